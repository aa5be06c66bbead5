"""The loop over pixels, backward: one record of gradients per splat and tile, so that nothing is shared.

The splats of a tile are blended once more, front to back. A pixel keeps one number: the gradient's
product with all colour, depth and alpha that lies behind; each splat takes its share off.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from csplat_render.binning import TILE
from csplat_render.blending_steps import (
    CHECK,
    NUMBERS,
    aligned,
    alive_rows,
    alpha_at,
    begin_tile,
    gather,
    middles,
    numbers_of,
    passed,
    place,
    read_planes,
)
from csplat_render.jit import parallel_kernel

#: Numbers per record: moments of the exponent's gradient (1, x, y, xx, xy, yy, about the centre of
#: the tile), gradients of red, green, blue and depth.
RECORD = 10

_AREA = TILE * TILE

# Where the planes of a tile begin: transmittance, the gradient's product with what lies behind,
# gradients, shares of the current splat, positions about the centre of the tile.
_BEHIND, _RED, _GREEN, _BLUE, _ALPHA, _DEPTH, _SLOPE, _WEIGHT, _X, _Y = (_AREA * k for k in range(1, 11))
_PLANES = 11


@parallel_kernel(relaxed=True)
def blend_backward(
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
        lane: which of the threads this is.
        lanes: how many share the tiles; the result does not depend on it.
        starts: see `blend`.
        used: [tiles] int64, as `blend` wrote it.
        ids: see `blend`.
        slots: [intersections] int32, the record of each of `ids`.
        shape: see `blend`, as the next three.
        box: see `blend`.
        tiles_x: see `blend`.
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
    # Planes of 16 × 16, one after the other, in one array: so the compiler sees what overlaps.
    planes = aligned(_PLANES * _AREA, limits)
    T = planes[:_AREA].reshape((TILE, TILE))
    ys = middles()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
        planes[_Y + e] = ys[e // TILE]
    batch, rows = np.empty((CHECK, NUMBERS), limits.dtype), np.empty((CHECK, 2), np.int64)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    for tile in range(lane, len(used), lanes):
        X0, Y0, columns, high = place(tile, tiles_x, width, height)
        low = 0
        planes[:_X] = zero
        begin_tile(T, columns, one)
        read_planes(grad_rgb, X0, Y0, columns, high, planes, _RED)
        for y in range(high):
            row = planes[y * TILE :]
            for x in range(columns):
                ga, gd = grad_alpha[Y0 + y, X0 + x], grad_depth[Y0 + y, X0 + x]
                row[_ALPHA + x], row[_DEPTH + x] = ga, gd
                row[_BEHIND + x] = (
                    row[_RED + x] * rgb[Y0 + y, X0 + x, 0]
                    + row[_GREEN + x] * rgb[Y0 + y, X0 + x, 1]
                    + row[_BLUE + x] * rgb[Y0 + y, X0 + x, 2]
                    + ga * (one - transmittance[Y0 + y, X0 + x])
                    + gd * depth[Y0 + y, X0 + x]
                )
        for begin in range(starts[tile], used[tile], CHECK):
            low, high = alive_rows(T, low, high)
            count = min(CHECK, used[tile] - begin)
            gather(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows)
            for j in range(count):
                record = records[slots[begin + j]]
                first, last = rows[j, 0], rows[j, 1]
                if first >= last:
                    record[:] = zero
                    continue
                body = planes[first * TILE :]
                row0, row1, a, o, r, g, b, d = numbers_of(batch, j, first)
                for y in range(last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        full, alpha = alpha_at(row[_X + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                        going, weight, row[x] = passed(row[x], alpha, stop, zero, one)
                        colour = row[_RED + x] * r + row[_GREEN + x] * g + row[_BLUE + x] * b
                        own = weight * (colour + row[_ALPHA + x] + row[_DEPTH + x] * d)
                        behind = row[_BEHIND + x] - own
                        row[_BEHIND + x] = behind
                        # Colour of this splat against the colour behind; nothing where alpha is capped.
                        slope = own - behind * alpha / (one - alpha)
                        slope = slope if going else zero
                        row[_SLOPE + x] = slope if full < alpha_cap else zero
                        row[_WEIGHT + x] = weight
                m0, m1, m2, m3, m4, m5, m6, m7, m8, m9 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
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
