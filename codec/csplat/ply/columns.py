"""Turn the rows of a splat PLY into the arrays of a model, repairing what is safe.

Rows come in blocks that stay in the cache while each column group is copied out, checked and
repaired: one pass over memory. (A million splats of SH degree 3: 0.1 s; column by column over the
whole file it takes ten times that.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import counted
from csplat.lint import ColumnMap, Finding, colour_finding, float_columns, plain_name
from csplat.model import QUAT_LENGTH_TOLERANCE, normalise_quats
from csplat.types import F32, F64

Rows = NDArray[Any]  # one block of the file: 1-D, structured, contiguous

#: The basis function of SH degree 0.
SH_C0 = np.float32(0.28209479177387814)

#: float32 sigmoids of these are exactly 0 and 1, however they are written down.
LOGIT_OF_0 = -110.0
LOGIT_OF_1 = 20.0

#: The third scale of a disc lies this far (natural logarithm: a hundredth) below the smallest
#: scale of the file.
_FLAT_SCALE_STEP = 4.605170

_HUGE_LOG = 88.0  # standard deviations beyond this exponent overflow float32
_HUGE_COLOUR = 1e6
_USUAL_LENGTHS = (1e-3, 1e3)  # lengths of quaternions: they grow and shrink while a scene is trained
_LARGEST_COLOUR = 16.0  # red, green and blue as floats, where 1 is white: larger values are taken as 0 to 255
_LOOKED_AT = 4096  # rows that tell half floats from integers
_BYTE, _WORD = 255.0, 65535.0  # values of a colour of 8 and of 16 bits that are 1
_POSITIONS = ("x", "y", "z")
_BAD_SHARE = 0.01  # half floats that may be NaN or infinite, as in any scene
_SANE_LENGTHS = (0.01, 100.0)  # lengths of quaternions: integers read as half floats leave them
_MOST_RATIO = 256.0  # half floats of positions: the ratio of a large one and one in the middle
_FEW = 16  # splats: a property of fewer may be chance
_TINY = 1e-30  # above 0
_ROUNDING = 1e-3  # alphas may lie beyond 0 and 1 by that much
_OF_A_BLOCK = 256  # splats of a block whose scales are compared with the scene's extent
_LENGTHS_RATIO = 3.0  # 95th to 5th percentile of scales that are lengths, at least
_BYTE_COLOUR = 4.0  # an f_dc beyond is brighter than white, 1.77, and may be a colour of 0 to 255


@dataclass(eq=False)
class SplatArrays:
    """The arrays of a `SplatModel`, by the same names, filled row by row.

    `means` is float64 if the file's positions are double.
    """

    means: NDArray[Any]
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)


_NOTHING = (math.inf, -math.inf)


@dataclass
class RowStatistics:
    """Counts and ranges of what was noticed in rows, updated block by block."""

    nonfinite: int = 0
    zero_quats: int = 0
    unnormalised: int = 0
    quat_lengths: tuple[float, float] = (math.inf, 0.0)  # shortest and longest, without those that are 0
    infinite_logits: int = 0
    normals: int = 0
    huge: int = 0
    filtered: int = 0
    opacities: tuple[float, float] = _NOTHING  # as the file has them: least and largest
    scales: tuple[float, float] = _NOTHING
    colours: tuple[float, float] = _NOTHING
    colour_range: float = 0.0  # as in `ColumnMap`
    has_columns: bool = True  # they are rows of a PLY
    looked_at: list[tuple[NDArray[Any], F32]] = field(default_factory=list)  # means and scales of some splats


def gather_arrays(
    blocks: Iterable[Rows],
    count: int,
    dtype: np.dtype[Any],
    columns: ColumnMap,
    *,
    keep_extra: bool = False,
    counts: RowStatistics | None = None,
    thinnest: float = math.inf,
) -> SplatArrays:
    """Copy columns into arrays, dropping rows that are not finite and repairing rotations.

    Args:
        blocks: the rows in order, `count` in all.
        count: N.
        dtype: dtype of the blocks.
        columns: meaning of the columns.
        keep_extra: keep `columns.extra` too.
        counts: updated with what is noticed and repaired.
        thinnest: the smallest scale of all discs, if these are not all of them.

    Returns:
        Arrays of the splats that were kept.
    """
    out = _allocate(count, dtype, columns, keep_extra=keep_extra)
    counts = RowStatistics() if counts is None else counts
    counts.colour_range = columns.colour_range
    at = 0
    with np.errstate(over="ignore", invalid="ignore"):  # overflow of float32 is found below
        for rows in blocks:
            part = _part(out, slice(at, at + len(rows)))
            _copy(rows, columns, part)
            counts.normals += _nonzero_rows(rows, columns.normals)
            widths = rows[columns.filter_3d].astype(np.float64) if columns.filter_3d else None
            at += _repair(part, columns, counts, widths)
    kept = _part(out, slice(0, at))
    if len(columns.scales) == 2 and at:
        kept.scales[:, 2] = choose_thickness(kept.scales[:, :2], thinnest)
    return kept


def choose_thickness(scales: F32, thinnest: float = math.inf) -> np.float32:
    """Choose the third scale of discs.

    Args:
        scales: [N, 2] natural logarithms, of one disc at least.
        thinnest: the smallest scale of all discs, if these are not all of them.
    """
    return np.float32(min(scales.min(), np.float32(thinnest)) - np.float32(_FLAT_SCALE_STEP))


def survey_arrays(arrays: SplatArrays, scale_count: int, counts: RowStatistics) -> None:
    """Count what is noticed in splats that are not the rows of a file; they stay as they are.

    Args:
        arrays: finite; opacities are logits, and rotations may have any length.
        scale_count: scales of a splat: 2 of discs.
        counts: updated.
    """
    counts.has_columns = False
    columns = ColumnMap((), ("",) * scale_count, (), (), (), "", (), (), double=False)
    for start in range(0, len(arrays.means), _LOOKED_AT):
        part = _part(arrays, slice(start, start + _LOOKED_AT))
        means, quats, scales = part.means.copy(), part.quats.copy(), part.scales.copy()
        copy = SplatArrays(means, quats, scales, part.opacities.copy(), part.sh0.copy(), part.shN.copy())
        _repair(copy, columns, counts, None)


def with_half_floats(rows: Rows, findings: list[Finding]) -> Rows:
    """View rows whose numbers are declared as 16-bit integers as the half floats that they are.

    PLY has no type of two bytes for floats. Rows of other types, or that would hold no sane numbers, stay as they
    are: integers in place of floats are refused by `csplat.lint`, and 16-bit positions that are no half floats here.

    Args:
        rows: rows of the file.
        findings: a finding is appended if they are half floats, or can be neither.
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
    if not _are_sane(viewed[:_LOOKED_AT], halves, alone=not floats & halves):
        if positions and not floats & halves:
            names = [name for name in dtype.names or () if name in positions]
            text = f"{', '.join(names)} are 16-bit integers, and no half floats, expected float: store them as float"
            findings.append(Finding("integer-columns", len(names), text, "error"))
        return rows
    text = f"{counted(len(halves), 'column')} of 16-bit integers hold the bits of half floats: read as these"
    findings.append(Finding("half-floats", len(halves), text, "note"))
    return viewed


