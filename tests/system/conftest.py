# SPDX-License-Identifier: Apache-2.0
"""A small scene, its file and its source index, for tests of commands."""

import numpy as np
import pytest
from command_line import printed

from csplat import write_ply


@pytest.fixture
def ply(tmp_path, make_model):
    """A PLY of 200 splats of degree 2."""
    path = tmp_path / "scene.ply"
    write_ply(path, make_model(200, 2))
    return path


@pytest.fixture
def damaged_ply(tmp_path, make_model):
    """A PLY of 50 splats; a value is NaN, and bytes follow the last row."""
    path = tmp_path / "bad.ply"
    write_ply(path, make_model(50, 1))
    data = bytearray(path.read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data + b"trailing")
    return path


@pytest.fixture(scope="session")
def encoded_once():
    """The files that `encode` writes for `ply`, by name; the first test that needs them fills it."""
    return {}


@pytest.fixture
def csplat_file(tmp_path, ply, encoded_once, no_first_view):  # noqa: ARG001  # the same bytes in every module
    """The file of `ply`, with its source index next to it."""
    names = ("scene.csplat", "index.npy")
    if not encoded_once:
        printed("encode", ply, tmp_path / names[0], "--source-index", tmp_path / names[1], "--quiet")
        encoded_once.update({name: (tmp_path / name).read_bytes() for name in names})
    for name, data in encoded_once.items():
        (tmp_path / name).write_bytes(data)
    return tmp_path / names[0]


@pytest.fixture
def no_first_view(monkeypatch):
    """Choose no first view and no up direction, which takes longer than encoding small scenes."""
    monkeypatch.setattr("csplat_tools.scene_files.viewing_metadata", lambda model, **_: model.metadata)
