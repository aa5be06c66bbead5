"""First stage: what to model, and on which lattices. One number, the quality, becomes all steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from csplat import _spec
from csplat.encoder.options import PRESETS, EncodeOptions
from csplat.encoder.statistics import Statistics, scene_statistics
from csplat.encoder.streams import Coding, deflate_library
from csplat.encoder.tiling import Lattice
from csplat.model import SplatModel
from csplat.types import F32

_SAMPLE = 1 << 16  # splats from which sizes and extents are estimated
_EDGE = 0.02  # share of splats on either side that does not count as the scene's extent
_MOST_BITS = 16  # per axis of a tile
_LEAST_STEP = 1e-250
_LOOK = 1024  # splats of which few scenes pass for multiples of a power of two
_FINER = 0.8  # of a step: how fine the source's grid may be, and be worth its bits
_HALF_DIAGONAL = 3.0**0.5 / 2.0  # of a lattice cell, in steps: no centre is moved farther


@dataclass(frozen=True)
class Plan:
    """Everything that is decided before the first splat is quantised.

    Attributes:
        lattice: of the means.
        morton: means are coded MORTON and splats are sorted; otherwise AXIS, in the model's order.
        sh_degree: bands that are kept.
        scale_step, sh0_step, sh_step: lattice steps, rounded to float32.
        sh_coding: "auto", "codebook", "scalar" or "none"; the SH stage settles "auto".
        codebook_step: lattice step of the bands 1 to 3 if they get a codebook, whose entries are worth more precision.
        codebook_share: entries per splat.
        codebook_most: entries at most.
        escape_fraction: share of the splats that are coded directly.
        escape_coarse: their values are multiples of 2**escape_coarse steps.
        coding: how streams are coded.
        gauged: rotations and scales are in their gauge, and are to stay as they are, though they may have left it a
            little: the integers that the tuning of a frozen scene saw are those that are written.
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
    coding: Coding
    gauged: bool = False

    def __post_init__(self) -> None:
        for name in ("scale_step", "sh0_step", "sh_step", "codebook_step"):  # ATT-10: "a binary32 value"
            object.__setattr__(self, name, float(np.float32(getattr(self, name))))

    def attribute_records(self) -> list[_spec.AttributeRecord]:
        """Return the file's attribute records (spec 4.3.1)."""
        lattice, ycocg = _spec.MAPPING_LATTICE, _spec.MAPPING_YCOCG
        levels = self.opacity_levels, self.quat_levels
        shift = self.chroma_shift
        records = [
            _spec.AttributeRecord(_spec.ATTRIBUTE_OPACITIES, _spec.MAPPING_SQUARE, 0, 0, levels[0], 0.0),
            _spec.AttributeRecord(_spec.ATTRIBUTE_SCALES, lattice, 0, 0, 0, self.scale_step),
            _spec.AttributeRecord(_spec.ATTRIBUTE_QUATS, _spec.MAPPING_UNIT_W, 0, 0, levels[1], 0.0),
            _spec.AttributeRecord(_spec.ATTRIBUTE_MEANS, lattice, 0, 0, 0, self.lattice.step),
            _spec.AttributeRecord(_spec.ATTRIBUTE_SH0, ycocg, shift, 0, 0, self.sh0_step),
        ]
        for band in range(1, self.sh_degree + 1):
            attribute = _spec.ATTRIBUTE_SH0 + band
            records.append(_spec.AttributeRecord(attribute, ycocg, shift, 0, 0, self.sh_step))
        return records


def make_plan(
    model: SplatModel, options: EncodeOptions, *, importance_given: bool, contrast: float | None = None
) -> Plan:
    """Resolve options, preset and scene, of which `contrast` may be known, into a plan."""
    preset = PRESETS[options.preset]
    degree = model.sh_degree if options.sh_degree is None else min(options.sh_degree, model.sh_degree)
    if options.sh_coding == "none":
        degree = 0
    coding = preset.sh_coding if options.sh_coding == "auto" else options.sh_coding
    quality = preset.quality[0 if degree else 1]
    sh_quality = preset.sh_quality
    if options.attribute_psnr is not None:
        quality, sh_quality = options.attribute_psnr, options.attribute_psnr + preset.sh_quality - preset.quality[0]
    statistics = scene_statistics(model, contrast)
    steps = _steps(statistics, quality, sh_quality, has_sh=degree > 0)
    return Plan(
        lattice=_lattice(model, options, steps.means),
        morton=options.means_coding != "axis",
        scale_step=_first(options.scale_step, _source_step(model.scales, steps.scales)),
        opacity_levels=_first(options.opacity_levels, steps.opacity_levels),
        quat_levels=_first(options.quat_levels, steps.quat_levels),
        sh0_step=_first(options.sh0_step, steps.sh0),
        sh_step=_first(options.sh_step, steps.sh),
        codebook_step=_first(options.sh_step, steps.sh / 2**preset.codebook_finer),
        codebook_share=preset.codebook_share,
        codebook_most=preset.codebook_most,
        escape_fraction=preset.escape_fraction,
        escape_coarse=0 if options.sh_step else preset.codebook_finer,
        chroma_shift=_first(options.chroma_shift, 1),
        sh_degree=degree,
        sh_coding=coding if degree else "none",
        adaptive=_first(options.adaptive, preset.adaptive if importance_given else 0.0),
        tile_splats=options.tile_splats,
        coding=Coding(
            level=_first(options.deflate_level, preset.deflate_level),
            library=deflate_library(options.deflate),
        ),
    )


