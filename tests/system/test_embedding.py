# SPDX-License-Identifier: Apache-2.0
"""The unchanged samples of codec/EMBEDDING.md, splat_math.mjs, and `<csplat-view>` in other pages."""

import base64
import gzip
import json
import re
import shlex
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked import covariances
from chromium import absent, read_pixels
from command_line import call, invoke

from csplat import EncodeOptions, decode, encode
from csplat.ply import read_ply, write_ply
from csplat.spherical_harmonics import evaluate_sh
from csplat_render.camera_files import load_cameras
from csplat_tools.present.viewer_page import export_element

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "codec" / "EMBEDDING.md").read_text("utf-8")
EXAMPLES = ROOT / "tools" / "examples"
FAST = EncodeOptions(preset="fast")

RUN = """
import { decode } from 'csplat-decoder';
import { colour, covariances, toThree } from './splat_math.mjs';
import { stream } from './stream.mjs';

const [url, directions] = JSON.parse(process.argv[2]);
const scene = await decode(await (await fetch(url)).arrayBuffer(), { workers: 2 });
const [tiles, bands] = [[], []];
await stream(url, {
  addTile: (first, part) => tiles.push([first, part.count, Array.from(part.means)]),
  addBand: (first, layer, sh) => bands.push([first, layer, sh.length]),
});
console.log(JSON.stringify({
  workers: scene.workers,
  covariances: Array.from(covariances(scene)),
  colours: directions.map((direction, i) => colour(scene, i, direction)),
  axes: ['', 'RDF', 'RUB', 'RFU'].map(toThree),
  tiles,
  bands,
}));
"""


def samples(language, text=TEXT):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def model(request):
    """The first 800 splats of the sample with SH band 4, after a round trip."""
    part = read_ply(request.getfixturevalue("sample_path")).select(slice(0, 800))
    band = np.random.default_rng(4).normal(0.0, 0.05, (len(part), 9, 3)).astype(np.float32)
    return decode(encode(replace(part, shN=np.concatenate([part.shN, band], axis=1)), FAST))


def copy_package(folder, source):
    manifest = json.loads((source / "package.json").read_text("utf-8"))
    target = folder / "node_modules" / manifest["name"]
    target.mkdir(parents=True)
    for pattern in ["package.json", *manifest["files"]]:
        for path in source.glob(pattern):
            (shutil.copytree if path.is_dir() else shutil.copy)(path, target / path.name)


def copy_decoder(folder):
    copy_package(folder, ROOT / "codec" / "js")


def install_decoder(folder):
    """Pack and install the decoder by the page's lines, without files that are not shipped."""
    npm = shutil.which("npm") or absent("the package of the decoder needs npm, which is not installed")
    (folder / "codec").symlink_to(ROOT / "codec")
    (lines,) = (block for block in samples("sh") if "npm pack" in block)
    for line in lines.splitlines():
        name, *words = shlex.split(line)
        assert "npm" == name
        subprocess.run([npm, *words, "--silent", "--offline", "--no-audit", "--no-fund"], check=True, cwd=folder)


