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

from csplat.encoder.curvature import GRADED, Curvatures, step_errors
from csplat.encoder.importance import trusted
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan
from csplat.encoder.tiling import Coarse
from csplat.model import SplatModel
from csplat.types import F64, U8

_SPLATS = 2500  # splats in a class, about: each tile has Huffman codes of its own
_MOST = 5
_FEWEST = 500  # splats; a smaller class joins others
_SAMPLE = 1 << 15  # splats that the steps of classes are computed from
_BLOCK = 1 << 16
_COMMON = 0.999  # fraction of the splats whose errors are not outliers
_ROUNDS = 30
_FINER, _COARSER = 4.0, 6.0  # octaves from the plan's steps, at most
_LARGEST_STEP = 1.0  # in log scale: the coarsest step of scales
_MOST_LEVELS = 255  # opacity or rotation levels, if no option sets more
_FEWEST_LEVELS = 3  # opacity or rotation levels, about: with 4, bytes jump by 7 % where whole multiples end
_ONE_BYTE = {"opacities": 255, "quats": 127}  # levels whose integers fit a byte plane
_KNOBS = {
    "opacities": ("opacity_levels",),
    "scales": ("scale_step",),
    "quats": ("quat_levels",),
    "means": ("position_bits", "position_step", "position_error"),
    "sh0": ("sh0_step",),
}


@dataclass(frozen=True, eq=False)
class Grades:
    """Quantisation class (grade) of each splat, and how much coarser its steps are than the file's.

    Attributes:
        index: [N] uint8; the finest class, whose tiles come first in a file, is 0.
        coarse: factors by which the steps are coarser, by class.
    """

    index: U8
    coarse: Sequence[Coarse]

    def as_json(self) -> dict[str, list[int]]:
        """Return the number of splats by class, and how much coarser their steps are."""
        counts = np.bincount(self.index, minlength=len(self.coarse))
        columns = {name: [getattr(one, name) for one in self.coarse] for name in GRADED}
        return {"splats": [int(count) for count in counts], **columns}


def choose_grades(
    model: SplatModel, curvatures: Curvatures | None, plan: Plan, options: EncodeOptions
) -> tuple[Plan, Grades | None]:
    """Sort the splats into grades, at about the picture error that the plan has in linear approximation, or less.

    Args:
        model: the scene.
        curvatures: curvatures of the splats, if known; without them, there is one class.
        plan: the lattices.
        options: `grades`, at most; and the knobs: what is set holds for all splats.

    Returns:
        The plan with the finest steps that a grade has, and the grades; or the plan as it was, and None.
    """
    count, free = most_grades(len(model), options), _free(options)
    if curvatures is None or count < 2:
        return plan, None
    integers = np.array([GRADED[name] for name in free], np.float64)
    errors = step_errors(model, curvatures, plan)[:, [list(GRADED).index(name) for name in free]]
    if not np.isfinite(errors).all():
        return plan, None  # a scene so large or small that float64 does not hold its squares
    # One splat in front of a camera must not determine how precise all others have to be.
    errors = np.minimum(errors, np.quantile(errors, _COMMON, axis=0))
    # Bounded levels, which the plan would otherwise have made finer, do not show how much error is acceptable.
    bounded = {"opacities": plan.opacity_levels >= _MOST_LEVELS, "quats": plan.quat_levels >= _MOST_LEVELS}
    says = np.array([not bounded.get(name, False) for name in free])
    allowed = errors[:, says].mean(axis=0).sum() / max(1.0, integers[says].sum())
    if not allowed > 0.0:
        return plan, None
    relative: F64 = trusted(errors, model) / allowed
    octaves = _clustered(relative, integers, count)
    return _as_steps(plan, _assigned(relative, integers, octaves), octaves, free)


def most_grades(count: int, options: EncodeOptions) -> int:
    """Return the maximum number of classes for `count` splats with known curvatures; 1: they are not sorted."""
    if options.shape_codebook_size or not _free(options):
        return 1
    asked = options.grades or (1 if options.preset == "fast" else _MOST)
    return max(1, min(asked, round(count / _SPLATS)))


def _free(options: EncodeOptions) -> list[str]:
    """Attributes whose steps no knob sets."""
    return [name for name in GRADED if all(getattr(options, knob) is None for knob in _KNOBS[name])]


def _clustered(errors: F64, integers: F64, count: int) -> F64:
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
        before, places = places, _assigned(sample, integers, octaves)
        if (places == before).all():
            break
        octaves = _octaves(sample, places, integers)
    splats = np.bincount(places)[np.unique(places)] * (len(errors) / len(sample))
    large: F64 = octaves[splats >= min(_FEWEST, splats.max())]
    return large[np.argsort((integers * large).sum(axis=1), kind="stable")]


def _octaves(errors: F64, places: U8, integers: F64) -> F64:
    """The best steps of the grades that have splats: those at which integers add 1 each, on average."""
    counts = np.bincount(places)
    sums = np.stack([np.bincount(places, column) for column in errors.T], axis=1)
    means = sums[counts > 0] / counts[counts > 0, None]
    best: F64 = 0.5 * np.log2(integers / np.maximum(means, np.finfo(np.float64).tiny))
    return np.clip(best, -_FINER, _COARSER)


def _assigned(errors: F64, integers: F64, octaves: F64) -> U8:
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


def _as_steps(plan: Plan, index: U8, octaves: F64, free: Sequence[str]) -> tuple[Plan, Grades | None]:
    """Steps of the file that are those of the finest grade, and whole multiples of them for the others."""
    used = np.unique(index)
    if len(used) < 2:
        return plan, None
    levels = {"opacities": plan.opacity_levels, "quats": plan.quat_levels}
    steps = {"scales": plan.scale_step, "means": plan.lattice.step, "sh0": plan.sh0_step}
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
    plan = replace(
        plan,
        lattice=replace(plan.lattice, step=steps["means"]),
        scale_step=steps["scales"],
        sh0_step=steps["sh0"],
        opacity_levels=levels["opacities"],
        quat_levels=levels["quats"],
    )
    by_grade = [Coarse(**{name: coarse[name][grade] for name in free}) for grade in range(len(used))]
    return plan, Grades(np.searchsorted(used, index).astype(np.uint8), by_grade)


def _coarser_levels(levels: int, octaves: F64, one_byte: int) -> tuple[int, list[int]]:
    """Return the levels that the finest class needs and a byte holds, and multiples of their step for the others."""
    most = one_byte if levels <= one_byte else max(levels, _MOST_LEVELS)
    finest = min(max(_FEWEST_LEVELS, round(levels * 2.0 ** -float(octaves.min()))), most)
    coarsest = max(1, finest // _FEWEST_LEVELS)
    return finest, [min(max(1, round(finest / levels * 2.0 ** float(octave))), coarsest) for octave in octaves]