@dataclass(frozen=True)
class _Steps:
    """Lattice steps and level counts; `means` is 0 where the scene has no extent."""

    means: float
    scales: float
    opacity_levels: int
    quat_levels: int
    sh0: float
    sh: float


def _steps(statistics: Statistics, quality: float, sh_quality: float, *, has_sh: bool) -> _Steps:
    """Choose the steps at which each attribute alone costs about `quality` dB.

    The factors are the medians over ten scenes of the step that costs 50 dB, divided by the scene's statistics; a
    quarter to a third of spread remains (2 to 3 dB). Bits are spent best where every dimension errs alike; the
    differences of quality between attributes are where that was found to lie, with and without SH.
    """
    contrast = statistics.contrast
    for_quats, for_sh0 = (0.0, -2.0) if has_sh else (-1.5, 2.5)

    def coarse(decibels: float) -> float:
        return float(10.0 ** ((50.0 - decibels) / 20.0))

    opacities = contrast / (0.012 * coarse(quality + for_quats))
    quats = contrast * statistics.size**0.75 * 2090.0 / coarse(quality + for_quats)
    return _Steps(
        means=2.2e-4 * coarse(quality) * statistics.reach / contrast,
        scales=min(0.5, 0.04 * coarse(quality) / contrast),
        opacity_levels=int(np.clip(np.ceil(opacities), 8, 255)),
        quat_levels=int(np.clip(np.ceil(quats), 8, 255)),
        sh0=0.07 * coarse(quality + for_sh0),
        sh=0.0135 * coarse(sh_quality),
    )


def _first(chosen: Any, otherwise: Any) -> Any:
    return otherwise if chosen is None else chosen


def _lattice(model: SplatModel, options: EncodeOptions, wanted: float) -> Lattice:
    """Choose the means' step: given, from an error, from bits over the core of the scene, or by the quality."""
    if options.position_error is not None:
        return Lattice(options.position_error / _HALF_DIAGONAL, _MOST_BITS, strict=True)
    if options.position_step is not None:
        return Lattice(options.position_step, _MOST_BITS)
    if len(model) == 0:
        return Lattice(1.0, _MOST_BITS)
    rows = slice(None, None, max(1, len(model) // _SAMPLE))
    points = np.sort(model.means[rows].astype(np.float64), axis=0)
    edge = int(len(points) * _EDGE)
    core = points[[edge, len(points) - 1 - edge]]
    extent = float((core[1] - core[0]).max()) or float((points[-1] - points[0]).max())
    reach = float(np.abs(core).max())
    if options.position_bits is not None:
        return Lattice(_usable(extent / ((1 << options.position_bits) - 2), reach), options.position_bits, True)
    step = _source_step(model.means, wanted or extent / (1 << _MOST_BITS))
    return Lattice(_usable(step, reach), _MOST_BITS)


def _source_step(values: F32, step: float) -> float:
    """Return the grid that the values lie on, where none finer is wanted: they come back as they were, in fewer bits.

    Centres and log scales of SPZ, and of what was SPZ once, are multiples of a power of two.
    """
    if not (step > _LEAST_STEP and values.any()):
        return step
    grid = 2.0 ** math.ceil(math.log2(_FINER * step))
    if not (_on_grid(values[:_LOOK], grid) and _on_grid(values, grid)):
        return step
    while _on_grid(values, 2.0 * grid):
        grid *= 2.0
    return grid


def _on_grid(values: F32, grid: float) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return not np.fmod(values, np.float32(grid)).any()


def _usable(step: float, reach: float) -> float:
    """Keep the step normal, and no finer than float32 is at the end of the scene's core."""
    step = max(step, reach * 2.0**-40)
    return step if np.isfinite(step) and step > _LEAST_STEP else 1.0
