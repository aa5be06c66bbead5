"""Cut a scene into tiles of nearby splats, outliers apart (spec 3, 4.3.5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.types import F32

Rows = NDArray[np.intp]

_FEW = 48  # splats for which a tile of their own costs more than a coarser lattice loses
_FINEST = 2.0**45  # steps from zero to a tile's far corner: float32 holds 2**24 of them


@dataclass(frozen=True)
class Lattice:
    """The positions' lattice.

    Attributes:
        step: of the file, scene units, > 0.
        bits: per axis and tile at most, 1 to 16; a tile whose box needs more is cut or coarsened.
        finest: tiles use all their bits (a step given in bits) instead of stopping at `step`.
        strict: no tile has a coarser step, however many tiles that takes.
    """

    step: float
    bits: int
    finest: bool = False
    strict: bool = False


@dataclass(frozen=True)
class Coarse:
    """By how much the steps of a tile's attributes are coarser than the file's, by choice (grades.py).

    Attributes:
        opacities, quats: integers are multiples of this, >= 1.
        scales, means, sh0: the step is the file's times 2**this, >= 0.
    """

    opacities: int = 1
    scales: int = 0
    quats: int = 1
    means: int = 0
    sh0: int = 0


EVEN = Coarse()


@dataclass(frozen=True)
class Tile:
    """Splats of one tile, before they are ordered.

    Attributes:
        rows: [n] places in the model.
        exponent: the step of the tile's means is the file's times 2**exponent.
        coarse: by how much the others' steps are coarser.
    """

    rows: Rows
    exponent: int
    coarse: Coarse = EVEN


def cut(means: F32, lattice: Lattice, tile_splats: int) -> list[Tile]:
    """Cut by k-d medians into at most `tile_splats`, and by halves of space what is too wide for the lattice.

    Halving space peels off outliers: the core keeps its step whatever lies far away.

    Args:
        means: [N, 3] float32.
        lattice: the step and how many bits of it a tile may use.
        tile_splats: splats per tile at most.

    Returns:
        Tiles in an order that keeps neighbours together.
    """
    if len(means) == 0:
        return []
    limit = float((1 << lattice.bits) - 1)
    wide = 4.0 if lattice.finest else 1.0  # a step given in bits follows the box; only outliers are cut off
    few = 1 if lattice.strict else _FEW
    tiles: list[Tile] = []
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
            tiles.append(Tile(rows, tile_exponent(extent, reach, lattice)))
            continue
        pending += [(rows[half], np.take(points, half, axis=1)) for half in halves]  # the near half is popped first
    return tiles


def _halve(coordinate: F32, tile_splats: int) -> list[Rows]:
    """Split at a multiple of the tile size, so that tiles are full; the first half comes last, to be popped first."""
    parts = math.ceil(len(coordinate) / tile_splats)
    share = len(coordinate) * (parts // 2) // parts
    order = np.argpartition(coordinate, share)
    return [order[share:], order[:share]]


def tile_exponent(extent: float, reach: float, lattice: Lattice) -> int:
    """Return the power of two by which a tile's step differs from the file's.

    Args:
        extent: longest side of the tile's box, scene units.
        reach: largest magnitude of a coordinate, scene units.
        lattice: step and bits.
    """
    # One step is left for the rounding of both ends.
    needed = _log2(extent / lattice.step / ((1 << lattice.bits) - 2 if lattice.bits > 1 else 1))
    floor = _log2(reach / lattice.step / _FINEST)
    if not lattice.finest:
        return max(0, needed, floor)
    lowest = math.ceil(-1021 - math.log2(lattice.step))
    if reach == 0.0:
        return 0
    return max(lowest, floor) if extent == 0.0 else max(lowest, needed, floor)


def _log2(ratio: float) -> int:
    return -(1 << 12) if ratio <= 0.0 else math.ceil(math.log2(ratio))
