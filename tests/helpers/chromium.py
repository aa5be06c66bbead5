# SPDX-License-Identifier: Apache-2.0
"""Chromium for tests: a browser per session, a static server that counts requests, and page objects of the viewer."""

import base64
import itertools
import math
import os
import re
import shutil
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from csplat_tools.present.viewer_page import web_files

VIEWER = "/tools/viewer/index.html"
_COPY = "JSON.parse(JSON.stringify(csplatViewer.rig.{}))"

#: Headless Chromium may forget that a canvas heeds the wheel once the page has shown several scenes; not the window.
_HEED_WHEEL = "addEventListener('wheel', () => {}, { capture: true, passive: true })"

#: A function of a promise of bytes: playwright takes seconds to hand over an array of numbers.
_BASE64 = """(async (read) => {
  const bytes = await read;
  let text = '';
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
})"""


def read_pixels(page, pixels, width, height):
    """Return a picture, [H, W, 4] uint8, the top row first, of an expression for its bytes or a promise of them."""
    text = page.evaluate(f"{_BASE64}({pixels})")
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)


class _ServedPage:
    """A page in a tab: `page` is playwright's, `site` the server of scenes."""

    def __init__(self, tab, site):
        self.tab, self.page, self.site = tab, tab.page, site
        self._numbers = itertools.count()

    @classmethod
    @contextmanager
    def opened(cls, context):
        site = Site()
        try:
            with open_tab(context) as tab:
                page = cls(tab, site)
                page.load()
                yield page
        finally:
            site.close()

    @contextmanager
    def watched(self, request):
        """Let a test use the page; load it anew if the test fails, which it also does by complaints of the page."""
        failures = request.session.testsfailed
        yield self
        problems, self.tab.problems[:] = list(self.tab.problems), []
        if problems or request.session.testsfailed > failures:
            self.load()
        assert problems == []


class ViewerPage(_ServedPage):
    SIZE = {"width": 240, "height": 180}  # noqa: RUF012  # the tools take up most of a smaller window

    def load(self, query=""):
        self.visit(self.site.url(VIEWER + query))

    def visit(self, url):
        """Load a page, and wait until it shows its scene or an error."""
        self._resize()
        self.page.goto(url)
        self.page.evaluate(_HEED_WHEEL)
        self.until("'csplatViewer' in window")  # a page of one file starts when all of it has been read
        self.page.evaluate("csplatViewer.ready")

    def show(self, data, name="scene.csplat"):
        """Show a scene in the place of the present one; return its path on the server."""
        path = self.begin(data, name)
        self.page.evaluate("shown")
        return path

    def begin(self, data, name="scene.csplat"):
        """Start to show a scene, or an absent one; `shown` on the page resolves at the end."""
        path = f"/{next(self._numbers)}/{name}"
        url = self.site.url(path) if data is None else self.site.add(path, data)
        self.page.evaluate("([url, name]) => void (window.shown = csplatViewer.show(url, name))", [url, name])
        return path

    def rest(self):
        """Reset the page to its state after loading, except for the scene."""
        self.page.bring_to_front()
        self._resize()
        self.page.emulate_media(reduced_motion="no-preference")
        self.page.evaluate("document.getElementById('help-dialog').close()")
        if not self.hides("#statistics"):
            self.page.keyboard.press("i")
        self.page.keyboard.press("Escape")
        self.site.requests.clear()
        self.site.ranges, self.site.bytes_per_second, self.site.bytes_left = True, 0, math.inf

    def _resize(self):
        if self.page.viewport_size != self.SIZE:
            self.page.set_viewport_size(self.SIZE)

    def until(self, expression):
        self.tab.until(expression)

    def settle(self):
        self.until("!csplatViewer.controls.frame && !csplatViewer.stage.moving")
        self.page.evaluate("csplatViewer.engine.settled()")

    def moved(self, act):
        """Return the camera's pose before and after an action that moves it; browsers may report events late."""
        before = self.pose
        self.page.evaluate("window.before = JSON.stringify(csplatViewer.rig.pose)")
        act()
        self.until("before !== JSON.stringify(csplatViewer.rig.pose)")
        self.settle()
        return before, self.pose

    @property
    def pose(self):
        return self.page.evaluate(_COPY.format("pose"))

    @property
    def home(self):
        return self.page.evaluate(_COPY.format("home"))

    @property
    def viewmat(self):
        return self.page.evaluate("csplatViewer.rig.camera(80, 60).viewmat")

    def text(self, selector):
        return self.page.inner_text(selector)

    def hides(self, *selectors):
        return all(self.page.locator(selector).is_hidden() for selector in selectors)

    def error(self):
        return None if self.hides("#error") else self.page.get_attribute("#error", "data-code")

    def picture(self):
        """Return the settled picture, [H, W, 4] uint8, the top row first."""
        self.settle()  # while the camera glides to its place a slow machine draws fewer pixels
        width, height = self.page.evaluate("[csplatViewer.stage.width, csplatViewer.stage.height]")
        return read_pixels(self.page, "csplatViewer.engine.readPixels()", width, height)


