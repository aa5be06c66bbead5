# SPDX-License-Identifier: Apache-2.0
"""The page of a scene as a PLY, as SPZ and as .csplat of equal bytes."""

import re

import numpy as np
import pytest
from command_line import call

import csplat
from csplat import EncodeOptions, encode
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import save_cameras

ITEM = re.compile(r"<li><b>(\S+): ([\d.]+)&nbsp;dB</b><br>([\d.]+)&nbsp;kB, ([\d,]+)&nbsp;splats</li>")
IMAGE = re.compile(
    r'<img src="data:image/(?:webp|png);base64,[^"]{1000,}" alt="(\S+), [\d.]+ dB" width="1280" height="960"'
)
ENDS = "[...document.querySelectorAll('[role=slider]')].map((one) => Number(one.getAttribute('aria-valuenow')))"


@pytest.fixture(scope="module")
def page(tmp_path_factory, sample_path):
    """A page that the command makes of a part of the sample, and the path of the .csplat."""
    folder = tmp_path_factory.mktemp("equal")
    model = csplat.read(sample_path).select(slice(0, None, 12))
    csplat.write_ply(folder / "scene.ply", model)
    (folder / "scene.csplat").write_bytes(encode(model, EncodeOptions(preset="fast")))
    K, centre = intrinsics(64, 48, 60.0), tuple(np.median(model.means, axis=0))
    cameras = [
        look_at((x, -1.0, z), centre, (0.0, -1.0, 0.0), K, 64, 48) for x, z in ((0.0, -4.0), (4.0, 0.0), (0.0, 4.0))
    ]
    save_cameras(folder / "cameras.json", cameras)
    words = ("--cameras", folder / "cameras.json", "--pictures", folder / "page.html")
    call("compare", folder / "scene.ply", folder / "scene.csplat", *words)
    return folder / "page.html"


@pytest.mark.slow
def test_files_of_equal_bytes_are_shown_with_their_errors(page):
    text = page.read_text("utf-8")
    assert ["PLY", "SPZ", ".csplat"] == IMAGE.findall(text)
    found = {
        title: (float(psnr), float(size), int(splats.replace(",", "")))
        for title, psnr, size, splats in ITEM.findall(text)
    }
    csplat_psnr, csplat_size, count = found[".csplat"]
    assert count == len(csplat.read(page.with_name("scene.ply")))
    for title, more in (("PLY", 1), ("SPZ", 3)):
        psnr, size, splats = found[title]
        assert 0.95 * csplat_size < size <= csplat_size + 0.1
        assert 10.0 < psnr < csplat_psnr
        assert more * 40 < splats < count


@pytest.mark.slow
def test_another_file_than_a_csplat_is_refused(page):
    words = (page.with_name("scene.ply"), page.with_name("scene.ply"), "--pictures", page.with_name("other.html"))
    assert "requires a .csplat as B" in call("compare", *words, status=1).stderr
    assert not page.with_name("other.html").exists()


@pytest.mark.browser
def test_borders_follow_keys_and_fingers(page, browser):
    tab = browser.new_page(viewport={"width": 390, "height": 700}, has_touch=True)
    problems = []
    tab.on("pageerror", lambda error: problems.append(str(error)))
    tab.goto(page.as_uri())
    assert [33, 67] == tab.evaluate(ENDS)
    tab.keyboard.press("Tab")
    tab.keyboard.press("End")  # the other border goes along
    assert [100, 100] == tab.evaluate(ENDS)
    tab.keyboard.press("Home")
    assert [0, 100] == tab.evaluate(ENDS)
    box = tab.locator("#stage").bounding_box()
    tab.touchscreen.tap(box["x"] + 0.8 * box["width"], box["y"] + 20)
    assert [0, 80] == tab.evaluate(ENDS)
    assert "inset(0px 0px 0px 80%)" == tab.evaluate("getComputedStyle(document.querySelectorAll('img')[2]).clipPath")
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert [] == problems
    tab.close()
