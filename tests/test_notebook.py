"""Scenes in a notebook: a frame with the viewer's page and the scene inside."""

import base64
import html
import re
import sys

import numpy as np
import pytest

import csplat
import csplat_tools
from csplat_tools.present.notebook import most_visible, scene_html


def scene_in(shown):
    """The model inside of a frame."""
    page = html.unescape(re.search(r'srcdoc="([^"]*)"', shown)[1])
    coded = re.search(r'<script type="application/octet-stream" id="csplat-scene">([^<]*)</script>', page)[1]
    return csplat.decode(base64.b64decode(coded))


def test_a_model_and_an_opened_file_show_themselves(make_model, tmp_path):
    model = make_model(40, 1)
    shown = model._repr_html_()
    assert (40, 1) == (len(scene_in(shown)), scene_in(shown).sh_degree)
    assert "<small>" not in shown
    assert ' src="' not in shown
    csplat.write_ply(tmp_path / "scene.ply", model)
    assert 40 == len(scene_in(csplat_tools.load_model(tmp_path / "scene.ply")._repr_html_()))


def test_of_a_large_scene_what_covers_most_is_shown_and_that_is_said(make_model):
    model = make_model(3000, 0)
    model.opacities[::3] = 0.0
    shown = scene_html(model, most_splats=1000)
    assert 1000 == len(scene_in(shown))
    assert "1,000 of 3,000 splats, those that cover most" in shown
    kept = most_visible(model, 1000)
    assert kept.opacities.min() > 0.0
    areas = np.exp(np.sort(kept.scales, axis=1)[:, 1:].sum(axis=1))
    assert np.median(areas) > np.median(np.exp(np.sort(model.scales, axis=1)[:, 1:].sum(axis=1)))


def test_without_splats_or_without_the_tools_a_notebook_shows_text(make_model, monkeypatch):
    assert make_model(0)._repr_html_() is None
    monkeypatch.setitem(sys.modules, "csplat_tools.present.notebook", None)
    assert make_model(5)._repr_html_() is None


@pytest.mark.slow
def test_the_frame_draws_and_is_kept_from_the_notebook(tab, site, make_model):
    shown = make_model(200, 0)._repr_html_()
    head = '<!doctype html><link rel="icon" href="data:,"><title>kept</title>'
    tab.page.set_viewport_size({"width": 200, "height": 500})
    tab.page.goto(site.add("/notebook.html", f"{head}{shown}".encode()))
    frame = next(one for one in tab.page.frames if one is not tab.page.main_frame)
    frame.wait_for_load_state()
    frame.evaluate("csplatViewer.ready")
    brightest = "(all) => all.filter((_, at) => at % 4 < 3).reduce((a, b) => Math.max(a, b), 0)"
    assert frame.evaluate(f"csplatViewer.engine.readPixels().then({brightest})") > 100
    with pytest.raises(Exception, match="cross-origin"):
        frame.evaluate("parent.document.title")