def _are_sane(rows: Rows, halves: set[str], *, alone: bool) -> bool:
    """Tell whether half floats can be meant: nearly all are finite, and they have sizes that splats have.

    Args:
        rows: some rows of the file, viewed as half floats.
        halves: names of the columns of half floats.
        alone: only positions are half floats, and the other columns say nothing of integers.
    """
    columns = {name: rows[name].astype(np.float32) for name in halves}
    bad = sum(int((np.isnan(one) if plain_name(name) == "opacity" else ~np.isfinite(one)).sum())
              for name, one in columns.items())  # fmt: skip
    if bad > _BAD_SHARE * len(rows) * len(columns):
        return False
    named = {plain_name(name): rows[name].astype(np.float64) for name in rows.dtype.names or ()}
    nothing = np.zeros(len(rows))  # for missing columns, which are refused later
    scales = np.stack([named.get(f"scale_{axis}", nothing) for axis in range(2)])
    if not alone:
        quats = np.stack([named.get(f"rot_{axis}", nothing) for axis in range(4)])
        lengths = np.sqrt((quats * quats).sum(axis=0))
        odd = (lengths > 0.0) & ~((lengths >= _SANE_LENGTHS[0]) & (lengths <= _SANE_LENGTHS[1]))
        large = (np.abs(scales) > _HUGE_LOG) & np.isfinite(scales)
        return bool(odd.sum() <= 0.1 * len(rows) and large.sum() <= _BAD_SHARE * large.size)
    positions = np.stack([named.get(axis, nothing) for axis in _POSITIONS], 1)
    positions = np.abs(positions[np.isfinite(positions).all(axis=1)])
    if len(positions) < _FEW:
        return True
    middle, most = np.quantile(positions, (0.5, 0.9), axis=0)
    # Integers that are read as half floats are of all sizes, from tiny to large, along all axes.
    if np.median(most / np.maximum(middle, _TINY)) > _MOST_RATIO:
        return False
    return math.exp(min(_HUGE_LOG, float(np.median(scales)))) <= 2.0 * float(most.max())


