# SPDX-License-Identifier: Apache-2.0
"""A server with limited bandwidth, shared by all connections, and latency."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from csplat_tools.present.viewer_server import byte_range

#: Files below this path are slow, all others come at full speed.
SLOW = "/scenes/"

_BLOCK_BYTES = 4096  # bytes after which connections take turns: 3 ms at 10 Mbit/s


class Line:
    """A server of folders that records what was sent when.

    Attributes:
        bits_per_second: its bandwidth, over all connections together; may be changed between two loads.
        sent: times, in seconds since the epoch, and bytes of bodies that were handed to the system then.
        begun: time of the first request, seconds since the epoch; `None` before.
    """

    def __init__(self, bits_per_second: float, latency_seconds: float) -> None:
        self.sent: list[tuple[float, int]] = []
        self.begun: float | None = None
        self.bits_per_second = bits_per_second
        self._latency = latency_seconds
        self._lock = threading.Lock()
        self._free = 0.0  # monotonic time, seconds, at which all requested bytes will have passed
        self._open = 0
        self._ended = 0.0

    def forget(self) -> None:
        """Drop the record."""
        with self._lock:
            self.sent, self.begun = [], None

    @property
    def quiet_seconds(self) -> float:
        """Seconds since the last request ended; 0 while one is in progress."""
        with self._lock:
            return 0.0 if self._open else time.time() - self._ended

    @contextmanager
    def serve(self, folder: Path) -> Iterator[str]:
        """Serve the files of a folder, with HTTP Range; yield its address."""
        handler = functools.partial(type("Slow", (_Handler,), {"line": self}), directory=str(folder))
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            server.daemon_threads = True
            server.block_on_close = False
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_address[1]}/"
            server.shutdown()

    @contextmanager
    def request(self) -> Iterator[None]:
        """Count a request as open within the context, which begins after the latency."""
        with self._lock:
            self.begun = self.begun or time.time()
            self._open += 1
        try:
            time.sleep(self._latency)
            yield
        finally:
            with self._lock:
                self._open -= 1
                self._ended = time.time()

    def wait_for(self, size: int) -> None:
        """Wait until `size` bytes have passed, after those of other requests."""
        with self._lock:
            self._free = max(self._free, time.monotonic()) + 8.0 * size / self.bits_per_second
            wait = self._free - time.monotonic()
        time.sleep(max(0.0, wait))

    def record(self, size: int) -> None:
        """Record that `size` bytes have been sent."""
        with self._lock:
            self.sent.append((time.time(), size))


class _Handler(SimpleHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # otherwise a block waits for the acknowledgement of the last one
    line: Line

    def do_GET(self) -> None:
        if not self.path.startswith(SLOW):
            super().do_GET()
            return
        with self.line.request(), contextlib.suppress(ConnectionError):  # the page was left
            self._answer()

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def _answer(self) -> None:
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        body = path.read_bytes()
        headers = {"Accept-Ranges": "bytes", "Cache-Control": "no-store", "Content-Type": self.guess_type(path)}
        status, part = HTTPStatus.OK, body
        try:
            found = byte_range(self.headers.get("Range"), len(body))
        except ValueError:
            status, part = HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, b""
            headers["Content-Range"] = f"bytes */{len(body)}"
        else:
            if found:
                first, length = found
                status, part = HTTPStatus.PARTIAL_CONTENT, body[first : first + length]
                headers["Content-Range"] = f"bytes {first}-{first + length - 1}/{len(body)}"
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(part))}.items():
            self.send_header(name, value)
        self.end_headers()
        for start in range(0, len(part), _BLOCK_BYTES):
            block = part[start : start + _BLOCK_BYTES]
            self.line.wait_for(len(block))
            self.wfile.write(block)
            self.line.record(len(block))
