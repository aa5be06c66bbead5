# SPDX-License-Identifier: Apache-2.0
"""Measure the errors of decoded splats, which a file declares (spec 5.5).

The encoder measures tile by tile, by the functions on columns; `measured_sums` compares two models.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.portable_math import exp
from csplat.types import F64

Floats = NDArray[Any]

SCALE_MOST = 88.0  # log scale beyond which a standard deviation leaves binary32
_BLOCK = 8192  # splats per block; the temporaries of their covariances fit the second-level cache
_ROUNDING = 2.0**-40  # relative margin for other orders of rounding
_DECLARED_BITS = 24  # significant bits of a declared bound; SER-5 allows to exceed the error by 1e-4 of it


@dataclass(frozen=True)
class ErrorSums:
    """The largest error and the sum of squares of each measure, over `count` splats."""

    count: int = 0
    largest: Mapping[str, float] = field(default_factory=dict)
    squares: Mapping[str, float] = field(default_factory=dict)

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return (max, rms) by measure; the rms is over splats, whose squares are summed over components."""
        count = max(1, self.count)
        return {name: (self.largest[name], float(np.sqrt(self.squares[name] / count))) for name in self.largest}

    def declared(self) -> dict[str, tuple[float, float]]:
        """Return `bounds()` with a margin for verifiers that round in another order (spec SER-5), rounded up.

        Raises:
            InputError: an error is not finite, which a file cannot declare (SER-2).
        """
        result = {}
        for name, (largest, rms) in self.bounds().items():
            floor = _ROUNDING if name == "covariance" else 0.0  # a ratio: its rounding does not shrink with its value
            result[name] = (with_margin(largest + floor), with_margin(rms + floor))
            if not (math.isfinite(result[name][0]) and math.isfinite(result[name][1])):
                raise InputError(f"the error of {name} is too large to declare: the step is too coarse for the values")
        return result

    @staticmethod
    def total(parts: Iterable[ErrorSums]) -> ErrorSums:
        """Add up sums in the given order, so that the result does not depend on threads."""
        count, largest, squares = 0, dict[str, float](), dict[str, float]()
        for part in parts:
            count += part.count
            for name in part.largest:
                largest[name] = max(largest.get(name, 0.0), part.largest[name])
                squares[name] = squares.get(name, 0.0) + part.squares[name]
        return ErrorSums(count, largest, squares)


def with_margin(error: float) -> float:
    """Return an error with a margin for verifiers that round in another order, rounded up to `_DECLARED_BITS`.

    Infinity and NaN, and errors that leave float64 by it, become infinity.
    """
    fraction, exponent = math.frexp(error * (1.0 + _ROUNDING))
    try:
        return math.ldexp(math.ceil(math.ldexp(fraction, _DECLARED_BITS)), exponent - _DECLARED_BITS)
    except (OverflowError, ValueError):
        return math.inf


def take_precise_means(model: SplatModel, rows: NDArray[Any]) -> Floats:
    """Return means of some splats relative to the origin, [n, 3], in float64 if the model has `means_double`."""
    if model.means_double is None:
        return np.take(model.means, rows, axis=0)
    relative: F64 = np.take(model.means_double, rows, axis=0) - np.array(model.origin)
    return relative


def distance_errors(source: Floats, decoded: Floats) -> tuple[float, float]:
    """Return (largest distance, sum of squared distances) of means in columns, [3, n]."""
    difference = decoded.astype(np.float64)
    difference -= source
    largest = float(np.abs(difference).max(initial=0.0))
    if largest == 0.0:
        return 0.0, 0.0
    difference /= largest  # keeps squares of distances such as 1e-200 or 1e200 within float64
    squares = np.square(difference, out=difference).sum(axis=0)
    return largest * float(np.sqrt(squares.max())), largest * largest * float(squares.sum())


def value_errors(source: Floats, decoded: Floats) -> tuple[float, float]:
    """Return (largest difference, sum of squared differences) over all components."""
    largest = squares = 0.0
    source, decoded = source.reshape(-1), decoded.reshape(-1)
    for start in range(0, source.size, 8 * _BLOCK):
        difference = decoded[start : start + 8 * _BLOCK].astype(np.float64)
        difference -= source[start : start + 8 * _BLOCK]
        largest = max(largest, float(difference.max()), -float(difference.min()))
        squares += float(np.square(difference, out=difference).sum())
    return largest, squares


