"""The loop over pixels, backward: one record of gradients per splat and tile, so that nothing is shared.

The splats of a tile are blended once more, front to back. A pixel keeps one number: the gradient's
product with all colour, depth and alpha that lies behind; each splat takes its share off.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from csplat_render.binning import TILE
from csplat_render.blending import CHECK, alive_rows, tile_polynomial
from csplat_render.jit import fast_exp, parallel_kernel

__all__ = ["RECORD", "blend_backward"]

#: Numbers per record: moments of the exponent's gradient (1, x, y, xx, xy, yy, about the centre of
#: the tile), gradients of red, green, blue and depth.
RECORD = 10

_HALF = 0.5 * TILE
_AREA = TILE * TILE

# Where the planes of a tile begin: transmittance, the gradient's product with what lies behind,
# gradients, shares of the current splat, positions about the centre of the tile.
_BEHIND, _RED, _GREEN, _BLUE, _ALPHA, _DEPTH, _SLOPE, _WEIGHT, _X, _Y = (_AREA * k for k in range(1, 11))
_PLANES = 11


@parallel_kernel(relaxed=True)
def blend_backward(
    starts: Any,
    used: Any,
    ids: Any,
    slots: Any,
    shape: Any,
    box: Any,
    tiles_x: int,
    lanes: int,
    limits: Any,
    rgb: Any,
    transmittance: Any,
    depth: Any,
    grad_rgb: Any,
    grad_alpha: Any,
    grad_depth: Any,
    records: Any,
) -> None:
    """Gradients of every splat in every tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        starts: see `blend`.
        used: [tiles] int64, as `blend` wrote it.
        ids: see `blend`.
        slots: [intersections] int32, the record of each of `ids`.
        shape: see `blend`, as the next four.
        box: see `blend`.
        tiles_x: see `blend`.
        lanes: see `blend`.
        limits: see `blend`.
        rgb: [H, W, 3], as `blend` wrote it, as the next two.
        transmittance: [H, W].
        depth: [H, W].
        grad_rgb: [H, W, 3], gradient of the loss.
        grad_alpha: [H, W], the same for alpha = 1 − transmittance.
        grad_depth: [H, W], the same for depth.
        records: [intersections, RECORD], written.
    """
    height, width = transmittance.shape
    for lane in numba.prange(lanes):
        # Planes of 16 × 16, one after the other, in one array: so the compiler sees what overlaps.
        planes = np.zeros(_PLANES * _AREA, limits.dtype)
        T = planes[:_AREA].reshape((TILE, TILE))
        for e in range(_AREA):
            planes[_X + e] = e % TILE + 0.5 - _HALF
            planes[_Y + e] = e // TILE + 0.5 - _HALF
        alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
        zero, one = alpha_min - alpha_min, alpha_min / alpha_min
        for tile in range(lane, len(used), lanes):
            X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
            columns, low, high = min(TILE, width - X0), 0, min(TILE, height - Y0)
            planes[:_X] = zero
            T[:, :columns] = one
            T[:, columns:] = -one
            for y in range(high):
                row = planes[y * TILE :]
                for x in range(columns):
                    gr, gg, gb = grad_rgb[Y0 + y, X0 + x, 0], grad_rgb[Y0 + y, X0 + x, 1], grad_rgb[Y0 + y, X0 + x, 2]
                    ga, gd = grad_alpha[Y0 + y, X0 + x], grad_depth[Y0 + y, X0 + x]
                    row[_RED + x], row[_GREEN + x], row[_BLUE + x] = gr, gg, gb
                    row[_ALPHA + x], row[_DEPTH + x] = ga, gd
                    row[_BEHIND + x] = (
                        gr * rgb[Y0 + y, X0 + x, 0]
                        + gg * rgb[Y0 + y, X0 + x, 1]
                        + gb * rgb[Y0 + y, X0 + x, 2]
                        + ga * (one - transmittance[Y0 + y, X0 + x])
                        + gd * depth[Y0 + y, X0 + x]
                    )
            for k in range(starts[tile], used[tile]):
                if (k - starts[tile]) % CHECK == CHECK - 1:
                    low, high = alive_rows(T, low, high)
                i = ids[k]
                c0, cx, cy, cxx, cxy, cyy, seen = tile_polynomial(shape, i, X0 + _HALF, Y0 + _HALF)
                record = records[slots[k]]
                first, last = max(box[i, 2] - Y0, low), min(box[i, 3] - Y0, high)
                if not (seen and first < last):
                    record[:] = zero
                    continue
                a, o = planes.dtype.type(cxx), planes.dtype.type(shape[i, 5])
                r, g, b = planes.dtype.type(shape[i, 6]), planes.dtype.type(shape[i, 7]), planes.dtype.type(shape[i, 8])
                d = planes.dtype.type(shape[i, 9])
                for y in range(first, last):
                    dy = y + 0.5 - _HALF
                    row0 = planes.dtype.type(c0 + dy * (cy + dy * cyy))
                    row1 = planes.dtype.type(cx + dy * cxy)
                    row = planes[y * TILE :]
                    for x in range(TILE):
                        at = row[_X + x]
                        power = (a * at + row1) * at + row0
                        full = o * fast_exp(min(power, zero))
                        alpha = min(full, alpha_cap)
                        alpha = alpha if alpha >= alpha_min else zero
                        before = row[x]
                        rest = one - alpha
                        after = before * rest
                        going = after >= stop
                        weight = alpha * before if going else zero
                        row[x] = after if going else -abs(before)
                        colour = row[_RED + x] * r + row[_GREEN + x] * g + row[_BLUE + x] * b
                        own = weight * (colour + row[_ALPHA + x] + row[_DEPTH + x] * d)
                        behind = row[_BEHIND + x] - own
                        row[_BEHIND + x] = behind
                        # Colour of this splat against the colour behind; nothing where alpha is capped.
                        slope = own - behind * alpha / rest
                        slope = slope if going else zero
                        row[_SLOPE + x] = slope if full < alpha_cap else zero
                        row[_WEIGHT + x] = weight
                m0, m1, m2, m3, m4, m5, m6, m7, m8, m9 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
                body = planes[first * TILE :]
                for e in range((last - first) * TILE):
                    slope, weight = body[_SLOPE + e], body[_WEIGHT + e]
                    sx, sy = slope * body[_X + e], slope * body[_Y + e]
                    m0 += slope
                    m1 += sx
                    m2 += sy
                    m3 += sx * body[_X + e]
                    m4 += sx * body[_Y + e]
                    m5 += sy * body[_Y + e]
                    m6 += weight * body[_RED + e]
                    m7 += weight * body[_GREEN + e]
                    m8 += weight * body[_BLUE + e]
                    m9 += weight * body[_DEPTH + e]
                record[0], record[1], record[2], record[3], record[4] = m0, m1, m2, m3, m4
                record[5], record[6], record[7], record[8], record[9] = m5, m6, m7, m8, m9
            for k in range(used[tile], starts[tile + 1]):
                records[slots[k]] = zero
