"""A web server and an S3 on this machine, for files that are read in parts; the former may be as bad as it is told."""

import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from csplat_tools.present.server import byte_range

KEYS = {"key": "nobody", "secret": "nothing"}


class Web:
    """What a server serves, and how.

    Attributes:
        files: by path, as `/scene.csplat`.
        ranges: whether it knows parts of files.
        cut_after: requests from which on a body ends in its middle; `None`: never.
        asked: method, path and Range of each request.
        before: called before each answer.
    """

    def __init__(self, files):
        self.files = dict(files)
        self.ranges = True
        self.cut_after = None
        self.asked = []
        self.before = lambda: None
        self.sent = 0

    @property
    def gets(self):
        return [one for one in self.asked if one[0] == "GET"]

    @contextmanager
    def serve(self):
        """Yields the address, without a slash at its end."""
        handler = type("Handler", (_Handler,), {"web": self})
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            server.daemon_threads = True
            server.handle_error = lambda *_: None  # clients hang up
            server.block_on_close = False
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_address[1]}"
            server.shutdown()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    web: Web

    def do_HEAD(self):
        self._answer(send=False)

    def do_GET(self):
        self._answer(send=True)

    def log_message(self, format, *args):
        pass

    def _answer(self, *, send):
        web = self.web
        web.asked.append((self.command, self.path, self.headers.get("Range")))
        web.before()
        data = web.files.get(self.path)
        if not isinstance(data, bytes):
            self.send_response(data or 404)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        try:
            part = byte_range(self.headers.get("Range"), len(data)) if web.ranges else None
        except ValueError:
            data, part = b"", None
        body = data if part is None else data[part[0] : part[0] + part[1]]
        self.send_response(206 if part else 200 if data else 416)
        self.send_header("ETag", f'"{hash(data)}"')
        self.send_header("Content-Length", str(len(body)))
        if part is not None:
            self.send_header("Content-Range", f"bytes {part[0]}-{part[0] + part[1] - 1}/{len(data)}")
        self.end_headers()
        if not send:
            return
        if web.cut_after is not None and len(web.gets) > web.cut_after:
            body = body[: len(body) // 2]
            self.close_connection = True
        try:
            self.wfile.write(body)
            web.sent += len(body)
        except ConnectionError:
            pass  # whoever asked has enough


@contextmanager
def s3(files):
    """Serve files by their keys in a bucket `scenes`; yields the options with which fsspec finds them."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        endpoint = f"http://{host}:{port}"
        client = boto3.client(
            "s3",
            endpoint_url=endpoint,
            aws_access_key_id=KEYS["key"],
            aws_secret_access_key=KEYS["secret"],
            region_name="us-east-1",
        )
        client.create_bucket(Bucket="scenes")
        for key, data in files.items():
            client.put_object(Bucket="scenes", Key=key, Body=data)
        client.close()
        yield {**KEYS, "endpoint_url": endpoint}
    finally:
        server.stop()
