# SPDX-License-Identifier: Apache-2.0
"""Choose the coding parameters of a file (steps, levels and codings) from options, preset and scene.

One number, the quality in dB, sets all steps. The error in renders that a step causes differs between scenes by a
factor of ten, most of which three statistics explain. Moving, turning or resizing a splat is visible only as far as its
neighbours have other colours; a displacement matters relative to the scene's extent on the screen, and a rotation in
proportion to the splat's size on the screen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder.encode_options import PRESETS, QUANTISED_PRESETS, EncodeOptions
from csplat.encoder.entropy import DeflateSettings, deflate_library, morton_codes
from csplat.model import SplatModel
from csplat.portable_math import ceil_log2, exp, log
from csplat.scene_parts import ScenePart, find_parts, median_size, part_min, part_of, split_parts
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64

#: Largest displacement of a mean by rounding, in steps.
HALF_DIAGONAL = 3.0**0.5 / 2.0

# Viewers show the first picture when layer 0 of a tile is here: after a tenth of the file, if there are eight of them.
_TILES = 8
_TILE_RANGE = (1 << 14, _spec.TILE_SPLATS_MAX)  # splats per tile; at the least, files are up to 1 % larger
_EXTENT_SAMPLE = 1 << 16  # splats on which the extent is estimated
_EDGE = 0.02  # fraction of the splats outside the extent on either side of an axis
_BITS_MAX = 16  # bits per axis of a tile
_STEP_MIN = 1e-250  # scene units
_GRID_TRIAL = 1024  # splats to test first, which most scenes that are not on a grid fail
_GRID_MIN = 0.8  # smallest step of a source's grid that is adopted, as a multiple of the chosen step
_STATISTICS_SAMPLE = 1 << 16  # splats
_RUNS = 16  # runs of neighbours in the sample
_NEIGHBOUR_DISTANCE = 8  # positions in Morton order
_COLOUR_DIFFERENCE_MAX = 10.0  # sh0; a larger difference is an outlier, and counts as this
_CORE = 0.8  # fraction of the splats within the reach of a scene or part
_STEP_SHARE_MIN = 2.0**-40  # smallest step of the means, as a fraction of the reach of the scene's core
_CONTRAST_DEFAULT = 0.2  # contrast of a scene without pairs of neighbours
_LEVELS_RANGE = (8, 255)  # opacity and rotation levels that the quality may choose
_SCALE_STEP_MAX = 0.5  # log scale; largest step that the quality may choose
_CODE_BITS = 16  # bits per axis of a Morton code
_CELLS_MAX = 1e38  # cells per scene unit, within float32


@dataclass(frozen=True)
class Lattice:
    """The lattice of the means.

    Attributes:
        step: step of the file, scene units, > 0.
        bits: maximum number of bits per axis and tile, 1 to 16; a tile whose box needs more is split or coarsened.
        finest: tiles use all their bits instead of stopping at `step`; set if the caller specified bits.
        error: largest displacement of a mean, scene units, which tiles are split and made finer to keep, regardless of
            their number; `None`: as the step gives it.
        parts: parts of the scene with steps of their own.
        octaves: <= 0, the step of each part, and of the rest, is the file's times 2**octaves.
    """

    step: float
    bits: int
    finest: bool = False
    error: float | None = None
    parts: tuple[ScenePart, ...] = ()
    octaves: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class StepFactors:
    """Steps of a quantisation class relative to the file's.

    Attributes:
        opacities, quats: k >= 1, integers are multiples of k.
        scales, means, sh0: k >= 0, the step is the file's times 2**k.
    """

    opacities: int = 1
    scales: int = 0
    quats: int = 1
    means: int = 0
    sh0: int = 0


SAME_STEPS = StepFactors()


@dataclass(frozen=True)
class CodingParameters:
    """Steps, levels and codings of a file.

    Attributes:
        lattice: lattice of the means.
        morton: means are coded MORTON and splats are sorted; otherwise AXIS, in the model's order.
        scale_step, sh0_step, sh_step: lattice steps, rounded to float32.
        opacity_levels, quat_levels: M of spec 7.3 and 7.5.
        chroma_shift: chroma is coarser than luma by 2**chroma_shift.
        sh_degree: SH degree to keep.
        codebook_step: lattice step of the bands from 1 on with a codebook, whose entries deserve more precision.
        codebook_share: number of codebook entries per splat.
        codebook_most: maximum number of codebook entries.
        escape_fraction: fraction of the splats to escape.
        escape_coarse: escapes are rounded to multiples of 2**escape_coarse steps.
        sh_coding: "auto", "codebook", "scalar" or "none"; "auto" until `choose_sh_coding`.
        adaptive: exponent by which SH gets coarser with falling importance, 0 to 1.
        tile_splats: maximum number of splats per tile.
        deflate: level and library of DEFLATE.
        canonical: keep the axis order of shapes, which was canonical before tuning; the file then contains the integers
            that tuning was based on, even if a shape crossed the boundary of canonical order.
        sorts_axes: sort the axes of shapes by scale; otherwise the rotations of a quantised source stay on its lattice.
        square_opacities: levels are equidistant in the square root of alpha, otherwise in alpha.
    """

    lattice: Lattice
    morton: bool
    scale_step: float
    opacity_levels: int
    quat_levels: int
    sh0_step: float
    sh_step: float
    chroma_shift: int
    sh_degree: int
    codebook_step: float
    codebook_share: float
    codebook_most: int
    escape_fraction: float
    escape_coarse: int
    sh_coding: str
    adaptive: float
    tile_splats: int
    deflate: DeflateSettings
    canonical: bool = False
    sorts_axes: bool = True
    square_opacities: bool = True

    def __post_init__(self) -> None:
        for name in ("scale_step", "sh0_step", "sh_step", "codebook_step"):  # ATT-10: "a binary32 value"
            object.__setattr__(self, name, float(np.float32(getattr(self, name))))

    @property
    def sh_coefficients(self) -> int:
        """Number of coefficients of the bands 1 to `sh_degree`."""
        return (self.sh_degree + 1) ** 2 - 1

    def attribute_records(self) -> list[_spec.AttributeRecord]:
        """Return the attribute records of the file (spec 4.3.1)."""
        lattice, ycocg = _spec.MAPPING_LATTICE, _spec.MAPPING_YCOCG
        levels = self.opacity_levels, self.quat_levels
        shift = self.chroma_shift
        opacities = _spec.MAPPING_SQUARE if self.square_opacities else _spec.MAPPING_LINEAR
        records = [
            _spec.AttributeRecord(_spec.ATTRIBUTE_OPACITIES, opacities, 0, 0, levels[0], 0.0),
            _spec.AttributeRecord(_spec.ATTRIBUTE_SCALES, lattice, 0, 0, 0, self.scale_step),
            _spec.AttributeRecord(_spec.ATTRIBUTE_QUATS, _spec.MAPPING_UNIT_W, 0, 0, levels[1], 0.0),
            _spec.AttributeRecord(_spec.ATTRIBUTE_MEANS, lattice, 0, 0, 0, self.lattice.step),
            _spec.AttributeRecord(_spec.ATTRIBUTE_SH0, ycocg, shift, 0, 0, self.sh0_step),
        ]
        for band in range(1, self.sh_degree + 1):
            attribute = _spec.ATTRIBUTE_SH0 + band
            records.append(_spec.AttributeRecord(attribute, ycocg, shift, 0, 0, self.sh_step))
        return records


def choose_parameters(
    model: SplatModel, options: EncodeOptions, *, importance_given: bool, contrast: float | None = None
) -> CodingParameters:
    """Choose the coding parameters of a scene.

    Args:
        model: the scene.
        options: the caller's options.
        importance_given: the caller specifies the importance of the splats.
        contrast: contrast of the scene that the model is a sample of; see `contrast_of`.
    """
    preset = (QUANTISED_PRESETS if model.metadata.quantised else PRESETS)[options.preset]
    degree = options.kept_degree(model.sh_degree)
    if options.sh_coding == "none":
        degree = 0
    sh_coding = preset.sh_coding if options.sh_coding == "auto" else options.sh_coding
    quality = preset.quality[0 if degree else 1]
    sh_quality = preset.sh_quality
    if options.attribute_psnr is not None:
        quality, sh_quality = options.attribute_psnr, options.attribute_psnr + preset.sh_quality - preset.quality[0]
    statistics = scene_statistics(model, contrast)
    steps = _steps(statistics, quality, sh_quality, has_sh=degree > 0)
    return CodingParameters(
        lattice=_lattice(model, options, steps.means, statistics),
        morton=options.means_coding != "axis",
        scale_step=_default_to(options.scale_step, _source_step(model.scales, steps.scales)),
        opacity_levels=_default_to(options.opacity_levels, steps.opacity_levels),
        quat_levels=_default_to(options.quat_levels, steps.quat_levels),
        sh0_step=_default_to(options.sh0_step, steps.sh0),
        sh_step=_default_to(options.sh_step, steps.sh),
        codebook_step=_default_to(options.sh_step, steps.sh / 2**preset.codebook_finer),
        codebook_share=preset.codebook_share,
        codebook_most=preset.codebook_most,
        escape_fraction=preset.escape_fraction,
        escape_coarse=0 if options.sh_step else preset.codebook_finer,
        chroma_shift=_default_to(options.chroma_shift, 1),
        sh_degree=degree,
        sh_coding=sh_coding if degree else "none",
        adaptive=_default_to(options.adaptive, preset.adaptive if importance_given else 0.0),
        tile_splats=tile_limit(len(model), options),
        deflate=DeflateSettings(
            level=_default_to(options.deflate_level, preset.deflate_level), library=deflate_library(options.deflate)
        ),
    )


def tile_limit(count: int, options: EncodeOptions) -> int:
    """Return the maximum number of splats per tile, 1 to 65536, of a scene of `count` splats."""
    return options.tile_splats or int(np.clip(math.ceil(count / _TILES), *_TILE_RANGE))


def band_slice(band: int) -> slice:
    """Return the slice of an SH band among the coefficients of the bands from 1 on."""
    return slice(band * band - 1, (band + 1) ** 2 - 1)


@dataclass(frozen=True)
class SceneStatistics:
    """Statistics of a scene, the largest of any part or the rest.

    Attributes:
        reach: radius around the median of the means that contains 80 % of them, scene units, >= 0.
        contrast: rms colour difference of neighbouring splats, weighted by their opacities, in [0.02, 1].
        size: median of the largest standard deviation, as a fraction of the reach, in [1e-4, 1].
        parts, octaves: see `Lattice`.
    """

    reach: float
    contrast: float
    size: float
    parts: tuple[ScenePart, ...] = ()
    octaves: tuple[int, ...] = (0,)


def scene_statistics(model: SplatModel, contrast: float | None = None) -> SceneStatistics:
    """Measure a scene on a deterministic sample.

    Args:
        model: the scene.
        contrast: contrast of the scene, if the model is a sample, which has no neighbours; see `contrast_of`.
    """
    if len(model) == 0:
        return SceneStatistics(reach=0.0, contrast=_CONTRAST_DEFAULT, size=0.01)
    rows = _sample_rows(len(model))
    points = np.take(model.means, rows, axis=0).astype(np.float64)
    scales = np.take(model.scales, rows, axis=0)
    parts = find_parts(points, scales)
    index = part_of(points, parts)
    counts = np.bincount(index, minlength=len(parts) + 1)
    if parts and counts[-1] < part_min(len(points)):
        counts[-1] = 0  # outliers
    groups = [number for number, count in enumerate(counts) if count]
    reaches, size = [0.0] * len(counts), 0.0
    for number in groups:
        reaches[number] = _reach(points[index == number])
        median = median_size(scales[index == number].max(axis=1))
        if parts:
            reaches[number] = max(reaches[number], median)
        size = max(size, median / reaches[number] if reaches[number] else 1.0)
    if contrast is None:
        plain = replace(model, shN=model.shN[:, :0], extra={})
        sums = [contrast_sums(part) for part in split_parts(plain, parts)]
        contrast = max(contrast_of([sums[number]]) for number in groups)
    reach = max(reaches)
    octaves = tuple(-max(0, ceil_log2(reach / own)) if own else 0 for own in reaches)
    size, contrast = float(np.clip(size, 1e-4, 1.0)), float(np.clip(contrast, 0.02, 1.0))
    return SceneStatistics(reach, contrast, size, parts, octaves)


def contrast_sums(part: SplatModel) -> tuple[float, float]:
    """Return what `contrast_of` takes of a part of a scene that has all splats of its region.

    Returns:
        Σ w d² and Σ w over pairs of splats `_NEIGHBOUR_DISTANCE` apart in Morton order, where d² is the mean over the
        channels of the squared difference of sh0, and w the product of the opacities. Both sums are 0 for few splats,
        or without an extent. In a large part, the pairs are a sample.
    """
    squares, weights = 0.0, 0.0
    if len(part) <= _NEIGHBOUR_DISTANCE:
        return squares, weights
    points = np.take(part.means, _sample_rows(len(part)), axis=0).astype(np.float64)
    reach = _reach(points)
    if not reach:
        return squares, weights
    # The grid spans a reach to either side of the median.
    for rows in _neighbour_runs(part.means, np.median(points, axis=0), 2.0 * reach):
        near, far = rows[:-_NEIGHBOUR_DISTANCE], rows[_NEIGHBOUR_DISTANCE:]
        weight = part.opacities[near].astype(np.float64) * part.opacities[far]
        difference = part.sh0[near].astype(np.float64) - part.sh0[far]
        difference = np.clip(difference, -_COLOUR_DIFFERENCE_MAX, _COLOUR_DIFFERENCE_MAX)
        squares += float((np.square(difference).mean(axis=1) * weight).sum())
        weights += float(weight.sum())
    return squares, weights


def contrast_of(parts: Iterable[tuple[float, float]]) -> float:
    """Return SH_C0 √(Σ w d² / Σ w), of the `contrast_sums` of parts of a scene; `_CONTRAST_DEFAULT` if Σ w is 0."""
    squares = weights = 0.0
    for part in parts:  # built-in sum rounds otherwise from Python 3.12 on
        squares, weights = squares + part[0], weights + part[1]
    return SH_C0 * float(np.sqrt(squares / weights)) if weights else _CONTRAST_DEFAULT


@dataclass(frozen=True)
class _AttributeSteps:
    """Steps and levels; `means` is 0 if the scene has no extent."""

    means: float
    scales: float
    opacity_levels: int
    quat_levels: int
    sh0: float
    sh: float


def _steps(statistics: SceneStatistics, quality: float, sh_quality: float, *, has_sh: bool) -> _AttributeSteps:
    """Choose the steps at which quantising one attribute leaves a PSNR of about `quality`, dB.

    The factors are medians over ten scenes of the step that leaves 50 dB, divided by the statistics; they scatter by a
    quarter to a third (2 to 3 dB). The rate is lowest if every dimension has the same error. The differences between
    attributes were determined by search, with and without SH.

    Args:
        statistics: statistics of the scene.
        quality: PSNR for each attribute except the SH bands from 1 on, before the differences above, dB.
        sh_quality: PSNR for these bands, dB.
        has_sh: the file has these bands.
    """
    contrast = statistics.contrast
    for_quats, for_sh0 = (0.0, -2.0) if has_sh else (-1.5, 2.5)

    def coarse(decibels: float) -> float:
        """Return the factor from a step that leaves 50 dB to one that leaves `decibels`."""
        return float(exp(log(10.0) * (50.0 - decibels) / 20.0))

    opacities = contrast / (0.012 * coarse(quality + for_quats))
    quats = contrast * math.sqrt(statistics.size * math.sqrt(statistics.size)) * 2090.0 / coarse(quality + for_quats)
    return _AttributeSteps(
        means=2.2e-4 * coarse(quality) * statistics.reach / contrast,
        scales=min(_SCALE_STEP_MAX, 0.04 * coarse(quality) / contrast),
        opacity_levels=int(np.clip(np.ceil(opacities), *_LEVELS_RANGE)),
        quat_levels=int(np.clip(np.ceil(quats), *_LEVELS_RANGE)),
        sh0=0.07 * coarse(quality + for_sh0),
        sh=0.0135 * coarse(sh_quality),
    )


def _default_to(option: Any, default: Any) -> Any:
    """Return an option, which may be 0, or the default if the caller left it `None`."""
    return default if option is None else option


def _lattice(model: SplatModel, options: EncodeOptions, by_quality: float, statistics: SceneStatistics) -> Lattice:
    """Choose the lattice of the means by the first option that is set, or by the quality.

    Args:
        model: the scene.
        options: `position_error`, `position_step`, and `position_bits`, which divide the extent of the scene's core.
        by_quality: step that the quality chooses, scene units; 0 if the scene has no extent.
        statistics: has the parts, whose steps follow the quality alone.
    """
    if options.position_error is not None:
        return Lattice(options.position_error / HALF_DIAGONAL, _BITS_MAX, error=options.position_error)
    if options.position_step is not None:
        return Lattice(options.position_step, _BITS_MAX)
    if len(model) == 0:
        return Lattice(1.0, _BITS_MAX)
    rows = slice(None, None, max(1, len(model) // _EXTENT_SAMPLE))
    points = np.sort(model.means[rows].astype(np.float64), axis=0)
    edge = int(len(points) * _EDGE)
    core = points[[edge, len(points) - 1 - edge]]
    extent = float((core[1] - core[0]).max()) or float((points[-1] - points[0]).max())
    reach = float(np.abs(core).max())
    if options.position_bits is not None:
        return Lattice(_clamp_step(extent / ((1 << options.position_bits) - 2), reach), options.position_bits, True)
    by_quality = by_quality or extent / (1 << _BITS_MAX)
    step = _clamp_step(_source_step(model.means, by_quality), reach)
    if step != by_quality:  # a grid holds every mean, or the step is at its limit: parts need no other
        return Lattice(step, _BITS_MAX)
    return Lattice(step, _BITS_MAX, parts=statistics.parts, octaves=statistics.octaves)


def _clamp_step(step: float, reach: float) -> float:
    """Raise a step to `_STEP_SHARE_MIN` of the reach; return 1 if it is then not finite or at most `_STEP_MIN`."""
    step = max(step, reach * _STEP_SHARE_MIN)
    return step if np.isfinite(step) and step > _STEP_MIN else 1.0


def _source_step(values: F32, step: float) -> float:
    """Return the step of the power-of-two grid of values [N, 3], or `step` if there is none or it is too fine.

    Means and log scales from SPZ are on such a grid, which represents them exactly in fewer bits.
    """
    if not (step > _STEP_MIN and values.any()):
        return step
    grid = math.ldexp(1.0, ceil_log2(_GRID_MIN * step))
    if not (on_grid(values[:_GRID_TRIAL], grid) and on_grid(values, grid)):
        return step
    while on_grid(values, 2.0 * grid):
        grid *= 2.0
    return grid


def on_grid(values: F32, grid: float) -> bool:
    """Return True if every value is a multiple of `grid`; an infinite value is on no grid."""
    with np.errstate(over="ignore", invalid="ignore"):
        return not np.fmod(values, np.float32(grid)).any()


def _sample_rows(count: int) -> NDArray[np.intp]:
    """Return evenly spaced rows: all below twice `_STATISTICS_SAMPLE`, otherwise 1 to 1.5 times as many as this."""
    return np.arange(0, count, max(1, count // _STATISTICS_SAMPLE))


def _reach(points: F64) -> float:
    """Return the radius around the median of points [n, 3], n > 0, with `_CORE` of them; 0 if all are equal."""
    distance = points - np.median(points, axis=0)
    top = float(np.abs(distance).max())
    if top == 0.0:
        return 0.0
    relative = np.sqrt(np.square(distance / top).sum(axis=1))  # squares of relative distances do not overflow
    return top * float(np.quantile(relative, _CORE))


def _neighbour_runs(means: F32, centre: NDArray[Any], side: float) -> list[NDArray[np.intp]]:
    """Return runs of rows in Morton order: one run of all splats of a small scene, up to `_RUNS` of a large scene.

    Runs of a large scene have about `_STATISTICS_SAMPLE` splats together; those with too few for a pair are omitted.

    Args:
        means: [N, 3].
        centre: [3], middle of the grid of Morton codes.
        side: side of the grid, scene units, > 0; means outside are moved to its border.
    """
    codes = np.empty(len(means), np.int64)
    scale = np.float32(min(1.0 / side, _CELLS_MAX))
    top = (1 << _CODE_BITS) - 1  # last cell of an axis
    shift = np.float32(0.5) - (centre / side).astype(np.float32)
    for start in range(0, len(means), _STATISTICS_SAMPLE):
        with np.errstate(over="ignore"):  # infinity is clipped to the grid
            positions = means[start : start + _STATISTICS_SAMPLE].T * scale + shift[:, None]
        codes[start : start + _STATISTICS_SAMPLE] = morton_codes((np.clip(positions, 0, 1) * top).astype(np.int32))
    if len(means) <= 2 * _STATISTICS_SAMPLE:
        return [np.argsort(codes, kind="stable")]
    bounds = np.sort(codes[:: len(codes) // _STATISTICS_SAMPLE])
    length = len(bounds) // _RUNS
    share = max(1, length * _STATISTICS_SAMPLE // len(means))
    runs = []
    for run in range(_RUNS):
        first, last = bounds[run * length], bounds[min(run * length + share, len(bounds) - 1)]
        rows = np.flatnonzero((codes >= first) & (codes <= last))
        if len(rows) > _NEIGHBOUR_DISTANCE:
            runs.append(rows[np.argsort(codes[rows], kind="stable")])
    return runs