def covariance_errors(
    source_quats: Floats, source_scales: Floats, quats: Floats, scales: Floats
) -> tuple[float, float]:
    """Return (largest, sum of squares) of ‖Σ - Σ'‖ / ‖Σ‖ over splats in columns.

    Args:
        source_quats, quats: [4, n], w x y z, any length above 0.
        source_scales, scales: [3, n], log standard deviations; they are clipped to ± 88 (SER-5).
    """
    # Scales are relative to the source's largest, so that nothing overflows.
    largest = squares = 0.0
    for start in range(0, source_quats.shape[1], _BLOCK):
        part = slice(start, start + _BLOCK)
        reference = np.clip(source_scales[:, part], -SCALE_MOST, SCALE_MOST).astype(np.float64)
        top = reference.max(axis=0)
        reference -= top
        variances = exp(2.0 * reference)
        decoded = exp(2.0 * (np.clip(scales[:, part], -SCALE_MOST, SCALE_MOST) - top))
        difference = covariance_entries(quats[:, part], decoded)
        difference -= covariance_entries(source_quats[:, part], variances)
        with np.errstate(over="ignore"):  # `declared` refuses infinity
            difference *= difference
            difference[3:] *= 2.0  # entries off the diagonal occur twice
            error = difference.sum(axis=0)
        error /= (variances * variances).sum(axis=0)
        squares += float(error.sum())
        largest = max(largest, float(error.max()))
    return float(np.sqrt(largest)), squares


def measured_sums(source: SplatModel, decoded: SplatModel, source_index: NDArray[Any]) -> ErrorSums:
    """Measure the errors of all attributes of a decoded model.

    Args:
        source: the model that was encoded.
        decoded: the decoded model.
        source_index: [len(decoded)] integers, index in the source of each decoded splat.

    Returns:
        Sums of the measures means, covariance, opacities, sh0 to sh4. A band that only one of the two models
        has is compared with 0.

    Raises:
        InputError: the index has another length, or exceeds the source.
    """
    index = np.asarray(source_index)
    if index.shape != (len(decoded),):
        raise InputError(f"source index has shape {index.shape}, expected ({len(decoded)},)")
    if len(index) and not (int(index.min()) >= 0 and int(index.max()) < len(source)):
        raise InputError(f"source index exceeds the source's {len(source)} splats")
    parts = []
    for start in range(0, len(decoded), 4 * _BLOCK):
        part = slice(start, start + 4 * _BLOCK)
        parts.append(_errors_of_rows(source, decoded, index[part], part))
    return ErrorSums.total(parts)


def _errors_of_rows(source: SplatModel, decoded: SplatModel, rows: NDArray[Any], part: slice) -> ErrorSums:
    """Return the errors of the decoded splats `part` against the rows [n] of the source; missing bands are 0."""
    pairs = {
        "means": distance_errors(take_precise_means(source, rows).T, decoded.means[part].T),
        "covariance": covariance_errors(
            source.quats[rows].T, source.scales[rows].T, decoded.quats[part].T, decoded.scales[part].T
        ),
        "opacities": value_errors(source.opacities[rows], decoded.opacities[part]),
        "sh0": value_errors(source.sh0[rows], decoded.sh0[part]),
    }
    for band in range(1, max(source.sh_degree, decoded.sh_degree) + 1):
        span = slice(band * band - 1, (band + 1) * (band + 1) - 1)
        zeros = np.zeros((len(rows), 2 * band + 1, 3), np.float32)
        source_band = source.shN[rows, span] if band <= source.sh_degree else zeros
        decoded_band = decoded.shN[part, span] if band <= decoded.sh_degree else zeros
        pairs[f"sh{band}"] = value_errors(np.ascontiguousarray(source_band), np.ascontiguousarray(decoded_band))
    return ErrorSums(
        len(rows), {name: pair[0] for name, pair in pairs.items()}, {name: pair[1] for name, pair in pairs.items()}
    )


def rotation_rows(quats: Floats) -> tuple[tuple[F64, F64, F64], ...]:
    """Return the rows of rotation matrices, entries [n], of quaternions [4, n] of any length above 0."""
    w, x, y, z = quats.astype(np.float64)
    two = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        (1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)),
        (two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)),
        (two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)),
    )


def covariance_entries(quats: Floats, variances: F64) -> F64:
    """Return the entries xx, yy, zz, xy, xz, yz of Σ, [6, n]."""
    rows = rotation_rows(quats)
    scaled = [tuple(entry * variance for entry, variance in zip(row, variances, strict=True)) for row in rows]
    result = np.empty((6, quats.shape[1]))
    for index, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        a, b = scaled[i], rows[j]
        result[index] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return result
