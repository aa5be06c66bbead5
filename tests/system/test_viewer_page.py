# SPDX-License-Identifier: Apache-2.0
"""The page of the viewer in headless Chromium: loading, messages, control of the camera, the first picture."""

import base64
import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from chromium import ViewerPage

from csplat import EncodeOptions, decode, encode, read_header
from csplat.ply import read_ply
from csplat_conformance.validator import validate
from csplat_render import camera
from csplat_render.camera_files import load_cameras
from csplat_tools.level_builder import FittedLevelBuilder

pytestmark = pytest.mark.slow
FAST = EncodeOptions(preset="fast", tile_splats=500)


@pytest.fixture(scope="module")
def model(sample_path):
    """A part of the shipped scene with known axes and spherical harmonics of degree 3, enlarged."""
    part = read_ply(sample_path).select(slice(0, None, 6))
    return replace(part, scales=part.scales + np.float32(0.8))


@pytest.fixture(scope="module")
def sample(model):
    return encode(model, FAST)


@pytest.fixture(scope="module")
def light(model):
    """A file that is quickly drawn: a moving camera requires many pictures."""
    part = model.select(slice(0, None, 10))
    return encode(replace(part, scales=part.scales + np.float32(0.8)), FAST)


def test_a_scene_arrives_by_ranges_with_its_facts(viewer, sample_path):
    model = read_ply(sample_path)
    data = encode(model, EncodeOptions(preset="fast", tile_splats=2000))  # more than a first request brings
    viewer.site.bytes_per_second = 400_000
    path = viewer.begin(data)
    viewer.until("Number(document.getElementById('progress').getAttribute('aria-valuenow')) > 0")
    assert not viewer.hides("#progress")
    viewer.site.bytes_per_second = 0
    viewer.page.evaluate("shown")
    statuses = viewer.site.statuses(path)
    assert {206} == set(statuses)
    assert len(statuses) >= 2
    assert viewer.hides("#progress", "#error")
    assert "scene.csplat" == viewer.text("#title")
    assert f"{len(model):,} splats · {len(data) / 1e6:.2f} MB" == viewer.text("#summary")
    assert "scene.csplat – csplat viewer" == viewer.page.title()
    loaded = viewer.page.evaluate("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert {viewer.site.url("/")} == {re.match(r"http://[^/]+/|data:", one)[0] for one in loaded} - {"data:"}


def test_a_server_without_ranges_suffices_and_a_scene_may_be_empty(viewer, make_model):
    viewer.site.ranges = False
    assert {200} == set(viewer.site.statuses(viewer.show(encode(make_model(0, 0)))))
    assert "0 splats" in viewer.text("#summary")
    assert viewer.error() is None


def test_statistics_are_shown_on_demand(viewer, model, sample):
    viewer.show(sample)
    assert viewer.hides("#statistics")
    viewer.page.keyboard.press("i")
    rows = dict(
        zip(*(viewer.page.locator(f"#statistics {kind}").all_inner_texts() for kind in ("dt", "dd")), strict=True)
    )
    assert f"{len(model):,} of {len(model):,}" == rows["Splats drawn"]
    assert {"File", "Sorting", "Frame", "Graphics memory", "First picture", "Renderer"} <= set(rows)
    assert re.search(r"[1-9]", rows["Decoding"])
    viewer.page.click("#details")
    assert viewer.hides("#statistics")


def test_a_broken_or_absent_file_is_explained(viewer, sample):
    middle = 2 * len(sample) // 3
    cases = {
        "E_TRUNCATED": ("is incomplete", "scene.csplat", sample[:middle]),
        "E_CRC": ("is damaged", "scene.csplat", sample[:middle] + bytes([sample[middle] ^ 1]) + sample[middle + 1 :]),
        "E_MAGIC": ("This is a PLY", "scene.ply", b"ply\nformat ascii 1.0\n" * 20),
    }
    for code, (words, name, data) in cases.items():
        viewer.show(data, name)
        assert code == viewer.error()
        assert re.match(rf"{code} at byte [\d,]+ \([A-Z]+-\d+\): .", viewer.text("#error-facts"))
        assert words in viewer.text("#error-title")
        viewer.page.keyboard.press("Escape")
        assert viewer.error() is None
    viewer.begin(None, "absent.csplat")
    viewer.page.evaluate("shown")
    assert "E_INPUT" == viewer.error()
    assert "404" in viewer.text("#error-facts")
    viewer.tab.problems.clear()  # a browser may report the status on its console, too


def test_a_damaged_part_is_reported_next_to_the_scene(viewer, model):
    data = bytearray(encode(model, FAST, levels=FittedLevelBuilder(leaf_splats=400, root_splats=100)))
    layer = read_header(bytes(data)).tiles[0].layers[0]
    data[layer.offset + layer.size // 2] ^= 1
    viewer.show(bytes(data))
    viewer.page.wait_for_selector("#error:not([hidden])")
    assert "E_CRC" == viewer.error()
    viewer.page.set_viewport_size({"width": 800, "height": 600})
    assert "CANVAS" == viewer.page.evaluate("document.elementFromPoint(innerWidth / 2, innerHeight / 2).tagName")
    assert f"{len(model):,} splats" in viewer.text("#summary")


def test_a_browser_without_webgl_shows_an_error(tab, site, sample):
    tab.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    viewer = ViewerPage(tab, site)
    site.add("/scene.csplat", sample)
    viewer.load("?scene=/scene.csplat")
    assert "E_WEBGL2" == viewer.error()
    assert "WebGL 2" in viewer.text("#error-title")
    assert viewer.hides("#error-open")


DROP = """async ([text, name]) => {
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))], name));
  const [over, drop] = ['dragover', 'drop'].map(
    (type) => new DragEvent(type, { dataTransfer, bubbles: true, cancelable: true }));
  const { hidden } = (document.body.dispatchEvent(over), document.getElementById('drop'));
  document.body.dispatchEvent(drop);
  return [over.defaultPrevented, !hidden, document.getElementById('drop').hidden];
}"""


def test_a_page_without_a_scene_shows_an_error_and_accepts_files(tab, site, model, sample):
    viewer = ViewerPage(tab, site)
    viewer.load("?size=big&axes=RRR&camera=[{}]")
    complaints = viewer.text("#toast")
    for words in ("size is “big”", "axes is “RRR”", "The camera cannot be used"):
        assert words in complaints
    assert not viewer.hides("#welcome")
    shows = f"document.getElementById('summary').textContent.includes('{len(model):,} splats ·')"
    assert [True, True, True] == tab.page.evaluate(DROP, [base64.b64encode(sample).decode(), "dropped.csplat"])
    viewer.until(shows)
    assert viewer.hides("#welcome")
    assert "dropped.csplat" == viewer.text("#title")
    tab.page.evaluate(DROP, [base64.b64encode(sample[:500]).decode(), "broken.csplat"])
    tab.page.wait_for_selector("#error:not([hidden])")
    assert "E_TRUNCATED" == viewer.error()
    tab.page.set_input_files("#file", {"name": "chosen.csplat", "mimeType": "model/vnd.csplat", "buffer": sample})
    viewer.until(shows)
    assert "chosen.csplat" == viewer.text("#title")
    assert viewer.error() is None


def pivot(pose):
    return np.array(pose["eye"]) + pose["distance"] * np.array(pose["basis"][2])


def test_mouse_and_keys_move_the_camera(viewer, light):
    viewer.show(light)
    viewer.settle()
    page, home = viewer.page, viewer.pose

    def drag(button):
        page.mouse.move(120, 90)
        page.mouse.down(button=button)
        page.mouse.move(150, 100, steps=2)
        page.mouse.up(button=button)

    for act in (partial(drag, "left"), partial(page.keyboard.press, "Shift+ArrowRight", delay=30)):
        before, after = viewer.moved(act)
        assert before["basis"] != after["basis"]
        np.testing.assert_allclose(pivot(before), pivot(after), atol=1e-9)  # it turns around the same point
    before, after = viewer.moved(lambda: drag("right"))
    assert before["basis"] == after["basis"]
    assert before["eye"] != after["eye"]
    page.mouse.move(120, 90)
    before, after = viewer.moved(lambda: page.mouse.wheel(0, -300))
    assert after["distance"] < 0.8 * before["distance"]
    for key, axis, sign in (("w", 2, 1), ("ArrowLeft", 0, -1), ("e", 1, -1)):
        before, after = viewer.moved(partial(page.keyboard.press, key, delay=30))
        step = np.array(after["basis"]) @ (np.array(after["eye"]) - before["eye"])
        assert sign * step[axis] > 0.0
        np.testing.assert_allclose(np.delete(step, axis), 0.0, atol=1e-9)
    before, after = viewer.moved(lambda: page.keyboard.press("Minus", delay=30))
    assert after["distance"] > before["distance"]
    viewer.moved(lambda: page.keyboard.press("r"))
    assert home == viewer.pose
    before, after = viewer.moved(lambda: page.mouse.dblclick(135, 95))
    np.testing.assert_allclose(before["eye"], after["eye"], atol=1e-9)  # the head turns to the point
    assert not np.allclose(pivot(before), pivot(after), atol=1e-3)
    shown = page.text_content("#point").removeprefix("Point ").split(",")
    np.testing.assert_allclose(np.array(shown, float), pivot(after), rtol=1e-3)
    viewer.moved(lambda: page.keyboard.press("r"))
    page.emulate_media(reduced_motion="reduce")
    page.evaluate("csplatViewer.rig.orbit(0.5, 0.2)")
    page.keyboard.press("r")
    assert viewer.home == viewer.pose  # at once: the user prefers no motion


def test_fingers_move_the_camera(viewer, light):
    viewer.show(light)
    viewer.settle()
    session = viewer.page.context.new_cdp_session(viewer.page)

    def touch(before, after):
        for kind, points in (("touchStart", before), ("touchMove", after), ("touchEnd", ())):
            fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    start, turned = viewer.moved(lambda: touch([(120, 90)], [(150, 90)]))
    assert start["basis"] != turned["basis"]
    np.testing.assert_allclose(pivot(start), pivot(turned), atol=1e-9)
    _, zoomed = viewer.moved(lambda: touch([(90, 90), (150, 90)], [(60, 90), (180, 90)]))
    assert turned["basis"] == zoomed["basis"]
    assert 0.4 < zoomed["distance"] / turned["distance"] < 0.6
    _, panned = viewer.moved(lambda: touch([(90, 90), (150, 90)], [(90, 110), (150, 110)]))
    assert abs(panned["distance"] / zoomed["distance"] - 1.0) < 0.2
    assert np.array(panned["basis"][1]) @ (np.array(panned["eye"]) - zoomed["eye"]) < 0.0


def test_the_automatic_camera_sees_the_object_whatever_outliers_do(viewer, model):
    means = model.means.copy()
    means[:5] = [[3000, 0, 0], [0, 5000, 0], [0, 0, -4000], [2000, 2000, 0], [-1000, 0, 9000]]
    viewer.show(encode(replace(model, means=means), FAST))
    assert 0.15 < (viewer.picture()[..., :3].max(axis=2) > 40).mean() < 0.9


def test_the_camera_does_not_move_while_a_scene_loads(viewer, sample_path):
    data = encode(read_ply(sample_path), EncodeOptions(preset="fast", tile_splats=1000))
    viewer.site.bytes_left = 100_000  # more than the first request
    assert viewer.site.bytes_left < len(data)
    viewer.begin(data)
    viewer.until("csplatViewer.engine?.bounds?.coarse")
    first = viewer.viewmat
    viewer.site.bytes_left = math.inf
    viewer.page.evaluate("shown")
    assert viewer.page.evaluate("!csplatViewer.engine.bounds.coarse")
    assert first == viewer.viewmat


def look_at(eye):
    K = [[90.0, 0.0, 40.0], [0.0, 90.0, 30.0], [0.0, 0.0, 1.0]]
    viewmat = camera.look_at(eye, (0, 0, 0), (0, -1, 0), K, 80, 60).viewmat.tolist()
    return {"K": K, "W": 80, "H": 60, "near": 0.1, "viewmat": viewmat}


def test_the_file_gives_the_first_view(viewer, make_model):
    images = {"a/first.jpg": 2.0, "b.jpg": -2.0}
    cameras = [{**look_at([x, -1.0, -6.0]), "image": name} for name, x in images.items()]
    viewer.show(encode(make_model(100, 0, cameras=cameras)))
    assert list(np.ravel(cameras[0]["viewmat"])) == viewer.viewmat
    assert viewer.hides("#upright")  # the cameras know which way is up
    viewer.page.click("#next")
    viewer.settle()
    assert list(np.ravel(cameras[1]["viewmat"])) == viewer.viewmat
    assert "Camera 2 of 2: b.jpg" == viewer.text("#toast")
    viewer.page.keyboard.press("r")
    viewer.settle()
    assert list(np.ravel(cameras[0]["viewmat"])) == viewer.viewmat

    view = look_at([0.0, -3.0, -5.0])  # the view of the metadata: it has precedence over the cameras
    metadata = {"view": view, "title": "A <b>cloud</b>", "licence": "CC0"}
    viewer.show(encode(make_model(100, 0, cameras=cameras, entries=metadata)))
    assert list(np.ravel(view["viewmat"])) == viewer.viewmat
    assert "A <b>cloud</b>" == viewer.text("#title")
    viewer.page.keyboard.press("i")
    assert "CC0" in viewer.page.locator("#statistics dd").all_inner_texts()


def test_the_address_has_precedence_over_the_file(tab, site, make_model):
    views = [look_at([0.0, 0.0, -4.0]), look_at([3.0, 0.0, -4.0])]
    site.add("/cameras.json", json.dumps(views).encode())
    in_file = {"cameras": [look_at([1.0, 1.0, 5.0])], "entries": {"training": {"background": [1, 1, 0.4]}}}
    site.add("/a%20scene.csplat", encode(make_model(1, 0, opacities=np.zeros(1, np.float32), **in_file)))
    viewer = ViewerPage(tab, site)
    query = "?scene=/a%2520scene.csplat&camera=/cameras.json&view=1&axes=RUB&size=80x60&background=ff8000&ui=0"
    viewer.load(query)
    assert list(np.ravel(views[1]["viewmat"])) == viewer.viewmat
    camera = tab.page.evaluate("csplatViewer.rig.camera(80, 60)")
    assert [90, 90, 40, 30, 0.1] == [camera[name] for name in ("fx", "fy", "cx", "cy", "near")]
    picture = viewer.picture()
    assert (60, 80, 4) == picture.shape
    assert [255, 128, 0] == picture[0, 0, :3].tolist()
    assert [0, 1, 0] == viewer.pose["up"]
    assert viewer.hides("#tools", "#info", "#progress")
    assert tab.page.title().startswith("a scene.csplat")


def test_backgrounds_begin_with_the_background_of_training(viewer, make_model):
    training = {"background": [1, 1, 0.4], "near": 0.2}
    viewer.show(encode(make_model(1, 0, opacities=np.zeros(1, np.float32), entries={"training": training})))
    behind = []
    for _ in range(5):
        behind.append(viewer.picture()[0, 0, :3].tolist())
        viewer.page.keyboard.press("b")
    assert [[255, 255, 102], [0, 0, 0], [128, 128, 128], [255, 255, 255], [255, 255, 102]] == behind


def downloaded(page, selector):
    """Click; return the name and the bytes of the file that the page saves."""
    with page.expect_download() as download:
        page.click(selector)
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def test_turning_upright_can_be_kept(viewer, make_model):
    viewer.show(encode(make_model(60, 1, entries={"title": "Lying down"})))
    page = viewer.page
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.click("#upright")
    assert [0, 0, 1] == viewer.home["up"]
    assert "z is up." == viewer.text("#keep-title")
    command = "csplat encode scene.ply scene.csplat --up z"
    assert command == viewer.text("#keep-command")
    page.click("#keep-copy")
    viewer.until("document.getElementById('toast').textContent === 'Copied'")
    assert command == page.evaluate("navigator.clipboard.readText()")
    name, kept = downloaded(page, "#keep-download")
    assert "scene.csplat" == name
    assert {"title": "Lying down", "up": [0, 0, 1]} == decode(kept).metadata.entries
    assert validate(kept).conforms
    page.keyboard.press("Escape")
    assert viewer.hides("#keep")

    viewer.show(kept)
    assert [0, 0, 1] == viewer.home["up"]
    assert viewer.hides("#upright")
    page.click("#help")  # its answer may be wrong, and a phone has no keys
    page.click("#help-upright")
    assert viewer.hides("#help-dialog")
    assert not viewer.hides("#upright")
    for _ in range(5):
        page.keyboard.press("u")
    assert "z is up, as in the file" == viewer.text("#toast")
    assert viewer.hides("#keep")


def test_the_current_camera_can_be_kept_as_the_first_view(viewer, make_model, tmp_path):
    viewer.show(encode(make_model(60, 1)))
    page = viewer.page
    page.keyboard.press("ArrowLeft", delay=30)
    viewer.settle()
    page.keyboard.press("v")
    assert "csplat encode scene.ply scene.csplat --cameras view.json" == viewer.text("#keep-command")
    name, text = downloaded(page, "#keep-camera")
    assert viewer.text("#keep p:has(#keep-download)").startswith("Download scene.csplat with it: all else stays.")
    file_name, kept = downloaded(page, "#keep-download")
    assert ["view.json", "scene.csplat"] == [name, file_name]
    view = decode(kept).metadata.entries["view"]
    assert [{key: value for key, value in view.items() if key != "from"}] == json.loads(text)
    assert "author" == view["from"]
    assert validate(kept).conforms
    before = viewer.viewmat
    viewer.show(kept)
    assert np.allclose(before, viewer.viewmat, atol=1e-6)
    (tmp_path / name).write_bytes(text)
    assert np.allclose(view["viewmat"], load_cameras(tmp_path / name)[0].viewmat)


def test_all_controls_have_a_name_and_can_be_reached_by_keys(viewer, make_model):
    viewer.show(encode(make_model(100, 0)))
    page = viewer.page
    name = (
        "one.getAttribute('aria-label') ?? document.getElementById(one.getAttribute('aria-labelledby'))?.textContent"
        " ?? one.textContent.trim()"
    )
    assert all(page.evaluate(f"[...document.querySelectorAll('button, canvas, input, dialog')].map((one) => {name})"))
    page.keyboard.press("h")
    assert not viewer.hides("#help-dialog")
    assert "help-close" == page.evaluate("document.activeElement.id")
    before = viewer.pose
    page.keyboard.press("w", delay=30)  # keys in a dialog are the dialog's
    assert before == viewer.pose
    page.keyboard.press("Escape")
    assert viewer.hides("#help-dialog")
    reached = set()
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id"))
    assert {"canvas", "reset", "details", "open", "help"} <= reached


def test_the_page_measures_itself(viewer, make_model):
    viewer.show(encode(make_model(100, 0)), "balls.csplat")
    page = viewer.page
    page.keyboard.press("m")
    page.wait_for_selector("#measured", timeout=120_000)
    assert "100 splats" in viewer.text("#measured-what")
    backends = ["webgl2", "webgpu-tiles", "webgpu-quads"]
    assert backends == page.locator("#measured-table td:first-child").all_inner_texts()
    name, data = downloaded(page, "#measured-save")
    report = json.loads(data)
    assert "balls-frames.json" == name
    assert [100, 240, 180, []] == [report[name] for name in ("splats", "width", "height", "missing")]
    assert backends == [result["backend"] for result in report["results"]]
    for result in report["results"]:
        assert 0 < min(result["viewMs"]) <= result["frameMs"] <= max(result["viewMs"])
        assert min(result["loadMs"], result["sceneBytes"]) > 0
    page.keyboard.press("Escape")
    assert viewer.hides("#measured")


def test_a_phone_shows_all_tools(viewer, make_model):
    page = viewer.page
    page.set_viewport_size({"width": 360, "height": 640})
    viewer.show(encode(make_model(100, 0)))
    for name in ("#tools", "#info"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    sizes = [one.bounding_box() for one in page.locator("#tools button:visible").all()]
    assert all(box["width"] >= 40 and box["height"] >= 40 for box in sizes)
