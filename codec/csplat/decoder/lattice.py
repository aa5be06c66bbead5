"""Block heads and the codings LEVELS, OFFSET and SIGNED (spec 6.4, 6.4.1, 6.4.4)."""

from __future__ import annotations

import numpy as np

from csplat import _spec
from csplat.decoder.blocks import Columns
from csplat.decoder.container import Cursor, check_reserved
from csplat.decoder.header import SceneHeader
from csplat.decoder.index_tiles import SINGLE_MAX, SINGLE_MIN, scaled_step
from csplat.decoder.streams import read_stream
from csplat.errors import FormatError, UnsupportedError


def read_block_head(cursor: Cursor, attribute: int, legal: tuple[int, ...] | None = None) -> int:
    """Read a block head, or that of an escape block if `legal` codings are given; return the coding."""
    at = cursor.take(_spec.BLOCK_HEAD_SIZE)
    head = _spec.unpack_block_head(cursor.view, at)
    check_reserved(head, at, _spec.BLOCK_HEAD_OFFSETS)
    place = at + _spec.BLOCK_HEAD_OFFSETS["coding"]
    if head.attribute != attribute:
        raise FormatError(
            _spec.ERROR_STREAM,
            at,
            "CBK-5" if legal else "TLE-2",
            "attribute",
            found=head.attribute,
            wanted=attribute,
        )
    if head.coding not in _spec.CODING_NAMES:
        raise UnsupportedError(f"attribute coding {head.coding}", offset=place, clause="BLK-1")
    if legal is not None and head.coding not in legal:
        raise FormatError(
            _spec.ERROR_STREAM, place, "CBK-5", "coding of an escape block", found=head.coding, wanted=legal
        )
    if _spec.CODING_NAMES[head.coding] not in _spec.ATTRIBUTE_CODINGS[attribute]:
        raise FormatError(
            _spec.ERROR_VALUE,
            place,
            "BLK-1",
            f"coding of {_spec.ATTRIBUTE_NAMES[attribute]}",
            found=_spec.CODING_NAMES[head.coding],
            wanted=" or ".join(_spec.ATTRIBUTE_CODINGS[attribute]),
        )
    return head.coding


def read_columns(
    cursor: Cursor, header: SceneHeader, attribute: int, coding: int, count: int, escape: bool = False
) -> Columns:
    """Read what follows the block head: parameters and stream; ranges checked.

    Args:
        cursor: stands behind the block head.
        header: the scene.
        attribute: of the block.
        coding: LEVELS, OFFSET or SIGNED.
        count: splats of the block.
        escape: it is an escape block.
    """
    columns = _spec.ATTRIBUTE_COLUMNS[attribute]
    record = header.attribute(attribute)
    exponent, offsets = 0, (0,) * columns
    if coding != _spec.CODING_LEVELS:
        exponent = read_exponent(cursor, record, fixed=escape or attribute == _spec.ATTRIBUTE_QUATS)
    if coding == _spec.CODING_OFFSET:
        offsets = read_offsets(cursor, columns)
    if coding == _spec.CODING_SIGNED:
        return read_signed(cursor, record, exponent, count)
    at = cursor.at
    elements = read_stream(cursor, columns * count, _spec.CODING_WIDTH_MAX[coding])
    block = Columns(elements.reshape(columns, count), offsets, exponent, at)
    check_integers(block.lows, block.highs, record, at)
    return block


def read_exponent(cursor: Cursor, record: _spec.AttributeRecord, *, fixed: bool) -> int:
    """Read lattice parameters: LAT-1, or LAT-2 where the exponent is fixed at 0."""
    at = cursor.take(_spec.LATTICE_PARAMS_SIZE)
    params = _spec.unpack_lattice_params(cursor.view, at)
    check_reserved(params, at, _spec.LATTICE_PARAMS_OFFSETS)
    if fixed and params.exponent != 0:
        raise FormatError(_spec.ERROR_VALUE, at, "LAT-2", "exponent", found=params.exponent, wanted=0)
    if not fixed:
        check_step(record, params.exponent, at)
    return params.exponent


def check_step(record: _spec.AttributeRecord, exponent: int, at: int) -> None:
    """LAT-1: step × 2^exponent is normal and finite in binary32; levels have no step."""
    scaled = scaled_step(record.step, exponent, SINGLE_MIN)
    if record.step and (scaled is None or scaled > SINGLE_MAX):
        raise FormatError(
            _spec.ERROR_VALUE,
            at,
            "LAT-1",
            f"{record.step} x 2^{exponent} is not finite in binary32 and at least 2^-126",
        )


def read_signed(cursor: Cursor, record: _spec.AttributeRecord, exponent: int, count: int) -> Columns:
    """Read a stream of signed integers in columns, [C, count] (LAT-4)."""
    at, columns = cursor.at, _spec.ATTRIBUTE_COLUMNS[record.attribute]
    elements = read_stream(cursor, columns * count, _spec.CODING_WIDTH_MAX[_spec.CODING_SIGNED], signed=True)
    block = Columns(elements.reshape(columns, count), (0,) * columns, exponent, at)
    check_integers(block.lows, block.highs, record, at)
    return block


def read_offsets(cursor: Cursor, columns: int) -> tuple[int, ...]:
    """Read i32[columns], the offsets (LAT-3)."""
    at = cursor.take(4 * columns)
    offsets = tuple(int(value) for value in np.frombuffer(cursor.view, "<i4", columns, at))
    for i, offset in enumerate(offsets):
        if abs(offset) > _spec.COLUMN_MAX:
            raise FormatError(
                _spec.ERROR_VALUE,
                at + 4 * i,
                "LAT-3",
                "offset",
                found=offset,
                wanted=f"{_spec.COLUMN_MAX} in magnitude at most",
            )
    return offsets


def check_integers(lows: tuple[int, ...], highs: tuple[int, ...], record: _spec.AttributeRecord, at: int) -> None:
    """Check the extremes of columns by LEV-1, QUA-1 or LAT-4, whichever the attribute is under.

    Args:
        lows: smallest integer of each column.
        highs: largest integer of each column.
        record: the attribute.
        at: byte of the file that is to blame.

    Raises:
        FormatError: E_RANGE.
    """
    if record.attribute == _spec.ATTRIBUTE_OPACITIES:
        _check_level(highs[0], 0, record.levels, at, "LEV-1")
    elif record.attribute == _spec.ATTRIBUTE_QUATS:
        for found in (min(lows), max(highs)):
            _check_level(found, -record.levels, record.levels, at, "QUA-1")
    else:
        _check_columns(lows, highs, record, at)


def _check_level(found: int, low: int, high: int, at: int, clause: str) -> None:
    if not low <= found <= high:
        raise FormatError(_spec.ERROR_RANGE, at, clause, "level", found=found, wanted=f"{low} to {high}")


def _check_columns(lows: tuple[int, ...], highs: tuple[int, ...], record: _spec.AttributeRecord, at: int) -> None:
    """LAT-4: each integer, after its chroma shift, is at most COLUMN_MAX in magnitude."""
    for column, (low, high) in enumerate(zip(lows, highs, strict=True)):
        shift = record.chroma_shift if 3 * column >= len(lows) else 0
        found = max(-low, high) << shift
        if found > _spec.COLUMN_MAX:
            raise FormatError(
                _spec.ERROR_RANGE,
                at,
                "LAT-4",
                f"integer of column {column}",
                found=found,
                wanted=f"{_spec.COLUMN_MAX} in magnitude at most",
            )
