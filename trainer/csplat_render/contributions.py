"""What each splat is to the pictures of a scene: sums over pixels per splat, without any matrix being built.

A `DrawnView` is one view of fixed splats, projected and sorted into tiles, with nothing kept but the splats that it
shows. Two questions are put to it: what the removal of each splat would change, and what pictures follow from other
colours, with the way back from pixels to colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from csplat.model import sh_degree_of
from csplat_render.arrays import Array, HasSplats, Splats
from csplat_render.binning import TILE
from csplat_render.blending_sums import SUMS, blend_counted, sum_back
from csplat_render.camera import Camera
from csplat_render.conventions import TRANSMITTANCE_MIN, view_vector
from csplat_render.harmonics import sh_basis
from csplat_render.jit import parallel_kernel, thread_count
from csplat_render.projecting import BLOCK, direction, project
from csplat_render.rasterise import Rasteriser

__all__ = ["Contributions", "DrawnView"]


@dataclass(frozen=True, eq=False)
class DrawnView:
    """One view of fixed geometry: V splats that may be seen in it, nearest first.

    Attributes:
        rows: [V] int32, which splats of the scene they are.
        shape: [V, 10] float64, see `project`; columns 6 to 8 are colours and may be replaced.
        box: [V, 4] int32, see `project`.
        basis: [V, B] float32, spherical harmonics in the direction of the splat, B = (degree + 1)².
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