def with_colour_range(blocks: Iterable[Rows], columns: ColumnMap, findings: list[Finding]) -> ColumnMap:
    """Take red, green and blue of 16 bits that are none above 255 for what bytes would be.

    Args:
        blocks: the rows; looked at only if the colours have 16 bits.
        columns: meaning of the columns.
        findings: the finding about the colours is replaced if they are of 0 to 255.
    """
    if columns.colour_range != _WORD:
        return columns
    largest = max((int(rows[name].max(initial=0)) for rows in blocks for name in columns.sh0), default=0)
    if not 0 < largest <= _BYTE:
        return columns
    at = next(index for index, one in enumerate(findings) if one.id == "rgb-colours")
    findings[at] = colour_finding(columns.sh0, _BYTE, f": they are of 16 bits, and at most {largest}")
    return replace(columns, colour_range=_BYTE)


def alpha_of_logits(logits: NDArray[Any]) -> F32:
    """Opacities of logits: the sigmoid in float64, rounded once.

    Infinite logits are alpha 0 and 1; NaN stays NaN. Above a logit of 16 float32 alpha is too
    close to 1 to tell neighbours apart: 17.33 and more are 1.

    Args:
        logits: [N] floating.

    Returns:
        [N] float32 in [0, 1].
    """
    return _alphas(logits).astype(np.float32)


def _alphas(logits: NDArray[Any]) -> F64:
    with np.errstate(over="ignore"):
        alphas: F64 = 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))
    return alphas


def logits_of_alpha(alpha: F32) -> F32:
    """Logits of opacities; those of 0 and 1 are finite and lead back to exactly 0 and 1.

    Args:
        alpha: [N] float32 in [0, 1].

    Returns:
        [N] float32, from `LOGIT_OF_0` to `LOGIT_OF_1`.
    """
    wide = alpha.astype(np.float64)
    with np.errstate(divide="ignore"):
        logits: F64 = np.clip(np.log(wide) - np.log1p(-wide), LOGIT_OF_0, LOGIT_OF_1)
    return logits.astype(np.float32)


