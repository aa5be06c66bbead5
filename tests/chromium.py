"""Chromium for tests: one browser per session, and a static server that counts the requests.

Loading the viewer's page costs two CPU seconds, showing another scene in it a tenth of one. So tests share a page
that is loaded already, and take a tab of their own only when they need another address or other markup:

    def test_a_scene_is_named(viewer):
        viewer.show(data)
        assert "scene.csplat" == viewer.text("#title")

    def test_something_else(tab, site):
        site.add("/scene.csplat", data)
        tab.page.goto(site.url("/tools/viewer/index.html?scene=/scene.csplat"))
        assert 206 in [one.status for one in site.requests]

Every file of such tests has `pytestmark = IN_CHROMIUM`: they are slow, and run on one worker, which starts one browser.
If Chromium or playwright is absent, the tests are skipped with the reason; with CI=true that is a failure.
"""

from __future__ import annotations

import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from viewer_pages import EnginePage, ViewerPage

from csplat_tools.present.viewer_page import web_files

ROOT = Path(__file__).resolve().parent.parent
SERVED = ("tools/viewer", "codec/js", "conformance/csplat_conformance/vectors")

#: Marks of a test that needs the browser.
IN_CHROMIUM = [pytest.mark.slow]

#: WebGL2 on the CPU, with float render targets and float blending; deterministic pictures at one pixel per pixel.
ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--force-device-scale-factor=1",
    "--force-color-profile=srgb",
    "--no-proxy-server",
]

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
}


@dataclass
class Tab:
    """A page, and what it complained about.

    Attributes:
        page: playwright's page.
        problems: console errors and uncaught exceptions; a test fails at its end when some are left, so a test
            that provokes them looks at them and clears the list.
    """

    page: Any
    problems: list[str] = field(default_factory=list)

    def until(self, expression: str, seconds: float = 60.0) -> None:
        """Wait until an expression is true; playwright's own way evaluates strings, which the page's policy forbids."""
        end = time.monotonic() + seconds
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, f"{expression} has not become true within {seconds:g} s"
            time.sleep(0.02)


@dataclass(frozen=True)
class Request:
    """A request as the server saw it: path without query, the Range header or "", and what was answered."""

    method: str
    path: str
    range: str
    status: int
    size: int


