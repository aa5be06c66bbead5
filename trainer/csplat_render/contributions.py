"""Contribution of each splat to the renders of a scene: sums over pixels per splat, without building any matrix.

A `ProjectedView` is one view of fixed splats, projected, sorted into tiles, and reduced to the visible splats. It is
used to measure the effect of pruning each splat (`Contributions.measure_pruning`), and to render other colours and
project an image back to the colours (`Contributions.backproject`).

Pruning. At a pixel, a splat of alpha a with transmittance T in front of it has the weight w = T·a. Let C be its colour
and B the colour blended from everything behind it, background included, as seen directly behind the splat. Without the
splat the pixel changes by

    d = w·(B − C),

because only the light from behind changes. So after an ordinary render, in which each pixel stores its last splat, the
splats of a tile are processed once more, back to front:

    T ← T / (1 − a);  d = T·a·(B − C);  B ← B + a·(C − B)

Nothing is subtracted from a finished sum, so splats deep in the scene are as accurate as those in front.

Colours. The transpose of rendering colours sums, for each splat, w times the image. It needs only the weights w, which
are computed front to back as in a render.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.model import sh_degree_of
from csplat.spherical_harmonics import BASIS_SIZE
from csplat_render.binning import TILE
from csplat_render.blending import (
    BATCH,
    BATCH_COLUMNS,
    aligned_zeros,
    alpha_at,
    batch_entry,
    begin_tile,
    blend,
    blend_counted,
    gather_batch,
    narrow_rows,
    pixel_centres,
    read_planes,
    tile_extent,
    transmit,
)
from csplat_render.camera import Camera
from csplat_render.conventions import TRANSMITTANCE_MIN, Array, HasSplats, checked_splats
from csplat_render.kernels import device_function, parallel_kernel, thread_count
from csplat_render.projection import BLOCK, sh_basis, view_direction
from csplat_render.rasteriser import Rasteriser

# Colours are limited so that squares of their differences, summed over a tile, stay within float32.
_MAX_COLOUR = 1e15

# Margin for the rounding of exponents, which far from a splat's centre are small differences of numbers up to 1e4.
_EXPONENT_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class ProjectedView:
    """One view of fixed geometry: the V splats that may be visible in it, in the order of the scene.

    Attributes:
        rows: [V] int32, indices of the splats in the scene.
        shape: [V, 10] float64, see `project`, except for the last column: the exponent of 2 below which the splat is
            not drawn. Columns 6 to 8 are colours and may be replaced.
        box: [V, 4] int32, see `project`.
        basis: [V, B] float32, SH basis in the direction of the splat, B = (degree + 1)²; [V, 0] if not requested.
        starts: [tiles + 1] int64, start of each tile's splats in `ids`.
        ids: [intersections] int32, indices into `rows`, tile by tile, nearest first.
        slots: [intersections] int32, the record of each entry of `ids`.
        first: [V + 1] int64, index of each splat's first record.
        width, height: size of the image, pixels.
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
        """Memory of the arrays in bytes."""
        return sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray))

    def with_records(self, needed: Array) -> tuple[ProjectedView, Array]:
        """Drop pairs of splat and tile, and splats without any.

        Args:
            needed: [intersections] bool, True for records to keep.

        Returns:
            The view; and the indices of the kept splats among the V.
        """
        before = np.zeros(len(needed) + 1, np.int64)
        np.cumsum(needed, out=before[1:])
        kept = np.take(needed, self.slots)
        starts = np.zeros(len(kept) + 1, np.int64)
        np.cumsum(kept, out=starts[1:])
        first = before[self.first]
        kept_splats = np.flatnonzero(first[1:] > first[:-1])
        place = np.empty(len(self.rows), np.int32)
        place[kept_splats] = np.arange(len(kept_splats), dtype=np.int32)
        view = ProjectedView(
            rows=self.rows[kept_splats],
            shape=np.take(self.shape, kept_splats, axis=0),
            box=np.take(self.box, kept_splats, axis=0),
            basis=np.take(self.basis, kept_splats, axis=0),
            starts=starts[self.starts],
            ids=place[self.ids[kept]],
            slots=before[self.slots[kept]].astype(np.int32),
            first=np.append(first[kept_splats], first[-1]),
            width=self.width,
            height=self.height,
        )
        return view, kept_splats


