# SPDX-License-Identifier: CC0-1.0
"""Check the ranges of integers and of the values that they represent (spec 6.4, 7)."""

from __future__ import annotations

import numpy as np

from csplat import _spec
from csplat.types import I64
from csplat_conformance.validator.index import Index, is_finite, scaled_step, value_bits
from csplat_conformance.validator.violation_log import ViolationLog

#: Offset in the file and name of a field to report.
Place = tuple[int, str]


def check_integers(log: ViolationLog, index: Index, attribute: int, rows: I64, exponent: int, where: Place) -> bool:
    """Check the integers of a block, or of its part from one stream or codebook.

    Args:
        log: receives the violations.
        index: index of the file.
        attribute: registry value; not means.
        rows: [C, n] integers, before the lifting of 7.1.
        exponent: exponent of the block.
        where: the field to report.

    Returns:
        True if all clauses that could be checked hold.
    """
    violation_count = len(log.violations)
    placed, levels = index.attributes.get(attribute), index.levels.get(attribute)
    if placed is None or not rows.size:
        return placed is not None
    if _spec.ATTRIBUTE_KIND[attribute] == "lattice":
        _check_lattice_range(log, index, placed.record, rows, exponent, where)
    elif levels is not None:
        check = _check_quat_range if attribute == _spec.ATTRIBUTE_QUATS else _check_level_range
        check(log, rows, levels, where)
    return len(log.violations) == violation_count


def _check_level_range(log: ViolationLog, rows: I64, levels: int, where: Place) -> None:
    """Check LEV-1 of integers [C, n], at least one."""
    highest = int(rows.max())
    if highest > levels:
        log.add("LEV-1", *where, f"a level of {highest}, expected at most {levels}")


def _check_quat_range(log: ViolationLog, rows: I64, levels: int, where: Place) -> None:
    """Check QUA-1 and QUA-2 of integers [3, n]; QUA-2 only if QUA-1 holds."""
    largest = max(abs(int(rows.min())), abs(int(rows.max())))
    if largest > levels:
        log.add("QUA-1", *where, f"a component of magnitude {largest}, expected at most {levels}")
        if largest > _spec.QUAT_LEVELS_MAX:
            return  # squares could overflow 64 bits
    radicands = 2 * levels * levels - np.square(rows).sum(axis=0)
    lowest = int(radicands.min())
    if lowest < 0 and largest <= levels:
        message = f"R is {lowest} for splat {int(radicands.argmin())}, expected 0 or more"
        log.add("QUA-2", *where, message)


def _check_lattice_range(
    log: ViolationLog, index: Index, record: _spec.AttributeRecord, rows: I64, exponent: int, where: Place
) -> None:
    """Check LAT-4 of integers [C, n], at least one each; LAT-5 if it holds and the step is valid."""
    luma_count = len(rows) // 3  # number of Y columns of YCOCG, which precede the Co and Cg columns
    for column, row in enumerate(rows):
        shift = record.chroma_shift if column >= luma_count and record.mapping == _spec.MAPPING_YCOCG else 0
        largest = max(abs(int(row.min())), abs(int(row.max()))) << shift
        if largest > _spec.COLUMN_MAX:
            message = f"column {column} has an integer of magnitude {largest}, expected at most {_spec.COLUMN_MAX}"
            log.add("LAT-4", *where, message)
            return
    step = index.steps.get(record.attribute)
    scale = None if step is None else scaled_step(step, exponent)
    if scale is None:
        return
    if record.mapping == _spec.MAPPING_YCOCG:
        rows = _undo_ycocg(rows, record.chroma_shift)
    for extreme in (int(rows.min()), int(rows.max())):
        if not is_finite(extreme, scale):
            log.add("LAT-5", *where, f"{extreme} x {scale} is not finite in binary32")
            return


def _undo_ycocg(rows: I64, chroma_shift: int) -> I64:
    """Return R, G, B of Y, Co, Cg, [3 K, n] (7.1). LAT-4 bounds all intermediate values by 2^53."""
    y, co, cg = np.split(rows, 3)
    co, cg = co << chroma_shift, cg << chroma_shift
    t = y - (cg >> 1)
    blue = t - (co >> 1)
    return np.concatenate((blue + co, cg + t, blue))


def check_box(log: ViolationLog, record: _spec.TileRecord, rows: I64, box: Place) -> None:
    """Check TIL-10.

    Args:
        log: receives the violations.
        record: the tile record.
        rows: [3, n], the integers q.
        box: the field `corner` of the record.
    """
    lows, highs = rows.min(axis=1).tolist(), rows.max(axis=1).tolist()
    for axis, (low, high, extent) in enumerate(zip(lows, highs, record.extent, strict=True)):
        if low != 0 or high != extent:
            message = f"axis {axis}: q is {low} to {high}, expected 0 to the extent {extent}"
            log.add("TIL-10", *box, message)


def check_max_scale(log: ViolationLog, index: Index, largest: int, exponent: int, stored: bytes, where: Place) -> None:
    """Check TIL-11, if the step is valid, bit for bit: NaN differs from everything, and +0 from −0.

    Args:
        log: receives the violations.
        index: index of the file.
        largest: largest lattice integer of the tile's scales.
        exponent: exponent of their block.
        stored: the four bytes of `max_scale`.
        where: the field `max_scale`.
    """
    step = index.steps.get(_spec.ATTRIBUTE_SCALES)
    scale = None if step is None else scaled_step(step, exponent)
    if scale is None:
        return
    expected = value_bits(largest, scale)
    if expected != stored:
        actual, correct = (float(np.frombuffer(raw, "<f4")[0]) for raw in (stored, expected))
        log.add("TIL-11", *where, f"{actual!r}, expected the largest scale, {correct!r} ({largest} x {scale})")
