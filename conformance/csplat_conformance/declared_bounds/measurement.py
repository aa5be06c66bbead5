# SPDX-License-Identifier: CC0-1.0
"""Measure the differences between decoded splats and their source splats (spec 5.5, 5.6).

The code is independent of the encoder's, so that each reveals errors of the other. Arithmetic is float64, in blocks
that fit the cache. Sums do not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.types import F32, F64

_LOG_SCALE_MAX = 88.0  # largest magnitude of a log scale; larger values are clamped to it (5.5)
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@dataclass(frozen=True, eq=False)
class Source:
    """The scene that a file was encoded from: M splats (spec 5.6) of SH degree 0 to 4.

    Attributes:
        means: [M, 3] float32 or float64, centres relative to `origin`.
        quats: [M, 4] float32, w x y z, divided by their lengths and rounded.
        scales: [M, 3] float32, logarithms.
        opacities: [M] float32, alpha: the logistic function of the logit, rounded.
        sh0: [M, 3] float32.
        shN: [M, K, 3] float32, K = (d + 1)² − 1.
        origin: offset to add to `means`, float64.
        extra: further columns by name, [M].
    """

    means: NDArray[Any]
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, model: SplatModel) -> Source:
        """Return a model as a source, with the model's centres in float64 if it has them."""
        doubles = model.means_double
        return cls(
            model.means if doubles is None else doubles,
            model.quats,
            model.scales,
            model.opacities,
            model.sh0,
            model.shN,
            model.origin if doubles is None else (0.0, 0.0, 0.0),
            model.extra,
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """The SH degree, 0 to 4."""
        return math.isqrt(self.shN.shape[1] + 1) - 1

    def about(self, origin: tuple[float, float, float]) -> Source:
        """Return the same splats with centres relative to another origin."""
        if origin == self.origin:
            return self
        means = self.means.astype(np.float64) + np.subtract(self.origin, origin)
        return replace(self, means=means, origin=origin)

    def select(self, rows: NDArray[Any]) -> Source:
        """Return the splats of the given rows, in that order."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in _ARRAYS}
        return replace(self, **arrays, extra={name: column[rows] for name, column in self.extra.items()})

    @staticmethod
    def concatenate(parts: Sequence[Source]) -> Source:
        """Return the splats of one or more parts, in order."""
        first = parts[0]
        arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        extra = {name: np.concatenate([part.extra[name] for part in parts]) for name in first.extra}
        return replace(first, **arrays, extra=extra)

    def to_model(self, origin: tuple[float, float, float]) -> SplatModel:
        """Return a model to render: centres in float32 relative to a file's origin, SH degree 4 at most.

        Scales beyond ±88, which include the logarithm of 0, are those that count (5.5).
        """
        near = self.about(origin)
        with np.errstate(over="ignore"):  # SplatModel refuses values beyond float32
            means = near.means.astype(np.float32)
        return SplatModel(
            means,
            self.quats,
            np.clip(self.scales, -_LOG_SCALE_MAX, _LOG_SCALE_MAX),
            self.opacities,
            self.sh0,
            np.ascontiguousarray(self.shN[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]),
            origin,
        )

    def reach(self, origin: tuple[float, float, float]) -> float:
        """Return the largest magnitude of the coordinates and of a file's origin, in scene units."""
        farthest = 0.0
        for axis in range(3):
            column, own = self.means[:, axis], self.origin[axis]
            ends = (float(column.min(initial=0.0)) + own, float(column.max(initial=0.0)) + own, own, origin[axis])
            farthest = max(farthest, *map(abs, ends))
        return farthest


SplatRows = NDArray[Any]  # integers, indices of splats

_NORMALS = frozenset(("nx", "ny", "nz"))
_BLOCK = 4096  # splats per block; their 72 float64 SH coefficients of degree 4 take 2.4 MB


class MeasuredError(NamedTuple):
    """The errors of one measure.

    Attributes:
        max: largest error.
        rms: root mean square over the splats.
        worst: index of the decoded splat with the largest error; 0 if there are no splats.
    """

    max: float
    rms: float
    worst: int


class PairErrors(NamedTuple):
    """The errors of known pairs of splats.

    Attributes:
        measured: errors by measure.
        extras: a line for each extra column that differs.
        reach: see `bound_tolerance`.
    """

    measured: dict[str, MeasuredError]
    extras: list[str]
    reach: float


def measure_names(source: Source | SplatModel, decoded: SplatModel) -> list[str]:
    """Return the measures that apply to a source and a decoded file, in the order of the registry."""
    return ["means", "covariance", "opacities", "sh0", *(f"sh{band}" for band in _bands(source, decoded))]


def _bands(source: Source | SplatModel, decoded: SplatModel) -> range:
    """Return the SH bands that have a measure and that at least one of the two scenes has."""
    return range(1, min(_spec.SH_DEGREE_MAX, max(source.sh_degree, decoded.sh_degree)) + 1)


def measure_pairs(
    source: Source, decoded: SplatModel, source_index: SplatRows, *, context: Context = DEFAULT_CONTEXT
) -> dict[str, MeasuredError]:
    """Measure the errors of decoded splats compared with their source splats.

    Args:
        source: the encoded scene.
        decoded: the decoded file, N splats.
        source_index: [N] integers; decoded splat i was source splat `source_index[i]`.
        context: threads.

    Returns:
        The errors by measure. The maximum is over components; the square of a vector is the sum over components. A
        band that only one scene has counts as zero in the other.

    Raises:
        InputError: `source_index` is not one valid index for each decoded splat.
    """
    check_source_index(source_index, len(source), len(decoded), once=False)

    def measure_block(start: int) -> dict[str, tuple[float, float, int]]:
        rows = slice(start, min(start + _BLOCK, len(decoded)))
        errors = pair_differences(source, decoded, source_index[rows], rows)
        return {name: _reduce_errors(values, start) for name, values in errors.items()}

    with ThreadPoolExecutor(context.threads) as pool:
        blocks = list(pool.map(measure_block, range(0, len(decoded), _BLOCK)))
    return {
        name: _combine_blocks([block[name] for block in blocks], len(decoded))
        for name in measure_names(source, decoded)
    }


def merge_errors(parts: Sequence[tuple[int, int, dict[str, MeasuredError]]]) -> dict[str, MeasuredError]:
    """Merge the errors of parts of a scene.

    Args:
        parts: first splat, number of splats and errors of each part; at least one part.
    """
    return {
        name: _combine_blocks(
            [
                (errors[name].max, errors[name].rms * errors[name].rms * count, start + errors[name].worst)
                for start, count, errors in parts
            ],
            sum(count for _, count, _ in parts),
        )
        for name in parts[0][2]
    }


def _combine_blocks(blocks: list[tuple[float, float, int]], count: int) -> MeasuredError:
    """Combine the results of `_reduce_errors` for the blocks of `count` splats; zeros without splats.

    The rms is infinite if the sum of squares is.
    """
    largest, _, worst = max(blocks, key=lambda block: block[0], default=(0.0, 0.0, 0))
    try:
        squares = math.fsum(block[1] for block in blocks)
    except OverflowError:
        squares = math.inf
    return MeasuredError(largest, math.sqrt(squares / max(1, count)), worst)


def pair_differences(
    source: Source,
    decoded: SplatModel,
    source_rows: SplatRows,
    decoded_rows: SplatRows | slice,
    names: Collection[str] | None = None,
) -> dict[str, F64]:
    """Compute the differences of pairs of splats by measure.

    Args:
        source: the encoded scene.
        decoded: the decoded file; its origin may differ.
        source_rows, decoded_rows: n splats each; pair k is splat k of both.
        names: names of the measures to compute; `None`: all of `measure_names`.

    Returns:
        [n, C] by measure: the distance of the centres, the relative Frobenius distance of the
        covariances and the difference of alpha (C = 1), the differences of the coefficients
        (C = 3 for sh0, 3 (2l + 1) for band l).
    """
    result = {}
    for name in measure_names(source, decoded):
        if names is not None and name not in names:
            continue
        if name == "means":
            values = _distances(source, decoded, source_rows, decoded_rows)
        elif name == "covariance":
            values = _covariance_errors(source, decoded, source_rows, decoded_rows)
        elif name == "opacities":
            values = _subtract(decoded.opacities[decoded_rows], source.opacities[source_rows])
        elif name == "sh0":
            values = _subtract(decoded.sh0[decoded_rows], source.sh0[source_rows])
        else:
            band = int(name.removeprefix("sh"))
            values = _subtract(_band(decoded, decoded_rows, band), _band(source, source_rows, band))
        result[name] = values.reshape(len(values), -1)
    return result


def check_source_index(
    index: SplatRows, source_count: int, decoded_count: int, *, once: bool = True, block: int = 1 << 20
) -> None:
    """Check that an array is a source index (SRC-4).

    Args:
        index: an array of any type and shape.
        source_count: splats of the source.
        decoded_count: splats of the file.
        once: require that no number occurs twice.
        block: numbers to check at a time.

    Raises:
        InputError: the array does not have an index of a source splat for each splat of the file, or an index occurs
            twice.
    """
    if index.shape != (decoded_count,) or index.dtype.kind not in "iu":
        actual = f"{index.dtype} of shape {list(index.shape)}"
        raise InputError(f"the source index is {actual}, expected integers of shape [{decoded_count}]")
    seen = np.zeros(source_count if once else 0, bool)
    for start in range(0, decoded_count, block):  # the index may be larger than memory
        part = index[start : start + block]
        outside = (part < 0) | (part >= source_count)
        if outside.any():
            first = int(outside.argmax())
            what = f"splat {start + first} is {part[first]}, expected 0 to {source_count - 1}"
            raise InputError(f"the source index of {what}")
        if once:
            values = np.sort(part)
            again = np.concatenate([values[1:][values[1:] == values[:-1]], part[seen[part]]])
            if len(again):
                first, second = np.flatnonzero(index == again[0])[:2]
                raise InputError(f"splats {first} and {second} both have the source index {again[0]}")
            seen[part] = True


def _reduce_errors(values: F64, start: int) -> tuple[float, float, int]:
    """Return the largest magnitude in [n, C], n > 0, the sum of squares, and the splat of the largest magnitude.

    `start` is the index of the first of the n splats.

    BLAS is not used, because its sums depend on the number of threads.
    """
    magnitudes = np.abs(values)
    worst = int(magnitudes.argmax())
    with np.errstate(over="ignore"):
        squares = float(np.square(values).sum())
    return float(magnitudes.flat[worst]), squares, start + worst // values.shape[1]


def _subtract(a: NDArray[Any], b: NDArray[Any]) -> F64:
    """Return a - b, computed in float64."""
    result: F64 = np.subtract(a, b, dtype=np.float64)
    return result


def _band(model: Source | SplatModel, rows: SplatRows | slice, band: int) -> F32:
    """Return the coefficients of a band, [n, 2l + 1, 3]; zeros, [1, 2l + 1, 3], if the scene lacks it."""
    if band > model.sh_degree:
        return np.zeros((1, 2 * band + 1, 3), np.float32)
    return model.shN[rows, band * band - 1 : (band + 1) ** 2 - 1]


def _distances(source: Source, decoded: SplatModel, source_rows: SplatRows, decoded_rows: SplatRows | slice) -> F64:
    """Return the distances between the centres of pairs, [n]."""
    moved = _subtract(decoded.means[decoded_rows], source.means[source_rows])
    shift = np.subtract(decoded.origin, source.origin)
    if shift.any():
        moved += shift
    # Squares of float32 values neither overflow nor vanish in float64, but an origin of 1e200 overflows.
    with np.errstate(over="ignore"):
        distances: F64 = np.sqrt(np.einsum("ij,ij->i", moved, moved))
    return distances


def _covariance_errors(
    source: Source, decoded: SplatModel, source_rows: SplatRows, decoded_rows: SplatRows | slice
) -> F64:
    """Compute |S' - S| / |S|, [n], of the covariances S' of the file and S of the source (5.5)."""
    scales = source.scales[source_rows].clip(-_LOG_SCALE_MAX, _LOG_SCALE_MAX)
    x, y, z = scales.T  # NumPy is slow along an axis of three
    largest = np.maximum(np.maximum(x, y), z).astype(np.float64)
    theirs = _covariances(source.quats[source_rows], scales, largest)
    decoded_scales = decoded.scales[decoded_rows].clip(-_LOG_SCALE_MAX, _LOG_SCALE_MAX)
    ours = _covariances(decoded.quats[decoded_rows], decoded_scales, largest)
    error: F64 = _frobenius(ours - theirs) / _frobenius(theirs)  # the norm is at least 1
    return error


def _covariances(quats: F32, scales: F32, largest: F64) -> F64:
    """Return xx, yy, zz, xy, xz, yz of R diag(e^(2 (scales - largest))) Rᵀ, [6, n].

    Args:
        quats: [n, 4].
        scales: [n, 3], logarithms.
        largest: [n], logarithm of the unit, so that no variance overflows.
    """
    w, x, y, z = quats.T.astype(np.float64)
    f = 2.0 / (w * w + x * x + y * y + z * z)  # quaternions are unit only within a tolerance
    xx, yy, zz = f * x * x, f * y * y, f * z * z
    xy, xz, yz = f * x * y, f * x * z, f * y * z
    wx, wy, wz = f * w * x, f * w * y, f * w * z
    rotation = (
        (1.0 - yy - zz, xy - wz, xz + wy),
        (xy + wz, 1.0 - xx - zz, yz - wx),
        (xz - wy, yz + wx, 1.0 - xx - yy),
    )
    variances = np.exp(2.0 * (scales.T - largest))
    entries = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    stacked: F64 = np.stack([_entry(rotation[i], rotation[j], variances) for i, j in entries])
    return stacked


def _entry(a: tuple[F64, F64, F64], b: tuple[F64, F64, F64], variances: F64) -> F64:
    """Return a · diag(variances) · b, [n], for two rows of a rotation and [3, n] variances."""
    entry: F64 = a[0] * b[0] * variances[0] + a[1] * b[1] * variances[1] + a[2] * b[2] * variances[2]
    return entry


def _frobenius(entries: F64) -> F64:
    """Return the norms, [n], of symmetric matrices given by the entries of `_covariances`, [6, n]."""
    squares = np.square(entries)
    norms: F64 = np.sqrt(squares[:3].sum(axis=0) + 2.0 * squares[3:].sum(axis=0))
    return norms


def find_wrong_extras(source: Source, decoded: SplatModel, source_index: SplatRows) -> list[str]:
    """Return a line for each extra column of a file that differs from its source (SRC-3).

    Normals are not compared: any splat PLY may contain them, but splats do not use them.
    """
    lines = []
    for name, column in decoded.extra.items():
        source_column = source.extra.get(name)
        if name in _NORMALS:
            continue
        if source_column is None:
            lines.append(f"the source has no extra column {name!r}")
        elif column.tobytes() != source_column[source_index].astype(column.dtype).tobytes():
            lines.append(f"the extra column {name!r} differs from that of the source")
    return lines
