import json
import re
from pathlib import Path

import numpy as np
import pytest
from checked import cloud
from chromium import ViewerPage
from command_line import call

from csplat import decode, encode
from csplat_tools.present.viewer_page import export_page
from csplat_tools.present.viewer_server import page_parameters
from csplat_tools.scene_files import MetadataOverrides


@pytest.fixture(scope="module")
def sample():
    """A file of 500 splats."""
    rng = np.random.default_rng(0)
    return encode(cloud(rng.standard_normal((500, 3)), 0.3, sh0=rng.standard_normal((500, 3)).astype(np.float32)))


def export(*words, status=0):
    return call("export-html", *words, status=status)


@pytest.mark.slow
def test_the_page_opens_without_a_network_and_equals_the_served_one(viewer, tab, sample, make_model, tmp_path):
    (tmp_path / "scene.csplat").write_bytes(sample)
    export(tmp_path / "scene.csplat", tmp_path / "page.html")
    viewer.load()  # afresh: other tests have turned its camera
    viewer.show(sample)
    served = viewer.picture()
    assert served[..., :3].max() > 100

    exported, page, requests = ViewerPage(tab, viewer.site), tab.page, []
    page.on("request", lambda request: requests.append(request.url))
    page.context.set_offline(True)
    try:
        exported.visit((tmp_path / "page.html").as_uri())
    finally:
        page.context.set_offline(False)
    np.testing.assert_array_equal(served, exported.picture())
    assert exported.error() is None
    assert "scene.csplat" == exported.text("#title")
    schemes = [re.match(r"\w+", url)[0] for url in requests]
    assert ["blob", "file"] == sorted(schemes)  # the page, and its worker

    (tmp_path / "other.csplat").write_bytes(encode(make_model(70, 0)))
    page.set_input_files("#file", tmp_path / "other.csplat")
    exported.until("document.getElementById('summary').textContent.startsWith('70 splats')")
    assert "other.csplat" == exported.text("#title")
    page.click("#upright")
    with page.expect_download() as download:
        page.click("#keep-download")
    assert [0, 0, 1] == decode(Path(download.value.path()).read_bytes()).metadata["up"]


@pytest.fixture
def cameras(tmp_path):
    """A file with one camera."""
    viewmat = np.eye(4)
    viewmat[2, 3] = 6.5
    entry = {"K": [[90, 0, 40], [0, 90, 30], [0, 0, 1]], "viewmat": viewmat.tolist(), "W": 80, "H": 60}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    return tmp_path / "cameras.json"


@pytest.mark.browser
@pytest.mark.slow
def test_a_page_has_its_cameras_axes_and_any_name_and_is_forbidden_the_network(tab, site, make_model, cameras):
    name = "</script><script>alert('é')</script>&.csplat"
    wishes = page_parameters(str(cameras), MetadataOverrides(coordinate_system="RFU"))
    url = site.add("/page.html", export_page(encode(make_model(20, 0)), name, wishes).page)
    viewer = ViewerPage(tab, site)
    viewer.visit(url)
    assert list(np.ravel(json.loads(cameras.read_text())[0]["viewmat"])) == viewer.viewmat
    assert [0, 0, 1] == viewer.pose["up"]
    assert name == viewer.text("#title")
    assert f"{name} – csplat viewer" == tab.page.title()
    before = len(site.requests)
    blocked = tab.page.evaluate("fetch('/other').then(() => 'came', (error) => String(error))")
    assert "TypeError" in blocked
    assert before == len(site.requests)
    assert any("Content Security Policy" in problem for problem in tab.problems)
    tab.problems.clear()
