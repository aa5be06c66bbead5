"""Page objects: the viewer's page and a page with its engine, in terms of what a user does and sees."""

from __future__ import annotations

import base64
import itertools
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from chromium import Site, Tab

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


def read_pixels(page: Any, pixels: str, width: int, height: int) -> np.ndarray:
    """Return a picture, [H, W, 4] uint8, the top row first.

    Args:
        page: playwright's page.
        pixels: an expression for its bytes, or for a promise of them.
        width: pixels.
        height: pixels.
    """
    text = page.evaluate(f"{_BASE64}({pixels})")
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)


class ViewerPage:
    """The viewer's page in a tab.

    Attributes:
        tab: the tab; `tab.problems` are its complaints.
        page: playwright's page.
        site: the server of scenes.
    """

    SIZE: ClassVar = (240, 180)  # size of the window: the tools take up most of a smaller one

    def __init__(self, tab: Tab, site: Site) -> None:
        self.tab, self.page, self.site = tab, tab.page, site
        self._numbers = itertools.count()

    def load(self, query: str = "") -> None:
        """Load the served page with parameters, and wait until it shows its scene or an error."""
        self.visit(self.site.url(VIEWER + query))

    def visit(self, url: str) -> None:
        """Do the same with a page that lies elsewhere."""
        self._resize()
        self.page.goto(url)
        self.page.evaluate(_HEED_WHEEL)
        self.until("'csplatViewer' in window")  # a page of one file starts when all of it has been read
        self.page.evaluate("csplatViewer.ready")

    def show(self, data: bytes, name: str = "scene.csplat") -> str:
        """Show a scene in the place of the present one; return its path on the server."""
        path = self.begin(data, name)
        self.page.evaluate("shown")
        return path

    def begin(self, data: bytes | None, name: str = "scene.csplat") -> str:
        """Begin to show a scene, or one that is absent; `shown` on the page resolves when that is done."""
        path = f"/{next(self._numbers)}/{name}"
        url = self.site.url(path) if data is None else self.site.add(path, data)
        self.page.evaluate("([url, name]) => void (window.shown = csplatViewer.show(url, name))", [url, name])
        return path

    def rest(self) -> None:
        """Bring the page into the state of one that has just been loaded, its scene apart."""
        self.page.bring_to_front()
        self._resize()
        self.page.emulate_media(reduced_motion="no-preference")
        self.page.evaluate("document.getElementById('help-dialog').close()")
        if not self.hides("#statistics"):
            self.page.keyboard.press("i")
        self.page.keyboard.press("Escape")
        self.site.requests.clear()
        self.site.ranges, self.site.bytes_per_second = True, 0

    def _resize(self) -> None:
        size = {"width": self.SIZE[0], "height": self.SIZE[1]}
        if self.page.viewport_size != size:
            self.page.set_viewport_size(size)

    def until(self, expression: str) -> None:
        """Wait until an expression is true."""
        self.tab.until(expression)

    def settle(self) -> None:
        """Wait until the camera has come to rest, and the picture with it."""
        self.until("!csplatViewer.controls.frame && !csplatViewer.stage.moving")
        self.page.evaluate("csplatViewer.engine.settled()")

    def moved(self, act: Callable[[], object]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the camera's pose before and after an action, which moves it: a browser may take a while to tell."""
        before = self.pose
        self.page.evaluate("window.before = JSON.stringify(csplatViewer.rig.pose)")
        act()
        self.until("before !== JSON.stringify(csplatViewer.rig.pose)")
        self.settle()
        return before, self.pose

    @property
    def pose(self) -> dict[str, Any]:
        """Pose of the camera."""
        return self.page.evaluate(_COPY.format("pose"))

    @property
    def home(self) -> dict[str, Any]:
        """Pose of the first picture."""
        return self.page.evaluate(_COPY.format("home"))

    @property
    def viewmat(self) -> list[float]:
        """The camera's matrix, row by row."""
        return self.page.evaluate("csplatViewer.rig.camera(80, 60).viewmat")

    def text(self, selector: str) -> str:
        """Return the text of an element."""
        return self.page.inner_text(selector)

    def hides(self, *selectors: str) -> bool:
        """Return whether all of these elements are hidden."""
        return all(self.page.locator(selector).is_hidden() for selector in selectors)

    def error(self) -> str | None:
        """Return the code of the error that is shown, or None."""
        return None if self.hides("#error") else self.page.get_attribute("#error", "data-code")

    def picture(self) -> np.ndarray:
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


class EnginePage:
    """A page with the engine alone.

    Attributes:
        tab: the tab; `tab.problems` are its complaints.
        page: playwright's page.
        site: the server of scenes.
    """

    def __init__(self, tab: Tab, site: Site) -> None:
        self.tab, self.page, self.site = tab, tab.page, site
        site.add("/engine.html", _ENGINE.encode())

    def load(self) -> None:
        """Load the page."""
        self.page.goto(self.site.url("/engine.html"))
        self.page.wait_for_function("window.isLoaded")

    def start(self, options: str = "{}") -> None:
        """Make the engine."""
        self.page.evaluate(f"make({options})")

    def open(self, data: bytes, path: str = "/scene.csplat") -> dict[str, Any] | None:
        """Show a file; return the error, or None."""
        return self.page.evaluate("open_", self.site.add(path, data))

    def look(self, camera: Any, background: tuple[float, ...] = (0, 0, 0), degree: int = 3) -> None:
        """Set camera, size, background and degree."""
        K = camera.K
        pinhole = {
            "viewmat": camera.viewmat.ravel().tolist(),
            "fx": K[0, 0],
            "fy": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "near": camera.near,
        }
        self.page.evaluate("(given) => look(...given)", [pinhole, camera.W, camera.H, list(background), degree])

    def picture(self, camera: Any, background: tuple[float, ...] = (0, 0, 0), degree: int = 3) -> np.ndarray:
        """Return the settled picture, [H, W, 3] float, 0 to 1."""
        self.look(camera, background, degree)
        return self._read("engine.readPixels()", camera)

    def picture_of_now(self, camera: Any) -> np.ndarray:
        """Return the picture of the part that has arrived."""
        return self._read("(engine.drawNow(), engine.renderer.readPixels())", camera)

    def _read(self, pixels: str, camera: Any) -> np.ndarray:
        return read_pixels(self.page, pixels, camera.W, camera.H)[..., :3] / 255.0

    def stats(self) -> dict[str, Any]:
        """Return the engine's counts."""
        return self.page.evaluate("engine.stats")
