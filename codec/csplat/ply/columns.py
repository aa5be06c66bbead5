# SPDX-License-Identifier: Apache-2.0
"""Convert the rows of a splat PLY to the arrays of a model, with safe repairs.

Blocks of rows fit in the cache while each group of columns is copied, checked and repaired. This single pass over
memory takes 0.1 s for a million splats of SH degree 3, a tenth of the time of a pass per column over the whole file.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import counted
from csplat.lint import Finding, list_names
from csplat.model import QUAT_LENGTH_TOLERANCE, normalise_quats, squared_lengths
from csplat.ply.column_names import ColumnMap, colour_finding, float_columns, plain_name
from csplat.portable_math import exp, log
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64

Rows = NDArray[Any]  # a block of the file: 1-D, structured, contiguous

#: Logits whose float32 sigmoids are exactly 0 and 1, also after a round trip through decimal text.
LOGIT_OF_0 = -110.0
LOGIT_OF_1 = 20.0

#: Replaces the natural logarithm of a standard deviation of 0. Errors count smaller logarithms as this value (SER-5).
LOG_OF_0 = -88.0

#: Natural logarithm of the largest float32, scene units.
LOG_OF_LARGEST = math.log(np.finfo(np.float32).max)

#: Log scale beyond which the exponential or its inverse leaves float32; decoders treat larger values alike (CNF-6).
HUGE_LOG = 88.0

#: Natural logarithm of 100: the third scale of a disc is a hundredth of the smallest scale in the file.
_FLAT_SCALE_STEP = 4.605170

_MANY_BYTES = 1 << 24  # bytes of rows from which threads are worth starting
_HUGE_COLOUR = 1e6
_USUAL_LENGTHS = (1e-3, 1e3)  # lengths of quaternions, which drift during training
_LARGEST_COLOUR = 16.0  # white is 1 for float colours: larger values are on a scale of 0 to 255
_SAMPLE_ROWS = 4096  # number of rows that are tested for half floats
_BYTE, _WORD = 255.0, 65535.0  # the value of white for colours of 8 and 16 bits
_POSITIONS = ("x", "y", "z")
_BAD_SHARE = 0.01  # maximum fraction of NaN and infinity among half floats
_SANE_LENGTHS = (0.01, 100.0)  # lengths of quaternions in half floats; integers read as half floats are outside
_ODD_SHARE = 0.1  # maximum fraction of rotations with other lengths among half floats
_MAX_SPREAD = 256.0  # maximum ratio of the 90th to the 50th percentile of positions in half floats
_FEW = 16  # splats; a property that fewer have in common may be coincidence
_TINY = 1e-30  # smallest divisor
_ROUNDING = 1e-3  # tolerance by which alphas may exceed 0 and 1
_SAMPLE_OF_BLOCK = 256  # splats per block whose scales are compared with the scene's extent
_EXTENT_QUANTILES = (0.95, 0.05)  # quantiles of the means; their difference is the extent of a scene without outliers
_LENGTHS_RATIO = 3.0  # minimum ratio of the 95th to the 5th percentile of scales that are lengths
_BYTE_COLOUR = 4.0  # a larger f_dc is much brighter than white (1.77) and may be a colour of 0 to 255


@dataclass(eq=False)
class AttributeArrays:
    """The arrays of a `SplatModel`; `means` is float64 if the file has doubles."""

    means: NDArray[Any]
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)


_NO_RANGE = (math.inf, -math.inf)


@dataclass
class RowStatistics:
    """Counts and ranges for the findings about rows, updated block by block."""

    nonfinite: int = 0
    zero_quats: int = 0
    unnormalised: int = 0
    quat_lengths: tuple[float, float] = (math.inf, 0.0)  # shortest and longest, except 0
    infinite_logits: int = 0
    zero_scales: int = 0
    normals: int = 0  # splats with normals other than 0
    first_normal: NDArray[Any] | None = None  # [1, 3], of the first splat
    normals_differ: bool = False
    rounded: set[str] = field(default_factory=set)  # columns of doubles with values that float32 does not hold
    huge: int = 0
    filtered: int = 0
    opacities: tuple[float, float] = _NO_RANGE  # smallest and largest value in the file
    scales: tuple[float, float] = _NO_RANGE
    colours: tuple[float, float] = _NO_RANGE
    colour_range: float = 0.0  # as in `ColumnMap`
    has_columns: bool = True  # the rows come from a PLY, whose columns can be renamed
    sample: list[tuple[NDArray[Any], F32]] = field(default_factory=list)  # means and scales of some splats


def gather_arrays(
    blocks: Iterable[Rows],
    count: int,
    dtype: np.dtype[Any],
    columns: ColumnMap,
    *,
    keep_extra: bool = False,
    statistics: RowStatistics | None = None,
    thinnest: float = math.inf,
    context: Context = DEFAULT_CONTEXT,
) -> AttributeArrays:
    """Copy columns into arrays, drop rows that are not finite, and repair rotations.

    Args:
        blocks: the rows in order, `count` in total.
        count: N.
        dtype: dtype of the blocks.
        columns: meaning of the columns.
        keep_extra: also keep `columns.extra`.
        statistics: updated.
        thinnest: smallest scale of all discs of the file, if the blocks are only some of its rows.
        context: threads, which copy the blocks of a large file.

    Returns:
        Arrays of the remaining splats.
    """
    out = _allocate(count, dtype, columns, keep_extra=keep_extra)
    statistics = RowStatistics() if statistics is None else statistics
    statistics.colour_range = columns.colour_range
    attributes = (*columns.sh0, *columns.rest, columns.opacity, *columns.scales, *columns.quats)
    doubles = [name for name in attributes if dtype[name].kind == "f" and dtype[name].itemsize > 4]
    at = 0
    threads = context.thread_count if count * dtype.itemsize > _MANY_BYTES else 1
    with np.errstate(over="ignore", invalid="ignore"):  # `_repair` detects overflow of float32
        for rows, span in _copy_blocks(blocks, columns, out, threads):
            part = _slice_arrays(out, span)
            _survey_normals(rows, columns.normals, statistics)
            statistics.rounded |= {name for name in doubles if is_rounded(rows[name])}
            widths = rows[columns.filter_3d].astype(np.float64) if columns.filter_3d else None
            kept_count = _repair(part, columns, statistics, widths)
            if at < span.start:  # rows before were dropped
                _move(out, slice(span.start, span.start + kept_count), at)
            at += kept_count
    kept = _slice_arrays(out, slice(0, at))
    if len(columns.scales) == 2 and at:
        kept.scales[:, 2] = choose_thickness(kept.scales[:, :2], thinnest)
    return kept


def choose_thickness(scales: F32, thinnest: float = math.inf) -> np.float32:
    """Choose the third scale of discs.

    Args:
        scales: [N, 2], natural logarithms, N >= 1.
        thinnest: smallest scale of all discs of the scene, if these are only some of them.
    """
    return np.float32(min(scales.min(), np.float32(thinnest)) - np.float32(_FLAT_SCALE_STEP))


def survey_arrays(arrays: AttributeArrays, scale_count: int, statistics: RowStatistics) -> None:
    """Update the statistics with splats that are not rows of a PLY; the arrays stay unchanged.

    Args:
        arrays: finite; opacities are logits, and rotations may have any length.
        scale_count: number of scales of a splat: 2 for discs.
        statistics: updated.
    """
    statistics.has_columns = False
    columns = ColumnMap((), ("",) * scale_count, (), (), (), "", (), {}, double=False)
    for start in range(0, len(arrays.means), _SAMPLE_ROWS):
        part = _slice_arrays(arrays, slice(start, start + _SAMPLE_ROWS))
        copies = {name: array.copy() for name, array in vars(part).items() if name != "extra"}
        _repair(AttributeArrays(**copies), columns, statistics, None)


def with_half_floats(rows: Rows, findings: list[Finding]) -> Rows:
    """View 16-bit integer columns as half floats if they contain plausible half floats.

    PLY has no half float type. Other rows are returned unchanged: `find_columns` refuses integers in place of floats.
    16-bit positions that are not half floats are an error here, because integer positions are otherwise allowed.

    Args:
        rows: rows of the file.
        findings: a finding is appended if columns are half floats, or invalid 16-bit positions.
    """
    dtype = rows.dtype
    floats = set(float_columns(dtype.names or ()))
    halves = {name for name in dtype.names or () if dtype[name].kind in "iu" and dtype[name].itemsize == 2}
    positions = {name for name in halves if name.lower() in _POSITIONS}
    if not floats or not (floats <= halves or (positions and not floats & halves)):
        return rows
    halves = {name for name in halves if name in floats | positions or name.lower() in ("nx", "ny", "nz")}
    kinds = {name: f"{dtype[name].str[0]}f2" if name in halves else dtype[name] for name in dtype.names or ()}
    viewed = rows.view([*kinds.items()])
    if not _are_sane(viewed[:_SAMPLE_ROWS], halves, alone=not floats & halves):
        if positions and not floats & halves:
            names = [name for name in dtype.names or () if name in positions]
            text = f"{', '.join(names)} are 16-bit integers other than half floats, expected float: store them as float"
            findings.append(Finding("integer-columns", len(names), text, "error"))
        return rows
    text = f"{counted(len(halves), 'column')} of 16-bit integers contain half floats: read as such"
    findings.append(Finding("half-floats", len(halves), text, "note"))
    return viewed


def _are_sane(rows: Rows, halves: set[str], *, alone: bool) -> bool:
    """Return True if the columns may be half floats: nearly all values are finite and plausible for splats.

    Args:
        rows: some rows of the file, viewed as half floats.
        halves: names of the columns of half floats.
        alone: only positions are half floats, so other columns give no evidence.
    """
    columns = {name: rows[name].astype(np.float32) for name in halves}
    bad = sum(int((np.isnan(values) if plain_name(name) == "opacity" else ~np.isfinite(values)).sum())
              for name, values in columns.items())  # fmt: skip
    if bad > _BAD_SHARE * len(rows) * len(columns):
        return False
    named = {plain_name(name): rows[name].astype(np.float64) for name in rows.dtype.names or ()}
    absent = np.zeros(len(rows))  # missing columns are refused later
    scales = np.stack([named.get(f"scale_{axis}", absent) for axis in range(2)])
    if not alone:
        quats = np.stack([named.get(f"rot_{axis}", absent) for axis in range(4)])
        lengths = np.sqrt((quats * quats).sum(axis=0))
        odd = (lengths > 0.0) & ~((lengths >= _SANE_LENGTHS[0]) & (lengths <= _SANE_LENGTHS[1]))
        large = (np.abs(scales) > HUGE_LOG) & np.isfinite(scales)
        return bool(odd.sum() <= _ODD_SHARE * len(rows) and large.sum() <= _BAD_SHARE * large.size)
    positions = np.stack([named.get(axis, absent) for axis in _POSITIONS], 1)
    positions = np.abs(positions[np.isfinite(positions).all(axis=1)])
    if len(positions) < _FEW:
        return True
    middle, most = np.quantile(positions, (0.5, 0.9), axis=0)
    # Integers read as half floats have magnitudes from tiny to large along every axis.
    if np.median(most / np.maximum(middle, _TINY)) > _MAX_SPREAD:
        return False
    return math.exp(min(HUGE_LOG, float(np.median(scales)))) <= 2.0 * float(most.max())


def with_colour_range(blocks: Iterable[Rows], columns: ColumnMap, findings: list[Finding]) -> ColumnMap:
    """Read 16-bit red, green and blue on a scale of 0 to 255 if no value is above 255.

    Args:
        blocks: the rows; read only if the colours have 16 bits.
        columns: meaning of the columns.
        findings: the finding about the colours is replaced if the scale changes.
    """
    if columns.colour_range != _WORD:
        return columns
    largest = max((int(rows[name].max(initial=0)) for rows in blocks for name in columns.sh0), default=0)
    if not 0 < largest <= _BYTE:
        return columns
    at = next(index for index, finding in enumerate(findings) if finding.id == "rgb-colours")
    findings[at] = colour_finding(columns.sh0, _BYTE, f": they have 16 bits, but are at most {largest}")
    return replace(columns, colour_range=_BYTE)


def alpha_of_logits(logits: NDArray[Any]) -> F32:
    """Compute opacities: the sigmoid of logits in float64, rounded once.

    Infinite logits give alpha 0 and 1; NaN stays NaN. Above a logit of 16, float32 alpha is too close to 1 to
    distinguish neighbouring values; 17.33 and more give 1.

    Args:
        logits: [N] floating.

    Returns:
        [N] float32 in [0, 1].
    """
    return _alphas(logits).astype(np.float32)


def _alphas(logits: NDArray[Any]) -> F64:
    """Compute the sigmoid of logits [N] in float64."""
    alphas: F64 = 1.0 / (1.0 + exp(-logits.astype(np.float64)))
    return alphas


def logits_of_alpha(alpha: F32) -> F32:
    """Compute logits of opacities; alphas 0 and 1 have finite logits whose sigmoids are exactly 0 and 1.

    Args:
        alpha: [N] float32 in [0, 1].

    Returns:
        [N] float32, from `LOGIT_OF_0` to `LOGIT_OF_1`.
    """
    wide = alpha.astype(np.float64)
    with np.errstate(divide="ignore"):
        logits: F64 = np.clip(np.log(wide) - np.log1p(-wide), LOGIT_OF_0, LOGIT_OF_1)
    return logits.astype(np.float32)


def _allocate(count: int, dtype: np.dtype[Any], columns: ColumnMap, *, keep_extra: bool) -> AttributeArrays:
    """Return uninitialised arrays for `count` splats; extra columns have the byte order of the machine."""
    extra = columns.extra if keep_extra else {}
    return AttributeArrays(
        means=np.empty((count, 3), np.float64 if columns.double else np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh0=np.empty((count, 3), np.float32),
        shN=np.empty((count, len(columns.rest) // 3, 3), np.float32),
        extra={
            name: np.empty((count, len(group)) if len(group) > 1 else count, dtype[group[0]].newbyteorder("="))
            for name, group in extra.items()
        },
    )


def _slice_arrays(arrays: AttributeArrays, rows: slice) -> AttributeArrays:
    """Return views of some rows of all arrays."""
    named = {name: array[rows] for name, array in vars(arrays).items() if name != "extra"}
    return AttributeArrays(**named, extra={name: column[rows] for name, column in arrays.extra.items()})


def _copy_blocks(
    blocks: Iterable[Rows], columns: ColumnMap, out: AttributeArrays, threads: int
) -> Iterator[tuple[Rows, slice]]:
    """Copy blocks of rows one after the other into arrays; yield each with the rows of the arrays that it takes.

    Most of the time goes to memory that is touched for the first time, so threads copy the next blocks meanwhile.
    """

    def copy(rows: Rows, span: slice) -> tuple[Rows, slice]:
        with np.errstate(over="ignore", invalid="ignore"):  # as in `gather_arrays`; a thread has its own state
            _copy(rows, columns, _slice_arrays(out, span))
        return rows, span

    start = 0
    if threads == 1:
        for rows in blocks:
            yield copy(rows, slice(start, start + len(rows)))
            start += len(rows)
        return
    pending = deque[Future[tuple[Rows, slice]]]()
    with ThreadPoolExecutor(threads) as pool:
        for rows in blocks:
            pending.append(pool.submit(copy, rows, slice(start, start + len(rows))))
            start += len(rows)
            if len(pending) > 2 * threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _move(arrays: AttributeArrays, rows: slice, to: int) -> None:
    """Move rows of all arrays to rows from `to` on."""
    source, target = _slice_arrays(arrays, rows), _slice_arrays(arrays, slice(to, to + rows.stop - rows.start))
    for name, array in vars(source).items():
        if name != "extra":
            getattr(target, name)[...] = array
    for name, column in source.extra.items():
        target.extra[name][...] = column


def _copy(rows: Rows, columns: ColumnMap, part: AttributeArrays) -> None:
    """Copy all columns of a block; opacities stay logits, rotations keep their lengths."""
    _copy_group(rows, columns.means, part.means)
    _copy_group(rows, columns.quats, part.quats)
    _copy_group(rows, columns.scales, part.scales[:, : len(columns.scales)])
    if len(columns.scales) == 1:
        part.scales[:, 1:] = part.scales[:, :1]
        if not columns.quats:
            part.quats[:] = (1.0, 0.0, 0.0, 0.0)
    part.opacities[:] = rows[columns.opacity]
    _copy_group(rows, columns.sh0, part.sh0)
    coefficients = part.shN.shape[1]
    for channel in range(3):
        names = columns.rest[channel * coefficients : (channel + 1) * coefficients]
        _copy_group(rows, names, part.shN[:, :, channel])
    for name, column in part.extra.items():
        _copy_group(rows, columns.extra[name], column.reshape(len(rows), -1))


def _copy_group(rows: Rows, names: Sequence[str], target: NDArray[Any]) -> None:
    """Copy columns of a block to the last axis of `target` [n, len(names)]."""
    view = _adjacent(rows, names)
    if view is not None:
        target[...] = view
        return
    for index, name in enumerate(names):
        target[:, index] = rows[name]


def _adjacent(rows: Rows, names: Sequence[str]) -> NDArray[Any] | None:
    """View columns as an array [n, len(names)] if they are adjacent and of the same type; otherwise return `None`."""
    fields: dict[str, Any] = dict((rows.dtype.fields or {}).items())
    if not names:
        return None
    kind, start = fields[names[0]][:2]
    for index, name in enumerate(names):
        if fields[name][:2] != (kind, start + index * kind.itemsize):
            return None
    shape, strides = (len(rows), len(names)), (rows.dtype.itemsize, kind.itemsize)
    # Via bytes, because the buffer protocol does not support every column name that a PLY may have.
    return np.ndarray(shape, kind, rows.view(np.uint8).data, start, strides)


def _survey_normals(rows: Rows, names: Sequence[str], statistics: RowStatistics) -> None:
    """Update the statistics with the normals of a block: normals that are the same for all splats hold nothing."""
    if not names or not len(rows):
        return
    normals = np.stack([rows[name] for name in names], axis=1)
    if statistics.first_normal is None:
        statistics.first_normal = normals[:1].copy()
    statistics.normals += int(np.count_nonzero(normals.any(axis=1)))
    statistics.normals_differ |= not np.array_equal(
        normals, np.broadcast_to(statistics.first_normal, normals.shape), equal_nan=True
    )


def is_rounded(values: NDArray[Any]) -> bool:
    """Return True if float32 rounds values of any shape; splats with values beyond it are dropped."""
    rounded = values.astype(np.float32)
    return bool((np.isfinite(rounded) & (rounded != values)).any())


def _repair(part: AttributeArrays, columns: ColumnMap, statistics: RowStatistics, widths: F64 | None) -> int:
    """Repair a block in place, moving the remaining rows to the front, and return their number.

    Args:
        part: the block with the values of the file.
        columns: meaning of the columns.
        statistics: updated.
        widths: [n], standard deviations of the 3D filter, scene units; `None`: there is no filter.
    """
    scale_count = len(columns.scales)
    checked = [part.means, part.quats, part.scales[:, :scale_count], part.sh0, part.shN]
    checked += [] if widths is None else [widths]
    sums = [float(array.sum()) for array in (*checked, part.opacities)]
    if not np.isfinite(sum(sums)):  # NaN, infinity, or a sum of large values that overflows
        zero = flatten_scales(part.scales)
        good = ~np.isnan(part.opacities)
        for array in checked:
            finite = np.isfinite(array.astype(np.float32))  # means may be float64
            good &= finite.reshape(len(good), -1).all(axis=1) if finite.size else True
        kept = int(np.count_nonzero(good))
        statistics.nonfinite += len(good) - kept
        statistics.zero_scales += int(np.count_nonzero(zero & good))
        for array in (*vars(part).values(), *part.extra.values()):
            if isinstance(array, np.ndarray):
                array[:kept] = array[good]
        part = _slice_arrays(part, slice(0, kept))
        widths = None if widths is None else widths[good]
        statistics.infinite_logits += int(np.count_nonzero(np.isinf(part.opacities)))
    statistics.opacities = _extend_range(statistics.opacities, part.opacities)
    statistics.scales = _extend_range(statistics.scales, part.scales[:, :scale_count])
    statistics.colours = _extend_range(statistics.colours, part.sh0)
    if statistics.scales[0] >= 0.0:  # they may be lengths
        step = len(part.means) // _SAMPLE_OF_BLOCK + 1
        statistics.sample.append((part.means[::step].copy(), part.scales[::step, :scale_count].copy()))
    alphas = _alphas(part.opacities)
    if widths is not None:
        statistics.filtered += int(np.count_nonzero(widths))
        _fuse_filter(part.scales, alphas, widths)
    part.opacities[:] = alphas
    if columns.colour_range:
        part.sh0[:] = (part.sh0 / np.float32(columns.colour_range) - np.float32(0.5)) / np.float32(SH_C0)
    _repair_quats(part.quats, statistics)
    statistics.huge += count_huge_rows(part.scales[:, :scale_count], part.sh0, part.shN)
    return len(part.opacities)


def flatten_scales(scales: F32) -> NDArray[np.bool_]:
    """Replace logarithms of standard deviations of 0, which are -infinity, in place; return a mask of their rows.

    Args:
        scales: [N, C], natural logarithms.
    """
    zero = scales == -np.inf
    scales[zero] = LOG_OF_0
    return np.asarray(zero.any(axis=1))


def _extend_range(bounds: tuple[float, float], values: F32) -> tuple[float, float]:
    """Extend a range by values, an array of any shape.

    A value that is negative beyond rounding shows that the values are not activated. The range is then irrelevant and
    stays unchanged.
    """
    if bounds[0] < -_ROUNDING:
        return bounds
    return min(bounds[0], float(values.min(initial=math.inf))), max(bounds[1], float(values.max(initial=-math.inf)))


def _fuse_filter(scales: F32, alphas: F64, widths: F64) -> None:
    """Convolve splats with the 3D filter of Mip-Splatting, in place.

    As in `create_fused_ply.py`, standard deviations s become sqrt(s² + f²), and opacities are multiplied by
    sqrt(Π s² / Π (s² + f²)), which preserves the mass of a splat (Yu et al., Mip-Splatting, CVPR 2024, equation 9).
    The computation uses logarithms so that squares and products do not overflow. A width of 0 changes no bit.

    Args:
        scales: [n, 3], natural logarithms of standard deviations.
        alphas: [n], opacities, 0 to 1.
        widths: [n], standard deviations f of the filter, finite; the sign is ignored.
    """
    rows = np.flatnonzero(widths)
    before = scales[rows].astype(np.float64)
    width = log(np.abs(widths[rows, None]))
    larger = np.maximum(before, width)
    after = larger + 0.5 * log(1.0 + exp(2.0 * (np.minimum(before, width) - larger)))
    alphas[rows] *= exp((before - after).sum(axis=1))
    scales[rows] = after


def count_huge_rows(scales: NDArray[Any], *colours: NDArray[Any]) -> int:
    """Count splats with implausibly large values.

    Args:
        scales: [n, C], natural logarithms.
        colours: [n, ...], coefficients.
    """
    huge = None
    for array, limit in ((scales, HUGE_LOG), *((array, _HUGE_COLOUR) for array in colours)):
        if max(float(array.max(initial=0.0)), -float(array.min(initial=0.0))) > limit:
            beyond = np.abs(array).reshape(len(array), -1).max(axis=1) > limit
            huge = beyond if huge is None else huge | beyond
    return 0 if huge is None else int(np.count_nonzero(huge))


def _repair_quats(quats: F32, statistics: RowStatistics) -> None:
    """Normalise quaternions [n, 4] in place.

    Adds to `statistics` the number of zero rows and of other rows that were not of unit length, and the range of
    lengths.
    """
    wide = quats.astype(np.float64)
    squared = squared_lengths(wide)
    zero = int(np.count_nonzero(squared == 0.0))
    not_unit = int(np.count_nonzero(np.abs(squared - 1.0) > 2.0 * QUAT_LENGTH_TOLERANCE))
    statistics.zero_quats += zero
    statistics.unnormalised += not_unit - zero
    if not_unit > zero:
        low, high = statistics.quat_lengths
        least = float(squared.min(where=squared > 0.0, initial=math.inf))
        statistics.quat_lengths = (min(low, math.sqrt(least)), max(high, math.sqrt(float(squared.max()))))
    quats[:] = normalise_quats(quats)


def list_findings(statistics: RowStatistics, count: int) -> list[Finding]:
    """Return the findings about `count` rows with these statistics."""
    s, (shortest, longest) = statistics, statistics.quat_lengths
    nonfinite = f"{counted(s.nonfinite, 'splat')} with NaN or infinity"
    quats = f"{counted(s.unnormalised, 'rotation')} not of unit length ({shortest:.3g} to {longest:.3g}): normalised"
    usual = _USUAL_LENGTHS[0] <= shortest and longest <= _USUAL_LENGTHS[1]
    zero = f"{counted(s.zero_quats, 'rotation')} of length 0: set to the identity"
    logits = f"{counted(s.infinite_logits, 'infinite logit')} of opacity: alpha 0 or 1"
    flat = f"{counted(s.zero_scales, 'splat')} with a log scale of -infinity, a size of 0: read as flat"
    normals = f"{counted(s.normals, 'splat')} with normals, which are not splat attributes: dropped"
    fused = f"the 3D filter of Mip-Splatting: fused into scales and opacities of {counted(s.filtered, 'splat')}"
    huge = f"log scales beyond ± {HUGE_LOG:g} or colours beyond ± {_HUGE_COLOUR:g}"
    findings = [
        Finding("nonfinite-rows", s.nonfinite, f"{nonfinite}: dropped", "repair", lost=(nonfinite,))
        if s.nonfinite < count
        else Finding("nonfinite-rows", count, f"{nonfinite}: none is left; export the scene again", "error"),
        Finding("zero-quats", s.zero_quats, zero, "repair"),
        Finding("unnormalised-quats", s.unnormalised, quats, "note", usual=usual),
        Finding("infinite-logits", s.infinite_logits, logits, "note"),
        Finding("zero-scales", s.zero_scales, flat, "note"),
        Finding("nonzero-normals", s.normals * s.normals_differ, normals, "note", lost=("normals",)),
        rounded_doubles(sorted(s.rounded)),
        Finding("filter-3d", s.filtered, fused, "note"),
        Finding("huge-values", s.huge, f"{counted(s.huge, 'splat')} with {huge}", "note"),
    ]
    return [finding for finding in findings if finding.count] + _activation_findings(s, count - s.nonfinite)


def rounded_doubles(names: Sequence[str]) -> Finding:
    """Return the finding about columns of doubles that float32 rounds; it has no count without names."""
    text, lost = f"{list_names(names)}: doubles, rounded to float32", (f"doubles of {list_names(names)}",)
    return Finding("double-columns", len(names), text, "note", lost=lost)


def _activation_findings(statistics: RowStatistics, kept: int) -> list[Finding]:
    """Report ranges that indicate values after their activation, which trained scenes do not have."""
    findings = []
    colours = statistics.colours
    if statistics.colour_range == 1.0 and kept and colours[1] > _LARGEST_COLOUR:
        text = f"red, green and blue are floats up to {colours[1]:g}, expected 0 to 1: store them as uchar"
        findings.append(Finding("colour-columns", kept, text, "error"))
    if kept < _FEW:
        return findings
    alphas = _lie_in(statistics.opacities, -_ROUNDING, 1.0 + _ROUNDING)
    if alphas or (_lie_in(statistics.opacities, 0.0, _BYTE) and statistics.opacities[1] > HUGE_LOG):
        top = 1 if alphas else 255
        text = f"all {kept} opacities are in 0..{top}, like alphas: read as logits; export them before the sigmoid"
        findings.append(Finding("opacities-are-alphas", kept, text, "note"))
    if _lie_in(statistics.scales, 0.0, HUGE_LOG) and _are_lengths(statistics):
        text = f"no scale of {kept} splats is negative, like lengths: read as logarithms; export them before exp"
        findings.append(Finding("scales-are-linear", kept, text, "note"))
    if not statistics.colour_range and (
        _lie_in(colours, 0.0, 1.0) or (_lie_in(colours, 0.0, 255.0) and colours[1] > _BYTE_COLOUR)
    ):
        top = 1 if colours[1] <= 1.0 else 255
        text = f"all f_dc of {kept} splats are in 0..{top}, like colours: read as SH coefficients"
        text += "; name the columns red, green and blue if they are colours" if statistics.has_columns else ""
        findings.append(Finding("colours-are-rgb", kept, text, "note"))
    return findings


def _are_lengths(statistics: RowStatistics) -> bool:
    """Return True if positive scales are plausible as lengths but not as logarithms."""
    means, scales = (np.concatenate(arrays) for arrays in zip(*statistics.sample, strict=True))
    extent = float(np.subtract(*np.quantile(means, _EXTENT_QUANTILES, axis=0)).max())
    low, middle, high = np.quantile(scales, (0.05, 0.5, 0.95)).tolist()
    # Lengths vary by factors. Read as logarithms, they would give all splats a size of about a scene unit.
    alike = middle < 1.0 and high > _LENGTHS_RATIO * low
    return middle <= extent / 2.0 and (alike or math.exp(middle) > extent / 2.0)


def _lie_in(bounds: tuple[float, float], low: float, high: float) -> bool:
    """Return True if a range is inside low..high and has more than one value."""
    return low <= bounds[0] < bounds[1] <= high