class Contributions(Rasteriser):
    """Draws views and sums over their pixels; arguments as those of `Rasteriser`, and when a pixel is finished.

    No result depends on the number of threads: every splat of every tile has a record of its own, and a splat's
    records are added up in one order.
    """

    def __init__(
        self,
        dtype: Any = np.float32,
        *,
        transmittance_min: float = TRANSMITTANCE_MIN,
        threads: int | None = None,
    ) -> None:
        super().__init__("standard", dtype, gradients=True, threads=threads)
        self._limits[2] = transmittance_min

    def draw(self, splats: HasSplats, camera: Camera, *, antialiased: bool = False) -> DrawnView:
        """Project splats, sort them into the tiles of a picture, and forget what it does not show.

        Args:
            splats: the scene.
            camera: the view.
            antialiased: scale opacities by what the dilation added.

        Raises:
            LimitError: there are too many pairs of splat and tile.
        """
        arrays = Splats(
            *(
                np.ascontiguousarray(getattr(splats, name), self.dtype)
                for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
            )
        )
        n, degree = len(arrays.means), sh_degree_of(arrays.shN.shape[1])
        width, height = camera.W, camera.H
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        shape, extent = self._buffer("shape", (n, 10), np.float64), self._buffer("extent", (n, 6), np.float64)
        box, near = self._buffer("box", (n, 4), np.int32), self._buffer("near", (n,), np.float32)
        view = view_vector(camera)
        with thread_count(self.threads):
            project(
                arrays.means, arrays.quats, arrays.scales, arrays.opacities, arrays.sh0, arrays.shN, degree, view,
                width, height, antialiased, self.settings.alpha_min, shape, extent, box, near,
                self._buffer("radii", (n,), np.float32), self._buffer("ignored", (-(-n // BLOCK),), np.int64),
            )  # fmt: skip
            order = self._depth_order(near)
            starts, _ = self._sort_into_tiles(order, near, extent, box, tiles_x, tiles_x * tiles_y)
            rows = order.copy()
            basis = np.empty((len(rows), (degree + 1) ** 2), np.float32)
            _basis_of_view(arrays.means, rows, view, degree, basis)
        return _without_unseen(
            rows, shape, box, basis, starts.copy(), self._buffers["ids"], self._buffers["slots"],
            self._buffers["offsets"], width, height,
        )  # fmt: skip

    def removal(
        self,
        drawn: DrawnView,
        coefficients: Array,
        totals: Array,
        bands: Array,
        *,
        background: Array,
        reference: Array | None = None,
    ) -> Array:
        """Add what one view says of every splat to the totals of a scene.

        Args:
            drawn: the view, its shape holding the splats' colours.
            coefficients: [N, B, 3] float32, spherical harmonics of all splats.
            totals: [N, 5] float64, added to: squared change of the picture if the splat were not there, product of
                that change with (picture − reference), weight, squared weight, and 1 where the splat was seen.
            bands: [N, d] float64, added to: squared change of the picture if its band 1, … d were zero.
            background: [3], behind everything.
            reference: [H, W, 3], the picture that is wanted; None for this one.

        Returns:
            [H, W, 3], the picture.
        """
        rgb, records = self._summed(drawn, background, reference, removal=True)
        with thread_count(self.threads):
            _add_removal(drawn.rows, drawn.first, records, drawn.basis, coefficients, totals, bands)
        return rgb

    def colours(
        self,
        drawn: DrawnView,
        coefficients: Array,
        active: Array,
        gradient: Array,
        diagonal: Array,
        *,
        offset: float,
        background: Array,
        reference: Array | None = None,
    ) -> Array:
        """Render with other colours, subtract a picture, and take the difference back to the colours.

        A colour is offset + Σ_k Y_k(direction) · coefficient_k where it is active, else 0: linear, not clamped.

        Args:
            drawn: the view; its colours are overwritten.
            coefficients: [N, B, 3] float32.
            active: [V, 3] bool, which colours take part.
            gradient: [N, B, 3] float32, added to: sum over pixels of w · Y_k · (picture − reference).
            diagonal: [N, B] float32, added to: sum over pixels of (w · Y_k)²; empty if it is not wanted.
            offset: ½ for pictures of splats, 0 for differences of such pictures.
            background: [3].
            reference: [H, W, 3]; None for black.

        Returns:
            [H, W, 3], the picture, before the subtraction.
        """
        with thread_count(self.threads):
            _set_colours(drawn.rows, drawn.basis, coefficients, active, offset, drawn.shape)
        if reference is None:
            reference = np.zeros((drawn.height, drawn.width, 3), self.dtype)
        rgb, records = self._summed(drawn, background, reference, removal=False)
        with thread_count(self.threads):
            _add_gradient(drawn.rows, drawn.first, records, drawn.basis, active, gradient, diagonal)
        return rgb

    def _summed(
        self, drawn: DrawnView, background: Array, reference: Array | None, *, removal: bool
    ) -> tuple[Array, Array]:
        """Run the loops over pixels: the picture, and a record for every splat in every tile."""
        size, tiles_x = (drawn.height, drawn.width), -(-drawn.width // TILE)
        records = self._buffer("sums", (len(drawn.ids), SUMS), self.dtype)
        transmittance, last = self._buffer("through", size, self.dtype), self._buffer("last", size, self.dtype)
        rgb = np.empty((*size, 3), self.dtype)
        behind = np.ascontiguousarray(background, self.dtype)
        with thread_count(self.threads) as lanes:
            blend_counted(
                drawn.starts, drawn.ids, drawn.shape, drawn.box, tiles_x, lanes, self._limits, behind,
                rgb, transmittance, last,
            )  # fmt: skip
            error = np.zeros_like(rgb) if reference is None else rgb - reference
            sum_back(
                drawn.starts, drawn.ids, drawn.slots, drawn.shape, drawn.box, tiles_x, lanes, self._limits, behind,
                error.astype(self.dtype, copy=False), transmittance, last, removal, records,
            )  # fmt: skip
        return rgb, records


def _without_unseen(
    rows: Array, shape: Array, box: Array, basis: Array, starts: Array, ids: Array, slots: Array, offsets: Array,
    width: int, height: int,
) -> DrawnView:  # fmt: skip
    """Renumber: a splat is its place in the order of depth, and records follow that order."""
    place = np.empty(len(shape), np.int32)
    place[rows] = np.arange(len(rows), dtype=np.int32)
    count = offsets[rows + 1] - offsets[rows]
    first = np.zeros(len(rows) + 1, np.int64)
    np.cumsum(count, out=first[1:])
    moved = place[ids]
    shift = (first[:-1] - offsets[rows]).astype(np.int32)
    return DrawnView(
        rows=rows,
        shape=np.take(shape, rows, axis=0),
        box=np.take(box, rows, axis=0),
        basis=basis,
        starts=starts,
        ids=moved,
        slots=slots + shift[moved],
        first=first,
        width=width,
        height=height,
    )


@parallel_kernel()
def _basis_of_view(means: Any, rows: Any, view: Any, degree: int, basis: Any) -> None:
    """Spherical harmonics in the direction of each splat that is drawn; parallel over blocks of them."""
    for block in numba.prange((len(rows) + BLOCK - 1) // BLOCK):
        values = np.empty(16, np.float64)
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            x, y, z, _ = direction(view, means[rows[j]])
            sh_basis(degree, x, y, z, values)
            for k in range(basis.shape[1]):
                basis[j, k] = values[k]


@parallel_kernel()
def _set_colours(rows: Any, basis: Any, coefficients: Any, active: Any, offset: float, shape: Any) -> None:
    """Write offset + Y · coefficients into the shapes, 0 where not active; parallel over blocks of splats."""
    for block in numba.prange((len(rows) + BLOCK - 1) // BLOCK):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            i = rows[j]
            for c in range(3):
                colour = np.float64(offset)
                for k in range(basis.shape[1]):
                    colour += np.float64(basis[j, k]) * coefficients[i, k, c]
                shape[j, 6 + c] = colour if active[j, c] else 0.0


@parallel_kernel()
def _add_removal(rows: Any, first: Any, records: Any, basis: Any, coefficients: Any, totals: Any, bands: Any) -> None:
    """Add the records of one view up, splat by splat, see `Contributions.removal`; parallel over blocks of splats."""
    for block in numba.prange((len(rows) + BLOCK - 1) // BLOCK):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            i = rows[j]
            error, product, weight, squares = 0.0, 0.0, 0.0, 0.0
            for r in range(first[j], first[j + 1]):
                error += records[r, 0]
                product += records[r, 1]
                weight += records[r, 2]
                squares += records[r, 3]
            if weight <= 0.0:
                continue
            totals[i, 0] += error
            totals[i, 1] += product
            totals[i, 2] += weight
            totals[i, 3] += squares
            totals[i, 4] += 1.0
            for band in range(1, bands.shape[1] + 1):
                energy = 0.0
                for c in range(3):
                    part = 0.0
                    for k in range(band * band, (band + 1) * (band + 1)):
                        part += np.float64(basis[j, k]) * coefficients[i, k, c]
                    energy += part * part
                bands[i, band - 1] += squares * energy


@parallel_kernel()
def _add_gradient(rows: Any, first: Any, records: Any, basis: Any, active: Any, gradient: Any, diagonal: Any) -> None:
    """Take the records of one view to the coefficients, see `Contributions.colours`; parallel over blocks of splats."""
    with_diagonal = diagonal.shape[0] > 0
    for block in numba.prange((len(rows) + BLOCK - 1) // BLOCK):
        sums = np.empty(3, np.float64)
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            i = rows[j]
            sums[:] = 0.0
            squares = 0.0
            for r in range(first[j], first[j + 1]):
                sums[0] += records[r, 0]
                sums[1] += records[r, 1]
                sums[2] += records[r, 2]
                squares += records[r, 3]
            for c in range(3):
                if active[j, c]:
                    for k in range(basis.shape[1]):
                        gradient[i, k, c] += basis[j, k] * sums[c]
            if with_diagonal:
                for k in range(basis.shape[1]):
                    diagonal[i, k] += squares * basis[j, k] * basis[j, k]
