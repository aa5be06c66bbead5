"""`<csplat-view>`: scenes in pages of others, from one script or from the served modules."""

import gzip
import re
from pathlib import Path

import numpy as np
import pytest
from chromium import IN_CHROMIUM
from typer.testing import CliRunner
from viewer_pages import read_pixels

from csplat import EncodeOptions, encode
from csplat_tools.cli.app import app
from csplat_tools.present.viewer_page import export_element

pytestmark = [*IN_CHROMIUM, pytest.mark.area(name="chromium")]

POLICY = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src blob:; connect-src 'self'; img-src data:"
GUIDE = (Path(__file__).resolve().parent.parent / "codec" / "EMBEDDING.md").read_text("utf-8")
STYLE = "csplat-view { width: 160px; height: 120px }"
ONE_FILE = '<script src="../scripts/csplat-view.js"></script>'
MODULE = '<script type="module" src="/tools/viewer/element.mjs"></script>'
# Events of elements, without progress: [[id, type, detail], ...].
RECORD = """
globalThis.told = [];
for (const type of ['load', 'error']) {
  const record = ({ target, detail }) => target.localName === 'csplat-view' && told.push([target.id, type, detail]);
  document.addEventListener(type, record, { capture: true });
}
"""


@pytest.fixture
def blog(tab, site, make_model):
    """A function that opens a page with a text in it; scenes are /scene.csplat (60 splats) and /other.csplat (90)."""
    fast = EncodeOptions(preset="fast")
    site.add("/scene.csplat", encode(make_model(60, 0, scales=np.full((60, 3), -2, "f")), fast))
    site.add("/other.csplat", encode(make_model(90, 0, scales=np.full((90, 3), -2, "f")), fast))
    site.add("/scripts/csplat-view.js", export_element())
    site.add("/blog/style.css", STYLE.encode())

    tab.page.add_init_script(RECORD)

    def opened(text, script=ONE_FILE, policy=POLICY):
        head = f'<meta http-equiv="Content-Security-Policy" content="{policy}; style-src \'self\'">' if policy else ""
        links = "<link rel=icon href=data:,><link rel=stylesheet href=style.css>"
        page = f"<!doctype html><meta charset=utf-8>{head}<title>x</title>{links}{text}{script}"
        tab.page.goto(site.add("/blog/post.html", page.encode()))
        return tab.page

    return opened


def told(tab, identity=""):
    """Wait for an event of an element; return its type and its detail."""
    tab.until(f"told.some(([id]) => id === '{identity}')")
    return tab.page.evaluate(f"told.splice(told.findIndex(([id]) => id === '{identity}'), 1)[0].slice(1)")


def shown(page, element="csplat-view"):
    """Return a mask of the pixels that are not black in the settled picture, [120, 160]."""
    pixels = f"document.querySelector('{element}').engine.readPixels()"
    return read_pixels(page, pixels, 160, 120)[..., :3].max(axis=2) > 20


def test_a_scene_is_shown_and_then_another_and_then_none(tab, blog):
    page = blog('<csplat-view alt="A garden"></csplat-view>')
    page.evaluate("globalThis.view = document.querySelector('csplat-view')")
    page.evaluate("globalThis.progress = 0; view.addEventListener('progress', () => progress++)")
    page.evaluate("view.src = '../scene.csplat'")
    kind, stats = told(tab)
    assert ("load", 60) == (kind, stats["splatCount"])
    assert page.evaluate("progress") > 0
    assert 0.02 < shown(page).mean() < 0.9
    canvas = page.locator("csplat-view canvas")
    assert canvas.get_attribute("aria-label").startswith("A garden. Arrow keys")
    assert 0 == page.evaluate("performance.getEntriesByType('resource').filter(({ name }) => /mjs/.test(name)).length")

    page.evaluate("view.setAttribute('background', '#ff0000')")
    assert [255, 0, 0] == page.evaluate("view.engine.readPixels().then((pixels) => Array.from(pixels.slice(0, 3)))")

    page.evaluate("globalThis.old = view.shadowRoot.querySelector('canvas').getContext('webgl2')")
    page.evaluate("view.src = '/other.csplat'")
    kind, stats = told(tab)
    assert ("load", 90) == (kind, stats["splatCount"])
    assert page.evaluate("old.isContextLost()")
    assert 1 == len(page.workers)

    page.evaluate("document.body.append(document.createElement('main')); document.querySelector('main').append(view)")
    assert page.evaluate("Promise.resolve().then(() => view.engine !== null)")  # it was moved, not removed
    page.evaluate("old = view.shadowRoot.querySelector('canvas').getContext('webgl2'); view.remove()")
    assert page.evaluate("view.engine === null && old.isContextLost()")
    tab.page.wait_for_timeout(50)
    assert [] == page.workers


