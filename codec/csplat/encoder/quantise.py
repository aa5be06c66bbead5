"""Values to lattice integers, and back as the decoder will see them (spec 7).

Arrays are in columns, [C, n]: what the streams want, and what keeps NumPy's inner loops long.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.errors import InputError
from csplat.types import F32, I32, I64

Floats = NDArray[Any]
Integers = NDArray[Any]

_WIDE = _spec.COLUMN_MAX / 2  # lattice integers of scales and colours stay below, with room for rounding
_EXACT32 = 2.0**20  # colours beyond this many steps are quantised in float64
_ROOT2 = float.fromhex("0x1.6A09E667F3BCDp+0")


def lattice_step(step: float, exponent: int) -> float:
    """Return step × 2**exponent, which LAT-1 and TIL-9 want normal and finite: in binary32, and in binary64."""
    return math.ldexp(step, exponent)


def lattice_exponent(largest: float, step: float) -> int:
    """Return the smallest exponent >= 0 at which the integers of scales or colours keep LAT-4.

    Args:
        largest: largest magnitude of the values, in the unit of `step`.
        step: lattice step, > 0.
    """
    ratio = largest / step
    return 0 if ratio < _WIDE else math.ceil(math.log2(ratio / _WIDE)) + 1


def largest_exact(step: float) -> float:
    """Return the magnitude from which on `lattice_exponent` is above 0."""
    return _WIDE * step


def lattice_values(n: Integers, step: float) -> F32:
    """Return float32(float64(n) × step) (spec 7.2)."""
    values = n.astype(np.float64)
    values *= step
    return values.astype(np.float32)


def quantise_means(means: F32, step: float) -> I64:
    """Round centres to the lattice (spec 7.4).

    Args:
        means: [3, n] float32.
        step: the tile's step; |mean| / step stays below 2**53 (the tiling sees to it).

    Returns:
        [3, n] int64. Where rounding up would leave float32, the integer below in magnitude is taken.
    """
    scaled = means.astype(np.float64)
    scaled /= step
    n = np.rint(scaled, out=scaled).astype(np.int64)
    if float(np.abs(means).max(initial=0.0)) > 1e38:
        with np.errstate(over="ignore"):
            n -= np.where(np.isinf(lattice_values(n, step)), np.sign(n), 0)
    return n


def opacity_levels(opacities: F32, levels: int, *, square: bool, multiple: int = 1) -> I32:
    """Round alpha to q / M or q² / M² (spec 7.3).

    Args:
        opacities: [n] float32, 0 to 1.
        levels: M.
        square: the square-root domain, whose levels lie closer near 0.
        multiple: all q but M are multiples of this, >= 1: no other levels, fewer symbols.

    Returns:
        [n] int32, 0 to M; 0 and M exactly for alpha 0 and 1.
    """
    root = np.sqrt(opacities) if square else opacities
    q: I32 = np.rint(root * np.float32(levels / multiple)).astype(np.int32)
    if multiple > 1:
        q *= multiple
        np.copyto(q, levels, where=(q > levels) | (opacities == 1.0))
    return q


def opacity_values(q: I32, levels: int, *, square: bool) -> F32:
    """Return alpha as the decoder computes it (spec 7.3)."""
    table = np.arange(levels + 1, dtype=np.float64)
    table = table * table / np.float64(levels * levels) if square else table / np.float64(levels)
    result: F32 = table.astype(np.float32)[q]
    return result


def quat_levels(rotation: F32, levels: int, multiple: int = 1) -> I32:
    """Round x, y, z of a rotation whose w is the largest component (spec 7.5).

    Args:
        rotation: [4, n] float32, unit length, w >= |x|, |y|, |z|.
        levels: M >= 3.
        multiple: q are multiples of this, 1 to M / 3: no other levels, fewer symbols.

    Returns:
        [3, n] int32 with |q| <= M and q1² + q2² + q3² <= 2 M². Where rounding to the nearest breaks the second
        bound (about w = 0.5 at small M), all three are rounded towards 0.
    """
    scaled = rotation[1:] * np.float32(levels * _ROOT2 / multiple)
    most = levels // multiple
    q: I32 = np.rint(scaled).astype(np.int32)
    np.clip(q, -most, most, out=q)
    negative = (q * q).sum(axis=0, dtype=np.int64) * multiple**2 > 2 * levels * levels
    if negative.any():
        q[:, negative] = np.trunc(scaled[:, negative]).astype(np.int32)
    return q if multiple == 1 else q * np.int32(multiple)


def quat_values(q: I32, levels: int) -> F32:
    """Return w, x, y, z as the decoder computes them (spec 7.5), [4, n] float32."""
    c = 1.0 / (np.float64(levels) * _ROOT2)
    wide = q.astype(np.float64)
    rest = 2.0 * levels * levels - (wide * wide).sum(axis=0)
    values = np.empty((4, q.shape[1]), np.float32)
    values[0] = np.sqrt(rest) * c
    values[1:] = wide * c
    return values


def colour_integers(rgb: Floats, shift: int, coarse: I32 | None = None) -> Integers:
    """Round colours to luma and chroma integers (spec 7.1).

    Args:
        rgb: [3, ..., n] float32 or float64, in lattice steps, below 2**30 in magnitude.
        shift: Co and Cg are coarser by 2**shift.
        coarse: [n], splats rounded to multiples of 2**coarse steps: no other lattice, fewer symbols.

    Returns:
        [3, ..., n] Y, Co, Cg; int32, or int64 where 32 bits would not do. Y is the integer that brings R + G + B
        nearest to the source's, given the rounded chroma.
    """
    wide = float(np.abs(rgb).max(initial=0.0)) >= _EXACT32
    r, g, b = rgb.astype(np.float64) if wide else rgb
    kind = np.int64 if wide else np.int32
    real = r.dtype.type
    co = _round((r - b) * real(0.5**shift), kind, coarse)
    cg = _round((g - (r + b) * real(0.5)) * real(0.5**shift), kind, coarse)
    full_co, full_cg = co << shift, cg << shift
    rest = r + g + b
    rest -= full_cg + full_co - 2 * (full_co >> 1)
    rest /= real(3)
    rest += full_cg >> 1
    return np.stack([_round(rest, kind, coarse), co, cg])


def colour_lifted(columns: Integers, shift: int) -> Integers:
    """Return R, G, B integers from Y, Co, Cg (spec 7.1), [3, ...] of the same dtype."""
    y, co, cg = columns
    co, cg = co << shift, cg << shift
    t = y - (cg >> 1)
    b = t - (co >> 1)
    return np.stack([b + co, cg + t, b])


def _round(values: Floats, kind: type[np.signedinteger[Any]], coarse: I32 | None = None) -> Integers:
    if coarse is None:
        result: Integers = np.rint(values).astype(kind)
        return result
    rounded: Integers = np.rint(values * np.ldexp(values.dtype.type(1), -coarse)).astype(kind)
    return rounded << coarse.astype(kind)


def check_finite(name: str, values: F32) -> None:
    """Refuse what no lattice integer can bring back into float32."""
    if not np.isfinite(values).all():
        raise InputError(f"{name} too large to quantise: values at the end of float32's range")
