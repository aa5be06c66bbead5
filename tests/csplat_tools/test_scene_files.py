# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.scene_files: the first view of a scene, the same in every encoding of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from checked import cloud
from models import with_facts

import csplat
from csplat import EncodeOptions, InputError, write_ply
from csplat.scene import Scene
from csplat_render.camera import Camera, intrinsics, look_at
from csplat_render.first_view import viewing_metadata
from csplat_tools import scene_files
from csplat_tools.convert_file import convert_file
from csplat_tools.encode_file import encode_file
from csplat_tools.scene_files import with_first_view


def bowl(count=3000):
    """Return a ball of splats that are fine above and smeared below, z up, as if photographed from above."""
    points = np.random.default_rng(0).standard_normal((count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return cloud(points, 0.02 * 30.0 ** np.clip(-points[:, 2] + 0.2, 0.0, 1.0))


def test_every_encoding_of_a_scene_has_the_same_first_view_and_up_direction(tmp_path):
    source, first = tmp_path / "bowl.ply", viewing_metadata(bowl()).entries
    write_ply(source, bowl())
    made = [tmp_path / f"{name}.csplat" for name in ("fast", "balanced", "levels", "target", "converted")]
    encode_file(str(source), str(made[0]), EncodeOptions(preset="fast"))
    encode_file(str(source), str(made[1]), EncodeOptions())
    encode_file(str(source), str(made[2]), EncodeOptions(preset="fast"), levels="merged")
    encode_file(str(source), str(made[3]), EncodeOptions(), target=csplat.Target(max_error={"means": 0.01}))
    convert_file(str(source), str(made[4]))
    for path in made:
        assert first == csplat.read(path).metadata.entries, path.name
    assert ("estimate", [0.0, 0.0, 1.0], ["up"]) == (first["view"]["from"], first["up"], first["estimated"])
    decoded, again = tmp_path / "decoded.ply", tmp_path / "again.csplat"
    write_ply(decoded, csplat.read(made[1]))
    encode_file(str(decoded), str(again), EncodeOptions(preset="fast"))
    assert first == csplat.read(again).metadata.entries


def test_blocks_give_the_first_view_of_memory(monkeypatch):
    monkeypatch.setattr(scene_files, "SAMPLE_SPLATS", 700)
    model = bowl()
    blocks = Scene.of(model).changed(
        in_memory=None, reader=lambda: iter((model.select(slice(0, 1111)), model.select(slice(1111, None))))
    )
    sample = viewing_metadata(model.select(slice(None, None, 5)), every=5)
    assert sample == with_first_view(blocks).metadata
    assert sample == next(with_first_view(blocks).blocks()).metadata


def test_a_camera_file_gives_the_first_view(tmp_path):
    camera = look_at([0.0, -3.0, 1.0], [0, 0, 0], [0, 0, 1], intrinsics(64, 48, 60.0), 64, 48, image="a.jpg")
    path = tmp_path / "view.json"
    path.write_text(json.dumps([camera.as_json()]), encoding="utf-8")
    known = with_facts(bowl(), entries={"view": {"from": "estimate"}, "up": [0, 1, 0]})
    entries = with_first_view(Scene.of(known), path).metadata.entries
    assert ([0, 1, 0], "author") == (entries["up"], entries["view"]["from"])
    assert np.allclose(camera.viewmat, Camera.from_json(entries["view"]).viewmat, atol=1e-5)
    path.write_text("[]", encoding="utf-8")
    with pytest.raises(InputError, match="camera"):
        with_first_view(Scene.of(known), path)


def test_a_scene_with_a_view_and_an_up_direction_is_not_read():
    entries = {"view": {"from": "training"}, "up": [0, 0, 1]}
    model = with_facts(bowl(), entries=entries)
    unread = Scene.of(model).changed(in_memory=None, reader=lambda: pytest.fail("it was read"))
    assert entries == with_first_view(replace(unread)).metadata.entries
