"""Everything of a splat but its colour, quantised: for the stage that codes it, and for whoever fits colours to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from csplat.encoder.shape_tables import ShapePart, ShapeTables
from csplat.encoder.tiling import EVEN, Coarse, Tile
from csplat.types import F32

Integers = NDArray[Any]


@dataclass(frozen=True)
class Shape:
    """Rotations and scales of a tile in columns: integers, the scales' exponent, and what the decoder will see."""

    scales: Integers
    exponent: int
    quats: Integers
    decoded_scales: F32
    decoded_quats: F32


def quantise_shape(quats: F32, scales: F32, plan: Plan, part: ShapePart | None = None, coarse: Coarse = EVEN) -> Shape:
    """Quantise rotations [n, 4] and log scales [n, 3] of a tile in their gauge, which they may be in already.

    Args:
        quats: w x y z.
        scales: logarithms.
        plan: the lattices.
        part: what a codebook says of these splats; those that it serves take its integers.
        coarse: by how much the tile's steps are coarser, where there is no codebook.
    """
    rotation, sorted_scales = (quats.T, scales.T) if plan.gauged else fix_gauge(quats, scales)
    exponent = max(coarse.scales, lattice_exponent(float(np.abs(sorted_scales).max()), plan.scale_step))
    step = lattice_step(plan.scale_step, exponent)
    n = np.rint(sorted_scales.astype(np.float64) / step).astype(np.int64)
    q = quat_levels(rotation, plan.quat_levels, coarse.quats)
    if part is not None:
        n[:, part.served], q[:, part.served] = part.scales, part.quats
    return Shape(n, exponent, q, lattice_values(n, step), quat_values(q, plan.quat_levels))


def seen_means(means: F32, tiles: Sequence[Tile], plan: Plan) -> F32:
    """Centres [N, 3] as a decoder will see them."""
    seen = np.empty_like(means)
    for tile in tiles:
        step = lattice_step(plan.lattice.step, tile.exponent)
        seen[tile.rows] = lattice_values(quantise_means(np.ascontiguousarray(means[tile.rows].T), step), step).T
    return seen


def seen_shapes(
    quats: F32, scales: F32, tiles: Sequence[Tile], plan: Plan, shapes: ShapeTables | None = None
) -> tuple[F32, F32]:
    """Rotations [N, 4] and log scales [N, 3] as a decoder will see them."""
    seen = np.empty_like(quats), np.empty_like(scales)
    for tile in tiles:
        part = None if shapes is None else shapes.part(tile.rows)
        shape = quantise_shape(quats[tile.rows], scales[tile.rows], plan, part, tile.coarse)
        seen[0][tile.rows], seen[1][tile.rows] = shape.decoded_quats.T, shape.decoded_scales.T
    return seen


def seen_opacities(opacities: F32, tiles: Sequence[Tile], plan: Plan) -> F32:
    """Alpha [N] as a decoder will see it."""
    seen, levels = np.empty_like(opacities), plan.opacity_levels
    for tile in tiles:
        q = opacity_levels(opacities[tile.rows], levels, square=True, multiple=tile.coarse.opacities)
        seen[tile.rows] = opacity_values(q, levels, square=True)
    return seen
