# SPDX-License-Identifier: Apache-2.0
"""Stores of files that are read in parts: in memory, a local web server and a local S3.

Memory and web server can be made to misbehave.
"""

import gzip
import threading
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from csplat import read_header
from csplat_tools.present.viewer_server import byte_range

KEYS = {"key": "nobody", "secret": "nothing"}


def assert_same(a, b):
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def box_of(data, place):
    header = read_header(data)
    tile, step = header.tiles[place], header.attributes[3].step
    corners = np.array([tile.corner, np.add(tile.corner, tile.extent)])
    return tuple(np.float32(corners * (step * 2.0**tile.exponent)).ravel().tolist())


class FileSystem:
    async_impl = True

    def __init__(self, files):
        self.files = dict(files)  # by name
        self.protocol = "store"  # one name, or several
        self.cut_after = None  # number of requests after which only half of a range is returned
        self.answer = None  # raised in place of any answer
        self.asked = self.sent = 0  # numbers of requests and of bytes sent

    def info(self, name):
        data = self._data(name)
        return {"size": len(data), "ETag": hash(data)}

    def invalidate_cache(self, name):
        pass

    def cat_ranges(self, names, starts, stops, on_error):
        assert "return" == on_error
        return [self._part(*one) for one in zip(names, starts, stops, strict=True)]

    def _data(self, name):
        self.asked += 1
        if self.answer is not None:
            raise self.answer
        if name.partition("?")[0] not in self.files:
            raise FileNotFoundError(name)
        return self.files[name.partition("?")[0]]

    def _part(self, name, start, stop):
        part = self._data(name)[start:stop]
        if self.cut_after is not None and self.asked > self.cut_after:
            part = part[: len(part) // 2]
        self.sent += len(part)
        return part


class Web:
    def __init__(self, files):
        self.files = dict(files)  # by path, as `/scene.csplat`
        self.ranges = True  # whether it supports HTTP Range
        self.faults = []  # answers to the next GETs: a status; None; or the name of a fault in `_Handler`
        self.tag = None  # its ETag; by default that of the content
        self.coding = ""  # Content-Encoding of all answers, as of a file that is stored compressed
        self.released = threading.Event()  # ends stalled answers
        self.cut_after = None  # number of requests after which bodies are cut short
        self.asked = []  # method, path and Range of each request so far
        self.before = lambda: None  # called before each answer
        self.sent = 0  # bytes

    @property
    def gets(self):
        return [one for one in self.asked if one[0] == "GET"]

    @contextmanager
    def serve(self):
        """Yield the address without a trailing slash."""
        handler = type("Handler", (_Handler,), {"web": self})
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            server.daemon_threads = True
            server.handle_error = lambda *_: None  # clients hang up
            server.block_on_close = False
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_address[1]}"
            self.released.set()
            server.shutdown()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    web: Web

    def log_message(self, format, *args):
        pass

    def do_HEAD(self):
        self.do_GET(send=False)

    def do_GET(self, *, send=True):
        web = self.web
        web.asked.append((self.command, self.path, self.headers.get("Range")))
        web.before()
        fault = web.faults.pop(0) if send and web.faults else None
        data = web.files.get(self.path) if not isinstance(fault, int) else fault
        if not isinstance(data, bytes):
            self.send_response(data or 404)
            if fault in {429, 503}:
                self.send_header("Retry-After", "0")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        if fault == "hang up":
            self.close_connection = True
            return
        try:
            part = byte_range(self.headers.get("Range"), len(data)) if web.ranges and fault != "whole" else None
        except ValueError:
            data, part = b"", None
        if fault == "short":
            part = part[0], part[1] // 2
        body = data if part is None else data[part[0] : part[0] + part[1]]
        self.send_response(206 if part and fault != "part as 200" else 200 if data else 416)
        if web.tag != "":
            self.send_header("ETag", web.tag or f'"{hash(data)}"')
        if fault == "gzip":
            body = gzip.compress(body)
        if web.coding or fault == "gzip":
            self.send_header("Content-Encoding", web.coding or fault)
        if fault == "broken chunk":
            self.send_header("Transfer-Encoding", "chunked")
        elif fault != "until it closes":
            self.send_header("Content-Length", str(len(body)))
        if part is not None and fault != "part as 200":
            start = part[0] + (fault == "shifted")
            self.send_header("Content-Range", f"bytes {start}-{start + part[1] - 1}/{len(data)}")
        self.end_headers()
        if not send:
            return
        half = fault in {"half", "stall", "broken chunk", "until it closes"}
        if half or (web.cut_after is not None and len(web.gets) > web.cut_after):
            body = body[: len(body) // 2]
            self.close_connection = True
        if fault == "broken chunk":
            body = b"%x\r\n%s" % (len(body), body)
        with suppress(ConnectionError):  # the client closed the connection
            self.wfile.write(body)
            web.sent += len(body)
        if fault == "stall":
            web.released.wait(5)


@contextmanager
def s3(files):
    """Serve files by their keys in a bucket `scenes`; yield the storage options for fsspec."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        endpoint = f"http://{host}:{port}"
        keys = {"aws_access_key_id": KEYS["key"], "aws_secret_access_key": KEYS["secret"]}
        client = boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1", **keys)
        client.create_bucket(Bucket="scenes")
        for key, data in files.items():
            client.put_object(Bucket="scenes", Key=key, Body=data)
        client.close()
        yield {**KEYS, "endpoint_url": endpoint}
    finally:
        server.stop()
