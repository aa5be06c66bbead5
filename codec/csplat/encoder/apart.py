"""Tiles of a whole scene: by grade (grades.py), and splats with huge values apart, as far outliers are (tiling.py).

A tile's lattices grow coarser until the largest value fits 32 bits. One exploded colour would take those of up to
65,535 neighbours along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.buckets import bucket_rows
from csplat.encoder.grades import Grades
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import largest_exact, lattice_step
from csplat.encoder.tiling import EVEN, Coarse, Tile, cut
from csplat.model import SplatModel
from csplat.types import F32

Flags = NDArray[np.uint8]
Rows = NDArray[np.intp]

_BLOCK = 1 << 14  # splats that are looked at at a time


def cut_scene(
    model: SplatModel, plan: Plan, grades: Grades | None = None, buckets: Sequence[Rows] | None = None
) -> list[Tile]:
    """Cut a scene into tiles.

    Args:
        model: the scene.
        plan: lattices and tile size.
        grades: quantisation classes, whose splats share steps; `None`: all splats share them.
        buckets: `bucket_rows` of the model, if they are known.

    Returns:
        As `cut`, bucket by bucket, or grade by grade; and after those of each the tiles of splats some of whose values
        their lattices hold with coarser steps only, those alike in which attributes that are together.
    """
    kinds = _huge(model, plan)
    if grades is not None:
        groups = grades.index if kinds is None else grades.index + np.uint8(len(grades.coarse)) * kinds
        return _cut_groups(model.means, np.arange(len(model)), groups, grades.coarse, plan)
    tiles: list[Tile] = []
    for rows in bucket_rows(model.means) if buckets is None else buckets:
        found = None if kinds is None else kinds[rows]
        tiles += _cut_groups(model.means, rows, found, [EVEN], plan)
    return tiles


def _cut_groups(means: F32, rows: Rows, groups: Flags | None, coarse: Sequence[Coarse], plan: Plan) -> list[Tile]:
    """Cut the splats `rows`, those of each group by themselves; group g has the steps of grade g modulo the grades."""
    tiles: list[Tile] = []
    for group in (0,) if groups is None else np.unique(groups):
        chosen = rows if groups is None else rows[groups == group]
        shared = coarse[int(group) % len(coarse)]
        lattice = replace(plan.lattice, step=lattice_step(plan.lattice.step, shared.means))
        tiles += (
            Tile(chosen[tile.rows], tile.exponent + shared.means, shared)
            for tile in cut(means[chosen], lattice, plan.tile_splats)
        )
    return tiles


def _huge(model: SplatModel, plan: Plan) -> Flags | None:
    """[N], a bit for each attribute with a value that the file's lattice does not hold; None if there is none."""
    kept = (plan.sh_degree + 1) ** 2 - 1
    # Colours go through sums and differences of two channels.
    looked_at = (
        (model.scales, largest_exact(plan.scale_step)),
        (model.sh0, largest_exact(plan.sh0_step) / 2.0),
        (model.shN[:, :kept], largest_exact(min(plan.sh_step, plan.codebook_step)) / 2.0),
    )
    kinds: Flags | None = None
    for bit, (values, limit) in enumerate(looked_at):
        if _may_exceed(values, limit):
            kinds = np.zeros(len(model), np.uint8) if kinds is None else kinds
            kinds |= _exceeds(values, limit).view(np.uint8) << np.uint8(bit)
    return kinds if kinds is not None and kinds.any() else None


def _may_exceed(values: F32, limit: float) -> bool:
    """Return True if a value may reach the limit: one pass over memory, without a mask, by the sum of squares."""
    flat: NDArray[Any] = values.reshape(-1) if values.flags.c_contiguous else values
    with np.errstate(over="ignore"):
        axes = "ijk"[: flat.ndim]
        return not 4.0 * float(np.einsum(f"{axes},{axes}->", flat, flat)) < limit * limit  # float32 sums lose digits


def _exceeds(values: F32, limit: float) -> NDArray[np.bool_]:
    """[N], whether any value of a row reaches the limit."""
    found = np.zeros(len(values), bool)
    for at in range(0, len(values), _BLOCK):
        part = values[at : at + _BLOCK]
        found[at : at + _BLOCK] = np.abs(part.reshape(len(part), -1)).max(axis=1, initial=0.0) >= limit
    return found