_ENGINE = """<!doctype html><link rel="icon" href="data:,"><canvas id="canvas"></canvas><script type="module">
import { createEngine } from '/tools/viewer/engine.mjs';
window.errors = [];
window.make = async (options = {}) => {
  const onError = (error) => errors.push(error);
  window.engine = await createEngine(document.getElementById('canvas'), { onError, ...options });
};
window.open_ = async (source) => {
  try {
    await engine.open(source);
  } catch ({ code, message, offset }) {
    return { code, message, offset };
  }
};
window.look = (camera, width, height, background, degree) => {
  engine.setSize(width, height);
  engine.setBackground(background);
  engine.setShDegree(degree);
  engine.setCamera(camera);
};
window.isLoaded = true;
</script>"""


class EnginePage(_ServedPage):
    def load(self):
        self.page.goto(self.site.add("/engine.html", _ENGINE.encode()))
        self.page.wait_for_function("window.isLoaded")
        self.start()

    def start(self, options="{}"):
        self.page.evaluate(f"make({options})")

    def start_again(self, options="{}"):
        """Make the engine with other options, on a canvas of its own, since a canvas keeps its kind of context."""
        self.page.evaluate("engine.close(), document.querySelector('canvas').outerHTML = '<canvas id=canvas></canvas>'")
        self.start(options)

    def open(self, data, path="/scene.csplat"):
        return self.page.evaluate("open_", self.site.add(path, data))

    def look(self, camera, background=(0, 0, 0), degree=4):
        K = camera.K
        pinhole = {
            "viewmat": camera.viewmat.ravel().tolist(), "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
            "near": camera.near,
        }  # fmt: skip
        self.page.evaluate("(given) => look(...given)", [pinhole, camera.W, camera.H, list(background), degree])

    def picture(self, camera, background=(0, 0, 0), degree=4):
        """Return the settled picture, [H, W, 3] float, 0 to 1."""
        self.look(camera, background, degree)
        return self._read("engine.readPixels()", camera)

    def picture_of_now(self, camera):
        return self._read("engine.renderer.pixelsOf(engine.view, engine.look)", camera)

    def _read(self, pixels, camera):
        return read_pixels(self.page, pixels, camera.W, camera.H)[..., :3] / 255.0

    def stats(self):
        return self.page.evaluate("engine.stats")


ROOT = Path(__file__).resolve().parents[2]
SERVED = ("tools/viewer", "codec/js", "conformance/csplat_conformance/vectors")

#: WebGL2, with float render targets and float blending, and WebGPU on the CPU; deterministic pictures at one pixel per
#: pixel.
ARGUMENTS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan", "--use-vulkan=swiftshader",  # without these, a canvas of WebGPU loses the device
    "--disable-dev-shm-usage", "--force-device-scale-factor=1", "--force-color-profile=srgb", "--no-proxy-server",
]  # fmt: skip

TYPES = {
    ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".mjs": "text/javascript; charset=utf-8",
    ".js": "text/javascript; charset=utf-8", ".json": "application/json",
}  # fmt: skip


@dataclass
class Tab:
    """A page and its problems: console errors and uncaught exceptions. A test that provokes them clears the list."""

    page: object
    problems: list[str] = field(default_factory=list)

    def until(self, expression, seconds=60.0):
        """Wait until an expression is true; playwright's own way evaluates strings, which the page's policy forbids."""
        end = time.monotonic() + seconds
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, f"{expression} has not become true within {seconds:g} s"
            time.sleep(0.02)


