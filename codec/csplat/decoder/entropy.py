# SPDX-License-Identifier: Apache-2.0
"""Read streams: head, coder and transforms (spec 6.1 to 6.3)."""

from __future__ import annotations

import zlib
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.container import Cursor, check_reserved
from csplat.errors import FormatError, LimitError, UnsupportedError

#: Integers of any width.
Ints = NDArray[Any]

_OFFSETS = _spec.STREAM_HEAD_OFFSETS
#: Clauses by the last word of zlib's message; otherwise COD-2.
_ZLIB_CLAUSES = {
    "symbols": "COD-5",  # too many length or distance symbols
    "set": "COD-6",  # invalid code lengths set, invalid literal/lengths set, invalid distances set
    "repeat": "COD-7",  # invalid bit length repeat
    "end-of-block": "COD-7",  # invalid code -- missing end-of-block
    "code": "COD-8",  # invalid literal/length code, invalid distance code
    "back": "COD-8",  # invalid distance too far back
}


def read_stream(
    cursor: Cursor, count: int | None, width_max: int, *, signed: bool = False, json_bytes: int | None = None
) -> Ints:
    """Read a stream and step over it.

    Args:
        cursor: at the stream's head.
        count: required number of elements; `None`: any number (JSON).
        width_max: maximum bytes per element.
        signed: read elements as two's complement of `width` bytes.
        json_bytes: the caller's limit if `count` is `None`.

    Returns:
        [count] little-endian integers of 1, 2, 4 or 8 bytes, the smallest size that holds `width` bytes. The array may
        be a read-only view of the file.
    """
    at = cursor.take(_spec.STREAM_HEAD_SIZE)
    head = _spec.unpack_stream_head(cursor.view, at)
    _check_head(head, at, count, width_max)
    if json_bytes is not None and _spec.JSON_BYTE_COST * head.count > json_bytes:
        cost = _spec.JSON_BYTE_COST * head.count
        raise LimitError("json_bytes", cost, json_bytes, offset=at + _OFFSETS["count"], clause="STR-8")
    if head.coded_size > cursor.end - cursor.at:
        _refuse(at, "coded_size", "STR-6", head.coded_size, f"at most {cursor.end - cursor.at}")
    start = cursor.take(head.coded_size)
    packed: bytes | memoryview | Ints = _undo_coder(head, cursor.view[start : start + head.coded_size], start)
    if _spec.TRANSFORM_RUN_LENGTH in head.transforms:
        packed = _undo_run_length(packed, head.count * head.width, start)
    elements = undo_transforms(packed, head.transforms, head.count, head.width)
    return _as_signed(elements, head.width) if signed else elements


def _check_head(head: _spec.StreamHead, at: int, count: int | None, width_max: int) -> None:
    """Check the stream head at `at` (RES-1, RES-2, STR-1 to STR-5); a `count` of `None` stands for any from 1."""
    check_reserved(head, at, _OFFSETS)
    wanted = max(1, head.count) if count is None else count
    if head.count != wanted:
        _refuse(at, "count", "STR-1", head.count, wanted)
    if not 1 <= head.width <= width_max:
        _refuse(at, "width", "STR-2", head.width, f"1 to {width_max}")
    used = head.transforms.rstrip(b"\0")
    if any(transform not in _spec.TRANSFORM_NAMES for transform in used):
        raise UnsupportedError(f"transform {max(used)}", offset=at + _OFFSETS["transforms"], clause="RES-2")
    if any(a >= b for a, b in pairwise(b"\0" + used)):
        _refuse(at, "transforms", "STR-3", list(head.transforms), "ascending values, then zeros")
    if head.coder not in _spec.CODER_NAMES:
        raise UnsupportedError(f"coder {head.coder}", offset=at + _OFFSETS["coder"], clause="RES-2")
    size = head.count * head.width
    if _spec.TRANSFORM_RUN_LENGTH not in used:
        if head.packed_size != size:
            _refuse(at, "packed_size", "STR-4", head.packed_size, size)
    elif head.packed_size % 3 or not 3 <= head.packed_size <= 3 * size:
        _refuse(at, "packed_size", "STR-5", head.packed_size, f"a multiple of 3 up to {3 * size}")


def _refuse(at: int, name: str, clause: str, value: object, wanted: object) -> None:
    """Raise E_STREAM with the clause for the field `name` of the stream head at `at`."""
    raise FormatError(_spec.ERROR_STREAM, at + _OFFSETS[name], clause, name, found=value, wanted=wanted)


# Coders ------------------------------------------------------------------------------------------


def _undo_coder(head: _spec.StreamHead, coded: memoryview, at: int) -> bytes | memoryview:
    """Return exactly `packed_size` bytes; otherwise raise E_CODER at the first coded byte."""
    if head.coder == _spec.CODER_STORED:
        if head.coded_size != head.packed_size:
            raise FormatError(
                _spec.ERROR_CODER, at, "COD-1", "coded_size", found=head.coded_size, wanted=head.packed_size
            )
        return coded
    return _inflate(coded, head.packed_size, at)


