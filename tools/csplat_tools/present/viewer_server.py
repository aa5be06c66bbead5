# SPDX-License-Identifier: Apache-2.0
"""Prepare a scene for the viewer, and serve the page, the decoder and the scene with HTTP Range.

A table lists all paths that are served, so that no other file can be reached. Requests for other hosts are refused, see
`SceneServer.serves`.
"""

from __future__ import annotations

import errno
import io
import json
import os
import re
import socket
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from pathlib import Path
from typing import BinaryIO, cast
from urllib.parse import quote, unquote, urlencode, urlsplit

from csplat._spec import ERROR_TRAILING, ERROR_TRUNCATED
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import SceneHeader, read_header
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions, PresetName
from csplat.errors import FormatError, InputError
from csplat.file_source import open_binary, read_bytes
from csplat.lint import Finding
from csplat.scene_metadata import Direction
from csplat_render.camera_files import load_cameras
from csplat_tools.file_streams import STANDARD_STREAM, is_csplat, local_path, mapped_csplat
from csplat_tools.present.viewer_page import PAGE, web_files
from csplat_tools.scene_files import MetadataOverrides, read_source, with_first_view

_NONE = MetadataOverrides()
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".csplat": "model/vnd.csplat",
}
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src data:;"
    " base-uri 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-cache",
}
_BLOCK_BYTES = 1 << 20
_SECONDS_IDLE = 60.0
_DRAINED_BYTES = 1 << 20  # bytes; the part of a request's body that is read before the connection is closed
_DRAIN_SECONDS = 1.0  # seconds; the time that this may take
_DIGITS_MAX = 18  # decimal digits; a longer position lies after the end of any file


@dataclass(frozen=True)
class _Resource:
    """The content of a path.

    Attributes:
        open: returns a stream of the content, and its size in bytes.
        media_type: value of `Content-Type`.
        tag: returns the entity tag of a stream from `open`.
    """

    open: Callable[[], tuple[BinaryIO, int]]
    media_type: str
    tag: Callable[[BinaryIO], str]


@dataclass(frozen=True)
class ViewerScene:
    """A scene that the viewer can show.

    Attributes:
        name: name of the file that the page shows; ends in `.csplat`.
        content: path of the file, or its bytes.
        size_bytes: size of the file.
        header: header of the file.
        findings: lint findings in the source.
        encoded_from: size of the source in bytes; 0 if it is a .csplat file.
    """

    name: str
    content: Path | bytes
    size_bytes: int
    header: SceneHeader
    findings: tuple[Finding, ...] = ()
    encoded_from: int = 0

    def read(self) -> bytes:
        """Return the bytes of the file."""
        return self.content if isinstance(self.content, bytes) else read_bytes(self.content)


