# SPDX-License-Identifier: Apache-2.0
"""Quantise values to lattice integers, and dequantise them as a decoder does (spec 7).

Arrays are in columns, [C, n], in the order of the streams; NumPy's inner loops are then long.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder.coding_parameters import CodingParameters
from csplat.errors import InputError
from csplat.portable_math import ceil_log2
from csplat.types import F32, I32, I64

Floats = NDArray[Any]
Integers = NDArray[Any]

_WIDE = _spec.COLUMN_MAX / 2  # maximum integer of scales and colours; half of LAT-4's bound, to allow for rounding
#: Magnitude below which the nearest multiple of a step is finite in float32, since it is at most twice the value.
_SAFE32 = 1e38
_EXACT32 = 2.0**20  # steps from which colours are quantised in float64
_ROWS = 2048  # splats per block; rows of 45 floats and their columns fit the second-level cache
_ROOT2 = float.fromhex("0x1.6A09E667F3BCDp+0")  # spec 7.5

#: Largest distance from a lattice point, in steps, of values that were computed from its integer in float32.
LATTICE_TOLERANCE = 0.00025

Quaternion = tuple[F32, F32, F32, F32]


def lattice_exponent(largest: float, step: float) -> int:
    """Return the smallest exponent >= 0 at which scales or colours of this largest magnitude satisfy LAT-4."""
    ratio = largest / step
    return 0 if ratio < _WIDE else ceil_log2(ratio / _WIDE) + 1


def largest_exact(step: float) -> float:
    """Return the magnitude from which `lattice_exponent` is positive."""
    return _WIDE * step


def lattice_values(n: Integers, step: float) -> F32:
    """Return float32(float64(n) × step) (spec 7.2)."""
    values = n.astype(np.float64)
    values *= step
    return values.astype(np.float32)


def quantise_means(means: F32, step: float) -> I64:
    """Round means to the lattice (spec 7.4).

    Args:
        means: [3, n] float32.
        step: step of the tile; `tile_exponent` keeps |mean| / step below 2**53.

    Returns:
        [3, n] int64; rounded towards 0 if the nearest value is beyond float32.
    """
    scaled = means.astype(np.float64)
    scaled /= step
    n = np.rint(scaled, out=scaled).astype(np.int64)
    if float(np.abs(means).max(initial=0.0)) > _SAFE32:
        with np.errstate(over="ignore"):
            # One step suffices: a nearest multiple beyond float32 exceeds the mean by at most half a step.
            n -= np.where(np.isinf(lattice_values(n, step)), np.sign(n), 0)
    return n


def opacity_levels(opacities: F32, levels: int, *, square: bool, multiple: int = 1) -> I32:
    """Round alpha to q / M or q² / M² (spec 7.3).

    Args:
        opacities: [n] float32, 0 to 1.
        levels: M.
        square: the mapping is SQUARE: levels are equidistant in the square root of alpha.
        multiple: round all q except M to multiples of this, >= 1, which leaves fewer symbols.

    Returns:
        [n] int32, 0 to M. Alpha 0 and 1 are exact.
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
        multiple: round q to multiples of this, 1 to M / 3, which leaves fewer symbols.

    Returns:
        [3, n] int32 with |q| <= M and q1² + q2² + q3² <= 2 M². If rounding to nearest violates the second bound
        (near w = 0.5, for small M), all three are rounded towards 0.
    """
    scaled = rotation[1:] * np.float32(levels * _ROOT2 / multiple)
    q_max = levels // multiple
    q: I32 = np.rint(scaled).astype(np.int32)
    np.clip(q, -q_max, q_max, out=q)
    negative = (q * q).sum(axis=0, dtype=np.int64) * multiple**2 > 2 * levels * levels
    if negative.any():
        q[:, negative] = np.trunc(scaled[:, negative]).astype(np.int32)
    return q if multiple == 1 else q * np.int32(multiple)


def quat_values(q: I32, levels: int) -> F32:
    """Return w, x, y, z as the decoder computes them (spec 7.5), [4, n] float32."""
    c = 1.0 / (np.float64(levels) * _ROOT2)
    wide = q.astype(np.float64)
    w_squared = 2.0 * levels * levels - (wide * wide).sum(axis=0)
    values = np.empty((4, q.shape[1]), np.float32)
    values[0] = np.sqrt(w_squared) * c
    values[1:] = wide * c
    return values


def colour_integers(rgb: Floats, shift: int, coarse: I32 | None = None) -> Integers:
    """Round colours to luma and chroma integers (spec 7.1).

    With the rounded chroma, Co ≈ R - B and Cg ≈ G - (R + B) / 2, Y is chosen to bring the decoded sum
        R + G + B = 3 (Y - (Cg >> 1)) + Cg + Co - 2 (Co >> 1)
    closest to the source's.

    Args:
        rgb: [3, ..., n] float32 or float64, in lattice steps, below 2**30 in magnitude.
        shift: Co and Cg are coarser by 2**shift.
        coarse: [n], exponents; splats are rounded to multiples of 2**coarse steps, which leaves fewer symbols.

    Returns:
        [3, ..., n] Y, Co, Cg; int32, or int64 if 32 bits are too few.
    """
    wide = float(np.abs(rgb).max(initial=0.0)) >= _EXACT32
    r, g, b = rgb.astype(np.float64) if wide else rgb
    kind = np.int64 if wide else np.int32
    real = r.dtype.type
    co = _round_multiples((r - b) * real(0.5**shift), kind, coarse)
    if shift or coarse is not None:
        cg = _round_multiples((g - (r + b) * real(0.5)) * real(0.5**shift), kind, coarse)
    else:  # halves are rounded up, which reproduces integers exactly (encoders.md, E.2)
        cg = np.floor(g - (r + b) * real(0.5) + real(0.5)).astype(kind)
    full_co, full_cg = co << shift, cg << shift
    luma = r + g + b
    luma -= full_cg + full_co - 2 * (full_co >> 1)
    luma /= real(3)
    luma += full_cg >> 1
    return np.stack([_round_multiples(luma, kind, coarse), co, cg])


def lift_colour(columns: Integers, shift: int) -> Integers:
    """Return the R, G, B integers of Y, Co, Cg (spec 7.1), [3, ...]."""
    y, co, cg = columns
    co, cg = co << shift, cg << shift
    t = y - (cg >> 1)
    b = t - (co >> 1)
    return np.stack([b + co, cg + t, b])


def _round_multiples(values: Floats, kind: type[np.signedinteger[Any]], coarse: I32 | None = None) -> Integers:
    """Round values [..., n] to integers, multiples of 2**coarse, [n]; `None`: to any integers."""
    if coarse is None:
        result: Integers = np.rint(values).astype(kind)
        return result
    rounded: Integers = np.rint(values * np.ldexp(values.dtype.type(1), -coarse)).astype(kind)
    return rounded << coarse.astype(kind)


def check_finite(name: str, values: F32) -> None:
    """Raise an `InputError` if decoded values are beyond float32."""
    if not np.isfinite(values).all():
        raise InputError(f"{name} are too large to quantise: values at the limit of float32")


def quantise_colour(rgb: F32, step: float, shift: int, coarse: int = 0) -> tuple[Integers, int, F32]:
    """Quantise colours [3, ..., n] to multiples of step × 2**coarse, or of a coarser step that satisfies LAT-4.

    Returns:
        Y, Co, Cg columns; the exponent of their lattice; decoded colours.
    """
    exponent = max(coarse, lattice_exponent(2.0 * float(np.abs(rgb).max(initial=0.0)), step))
    tile_step = math.ldexp(step, exponent)
    real = np.float32 if exponent == 0 else np.float64
    columns = colour_integers(rgb * real(1.0 / tile_step), shift)
    return columns, exponent, lattice_values(lift_colour(columns, shift), tile_step)


def quantise_sh(source: F32, parameters: CodingParameters, coarse: I32 | None) -> tuple[Integers, int, F32]:
    """Quantise SH without a codebook.

    Args:
        source: [n, K, 3] float32.
        parameters: step and chroma shift.
        coarse: [n], see `colour_integers`; `None`: 0.

    Returns:
        Y, Co, Cg columns [3, K, n] of the narrowest dtype; the exponent of the tile's lattice; decoded values
        [n, K, 3] float32.
    """
    n, coefficients, _ = source.shape
    largest = max(abs(float(source.max(initial=0.0))), abs(float(source.min(initial=0.0))))
    exponent = lattice_exponent(2.0 * largest, parameters.sh_step)
    step = math.ldexp(parameters.sh_step, exponent)
    coarsest = 0 if coarse is None else int(coarse.max(initial=0))
    columns = np.empty((3, coefficients, n), _narrowest(2.0 * largest / step + 1.0 + 2.0**coarsest))
    decoded = np.empty(source.shape, np.float32)
    real = np.float32 if exponent == 0 else np.float64
    for start in range(0, n, _ROWS):
        part = slice(start, start + _ROWS)
        rgb = np.ascontiguousarray(source[part].transpose(2, 1, 0))
        multiples = None if coarse is None else coarse[part]
        quantised = colour_integers(rgb * real(1.0 / step), parameters.chroma_shift, multiples)
        columns[:, :, part] = quantised
        decoded[part] = lattice_values(lift_colour(quantised, parameters.chroma_shift), step).transpose(2, 1, 0)
    check_finite("shN", decoded)
    return columns, exponent, decoded


def _narrowest(largest: float) -> type[np.signedinteger[Any]]:
    """Return the narrowest of int8, int16 and int32 that holds every integer of a magnitude up to `largest`."""
    return np.int8 if largest < 127 else np.int16 if largest < 32767 else np.int32


def canonicalise_shape(quats: F32, scales: F32) -> tuple[F32, F32]:
    """Bring shapes into canonical axis order: scales descending, w the largest component of the rotation.

    Permuting the axes of an ellipsoid, or turning it by 180° about an axis, changes rotation and scales but not the
    covariance: 24 pairs, with two signs of the quaternion each, describe the same ellipsoid. In canonical order, the
    coding needs no index of the quaternion's largest component.

    Args:
        quats: [n, 4] float32, w x y z, unit length within 1e-3.
        scales: [n, 3] float32, log standard deviations.

    Returns:
        [4, n] float32 rotation in columns, unit length, w >= |x|, |y|, |z|; [3, n] float32 scales in columns. The
        covariances are unchanged.
    """
    w, x, y, z = (np.ascontiguousarray(quats[:, i]) for i in range(4))
    a, b, c = (np.ascontiguousarray(scales[:, i]) for i in range(3))
    # Turns by 180° about x+y, y+z and x+y exchange two axes each. They are right products with (0, 1, 1, 0) and
    # (0, 0, 1, 1), divided by √2.
    for axes in ((0, 1), (1, 2), (0, 1)):
        first, second = (a, b) if axes == (0, 1) else (b, c)
        swap = first < second
        low, high = np.minimum(first, second), np.maximum(first, second)
        if axes == (0, 1):
            a, b = high, low
            turned = (-(x + y), w - z, w + z, x - y)
        else:
            b, c = high, low
            turned = (-(y + z), y - z, w - x, w + x)
        w, x, y, z = _exchange_axes(swap, turned, (w, x, y, z))
    return _rotation_led_by((np.abs(w), np.abs(x), np.abs(y), np.abs(z)), (w, x, y, z)), np.stack([a, b, c])


def rotation_on_lattice(quats: F32, levels: int) -> F32:
    """Return rotations of a quantised source whose x, y and z are multiples of √½ / levels, if it has such.

    SPZ and SOG store three components as such multiples. The fourth follows from their length, and may be smaller than
    one of them. The axes keep their order.

    Args:
        quats: [n, 4] float32, w x y z, unit length within 1e-3.
        levels: M.

    Returns:
        [4, n] float32, unit length, w >= 0: of four equal rotations, the one whose w is on no lattice point or, if all
        components are on one, the largest.
    """
    columns = np.ascontiguousarray(quats.T)
    scaled = np.abs(columns) * np.float32(levels * _ROOT2)
    keys = np.abs(columns) + np.float32(2) * (np.abs(scaled - np.rint(scaled)) > LATTICE_TOLERANCE)
    return _rotation_led_by((keys[0], keys[1], keys[2], keys[3]), (columns[0], columns[1], columns[2], columns[3]))


def _exchange_axes(swap: NDArray[np.bool_], turned: Quaternion, kept: Quaternion) -> Quaternion:
    """Select turned rotations, normalised, if `swap` [N], and kept rotations otherwise; components are [N]."""
    root = np.float32(np.sqrt(0.5))
    w, x, y, z = (np.where(swap, new * root, old) for new, old in zip(turned, kept, strict=True))
    return w, x, y, z


def _rotation_led_by(keys: Quaternion, quat: Quaternion) -> F32:
    """Multiply quaternions, [N] per component, from the right by 1, i, j or k so that w is the one of the largest key.

    Of equal keys, that of w is preferred, then z, then y.

    Returns:
        [4, N], unit length, w >= 0.
    """
    (aw, ax, ay, az), (w, x, y, z) = keys, quat
    x_leads = ax > np.maximum(aw, np.maximum(ay, az))
    y_leads = ~x_leads & (ay > np.maximum(aw, az))
    z_leads = ~x_leads & ~y_leads & (az > aw)
    new_w = np.where(x_leads, -x, np.where(y_leads, -y, np.where(z_leads, -z, w)))
    new_x = np.where(x_leads, w, np.where(y_leads, -z, np.where(z_leads, y, x)))
    new_y = np.where(x_leads, z, np.where(y_leads, w, np.where(z_leads, -x, y)))
    new_z = np.where(x_leads, -y, np.where(y_leads, x, np.where(z_leads, w, z)))
    length = np.sqrt(new_w * new_w + new_x * new_x + new_y * new_y + new_z * new_z)
    np.copysign(length, new_w, out=length)
    rotation = np.stack([new_w, new_x, new_y, new_z])
    rotation /= length
    return rotation
