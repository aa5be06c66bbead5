"""Everything of a splat but its colour, quantised: for the stage that codes it, and for whoever fits colours to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.gauge import fix_gauge
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import (
    lattice_exponent,
    lattice_step,
    lattice_values,
    opacity_levels,
    opacity_values,
    quantise_means,
    quat_levels,
    quat_values,
)
from csplat.encoder.tiling import Tile
from csplat.model import SplatModel

__all__ = ["Shape", "quantise_shape", "quantised_geometry"]

Integers = NDArray[Any]
F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Shape:
    """Rotations and scales of a tile in columns: integers, the scales' exponent, and what the decoder will see."""

    scales: Integers
    exponent: int
    quats: Integers
    decoded_scales: F32
    decoded_quats: F32


def quantise_shape(quats: F32, scales: F32, plan: Plan) -> Shape:
    """Quantise rotations [n, 4] and log scales [n, 3] of a tile in their gauge."""
    rotation, sorted_scales = fix_gauge(quats, scales)
    exponent = lattice_exponent(float(np.abs(sorted_scales).max()), plan.scale_step)
    step = lattice_step(plan.scale_step, exponent)
    n = np.rint(sorted_scales.astype(np.float64) / step).astype(np.int64)
    q = quat_levels(rotation, plan.quat_levels)
    return Shape(n, exponent, q, lattice_values(n, step), quat_values(q, plan.quat_levels))


def quantised_geometry(model: SplatModel, tiles: Sequence[Tile], plan: Plan) -> SplatModel:
    """The scene with means, rotations, scales and opacities as a decoder will see them, colours as they are.

    Args:
        model: the scene.
        tiles: how it is cut: a tile's lattice may be coarser than the file's.
        plan: the lattices.

    Returns:
        The scene, in the same order.
    """
    means, quats, scales = np.empty_like(model.means), np.empty_like(model.quats), np.empty_like(model.scales)
    for tile in tiles:
        rows, step = tile.rows, lattice_step(plan.lattice.step, tile.exponent)
        means[rows] = lattice_values(quantise_means(np.ascontiguousarray(model.means[rows].T), step), step).T
        shape = quantise_shape(model.quats[rows], model.scales[rows], plan)
        quats[rows], scales[rows] = shape.decoded_quats.T, shape.decoded_scales.T
    levels = plan.opacity_levels
    opacities = opacity_values(opacity_levels(model.opacities, levels, square=True), levels, square=True)
    return replace(model, means=means, quats=quats, scales=scales, opacities=opacities)
