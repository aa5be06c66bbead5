"""The page of the viewer in headless Chromium: loading, messages, the camera in a person's hands, the first picture."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from csplat import EncodeOptions, decode, encode, read_ply
from csplat.decoder import read_header
from csplat_conformance.validator import validate

PAGE = "/tools/viewer/index.html"
POSE = "JSON.parse(JSON.stringify(csplatViewer.rig.pose))"


@pytest.fixture(scope="module")
def sample(request):
    """The shipped scene: axes are known, spherical harmonics of degree 3."""
    path = request.getfixturevalue("sample_path")
    return encode(read_ply(path), EncodeOptions(preset="fast", tile_splats=2000))


@pytest.fixture
def small(tab):
    """A page of few pixels: pictures are drawn on the CPU."""
    tab.page.set_viewport_size({"width": 400, "height": 300})
    return tab


def load(tab, site, data, query="", path="/scene.csplat"):
    site.add(path, data)
    tab.page.goto(site.url(f"{PAGE}?scene={path}{query}"))
    tab.page.evaluate("csplatViewer.ready")


def picture(page):
    """The settled picture, [H, W, 4] uint8, the top row first."""
    height, width = page.evaluate("[csplatViewer.stage.height, csplatViewer.stage.width]")
    pixels = page.evaluate("csplatViewer.engine.readPixels().then((pixels) => Array.from(pixels))")
    return np.array(pixels, np.uint8).reshape(height, width, 4)


def quiet(tab):
    """Wait until the camera has come to rest, and the picture with it."""
    tab.until("!csplatViewer.controls.frame && !csplatViewer.stage.moving")
    tab.page.evaluate("csplatViewer.engine.settled()")


def test_a_scene_arrives_by_ranges(small, site, sample):
    load(small, site, sample)
    statuses = site.statuses("/scene.csplat")
    assert {206} == set(statuses)
    assert len(statuses) >= 2
    page = small.page
    assert page.locator("#progress").is_hidden()
    assert page.locator("#error").is_hidden()
    assert "scene.csplat" == page.inner_text("#title")
    count = read_header(sample).splat_count
    assert f"{count:,} splats · {len(sample) / 1e6:.2f} MB" == page.inner_text("#summary")
    assert "scene.csplat – csplat viewer" == page.title()
    loaded = page.evaluate("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert {site.url("/")} == {re.match(r"http://[^/]+/|data:", one)[0] for one in loaded} - {"data:"}


def test_a_server_without_ranges_will_do(small, site, sample):
    site.ranges = False
    load(small, site, sample)
    assert {200} == set(site.statuses("/scene.csplat"))
    assert f"{read_header(sample).splat_count:,} splats" in small.page.inner_text("#summary")


def test_progress_is_shown_while_bytes_arrive(small, site, sample):
    site.bytes_per_second = 60_000
    site.add("/scene.csplat", sample)
    small.page.goto(site.url(f"{PAGE}?scene=/scene.csplat"))
    small.until("Number(document.getElementById('progress').getAttribute('aria-valuenow')) > 0")
    assert small.page.locator("#progress").is_visible()
    site.bytes_per_second = 0
    small.page.evaluate("csplatViewer.ready")
    assert small.page.locator("#progress").is_hidden()


def test_statistics_are_shown_on_demand(small, site, sample):
    load(small, site, sample)
    page = small.page
    assert page.locator("#statistics").is_hidden()
    page.keyboard.press("i")
    rows = dict(
        zip(
            page.locator("#statistics dt").all_inner_texts(),
            page.locator("#statistics dd").all_inner_texts(),
            strict=True,
        )
    )
    count = f"{read_header(sample).splat_count:,}"
    assert f"{count} of {count}" == rows["Splats drawn"]
    assert {"File", "Decoding", "Sorting", "Frame", "Graphics memory", "First picture", "Renderer"} <= set(rows)
    assert re.search(r"[1-9]", rows["Decoding"])
    assert "true" == page.get_attribute("#details", "aria-expanded")
    page.click("#details")
    assert page.locator("#statistics").is_hidden()


@pytest.mark.parametrize(("what", "code"), [("cut", "E_TRUNCATED"), ("flipped", "E_CRC"), ("text", "E_MAGIC")])
def test_a_broken_file_is_explained(small, site, sample, what, code):
    middle = 2 * len(sample) // 3
    data = {
        "cut": sample[:middle],
        "flipped": sample[:middle] + bytes([sample[middle] ^ 1]) + sample[middle + 1 :],
        "text": b"ply\nformat ascii 1.0\n" * 20,
    }[what]
    load(small, site, data, path="/scene.ply" if what == "text" else "/scene.csplat")
    page = small.page
    assert page.locator("#error").is_visible()
    assert code == page.get_attribute("#error", "data-code")
    facts = page.inner_text("#error-facts")
    assert re.match(rf"{code} at byte [\d,]+ \([A-Z]+-\d+\): .", facts)
    title = page.inner_text("#error-title")
    assert {"cut": "ends too early", "flipped": "is damaged", "text": "This is a PLY"}[what] in title
    assert code not in title
    page.keyboard.press("Escape")
    assert page.locator("#error").is_hidden()


def test_an_absent_file_is_explained(small, site):
    small.page.goto(site.url(f"{PAGE}?scene=/absent.csplat"))
    small.page.evaluate("csplatViewer.ready")
    assert "E_INPUT" == small.page.get_attribute("#error", "data-code")
    assert "404" in small.page.inner_text("#error-facts")
    small.problems.clear()  # a browser may report the status on its console, too


def test_a_browser_without_webgl_is_told(small, site, sample):
    small.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    load(small, site, sample)
    assert "E_WEBGL2" == small.page.get_attribute("#error", "data-code")
    assert "WebGL 2" in small.page.inner_text("#error-title")
    assert small.page.locator("#error-open").is_hidden()


DROP = """async ([text, name]) => {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([bytes], name));
  const over = new DragEvent('dragover', { dataTransfer, bubbles: true, cancelable: true });
  document.body.dispatchEvent(over);
  const shown = !document.getElementById('drop').hidden;
  document.body.dispatchEvent(new DragEvent('drop', { dataTransfer, bubbles: true, cancelable: true }));
  return [over.defaultPrevented, shown, document.getElementById('drop').hidden];
}"""


def test_a_file_can_be_dropped_and_replaced(small, site, sample):
    page = small.page
    count = f"{read_header(sample).splat_count:,}"
    shows = f"document.getElementById('summary').textContent.includes('{count} splats ·')"
    page.goto(site.url(PAGE))
    page.evaluate("csplatViewer.ready")
    assert page.locator("#welcome").is_visible()
    assert [True, True, True] == page.evaluate(DROP, [base64.b64encode(sample).decode(), "dropped.csplat"])
    small.until(shows)
    assert page.locator("#welcome").is_hidden()
    assert "dropped.csplat" == page.inner_text("#title")
    broken = base64.b64encode(sample[:500]).decode()
    page.evaluate(DROP, [broken, "broken.csplat"])
    page.wait_for_selector("#error:not([hidden])")
    assert "E_TRUNCATED" == page.get_attribute("#error", "data-code")
    page.set_input_files("#file", {"name": "chosen.csplat", "mimeType": "model/vnd.csplat", "buffer": sample})
    small.until(shows)
    assert "chosen.csplat" == page.inner_text("#title")
    assert page.locator("#error").is_hidden()


def test_mouse_and_keys_move_the_camera(small, site, sample):
    load(small, site, sample)
    page = small.page
    quiet(small)
    home = page.evaluate(POSE)

    def moved(act):
        before = page.evaluate(POSE)
        act()
        quiet(small)
        return before, page.evaluate(POSE)

    def drag(button):
        page.mouse.move(200, 150)
        page.mouse.down(button=button)
        page.mouse.move(240, 165, steps=4)
        page.mouse.up(button=button)

    before, after = moved(lambda: drag("left"))
    assert before["basis"] != after["basis"]
    np.testing.assert_allclose(pivot(before), pivot(after), atol=1e-9)  # it turns around the same point
    before, after = moved(lambda: drag("right"))
    assert before["basis"] == after["basis"]
    assert before["eye"] != after["eye"]
    page.mouse.move(200, 150)
    before, after = moved(lambda: page.mouse.wheel(0, -300))
    assert after["distance"] < 0.8 * before["distance"]
    for key, axis, sign in (("w", 2, 1), ("s", 2, -1), ("ArrowLeft", 0, -1), ("d", 0, 1), ("e", 1, -1), ("q", 1, 1)):
        before, after = moved(lambda key=key: page.keyboard.press(key, delay=80))
        step = np.array(after["basis"]) @ (np.array(after["eye"]) - before["eye"])
        assert sign * step[axis] > 0.0
        np.testing.assert_allclose(np.delete(step, axis), 0.0, atol=1e-9)
    before, after = moved(lambda: page.keyboard.press("Shift+ArrowRight", delay=80))
    assert before["basis"] != after["basis"]
    np.testing.assert_allclose(pivot(before), pivot(after), atol=1e-9)
    before, after = moved(lambda: page.keyboard.press("Minus", delay=80))
    assert after["distance"] > before["distance"]
    moved(lambda: page.keyboard.press("r"))
    assert home == page.evaluate(POSE)
    before, after = moved(lambda: page.mouse.dblclick(230, 170))
    np.testing.assert_allclose(before["eye"], after["eye"], atol=1e-9)  # the head turns to the point
    assert not np.allclose(pivot(before), pivot(after), atol=1e-3)


def pivot(pose):
    return np.array(pose["eye"]) + pose["distance"] * np.array(pose["basis"][2])


def test_fingers_move_the_camera(small, site, sample):
    load(small, site, sample)
    page = small.page
    quiet(small)
    session = page.context.new_cdp_session(page)

    def touch(kind, *points):
        fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    start = page.evaluate(POSE)
    touch("touchStart", (200, 150))
    touch("touchMove", (230, 150))
    touch("touchEnd")
    quiet(small)
    turned = page.evaluate(POSE)
    assert start["basis"] != turned["basis"]
    np.testing.assert_allclose(pivot(start), pivot(turned), atol=1e-9)
    touch("touchStart", (150, 150), (250, 150))
    touch("touchMove", (100, 150), (300, 150))
    touch("touchEnd")
    quiet(small)
    zoomed = page.evaluate(POSE)
    assert turned["basis"] == zoomed["basis"]
    assert 0.4 < zoomed["distance"] / turned["distance"] < 0.6
    touch("touchStart", (150, 150), (250, 150))
    touch("touchMove", (150, 190), (250, 190))
    touch("touchEnd")
    quiet(small)
    panned = page.evaluate(POSE)
    assert abs(panned["distance"] / zoomed["distance"] - 1.0) < 0.2
    assert np.array(panned["basis"][1]) @ (np.array(panned["eye"]) - zoomed["eye"]) < 0.0


def test_the_automatic_camera_sees_the_whole_object(small, site, sample):
    load(small, site, sample, "&size=200x160")
    shown = picture(small.page)[..., :3].max(axis=2) > 40
    assert 0.15 < shown.mean() < 0.9
    rows, columns = np.nonzero(shown)
    assert abs(rows.mean() / 160 - 0.5) < 0.15
    assert abs(columns.mean() / 200 - 0.5) < 0.1
    border = np.concatenate([shown[0], shown[-1], shown[:, 0], shown[:, -1]])
    assert border.mean() < 0.02


def test_outliers_do_not_move_the_automatic_camera(small, site, sample_path):
    model = read_ply(sample_path)
    means = model.means.copy()
    means[:5] = [[3000, 0, 0], [0, 5000, 0], [0, 0, -4000], [2000, 2000, 0], [-1000, 0, 9000]]
    load(small, site, encode(replace(model, means=means), EncodeOptions(preset="fast")), "&size=100x80")
    assert (picture(small.page)[..., :3].max(axis=2) > 40).mean() > 0.15


CAMERA = {"K": [[90.0, 0.0, 40.0], [0.0, 90.0, 30.0], [0.0, 0.0, 1.0]], "W": 80, "H": 60, "near": 0.1}


def look_at(eye, up=(0.0, -1.0, 0.0)):
    forward = -np.array(eye) / np.linalg.norm(eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    viewmat = np.eye(4)
    viewmat[:3, :3] = right, np.cross(forward, right), forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return {**CAMERA, "viewmat": viewmat.tolist()}


def engine_viewmat(page):
    return page.evaluate("csplatViewer.rig.camera(80, 60).viewmat")


def test_the_file_says_where_to_stand(small, site, make_model):
    cameras = [
        {**look_at([2.0, -1.0, -6.0]), "image": "a/first.jpg"},
        {**look_at([-2.0, -1.0, -6.0]), "image": "b.jpg"},
    ]
    data = encode(make_model(500, 0, cameras=cameras))
    load(small, site, data)
    page = small.page
    assert list(np.ravel(cameras[0]["viewmat"])) == engine_viewmat(page)
    assert page.locator("#upright").is_hidden()  # the cameras know which way is up
    page.click("#next")
    quiet(small)
    assert list(np.ravel(cameras[1]["viewmat"])) == engine_viewmat(page)
    assert "Camera 2 of 2: b.jpg" == page.inner_text("#toast")
    page.keyboard.press("r")
    quiet(small)
    assert list(np.ravel(cameras[0]["viewmat"])) == engine_viewmat(page)


def test_the_metadata_may_say_it_too(small, site, make_model):
    view = look_at([0.0, -3.0, -5.0])
    metadata = {"view": view, "title": "A <b>cloud</b>", "licence": "CC0"}
    load(small, site, encode(make_model(500, 0, cameras=[look_at([1.0, 1.0, 5.0])], metadata=metadata)))
    assert list(np.ravel(view["viewmat"])) == engine_viewmat(small.page)
    assert "A <b>cloud</b>" == small.page.inner_text("#title")
    small.page.keyboard.press("i")
    assert "CC0" in small.page.locator("#statistics dd").all_inner_texts()


def test_a_camera_of_the_address_goes_before_all_others(small, site, make_model):
    wanted = [look_at([0.0, 0.0, -4.0]), look_at([3.0, 0.0, -4.0])]
    site.add("/cameras.json", json.dumps(wanted).encode())
    data = encode(make_model(500, 0, cameras=[look_at([1.0, 1.0, 5.0])]))
    load(small, site, data, "&camera=/cameras.json&view=1&size=80x60")
    page = small.page
    assert list(np.ravel(wanted[1]["viewmat"])) == engine_viewmat(page)
    camera = page.evaluate("csplatViewer.rig.camera(80, 60)")
    assert [90, 90, 40, 30, 0.1] == [camera[name] for name in ("fx", "fy", "cx", "cy", "near")]
    assert (60, 80, 4) == picture(page).shape


@pytest.mark.parametrize("camera", ["nonsense.json", "[{}]", '[{"K":1}]', "[1"])
def test_a_wrong_camera_costs_a_line_not_the_scene(small, site, make_model, camera):
    load(small, site, encode(make_model(100, 0)), f"&camera={camera}")
    assert "The camera cannot be used" in small.page.inner_text("#toast")
    assert "100 splats" in small.page.inner_text("#summary")
    small.problems.clear()  # that of a file that is not found


def test_a_scene_of_unknown_axes_can_be_turned(small, site, make_model):
    load(small, site, encode(make_model(300, 0)), "&size=40x30")
    page = small.page
    assert [0, -1, 0] == page.evaluate("csplatViewer.rig.pose.up")
    seen = []
    for _ in range(6):
        page.click("#upright")
        quiet(small)
        seen.append(tuple(page.evaluate("csplatViewer.rig.pose.up")))
    assert (0, 0, 1) == seen[0]
    assert 6 == len(set(seen))
    assert (0, -1, 0) == seen[-1]


def test_axes_of_the_file_are_honoured(small, site, make_model):
    load(small, site, encode(make_model(300, 0, coordinate_system="RFU")))
    page = small.page
    assert page.locator("#upright").is_hidden()
    pose = page.evaluate(POSE)
    assert [0, 0, 1] == pose["up"]
    assert pose["basis"][1][2] < -0.5  # down in the picture is −z
    assert pose["basis"][2][1] > 0.5  # and the camera looks along +y, forward
    load(small, site, encode(make_model(300, 0, coordinate_system="RFU")), "&axes=RUB")
    assert [0, 1, 0] == page.evaluate("csplatViewer.rig.pose.up")


def test_the_background_and_a_bare_page(small, site, make_model):
    load(small, site, encode(make_model(1, 0, opacities=np.zeros(1, np.float32))), "&background=ff8000&ui=0&size=20x10")
    page = small.page
    assert [255, 128, 0] == picture(page)[0, 0, :3].tolist()
    for name in ("#tools", "#info", "#progress"):
        assert page.locator(name).is_hidden()


def test_a_scene_stands_in_front_of_what_it_was_trained_on(small, site, make_model):
    training = {"background": [1, 1, 0.4], "near": 0.2}
    clear = encode(make_model(1, 0, opacities=np.zeros(1, np.float32), metadata={"training": training}))
    behind = []
    load(small, site, clear, "&size=20x10")
    for _ in range(5):
        behind.append(picture(small.page)[0, 0, :3].tolist())
        small.page.keyboard.press("b")
    assert [[255, 255, 102], [0, 0, 0], [128, 128, 128], [255, 255, 255], [255, 255, 102]] == behind
    load(small, site, clear, "&size=20x10&background=0000ff")
    assert [0, 0, 255] == picture(small.page)[0, 0, :3].tolist()


def test_nonsense_in_the_address_is_reported(small, site, make_model):
    load(small, site, encode(make_model(10, 0)), "&size=big&axes=RRR")
    said = small.page.inner_text("#toast")
    assert "size is “big”" in said
    assert "axes is “RRR”" in said


def test_turning_upright_can_be_kept(small, site, make_model, tmp_path):
    load(small, site, encode(make_model(60, 1, metadata={"title": "Lying down"})), "&size=40x30")
    page = small.page
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.click("#upright")
    assert [0, 0, 1] == page.evaluate("csplatViewer.rig.home.up")
    assert "z is up." == page.inner_text("#keep-title")
    command = "csplat encode scene.ply scene.csplat --up z"
    assert command == page.inner_text("#keep-command")
    page.click("#keep-copy")
    small.until("document.getElementById('toast').textContent === 'Copied'")
    assert command == page.evaluate("navigator.clipboard.readText()")
    with page.expect_download() as download:
        page.click("#keep-download")
    assert "scene.csplat" == download.value.suggested_filename
    kept = tmp_path / "kept.csplat"
    download.value.save_as(kept)
    assert {"title": "Lying down", "up": [0, 0, 1]} == decode(kept.read_bytes()).metadata
    assert validate(kept.read_bytes()).conforms
    page.keyboard.press("Escape")
    assert page.locator("#keep").is_hidden()

    load(small, site, kept.read_bytes(), "&size=40x30")
    assert [0, 0, 1] == page.evaluate("csplatViewer.rig.home.up")
    assert page.locator("#upright").is_hidden()
    page.click("#help")  # what it says may be wrong, and a phone has no keys
    page.click("#help-upright")
    assert page.locator("#help-dialog").is_hidden()
    assert page.locator("#upright").is_visible()
    for _ in range(5):
        page.keyboard.press("u")
    assert "z is up, as the scene says" == page.inner_text("#toast")
    assert page.locator("#keep").is_hidden()


def test_an_empty_scene_is_a_scene(small, site, make_model):
    load(small, site, encode(make_model(0, 0)))
    assert "0 splats" in small.page.inner_text("#summary")
    assert small.page.locator("#error").is_hidden()


def test_everything_has_a_name_and_can_be_reached_by_keys(small, site, make_model):
    load(small, site, encode(make_model(100, 0)))
    page = small.page
    names = page.evaluate(
        "[...document.querySelectorAll('button, canvas, input, dialog')].map((one) =>"
        " one.getAttribute('aria-label') ?? document.getElementById(one.getAttribute('aria-labelledby'))?.textContent"
        " ?? one.textContent.trim())"
    )
    assert all(names)
    page.keyboard.press("h")
    assert page.locator("#help-dialog").is_visible()
    assert "help-close" == page.evaluate("document.activeElement.id")
    before = page.evaluate(POSE)
    page.keyboard.press("w", delay=60)  # keys in a dialog are the dialog's
    assert before == page.evaluate(POSE)
    page.keyboard.press("Escape")
    assert page.locator("#help-dialog").is_hidden()
    reached = set()
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id"))
    assert {"canvas", "reset", "details", "open", "help"} <= reached


def test_a_person_who_wants_no_motion_gets_none(small, site, sample):
    small.page.emulate_media(reduced_motion="reduce")
    load(small, site, sample)
    page = small.page
    page.evaluate("csplatViewer.rig.orbit(0.5, 0.2)")
    home = page.evaluate("JSON.parse(JSON.stringify(csplatViewer.rig.home))")
    page.keyboard.press("r")
    assert home == page.evaluate(POSE)  # at once


def test_a_phone_shows_all_tools(tab, site, make_model):
    tab.page.set_viewport_size({"width": 360, "height": 640})
    load(tab, site, encode(make_model(100, 0)))
    for name in ("#tools", "#info"):
        box = tab.page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 360
    sizes = [one.bounding_box() for one in tab.page.locator("#tools button:visible").all()]
    assert all(box["width"] >= 40 and box["height"] >= 40 for box in sizes)
