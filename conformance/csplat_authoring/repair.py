"""Repair the checksums of a file that was changed, so that the change itself is what a decoder meets."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import Final

from csplat import _spec

_CRC_SIZE = 4

#: Structures that name a chunk, and where their `crc` lies.
CHUNK_RECORDS: Final = {
    "directory_record": _spec.DIRECTORY_RECORD_OFFSETS["crc"],
    "layer_record": _spec.LAYER_RECORD_OFFSETS["crc"],
}


def repair(data: bytes, records: Sequence[tuple[str, int]] | None = None) -> bytes:
    """Return the file with the CRCs of chunks, index and header computed anew.

    Args:
        data: a file, damaged or not; shorter than a header it comes back as it is.
        records: structure and place of each record that names a chunk, where the index cannot be trusted to lead to
            them; None walks the index. A record that names bytes beyond the file keeps its CRC.
    """
    if len(data) < _spec.HEADER_SIZE:
        return data
    out = bytearray(data)
    for structure, at in chunk_records(data) if records is None else records:
        if at + int(getattr(_spec, f"{structure.upper()}_SIZE")) <= len(out):
            record = getattr(_spec, f"unpack_{structure}")(out, at)
            if record.offset + record.size <= len(out):
                _put_crc(out, record.offset, record.offset + record.size, at + CHUNK_RECORDS[structure])
    return seal(out)


def seal(data: bytes | bytearray) -> bytes:
    """Return the file with the CRCs of index and header computed anew."""
    out = bytearray(data)
    index_size = _spec.unpack_header(out).index_size
    crc_at = _spec.HEADER_SIZE + index_size - _CRC_SIZE
    if index_size >= _CRC_SIZE and crc_at + _CRC_SIZE <= len(out):
        _put_crc(out, _spec.HEADER_SIZE, crc_at, crc_at)
    _put_crc(out, 0, _spec.HEADER_OFFSETS["header_crc"], _spec.HEADER_OFFSETS["header_crc"])
    return bytes(out)


def chunk_records(data: bytes) -> list[tuple[str, int]]:
    """Walk the index, as far as it holds what its counts announce: structure and place of what names chunks."""
    end = min(len(data), _spec.HEADER_SIZE + _spec.unpack_header(data).index_size)
    return [(structure, at) for structure, at, size in _records(data) if at + size <= end]


def _records(data: bytes) -> Iterator[tuple[str, int, int]]:
    """Yield structure, place and size of the records that name chunks, up to the first beyond the data."""
    at = _spec.HEADER_SIZE
    if at + _spec.INDEX_HEAD_SIZE > len(data):
        return
    head = _spec.unpack_index_head(data, at)
    at += head.head_size
    at += head.attribute_count * head.attribute_size
    at += head.codebook_count * head.codebook_size
    at += head.extra_count * head.extra_size
    for _ in range(head.directory_count):
        yield "directory_record", at, _spec.DIRECTORY_RECORD_SIZE
        at += head.directory_size
    for _ in range(head.tile_count):
        if at + _spec.TILE_RECORD_SIZE > len(data):
            return
        tile = _spec.unpack_tile_record(data, at)
        at += head.tile_size
        for _layer in range(tile.layer_count):
            yield "layer_record", at, _spec.LAYER_RECORD_SIZE
            at += head.layer_size
        at += 2 * tile.table_count


def _put_crc(out: bytearray, start: int, end: int, at: int) -> None:
    out[at : at + _CRC_SIZE] = struct.pack("<I", zlib.crc32(memoryview(out)[start:end]))