def _allocate(count: int, dtype: np.dtype[Any], columns: ColumnMap, *, keep_extra: bool) -> SplatArrays:
    extra = columns.extra if keep_extra else ()
    return SplatArrays(
        means=np.empty((count, 3), np.float64 if columns.double else np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh0=np.empty((count, 3), np.float32),
        shN=np.empty((count, len(columns.rest) // 3, 3), np.float32),
        extra={name: np.empty(count, dtype[name].newbyteorder("=")) for name in extra},
    )


def _part(arrays: SplatArrays, rows: slice) -> SplatArrays:
    return SplatArrays(
        arrays.means[rows],
        arrays.quats[rows],
        arrays.scales[rows],
        arrays.opacities[rows],
        arrays.sh0[rows],
        arrays.shN[rows],
        {name: column[rows] for name, column in arrays.extra.items()},
    )


def _copy(rows: Rows, columns: ColumnMap, part: SplatArrays) -> None:
    """Copy every column group of a block; opacities stay logits, rotations stay as they are."""
    _copy_group(rows, columns.means, part.means)
    _copy_group(rows, columns.quats, part.quats)
    _copy_group(rows, columns.scales, part.scales[:, : len(columns.scales)])
    part.opacities[:] = rows[columns.opacity]
    _copy_group(rows, columns.sh0, part.sh0)
    coefficients = part.shN.shape[1]
    for channel in range(3):
        names = columns.rest[channel * coefficients : (channel + 1) * coefficients]
        _copy_group(rows, names, part.shN[:, :, channel])
    for name, column in part.extra.items():
        column[:] = rows[name]


def _copy_group(rows: Rows, names: Sequence[str], target: NDArray[Any]) -> None:
    """Copy columns `names` of a block to the last axis of `target` [n, len(names)]."""
    view = _adjacent(rows, names)
    if view is not None:
        target[...] = view
        return
    for index, name in enumerate(names):
        target[:, index] = rows[name]


def _adjacent(rows: Rows, names: Sequence[str]) -> NDArray[Any] | None:
    """View columns as one [n, len(names)] array, if they lie side by side and are of one type."""
    fields: dict[str, Any] = dict((rows.dtype.fields or {}).items())
    if not names:
        return None
    kind, start = fields[names[0]][:2]
    for index, name in enumerate(names):
        if fields[name][:2] != (kind, start + index * kind.itemsize):
            return None
    shape, strides = (len(rows), len(names)), (rows.dtype.itemsize, kind.itemsize)
    # Through bytes: the buffer protocol does not take every name that a PLY may give a column.
    return np.ndarray(shape, kind, rows.view(np.uint8).data, start, strides)


def _nonzero_rows(rows: Rows, names: Sequence[str]) -> int:
    nonzero = np.zeros(len(rows), bool)
    for name in names:
        nonzero |= rows[name] != 0
    return int(np.count_nonzero(nonzero))


def _repair(part: SplatArrays, columns: ColumnMap, counts: RowStatistics, widths: F64 | None) -> int:
    """Repair a block in place, moving the rows that are kept to the front. Return how many are kept.

    Args:
        part: the block, as the file has it.
        columns: meaning of the columns.
        counts: updated with what is noticed.
        widths: [n] standard deviations of the 3D filter, scene units; `None`: there is none.
    """
    scale_count = len(columns.scales)
    checked = [part.means, part.quats, part.scales[:, :scale_count], part.sh0, part.shN]
    checked += [] if widths is None else [widths]
    sums = [float(array.sum()) for array in (*checked, part.opacities)]
    if not np.isfinite(sum(sums)):  # a NaN or an infinity, or large values: look closer
        good = ~np.isnan(part.opacities)
        for array in checked:
            finite = np.isfinite(array.astype(np.float32))  # means may be float64
            good &= finite.reshape(len(good), -1).all(axis=1) if finite.size else True
        kept = int(np.count_nonzero(good))
        counts.nonfinite += len(good) - kept
        for array in (*vars(part).values(), *part.extra.values()):
            if isinstance(array, np.ndarray):
                array[:kept] = array[good]
        part = _part(part, slice(0, kept))
        widths = None if widths is None else widths[good]
        counts.infinite_logits += int(np.count_nonzero(np.isinf(part.opacities)))
    counts.opacities = _wider(counts.opacities, part.opacities)
    counts.scales = _wider(counts.scales, part.scales[:, :scale_count])
    counts.colours = _wider(counts.colours, part.sh0)
    if counts.scales[0] >= 0.0:  # they may be lengths
        step = len(part.means) // _OF_A_BLOCK + 1
        counts.looked_at.append((part.means[::step].copy(), part.scales[::step, :scale_count].copy()))
    alphas = _alphas(part.opacities)
    if widths is not None:
        counts.filtered += int(np.count_nonzero(widths))
        _fuse_filter(part.scales, alphas, widths)
    part.opacities[:] = alphas
    if columns.colour_range:
        part.sh0[:] = (part.sh0 / np.float32(columns.colour_range) - np.float32(0.5)) / SH_C0
    _repair_quats(part.quats, counts)
    counts.huge += count_huge_rows(part.scales[:, :scale_count], part.sh0, part.shN)
    return len(part.opacities)


def _wider(bounds: tuple[float, float], values: F32) -> tuple[float, float]:
    """Return the least and the largest of what was seen before and of some values.

    Below 0 is nothing that was activated, but for what rounding leaves: from there on nobody looks.
    """
    if bounds[0] < -_ROUNDING:
        return bounds
    return min(bounds[0], float(values.min(initial=math.inf))), max(bounds[1], float(values.max(initial=-math.inf)))


def _fuse_filter(scales: F32, alphas: F64, widths: F64) -> None:
    """Convolve splats with the 3D filter of Mip-Splatting, in place.

    As `create_fused_ply.py` does: standard deviations become sqrt(s² + f²), and opacities are multiplied by
    sqrt(Π s² / Π (s² + f²)), which keeps what a splat holds (Yu et al., Mip-Splatting, CVPR 2024, equation 9). Here of
    logarithms, so that neither squares nor products leave float64; a filter of width 0 changes no bit.

    Args:
        scales: [n, 3] natural logarithms of standard deviations.
        alphas: [n] opacities, 0 to 1.
        widths: [n] standard deviations of the filter, finite; their sign means nothing.
    """
    rows = np.flatnonzero(widths)
    before = scales[rows].astype(np.float64)
    after = 0.5 * np.logaddexp(2.0 * before, 2.0 * np.log(np.abs(widths[rows, None])))
    alphas[rows] *= np.exp((before - after).sum(axis=1))
    scales[rows] = after


def count_huge_rows(scales: NDArray[Any], *colours: NDArray[Any]) -> int:
    """Count splats with values that no picture can be meant by.

    Args:
        scales: [n, C] natural logarithms.
        colours: [n, ...] coefficients.
    """
    looked_at = ((scales, _HUGE_LOG), *((one, _HUGE_COLOUR) for one in colours))
    huge = None
    for array, limit in looked_at:
        if max(float(array.max(initial=0.0)), -float(array.min(initial=0.0))) > limit:
            found = np.abs(array).reshape(len(array), -1).max(axis=1) > limit
            huge = found if huge is None else huge | found
    return 0 if huge is None else int(np.count_nonzero(huge))


def _repair_quats(quats: F32, counts: RowStatistics) -> None:
    wide = quats.astype(np.float64)
    squared = np.einsum("ij,ij->i", wide, wide)
    zero = int(np.count_nonzero(squared == 0.0))
    other = int(np.count_nonzero(np.abs(squared - 1.0) > 2.0 * QUAT_LENGTH_TOLERANCE))
    counts.zero_quats += zero
    counts.unnormalised += other - zero
    if other > zero:
        low, high = counts.quat_lengths
        least = float(squared.min(where=squared > 0.0, initial=math.inf))
        counts.quat_lengths = (min(low, math.sqrt(least)), max(high, math.sqrt(float(squared.max()))))
    quats[:] = normalise_quats(quats)


def list_findings(counts: RowStatistics, count: int) -> list[Finding]:
    """Return the findings about what was noticed in `count` rows."""
    nonfinite = f"{counted(counts.nonfinite, 'splat')} with NaN or infinity"
    findings = [
        Finding("nonfinite-rows", counts.nonfinite, f"{nonfinite}: dropped", "repair")
        if counts.nonfinite < count
        else Finding("nonfinite-rows", count, f"{nonfinite}: none is left; export the scene again", "error"),
        Finding(
            "zero-quats",
            counts.zero_quats,
            f"{counted(counts.zero_quats, 'rotation')} of length 0: set to the identity",
            "repair",
        ),
        Finding(
            "unnormalised-quats",
            counts.unnormalised,
            f"{counted(counts.unnormalised, 'rotation')} not of unit length"
            f" ({counts.quat_lengths[0]:.3g} to {counts.quat_lengths[1]:.3g}): normalised",
            "note",
            usual=_USUAL_LENGTHS[0] <= counts.quat_lengths[0] and counts.quat_lengths[1] <= _USUAL_LENGTHS[1],
        ),
        Finding(
            "infinite-logits",
            counts.infinite_logits,
            f"{counted(counts.infinite_logits, 'infinite logit')} of opacity: alpha 0 or 1",
            "note",
        ),
        Finding(
            "nonzero-normals",
            counts.normals,
            f"{counted(counts.normals, 'splat')} with normals, which splats do not use: dropped",
            "note",
        ),
        Finding(
            "filter-3d",
            counts.filtered,
            f"the 3D filter of Mip-Splatting: fused into scales and opacities of {counted(counts.filtered, 'splat')}",
            "note",
        ),
        Finding(
            "huge-values",
            counts.huge,
            f"{counted(counts.huge, 'splat')} with log scales beyond ± {_HUGE_LOG:g}"
            f" or colours beyond ± {_HUGE_COLOUR:g}",
            "note",
        ),
    ]
    return [finding for finding in findings if finding.count] + _suspicions(counts, count - counts.nonfinite)


def _suspicions(counts: RowStatistics, kept: int) -> list[Finding]:
    """Report properties that all splats share but no trained scene has: values after their activation."""
    found = []
    colours = counts.colours
    if counts.colour_range == 1.0 and kept and colours[1] > _LARGEST_COLOUR:
        text = f"red, green and blue are floats up to {colours[1]:g}, expected 0 to 1: store them as uchar"
        found.append(Finding("colour-columns", kept, text, "error"))
    if kept < _FEW:
        return found
    alphas = _lie_in(counts.opacities, -_ROUNDING, 1.0 + _ROUNDING)
    if alphas or (_lie_in(counts.opacities, 0.0, _BYTE) and counts.opacities[1] > _HUGE_LOG):
        top = 1 if alphas else 255
        text = f"all {kept} opacities lie in 0..{top}, as alphas do: read as logits; export them before the sigmoid"
        found.append(Finding("opacities-are-alphas", kept, text, "note"))
    if _lie_in(counts.scales, 0.0, _HUGE_LOG) and _are_lengths(counts):
        text = f"no scale of {kept} splats is below 0, as lengths are: read as logarithms; export them before exp"
        found.append(Finding("scales-are-linear", kept, text, "note"))
    if not counts.colour_range and (
        _lie_in(colours, 0.0, 1.0) or (_lie_in(colours, 0.0, 255.0) and colours[1] > _BYTE_COLOUR)
    ):
        top = 1 if colours[1] <= 1.0 else 255
        text = f"all f_dc of {kept} splats lie in 0..{top}, as colours do: read as SH coefficients"
        text += "; name the columns red, green and blue if they are colours" if counts.has_columns else ""
        found.append(Finding("colours-are-rgb", kept, text, "note"))
    return found


def _are_lengths(counts: RowStatistics) -> bool:
    """Tell whether scales above 0 fit the scene as lengths, and as logarithms do not."""
    means, scales = (np.concatenate(arrays) for arrays in zip(*counts.looked_at, strict=True))
    extent = float(np.subtract(*np.quantile(means, (0.95, 0.05), axis=0)).max())
    low, middle, high = np.quantile(scales, (0.05, 0.5, 0.95)).tolist()
    # Lengths differ by a factor; their exponentials are all about 1, which no logarithms say of a scene.
    alike = middle < 1.0 and high > _LENGTHS_RATIO * low
    return middle <= extent / 2.0 and (alike or math.exp(middle) > extent / 2.0)


def _lie_in(bounds: tuple[float, float], low: float, high: float) -> bool:
    return low <= bounds[0] < bounds[1] <= high