def _inflate(coded: memoryview, size: int, at: int) -> bytes:
    """Return exactly `size` bytes from DEFLATE (COD-2 to COD-8); `at` is the offset of the coded bytes in the file."""
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        # COD-4: asking for another byte detects a stream that is too long, and lets inflate reach the stream's end.
        packed = inflater.decompress(coded, size + 1)
    except zlib.error as error:
        clause = _ZLIB_CLAUSES.get(str(error).split()[-1], "COD-2")
        raise FormatError(_spec.ERROR_CODER, at, clause, str(error)) from None
    if len(packed) != size:
        actual = f"more than {size} bytes" if len(packed) > size else f"{len(packed)} bytes"
        raise FormatError(_spec.ERROR_CODER, at, "COD-2", found=actual, wanted=f"{size} bytes")
    if not inflater.eof:
        raise FormatError(_spec.ERROR_CODER, at, "COD-2", "the DEFLATE stream has no end")
    if inflater.unused_data:
        left = len(inflater.unused_data)
        raise FormatError(_spec.ERROR_CODER, at + len(coded) - left, "COD-2", f"{left} bytes follow the final block")
    return packed


# Transforms --------------------------------------------------------------------------------------


def _undo_run_length(packed: bytes | memoryview | Ints, size: int, at: int) -> Ints:
    """Expand runs to uint8 [size]: planes of values, and of low and high bytes of lengths - 1.

    Raises:
        FormatError: E_CODER at the offset `at` of the coded bytes, if the lengths do not add up to `size` (TRF-1).
    """
    data = np.frombuffer(packed, np.uint8)
    values, low, high = data.reshape(3, -1)
    lengths = high.astype(np.int64)
    lengths <<= 8
    lengths += low
    lengths += 1
    total = int(lengths.sum())
    if total != size:
        raise FormatError(_spec.ERROR_CODER, at, "TRF-1", "sum of the run lengths", found=total, wanted=size)
    return np.repeat(values, lengths)


def undo_transforms(packed: bytes | memoryview | Ints, transforms: bytes, count: int, width: int) -> Ints:
    """Undo byte planes, zigzag and delta, in this order (spec 6.3).

    Args:
        packed: `count` × `width` bytes.
        transforms: ids; NONE and RUN_LENGTH, which is undone before, are ignored.
        count: number of elements.
        width: bytes per element, 1 to 8.
    """
    data = np.frombuffer(packed, np.uint8)
    if _spec.TRANSFORM_BYTE_PLANES in transforms:
        elements = _join_planes(data.reshape(width, count))
    elif width in (1, 2, 4, 8):
        elements = data.view(f"<u{width}")
    else:
        elements = _join_planes(data.reshape(count, width).T)
    if _spec.TRANSFORM_ZIGZAG in transforms:
        elements = _undo_zigzag(elements, width)
    if _spec.TRANSFORM_DELTA in transforms:
        elements = _undo_delta(elements, width)
    return elements


def _join_planes(planes: Ints) -> Ints:
    """Join byte planes [width, count], lowest first, to integers [count]."""
    width, count = planes.shape
    if width == 1:
        only: Ints = planes[0]
        return only
    size = 2 if width == 2 else 4 if width <= 4 else 8
    out = np.empty((count, size), np.uint8)
    for i in range(size):
        out[:, i] = planes[i] if i < width else 0
    return out.reshape(-1).view(f"<u{size}")


def _undo_zigzag(elements: Ints, width: int) -> Ints:
    """Return integers [count] in two's complement of `width` bytes."""
    one = elements.dtype.type(1)
    out = elements & one
    np.negative(out, out=out)  # all ones if the sign bit is set, modulo 2^bits
    out ^= elements >> one
    return _wrap(out, width)


def _undo_delta(elements: Ints, width: int) -> Ints:
    """Return the cumulative sums of integers [count], modulo 2^(8 width)."""
    dtype = elements.dtype
    if dtype.itemsize < 4:
        # Summing four-byte integers is several times faster than summing bytes, and equal modulo 2^(8 width).
        narrow: Ints = np.cumsum(elements, dtype="<u4").astype(dtype)
        return narrow
    return _wrap(np.cumsum(elements, dtype=dtype), width)


def _wrap(elements: Ints, width: int) -> Ints:
    """Reduce modulo 2^(8 width), in place."""
    if width < elements.dtype.itemsize:
        elements &= elements.dtype.type((1 << (8 * width)) - 1)
    return elements


def _as_signed(elements: Ints, width: int) -> Ints:
    """Read integers [count] in two's complement of `width` bytes as signed integers of the same item size."""
    spare = elements.dtype.itemsize - width
    if spare:
        elements = elements << elements.dtype.type(8 * spare)
    result: Ints = elements.view(f"<i{elements.dtype.itemsize}")
    if spare:
        result = result >> result.dtype.type(8 * spare)
    return result