class Contributions(Rasteriser):
    """A rasteriser that computes sums over pixels for each splat.

    No result depends on the number of threads: each pair of splat and tile has its own record, and the records of a
    splat are added in a fixed order.

    Args:
        dtype: see `Rasteriser`.
        transmittance_min: transmittance at which a pixel is finished.
        context: threads.
    """

    def __init__(
        self,
        dtype: Any = np.float32,
        *,
        transmittance_min: float = TRANSMITTANCE_MIN,
        context: Context = DEFAULT_CONTEXT,
    ) -> None:
        super().__init__("standard", dtype, gradients=True, context=context)
        self._limits[2] = transmittance_min

    def project_view(
        self, splats: HasSplats, camera: Camera, *, antialiased: bool = False, basis: bool = True
    ) -> ProjectedView:
        """Project splats, sort them into tiles, and drop invisible splats.

        Args:
            splats: the scene.
            camera: the view.
            antialiased: compensate for the dilation by scaling opacities.
            basis: compute the SH basis in the direction of each splat.

        Raises:
            LimitError: there are too many pairs of splat and tile.
        """
        arrays = checked_splats(splats, self.dtype)
        degree = sh_degree_of(arrays.shN.shape[1])
        tiles_x, tiles_y = -(-camera.W // TILE), -(-camera.H // TILE)
        with thread_count(self.context.threads):
            view, _, _ = self._project(arrays, camera, degree, antialiased=antialiased)
            shape, extent, box, near = (self._buffers[name] for name in ("shape", "extent", "box", "near"))
            order = self._depth_order(near)
            starts, _ = self._sort_into_tiles(order, near, extent, box, tiles_x, tiles_x * tiles_y)
            # In scene order rather than depth order, so that arrays by splat are read and written sequentially.
            rows = np.flatnonzero(near > 0.0).astype(np.int32)
            harmonics = np.empty((len(rows), (degree + 1) ** 2 if basis else 0), np.float32)
            evaluate_basis(arrays.means, rows, view, degree, harmonics)
        offsets, place = self._buffers["offsets"], self._buffer("place", (len(near),), np.int32)
        place[rows] = np.arange(len(rows), dtype=np.int32)
        drawn = np.take(shape, rows, axis=0)
        np.minimum(drawn[:, 6:9], _MAX_COLOUR, out=drawn[:, 6:9])
        # The exponent of 2 at which alpha, opacity · 2**exponent, falls below the minimum.
        drawn[:, 9] = np.log2(self._alpha_min / drawn[:, 5]) - _EXPONENT_MARGIN
        return ProjectedView(
            rows=rows,
            shape=drawn,
            box=np.take(box, rows, axis=0),
            basis=harmonics,
            starts=starts.copy(),
            ids=np.take(place, self._buffers["ids"]),
            slots=self._buffers["slots"].copy(),
            first=np.append(offsets[rows], offsets[-1]),  # splats that are not drawn have no records
            width=camera.W,
            height=camera.H,
        )

    def measure_pruning(
        self,
        drawn: ProjectedView,
        error: Array,
        seen: Array,
        *,
        background: Array,
    ) -> Array:
        """Measure one view, and add to the sums of a scene.

        Args:
            drawn: the view, with the splats' own colours.
            error: [N] float64, |d|² summed over pixels is added, with d the change of the render without the splat.
            seen: [N] bool, set for splats that are visible.
            background: [3].

        Returns:
            [H, W, 3], the render.
        """
        size, tiles_x = (drawn.height, drawn.width), -(-drawn.width // TILE)
        records = self._buffer("sums", (len(drawn.ids), PRUNING_SUMS), self.dtype)
        transmittance, last = self._buffer("through", size, self.dtype), self._buffer("last", size, self.dtype)
        rgb = np.empty((*size, 3), self.dtype)
        behind = np.ascontiguousarray(background, self.dtype)
        with thread_count(self.context.threads):
            blend_counted(
                drawn.starts, drawn.ids, drawn.shape, drawn.box, tiles_x, self._limits, behind,
                rgb, transmittance, last, self._buffer("used", (len(drawn.starts) - 1,), np.int64),
                np.empty((0, 0, 5), self.dtype),
            )  # fmt: skip
            sum_pruning(
                drawn.starts, drawn.ids, drawn.slots, drawn.shape, drawn.box, tiles_x, self._limits, behind,
                transmittance, last, records,
            )  # fmt: skip
            add_pruning_sums(drawn.rows, drawn.first, records, error, seen)
        return rgb

    def backproject(
        self,
        drawn: ProjectedView,
        coefficients: Array,
        active: Array,
        gradient: Array,
        diagonal: Array,
        *,
        offset: float,
        background: Array,
        reference: Array | None = None,
    ) -> Array:
        """Render with other colours, subtract an image, and project the difference back to the coefficients.

        A colour is offset + Σ_k Y_k(direction) · coefficient_k if it is active, else 0. It is not clamped.

        Args:
            drawn: the view; its colours are overwritten.
            coefficients: [N, B, 3] float32.
            active: [V, 3] bool, True for active colours.
            gradient: [N, B, 3] float32, the sum over pixels of w · Y_k · (render − reference) is added.
            diagonal: [N, B] float32, the sum over pixels of (w · Y_k)² is added; empty: it is not computed.
            offset: ½ for renders of splats, 0 for differences of such renders.
            background: [3].
            reference: [H, W, 3]; `None`: black.

        Returns:
            [H, W, 3], the render before the subtraction.
        """
        size, tiles_x = (drawn.height, drawn.width), -(-drawn.width // TILE)
        records = self._buffer("sums", (len(drawn.ids), COLOUR_SUMS), self.dtype)
        used = self._buffer("used", (len(drawn.starts) - 1,), np.int64)
        rgb = np.empty((*size, 3), self.dtype)
        with thread_count(self.context.threads):
            set_colours(drawn.rows, drawn.basis, coefficients, active, offset, drawn.shape)
            blend(
                drawn.starts, drawn.ids, drawn.shape, drawn.box, tiles_x, self._limits,
                np.ascontiguousarray(background, self.dtype), rgb, self._buffer("through", size, self.dtype),
                self._buffer("depth", size, self.dtype), used, np.empty((0, 0, 5), self.dtype),
            )  # fmt: skip
            error = rgb if reference is None else rgb - reference
            sum_colours(
                drawn.starts, used, drawn.ids, drawn.slots, drawn.shape, drawn.box, tiles_x, self._limits,
                error.astype(self.dtype, copy=False), records,
            )  # fmt: skip
            add_gradient(drawn.rows, drawn.first, records, drawn.basis, active, gradient, diagonal)
        return rgb

    def trim(self, drawn: ProjectedView) -> tuple[ProjectedView, Array]:
        """Drop splats of zero weight after a `backproject` of this view; renders do not change.

        Returns:
            The view; and the indices of the kept splats among the V.
        """
        return drawn.with_records(self._buffer("sums", (len(drawn.ids), COLOUR_SUMS), self.dtype)[:, 3] > 0.0)


@parallel_kernel()
def evaluate_basis(lane: int, lanes: int, means: Any, rows: Any, view: Any, degree: int, basis: Any) -> None:
    """Evaluate the SH basis in the direction of each drawn splat; parallel over blocks of splats.

    Args:
        means: [N, 3].
        rows: [V] int32, indices of the drawn splats.
        view: see `view_vector`.
        degree: highest SH degree.
        basis: [V, B], written; B is (degree + 1)² or 0.
    """
    values = np.empty(BASIS_SIZE, np.float64)
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            x, y, z, _ = view_direction(view, means[rows[j]])
            sh_basis(degree, x, y, z, values)
            for k in range(basis.shape[1]):
                basis[j, k] = values[k]


@parallel_kernel()
def set_colours(
    lane: int, lanes: int, rows: Any, basis: Any, coefficients: Any, active: Any, offset: float, shape: Any
) -> None:
    """Write colours, offset + Y · coefficients if active, else 0, into the shapes; parallel over blocks of splats.

    Args:
        rows, basis: see `ProjectedView`.
        coefficients, active, offset: see `Contributions.backproject`.
        shape: [V, 10], columns 6 to 8 are written.
    """
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            i = rows[j]
            r, g, b = _colour_at(basis[j], coefficients[i])
            shape[j, 6] = offset + r if active[j, 0] else 0.0
            shape[j, 7] = offset + g if active[j, 1] else 0.0
            shape[j, 8] = offset + b if active[j, 2] else 0.0


@device_function
def _colour_at(basis: Any, coefficients: Any) -> tuple[float, float, float]:
    """Return the products basis [B] · coefficients [B, 3], red, green, blue, summed in float64."""
    r, g, b = 0.0, 0.0, 0.0
    for k in range(basis.shape[0]):
        y = np.float64(basis[k])
        r += y * coefficients[k, 0]
        g += y * coefficients[k, 1]
        b += y * coefficients[k, 2]
    return r, g, b


@parallel_kernel()
def add_pruning_sums(lane: int, lanes: int, rows: Any, first: Any, records: Any, errors: Any, seen: Any) -> None:
    """Add the records of a view to the sums of `Contributions.measure_pruning`; parallel over blocks of splats.

    Args:
        rows, first: see `ProjectedView`.
        records: [intersections, PRUNING_SUMS], from `sum_pruning`.
        errors, seen: [N], modified; splats of weight 0 in the view keep their values.
    """
    for block in range(lane, (len(rows) + BLOCK - 1) // BLOCK, lanes):
        for j in range(block * BLOCK, min(len(rows), (block + 1) * BLOCK)):
            error, weight = 0.0, 0.0
            for n in range(first[j], first[j + 1]):
                error += records[n, 0]
                weight += records[n, 1]
            if weight > 0.0:
                errors[rows[j]] += error
                seen[rows[j]] = True


@parallel_kernel()
def add_gradient(
    lane: int, lanes: int, rows: Any, first: Any, records: Any, basis: Any, active: Any, gradient: Any, diagonal: Any
) -> None:
    """Add the records of a view to the results of `Contributions.backproject`; parallel over blocks of splats.

    gradient_k += Y_k Σ w · error and diagonal_k += Y_k² Σ w².
    """
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
            harmonics, sums = basis[j], gradient[rows[j]]
            for k in range(basis.shape[1]):
                sums[k, 0] += harmonics[k] * r32
                sums[k, 1] += harmonics[k] * g32
                sums[k, 2] += harmonics[k] * b32
            if with_diagonal:
                for k in range(basis.shape[1]):
                    diagonal[rows[j], k] += squares * harmonics[k] * harmonics[k]


#: Numbers per record.
PRUNING_SUMS = 2

_AREA = TILE * TILE

# Offsets of the planes of a tile: after transmittance, the colour B behind the current splat, the position of each
# pixel's last splat, the current splat's term of the sum, its weight, and positions in a row.
_RED, _GREEN, _BLUE, _LAST, _CHANGE, _WEIGHT, _X = (_AREA * k for k in range(1, 8))
_PLANES = 8


@parallel_kernel(relaxed=True)
def sum_pruning(
    lane: int,
    lanes: int,
    starts: Any,
    ids: Any,
    slots: Any,
    shape: Any,
    box: Any,
    tiles_x: int,
    limits: Any,
    background: Any,
    transmittance: Any,
    last: Any,
    records: Any,
) -> None:
    """Compute the sums of "Pruning" above; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane, lanes, starts, ids, shape, box, tiles_x, limits, background: as in `blend_counted`.
        slots: [intersections] int32, the record of each entry of `ids`.
        transmittance, last: [H, W], results of `blend_counted`.
        records: [intersections, PRUNING_SUMS], written: sums over pixels of |d|² and w.
    """
    height, width = transmittance.shape
    # Planes of 16 × 16 one after the other in one array, so that the compiler knows which parts overlap.
    planes, deepest = aligned_zeros(_PLANES * _AREA, limits), np.zeros(TILE, np.int64)
    ys = pixel_centres()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
    batch, rows = np.empty((BATCH, BATCH_COLUMNS), limits.dtype), np.empty((BATCH, 2), np.int64)
    alpha_min, alpha_cap = limits[0], limits[1]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    for tile in range(lane, len(starts) - 1, lanes):
        X0, Y0, columns, high = tile_extent(tile, tiles_x, width, height)
        planes[:_LAST] = zero
        planes[_LAST:_CHANGE] = -one  # pixels beyond the image have no splat
        planes[_CHANGE:_X] = zero
        start, end = starts[tile], starts[tile]
        for y in range(high):
            row = planes[y * TILE :]
            deepest[y] = -1
            for x in range(columns):
                row[x] = transmittance[Y0 + y, X0 + x]
                row[_LAST + x] = last[Y0 + y, X0 + x]
                row[_RED + x], row[_GREEN + x], row[_BLUE + x] = background[0], background[1], background[2]
                deepest[y] = max(deepest[y], np.int64(row[_LAST + x]))
            end = max(end, start + deepest[y] + 1)
        for k in range(end, starts[tile + 1]):
            records[slots[k]] = zero
        while end > start:
            begin = max(start, end - BATCH)
            gather_batch(ids, begin, end, shape, box, X0, Y0, 0, high, ys, batch, rows)
            narrow_rows(end - begin, batch, rows)
            for j in range(end - begin - 1, -1, -1):
                record, k = records[slots[begin + j]], begin + j - start
                first, after_last = rows[j, 0], rows[j, 1]
                while first < after_last and deepest[first] < k:
                    first += 1
                while first < after_last and deepest[after_last - 1] < k:
                    after_last -= 1
                if first >= after_last:
                    record[:] = zero
                    continue
                body = planes[first * TILE :]
                row0, row1, a, o, r, g, b, _ = batch_entry(batch, j, first)
                depth = planes.dtype.type(k)
                for y in range(after_last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        _, alpha = alpha_at(row[_X + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                        alpha = alpha if depth <= row[_LAST + x] else zero
                        before = row[x] / (one - alpha)
                        row[x] = before
                        weight = alpha * before
                        dr, dg, db = row[_RED + x] - r, row[_GREEN + x] - g, row[_BLUE + x] - b
                        row[_RED + x] -= alpha * dr
                        row[_GREEN + x] -= alpha * dg
                        row[_BLUE + x] -= alpha * db
                        row[_WEIGHT + x] = weight
                        row[_CHANGE + x] = weight * weight * (dr * dr + dg * dg + db * db)
                change, weight_sum = zero, zero
                for e in range((after_last - first) * TILE):
                    change += body[_CHANGE + e]
                    weight_sum += body[_WEIGHT + e]
                record[0], record[1] = change, weight_sum
            end = begin


#: Numbers per record.
COLOUR_SUMS = 4


# Offsets of the planes of a tile: after transmittance, the error, the current splat's weight, and positions in a row.
_COLOUR_RED, _COLOUR_GREEN, _COLOUR_BLUE, _COLOUR_WEIGHT, _COLOUR_X = (_AREA * k for k in range(1, 6))
_COLOUR_PLANES = 6

# Weight of a splat in a pixel that it finishes: negligible compared with the smallest weight, 4e-7, but not 0, so that
# `trim` keeps the splat.
_FINISHING_WEIGHT = 1e-12


@parallel_kernel(relaxed=True)
def sum_colours(
    lane: int,
    lanes: int,
    starts: Any,
    used: Any,
    ids: Any,
    slots: Any,
    shape: Any,
    box: Any,
    tiles_x: int,
    limits: Any,
    error: Any,
    records: Any,
) -> None:
    """Project an image back to the splats; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane, lanes, starts, ids, shape, box, tiles_x, limits: as in `blend`; colours are not read.
        used: [tiles] int64, result of `blend`.
        slots: [intersections] int32, the record of each entry of `ids`.
        error: [H, W, 3], the image.
        records: [intersections, COLOUR_SUMS], written: sums over pixels of w · error for red, green, blue, and of w²,
            which is 0 only for a splat that neither contributes to a pixel nor finishes one.
    """
    height, width = error.shape[:2]
    planes = aligned_zeros(_COLOUR_PLANES * _AREA, limits)
    T, ys = planes[:_AREA].reshape((TILE, TILE)), pixel_centres()
    for e in range(_AREA):
        planes[_COLOUR_X + e] = ys[e % TILE]
    batch, rows = np.empty((BATCH, BATCH_COLUMNS), limits.dtype), np.empty((BATCH, 2), np.int64)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    trace = planes.dtype.type(_FINISHING_WEIGHT)
    for tile in range(lane, len(used), lanes):
        X0, Y0, columns, high = tile_extent(tile, tiles_x, width, height)
        begin_tile(T, columns, one)
        planes[_COLOUR_RED:_COLOUR_WEIGHT] = zero
        read_planes(error, X0, Y0, columns, high, planes, _COLOUR_RED)
        # Finished rows are processed, too, so that the order of a sum does not depend on the splats in front.
        for begin in range(starts[tile], used[tile], BATCH):
            count = min(BATCH, used[tile] - begin)
            gather_batch(ids, begin, begin + count, shape, box, X0, Y0, 0, high, ys, batch, rows)
            for j in range(count):
                record = records[slots[begin + j]]
                first, last = rows[j, 0], rows[j, 1]
                if first >= last:
                    record[:] = zero
                    continue
                body = planes[first * TILE :]
                row0, row1, a, o, _, _, _, _ = batch_entry(batch, j, first)
                for y in range(last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        _, alpha = alpha_at(row[_COLOUR_X + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                        before = row[x]
                        going, weight, row[x] = transmit(before, alpha, stop, zero, one)
                        row[_COLOUR_WEIGHT + x] = weight if going else max(before, zero) * trace
                m0, m1, m2, m3 = zero, zero, zero, zero
                for e in range((last - first) * TILE):
                    weight = body[_COLOUR_WEIGHT + e]
                    m0 += weight * body[_COLOUR_RED + e]
                    m1 += weight * body[_COLOUR_GREEN + e]
                    m2 += weight * body[_COLOUR_BLUE + e]
                    m3 += weight * weight
                record[0], record[1], record[2], record[3] = m0, m1, m2, m3
        for k in range(used[tile], starts[tile + 1]):
            records[slots[k]] = zero
