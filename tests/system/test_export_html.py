# SPDX-License-Identifier: Apache-2.0
import json
import re

import numpy as np
import pytest
from checked import cloud
from chromium import ViewerPage
from command_line import call

from csplat import encode
from csplat_tools.present.viewer_page import export_page
from csplat_tools.present.viewer_server import page_parameters
from csplat_tools.scene_files import MetadataOverrides


@pytest.mark.slow
def test_the_page_opens_without_a_network_and_equals_the_served_one(viewer, tab, make_model, tmp_path):
    rng = np.random.default_rng(0)
    sample = encode(cloud(rng.standard_normal((500, 3)), 0.3, sh0=rng.standard_normal((500, 3)).astype(np.float32)))
    (tmp_path / "scene.csplat").write_bytes(sample)
    call("export-html", tmp_path / "scene.csplat", tmp_path / "page.html")
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


@pytest.mark.slow
def test_a_page_has_its_cameras_axes_and_any_name_and_is_forbidden_the_network(tab, site, make_model, tmp_path):
    name = "</script><script>alert('é')</script>&.csplat"
    viewmat = np.eye(4)
    viewmat[2, 3] = 6.5
    entry = {"K": [[90, 0, 40], [0, 90, 30], [0, 0, 1]], "viewmat": viewmat.tolist(), "W": 80, "H": 60}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    wishes = page_parameters(str(tmp_path / "cameras.json"), MetadataOverrides(coordinate_system="RFU"))
    url = site.add("/page.html", export_page(encode(make_model(20, 0)), name, wishes).page)
    viewer = ViewerPage(tab, site)
    viewer.visit(url)
    assert viewmat.ravel().tolist() == viewer.viewmat
    assert [0, 0, 1] == viewer.pose["up"]
    assert name == viewer.text("#title")
    assert f"{name} – csplat viewer" == tab.page.title()
    before = len(site.requests)
    blocked = tab.page.evaluate("fetch('/other').then(() => 'came', (error) => String(error))")
    assert "TypeError" in blocked
    assert before == len(site.requests)
    assert any("Content Security Policy" in problem for problem in tab.problems)
    tab.problems.clear()
