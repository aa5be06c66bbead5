# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.scene."""

from __future__ import annotations

import pickle
import struct
import zipfile

import numpy as np
import pytest
from formats_cases import same, with_size, zip_of

import csplat
from csplat import InputError, write_ply
from csplat.formats import write_scene
from csplat.ply import read_ply
from csplat.scene import BLOCK_SPLATS, Scene


@pytest.fixture
def large(make_model):
    """More splats than a block has."""
    model = make_model(60, 1)
    return model.select(np.arange(BLOCK_SPLATS + 1000) % 60)


@pytest.mark.slow
def test_a_ply_in_blocks_is_the_ply_at_once(tmp_path, large):
    path = tmp_path / "a.ply"
    write_ply(path, large)
    with csplat.open(path) as scene:
        assert len(large) == scene.count
        assert 0 == len(scene.empty())
        assert [BLOCK_SPLATS, 1000] == [len(block) for block in scene.blocks()]
        same(read_ply(path), scene.model())
        write_scene(tmp_path / "b.ply", scene)
    assert path.read_bytes() == (tmp_path / "b.ply").read_bytes()
    path.write_bytes(path.read_bytes()[:-4] + np.float32(np.nan).tobytes())
    with csplat.open(path) as scene:  # rows that are dropped are not counted
        assert len(large) - 1 == scene.count == sum(map(len, scene.blocks()))
        assert ["nonfinite-rows"] == [one.id for one in scene.findings if one.kind == "repair"]


def test_a_scene_in_memory_is_read_in_blocks(large):
    scene = Scene.of(large)
    assert [BLOCK_SPLATS, 1000] == [len(one) for one in scene.blocks()]
    assert [30_000, 30_000, 5536, 1000] == [len(one) for one in scene.blocks(30_000)]
    with pytest.raises(InputError, match="splats_max is 0"):
        next(scene.blocks(0))
    same(large, scene.model())
    assert 0 == len(Scene(0, 1, lambda: iter(())).model())


def checkpoint_of(pickled, way=zipfile.ZIP_STORED):
    return zip_of([("archive/data.pkl", pickled), ("archive/version", b"3\n")], way)


def test_large_pickles_and_compressed_parts_of_checkpoints_are_refused(tmp_path):
    large = b"\x80\2X" + struct.pack("<I", 1 << 23) + bytes(1 << 23) + b"."
    lied = with_size(zip_of([("a/data/0", bytes(1000)), ("a/data.pkl", b"N.")], zipfile.ZIP_DEFLATED), 300_000_000)
    for name, data, message in (
        ("a.pt", checkpoint_of(large), "a pickle of more than 4,194,304 bytes"),
        ("a.ckpt", checkpoint_of(large, zipfile.ZIP_DEFLATED), "a pickle of more than 4,194,304 bytes"),
        ("b.pt", pickle.dumps(0x1950A86A20F9469CFC6C, 2) + large, "a pickle of more than 4,194,304 bytes"),
        ("a.pt", lied, "declares an unpacked size of 300,000,000"),
        ("a.pt", zip_of([("archive/data.pkl", b"N.")], zipfile.ZIP_LZMA), "by method 14, expected 8"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=message), csplat.open(tmp_path / name):
            pass
