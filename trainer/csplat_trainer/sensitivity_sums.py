"""Sums of the derivatives of every pixel of a render towards every splat, without building any matrix.

`Rasteriser.backward` adds the derivatives of a render's pixels before they can be examined: an axis that grows
brightens one side of a splat and darkens what it hides, and the sum may be near 0 for a splat on which much depends.
Here magnitudes and squares are added pixel by pixel and channel by channel, in addition to the plain sum.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

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
from csplat_render.kernels import parallel_kernel, relaxed_kernel
from csplat_render.projection import BLOCK, sh_basis, standard_deviation, view_direction
from csplat_trainer.sensitivity_forms import FORM

#: Numbers per record. With w the share of a pixel that is the splat's, s_c the derivative of channel c towards the
#: exponent (that is, towards the logarithm of alpha), t the matrix of `covariance_forms`, |h|² of its first part: sums
#: over pixels of w, w²; Σ s, Σ |s|, Σ s² over channels; Σ s · t (6 entries); Σ |s| · |t| (6); Σ s² · |h|²; Σ s² · t tᵀ
#: (the upper triangle of 6 by 6).
SUMS = 39

_AREA = TILE * TILE

# Offsets of the planes of a tile: transmittance, what lies behind by channel, the current splat's share of the pixel,
# Σ s, Σ |s|, Σ s², positions about the centre of the tile.
_RED, _GREEN, _BLUE, _WEIGHT, _SLOPE, _SIZE, _SQUARE, _X, _Y = (_AREA * k for k in range(1, 10))
_PLANES = 10


@parallel_kernel(relaxed=True)
def sum_derivatives(lane: int, lanes: int, starts: Any, used: Any, ids: Any, slots: Any, shape: Any, box: Any,
                    forms: Any, tiles_x: int, limits: Any, rgb: Any, records: Any) -> None:  # fmt: skip
    """One record for every splat in every tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane: see `blend_backward`.
        lanes: see `blend_backward`.
        starts: see `blend_backward`, as the next five.
        used: see `blend_backward`.
        ids: see `blend_backward`.
        slots: see `blend_backward`.
        shape: see `blend_backward`.
        box: see `blend_backward`.
        forms: see `covariance_forms`.
        tiles_x: see `blend_backward`, as the next.
        limits: see `blend_backward`.
        rgb: [H, W, 3], the picture.
        records: [intersections, SUMS], written.
    """
    height, width = rgb.shape[:2]
    planes = aligned_zeros(_PLANES * _AREA, limits)
    T = planes[:_AREA].reshape((TILE, TILE))
    ys = pixel_centres()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
        planes[_Y + e] = ys[e // TILE]
    batch, rows_ = np.empty((BATCH, BATCH_COLUMNS), limits.dtype), np.empty((BATCH, 2), np.int64)
    form, sums = np.empty(FORM + 3, limits.dtype), np.empty(SUMS, limits.dtype)
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
                for e in range(FORM):
                    form[e] = forms[i, e]
                for k in range(3):
                    form[FORM + k] = forms[i, 2 * k] * dx + forms[i, 2 * k + 1] * dy
                _moments(body, (last - first) * TILE, form, sums)
                for e in range(SUMS):
                    record[e] = sums[e]
        for k in range(used[tile], starts[tile + 1]):
            records[slots[k]] = zero


@relaxed_kernel
def _moments(body: Any, count: int, form: Any, sums: Any) -> None:
    """The sums of one splat over pixels of a tile; `form` is as in `covariance_forms`, then h at the tile's middle."""
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
             bends: Any, views: Any) -> None:  # fmt: skip
    """Add one view's sums for every splat; parallel over blocks of splats, records in one order.

    Args:
        means: see `project`, as the next two.
        opacities: see `project`.
        scales: see `project`.
        view: see `project`.
        degree: degree of the spherical harmonics.
        shape: see `project`.
        near: [N] float32, above 0 for splats that are drawn.
        offsets: [N + 1] int64, index of each splat's first record.
        records: [intersections, SUMS].
        colour: [N, B, 3] float32, added to: |derivative of the render's sum towards a coefficient|; [0, …] if neither
            this nor the next two are needed.
        net: [N, 7] float64, added to: the same towards alpha and the six entries of the covariance over its trace.
        sizes: [N, 7] float64, added to: the same with magnitudes taken pixel by pixel and channel by channel.
        squares: [N, 3] float64, added to: squared derivatives of the pixels' channels towards a colour (one channel of
            it), alpha, and the centre.
        metric: [N, B (B + 1) / 2] float32, added to: squared derivatives towards SH coefficients, of one channel, the
            upper triangle of a matrix; [0, …] if it is not needed.
        bends: [N, 21] float64, added to: squared derivatives of all channels towards the covariance over its trace, as
            the upper triangle of a matrix over xx, yy, zz, √2 xy, √2 xz, √2 yz.
        views: [N] int64, added to: 1 if the splat was seen.
    """
    n = means.shape[0]
    count = (degree + 1) * (degree + 1)
    basis, sums = np.empty(16, np.float64), np.empty(SUMS, np.float64)
    with_magnitudes = colour.shape[0] > 0
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not (near[i] > 0.0 and offsets[i + 1] > offsets[i]):
                continue
            sums[:] = 0.0
            for j in range(offsets[i], offsets[i + 1]):
                for e in range(SUMS):
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
                    beside = (2.0 if e > 2 else 1.0) * (2.0 if f > 2 else 1.0)
                    bends[i, place] += math.sqrt(beside) * sums[18 + place]
                    place += 1