class SceneServer(ThreadingHTTPServer):
    """A server of one scene; `url` is the address of its page."""

    daemon_threads = True  # connections that a browser keeps open must not keep the command alive

    def __init__(self, host: str, port: int, resources: Mapping[str, _Resource], start: str) -> None:
        """Bind and listen, and set `url`.

        Args:
            host: address of a network interface, or a name of this machine; IPv4 is preferred.
            port: port number; 0 for any free port.
            resources: content by path, without the first slash.
            start: path of the page with its query, to which `/` redirects.

        Raises:
            OSError, OverflowError, ValueError: the host or the port cannot be used.
        """
        self.resources = resources
        self.start = start
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, _, _, _, address = min(addresses, key=lambda entry: entry[0] != socket.AF_INET)
        self.address_family = family
        super().__init__(cast("tuple[str, int]", address), _Handler)
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.server_address[1]}/"
        own = socket.gethostname().lower()
        names = set() if _is_loopback(str(self.server_address[0])) else {own, f"{own}.local", host.lower().rstrip(".")}
        self._names = {"localhost", *names}

    def serves(self, host: str) -> bool:
        """Return True for the host of a request if its page may read the scene.

        Protects from DNS rebinding: the owner of a web page can let its name lead to this machine. An address leads
        nowhere else, and names of this machine are nobody else's: `localhost`, and for a server that other machines
        reach its host name, the same with `.local`, and the name that the user gave.

        Args:
            host: host and port as in the header `Host`.
        """
        name = re.sub(r":[0-9]*$", "", host)
        if name.startswith("["):
            return name.endswith("]") and _is_address(name[1:-1])
        return _is_address(name) or name.lower().removesuffix(".") in self._names

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore connections that the browser closes early."""


@contextmanager
def open_viewer_scene(path: str, *, preset: PresetName, context: Context = DEFAULT_CONTEXT) -> Iterator[ViewerScene]:
    """Prepare a scene: check the header of a .csplat file, or encode a file of another format.

    Args:
        path: the file, or `-`.
        preset: preset of the encoder.
        context: threads and seed of encoding, and progress.

    Yields:
        The scene; its content can be read within the context.

    Raises:
        CsplatError: the file is not valid.
        OSError: the file cannot be read.
    """
    with local_path(path) as local:
        name = "scene" if path == STANDARD_STREAM else Path(path).stem or "scene"
        stem = os.fsencode(name).decode("utf-8", "replace")  # a name in another encoding is no part of a URL
        yield _check_scene(local, stem) if is_csplat(local) else _encode_scene(local, stem, preset, context)


@contextmanager
def open_server(
    scene: ViewerScene, *, host: str = "127.0.0.1", port: int = 0, wishes: Mapping[str, str] | None = None
) -> Iterator[SceneServer]:
    """Open a server for a scene; `serve_forever` runs it.

    Args:
        scene: the scene to show.
        host: the address of a network interface, or `localhost`.
        port: port number; 0 for any free port.
        wishes: parameters of the page.

    Yields:
        The server, already listening.

    Raises:
        InputError: the port is in use, or the host is not an address of this machine.
    """
    if not host.strip():  # would be all interfaces
        raise InputError("the host is empty, expected 127.0.0.1 for local access, 0.0.0.0 for all interfaces")
    place = f"scene/{scene.name}"
    resources = {path: _file_resource(file) for path, file in web_files().items()}
    content = scene.content
    resources[place] = (
        _bytes_resource(content, ".csplat") if isinstance(content, bytes) else _file_resource(content, ".csplat")
    )
    parameters = {"scene": "/" + quote(place), **(wishes or {})}
    if "camera" in parameters:  # too long for a URL
        resources["cameras.json"] = _bytes_resource(parameters["camera"].encode(), ".json")
        parameters["camera"] = "/cameras.json"
    start = f"/{PAGE}?{urlencode(parameters)}"
    try:
        server = SceneServer(host, port, resources, start)
    except OverflowError:
        raise InputError(f"the port is {port}, expected 1 to 65535, or 0 for any free port") from None
    except ValueError:  # not a valid host name: 300 letters, for example
        raise InputError(_NOT_HERE.format(host)) from None
    except OSError as error:
        raise InputError(_bind_error_message(error, host, port)) from None
    with server:
        yield server


def page_parameters(
    camera: str | None,
    overrides: MetadataOverrides = _NONE,
    report: list[str] | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> dict[str, str]:
    """Return the parameters of the page for given options.

    Args:
        camera: a camera file, see `load_cameras`. The page starts at the first camera and steps through all of them.
        overrides: overrides of the scene's axes and up direction.
        report: receives remarks on camera files of other programs.
        origin: the scene's origin.

    Raises:
        InputError: the camera file has no cameras.
    """
    wishes = {}
    if camera is not None:
        entries = [view.as_json() for view in load_cameras(camera, report, origin)]
        wishes["camera"] = json.dumps(entries, separators=(",", ":"))
    if overrides.coordinate_system is not None:
        wishes["axes"] = overrides.coordinate_system
    if overrides.up is not None:
        wishes["up"] = _format_direction(overrides.up)
    return wishes


def byte_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Parse a Range header (RFC 9110, 14.2).

    Args:
        header: its value.
        size: number of bytes of the resource.

    Returns:
        First byte and number of bytes; `None` to send everything: there is no range, an unsupported range, or several.

    Raises:
        ValueError: no byte of the range exists (status 416).
    """
    match = re.fullmatch(r"bytes=\s*(\d*)-(\d*)\s*", header or "", re.ASCII | re.IGNORECASE)
    if match is None or match[1] == match[2] == "":
        return None
    first, last = (_position(digits) for digits in match.groups())
    if match[1] == "":
        length = min(last, size)
        if length == 0:
            raise ValueError("a range of no bytes")
        return size - length, length
    if match[2] == "":
        last = size - 1
    elif last < first:
        return None
    if first >= size:
        raise ValueError("a range after the end")
    return first, min(last, size - 1) - first + 1


