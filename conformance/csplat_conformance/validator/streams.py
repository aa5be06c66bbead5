# SPDX-License-Identifier: CC0-1.0
"""Read streams (spec 6.1 to 6.3): the head, the coder, the transforms."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat_conformance.validator.inflate import CodedError, Inflater
from csplat_conformance.validator.violation_log import Payload, PlacedRecord, UnreadableError, ViolationLog

#: Elements of a stream: int64, or uint64 if they have eight bytes, which only RAW permits.
Elements = NDArray[Any]

#: Largest number of elements in a valid file: the columns of the highest band for a full tile or codebook.
_ELEMENTS_MAX = max(_spec.ATTRIBUTE_COLUMNS.values()) * max(_spec.TILE_SPLATS_MAX, _spec.CODEBOOK_ENTRIES_MAX)


@dataclass(frozen=True)
class Stream:
    """A stream that was read.

    Attributes:
        head: the stream head with its offset.
        elements: [count], `None` if a violation prevents decoding.
    """

    head: PlacedRecord[_spec.StreamHead]
    elements: Elements | None


def read_stream(
    payload: Payload,
    what: str,
    count: int | None,
    width_max: int,
    *,
    signed: bool = False,
    count_max: int = 0,
) -> Stream:
    """Read the next stream.

    Args:
        payload: reader at the stream head.
        what: name of the stream within its chunk, `sh0.stream`.
        count: required number of elements; `None` for texts, whose head specifies it.
        width_max: largest number of bytes per element.
        signed: elements are in two's complement.
        count_max: budget of elements if `count` is `None`.

    Raises:
        UnreadableError: the payload ends within the stream.
    """
    log = payload.log
    head = payload.structure(_spec.StreamHead, what)
    sound = _check_counts(log, head, count, width_max)
    sound &= _check_transforms(log, head)
    sound &= _check_packed(log, head, sound)
    if count is None and head.record.count > count_max:
        log.add_field("STR-8", head, "count", f"{head.record.count}, expected at most {count_max} by the budget")
        sound = False
    coder_known = _check_coder(log, head)
    size = head.record.coded_size
    if size > payload.left:
        log.add_field("STR-6", head, "coded_size", f"{size} bytes, expected at most {payload.left}")
        raise UnreadableError
    at = payload.take(size, f"{what}.coded")
    if not coder_known:
        return Stream(head, None)
    # The coder can be checked even if the head is wrong, provided that the output size is plausible.
    most = count_max if count is None else _ELEMENTS_MAX
    if count is not None and count > most:
        sound = False  # the field that requires the count was reported
    if not sound and head.record.packed_size > 3 * width_max * most:
        return Stream(head, None)
    try:
        packed, spare_bits = undo_coder(payload.view[at : at + size], head.record.coder, head.record.packed_size)
    except CodedError as error:
        log.add(error.clause, at + error.within, f"{payload.name}/{what}.coded", str(error))
        return Stream(head, None)
    if spare_bits:
        log.remarks.append(f"{payload.name}/{what}.coded: the unused bits after the final block are not 0 (6.2)")
    return Stream(head, _undo_transforms(log, head, packed, at, signed) if sound else None)


def _check_counts(log: ViolationLog, head: PlacedRecord[_spec.StreamHead], count: int | None, width_max: int) -> bool:
    """Check STR-1 and STR-2; return True if they hold. A `count` of `None` permits any number of elements from 1 on."""
    sound = True
    announced, width = head.record.count, head.record.width
    count_valid = announced >= 1 if count is None else announced == count
    if not count_valid:
        log.add_field("STR-1", head, "count", f"{announced}, expected {'1 or more' if count is None else count}")
        sound = False
    if not 1 <= width <= width_max:
        log.add_field("STR-2", head, "width", f"{width}, expected 1 to {width_max}")
        sound = False
    return sound


def _check_transforms(log: ViolationLog, head: PlacedRecord[_spec.StreamHead]) -> bool:
    """Check RES-2 of the transforms, and STR-3; return True if they hold."""
    listed = head.record.transforms
    used = listed.rstrip(b"\0")
    unknown = [value for value in used if value not in _spec.TRANSFORM_NAMES]
    if unknown:
        log.add_field("RES-2", head, "transforms", f"{unknown[0]} is not in the registry")
        return False  # STR-3 assumes known ids
    if any(a >= b for a, b in pairwise(used)) or 0 in used:
        log.add_field("STR-3", head, "transforms", f"{list(listed)}, expected strictly ascending values, then zeros")
        return False
    return True


def _check_packed(log: ViolationLog, head: PlacedRecord[_spec.StreamHead], sound: bool) -> bool:
    """Check STR-4 or STR-5; return True if it holds, False unless `sound`: count, width and transforms are valid."""
    if not sound:
        return False
    size, packed = head.record.count * head.record.width, head.record.packed_size
    if _spec.TRANSFORM_RUN_LENGTH not in head.record.transforms:
        if packed != size:
            log.add_field("STR-4", head, "packed_size", f"{packed}, expected {size}, count x width")
            return False
    elif packed % 3 or not 3 <= packed <= 3 * size:
        log.add_field("STR-5", head, "packed_size", f"{packed}, expected a multiple of 3 from 3 to {3 * size}")
        return False
    return True


def _check_coder(log: ViolationLog, head: PlacedRecord[_spec.StreamHead]) -> bool:
    """Check RES-2 of the coder; return True if it is known."""
    coder = head.record.coder
    if coder not in _spec.CODER_NAMES:
        log.add_field("RES-2", head, "coder", f"{coder} is not a coder of this version")
        return False
    return True


# Transforms, undone last to first ------------------------------------------------------------------


def _undo_transforms(
    log: ViolationLog, head: PlacedRecord[_spec.StreamHead], packed: bytes, coded_at: int, signed: bool
) -> Elements | None:
    """Undo the transforms of a stream, and check TRF-1.

    Args:
        log: receives the violations.
        head: the stream head.
        packed: `packed_size` bytes.
        coded_at: offset of the coded bytes.
        signed: elements are in two's complement.

    Returns:
        [count]; `None` if TRF-1 does not hold.
    """
    record = head.record
    data = np.frombuffer(packed, np.uint8)
    if _spec.TRANSFORM_RUN_LENGTH in record.transforms:
        runs = data.reshape(3, -1)  # values, then low and high bytes of the lengths - 1
        lengths = runs[1].astype(np.int64) + 256 * runs[2].astype(np.int64) + 1
        total = int(lengths.sum())
        expected = record.count * record.width
        if total != expected:
            log.add("TRF-1", coded_at, head.path("coded"), f"the runs have {total} bytes, expected {expected}")
            return None
        data = np.repeat(runs[0], lengths)
    width, count = record.width, record.count
    if width == 1 and not signed and not {_spec.TRANSFORM_DELTA, _spec.TRANSFORM_ZIGZAG} & set(record.transforms):
        return data  # nothing to undo for texts and plain bytes
    planes = (
        data.reshape(width, count) if _spec.TRANSFORM_BYTE_PLANES in record.transforms else _split_bytes(data, width)
    )
    values = np.zeros(count, np.uint64)
    for i in range(width):
        values |= planes[i].astype(np.uint64) << np.uint64(8 * i)
    mask = np.uint64((1 << 8 * width) - 1)
    if _spec.TRANSFORM_ZIGZAG in record.transforms:
        half = values >> np.uint64(1)
        values = np.where(values & np.uint64(1), mask - half, half)
    if _spec.TRANSFORM_DELTA in record.transforms:
        values = np.cumsum(values, dtype=np.uint64) & mask
    if signed:
        spare = np.int64(64 - 8 * width)
        return (values.view(np.int64) << spare) >> spare
    return values if width == 8 else values.view(np.int64)


def _split_bytes(data: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Return byte i of each element as row i, [width, n]."""
    return data.reshape(-1, width).T


