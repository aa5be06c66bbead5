"""One view of fixed splats, and the loops over its splats: from coefficients to colours, and from sums to totals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from csplat_render.arrays import Array
from csplat_render.harmonics import sh_basis
from csplat_render.jit import inline, parallel_kernel
from csplat_render.projecting import BLOCK, direction


@dataclass(frozen=True, eq=False)
class DrawnView:
    """One view of fixed geometry: V splats that may be seen in it, in the order of the scene.

    Attributes:
        rows: [V] int32, which splats of the scene they are.
        shape: [V, 10] float64, see `project`, but for the last column: the exponent of 2 below which nothing is drawn.
            Columns 6 to 8 are colours and may be replaced.
        box: [V, 4] int32, see `project`.
        basis: [V, B] float32, spherical harmonics in the direction of the splat, B = (degree + 1)²; [V, 0] where
            nothing asks for them.
        starts: [tiles + 1] int64, where the splats of each tile begin in `ids`.
        ids: [intersections] int32, places in `rows`, tile by tile, nearest first.
        slots: [intersections] int32, the record of each of `ids`.
        first: [V + 1] int64, where the records of each splat begin.
        width, height: of the picture, pixels.
    """

    rows: Array
    shape: Array
    box: Array
    basis: Array
    starts: Array
    ids: Array
    slots: Array
    first: Array
    width: int
    height: int

    @property
    def size_bytes(self) -> int:
        """Memory that the arrays take."""
        arrays = (self.rows, self.shape, self.box, self.basis, self.starts, self.ids, self.slots, self.first)
        return sum(array.nbytes for array in arrays)

    def with_records(self, needed: Array) -> tuple[DrawnView, Array]:
        """Leave out pairs of splat and tile, and splats that have none.

        Args:
            needed: [intersections] bool, which records stay.

        Returns:
            The view, and which of the V splats are left.
        """
        before = np.zeros(len(needed) + 1, np.int64)
        np.cumsum(needed, out=before[1:])
        stays = np.take(needed, self.slots)
        starts = np.zeros(len(stays) + 1, np.int64)
        np.cumsum(stays, out=starts[1:])
        first = before[self.first]
        left = np.flatnonzero(first[1:] > first[:-1])
        place = np.empty(len(self.rows), np.int32)
        place[left] = np.arange(len(left), dtype=np.int32)
        view = DrawnView(
            rows=self.rows[left],
            shape=np.take(self.shape, left, axis=0),
            box=np.take(self.box, left, axis=0),
            basis=np.take(self.basis, left, axis=0),
            starts=starts[self.starts],
            ids=place[self.ids[stays]],
            slots=before[self.slots[stays]].astype(np.int32),
            first=np.append(first[left], first[-1]),
            width=self.width,
            height=self.height,
        )
        return view, left


@parallel_kernel()
def basis_of_view(lane: int, lanes: int, means: Any, rows: Any, view: Any, degree: int, basis: Any) -> None:
    """Spherical harmonics in the direction of each splat that is drawn; parallel over blocks of them."""
    values = np.empty(16, np.float64)
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            x, y, z, _ = direction(view, means[rows[j]])
            sh_basis(degree, x, y, z, values)
            for k in range(basis.shape[1]):
                basis[j, k] = values[k]


@parallel_kernel()
def set_colours(
    lane: int, lanes: int, rows: Any, basis: Any, coefficients: Any, active: Any, offset: float, shape: Any
) -> None:
    """Write offset + Y · coefficients into the shapes, 0 where not active; parallel over blocks of splats."""
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            i = rows[j]
            r, g, b = _shown(basis[j], coefficients[i])
            shape[j, 6] = offset + r if active[j, 0] else 0.0
            shape[j, 7] = offset + g if active[j, 1] else 0.0
            shape[j, 8] = offset + b if active[j, 2] else 0.0


@inline
def _shown(basis: Any, coefficients: Any) -> tuple[float, float, float]:
    """Red, green, blue of some coefficients, [B, 3], in the direction of a basis, [B]; float64."""
    r, g, b = 0.0, 0.0, 0.0
    for k in range(basis.shape[0]):
        y = np.float64(basis[k])
        r += y * coefficients[k, 0]
        g += y * coefficients[k, 1]
        b += y * coefficients[k, 2]
    return r, g, b


@parallel_kernel()
def add_removal(
    lane: int, lanes: int, rows: Any, first: Any, records: Any, basis: Any, shN: Any, totals: Any, bands: Any
) -> None:
    """Add the records of one view up, splat by splat, see `Contributions.removal`; parallel over blocks of splats."""
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            i = rows[j]
            error, product, weight, squares = 0.0, 0.0, 0.0, 0.0
            for n in range(first[j], first[j + 1]):
                error += records[n, 0]
                product += records[n, 1]
                weight += records[n, 2]
                squares += records[n, 3]
            if weight <= 0.0:
                continue
            totals[i, 0] += error
            totals[i, 1] += product
            totals[i, 2] += weight
            totals[i, 3] += squares
            totals[i, 4] += 1.0
            for band in range(1, bands.shape[1] + 1):
                begin, end = band * band, (band + 1) * (band + 1)
                r, g, b = _shown(basis[j, begin:end], shN[i, begin - 1 : end - 1])
                bands[i, band - 1] += squares * (r * r + g * g + b * b)


@parallel_kernel()
def add_gradient(
    lane: int, lanes: int, rows: Any, first: Any, records: Any, basis: Any, active: Any, gradient: Any, diagonal: Any
) -> None:
    """Take the records of one view to the coefficients, see `Contributions.colours`; parallel over blocks of splats."""
    with_diagonal = diagonal.shape[0] > 0
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            r, g, b, squares = 0.0, 0.0, 0.0, 0.0
            for n in range(first[j], first[j + 1]):
                r += records[n, 0]
                g += records[n, 1]
                b += records[n, 2]
                squares += records[n, 3]
            if squares <= 0.0:
                continue
            r, g, b = r if active[j, 0] else 0.0, g if active[j, 1] else 0.0, b if active[j, 2] else 0.0
            r32, g32, b32 = np.float32(r), np.float32(g), np.float32(b)
            own, to = basis[j], gradient[rows[j]]
            for k in range(basis.shape[1]):
                to[k, 0] += own[k] * r32
                to[k, 1] += own[k] * g32
                to[k, 2] += own[k] * b32
            if with_diagonal:
                for k in range(basis.shape[1]):
                    diagonal[rows[j], k] += squares * own[k] * own[k]