def _position(digits: str) -> int:
    """Return a number of any length, limited; Python refuses to convert 5,000 digits."""
    digits = digits.lstrip("0")
    return int(digits or "0") if len(digits) <= _DIGITS_MAX else 10**_DIGITS_MAX


def _is_address(host: str) -> bool:
    """Return True for an IPv4 or IPv6 address without brackets."""
    try:
        ip_address(host)
    except ValueError:
        return False
    return True


def _is_loopback(address: str) -> bool:
    """Return True for an address that only programs on this machine reach, also for IPv4 addresses in IPv6."""
    parsed = ip_address(address.partition("%")[0])
    return (getattr(parsed, "ipv4_mapped", None) or parsed).is_loopback


def _format_direction(up: Direction) -> str:
    return ",".join(f"{value:g}" for value in up)


def _check_scene(path: Path, stem: str) -> ViewerScene:
    """Return the scene of a .csplat file, of which only header and size are checked.

    Raises:
        FormatError: the header is invalid, or the file has another size than it declares.
    """
    with mapped_csplat(str(path)) as data:
        header, size = read_header(data), len(data)
    if size != header.file_size:
        code, offset, clause, detail = (
            (ERROR_TRUNCATED, size, "HDR-5", "the file ends early")
            if size < header.file_size
            else (ERROR_TRAILING, header.file_size, "HDR-6", "bytes follow the end of the file")
        )
        raise FormatError(code, offset, clause, detail, found=f"{size} bytes", wanted=f"{header.file_size} bytes")
    return ViewerScene(f"{stem}.csplat", path, size, header)


