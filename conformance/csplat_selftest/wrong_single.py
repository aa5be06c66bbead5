"""Mistakes of decoders in single precision, judged by the class *renderer*; and one that makes none."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Final

import numpy as np

from csplat import _spec
from csplat.decoder import reconstruct
from csplat.errors import FormatError
from csplat_conformance.single_precision import GPUS, GpuArithmetic, lattice_values, opacities, quats
from csplat_conformance.tolerance import RENDERER
from csplat_selftest.mistakes import Mistake, Wrong, nothing, replaced

Apply = Callable[[ExitStack], None]


def single_precision(gpu: GpuArithmetic) -> Apply:
    """Return what makes the Python decoder compute section 7 as a GPU does, and as CNF-7 allows."""

    def lattice(_right: Wrong, integers: Any, step: float, out: Any, **_options: Any) -> None:
        out[...] = lattice_values(integers.astype(np.int64), step, 0, gpu)

    def table(_right: Wrong, record: _spec.AttributeRecord) -> Any:
        return opacities(np.arange(record.levels + 1), record, gpu)

    def rotations(_right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
        for start, stop, q, _ in reconstruct.quat_rows(block, record, len(out)):
            out[start:stop] = quats(q.T.astype(np.int64), record.levels, gpu)

    parts = (replaced("_scale", lattice), replaced("opacity_table", table), replaced("write_quats", rotations))
    return _all(*parts)


def off_by(ulps: int) -> Apply:
    """Return a mistake that makes means, scales and colours larger by `ulps` ulps of binary32."""

    def wrong(right: Wrong, integers: Any, step: float, out: Any, **options: Any) -> None:
        right(integers, step, out, **options)
        for _ in range(ulps):
            out[...] = np.where(np.abs(out) < np.finfo(np.float32).max, np.nextafter(out, np.float32(np.inf)), out)

    return replaced("_scale", wrong)


def _all(*parts: Apply) -> Apply:
    def apply(stack: ExitStack) -> None:
        for part in parts:
            part(stack)

    return apply


def _corner_as_float(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> int:
    """Add corner × s, exact but for one rounding, and q × s."""
    largest: int = right(block, record, out)
    if record.attribute == _spec.ATTRIBUTE_MEANS:
        step = math.ldexp(record.step, block.exponent)
        for axis, offset in enumerate(block.offsets):
            out[:, axis] = np.float32(offset * step) + block.elements[axis].astype(np.float32) * np.float32(step)
    return largest


def _rounded_radicand(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    right(block, record, out)
    twice = np.float32(2 * record.levels**2)
    for start, stop, q, _ in reconstruct.quat_rows(block, record, len(out)):
        a, b, c = (q.astype(np.float32)) ** 2
        out[start:stop, 0] = np.sqrt(np.maximum(twice - a - b - c, 0)) * np.float32(1 / (record.levels * math.sqrt(2)))


def _rest_of_unit(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    right(block, record, out)
    x, y, z = out[:, 1:].T
    out[:, 0] = np.sqrt(np.maximum(np.float32(1) - x * x - y * y - z * z, 0))


def _half_precision(right: Wrong, record: _spec.AttributeRecord) -> Any:
    return right(record).astype(np.float16).astype(np.float32)


def _overflowing(_right: Wrong, integers: Any, step: float, out: Any, **_options: Any) -> None:
    with np.errstate(over="ignore"):
        out[...] = integers.astype(np.float32) * np.float32(step)


def _checked_when_rounded(_right: Wrong, parts: Any, step: float, record: Any, at: int) -> None:
    """Ask whether the values in single precision are finite."""
    with np.errstate(over="ignore"):
        finite = all(np.isfinite(part.astype(np.float32) * np.float32(step)).all() for part in parts)
    if not finite:
        raise FormatError(_spec.ERROR_RANGE, at, "MEA-1", _spec.ATTRIBUTE_NAMES[record.attribute])


def _never(_right: Wrong, _integer: int, _step: float) -> bool:
    return False


def _mistake(name: str, what: str, clause: str, apply: Apply) -> Mistake:
    return Mistake(f"renderer: {name}", what, clause, apply, RENDERER)


MISTAKES: Final = (
    _mistake("3 ulp", "values of lattices", "CNF-7", off_by(3)),
    _mistake("corner as float", "corner and rest meet as floats", "CNF-7", replaced("write_lattice", _corner_as_float)),
    _mistake("radicand", "R of squares in binary32", "CNF-7", replaced("write_quats", _rounded_radicand)),
    _mistake("rest of a unit", "w as √(1 − x² − y² − z²)", "CNF-7", replaced("write_quats", _rest_of_unit)),
    _mistake("half precision", "opacities of 16 bits", "CNF-7", replaced("opacity_table", _half_precision)),
    _mistake("overflow", "a product beyond the largest number is infinite", "CNF-7", replaced("_scale", _overflowing)),
    _mistake(
        "range by rounded values",
        "refuses what overflows in single precision",
        "CNF-8",
        _all(replaced("_is_finite", _never), replaced("_check_finite", _checked_when_rounded)),
    ),
    _mistake(
        "range by cut values",
        "a GPU that cuts products has no infinite ones, and the range is not looked at",
        "CNF-8",
        _all(replaced("_check_finite", nothing), single_precision(GPUS["WGSL"][1])),
    ),
)
