# SPDX-License-Identifier: Apache-2.0
"""Recognise the lattices of values that were read from SPZ or SOG, and choose steps that reproduce these values.

SPZ has fixed-point means, log scales in steps of 1/16, SH in fractions of 128, alpha in steps of 1/255, colours that
are odd multiples of a step, and from version 3 on rotations of which three components are multiples of √½ / 511. SOG
has rotations (√½ / 255) and, in version 2, alpha like these. Its means are logarithmic, its scales and colours in
tables, which no lattice of the format contains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from csplat.encoder.coding_parameters import HALF_DIAGONAL, CodingParameters, on_grid
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.quantisation import LATTICE_TOLERANCE, rotation_on_lattice
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.portable_math import ceil_log2
from csplat.types import F32

#: Number of levels of alpha that is coded as it is, instead of its square root.
ALPHA_LEVELS = 255

_ROTATION_LEVELS = (255, 511)  # of SOG and SPZ
_FINEST = 2.0**-23  # step of a grid, as a fraction of the largest value; float32 is on finer grids anyway
_CODES_MAX = 256  # distinct colours of a channel


def exact_options(model: SplatModel, families: Iterable[str]) -> dict[str, Any]:
    """Return `EncodeOptions` with which attributes keep the values of a quantised source.

    Args:
        model: the scene.
        families: "means", "covariance", "opacities", "sh0" or "sh".

    Raises:
        InputError: the values of an attribute are on no lattice of the format.
    """
    chosen: dict[str, Any] = {}
    for family in families:
        found: dict[str, float | int | None] = {}
        if not len(model):
            continue
        if not model.metadata.quantised:
            pass
        elif family == "means":
            step = power_of_two_step(model.means)
            found["position_error"] = None if step is None else step * HALF_DIAGONAL
        elif family == "covariance":
            found = {"scale_step": power_of_two_step(model.scales), "quat_levels": rotation_levels(model)}
        elif family == "opacities":
            found["opacity_levels"] = ALPHA_LEVELS if has_alpha_levels(model) else None
        elif family == "sh0":
            found = {"sh0_step": colour_step(model.sh0), "chroma_shift": 0}
        elif model.sh_degree:
            found = {"sh_step": power_of_two_step(model.shN), "chroma_shift": 0}
        else:
            continue
        if not found or None in found.values():
            raise InputError(
                f"a largest error of 0 for {family} requires values on a lattice of the format, as SPZ has them:"
                " allow an error above 0"
            )
        chosen |= found
    return chosen


def keep_lattices(model: SplatModel, parameters: CodingParameters, options: EncodeOptions) -> CodingParameters:
    """Return parameters with the mappings that reproduce a quantised source, if options have its numbers of levels."""
    if not model.metadata.quantised or not len(model):
        return parameters
    alpha = options.opacity_levels == ALPHA_LEVELS and has_alpha_levels(model)
    rotation = options.quat_levels in _ROTATION_LEVELS and rotation_levels(model) == options.quat_levels
    return replace(parameters, square_opacities=not alpha, sorts_axes=not rotation)


def power_of_two_step(values: F32) -> float | None:
    """Return the largest power of two of which all values are multiples, 1 if all are 0; `None` if it is too fine."""
    largest = float(np.abs(values).max(initial=0.0))
    if not 0.0 < largest < math.inf:
        return None if largest else 1.0
    step = math.ldexp(1.0, ceil_log2(_FINEST * largest))
    if not on_grid(values, step):
        return None
    while on_grid(values, 2.0 * step):
        step *= 2.0
    return step


def has_alpha_levels(model: SplatModel) -> bool:
    """Return True if every alpha is a multiple of 1/255, rounded to float32."""
    codes = np.rint(model.opacities * np.float32(ALPHA_LEVELS))
    return bool((codes / np.float32(ALPHA_LEVELS) == model.opacities).all())


def rotation_levels(model: SplatModel) -> int | None:
    """Return M of spec 7.5 if the smaller components of all rotations are multiples of √½ / M; `None` otherwise."""
    for levels in _ROTATION_LEVELS:
        q = rotation_on_lattice(model.quats, levels)[1:] * np.float32(levels * 2.0**0.5)
        if bool((np.abs(q - np.rint(q)) < LATTICE_TOLERANCE).all()):
            return levels
    return None


def colour_step(sh0: F32) -> float | None:
    """Return the step of which all colours [N, 3] are multiples, most of them odd; `None` if there is none."""
    values = np.unique(sh0).astype(np.float64)
    if len(values) == 1:
        return abs(float(values[0])) or 1.0
    if len(values) > 3 * _CODES_MAX:
        return None
    gap = float(np.diff(values).min())
    codes = np.rint((values - values[0]) / gap)
    gap = float(values[-1] - values[0]) / float(codes[-1])  # more precise
    for step in (gap, 0.5 * gap):
        n = values / float(np.float32(step))
        if bool((np.abs(n - np.rint(n)) < LATTICE_TOLERANCE).all()):
            return step
    return None