def _encode_scene(path: Path, stem: str, preset: PresetName, context: Context) -> ViewerScene:
    """Read a scene of another format, and encode it in memory under the name `stem`.

    Raises:
        CsplatError: the scene is not valid.
    """
    source = with_first_view(read_source(str(path), context=context))
    data = encode_with_report(source.model(), EncodeOptions(preset=preset), context=context).data
    return ViewerScene(f"{stem}.csplat", data, len(data), read_header(data), tuple(source.findings), source.size_bytes)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "csplat"
    sys_version = ""
    timeout = _SECONDS_IDLE
    default_request_version = "HTTP/1.0"  # with HTTP/0.9, errors in the request line are answered without a status
    raw_requestline: bytes

    def do_GET(self) -> None:
        self._respond(send=True)

    def do_HEAD(self) -> None:
        self._respond(send=False)

    def parse_request(self) -> bool:
        """Parse a request; refuse HTTP/0.9, which has no version and no headers."""
        if len(self.raw_requestline.split()) == 2:
            self.requestline, self.request_version, self.command = "", self.default_request_version, ""
            self.send_error(HTTPStatus.BAD_REQUEST)
            return False
        return super().parse_request()

    def handle_expect_100(self) -> bool:
        """Do not ask for the body of a request: none is read."""
        return True

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:  # noqa: ARG002
        """Refuse a request that cannot be parsed, or its method, and close the connection."""
        self.close_connection = True
        self._refuse(HTTPStatus(code), send=self.command != "HEAD")

    def finish(self) -> None:
        """Close the connection. Unread bytes would let the system reset it, before the client has read the answer."""
        super().finish()
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(_DRAIN_SECONDS)
            end, left = time.monotonic() + _DRAIN_SECONDS, _DRAINED_BYTES
            while left > 0 and time.monotonic() < end and (data := self.connection.recv(_BLOCK_BYTES)):
                left -= len(data)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: standard error is for messages to the user."""

    def _respond(self, *, send: bool) -> None:
        """Answer a request: a resource, a redirect from `/` to the page, or status 400, 404 or 421.

        Args:
            send: send the body, too; False for HEAD.
        """
        server = self.server
        assert isinstance(server, SceneServer)
        if self.headers.get("Content-Length", "0").strip() != "0" or "Transfer-Encoding" in self.headers:
            self.close_connection = True  # the body is not read, and must not be taken for the next request
        hosts = self.headers.get_all("Host", [])
        try:
            target = urlsplit(self.path)
        except ValueError:  # "http://["
            self._refuse(HTTPStatus.BAD_REQUEST, send=send)
            return
        is_local = self.path.startswith("/")
        is_named = len(hosts) == 1 or (not hosts and self.request_version == "HTTP/1.0")
        if not is_named or not (is_local or target.scheme in ("http", "https")):
            self._refuse(HTTPStatus.BAD_REQUEST, send=send)
            return
        # RFC 9112, 3.2.2: "a server MUST ignore the received Host header field (if any) and instead replace it".
        if not server.serves("".join(hosts).strip() if is_local else target.netloc):
            self._refuse(HTTPStatus.MISDIRECTED_REQUEST, send=send)
            return
        path = unquote(target.path).removeprefix("/")
        if path == "":
            self._write_head(HTTPStatus.FOUND, {"Location": server.start, "Content-Length": "0"})
            return
        resource = server.resources.get(path)
        if resource is None:
            self._refuse(HTTPStatus.NOT_FOUND, send=send)
            return
        try:
            stream, size = resource.open()
        except OSError:  # the file was removed since the server started
            self._refuse(HTTPStatus.NOT_FOUND, send=send)
            return
        with stream:
            self._send_resource(resource, stream, size, send=send)

    def _send_resource(self, resource: _Resource, stream: BinaryIO, size: int, *, send: bool) -> None:
        """Send an open resource of `size` bytes, the requested range of it, or status 416 if that has no byte."""
        tag = resource.tag(stream)
        headers = {"Content-Type": resource.media_type, "Accept-Ranges": "bytes", "ETag": tag}
        condition = self.headers.get("If-Range")  # the tag of the version of which the client has a part
        try:
            requested = byte_range(self.headers.get("Range"), size) if condition in (None, tag) else None
        except ValueError:
            headers |= {"Content-Range": f"bytes */{size}", "Content-Length": "0"}
            self._write_head(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, headers)
            return
        first, length = requested or (0, size)
        headers["Content-Length"] = str(length)
        if requested is not None:
            headers["Content-Range"] = f"bytes {first}-{first + length - 1}/{size}"
        self._write_head(HTTPStatus.OK if requested is None else HTTPStatus.PARTIAL_CONTENT, headers)
        if send:
            self._write_range(stream, first, length)

    def _write_range(self, stream: BinaryIO, first: int, length: int) -> None:
        """Write `length` bytes of a stream from `first` on; if it ends before, mark the connection to be closed."""
        stream.seek(first)
        while length > 0:
            block = stream.read(min(length, _BLOCK_BYTES))
            if not block:  # the file was truncated; the browser notices missing bytes
                self.close_connection = True
                return
            self.wfile.write(block)
            length -= len(block)

    def _refuse(self, status: HTTPStatus, *, send: bool) -> None:
        """Answer with an error status, and its phrase as text if `send`."""
        body = f"{status.value} {status.phrase}\n".encode()
        self._write_head(status, {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
        if send:
            self.wfile.write(body)

    def _write_head(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        """Write the status line and the headers; `headers` replace those of `_HEADERS`."""
        self.send_response(status)
        if self.close_connection:
            self.send_header("Connection", "close")
        for name, value in {**_HEADERS, **headers}.items():
            self.send_header(name, value)
        self.end_headers()


def _file_resource(path: Path, ending: str = "") -> _Resource:
    """Return the resource of a file, opened anew for each request; `ending` replaces its own for the media type."""

    def open_file() -> tuple[BinaryIO, int]:
        stream = open_binary(path)
        return stream, os.fstat(stream.fileno()).st_size

    def tag(stream: BinaryIO) -> str:
        status = os.fstat(stream.fileno())
        return f'"{status.st_size:x}-{status.st_mtime_ns:x}-{status.st_ino:x}"'

    return _Resource(open_file, _TYPES[ending or path.suffix], tag)


def _bytes_resource(data: bytes, ending: str) -> _Resource:
    """Return the resource of bytes in memory, with the media type of a file name ending."""
    tag = f'"{zlib.crc32(data):08x}"'
    return _Resource(lambda: (io.BytesIO(data), len(data)), _TYPES[ending], lambda _stream: tag)


_NOT_HERE = "{} is not an address of this machine: use 127.0.0.1 for local access, 0.0.0.0 for all interfaces"


def _bind_error_message(error: OSError, host: str, port: int) -> str:
    """Return the message for an error of binding to a host and port, with a remedy if one is known."""
    if error.errno == errno.EADDRINUSE:
        return f"port {port} is in use: --port 0 finds a free port"
    if error.errno == errno.EACCES:
        return f"port {port} requires more rights: --port 0 finds a free port"
    if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        return _NOT_HERE.format(host)
    return f"{host}:{port}: {error.strerror or error}"
