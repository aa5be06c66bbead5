# SPDX-License-Identifier: Apache-2.0
"""Choose quantisation classes: splats whose errors are equally visible share tiles, and each class has its own steps.

Doubling a step multiplies the squared error of renders by four and saves a bit per integer. The rate at a given
distortion is therefore lowest if every integer adds the same error. With equal steps, the errors of splats differ by
orders of magnitude, and the format has no steps per splat. A tile may, however, coarsen the file's lattices by powers
of two, and the tiles of different classes may overlap. The means then take more bytes, as they are less dense in a
tile; scales, opacities and colours take fewer, as they are similar within a class.

Splats are clustered as in k-means, with the rate at equal distortion in place of squared distances (the Itakura-Saito
divergence). Let the steps of class k differ from the chosen steps by o_ka octaves for attribute a, which has m_a
integers. The cost of a splat with relative errors e_a, in bits, is
    Σ_a e_a 4^o_ka / (2 ln 2) - m_a o_ka.
For the mean error ē_a of the class, it is least for o_ka = ½ log2(m_a / ē_a).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from csplat.encoder.coding_parameters import CodingParameters, StepFactors
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.splat_importance import CLASSED_ATTRIBUTES, GaussNewtonBlocks, apply_weight_floor, rounding_errors
from csplat.model import SplatModel
from csplat.types import F64, U8

_SPLATS_PER_CLASS = 2500  # minimum mean; with fewer, the Huffman codes of more tiles cost more than classes save
_CLASSES_MAX = 5  # maximum number of classes by default
_CLASS_SPLATS_MIN = 500  # splats; smaller classes are merged into others
_SAMPLE = 1 << 15  # splats on which the steps of classes are computed
_BLOCK = 1 << 16  # splats per block of temporaries
_COMMON = 0.999  # quantile to which errors are clipped
_ROUNDS_MAX = 30  # maximum number of iterations
_FINER, _COARSER = 4.0, 6.0  # maximum deviation from the chosen steps, octaves
_SCALE_STEP_MAX = 1.0  # log scale
_LEVELS_MAX = 255  # maximum opacity or rotation levels by default
_LEVELS_MIN = 3  # opacity or rotation levels of the coarsest class; with 4, bytes jump by 7 % between multiples
_ONE_BYTE = {"opacities": 255, "quats": 127}  # maximum levels whose integers fit one byte plane
_OPTIONS = {  # options that set the step of an attribute
    "opacities": ("opacity_levels",),
    "scales": ("scale_step",),
    "quats": ("quat_levels",),
    "means": ("position_bits", "position_step", "position_error"),
    "sh0": ("sh0_step",),
}


@dataclass(frozen=True, eq=False)
class QuantisationClasses:
    """The class of each splat, and the steps of each class relative to the file's.

    Attributes:
        index: [N] uint8; 0 is the finest class, whose tiles come first in a file.
        factors: step factors of each class.
    """

    index: U8
    factors: Sequence[StepFactors]

    def as_json(self) -> dict[str, list[int]]:
        """Return the number of splats and the step factors of each class."""
        counts = np.bincount(self.index, minlength=len(self.factors))
        columns = {name: [getattr(factors, name) for factors in self.factors] for name in CLASSED_ATTRIBUTES}
        return {"splats": [int(count) for count in counts], **columns}


def choose_classes(
    model: SplatModel, blocks: GaussNewtonBlocks | None, parameters: CodingParameters, options: EncodeOptions
) -> tuple[CodingParameters, QuantisationClasses | None]:
    """Assign the splats to classes, keeping the error of renders at about the level of the chosen steps or below.

    Args:
        model: the scene.
        blocks: Gauss-Newton blocks of the splats; `None`: there is only one class.
        parameters: the chosen steps.
        options: `max_classes`, and options that set the step of an attribute for all splats.

    Returns:
        The parameters with the steps of the finest class, and the classes; or the unchanged parameters, and `None`.
    """
    count, free = max_class_count(len(model), options), _free_attributes(options)
    if blocks is None or count < 2:
        return parameters, None
    integers = np.array([CLASSED_ATTRIBUTES[name] for name in free], np.float64)
    errors = rounding_errors(model, blocks, parameters)[:, [list(CLASSED_ATTRIBUTES).index(name) for name in free]]
    if not np.isfinite(errors).all():
        return parameters, None  # squares of the scene's coordinates are out of the range of float64
    # A single splat close to a camera must not determine the precision of all others.
    errors = np.minimum(errors, np.quantile(errors, _COMMON, axis=0))
    # The errors of attributes at their maximum levels exceed the target and are not counted.
    at_most = {"opacities": parameters.opacity_levels >= _LEVELS_MAX, "quats": parameters.quat_levels >= _LEVELS_MAX}
    counts = np.array([not at_most.get(name, False) for name in free])
    allowed = errors[:, counts].mean(axis=0).sum() / max(1.0, integers[counts].sum())
    if not allowed > 0.0:
        return parameters, None
    relative: F64 = apply_weight_floor(errors, model) / allowed
    octaves = _cluster_octaves(relative, integers, count)
    return _as_steps(parameters, _assign_classes(relative, integers, octaves), octaves, free)


def max_class_count(count: int, options: EncodeOptions) -> int:
    """Return the maximum number of classes for `count` splats with Gauss-Newton blocks."""
    if options.shape_codebook_size or not _free_attributes(options):
        return 1
    most = options.max_classes or (1 if options.preset == "fast" else _CLASSES_MAX)
    return max(1, min(most, round(count / _SPLATS_PER_CLASS)))


def _free_attributes(options: EncodeOptions) -> list[str]:
    """Return the attributes whose steps no option sets."""
    return [name for name in CLASSED_ATTRIBUTES if all(getattr(options, option) is None for option in _OPTIONS[name])]


def _cluster_octaves(errors: F64, integers: F64, count: int) -> F64:
    """Return the octaves [K, A] by which the steps of each class differ from the chosen steps, finest class first.

    Args:
        errors: [N, A], error of each splat and attribute at the chosen steps, relative to the target per integer.
        integers: [A], number of integers of an attribute.
        count: maximum of K.
    """
    sample = errors[:: max(1, len(errors) // _SAMPLE)]
    energy = (integers * np.log(np.maximum(sample, np.finfo(np.float64).tiny))).sum(axis=1)
    classes = np.empty(len(sample), np.uint8)
    classes[np.argsort(energy, kind="stable")] = np.arange(len(sample)) * count // len(sample)
    octaves = _octaves(sample, classes, integers)
    for _ in range(_ROUNDS_MAX):
        reassigned = _assign_classes(sample, integers, octaves)
        if (reassigned == classes).all():
            break
        classes = reassigned
        octaves = _octaves(sample, classes, integers)
    splats = np.bincount(classes)[np.unique(classes)] * (len(errors) / len(sample))
    large: F64 = octaves[splats >= min(_CLASS_SPLATS_MIN, int(splats.max()))]
    return large[np.argsort((integers * large).sum(axis=1), kind="stable")]


def _octaves(errors: F64, classes: U8, integers: F64) -> F64:
    """Return the octaves [K, A] of each used class at which an integer adds an error of 1 on average.

    Errors are [N, A], classes [N], integers [A]. Octaves are limited to -`_FINER` and `_COARSER`.
    """
    counts = np.bincount(classes)
    sums = np.stack([np.bincount(classes, column) for column in errors.T], axis=1)
    means = sums[counts > 0] / counts[counts > 0, None]
    best: F64 = 0.5 * np.log2(integers / np.maximum(means, np.finfo(np.float64).tiny))
    return np.clip(best, -_FINER, _COARSER)


def _assign_classes(errors: F64, integers: F64, octaves: F64) -> U8:
    """Return the class of least cost for each splat, [N], the first of several; see the equation of this module.

    Errors are [N, A], integers [A], octaves [K, A].
    """
    distortion, saved = 4.0**octaves / (2.0 * math.log(2.0)), (integers * octaves).sum(axis=1)
    index = np.zeros(len(errors), np.uint8)
    for start in range(0, len(errors), _BLOCK):
        columns = np.ascontiguousarray(errors[start : start + _BLOCK].T)  # adding a few long rows is much faster
        least = np.full(columns.shape[1], np.inf)
        for number, factors in enumerate(distortion):
            cost = sum(factor * column for factor, column in zip(factors, columns, strict=True)) - saved[number]
            index[start : start + _BLOCK][cost < least] = number
            least = np.minimum(cost, least)
    return index


def _as_steps(
    parameters: CodingParameters, index: U8, octaves: F64, free: Sequence[str]
) -> tuple[CodingParameters, QuantisationClasses | None]:
    """Set the file's steps to the finest of any class, attribute by attribute, and express the others relative to them.

    Args:
        parameters: the chosen steps.
        index: [N], class of each splat.
        octaves: [classes, attributes of `free`], log2 of the steps of the classes relative to the chosen steps.
        free: attributes whose steps may change.

    Returns:
        The parameters with the new steps, and the classes that have splats; or, if only one class has splats, the
        unchanged parameters and `None`.
    """
    used = np.unique(index)
    if len(used) < 2:
        return parameters, None
    levels = {"opacities": parameters.opacity_levels, "quats": parameters.quat_levels}
    steps = {"scales": parameters.scale_step, "means": parameters.lattice.step, "sh0": parameters.sh0_step}
    coarse: dict[str, list[int]] = {}
    for column, name in enumerate(free):
        target = octaves[used, column]
        if name in levels:
            levels[name], coarse[name] = _coarser_levels(levels[name], target, _ONE_BYTE[name])
            continue
        if name == "scales":
            target = np.minimum(target, math.log2(_SCALE_STEP_MAX / steps[name]))
        steps[name] *= 2.0 ** float(target.min())
        coarse[name] = [round(octave) for octave in target - target.min()]
    parameters = replace(
        parameters,
        lattice=replace(parameters.lattice, step=steps["means"]),
        scale_step=steps["scales"],
        sh0_step=steps["sh0"],
        opacity_levels=levels["opacities"],
        quat_levels=levels["quats"],
    )
    factors = [StepFactors(**{name: coarse[name][number] for name in free}) for number in range(len(used))]
    return parameters, QuantisationClasses(np.searchsorted(used, index).astype(np.uint8), factors)


def _coarser_levels(levels: int, octaves: F64, one_byte: int) -> tuple[int, list[int]]:
    """Return the levels of the finest class, limited to one byte, and the step multiple of each class in [classes]."""
    most = one_byte if levels <= one_byte else max(levels, _LEVELS_MAX)
    finest = min(max(_LEVELS_MIN, round(levels * 2.0 ** -float(octaves.min()))), most)
    coarsest = max(1, finest // _LEVELS_MIN)
    return finest, [min(max(1, round(finest / levels * 2.0 ** float(octave))), coarsest) for octave in octaves]
