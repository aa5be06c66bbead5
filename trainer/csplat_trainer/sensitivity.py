"""Sensitivity of renders to each splat, attribute by attribute, measured from training or virtual cameras.

The sensitivity of a parameter p is S(p) = Σ_i |∂E_i/∂p| / Σ_i P_i over the views i, with E_i the sum of the red, green
and blue of view i, and P_i its number of pixels. The sensitivity of a group of parameters is its maximum (Niedermayr,
Stumpfegger, Westermann, "Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis", CVPR 2024). This suits
colours. For opacity and shape the pixels of one view cancel in E_i: a growing splat brightens some pixels and darkens
others. So magnitudes are taken here before pixels and channels are summed; the published quantity is computed as well.

Sums of squares instead of magnitudes are the diagonal of the Gauss–Newton matrix: the squared error that a small error
of the parameter adds to the renders. They are the weights of k-means, which minimises squared errors.

At a pixel, let s_c be the derivative of channel c by the exponent of a splat, and t = ∂exponent/∂(Σ / γ²), a symmetric
matrix, with Σ the splat's covariance and γ² its trace. With Σ2 the covariance on the render, M the linearised
perspective and d the distance of the pixel from the centre,

    t = h hᵀ + C,  h = γ/√2 · Mᵀ Σ2⁻¹ d

C is 0 except in antialiased mode, in which the opacity depends on the covariance, too. h is linear in d:
`covariance_forms` computes its coefficients once per splat, `_moments` evaluates it at each pixel as (u, v, w) and sums

    Σ w, Σ w²                        w: the splat's weight at the pixel
    Σ s, Σ |s|, Σ s²                 s, |s|, s²: summed over channels
    Σ s t, Σ |s| |t|                 entries xx, yy, zz, xy, xz, yz of t
    Σ s² |h|²                        squared derivative by the centre, up to 2 / γ²
    Σ s² t tᵀ                        21 entries: the Gauss–Newton matrix of the covariance
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.spherical_harmonics import BASIS_SIZE
from csplat.types import F32, F64
from csplat_render.binning import TILE
from csplat_render.blending import (
    BATCH,
    BATCH_COLUMNS,
    HALF_TILE,
    aligned_zeros,
    alpha_at,
    batch_entry,
    begin_tile,
    gather_batch,
    pixel_centres,
    read_planes,
    tile_extent,
    transmit,
    unfinished_rows,
)
from csplat_render.camera import Camera
from csplat_render.conventions import COMPENSATION_MIN, view_vector
from csplat_render.kernels import parallel_kernel, relaxed_kernel, thread_count
from csplat_render.projection import (
    BLOCK,
    determinants,
    jacobian_rows,
    perspective_jacobian,
    rotation_matrix,
    sh_basis,
    standard_deviation,
    unit_quaternion,
    view_direction,
)
from csplat_render.rasteriser import Rasteriser

_DIAGONAL = [0, 6, 11, 15, 18, 20]  # indices of the diagonal in a triangle of 6 by 6
_MAX_SUM = 1e37  # largest value of a sum, so that six of them fit float32


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sensitivities and squared derivatives of a scene's renders, by splat and group of attributes.

    Attributes:
        colour: [N] float64, S of the SH coefficients including sh0: the largest of up to 75.
        opacity: [N] float64, S of alpha, with magnitudes summed over pixels and channels.
        shape: [N] float64, S of the covariance over its trace, the largest of 6 entries, summed likewise.
        opacity_net: [N] float64, S of alpha as published: pixels of a view cancel.
        shape_net: [N] float64, the same for the covariance. All five are `None` if they were not requested.
        colour_squares: [N] float64, squared derivatives of a pixel's channel by the splat's colour in that channel,
            summed over pixels and views, per pixel.
        opacity_squares: [N] float64, the same of all three channels by alpha.
        shape_squares: [N] float64, by all nine entries of the covariance over its trace.
        means_squares: [N] float64, by the three coordinates of the centre, per square scene unit; effects through the
            viewing direction are ignored.
        shape_metric: [N, 21] float64, the Gauss–Newton matrix whose trace is `shape_squares`: the upper triangle, row
            by row, over xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance over its trace.
        metric: [N, B (B + 1) / 2] float32, `colour_squares` with the basis functions of each view, B = (degree + 1)²:
            the upper triangle of the Gauss–Newton matrix of the SH coefficients of one channel; `None` if it was not
            requested.
        views: [N] int64, number of views that saw the splat.
        view_count: number of views.
        pixel_count: pixels of all views together.
    """

    colour: F64 | None
    opacity: F64 | None
    shape: F64 | None
    opacity_net: F64 | None
    shape_net: F64 | None
    colour_squares: F64
    opacity_squares: F64
    shape_squares: F64
    means_squares: F64
    shape_metric: F64
    metric: F32 | None
    views: NDArray[np.int64]
    view_count: int
    pixel_count: int

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[N] bool, True for splats that any view saw; the others have a colour sensitivity of 0."""
        seen: NDArray[np.bool_] = self.views > 0
        return seen

    @property
    def unseen_share(self) -> float:
        """Fraction of the splats that no view saw."""
        return 1.0 - float(self.seen.mean()) if len(self.views) else 0.0


def measure_sensitivity(
    model: SplatModel,
    cameras: Sequence[Camera],
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    metric: bool = False,
    magnitudes: bool = True,
    dtype: Any = np.float32,
    context: Context = DEFAULT_CONTEXT,
) -> Sensitivity:
    """Measure how much renders depend on each splat.

    Args:
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: background colour.
        metric: compute the matrices of SH coefficients, too, which take 2 B (B + 1) bytes per splat.
        magnitudes: compute the sensitivities themselves, which take 112 + 12 B bytes per splat.
        dtype: dtype of pixels, float32 or, for tests, float64.
        context: threads and progress.

    Raises:
        InputError: there are no cameras.
        LimitError: a render has more than `rasteriser.MAX_INTERSECTIONS`.
    """
    if not cameras:
        raise InputError("measuring sensitivity requires at least one camera")
    drawing = _Derivatives(model, metric=metric, magnitudes=magnitudes, dtype=dtype, context=context)
    for number, camera in enumerate(cameras):
        drawing.add(camera, background)
        context.progress("measuring sensitivity", (number + 1) / len(cameras))
    return drawing.result()


class _Derivatives(Rasteriser):
    """A rasteriser that sums the derivatives of views, and owns the sums.

    Args:
        model, metric, magnitudes, dtype, context: as for `measure_sensitivity`. Sums not requested have no rows.
    """

    def __init__(self, model: SplatModel, *, metric: bool, magnitudes: bool, dtype: Any, context: Context) -> None:
        super().__init__("standard", dtype, gradients=True, context=context)
        n, count = len(model), 1 + model.shN.shape[1]
        self._model = model
        rows = n if magnitudes else 0
        self._colour = np.zeros((rows, count, 3), np.float32)
        self._net, self._sizes = np.zeros((rows, 7)), np.zeros((rows, 7))  # alpha, six entries of the covariance
        self._squares = np.zeros((n, 3))  # colour, alpha, centre
        self._shape_matrices = np.zeros((n, 21))  # upper triangles over the six entries
        self._metric = np.zeros((n if metric else 0, count * (count + 1) // 2), np.float32)
        self._views = np.zeros(n, np.int64)
        self._keeps_metric, self._keeps_magnitudes = metric, magnitudes
        self._view_count = self._pixel_count = 0

    def add(self, camera: Camera, background: ArrayLike) -> None:
        """Add one view."""
        self.forward(self._model, camera, background=background, antialiased=self._model.metadata.antialiased)
        last = self._last
        assert last is not None
        a, n = last.splats, len(self._model)
        shape, box = self._buffer("shape", (n, 10), np.float64), self._buffer("box", (n, 4), np.int32)
        near, offsets = self._buffer("near", (n,), np.float32), self._buffer("offsets", (n + 1,), np.int64)
        forms = self._buffer("forms", (n, FORM_SIZE), np.float64)
        records = self._buffer("derivatives", (last.intersections, DERIVATIVE_SUMS), self.dtype)
        view = view_vector(camera)
        with thread_count(self.context.threads):
            covariance_forms(a.means, a.quats, a.scales, view, last.antialiased, shape, near, forms)
            sum_derivatives(
                self._buffer("starts", (last.tile_count + 1,), np.int64),
                self._buffer("used", (last.tile_count,), np.int64), self._buffers["ids"], self._buffers["slots"],
                shape, box, forms, last.tiles_x, self._limits, last.rgb, records,
            )  # fmt: skip
            add_view(
                a.means, a.opacities, a.scales, view, last.degree, shape, near, offsets, records,
                self._colour, self._net, self._sizes, self._squares, self._metric, self._shape_matrices,
                self._views,
            )  # fmt: skip
        self._view_count += 1
        self._pixel_count += camera.W * camera.H

    def result(self) -> Sensitivity:
        """Divide by the number of pixels, and take the maximum of each group."""
        pixels = max(1, self._pixel_count)
        self._metric /= np.float32(pixels)
        shape_matrices, squares, net, sizes = (
            _mean_over(sums, pixels) for sums in (self._shape_matrices, self._squares, self._net, self._sizes)
        )
        kept = self._keeps_magnitudes
        return Sensitivity(
            colour=self._colour.max(axis=(1, 2), initial=0.0).astype(np.float64) / pixels if kept else None,
            opacity=sizes[:, 0] if kept else None,
            shape=sizes[:, 1:].max(axis=1) if kept else None,
            opacity_net=net[:, 0] if kept else None,
            shape_net=net[:, 1:].max(axis=1) if kept else None,
            colour_squares=squares[:, 0],
            opacity_squares=squares[:, 1],
            shape_squares=shape_matrices[:, _DIAGONAL].sum(axis=1),
            means_squares=squares[:, 2],
            shape_metric=shape_matrices,
            metric=self._metric if self._keeps_metric else None,
            views=self._views,
            view_count=self._view_count,
            pixel_count=self._pixel_count,
        )


def _mean_over(sums: F64, pixels: int) -> F64:
    """Divide an array of any shape in place, and limit it to float32; sums that overflowed float64 become 0."""
    sums /= pixels
    np.nan_to_num(sums, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    return np.clip(sums, -_MAX_SUM, _MAX_SUM, out=sums)


#: Numbers per splat that determine how its exponent depends on its covariance.
FORM_SIZE = 12


@parallel_kernel()
def covariance_forms(lane: int, lanes: int, means: Any, quats: Any, scales: Any, view: Any, antialiased: bool,
                     shape: Any, near: Any, forms: Any) -> None:  # fmt: skip
    """Compute the coefficients of h and C in the equations at the top of this module; parallel over blocks.

    Args:
        means, quats, scales, view, antialiased, shape: see `project`.
        near: [N] float32, above 0 for drawn splats.
        forms: [N, FORM_SIZE] float64, written for drawn splats: the matrix of h by d, [3, 2] row by row; C, as xx yy zz
            xy xz yz.
    """
    n = means.shape[0]
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not near[i] > 0.0:
                continue
            X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            x = view[0] * X + view[1] * Y + view[2] * Z + view[9]
            y = view[3] * X + view[4] * Y + view[5] * Z + view[10]
            z = view[6] * X + view[7] * Y + view[8] * Z + view[11]
            j0, j02, j1, j12, _, _ = perspective_jacobian(view, x, y, z)
            pq = jacobian_rows(view, j0, j02, j1, j12)
            s0, s1, s2 = (
                standard_deviation(scales[i, 0]),
                standard_deviation(scales[i, 1]),
                standard_deviation(scales[i, 2]),
            )
            half = 0.5 * (s0 * s0 + s1 * s1 + s2 * s2)
            a, b, c = shape[i, 2], shape[i, 3], shape[i, 4]
            size = math.sqrt(half)
            for k in range(3):
                p, q = pq[k], pq[3 + k]
                forms[i, 2 * k], forms[i, 2 * k + 1] = size * (p * a + q * b), size * (p * b + q * c)
            forms[i, 6:] = 0.0
            if antialiased:
                qw, qx, qy, qz, _ = unit_quaternion(quats[i])
                r = rotation_matrix(qw, qx, qy, qz)
                A, B, C = 0.0, 0.0, 0.0
                for k, s in enumerate((s0, s1, s2)):
                    u = s * (r[k] * pq[0] + r[3 + k] * pq[1] + r[6 + k] * pq[2])
                    v = s * (r[k] * pq[3] + r[3 + k] * pq[4] + r[6 + k] * pq[5])
                    A, B, C = A + u * u, B + u * v, C + v * v
                bare, dilated = determinants(pq, r, s0, s1, s2, A + C)
                if bare > COMPENSATION_MIN * dilated:
                    # Derivative of log √(det Σ2 / det (Σ2 + dilation)) by Σ2: half the difference of inverses.
                    da, db, dc = C / bare - a, -B / bare - b, A / bare - c
                    for e, (k, m) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
                        left, right = pq[k] * da + pq[3 + k] * db, pq[k] * db + pq[3 + k] * dc
                        forms[i, 6 + e] = half * (left * pq[m] + right * pq[3 + m])


#: Numbers per record: the sums listed at the top of this module, in their order.
DERIVATIVE_SUMS = 39

_AREA = TILE * TILE

# Offsets of the planes of a tile: transmittance, colour behind the splat by channel, the splat's weight at the pixel,
# Σ s, Σ |s|, Σ s², positions relative to the centre of the tile.
_RED, _GREEN, _BLUE, _WEIGHT, _SLOPE, _SIZE, _SQUARE, _X, _Y = (_AREA * k for k in range(1, 10))
_PLANES = 10


@parallel_kernel(relaxed=True)
def sum_derivatives(lane: int, lanes: int, starts: Any, used: Any, ids: Any, slots: Any, shape: Any, box: Any,
                    forms: Any, tiles_x: int, limits: Any, rgb: Any, records: Any) -> None:  # fmt: skip
    """Compute a record for every splat and tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane, lanes, starts, used, ids, slots, shape, box, tiles_x, limits: see `blend_backward`.
        forms: see `covariance_forms`.
        rgb: [H, W, 3], the render.
        records: [intersections, DERIVATIVE_SUMS], written.
    """
    height, width = rgb.shape[:2]
    planes = aligned_zeros(_PLANES * _AREA, limits)
    T = planes[:_AREA].reshape((TILE, TILE))
    ys = pixel_centres()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
        planes[_Y + e] = ys[e // TILE]
    batch, rows_ = np.empty((BATCH, BATCH_COLUMNS), limits.dtype), np.empty((BATCH, 2), np.int64)
    form, sums = np.empty(FORM_SIZE + 3, limits.dtype), np.empty(DERIVATIVE_SUMS, limits.dtype)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    for tile in range(lane, len(used), lanes):
        X0, Y0, columns, high = tile_extent(tile, tiles_x, width, height)
        low = 0
        planes[:_X] = zero
        begin_tile(T, columns, one)
        read_planes(rgb, X0, Y0, columns, high, planes, _RED)
        for begin in range(starts[tile], used[tile], BATCH):
            low, high = unfinished_rows(T, low, high)
            count = min(BATCH, used[tile] - begin)
            gather_batch(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows_)
            for j in range(count):
                record = records[slots[begin + j]]
                first, last = rows_[j, 0], rows_[j, 1]
                if first >= last:
                    record[:] = zero
                    continue
                body = planes[first * TILE :]
                row0, row1, a, o, r, g, b, _ = batch_entry(batch, j, first)
                for y in range(last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        full, alpha = alpha_at(row[_X + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                        going, weight, row[x] = transmit(row[x], alpha, stop, zero, one)
                        red, green, blue = weight * r, weight * g, weight * b
                        row[_RED + x] -= red
                        row[_GREEN + x] -= green
                        row[_BLUE + x] -= blue
                        share = alpha / (one - alpha)
                        red -= row[_RED + x] * share
                        green -= row[_GREEN + x] * share
                        blue -= row[_BLUE + x] * share
                        free = one if going and full < alpha_cap else zero
                        row[_WEIGHT + x] = weight
                        row[_SLOPE + x] = free * (red + green + blue)
                        row[_SIZE + x] = free * (abs(red) + abs(green) + abs(blue))
                        row[_SQUARE + x] = free * (red * red + green * green + blue * blue)
                i = ids[begin + j]
                dx, dy = X0 + HALF_TILE - shape[i, 0], Y0 + HALF_TILE - shape[i, 1]
                for e in range(FORM_SIZE):
                    form[e] = forms[i, e]
                for k in range(3):
                    form[FORM_SIZE + k] = forms[i, 2 * k] * dx + forms[i, 2 * k + 1] * dy
                _moments(body, (last - first) * TILE, form, sums)
                for e in range(DERIVATIVE_SUMS):
                    record[e] = sums[e]
        for k in range(used[tile], starts[tile + 1]):
            records[slots[k]] = zero


@relaxed_kernel
def _moments(body: Any, count: int, form: Any, sums: Any) -> None:
    """Sum over the pixels of a tile for one splat: the equations at the top of this module, with h = (u, v, w).

    The second pass over the pixels computes the sums of t tᵀ, the first pass all others.

    Args:
        body: planes of the tile, from the first pixel of the splat on.
        count: number of pixels.
        form: [FORM_SIZE + 3], the splat's row of `covariance_forms`, then h at the middle of the tile.
        sums: [DERIVATIVE_SUMS], written, in the order of the equations; entries of symmetric matrices xx yy zz xy xz
            yz, and of t tᵀ the upper triangle, row by row.
    """
    zero = form[0] - form[0]
    ax, ay, bx, by, cx, cy = form[0], form[1], form[2], form[3], form[4], form[5]
    oxx, oyy, ozz, oxy, oxz, oyz = form[6], form[7], form[8], form[9], form[10], form[11]
    a0, b0, c0 = form[12], form[13], form[14]
    m0, m1, m2, m3, m4, m5, m6, m7, m8, m9 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    n0, n1, n2, n3, n4, n5, n6, n7 = zero, zero, zero, zero, zero, zero, zero, zero
    for e in range(count):
        x, y = body[_X + e], body[_Y + e]
        weight, slope, size, square = body[_WEIGHT + e], body[_SLOPE + e], body[_SIZE + e], body[_SQUARE + e]
        u, v, w = a0 + ax * x + ay * y, b0 + bx * x + by * y, c0 + cx * x + cy * y
        xx, yy, zz = u * u + oxx, v * v + oyy, w * w + ozz
        xy, xz, yz = u * v + oxy, u * w + oxz, v * w + oyz
        m0 += weight
        m1 += weight * weight
        m2 += slope
        m3 += size
        m4 += square
        m5 += slope * xx
        m6 += slope * yy
        m7 += slope * zz
        m8 += slope * xy
        m9 += slope * xz
        n0 += slope * yz
        n1 += size * abs(xx)
        n2 += size * abs(yy)
        n3 += size * abs(zz)
        n4 += size * abs(xy)
        n5 += size * abs(xz)
        n6 += size * abs(yz)
        n7 += square * (u * u + v * v + w * w)
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6] = m0, m1, m2, m3, m4, m5, m6
    sums[7], sums[8], sums[9], sums[10], sums[11], sums[12], sums[13] = m7, m8, m9, n0, n1, n2, n3
    sums[14], sums[15], sums[16], sums[17] = n4, n5, n6, n7
    p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    p11, p12, p13, p14, p15, p16, p17, p18, p19, p20 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for e in range(count):
        x, y, square = body[_X + e], body[_Y + e], body[_SQUARE + e]
        u, v, w = a0 + ax * x + ay * y, b0 + bx * x + by * y, c0 + cx * x + cy * y
        xx, yy, zz = u * u + oxx, v * v + oyy, w * w + ozz
        xy, xz, yz = u * v + oxy, u * w + oxz, v * w + oyz
        sxx = square * xx
        syy = square * yy
        szz = square * zz
        sxy = square * xy
        sxz = square * xz
        syz = square * yz
        p0 += sxx * xx
        p1 += sxx * yy
        p2 += sxx * zz
        p3 += sxx * xy
        p4 += sxx * xz
        p5 += sxx * yz
        p6 += syy * yy
        p7 += syy * zz
        p8 += syy * xy
        p9 += syy * xz
        p10 += syy * yz
        p11 += szz * zz
        p12 += szz * xy
        p13 += szz * xz
        p14 += szz * yz
        p15 += sxy * xy
        p16 += sxy * xz
        p17 += sxy * yz
        p18 += sxz * xz
        p19 += sxz * yz
        p20 += syz * yz
    sums[18], sums[19], sums[20], sums[21], sums[22], sums[23], sums[24] = p0, p1, p2, p3, p4, p5, p6
    sums[25], sums[26], sums[27], sums[28], sums[29], sums[30], sums[31] = p7, p8, p9, p10, p11, p12, p13
    sums[32], sums[33], sums[34], sums[35], sums[36], sums[37], sums[38] = p14, p15, p16, p17, p18, p19, p20


@parallel_kernel()
def add_view(lane: int, lanes: int, means: Any, opacities: Any, scales: Any, view: Any, degree: int, shape: Any,
             near: Any, offsets: Any, records: Any, colour: Any, net: Any, sizes: Any, squares: Any, metric: Any,
             shape_matrices: Any, views: Any) -> None:  # fmt: skip
    """Add the sums of a view for every splat; parallel over blocks of splats, records in a fixed order.

    Args:
        means, opacities, scales, view, shape: see `project`.
        degree: degree of the spherical harmonics.
        near: [N] float32, above 0 for drawn splats.
        offsets: [N + 1] int64, index of each splat's first record.
        records: [intersections, DERIVATIVE_SUMS].
        colour: [N, B, 3] float32, incremented by |derivative of the render's sum by a coefficient|; [0, …] if this and
            the next two are not requested.
        net: [N, 7] float64, incremented by the same for alpha and the six entries of the covariance over its trace.
        sizes: [N, 7] float64, incremented by the same with magnitudes taken per pixel and channel.
        squares: [N, 3] float64, incremented by squared derivatives of the pixels' channels by a colour (one channel),
            alpha, and the centre.
        metric: [N, B (B + 1) / 2] float32, incremented by squared derivatives by SH coefficients of one channel, the
            upper triangle of a matrix; [0, …] if not requested.
        shape_matrices: [N, 21] float64, incremented by squared derivatives of all channels by the covariance over its
            trace, the upper triangle of a matrix over xx, yy, zz, √2 xy, √2 xz, √2 yz.
        views: [N] int64, incremented if the splat was seen.
    """
    n = means.shape[0]
    count = (degree + 1) * (degree + 1)
    basis, sums = np.empty(BASIS_SIZE, np.float64), np.empty(DERIVATIVE_SUMS, np.float64)
    with_magnitudes = colour.shape[0] > 0
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not (near[i] > 0.0 and offsets[i + 1] > offsets[i]):
                continue
            sums[:] = 0.0
            for j in range(offsets[i], offsets[i + 1]):
                for e in range(DERIVATIVE_SUMS):
                    sums[e] += records[j, e]
            if not sums[0] > 0.0:
                continue
            views[i] += 1
            x, y, z, _ = view_direction(view, means[i])
            sh_basis(degree, x, y, z, basis)
            for c in range(3 if with_magnitudes else 0):
                if shape[i, 6 + c] > 0.0:
                    for k in range(count):
                        colour[i, k, c] += abs(basis[k]) * sums[0]
            if metric.shape[0] > 0:
                place = 0
                for k in range(count):
                    for m in range(k, count):
                        metric[i, place] += basis[k] * basis[m] * sums[1]
                        place += 1
            alpha = np.float64(opacities[i])
            if with_magnitudes:
                net[i, 0] += abs(sums[2]) / alpha
                sizes[i, 0] += sums[3] / alpha
            for e in range(6 if with_magnitudes else 0):
                twice = 1.0 if e < 3 else 2.0  # an entry off the diagonal occurs twice in the covariance
                net[i, 1 + e] += twice * abs(sums[5 + e])
                sizes[i, 1 + e] += twice * sums[11 + e]
            s0, s1, s2 = (
                standard_deviation(scales[i, 0]),
                standard_deviation(scales[i, 1]),
                standard_deviation(scales[i, 2]),
            )
            squares[i, 0] += sums[1]
            squares[i, 1] += sums[4] / (alpha * alpha)
            squares[i, 2] += 2.0 * sums[17] / (s0 * s0 + s1 * s1 + s2 * s2)
            place = 0
            for e in range(6):
                for f in range(e, 6):
                    multiplicity = (2.0 if e > 2 else 1.0) * (2.0 if f > 2 else 1.0)
                    shape_matrices[i, place] += math.sqrt(multiplicity) * sums[18 + place]
                    place += 1
