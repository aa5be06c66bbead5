"""Formats and displays of other packages, found by entry points; scenes in a notebook."""

from __future__ import annotations

import base64
import html
import os
import re
import subprocess
import sys

import numpy as np
import pytest

import csplat
import csplat_tools
from csplat_tools.present.notebook import most_visible, scene_html

PLUGIN = """
from csplat.formats import Format, format_by_name

FORMAT = Format("lcc", open=format_by_name("splat").open)


def html(model):
    return f"<p>{len(model)}</p>"
"""


@pytest.fixture
def installed(tmp_path):
    """Return a function that runs a statement where a distribution has these entry points; it returns the output."""

    def run(statement, name="other", **groups):
        metadata = tmp_path / f"{name}-1.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n", "utf-8")
        lines = [f"[csplat.{group}]\n{line}\n" for group, line in groups.items()]
        (metadata / "entry_points.txt").write_text("".join(lines), "utf-8")
        (tmp_path / "other_plugin.py").write_text(PLUGIN, "utf-8")
        paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
        code = f"import csplat, csplat.formats, sys, numpy as np\n{statement}"
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": paths},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.strip()

    return run


def test_a_format_of_another_package_is_listed_and_read(installed, tmp_path):
    (tmp_path / "a.lcc").write_bytes(bytes(32))
    statement = "print('lcc' in [one.name for one in csplat.formats.formats()]); "
    statement += f"print(len(csplat.read({str(tmp_path / 'a.lcc')!r})))"
    assert "True\n1" == installed(statement, formats="lcc = other_plugin:FORMAT")


def test_entry_points_are_read_only_for_formats_that_this_package_lacks(installed, tmp_path, make_model):
    csplat.write(tmp_path / "a.ply", make_model(3, 0))
    statement = f"csplat.read({str(tmp_path / 'a.ply')!r})\nprint('other_plugin' in sys.modules)"
    assert "False" == installed(statement, formats="lcc = other_plugin:FORMAT")


def test_a_plug_in_that_cannot_be_loaded_is_left_out_with_a_warning(installed):
    statement = "import warnings\nwith warnings.catch_warnings(record=True) as seen:\n"
    statement += "    names = [one.name for one in csplat.formats.formats()]\nprint(names[0], seen[-1].message)"
    found = installed(statement, formats="lcc = other_plugin:NOTHING")
    assert found.startswith(
        "compressed-ply other_plugin:NOTHING, installed as 'lcc' of csplat.formats, cannot be loaded: module"
    )


def test_notebooks_use_the_display_that_is_installed(installed):
    model = "csplat.SplatModel(np.zeros((2, 3), np.float32), np.array([[1, 0, 0, 0]] * 2, np.float32), "
    model += "np.zeros((2, 3), np.float32), np.ones(2, np.float32), np.zeros((2, 3), np.float32))"
    # A distribution of this name hides the metadata of the installed one, which has a display, too.
    assert "<p>2</p>" == installed(f"print({model}._repr_html_())", "csplat", display="html = other_plugin:html")


def test_without_entry_points_the_formats_are_those_of_the_codec(installed):
    statement = "print([one.name for one in csplat.formats.formats()][-1])"
    assert "gltf" == installed(statement, "csplat")


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
