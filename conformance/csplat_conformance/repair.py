"""Repair the checksums of a file that was changed, so that the change itself is what a decoder meets."""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Sequence

from csplat import _spec

__all__ = ["chunk_spans", "digest_of", "repair", "seal"]

_CRC_SIZE = 4


def repair(data: bytes, spans: Sequence[tuple[int, int]] | None = None) -> bytes:
    """Return the file with the CRCs of header, index and chunks and the digest computed anew.

    Args:
        data: a file, damaged or not; shorter than a header it comes back as it is.
        spans: (offset, size) of the chunks; None walks the chunks as far as their frames are intact.
    """
    if len(data) < _spec.HEADER_SIZE:
        return data
    out = bytearray(data)
    for offset, size in chunk_spans(data) if spans is None else spans:
        if offset + size <= len(out) and size >= _CRC_SIZE:
            _put_crc(out, offset, offset + size - _CRC_SIZE)
    index_size = _spec.unpack_header(data).index_size
    end = _spec.HEADER_SIZE + index_size
    if index_size >= _CRC_SIZE and end <= len(out):
        _put_crc(out, _spec.HEADER_SIZE, end - _CRC_SIZE)
    return seal(out)


def chunk_spans(data: bytes | bytearray) -> list[tuple[int, int]]:
    """Walk the chunks by their own headers: (offset, size) of each whose frame fits into the data."""
    at = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size
    spans = []
    while at + _spec.CHUNK_HEADER_SIZE + _CRC_SIZE <= len(data):
        size = _spec.CHUNK_HEADER_SIZE + _spec.unpack_chunk_header(data, at).payload_size + _CRC_SIZE
        if at + size > len(data):
            break
        spans.append((at, size))
        at += size
    return spans


def seal(data: bytes | bytearray) -> bytes:
    """Return the file with the header's CRC and the digest computed anew."""
    out = bytearray(data)
    _put_crc(out, 0, _spec.HEADER_OFFSETS["header_crc"])
    out[_spec.HEADER_OFFSETS["digest"] : _spec.HEADER_SIZE] = digest_of(out)
    return bytes(out)


def digest_of(data: bytes | bytearray) -> bytes:
    """Return the SHA-256 of a file without its digest field (HDR-8)."""
    hashed = hashlib.sha256(data[: _spec.HEADER_OFFSETS["digest"]])
    hashed.update(data[_spec.HEADER_SIZE :])
    return hashed.digest()


def _put_crc(out: bytearray, start: int, end: int) -> None:
    out[end : end + _CRC_SIZE] = struct.pack("<I", zlib.crc32(out[start:end]))
