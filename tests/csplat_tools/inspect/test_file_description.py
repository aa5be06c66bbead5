# SPDX-License-Identifier: Apache-2.0
"""Descriptions of files: contents of unknown types, which no encoder writes, and boxes."""

import numpy as np
from checked import cloud

from csplat import EncodeOptions, _spec, decode, encode, write_ply
from csplat_conformance.manifest import VECTORS
from csplat_tools.inspect.file_description import FileDescription, describe_file, describe_other_format

_FRAME_SIZE = _spec.CHUNK_HEADER_SIZE + _spec.TILE_HEAD_SIZE


def described_vector(name: str) -> FileDescription:
    """Describe a valid vector, and check that the parts make up the file."""
    data = (VECTORS / "valid" / f"{name}.csplat").read_bytes()
    file = describe_file(data)
    assert len(data) == sum(file.overhead.values()) + sum(usage.size_bytes for usage in file.attributes.values())
    return file


def test_chunks_of_the_same_unknown_type_are_added_up():
    overhead = described_vector("unknown_chunks").overhead
    assert 2 * _spec.CHUNK_HEADER_SIZE + len("abc" + "d") == overhead["priv"]
    assert _FRAME_SIZE == overhead["tile_frames"]
    assert "unknown_layers" not in overhead


def test_layers_of_unknown_ids_are_not_counted_as_frames():
    file = described_vector("ancillary_layers")
    layers = [layer for tile in file.header.all_tiles for layer in tile.layers]
    payloads = (5, 1, 1)  # bytes: layers 128 and 255 of the first tile, 255 of the second
    known_count = len(layers) - len(payloads)
    assert len(payloads) * _spec.CHUNK_HEADER_SIZE + sum(payloads) == file.overhead["unknown_layers"]
    assert known_count * _FRAME_SIZE == file.overhead["tile_frames"]


def test_the_box_is_around_all_centres_and_most_of_it_is_without_far_splats():
    means = np.random.default_rng(1).normal(size=(3000, 3))
    means[0] = (900.0, -800.0, 700.0)
    data = encode(cloud(means), EncodeOptions(tile_splats=100))
    file, means = describe_file(data), decode(data).means
    assert [*means.min(axis=0).tolist(), *means.max(axis=0).tolist()] == file.box()
    most = np.reshape(file.box(0.9), (2, 3))
    assert np.all(most[1] - most[0] < 20)
    inside = np.all((means >= most[0]) & (means <= most[1]), axis=1)
    assert inside.mean() > 0.5
    on_each_axis = ((means >= most[0]) & (means <= most[1])).mean(axis=0)
    assert np.all((on_each_axis >= 0.9) & (on_each_axis < 1))


def test_the_second_box_of_a_ply_has_the_middle_of_its_splats(tmp_path):
    means = np.linspace(-1, 1, 101)[:, None] * (1.0, 2.0, 4.0)
    write_ply(tmp_path / "scene.ply", cloud(np.random.default_rng(1).permutation(means)))
    report, text = describe_other_format(tmp_path / "scene.ply")
    assert [-1, -2, -4, 1, 2, 4] == report["box"]
    assert "box          -1,-2,-4,1,2,4\nmiddle 90 %  -0.9,-1.8,-3.6,0.9,1.8,3.6" in text
    write_ply(tmp_path / "one.ply", cloud(means[:1]))
    assert "middle" not in describe_other_format(tmp_path / "one.ply")[1]


def test_without_splats_there_is_no_box():
    assert described_vector("empty").box() is None
