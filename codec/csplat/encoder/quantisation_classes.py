"""Quantisation classes (grades): splats whose errors are equally visible share tiles, and each class has its own steps.

If a step is twice as coarse, the squared error of renders grows fourfold and an integer takes a bit less; so bits
are spent best if every integer adds as much error as any other. Splats differ in that by orders of magnitude. The
format has no steps by splat, but each tile may coarsen the file's lattices by powers of two, and tiles may overlap:
those of all classes fill the same space. Coding the class of each splat has a cost (centres lie less densely in a tile
of fewer), which is recovered because sizes, opacities and colours within a class are alike.

Splats are assigned as in k-means, by the bytes that they would cost at equal error (the divergence is that of Itakura
and Saito); the steps of a class follow from the mean errors of its splats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from csplat.encoder.coding_parameters import CodingParameters, StepFactors
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.weights import CLASSED_ATTRIBUTES, GaussNewtonBlocks, apply_weight_floor, rounding_errors
from csplat.model import SplatModel
from csplat.types import F64, U8

_SPLATS_PER_CLASS = 2500  # splats in a class, about: each tile has Huffman codes of its own
_CLASSES_MAX = 5
_CLASS_SPLATS_MIN = 500  # splats; a smaller class joins others
_SAMPLE = 1 << 15  # splats that the steps of classes are computed from
_BLOCK = 1 << 16
_COMMON = 0.999  # fraction of the splats whose errors are not outliers
_ROUNDS = 30
_FINER, _COARSER = 4.0, 6.0  # octaves from the plan's steps, at most
_LARGEST_STEP = 1.0  # in log scale: the coarsest step of scales
_LEVELS_MAX = 255  # opacity or rotation levels, if no option sets more
_LEVELS_MIN = 3  # opacity or rotation levels, about: with 4, bytes jump by 7 % where whole multiples end
_ONE_BYTE = {"opacities": 255, "quats": 127}  # levels whose integers fit a byte plane
_KNOBS = {
    "opacities": ("opacity_levels",),
    "scales": ("scale_step",),
    "quats": ("quat_levels",),
    "means": ("position_bits", "position_step", "position_error"),
    "sh0": ("sh0_step",),
}


@dataclass(frozen=True, eq=False)
class QuantisationClasses:
    """Quantisation class (grade) of each splat, and how much coarser its steps are than the file's.

    Attributes:
        index: [N] uint8; the finest class, whose tiles come first in a file, is 0.
        coarse: factors by which the steps are coarser, by class.
    """

    index: U8
    factors: Sequence[StepFactors]

    def as_json(self) -> dict[str, list[int]]:
        """Return the number of splats by class, and how much coarser their steps are."""
        counts = np.bincount(self.index, minlength=len(self.factors))
        columns = {name: [getattr(one, name) for one in self.factors] for name in CLASSED_ATTRIBUTES}
        return {"splats": [int(count) for count in counts], **columns}


def choose_classes(
    model: SplatModel, curvatures: GaussNewtonBlocks | None, parameters: CodingParameters, options: EncodeOptions
) -> tuple[CodingParameters, QuantisationClasses | None]:
    """Sort the splats into grades, at about the picture error that the plan has in linear approximation, or less.

    Args:
        model: the scene.
        curvatures: curvatures of the splats, if known; without them, there is one class.
        parameters: the lattices.
        options: `grades`, at most; and the knobs: what is set holds for all splats.

    Returns:
        The plan with the finest steps that a grade has, and the grades; or the plan as it was, and None.
    """
    count, free = max_class_count(len(model), options), _free_attributes(options)
    if curvatures is None or count < 2:
        return parameters, None
    integers = np.array([CLASSED_ATTRIBUTES[name] for name in free], np.float64)
    errors = rounding_errors(model, curvatures, parameters)[:, [list(CLASSED_ATTRIBUTES).index(name) for name in free]]
    if not np.isfinite(errors).all():
        return parameters, None  # a scene so large or small that float64 does not hold its squares
    # One splat in front of a camera must not determine how precise all others have to be.
    errors = np.minimum(errors, np.quantile(errors, _COMMON, axis=0))
    # Bounded levels, which the plan would otherwise have made finer, do not show how much error is acceptable.
    bounded = {"opacities": parameters.opacity_levels >= _LEVELS_MAX, "quats": parameters.quat_levels >= _LEVELS_MAX}
    says = np.array([not bounded.get(name, False) for name in free])
    allowed = errors[:, says].mean(axis=0).sum() / max(1.0, integers[says].sum())
    if not allowed > 0.0:
        return parameters, None
    relative: F64 = apply_weight_floor(errors, model) / allowed
    octaves = _cluster_octaves(relative, integers, count)
    return _as_steps(parameters, _assign_classes(relative, integers, octaves), octaves, free)


def max_class_count(count: int, options: EncodeOptions) -> int:
    """Return the maximum number of classes for `count` splats with known curvatures; 1: they are not sorted."""
    if options.shape_codebook_size or not _free_attributes(options):
        return 1
    asked = options.grades or (1 if options.preset == "fast" else _CLASSES_MAX)
    return max(1, min(asked, round(count / _SPLATS_PER_CLASS)))


def _free_attributes(options: EncodeOptions) -> list[str]:
    """Attributes whose steps no knob sets."""
    return [name for name in CLASSED_ATTRIBUTES if all(getattr(options, knob) is None for knob in _KNOBS[name])]


def _cluster_octaves(errors: F64, integers: F64, count: int) -> F64:
    """Octaves [K, A] by which the steps of at most `count` grades differ from the plan's, the finest grade first.

    Args:
        errors: [N, A], of splats and attributes at the plan's steps; 1 is what an integer is to add.
        integers: [A], that an attribute has.
        count: K at most.
    """
    sample = errors[:: max(1, len(errors) // _SAMPLE)]
    energy = (integers * np.log(np.maximum(sample, np.finfo(np.float64).tiny))).sum(axis=1)
    places = np.empty(len(sample), np.uint8)
    places[np.argsort(energy, kind="stable")] = np.arange(len(sample)) * count // len(sample)
    octaves = _octaves(sample, places, integers)
    for _ in range(_ROUNDS):
        before, places = places, _assign_classes(sample, integers, octaves)
        if (places == before).all():
            break
        octaves = _octaves(sample, places, integers)
    splats = np.bincount(places)[np.unique(places)] * (len(errors) / len(sample))
    large: F64 = octaves[splats >= min(_CLASS_SPLATS_MIN, splats.max())]
    return large[np.argsort((integers * large).sum(axis=1), kind="stable")]


def _octaves(errors: F64, places: U8, integers: F64) -> F64:
    """The best steps of the grades that have splats: those at which integers add 1 each, on average."""
    counts = np.bincount(places)
    sums = np.stack([np.bincount(places, column) for column in errors.T], axis=1)
    means = sums[counts > 0] / counts[counts > 0, None]
    best: F64 = 0.5 * np.log2(integers / np.maximum(means, np.finfo(np.float64).tiny))
    return np.clip(best, -_FINER, _COARSER)


def _assign_classes(errors: F64, integers: F64, octaves: F64) -> U8:
    """Return the class of each splat, [N]: the one with the fewest bits, its error counted in bits too."""
    grown, saved = 4.0**octaves / (2.0 * math.log(2.0)), (integers * octaves).sum(axis=1)
    index = np.zeros(len(errors), np.uint8)
    for at in range(0, len(errors), _BLOCK):
        columns = np.ascontiguousarray(errors[at : at + _BLOCK].T)  # five long rows are added up far faster
        least = np.full(columns.shape[1], np.inf)
        for grade, factors in enumerate(grown):
            cost = sum(factor * column for factor, column in zip(factors, columns, strict=True)) - saved[grade]
            index[at : at + _BLOCK][cost < least] = grade
            least = np.minimum(cost, least)
    return index


def _as_steps(
    parameters: CodingParameters, index: U8, octaves: F64, free: Sequence[str]
) -> tuple[CodingParameters, QuantisationClasses | None]:
    """Steps of the file that are those of the finest grade, and whole multiples of them for the others."""
    used = np.unique(index)
    if len(used) < 2:
        return parameters, None
    levels = {"opacities": parameters.opacity_levels, "quats": parameters.quat_levels}
    steps = {"scales": parameters.scale_step, "means": parameters.lattice.step, "sh0": parameters.sh0_step}
    coarse: dict[str, list[int]] = {}
    for column, name in enumerate(free):
        wanted = octaves[used, column]
        if name in levels:
            levels[name], coarse[name] = _coarser_levels(levels[name], wanted, _ONE_BYTE[name])
            continue
        if name == "scales":
            wanted = np.minimum(wanted, math.log2(_LARGEST_STEP / steps[name]))
        steps[name] *= 2.0 ** float(wanted.min())
        coarse[name] = [round(octave) for octave in wanted - wanted.min()]
    parameters = replace(
        parameters,
        lattice=replace(parameters.lattice, step=steps["means"]),
        scale_step=steps["scales"],
        sh0_step=steps["sh0"],
        opacity_levels=levels["opacities"],
        quat_levels=levels["quats"],
    )
    by_grade = [StepFactors(**{name: coarse[name][grade] for name in free}) for grade in range(len(used))]
    return parameters, QuantisationClasses(np.searchsorted(used, index).astype(np.uint8), by_grade)


def _coarser_levels(levels: int, octaves: F64, one_byte: int) -> tuple[int, list[int]]:
    """Return the levels that the finest class needs and a byte holds, and multiples of their step for the others."""
    most = one_byte if levels <= one_byte else max(levels, _LEVELS_MAX)
    finest = min(max(_LEVELS_MIN, round(levels * 2.0 ** -float(octaves.min()))), most)
    coarsest = max(1, finest // _LEVELS_MIN)
    return finest, [min(max(1, round(finest / levels * 2.0 ** float(octave))), coarsest) for octave in octaves]