class Site:
    """A static server on 127.0.0.1 with the viewer, the decoder, and whatever a test adds.

    Attributes:
        requests: all that came, in order.
        ranges: False for a server that ignores Range and answers 200 with everything.
        bytes_per_second: speed of each answer to a path that a test added; 0 for no limit.
        policy: the Content-Security-Policy of all answers, if any.
    """

    def __init__(self) -> None:
        self.requests: list[Request] = []
        self.ranges = True
        self.bytes_per_second = 0
        self.policy = ""
        self._files: dict[str, bytes | Path] = {}
        self._web = web_files()  # from the package that is being tested, a checkout or a wheel
        site = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                site._answer(self)

            do_HEAD = do_GET

            def log_message(self, *_args: object) -> None:
                """Stay quiet."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05})
        self._thread.start()

    def add(self, path: str, what: bytes | Path) -> str:
        """Serve bytes or a file under a path; returns its URL."""
        self._files[path] = what
        return self.url(path)

    def url(self, path: str) -> str:
        """Return the address of a path: `/tools/viewer/...`, `/codec/js/...`, or one that was added."""
        return f"http://127.0.0.1:{self._server.server_address[1]}{path}"

    def statuses(self, path: str) -> list[int]:
        """Return the statuses of all answers to a path."""
        return [one.status for one in self.requests if one.path == path]

    def close(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, handler: BaseHTTPRequestHandler) -> None:
        path = handler.path.partition("?")[0]
        body = self._body(path)
        asked = handler.headers.get("Range") or ""
        status, headers = 200, {"Content-Type": TYPES.get(Path(path).suffix, "application/octet-stream")}
        if self.policy:
            headers["Content-Security-Policy"] = self.policy
        if body is None:
            status, body = 404, b"no such file"
        elif self.ranges:
            headers["Accept-Ranges"] = "bytes"
            match = re.fullmatch(r"bytes=(\d+)-(\d*)", asked)
            if match:
                total, first = len(body), int(match[1])
                last = min(int(match[2] or total - 1), total - 1)
                status = 416 if first >= total else 206
                body = b"" if status == 416 else body[first : last + 1]
                headers["Content-Range"] = f"bytes */{total}" if status == 416 else f"bytes {first}-{last}/{total}"
        self.requests.append(Request(handler.command, path, asked, status, len(body)))
        handler.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body)), "Cache-Control": "no-store"}.items():
            handler.send_header(name, value)
        handler.end_headers()
        if handler.command == "GET":
            self._send(handler, body, slow=path in self._files)

    def _send(self, handler: BaseHTTPRequestHandler, body: bytes, *, slow: bool) -> None:
        step = max(1, self.bytes_per_second // 20) if slow and self.bytes_per_second else len(body) or 1
        try:
            for start in range(0, len(body), step):
                if step < len(body):
                    time.sleep(0.05)
                handler.wfile.write(body[start : start + step])
        except (BrokenPipeError, ConnectionResetError):
            handler.close_connection = True  # the page has gone elsewhere

    def _body(self, path: str) -> bytes | None:
        what = self._files.get(path)
        if isinstance(what, bytes):
            return what
        if what is None:
            what = self._web.get(path.lstrip("/"))
        if what is None and path.lstrip("/").startswith(SERVED) and ".." not in path:
            what = ROOT / path.lstrip("/")  # tests may have pages of their own
        return what.read_bytes() if what is not None and what.is_file() else None


def absent(reason: str) -> None:
    """Skip the test, or fail if nothing may be absent."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"CI=true, and {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Playwright's browser, headless Chromium with WebGL2 on the CPU."""
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        absent("chromium is not installed")
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        absent("playwright is not installed: pip install playwright")
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield launched
        launched.close()


@pytest.fixture(scope="session")
def context(browser: Any) -> Iterator[Any]:
    """The profile that all tabs share: one of its own would cost a tab twice as much."""
    made = browser.new_context(viewport={"width": 800, "height": 600}, device_scale_factor=1)
    yield made
    made.close()


@contextmanager
def open_tab(context: Any) -> Iterator[Tab]:
    """Open a page; complaints that are left in `problems` at the end are a failure."""
    made = Tab(context.new_page())
    try:
        made.page.set_default_timeout(60_000)
        made.page.on("console", lambda message: message.type == "error" and made.problems.append(message.text))
        made.page.on("pageerror", lambda error: made.problems.append(str(error)))
        yield made
    finally:
        made.page.close()
    assert made.problems == []


@pytest.fixture
def tab(context: Any) -> Iterator[Tab]:
    """A fresh page of 800 by 600 pixels."""
    with open_tab(context) as made:
        yield made


@pytest.fixture
def site() -> Iterator[Site]:
    """A server for one test."""
    made = Site()
    yield made
    made.close()


@pytest.fixture(scope="session")
def viewer_page(context: Any) -> Iterator[ViewerPage]:
    """The viewer's page, loaded once; tests take `viewer`."""
    site = Site()
    try:
        with open_tab(context) as tab:
            page = ViewerPage(tab, site)
            page.load()
            yield page
    finally:
        site.close()


@pytest.fixture
def viewer(request: pytest.FixtureRequest, viewer_page: ViewerPage) -> Iterator[ViewerPage]:
    """The viewer's page, loaded already; what the last test left open is closed. A failed test leaves a fresh page."""
    failures = request.session.testsfailed
    viewer_page.rest()
    yield viewer_page
    problems, viewer_page.tab.problems[:] = list(viewer_page.tab.problems), []
    if problems or request.session.testsfailed > failures:
        viewer_page.load()
    assert problems == []


@pytest.fixture(scope="session")
def engine_page(context: Any) -> Iterator[EnginePage]:
    """A page with the engine alone, loaded once; tests take `engine`."""
    site = Site()
    try:
        with open_tab(context) as tab:
            page = EnginePage(tab, site)
            page.load()
            page.start()
            yield page
    finally:
        site.close()


@pytest.fixture
def engine(request: pytest.FixtureRequest, engine_page: EnginePage) -> Iterator[EnginePage]:
    """The engine, made already; a failed test leaves a fresh page."""
    failures = request.session.testsfailed
    engine_page.page.evaluate("void (errors.length = 0)")
    yield engine_page
    problems, engine_page.tab.problems[:] = list(engine_page.tab.problems), []
    if problems or request.session.testsfailed > failures:
        engine_page.load()
        engine_page.start()
    assert problems == []