@pytest.mark.slow
@pytest.mark.parametrize("provide", [
    copy_decoder,
    pytest.param(install_decoder, marks=pytest.mark.engines),  # npm decides which files are shipped, in seconds
])  # fmt: skip
def test_the_samples_in_javascript(provide, site, tmp_path, model):
    node = shutil.which("node") or absent("the samples in JavaScript need Node.js, which is not installed")
    for text in samples("js"):
        (tmp_path / re.match(r"// (\w+\.mjs)\n", text)[1]).write_text(text, "utf-8")
    provide(tmp_path)
    shutil.copy(EXAMPLES / "splat_math.mjs", tmp_path)
    (tmp_path / "run.mjs").write_text(RUN)
    data = encode(model, replace(FAST, tile_splats=200))
    scene, count = decode(data), len(model)
    ways = np.random.default_rng(5).standard_normal((20, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    words = json.dumps([site.add("/scene.csplat", data), ways.tolist()])
    done = subprocess.run([node, "run.mjs", words], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert 0 == done.returncode, done.stderr
    assert {200, 206} == set(site.statuses("/scene.csplat"))
    given = json.loads(done.stdout)
    assert 2 == given["workers"]
    wanted = covariances(scene.quats, scene.scales)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    largest = np.exp(2.0 * scene.scales.astype(np.float64)).max(axis=1, keepdims=True)
    np.testing.assert_allclose(np.reshape(given["covariances"], (count, 6)) / largest, wanted / largest, atol=1e-6)
    coefficients = np.concatenate([scene.sh0[:20, None], scene.shN[:20]], axis=1).astype(np.float64)
    wanted = np.maximum(0.0, 0.5 + np.einsum("nk,nkc->nc", evaluate_sh(4, ways), coefficients))
    np.testing.assert_allclose(given["colours"], wanted, atol=1e-12)
    flipped, same, turned = np.diag([1, -1, -1]), np.eye(3), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    np.testing.assert_array_equal([flipped, flipped, same, turned], given["axes"])

    assert len(given["tiles"]) > 1
    for first, size, means in given["tiles"]:
        np.testing.assert_array_equal(scene.means[first : first + size].ravel(), np.array(means, np.float32))
    sizes = {first: size for first, size, _ in given["tiles"]}
    assert count == sum(sizes.values())
    assert {1, 2, 3, 4} == {layer for _, layer, _ in given["bands"]}
    assert all(size == 3 * (2 * layer + 1) * sizes[first] for first, layer, size in given["bands"])


GIVEN = """
const drawn = [], [authorization, signal] = ['Bearer x', new AbortController().signal];
const newSignedUrl = () => url, draw = ({ count }) => drawn.push(count);
"""
# What comes of the samples of a package's page.
PACKAGES = {
    "js": "[scene.count, band.count, packed.count, drawn, tiles, nodes.length, signed.header.splatCount]",
    "js-encoder": "[file.length, edited.length, splats.opacities.length]",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PACKAGES)
def test_the_samples_of_the_packages_run_in_order(name, site, tmp_path, model):
    node = shutil.which("node") or absent("the samples in JavaScript need Node.js, which is not installed")
    copy_package(tmp_path, ROOT / "codec" / name)
    (tmp_path / "scene.csplat").write_bytes(encode(model, replace(FAST, tile_splats=400)))
    write_ply(tmp_path / "scene.ply", model)
    file = "scene.csplat" if name == "js" else "scene.ply"
    url = site.add(f"/{file}", (tmp_path / file).read_bytes())
    page = "".join(samples("js", (ROOT / "codec" / name / "README.md").read_text("utf-8")))
    program = f"const url = {url!r};\n{GIVEN}{page}console.log(JSON.stringify({PACKAGES[name]}));\nprocess.exit();\n"
    (tmp_path / "page.mjs").write_text(program, "utf-8")
    done = subprocess.run([node, "page.mjs"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert 0 == done.returncode, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    if name == "js":
        half = len(model) // 2
        assert [len(model), half, half, [half] * 4, [0, 1], 1, len(model)] == told
    else:
        assert len(model) == told.pop()
        assert min(told) > 5 * len(model)


@pytest.mark.slow
def test_the_samples_in_python(tmp_path, model, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.csplat").write_bytes(encode(model, replace(FAST, tile_splats=80)))
    said = []
    for program in samples("python"):
        exec(program, {"__name__": "__main__"})  # noqa: S102  # the guide's own lines
        said.append(capsys.readouterr().out)
    whole, part, cut = said
    assert f"{len(model)} float32 4 {model.metadata.coordinate_system}\n" == whole
    first, *tiles, last = part.splitlines()
    assert first == f"{len(model)} {model.metadata.coordinate_system} {model.metadata.licence}"
    assert [str(place) for place in range(10)] == [line.split()[0] for line in tiles if not line.startswith(" ")]
    assert last.endswith(f" of {(tmp_path / 'scene.csplat').stat().st_size}")
    assert 0 < len(decode(tmp_path / "part.csplat")) < len(model)
    assert f"{len(model)} [(0, 0.0)]\n" == cut


def test_the_engine_without_a_page(tab, site, model):
    (sample,) = (text for text in samples("js") if text.startswith("// show.mjs"))
    site.add("/show.mjs", sample.encode())
    site.add("/scene.csplat", encode(model, FAST))
    page = b"<!doctype html><title>x</title><link rel=icon href=data:,><canvas width=160 height=120></canvas>"
    tab.page.goto(site.add("/page.html", page))
    show = "(await show(document.querySelector('canvas'), '/scene.csplat')).readPixels()"
    pixels = f"import('/show.mjs').then(async ({{ show }}) => {show})"
    shown = read_pixels(tab.page, pixels, 160, 120)[..., :3].max(axis=2) > 40
    assert 0.1 < shown.mean() < 0.9


def test_the_guide_contains_lines_of_the_examples():
    for heading, name in {
        "three.js": "three",
        "Spark": "spark",
        "PlayCanvas": "playcanvas",
        "Babylon.js": "babylon",
    }.items():
        _, _, example = (EXAMPLES / f"{name}.mjs").read_text("utf-8").partition("\n")  # after the licence
        shown = re.search(rf"^### {heading}\n.*?^```(?:js|javascript)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)[1]
        assert shown == example or name != "three"
        lines = {line.strip() for line in example.splitlines()}
        assert [] == [line for line in shown.splitlines() if line.strip() not in lines]
    scripts = json.loads((EXAMPLES / "bundlers" / "package.json").read_text("utf-8"))["scripts"]
    assert f"```sh\nnpx {scripts['playcanvas'].replace('dist/playcanvas/', '')}\n```\n" in TEXT


POLICY = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src blob:; connect-src 'self'; img-src data:"
ONE_FILE = '<script src="../scripts/csplat-view.js"></script>'
MODULE = '<script type="module" src="/tools/viewer/element.mjs"></script>'

# Events of elements, without progress: [[id, type, detail], ...].
RECORD = """
globalThis.told = [];
for (const type of ['load', 'error'])
  document.addEventListener(type, ({ target, detail }) => {
    if (target.localName === 'csplat-view') told.push([target.id, type, detail]);
  }, { capture: true });
"""


@pytest.fixture
def blog(tab, site, make_model):
    """Return a function that opens a page with a text; scenes are /scene.csplat (60 splats) and /other.csplat (90)."""
    for name, count in (("scene", 60), ("other", 90)):
        site.add(f"/{name}.csplat", encode(make_model(count, 0, scales=np.full((count, 3), -2, "f")), FAST))
    site.add("/scripts/csplat-view.js", export_element())
    site.add("/blog/style.css", b"csplat-view { width: 160px; height: 120px }")
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


def assert_loads(tab, count, identity=""):
    kind, detail = told(tab, identity)
    assert ("load", count) == (kind, detail.get("splatCount")), detail


def shown(page, element="csplat-view"):
    """Return a mask of the pixels that are not black in the settled picture, [120, 160]."""
    pixels = f"document.querySelector('{element}').engine.readPixels()"
    return read_pixels(page, pixels, 160, 120)[..., :3].max(axis=2) > 20


def test_scenes_are_shown_replaced_and_removed(tab, blog):
    page = blog('<csplat-view alt="A garden"></csplat-view>')
    page.evaluate("globalThis.view = document.querySelector('csplat-view')")
    page.evaluate("globalThis.progress = 0; view.addEventListener('progress', () => progress++)")
    page.evaluate("view.src = '../scene.csplat'")
    assert_loads(tab, 60)
    assert page.evaluate("progress") > 0
    assert 0.02 < shown(page).mean() < 0.9
    assert page.locator("csplat-view canvas").get_attribute("aria-label").startswith("A garden. Arrow keys")
    assert 0 == page.evaluate("performance.getEntriesByType('resource').filter(({ name }) => /mjs/.test(name)).length")

    page.evaluate("view.setAttribute('background', '#ff0000')")
    assert [255, 0, 0] == page.evaluate("view.engine.readPixels().then((pixels) => Array.from(pixels.slice(0, 3)))")

    page.evaluate("globalThis.old = view.shadowRoot.querySelector('canvas').getContext('webgl2')")
    page.evaluate("view.src = '/other.csplat'")
    assert_loads(tab, 90)
    assert page.evaluate("old.isContextLost()")
    assert 1 == len(page.workers)

    page.evaluate("document.body.append(document.createElement('main')); document.querySelector('main').append(view)")
    assert page.evaluate("Promise.resolve().then(() => view.engine !== null)")  # it was moved, not removed
    page.evaluate("old = view.shadowRoot.querySelector('canvas').getContext('webgl2'); view.remove()")
    assert page.evaluate("view.engine === null && old.isContextLost()")
    tab.page.wait_for_timeout(50)
    assert [] == page.workers


def test_the_wheel_scrolls_the_page_until_a_scene_is_clicked_and_scenes_load_when_they_are_near(tab, site, blog):
    near, far = '<csplat-view id=a src="/scene.csplat">', '<csplat-view id=b src="/other.csplat">'
    page = blog(f"{near}</csplat-view>{90 * '<br>x'}{far}</csplat-view>", MODULE, policy="")
    assert_loads(tab, 60, "a")
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
    assert_loads(tab, 90, "b")
    tab.until("b.shadowRoot.querySelector('canvas').width === 160")  # slow machines draw fewer pixels for a moment
    assert (2, True) == (len(page.workers), shown(page, "#b").any())


def test_errors_are_shown_as_text(tab, site, blog):
    site.add("/cut.csplat", site._files["/scene.csplat"][:-20])
    types = f"{POLICY}; require-trusted-types-for 'script'; trusted-types"
    blog('<csplat-view src="/scene.csplat"></csplat-view>', policy=f"{types} csplat")
    assert_loads(tab, 60)
    for src, code, words, policy in (
        ("/cut.csplat", "E_TRUNCATED", "is incomplete", POLICY),
        ("/none.csplat", "E_INPUT", "could not be read.*404", POLICY),
        ("/scene.csplat", "E_WORKER", "could not start.*worker-src", POLICY.replace("blob:", "'none'")),
        ("/scene.csplat", "E_WORKER", "could not start.*trusted-types", f"{types} 'none'"),
        ("/scene.csplat", "E_WEBGL2", "no WebGL 2", POLICY),
    ):
        if code == "E_WEBGL2":
            tab.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        page = blog("<csplat-view></csplat-view>", policy=policy)
        page.eval_on_selector("csplat-view", f"(view) => view.src = '{src}'")
        kind, report = told(tab)
        assert ("error", code, True) == (kind, report["code"], report["fatal"])
        assert re.search(words, page.inner_text("csplat-view [role=alert]"), re.DOTALL)
    tab.problems.clear()  # browsers report a status, and what a policy forbids


def test_properties_count_that_were_set_before_the_script_had_run(tab, blog):
    before = """
    <csplat-view src="/none.csplat"></csplat-view><script>
    globalThis.view = document.querySelector('csplat-view');
    Object.assign(view, { src: '/scene.csplat', alt: 'A garden', background: 'ff0000', up: [0, -1, 0] });
    const viewmat = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 9, 0, 0, 0, 1];
    view.camera = { K: [[100, 0, 80], [0, 100, 60], [0, 0, 1]], viewmat, W: 160, H: 120 };
    view.request = { headers: { 'x-key': 'k' } };
    </script>"""
    page = blog(before, policy="")
    assert_loads(tab, 60)
    assert page.locator("csplat-view canvas").get_attribute("aria-label").startswith("A garden.")
    assert [255, 0, 0] == page.evaluate("view.engine.readPixels().then((pixels) => Array.from(pixels.slice(0, 3)))")
    assert [[], "0,-1,0", "k"] == page.evaluate("[Object.keys(view), view.up, view.request.headers['x-key']]")
    page.evaluate("view.src = '/other.csplat'")
    assert_loads(tab, 90)
    page.evaluate("view.background = null; view.alt = undefined")
    assert page.evaluate("!view.hasAttribute('background') && view.background === '' && !view.hasAttribute('alt')")


def test_setting_an_address_again_retries_after_an_error_and_a_script_may_run_twice(tab, site, blog):
    page = blog('<csplat-view src="/late.csplat"></csplat-view>' + ONE_FILE)
    page.evaluate("globalThis.view = document.querySelector('csplat-view')")
    for again in ("view.src = view.src", "view.setAttribute('src', view.getAttribute('src'))"):
        expected = {"code": "E_INPUT", "reason": "refused", "status": 404, "fatal": True}
        assert expected.items() <= told(tab)[1].items()
        assert "no file at this address" in page.inner_text("csplat-view [role=alert]")
        if "setAttribute" in again:
            site.add("/late.csplat", site._files["/scene.csplat"])
        page.evaluate(again)
    assert_loads(tab, 60)
    assert page.evaluate("view.shadowRoot.querySelector('#error').hidden")
    tab.problems.clear()  # the browser reports each 404


def test_a_page_decides_on_the_requests_of_an_element(tab, site, blog):
    keys = []

    def signed(headers, number):
        keys.append(headers.get("X-Key"))
        return (403, {}, b"") if number > 1 else None

    site.scripts["/signed.csplat"] = signed
    site.add("/signed.csplat", site._files["/scene.csplat"])
    page = blog("<csplat-view></csplat-view>")
    page.evaluate(
        """{ globalThis.view = document.querySelector('csplat-view'); globalThis.asked = [];
        view.request = { headers: { 'x-key': 'k' } }; view.crossOrigin = 'use-credentials'; view.timeoutMs = 5000;
        view.fetch = (url, init) => (asked.push([new URL(url).pathname, init.credentials]), fetch(url, init));
        view.renew = async ({ status }) => (asked.push(status), '/scene.csplat');
        view.src = '/signed.csplat'; }"""
    )
    assert_loads(tab, 60)
    assert (["/signed.csplat", "include"], "k") == (page.evaluate("asked[0]"), keys[0])
    page.evaluate("void (view.src = '/signed.csplat?2')")
    assert_loads(tab, 60)
    assert [403, ["/scene.csplat", "include"]] == page.evaluate("asked.slice(asked.indexOf(403)).slice(0, 2)")
    assert "use-credentials" == page.get_attribute("csplat-view", "crossorigin")
    tab.problems.clear()  # the browser reports the status


def test_a_file_that_is_replaced_while_it_is_read_is_opened_anew(tab, site, blog, make_model):
    old, new = (encode(make_model(count, 3), replace(FAST, tile_splats=2000)) for count in (6000, 6500))
    assert len(old) > 2**17

    def swap(_headers, _number):
        site.add("/changing.csplat", new)  # this answer is of the old one

    site.add("/changing.csplat", old)
    site.scripts["/changing.csplat"] = swap
    page = blog('<csplat-view src="/changing.csplat"></csplat-view>')
    kind, report = told(tab)
    assert ("error", "replaced", False) == (kind, report["reason"], report["fatal"])
    assert "the file was replaced on the server" in report["message"]
    assert_loads(tab, 6500)
    assert page.evaluate("document.querySelector('csplat-view').shadowRoot.querySelector('#error').hidden")


def test_a_blob_may_be_revoked_at_once(tab, blog):
    page = blog('<br style="line-height:300vh"><csplat-view id="view"></csplat-view>', policy="")
    page.evaluate(
        """fetch('/scene.csplat').then((response) => response.blob()).then((blob) => {
          view.src = URL.createObjectURL(blob);
          URL.revokeObjectURL(view.src);
          view.scrollIntoView();
        })"""
    )
    assert_loads(tab, 60, "view")


def test_a_page_from_disk_says_what_to_do(tab, tmp_path):
    (tmp_path / "csplat-view.js").write_bytes(export_element())
    (tmp_path / "page.html").write_text(
        f"<!doctype html><script>{RECORD}</script><script src=csplat-view.js></script>"
        '<csplat-view src="scene.csplat"></csplat-view>'
    )
    tab.page.goto((tmp_path / "page.html").as_uri())
    report = told(tab)[1]
    assert ("E_INPUT", "local", True) == (report["code"], report["reason"], report["fatal"])
    assert "csplat export-html" in tab.page.inner_text("csplat-view [role=alert]")
    tab.problems.clear()  # the browser reports the access


@pytest.mark.slow
def test_the_script_is_written_once(tmp_path):
    out, script = tmp_path / "csplat-view.js", export_element()
    call("export-element", out)
    assert script.isascii()
    assert script == out.read_bytes()
    said = re.search(r"self-contained script \((\d+) kB, (\d+) kB gzipped\)", TEXT)
    sizes = [len(data) / 1000 for data in (script, gzip.compress(script))]
    assert sizes == [pytest.approx(int(kilobytes), rel=0.05) for kilobytes in said.groups()]
    assert "--force replaces it" in call("export-element", out, status=1).stderr
    wrong = invoke("export-element", "scene.csplat")
    assert "did you mean `csplat export-element scene.js`" in wrong.stderr


# CSS of an element, that of its container, and the expected size in a window of 390 × 844; a window of 1280 × 844.
SIZES = {
    "": (390, 260, 1280, 853), "height: 70vh": (390, 591, 1280, 591), "height: 100px": (390, 100, 1280, 100),
    "width: 50%": (195, 130, 640, 427), "width: 300px; height: 100px": (300, 100, 300, 100),
    "aspect-ratio: 2": (390, 195, 1280, 640), "max-height: 100px": (390, 100, 1280, 100),
    "min-height: 900px": (390, 900, 1280, 900), "margin: 20px": (350, 233, 1240, 827),
    "position: absolute; inset: 0": (390, 844, 1280, 844), "position: absolute": (300, 200, 300, 200),
    "display: inline-block": (300, 200, 300, 200), "display: inline-block; height: 90px": (300, 90, 300, 90),
}  # fmt: skip


def test_css_gives_the_size_that_it_says(tab, blog):
    tab.page.set_viewport_size({"width": 390, "height": 844})
    page = blog("<main><csplat-view></csplat-view></main>", policy="")
    page.evaluate("document.head.querySelector('[rel=stylesheet]').remove(), document.body.style.margin = 0")
    found = {}
    for css in SIZES:
        found[css] = ()
        for width in (390, 1280):
            page.set_viewport_size({"width": width, "height": 844})
            found[css] += tuple(
                page.evaluate(
                    """(css) => {
                      const view = document.querySelector('csplat-view');
                      view.style.cssText = css;
                      const canvas = view.shadowRoot.querySelector('canvas');
                      if (canvas.clientHeight !== view.offsetHeight) throw new Error('the canvas does not fill it');
                      return [view.offsetWidth, view.offsetHeight];
                    }""",
                    css,
                )
            )
    assert SIZES == found


# Makes `image`, with pixels that are not premultiplied, of a Blob or a promise of it.
IMAGE = """async (made) => {
  const blob = await made;
  const bitmap = await createImageBitmap(blob);
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d', { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  globalThis.image = context.getImageData(0, 0, bitmap.width, bitmap.height);
  return [image.width, image.height, blob.type];
}"""


def image_of(page, blob):
    """Return an image and its type, [H, W, 4] uint8, of an expression for its Blob or a promise of it."""
    width, height, kind = page.evaluate(f"({IMAGE})({blob})")
    return read_pixels(page, "image.data", width, height), kind


def test_an_element_wider_than_the_gpu_can_draw_has_fewer_pixels(blog):
    scene = '<csplat-view src="/scene.csplat" backend="webgl2" style="width: 40000px; height: 2000px"></csplat-view>'
    page = blog(scene, policy="")
    page.wait_for_function("document.querySelector('csplat-view').shadowRoot.querySelector('canvas').width > 4000")
    image, _ = image_of(page, "document.querySelector('csplat-view').toBlob()")
    height, width, _ = image.shape
    assert width in (4096, 8192, 16384, 32768)
    assert round(width / 20) == height
    assert (image[..., :3].max(axis=2) > 60).mean() > 0.001


def test_a_page_shows_through_a_transparent_scene_and_images_of_it(tab, blog):
    scene = '<csplat-view src="/scene.csplat" background="transparent" backend="{}"></csplat-view>'
    for backend in ("webgl2", "webgpu-tiles", "webgpu-quads"):
        page = blog(scene.format(backend), policy="")
        assert_loads(tab, 60)
        page.evaluate(
            "globalThis.view = document.querySelector('csplat-view'), document.body.style.background = '#0f0'"
        )
        pixels = read_pixels(page, "view.engine.readPixels()", 160, 120).astype(int)
        assert (pixels[..., :3] <= pixels[..., 3:]).all()  # premultiplied
        assert pixels[0, 0, 3] == 0
        assert (pixels[..., 3] > 200).any()
        png = base64.b64encode(page.screenshot(clip={"x": 9, "y": 9, "width": 1, "height": 1})).decode()
        shot, _ = image_of(page, f"fetch('data:image/png;base64,{png}').then((answer) => answer.blob())")
        assert [0, 255, 0, 255] == shot[0, 0].tolist()
        image, kind = image_of(page, "view.toBlob()")
        assert ("image/png", (120, 160, 4)) == (kind, image.shape)
        alpha = image[..., 3:].astype(int)
        assert np.abs(alpha - pixels[..., 3:]).max() <= 1
        solid = image[..., :3] * (alpha / 255.0)
        assert np.abs(solid - pixels[..., :3]).max() <= 2
        # A soft edge has the colour of the splat, not that of black behind it.
        soft = (alpha[..., 0] > 40) & (alpha[..., 0] < 120)
        assert image[soft][:, :3].max(axis=1).mean() > 0.7 * image[alpha[..., 0] > 200][:, :3].max(axis=1).mean()
        page.evaluate("view.background = 'ff0000'")
        assert [255, 0, 0, 255] == page.evaluate("view.engine.readPixels().then((pixels) => [...pixels.slice(0, 4)])")


def test_images_have_any_size_and_camera_and_the_canvas_stays_as_it_is(tab, site, blog):
    page = blog('<csplat-view src="/scene.csplat"></csplat-view>', policy="")
    assert_loads(tab, 60)
    page.evaluate("globalThis.view = document.querySelector('csplat-view')")
    (sample,) = (text for text in samples("js") if text.startswith("// poster.mjs"))
    site.add("/blog/poster.mjs", sample.encode())
    with page.expect_download() as saved:
        page.evaluate("import('/blog/poster.mjs').then(({ savePoster }) => savePoster(view))")
    assert b"WEBP" == Path(saved.value.path()).read_bytes()[8:12]
    before = read_pixels(page, "view.engine.readPixels()", 160, 120)
    large, kind = image_of(page, "view.toBlob({ width: 480, type: 'image/webp', quality: 1 })")
    assert ("image/webp", (360, 480, 4)) == (kind, large.shape)
    small = large.reshape(120, 3, 160, 3, 4).mean(axis=(1, 3))
    assert np.abs(small - before).mean() < 3
    page.evaluate("view.engine.setSize(40, 30)")  # as on a slow machine
    np.testing.assert_array_equal(before, image_of(page, "view.toBlob()")[0])
    page.evaluate("view.engine.setSize(160, 120)")
    camera = "{ ...view.camera, viewmat: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 9], [0, 0, 0, 1]] }"
    other, _ = image_of(page, f"view.toBlob({{ camera: {camera} }})")
    assert (other != before).any()
    np.testing.assert_array_equal(before, read_pixels(page, "view.engine.readPixels()", 160, 120))
    moved, _ = image_of(page, f"(view.camera = {camera}, view.toBlob())")
    np.testing.assert_array_equal(other, moved)
    refusals = {
        "{ width: 0 }": "E_INPUT", "{ height: 1.5 }": "E_INPUT", "{ width: NaN }": "E_INPUT",
        "{ camera: {} }": "E_INPUT", "{ type: 'image/none' }": "E_INPUT",
        "{ width: 1e6, height: 1 }": "E_LIMIT", "{ width: 65536, height: 65536 }": "E_LIMIT",
    }  # fmt: skip
    code = "(given) => view.toBlob(given).then(() => 'made', ({ name, code }) => name === 'EngineError' && code)"
    found = {given: page.evaluate(f"({code})({given})") for given in refusals}
    assert refusals == found
    late = "const made = view.toBlob().catch(({ code }) => code); view.src = '/other.csplat'; return made;"
    assert "E_SUPERSEDED" == page.evaluate(f"(() => {{ {late} }})()")
    assert_loads(tab, 90)
    assert "E_INPUT" == page.evaluate("document.createElement('csplat-view').toBlob().catch(({ code }) => code)")


POSTER = (
    "data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg' width='3' height='2'>"
    "<rect width='3' height='2' fill='red'/></svg>"
)


def test_a_poster_is_shown_until_there_is_a_picture_and_if_there_is_none(tab, site, blog):
    page = blog("<csplat-view alt='A garden'></csplat-view>")
    page.evaluate(
        """{ globalThis.view = document.querySelector('csplat-view');
        const isHidden = () => view.shadowRoot.querySelector('#poster').hidden;
        view.addEventListener('firstpicture', ({ detail }) => told.push(['', 'firstpicture', isHidden(), detail])); }"""
    )
    size = page.evaluate("[view.offsetWidth, view.offsetHeight]")
    page.evaluate("(poster) => { view.poster = poster; }", POSTER)
    poster = page.locator("csplat-view #poster")
    assert poster.is_visible()
    assert size == page.evaluate("[view.offsetWidth, view.offsetHeight]")
    page.evaluate("view.src = '/scene.csplat'")
    kind, is_hidden, detail = told(tab)
    assert ("firstpicture", True, True) == (kind, is_hidden, detail["firstPictureMs"] > 0)
    assert poster.is_hidden()
    assert_loads(tab, 60)
    site.add("/broken.csplat", b"no scene")
    page.evaluate("view.src = '/broken.csplat'")
    assert "E_MAGIC" == told(tab)[1]["code"]
    assert poster.is_visible()
    assert "A garden" == poster.get_attribute("alt")
    assert page.locator("csplat-view canvas").is_hidden()
    page.evaluate("view.poster = '/none.svg'")
    poster.wait_for(state="hidden")
    tab.problems.clear()  # the browser reports the status


def test_the_camera_can_be_kept_restored_and_followed(tab, blog, tmp_path):
    page = blog('<csplat-view src="/scene.csplat"></csplat-view>', policy="")
    assert_loads(tab, 60)
    page.evaluate(
        """{ globalThis.view = document.querySelector('csplat-view'); globalThis.moves = []; globalThis.times = [];
        view.addEventListener('camerachange', ({ detail }) => (moves.push(detail), times.push(performance.now()))); }"""
    )
    kept = page.evaluate("view.camera")
    (tmp_path / "cameras.json").write_text(json.dumps([kept]))
    (camera,) = load_cameras(tmp_path / "cameras.json")
    assert (160, 120) == (camera.W, camera.H)
    np.testing.assert_array_equal(camera.viewmat, kept["viewmat"])
    page.mouse.move(80, 60)
    page.mouse.down()
    page.mouse.move(110, 70, steps=6)
    page.mouse.up()
    tab.until("moves.length > 0 && JSON.stringify(moves.at(-1)) === JSON.stringify(view.camera)")
    assert kept["viewmat"] != page.evaluate("view.camera.viewmat")
    assert page.evaluate("times.every((time, i) => i === 0 || time - times[i - 1] > 90)")
    assert kept == page.evaluate("(camera) => { moves.length = 0; view.camera = camera; return view.camera; }", kept)
    page.wait_for_timeout(150)
    assert [] == page.evaluate("moves")  # only what the user does fires events
    with page.expect_console_message(lambda message: "The camera cannot be used" in message.text):
        page.evaluate("view.camera = { K: 1 }")
    assert kept == page.evaluate("view.camera")


def test_controls_can_be_limited_and_turned_off(tab, blog):
    page = blog('<csplat-view src="/scene.csplat" alt="A garden" controls="none"></csplat-view>', policy="")
    assert_loads(tab, 60)
    page.evaluate("globalThis.view = document.querySelector('csplat-view')")
    canvas = page.locator("csplat-view canvas")
    before = page.evaluate("view.camera")
    page.mouse.move(80, 60)
    page.mouse.down()
    page.mouse.move(120, 80, steps=3)
    page.mouse.up()
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowUp", delay=100)
    assert before == page.evaluate("view.camera")
    assert ["img", "A garden", None] == [canvas.get_attribute(name) for name in ("role", "aria-label", "tabindex")]

    page.evaluate("view.controls = 'orbit min-distance=2 max-distance=4 max-polar=90'")
    assert canvas.get_attribute("aria-label").startswith("A garden. Arrow keys turn it")
    page.emulate_media(reduced_motion="reduce")
    page.keyboard.press("Tab")
    assert "2px" == page.eval_on_selector("csplat-view canvas", "(one) => getComputedStyle(one).outlineWidth")
    distances = []
    for key in ("Minus", "Equal"):
        page.keyboard.down(key)
        page.wait_for_timeout(1500)
        page.keyboard.up(key)
        page.wait_for_timeout(100)
        distances.append(page.evaluate("Math.hypot(...view.camera.viewmat.slice(0, 3).map((row) => row[3]))"))
    assert abs(distances[0] - distances[1] - 2) < 0.01 * 2 + 1  # the pivot is near the origin, not in it
    page.keyboard.down("ArrowUp")
    page.wait_for_timeout(1500)
    page.keyboard.up("ArrowUp")
    page.wait_for_timeout(100)
    forward = page.evaluate("view.camera.viewmat[2]")
    assert forward[1] >= -1e-6  # y is down: the camera is not below the pivot

    # The limits of the azimuth stay with the view at loading, not with a camera of the program.
    page.evaluate("globalThis.first = view.camera; view.controls = 'orbit min-azimuth=-20 max-azimuth=10'")
    for key, angle in (("ArrowRight", -20), ("ArrowLeft", 10)):
        page.evaluate("view.camera = view.camera")
        page.keyboard.down(key)
        page.wait_for_timeout(1500)
        page.keyboard.up(key)
        page.wait_for_timeout(100)
        (x, _, z, _), (ahead_x, _, ahead_z, _) = page.evaluate("[view.camera, first].map(({ viewmat }) => viewmat[2])")
        assert abs(np.degrees(np.arctan2(ahead_x * z - ahead_z * x, x * ahead_x + z * ahead_z)) - angle) < 0.01
