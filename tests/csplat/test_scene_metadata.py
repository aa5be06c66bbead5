# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.scene_metadata."""

from __future__ import annotations

import base64
import json
import math
import re

import numpy as np
import pytest
from command_line import call
from posed_sets import write_blender, write_colmap_set, write_transforms

from csplat import decode, write_ply
from csplat.errors import InputError
from csplat.ply import read_ply
from csplat.scene_metadata import SceneMetadata, unit_up
from csplat_render.camera_paths import orbit_cameras
from csplat_trainer.data import load
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions

pytest.importorskip("PIL", reason="training requires the extra [render]")


def test_a_direction_gets_unit_length_and_other_values_are_refused():
    for values, up in (
        ((0, 0, 2), (0, 0, 1)), ([0.0, -1.0, 0.1], (0, -0.995037, 0.099504)),
        ((1e300, -1e300, 0), (0.707107, -0.707107, 0)), ((5e-324, 0, 0), (1, 0, 0)),
    ):  # fmt: skip
        assert up == unit_up(values) == unit_up(unit_up(values))
    for values in (
        None, "xyz", (0, 0, 0), (1, 2), (1, 2, 3, 4), (math.nan, 0, 1), (math.inf, 0, 1), (True, 0, 0), [[1]],
    ):  # fmt: skip
        with pytest.raises(InputError, match="expected three finite numbers"):
            unit_up(values)


def test_up_of_the_metadata_comes_before_the_axes():
    assert (0, 0, 1) == SceneMetadata("RFU").up
    assert (0, -1, 0) == SceneMetadata("RDF").up
    assert (1, 0, 0) == SceneMetadata("RFU", entries={"up": [1, 0, 0]}).up
    assert (0, 0, 1) == SceneMetadata("RFU", entries={"up": "there"}).up
    assert SceneMetadata().up is None
    assert SceneMetadata(entries={"up": [0, 0, 0]}).up is None


def test_setting_up_drops_axes_that_contradict_it(make_model):
    model = make_model(coordinate_system="RDF", entries={"up": [0.0, -1.0, 0.0]})
    leaning, lying = model.metadata.with_up((0, -1, 0.1)), model.metadata.with_up((0, 0, 1))
    assert ("RDF", [0.0, -0.995037, 0.099504]) == (leaning.coordinate_system, leaning.entries["up"])
    assert ("unspecified", [0.0, 0.0, 1.0]) == (lying.coordinate_system, lying.entries["up"])
    turned = model.metadata.with_up(coordinate_system="RFU")
    assert ("RFU", {}) == (turned.coordinate_system, turned.entries)


def trained(write, up):
    def make(folder, _make_model):
        write(folder, up=up)
        return train(load(folder), TrainOptions(max_splats=40, sh_degree=0, iterations=1, strategy="none")).model

    return make


def without_up(**fields):
    return lambda _folder, make_model: make_model(60, 1, **fields)


ESTIMATED = trained(write_colmap_set, (0, -1, 0))  # COLMAP sets do not state a direction


@pytest.mark.long
@pytest.mark.parametrize(("make", "words", "axes", "up"), [
    (trained(write_blender, (0, 0, 1)), [], "RFU", (0, 0, 1)),
    (ESTIMATED, [], "unspecified", (0, -1, 0)),
    (trained(write_transforms, (1, 0, 0)), ["--up", "-y"], "unspecified", (0, -1, 0)),
    (without_up(), [], "unspecified", None),
    (without_up(), ["--up", "0,-2,2"], "unspecified", (0, -0.707107, 0.707107)),
    (without_up(coordinate_system="LUF"), [], "LUF", (0, 1, 0)),
    (without_up(coordinate_system="RDF"), ["--up", "z"], "unspecified", (0, 0, 1)),
], ids=["blender", "colmap", "transforms-up", "ply", "ply-up", "ply-axes", "axes-up"])  # fmt: skip
def test_all_commands_agree_on_up(tmp_path, make_model, make, words, axes, up):
    (tmp_path / "set").mkdir()
    write_ply(tmp_path / "scene.ply", make(tmp_path / "set", make_model))
    call("encode", tmp_path / "scene.ply", tmp_path / "a.csplat", *words, "--preset", "fast", "-q")
    call("decode", tmp_path / "a.csplat", tmp_path / "b.ply")
    call("encode", tmp_path / "b.ply", tmp_path / "b.csplat", "--preset", "fast", "-q")
    for path in (tmp_path / "a.csplat", tmp_path / "b.csplat"):
        info = json.loads(call("info", path, "--json").stdout)
        assert (axes, None if up is None else list(up)) == (info["coordinate_system"], info["up"])
    scene, wishes = in_page(path)
    assert (up, {}) == (scene.metadata.up, wishes)
    shown = "unknown" if up is None else " ".join(f"{value:g}" for value in up)
    shown += r" \(estimated\)" if make is ESTIMATED else ""
    assert re.search(rf"\nup +{shown}\n", call("info", tmp_path / "b.csplat").stdout)
    model = read_ply(tmp_path / "b.ply")
    assert scene.metadata.with_entries(comments=None) == model.metadata.with_entries(comments=None)
    direction = np.array(up or (0, -1, 0)) / np.linalg.norm(up or 1)  # without a recorded up: as in a PLY
    for camera in orbit_cameras(model, 2, 64, 48):
        assert abs(camera.viewmat[0, :3] @ direction) < 1e-6
        assert -camera.viewmat[1, :3] @ direction > 0.5
    if up is None:  # a page of a PLY, with the direction of the command line
        assert {"up": "0,-0.995037,0.099504"} == in_page(tmp_path / "scene.ply", "--up", "0,-1,0.1")[1]


def in_page(path, *words):
    """Export a page; return its scene, and the view parameters that it sets."""
    page = path.with_suffix(".html")
    call("export-html", path, page, "--force", *words)
    text = page.read_text("utf-8")
    settings = json.loads(re.search(r'id="csplat-page">(.*?)</script>', text, re.DOTALL)[1])
    scene = decode(base64.b64decode(re.search(r'id="csplat-scene">(.*?)</script>', text, re.DOTALL)[1]))
    return scene, settings["wishes"]


def test_an_estimated_up_direction_is_marked_until_another_is_given():
    estimated = SceneMetadata(entries={"estimated": ["view"]}).with_up((0, 0, 1), estimated=True)
    assert ["view", "up"] == estimated.estimated
    assert ["view"] == estimated.with_up((0, 1, 0)).estimated
    assert ["view"] == estimated.with_up(coordinate_system="RDF").estimated
    assert "estimated" not in SceneMetadata().with_up((0, 0, 1), estimated=True).with_up((0, 1, 0)).entries
    assert [] == SceneMetadata(entries={"estimated": "up"}).estimated


def test_an_estimated_view_is_for_one_up_direction():
    for source, left in (("estimate", {"up"}), ("training", {"up", "view"}), ("author", {"up", "view"})):
        assert left == SceneMetadata(entries={"view": {"from": source}}).with_up((0, 0, 1)).entries.keys()


def test_a_colour_space_is_registered_or_the_number_of_an_unknown_one():
    for space in ("srgb_rec709_display", "lin_rec709_display", "128", "255"):
        assert space == SceneMetadata(colour_space=space).colour_space
    for space in ("srgb", "127", "256", ""):
        with pytest.raises(InputError, match="expected one of srgb_rec709_display"):
            SceneMetadata(colour_space=space)