def test_the_wheel_is_the_pages_until_a_scene_is_clicked_and_scenes_load_when_they_are_near(tab, site, blog):
    scenes = [
        f'<csplat-view id="{name}" src="/{file}.csplat"></csplat-view>'
        for name, file in (("a", "scene"), ("b", "other"))
    ]
    page = blog((90 * "<br>x").join(scenes), MODULE, policy="")
    assert "load" == told(tab, "a")[0]
    page.evaluate("globalThis.pixels = async () => (await a.engine.readPixels()).reduce((sum, one) => sum + one, 0)")
    before = page.evaluate("pixels()")
    page.mouse.move(80, 60)
    page.mouse.wheel(0, 30)
    tab.until("scrollY === 30")
    assert before == page.evaluate("pixels()")
    assert "pan-y" == page.eval_on_selector("#a canvas", "(canvas) => getComputedStyle(canvas).touchAction")

    page.mouse.click(80, 60)
    page.mouse.wheel(0, 30)
    tab.until(f"pixels().then((sum) => sum !== {before})")
    assert 30 == page.evaluate("scrollY")
    page.keyboard.press("Escape")
    page.mouse.wheel(0, 30)
    tab.until("scrollY === 60")
    before = page.evaluate("pixels()")
    page.evaluate("a.focus()")
    page.keyboard.press("Shift+ArrowRight", delay=100)
    tab.until(f"pixels().then((sum) => sum !== {before})")

    assert [] == site.statuses("/other.csplat")
    page.evaluate("b.scrollIntoView()")
    assert "load" == told(tab, "b")[0]
    assert (2, True) == (len(page.workers), shown(page, "#b").any())


def test_what_went_wrong_is_said_in_words(tab, site, blog):
    site.add("/cut.csplat", site._files["/scene.csplat"][:-20])
    cases = [
        ("/cut.csplat", "E_TRUNCATED", "ends too early", POLICY),
        ("/none.csplat", "E_INPUT", "could not be read.*404", POLICY),
        ("/scene.csplat", "E_WORKER", "could not start.*worker-src", POLICY.replace("blob:", "'none'")),
        ("/scene.csplat", "E_WEBGL2", "no WebGL 2", POLICY),
    ]
    for src, code, words, policy in cases:
        if code == "E_WEBGL2":
            tab.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        page = blog("<csplat-view></csplat-view>", policy=policy)
        page.eval_on_selector("csplat-view", f"(view) => view.src = '{src}'")
        kind, report = told(tab)
        assert ("error", code, True) == (kind, report["code"], report["fatal"])
        assert re.search(words, page.inner_text("csplat-view [role=alert]"), re.DOTALL)
    tab.problems.clear()  # browsers report a status, and what a policy forbids


def test_the_script_is_written_once(tmp_path):
    out = tmp_path / "csplat-view.js"
    done = CliRunner().invoke(app, ["export-element", str(out)])
    assert 0 == done.exit_code, done.output
    assert out.read_bytes() == export_element()
    assert export_element().isascii()
    said = re.search(r"needs nothing beside it, (\d+) kB, (\d+) kB with gzip", GUIDE)
    assert [pytest.approx(int(kilobytes), rel=0.05) for kilobytes in said.groups()] == [
        len(data) / 1000 for data in (export_element(), gzip.compress(export_element()))
    ]
    again = CliRunner().invoke(app, ["export-element", str(out)])
    assert (1, True) == (again.exit_code, "--force replaces it" in again.stderr)
    wrong = CliRunner().invoke(app, ["export-element", "scene.csplat"])
    assert "did you mean `csplat export-element scene.js`" in wrong.stderr
