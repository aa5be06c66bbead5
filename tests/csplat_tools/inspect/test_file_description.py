# SPDX-License-Identifier: Apache-2.0
"""Descriptions of files with contents of unknown types, which no encoder writes."""

from csplat import _spec
from csplat_conformance.manifest import VECTORS
from csplat_tools.inspect.file_description import FileDescription, describe_file

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
