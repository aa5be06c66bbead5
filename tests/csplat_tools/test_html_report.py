# SPDX-License-Identifier: Apache-2.0
"""HTML reports: `csplat info --page` on one file, and the page about a training; both fetch nothing."""

import html
import json
import re
import sys

import numpy as np
import pytest
from captures import cameras, shell
from command_line import call, hide_renderer

from csplat import EncodeOptions, encode, write_ply
from csplat.ply import read_ply
from csplat_render.scene_frame import detail, sample_cloud, scene_frame
from csplat_tools.html_report import HardestPlaceSearch, attribute_figure
from csplat_tools.inspect.file_description import describe_file
from csplat_tools.views import comparison_cameras, display_cameras, find_view_set
from csplat_tools.views.view_sets import ViewSet

pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file and its scene."""
    folder, scene = tmp_path_factory.mktemp("files"), shell(8)
    write_ply(folder / "scene.ply", scene)
    (folder / "a & b.csplat").write_bytes(encode(scene, EncodeOptions(preset="small")))
    return folder / "a & b.csplat", folder / "scene.ply"


@pytest.fixture(scope="module")
def page(files):
    """Return the page of the file compared with its source."""
    path = files[0].with_name("page.html")
    call("info", files[0], "--page", path, "--source", files[1])
    return path


@pytest.mark.slow
def test_the_page_agrees_with_the_text_and_shows_source_and_file_without_external_references(files, page):
    raw, facts, cell = page.read_text(), describe_file(files[0].read_bytes()), r"</td><td[^>]*>[^<]+</td>"
    text = html.unescape(raw)
    assert "<h1>a & b.csplat: content</h1>" in text
    assert "a & b" not in raw  # names are escaped
    for name, one in facts.attributes.items():
        assert re.search(rf"<td[^>]*>{name}{cell}<td[^>]*>{one.size_bytes:,}</td>", text)
    for record in facts.declared_bounds.records:
        assert re.search(rf"{record.measure}{cell}<td>{record.max:.4g}</td><td>{record.rms:.4g}<", text)
    for name in facts.layers:
        assert re.search(rf"<td[^>]*>{name}{cell}", text)
    assert 4 == len(re.findall(r'<img src="data:image/webp;base64,', raw))
    compared = call("compare", files[1], files[0]).stdout
    assert re.search(r"^psnr +(\S+) dB", compared, re.MULTILINE)[1] == re.search(r"([\d.]+) dB: similarity", raw)[1]
    assert {"http://www.w3.org/2000/svg"} == set(re.findall(r"[a-z]+://[^\"'\s<)]+", raw))
    assert all(link.startswith("data:image/webp") for link in re.findall(r'(?:src|href)="([^"]*)"', raw))
    assert "default-src 'none'" in raw


@pytest.mark.slow
def test_a_file_without_splats_has_a_page_which_is_not_replaced_without_force(tmp_path, make_model):
    page, empty = tmp_path / "a.html", tmp_path / "empty.ply"
    page.write_text("mine")
    empty.with_suffix(".csplat").write_bytes(encode(make_model(0)))
    write_ply(empty, make_model(0))
    words = ("info", empty.with_suffix(".csplat"), "--source", empty)
    assert "--force replaces it" in call(*words, "--page", page, status=1).stderr
    assert "a.html exists" in call("train", tmp_path, tmp_path / "a.ply", "--page", page, status=1).stderr
    assert "mine" == page.read_text()
    call(*words, "--page", page, "--force")
    assert "0 splats" in page.read_text()
    call(*words, status=2)  # a source requires a page
    call(*words[:2], "--page", "-", status=2)


@pytest.mark.slow
def test_the_page_opens_in_a_browser(tab, page):
    tab.page.set_viewport_size({"width": 400, "height": 700})
    tab.page.goto(page.as_uri())
    assert "a & b.csplat: content" == tab.page.title()
    assert 0 == tab.page.evaluate("[...document.images].filter((one) => !one.naturalWidth).length")
    assert tab.page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


@pytest.mark.slow
def test_without_the_renderer_the_page_has_no_comparison(files, tmp_path, monkeypatch):
    line = hide_renderer(monkeypatch)
    monkeypatch.setitem(sys.modules, "PIL", None)
    call("info", files[0], "--page", tmp_path / "a.html")
    assert "Declared error bounds" in (tmp_path / "a.html").read_text()
    refused = call("info", files[0], "--page", tmp_path / "b.html", "--source", files[1], status=1)
    assert line == refused.stderr
    assert not (tmp_path / "b.html").exists()


def test_bars_are_proportional_to_bytes_and_the_hardest_place_is_where_the_error_is():
    text = attribute_figure({"means": 100, "sh0": 300, "sh1": 50})
    widths = np.array(re.findall(r'width="([\d.]+)" height="17"', text), float)
    np.testing.assert_allclose(widths / widths[0], [1.0, 3.0, 0.5], atol=1e-3)
    source, place = np.full((80, 120, 3), 0.5, np.float32), HardestPlaceSearch()
    badly = source.copy()
    badly[31:39, 70:80] = 1.0
    assert place.found() is None
    place.examine(0, source, source)
    assert 99.0 == place.found().psnr
    for number, seen in ((1, badly), (2, source + np.float32(0.05))):
        place.examine(number, source, seen)
    found = place.found()
    assert (1, (20, 30, 3), (20, 30, 3)) == (found.view, found.source.shape, found.decoded.shape)
    assert 80 * 3 == np.count_nonzero(found.decoded == 255)
    assert found.psnr == pytest.approx(10.0 * np.log10(600.0 / (80 * 0.25)), abs=0.01)
    frame = np.argwhere((found.where == 255).all(axis=2))
    assert (frame.min(axis=0) <= (32, 71)).all()
    assert (frame.max(axis=0) >= (37, 78)).all()


@pytest.mark.slow
def test_display_views_show_detail(sample_path):
    source, own = read_ply(sample_path), cameras(3)
    shown = display_cameras(source, find_view_set(source, count=0))
    assert 2 <= len(shown) <= 6
    cloud, nearest = sample_cloud(source, 20_000, np.random.default_rng(1)), 0.4 * scene_frame(source).extent
    best = max(detail(cloud, camera, nearest) for camera in comparison_cameras(source))
    assert all(detail(cloud, camera, nearest) > 0.6 * best for camera in shown)
    assert display_cameras(source, ViewSet("cameras.json", (0.0, 0.0, 0.0), (), (), own)) is own  # given by the user


def parts(page):
    """Return the headings and the captions of a page."""
    return re.findall("<h2>(.*?)</h2>", page), re.findall("<figcaption>(.*?)</figcaption>", page)


@pytest.mark.slow
def test_a_page_shows_a_training_and_its_file(file_runs):
    page, captions = file_runs.page.read_text(), ["image", "source", "before tuning", "file"]
    headings = ["Scores", "Renders", "Training", "Tuning", "Bytes by attribute", "Options"]
    assert (headings, captions * 2) == parts(page)
    for scores in file_runs.report["file"]["scores"].values():
        assert f"<td>{scores['psnr_mean']:.2f}</td>" in page
    assert 8 == page.count('src="data:image/')
    assert not re.search("(src|href)=.http", page)


@pytest.mark.slow
def test_a_page_of_a_training_without_a_file_agrees_with_compare(file_runs, tmp_path):
    compared, path = tmp_path / "compared.json", tmp_path / "page.html"
    file_runs.made("a.ply", "--resume", file_runs.checkpoint, "--page", path)
    expected = ["Scores", "Renders", "Training", "Options"], ["image", "trained scene"] * 2
    assert expected == parts(path.read_text())
    both = (file_runs.folder / name for name in ("a.ply", "a.csplat"))
    call("compare", *both, "--data", file_runs.data, "--report", compared)
    judged = json.loads(compared.read_text())["images"]
    for name, one in (("source", "a"), ("file", "b")):
        scores = {score: file_runs.report["file"]["scores"][name][score] for score in ("psnr", "psnr_mean", "ssim")}
        assert scores == pytest.approx({score: judged[one][score] for score in scores}, abs=1e-3)
