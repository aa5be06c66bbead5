# SPDX-License-Identifier: Apache-2.0
"""Partition splats into tiles, and order them (spec 3, 4.3.5)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.coding_parameters import SAME_STEPS, CodingParameters, Lattice, StepFactors
from csplat.encoder.entropy import morton_codes
from csplat.encoder.error_bounds import distance_errors, take_precise_means, with_margin
from csplat.encoder.quantisation import largest_exact, lattice_values, opacity_levels, opacity_values, quantise_means
from csplat.encoder.quantisation_classes import QuantisationClasses
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.portable_math import ceil_log2
from csplat.scene_parts import part_of
from csplat.types import F32, I64, U8, Mask

Rows = NDArray[np.intp]
Integers = NDArray[Any]

_OWN_TILE_MIN = 48  # splats; a smaller tile takes more bytes than a coarser lattice would lose
_FINER_MAX = 3  # halvings of a tile's step; after two, only the errors of rounding to float32 remain
_FINEST = 2.0**45  # maximum number of steps from zero to a tile's far corner; float32 resolves 2**24
_OUTLIER_BLOCK = 1 << 14  # splats per block of temporaries


@dataclass(frozen=True)
class TileSplats:
    """The splats of a tile, unsorted.

    Attributes:
        rows: [n], rows of the model.
        exponent: the tile's step of the means is the file's times 2**exponent.
        factors: the other steps relative to the file's.
    """

    rows: Rows
    exponent: int
    factors: StepFactors = SAME_STEPS


@dataclass(frozen=True, eq=False)
class QuantisedTile:
    """The quantised means of a tile, in decoding order.

    Attributes:
        rows: [n], rows of the model.
        q: [3, n], lattice integers relative to the corner, >= 0.
        corner: [3], lattice integers of the tile's corner.
        codes: [n], Morton codes, ascending; `None` if means are coded AXIS.
    """

    rows: Rows
    q: Integers
    corner: Integers
    codes: I64 | None


def cut_scene(
    model: SplatModel,
    parameters: CodingParameters,
    classes: QuantisationClasses | None = None,
    buckets: Sequence[Rows] | None = None,
) -> list[TileSplats]:
    """Partition a scene into tiles: by bucket, by class, by outliers, by part, and by space.

    An outlier is a value that does not fit the file's lattice and would coarsen the lattice of up to 65,535 other
    splats in its tile. Splats with outliers in the same attributes share tiles, after the other tiles of their class or
    bucket.

    Args:
        model: the scene.
        parameters: steps and tile size.
        classes: quantisation classes; `None`: all splats have the same steps.
        buckets: rows of the parts to cut by themselves; default: the whole scene.

    Raises:
        InputError: no lattice keeps the error of means that `parameters` allow.
    """
    flags = _outlier_flags(model, parameters)
    groups, factors = flags, [SAME_STEPS]
    if classes is not None:
        groups = classes.index if flags is None else classes.index + np.uint8(len(classes.factors)) * flags
        factors = [*classes.factors]
    tiles: list[TileSplats] = []
    for rows in [np.arange(len(model))] if buckets is None else buckets:
        tiles += _cut_groups(model, rows, None if groups is None else groups[rows], factors, parameters)
    return tiles


def cut_tiles(means: F32, lattice: Lattice, tile_splats: int) -> list[TileSplats]:
    """Split by k-d medians down to `tile_splats`; halve the box of tiles that are too wide for the lattice.

    Halving the box separates distant outliers, so that the core keeps its step.

    Args:
        means: [N, 3] float32.
        lattice: step of the file, and bits per axis of a tile.
        tile_splats: maximum number of splats per tile.

    Returns:
        Tiles in spatial order.
    """
    if len(means) == 0:
        return []
    limit = float((1 << lattice.bits) - 1)
    wide = 4.0 if lattice.finest else 1.0  # with `finest`, steps adapt to the box, and only outliers are separated
    few = _OWN_TILE_MIN if lattice.error is None else 1
    tiles: list[TileSplats] = []
    pending = [(np.arange(len(means), dtype=np.intp), np.ascontiguousarray(means.T))]
    while pending:
        rows, points = pending.pop()
        low = points.min(axis=1).astype(np.float64)
        high = points.max(axis=1).astype(np.float64)
        axis = int(np.argmax(high - low))
        extent = float(high[axis] - low[axis])
        if extent / lattice.step > wide * limit and len(rows) > few:
            near = points[axis] < low[axis] + extent / 2
            halves = [np.flatnonzero(~near), np.flatnonzero(near)]
        elif len(rows) > tile_splats:
            halves = _halve(points[axis], tile_splats)
        else:
            reach = float(max(np.abs(low).max(), np.abs(high).max()))
            tiles.append(TileSplats(rows, tile_exponent(extent, reach, lattice)))
            continue
        pending += [(rows[half], np.take(points, half, axis=1)) for half in halves]  # the near half is popped first
    return tiles


def tile_exponent(extent: float, reach: float, lattice: Lattice) -> int:
    """Return the exponent of a tile, whose step is the file's times 2**exponent.

    Args:
        extent: longest side of the tile's box, scene units.
        reach: largest magnitude of a coordinate, scene units.
        lattice: step and bits.
    """
    # One step is reserved for rounding at both ends.
    needed = _exponent(extent / lattice.step / ((1 << lattice.bits) - 2 if lattice.bits > 1 else 1))
    floor = _exponent(reach / lattice.step / _FINEST)
    if not lattice.finest:
        return max(0, needed, floor)
    lowest = -1020 - math.frexp(lattice.step)[1]  # the tile's step is a normal float64, at least 2**-1021
    if reach == 0.0:
        return 0
    return max(lowest, floor) if extent == 0.0 else max(lowest, needed, floor)


def quantise_and_sort(model: SplatModel, tile: TileSplats, parameters: CodingParameters) -> QuantisedTile:
    """Quantise the means of a tile, and sort its splats by Morton code unless means are coded AXIS."""
    step = math.ldexp(parameters.lattice.step, tile.exponent)
    n = quantise_means(np.ascontiguousarray(np.take(model.means, tile.rows, axis=0).T), step)
    corner = n.min(axis=1)
    q = n - corner[:, None]
    if not parameters.morton:
        return QuantisedTile(tile.rows, q, corner, None)
    # Keys of 48 bits of code and 16 bits of position: sorting them is stable and much faster than an argsort.
    keys = morton_codes(q).astype(np.uint64)
    keys <<= np.uint64(16)
    keys |= np.arange(len(keys), dtype=np.uint64)
    keys.sort()
    order = (keys & np.uint64(0xFFFF)).astype(np.intp)
    codes = (keys >> np.uint64(16)).astype(np.int64)
    return QuantisedTile(tile.rows[order], np.take(q, order, axis=1), corner, codes)


def dequantise_means(means: F32, tiles: Sequence[TileSplats], lattice: Lattice) -> F32:
    """Return decoded means, [N, 3]."""
    decoded = np.empty_like(means)
    for tile in tiles:
        step = math.ldexp(lattice.step, tile.exponent)
        decoded[tile.rows] = lattice_values(quantise_means(np.ascontiguousarray(means[tile.rows].T), step), step).T
    return decoded


def dequantise_opacities(opacities: F32, tiles: Sequence[TileSplats], parameters: CodingParameters) -> F32:
    """Return decoded alpha, [N]."""
    decoded, levels = np.empty_like(opacities), parameters.opacity_levels
    for tile in tiles:
        q = opacity_levels(
            opacities[tile.rows], levels, square=parameters.square_opacities, multiple=tile.factors.opacities
        )
        decoded[tile.rows] = opacity_values(q, levels, square=parameters.square_opacities)
    return decoded


def _cut_groups(
    model: SplatModel, rows: Rows, groups: U8 | None, factors: Sequence[StepFactors], parameters: CodingParameters
) -> list[TileSplats]:
    """Cut the splats of each group into tiles of their own.

    Args:
        model: the scene.
        rows: [n], rows of the splats.
        groups: [n], class + number of classes × mask of attributes with outliers; `None`: one group of class 0.
        factors: step factors of each class.
        parameters: steps and tile size.

    Returns:
        Tiles by ascending group, with rows of the model.

    Raises:
        InputError: no lattice keeps the error of means that `parameters` allow.
    """
    tiles: list[TileSplats] = []
    for group in (0,) if groups is None else np.unique(groups):
        chosen = rows if groups is None else rows[groups == group]
        shared = factors[int(group) % len(factors)]
        for part, octaves in _split_parts(model, chosen, parameters.lattice):
            exponent = shared.means + octaves
            lattice = replace(parameters.lattice, step=math.ldexp(parameters.lattice.step, exponent))
            tiles += (
                TileSplats(part[tile.rows], tile.exponent + exponent, shared)
                for tile in _cut_within(model, part, lattice, parameters.tile_splats)
            )
    return tiles


def _split_parts(model: SplatModel, rows: Rows, lattice: Lattice) -> Iterator[tuple[Rows, int]]:
    """Yield the rows of each part of the scene, and of the rest, with the octaves of their step; see `Lattice`."""
    if not lattice.parts:
        yield rows, 0
        return
    index = part_of(np.take(model.means, rows, axis=0), lattice.parts)
    for number in np.unique(index):
        yield rows[index == number], lattice.octaves[number]


def _cut_within(model: SplatModel, rows: Rows, lattice: Lattice, tile_splats: int) -> list[TileSplats]:
    """Cut splats into tiles, finer where means would move by more than the lattice allows.

    Half a step per axis is within the error, but decoded means are rounded to float32, by up to another half.

    Args:
        model: the scene.
        rows: [n], rows of the splats.
        lattice: step, bits, and the error to keep, if any.
        tile_splats: maximum number of splats per tile.

    Returns:
        Tiles in spatial order. Their rows index `rows`, not the model.

    Raises:
        InputError: after `_FINER_MAX` halvings of the step, a mean still moves too far.
    """
    tiles = cut_tiles(np.take(model.means, rows, axis=0), lattice, tile_splats)
    if lattice.error is None:
        return tiles
    kept = list[TileSplats]()
    worst, reach = lattice.error, 0.0  # the largest error above the limit, and the reach of its tile, scene units
    pending = [(tile, 0) for tile in reversed(tiles)]  # with the number of halvings; the next tile is last
    while pending:
        tile, finer = pending.pop()
        means = np.take(model.means, rows[tile.rows], axis=0)
        decoded = dequantise_means(means, [replace(tile, rows=np.arange(len(means)))], lattice)
        source = take_precise_means(model, rows[tile.rows])
        error = with_margin(distance_errors(source.T, decoded.T)[0])
        if error <= lattice.error or finer == _FINER_MAX:
            kept.append(tile)
            if error > worst:
                worst, reach = error, float(np.abs(means).max())
            continue
        half = replace(lattice, step=math.ldexp(lattice.step, -finer - 1))
        pending += (
            (TileSplats(tile.rows[part.rows], part.exponent - finer - 1), finer + 1)
            for part in reversed(cut_tiles(means, half, tile_splats))
        )
    if worst > lattice.error:
        raise InputError(
            f"no lattice keeps the error of means within {lattice.error:g}: the best possible is {worst:.3g}, for a"
            f" splat {reach:.3g} from the origin (decoded means are float32); allow a larger error, or remove distant"
            " splats (csplat convert --drop-floaters)"
        )
    return kept


def _outlier_flags(model: SplatModel, parameters: CodingParameters) -> U8 | None:
    """Return which attributes of each splat have outliers, [N]: bit 0 scales, 1 sh0, 2 kept SH bands; `None`: none."""
    # Chroma is a difference of two channels, hence half the limit for colours.
    limits = (
        (model.scales, largest_exact(parameters.scale_step)),
        (model.sh0, largest_exact(parameters.sh0_step) / 2.0),
        (
            model.shN[:, : parameters.sh_coefficients],
            largest_exact(min(parameters.sh_step, parameters.codebook_step)) / 2.0,
        ),
    )
    flags: U8 | None = None
    for bit, (values, limit) in enumerate(limits):
        if _may_exceed(values, limit):
            flags = np.zeros(len(model), np.uint8) if flags is None else flags
            flags |= _exceeds(values, limit).view(np.uint8) << np.uint8(bit)
    return flags if flags is not None and flags.any() else None


def _may_exceed(values: F32, limit: float) -> bool:
    """Return True if a value may reach the limit, by the sum of squares, which takes one pass over memory."""
    flat: NDArray[Any] = values.reshape(-1) if values.flags.c_contiguous else values
    with np.errstate(over="ignore"):
        axes = "ijk"[: flat.ndim]
        return not 4.0 * float(np.einsum(f"{axes},{axes}->", flat, flat)) < limit * limit  # 4: float32 sums round


def _exceeds(values: F32, limit: float) -> Mask:
    """Return True for rows with a value that reaches the limit, [N]."""
    mask = np.zeros(len(values), bool)
    for start in range(0, len(values), _OUTLIER_BLOCK):
        part = values[start : start + _OUTLIER_BLOCK]
        mask[start : start + _OUTLIER_BLOCK] = np.abs(part.reshape(len(part), -1)).max(axis=1, initial=0.0) >= limit
    return mask


def _halve(coordinate: F32, tile_splats: int) -> list[Rows]:
    """Split at a quantile that lets tiles of both halves be about equally full.

    Args:
        coordinate: [n], n > `tile_splats`, positions along the axis to split.
        tile_splats: maximum number of splats per tile.

    Returns:
        Rows of the far half and rows of the near half, in this order, so that the near half is popped first.
    """
    parts = math.ceil(len(coordinate) / tile_splats)
    share = len(coordinate) * (parts // 2) // parts
    limit = np.partition(coordinate, share)[share]
    near = coordinate < limit
    same = np.flatnonzero(coordinate == limit)  # `argpartition` would choose others of these on other processors
    near[same[: share - np.count_nonzero(near)]] = True
    return [np.flatnonzero(~near), np.flatnonzero(near)]


def _exponent(ratio: float) -> int:
    """Return log2 rounded up; for a ratio of 0, a number below the logarithm of every float64."""
    return -(1 << 12) if ratio <= 0.0 else ceil_log2(ratio)