_RAW_DEFLATE = -15  # `wbits` of zlib: no header, a window of 2^15 bytes


def undo_coder(coded: memoryview, coder: int, size: int) -> tuple[bytes, bool]:
    """Undo a coder.

    Args:
        coded: `coded_size` bytes.
        coder: registry value of a known coder.
        size: `packed_size`.

    Returns:
        `size` bytes, and whether unused bits after a DEFLATE stream are set.

    Raises:
        CodedError: COD-1, COD-2, COD-5 to COD-8.
    """
    if coder == _spec.CODER_STORED:
        if len(coded) != size:
            raise CodedError("COD-1", f"{len(coded)} bytes are stored, expected packed_size, {size}")
        return bytes(coded), False
    return _inflate(coded, size)


def _inflate(coded: memoryview, size: int) -> tuple[bytes, bool]:
    """Inflate `size` bytes, and check COD-2 and COD-5 to COD-8.

    Returns:
        The bytes, and whether unused bits after the stream are set, for which the last byte is inflated separately.

    Raises:
        CodedError: a clause is violated.
    """
    body, last = coded[:-1], bytes(coded[-1:])
    inflater = zlib.decompressobj(_RAW_DEFLATE)
    try:
        packed = inflater.decompress(body, size + 1)
        if inflater.eof:
            unused_size = len(inflater.unused_data) + len(last)
            raise CodedError("COD-2", f"{unused_size} bytes follow the final block", len(coded) - unused_size)
        if len(packed) > size:
            raise CodedError("COD-2", f"more than {size} bytes were inflated, expected packed_size, {size}")
        body_state = inflater.copy()
        tail = inflater.decompress(last, size + 1 - len(packed))
    except zlib.error as error:
        Inflater(bytes(coded)).inflate(size)  # raises with the clause
        raise CodedError("COD-2", f"not a DEFLATE stream: {error}") from None
    packed += tail
    if len(packed) != size:
        amount = f"more than {size}" if len(packed) > size else len(packed)
        raise CodedError("COD-2", f"{amount} bytes were inflated, expected packed_size, {size}")
    if not inflater.eof:
        raise CodedError("COD-2", "the DEFLATE stream has no end")
    return packed, _has_spare_bits(body_state, last[0], tail)


def _has_spare_bits(body_state: zlib._Decompress, last_byte: int, tail: bytes) -> bool:
    """Return True if bits of the last byte are set after the end of the final block.

    `body_state` is the inflater before the last byte, which gives the bytes `tail`.

    If the bits from k on are cleared, the stream ends in the same way once k reaches the end of the block. A smaller k
    has this effect only if the bits in between were already 0.
    """
    for k in range(8):
        trial = body_state.copy()
        try:
            same = trial.decompress(bytes([last_byte & (1 << k) - 1]), len(tail) + 1) == tail
        except zlib.error:
            continue
        if same and trial.eof:
            return bool(last_byte >> k)
    return False
