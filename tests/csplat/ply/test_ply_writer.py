# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.ply.ply_writer."""

import os
from pathlib import Path

import numpy as np
import pytest
from ply_cases import assert_same_scene, columns_of, header_of

from csplat.errors import InputError
from csplat.ply import read_ply, write_ply


@pytest.mark.parametrize(("count", "degree"), [(0, 3), (1, 0), (2, 1), (2, 2), (5000, 3)])
def test_written_scenes_read_back(tmp_path, make_model, count, degree):
    model, report = make_model(count, degree), []
    write_ply(tmp_path / "a.ply", model)
    assert_same_scene(model, read_ply(tmp_path / "a.ply", strict=True, report=report))
    assert (["empty"] if count == 0 else []) == [one.id for one in report]


def test_writes_the_columns_and_order_that_viewers_expect(tmp_path, make_model):
    model, names = make_model(3, 2, origin=(1.0, 2.0, 3.0)), columns_of(2)
    write_ply(tmp_path / "a.ply", model)
    lines = header_of(tmp_path / "a.ply")
    assert ["ply", "format binary_little_endian 1.0", "element vertex 3"] == lines[:3]
    assert [f"property float {name}" for name in names] == lines[3:-1]
    assert "comment csplat origin 1.0 2.0 3.0" == lines[-1]
    rows = np.frombuffer((tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1], "<f4").reshape(3, len(names))
    at = {name: rows[:, index] for index, name in enumerate(names)}
    assert np.array_equal(at["f_rest_9"], model.shN[:, 1, 1])
    assert np.array_equal(at["rot_0"], model.quats[:, 0])
    assert not rows[:, 3:6].any()  # normals


def test_metadata_survive_a_ply_and_comments_of_other_programs_are_read(tmp_path, make_model):
    entries = {"licence": "CC0-1.0", "comments": ["hello"], "up": [0, 0, 1], "estimated": ["up"]}
    model = make_model(4, origin=(4.5e6, -1.25, 0.1), coordinate_system="RUB", unit_metres=0.01, antialiased=True,
        flat=True, colour_space="200", entries=entries)  # fmt: skip
    write_ply(tmp_path / "a.ply", model)
    again = read_ply(tmp_path / "a.ply", strict=True)
    for name in ("origin", "metadata"):
        assert getattr(model, name) == getattr(again, name)
    assert_same_scene(model, again)
    assert {"comment SplatRenderMode: mip", "comment SplatRenderMode: 2dgs"} < set(header_of(tmp_path / "a.ply"))
    write_ply(tmp_path / "a.ply", make_model(2, 0, antialiased=True))
    for message, antialiased, flat in (
        (b"antialiased 1", True, False), (b"antialiased 0", False, False), (b"csplat antialiased", True, False),
        (b"SplatRenderMode: default", False, False), (b"splatrendermode: 2DGS", False, True),
    ):  # fmt: skip
        found = read_ply((tmp_path / "a.ply").read_bytes().replace(b"SplatRenderMode: mip", message))
        assert (antialiased, flat, {}) == (found.metadata.antialiased, found.metadata.flat, found.metadata.entries)


def test_absolute_positions_are_doubles_and_keep_the_origin(tmp_path, make_model):
    model = make_model(50, 0, origin=(1e7, -3e6, 12.25))
    write_ply(tmp_path / "a.ply", model, absolute=True)
    lines = header_of(tmp_path / "a.ply")
    assert "property double x" in lines
    assert "comment csplat absolute_origin 10000000.0 -3000000.0 12.25" in lines
    again = read_ply(tmp_path / "a.ply", strict=True)
    assert model.origin == again.origin
    np.testing.assert_allclose(again.means, model.means, rtol=1e-6, atol=2e-9)


def test_invalid_metadata_are_not_written(tmp_path, make_model):
    for metadata in (
        {"training": "on a laptop"}, {"view": "from above"}, {"view": {"near": np.inf}}, {"view": {"K": np.eye(3)}},
    ):  # fmt: skip
        write_ply(tmp_path / "b.ply", make_model(entries=metadata))
        assert {} == read_ply(tmp_path / "b.ply").metadata.entries


def test_a_file_is_replaced_only_once_it_is_complete(tmp_path, make_model):
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match="not a PLY type"):
        write_ply(path, make_model(extra={"id": np.arange(10, dtype=np.int64)}))
    assert b"old" == path.read_bytes()
    write_ply(path, make_model())
    assert 10 == len(read_ply(path))
    assert ["a.ply"] == [one.name for one in tmp_path.iterdir()]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no /dev/null, and links require privileges")
def test_writing_follows_a_symbolic_link_and_leaves_a_device(tmp_path, make_model):
    (tmp_path / "real.ply").write_bytes(b"")
    (tmp_path / "link.ply").symlink_to(tmp_path / "real.ply")
    write_ply(tmp_path / "link.ply", make_model())
    assert (tmp_path / "link.ply").is_symlink()
    assert 10 == len(read_ply(tmp_path / "real.ply"))
    write_ply("/dev/null", make_model())
    assert Path("/dev/null").is_char_device()


def test_names_of_extra_columns_and_comments_cannot_break_the_header(tmp_path, make_model):
    for name in ("x", "opacity", "f_rest_0", "two words", "ü", ""):
        with pytest.raises(InputError, match="extra column"):
            write_ply(tmp_path / "a.ply", make_model(extra={name: np.arange(10.0)}))
    metadata = {"comments": ["one\nend_header", "naïve", 5], "licence": "a\nb"}
    write_ply(tmp_path / "a.ply", make_model(entries=metadata))
    kept = {"comments": ["one\nend_header", "naïve"], "licence": "a\nb"}
    assert (tmp_path / "a.ply").read_bytes().partition(b"\nend_header\n")[0].isascii()
    assert kept == read_ply(tmp_path / "a.ply", strict=True).metadata.entries