class Site:
    """A static server on 127.0.0.1 with the viewer, the decoder, and the files that a test adds."""

    def __init__(self):
        self.requests = []  # path and status of all that came, in order
        self.ranges = True  # False: ignore Range, and answer 200 with everything
        self.bytes_per_second = 0  # speed of each answer to a path that a test added; 0 for no limit
        self.bytes_left = math.inf  # of answers to such paths, until they wait
        self.breaks = False  # True: connections break in the middle of a later part of such a path
        self.policy = ""  # Content-Security-Policy of all answers
        # By path: functions of a request's headers and number, from 1 on, that return an answer of their own or None.
        self.scripts, self._files = {}, {}
        self._web = web_files()  # from the package that is being tested, a checkout or a wheel
        site = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self):
                site._answer(self)

            do_HEAD = do_GET

            def log_message(self, *_args):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05})
        self._thread.start()

    def add(self, path, what):
        self._files[path] = what
        return self.url(path)

    def url(self, path):
        """Return the address of a path: `/tools/viewer/...`, `/codec/js/...`, or one that was added."""
        return f"http://127.0.0.1:{self._server.server_address[1]}{path}"

    def statuses(self, path):
        return [status for asked, status in self.requests if asked == path]

    def close(self):
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, handler):
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
        own = path in self.scripts and self.scripts[path](handler.headers, 1 + len(self.statuses(path)))
        if own:
            status, headers, body = own
        self.requests.append((path, status))
        handler.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body)), "Cache-Control": "no-store"}.items():
            handler.send_header(name, value)
        handler.end_headers()
        if self.breaks and path in self._files and asked and not asked.startswith("bytes=0-"):
            body, handler.close_connection = body[: len(body) // 2], True
        if handler.command == "GET":
            self._send(handler, body, slow=path in self._files)

    def _send(self, handler, body, *, slow):
        step = max(1, self.bytes_per_second // 20) if slow and self.bytes_per_second else len(body) or 1
        if slow and self.bytes_left < math.inf:
            step = min(step, 1024)
        try:
            for start in range(0, len(body), step):
                while slow and self.bytes_left <= 0:
                    time.sleep(0.02)
                self.bytes_left -= step if slow else 0
                if slow and self.bytes_per_second:
                    time.sleep(0.05)
                handler.wfile.write(body[start : start + step])
        except (BrokenPipeError, ConnectionResetError):
            handler.close_connection = True  # the page has gone elsewhere

    def _body(self, path):
        what = self._files.get(path)
        if isinstance(what, bytes):
            return what
        if what is None:
            what = self._web.get(path.lstrip("/"))
        if what is None and path.lstrip("/").startswith(SERVED) and ".." not in path:
            what = ROOT / path.lstrip("/")  # tests may have pages of their own
        return what.read_bytes() if what is not None and what.is_file() else None


def absent(reason):
    if os.environ.get("CI") == "true":
        pytest.fail(f"CI=true, and {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="session")
def browser():
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
def context(browser):
    """The profile that all tabs share: one of its own would cost a tab twice as much."""
    made = browser.new_context(viewport={"width": 800, "height": 600}, device_scale_factor=1)
    yield made
    made.close()


@contextmanager
def open_tab(context):
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
def tab(context):
    with open_tab(context) as made:
        yield made


@pytest.fixture
def site():
    made = Site()
    yield made
    made.close()


@pytest.fixture(scope="session")
def viewer_page(context):
    """The viewer's page, loaded once; tests take `viewer`."""
    with ViewerPage.opened(context) as page:
        yield page


@pytest.fixture
def viewer(request, viewer_page):
    """The viewer's page, loaded already; what the last test left open is closed. A failed test leaves a fresh page."""
    viewer_page.rest()
    with viewer_page.watched(request) as page:
        yield page


@pytest.fixture(scope="session")
def engine_page(context):
    """A page with the engine alone, loaded once; tests take `engine`."""
    with EnginePage.opened(context) as page:
        yield page


@pytest.fixture
def engine(request, engine_page):
    """The engine, made already; a failed test leaves a fresh page."""
    engine_page.page.evaluate("void (errors.length = 0)")
    with engine_page.watched(request) as page:
        yield page
