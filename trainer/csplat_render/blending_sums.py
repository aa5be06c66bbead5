"""The loops over pixels for what each splat is to a picture: what its removal would change, or how its colour errs.

At a pixel a splat of alpha a with transmittance T in front of it has the weight w = T·a. Let C be its colour and B the
colour that is seen where it ends, background included, not multiplied with any transmittance. Without the splat the
pixel changes by d = w·(B − C): nothing else in the sum changes but the light that reaches what lies behind. So after
an ordinary picture, in which each pixel notes the splat that finished it, the splats of a tile are gone through once
more, back to front: B follows from B ← B + a·(C − B), T from T ← T / (1 − a). Nothing is subtracted from a finished
sum: what lies deep behind is as exact as what lies in front.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from csplat_render.binning import TILE
from csplat_render.blending import CHECK, alive_rows, tile_polynomial
from csplat_render.jit import fast_exp, parallel_kernel

__all__ = ["SUMS", "blend_counted", "sum_back"]

#: Numbers per record.
SUMS = 4

_HALF = 0.5 * TILE
_NEVER = 3e38  # place of the splat that finished a pixel, where none did

# Where the planes of a row begin, after transmittance: three colours, positions; and, forward: the place of the splat
# that finished the pixel; back: the same, three differences from the picture that is wanted, alpha.
_RED, _GREEN, _BLUE, _X, _LAST, _ERR_R, _ERR_G, _ERR_B, _ALPHA = (TILE * k for k in range(1, 10))


@parallel_kernel(relaxed=True)
def blend_counted(
    starts: Any,
    ids: Any,
    shape: Any,
    box: Any,
    tiles_x: int,
    lanes: int,
    limits: Any,
    background: Any,
    rgb: Any,
    transmittance: Any,
    last: Any,
) -> None:
    """Blend as `blend` does, and note where each pixel was finished; parallel over tiles, vectorised over 16 pixels.

    Args:
        starts: see `blend`, as the next six; colours may be of any sign.
        ids: [intersections] int32.
        shape: [N, 10] float64.
        box: [N, 4] int32.
        tiles_x: tiles side by side.
        lanes: how many threads share the tiles.
        limits: [3].
        background: [3].
        rgb: [H, W, 3], written.
        transmittance: [H, W], written.
        last: [H, W], written: place, counted from its tile's start, of the splat that was one too many.
    """
    height, width = transmittance.shape
    for lane in numba.prange(lanes):
        planes = np.zeros((TILE, 6 * TILE), limits.dtype)
        for x in range(TILE):
            planes[:, _X + x] = x + 0.5 - _HALF
        alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
        zero, one = alpha_min - alpha_min, alpha_min / alpha_min
        for tile in range(lane, len(starts) - 1, lanes):
            X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
            columns, low, high = min(TILE, width - X0), 0, min(TILE, height - Y0)
            planes[:, :_X] = zero
            planes[:, _LAST:] = planes.dtype.type(_NEVER)
            planes[:, :columns] = one
            planes[:, columns:TILE] = -one  # finished from the start: they are not on the picture
            for k in range(starts[tile], starts[tile + 1]):
                if (k - starts[tile]) % CHECK == CHECK - 1:
                    low, high = alive_rows(planes, low, high)
                    if low >= high:
                        break
                i = ids[k]
                c0, cx, cy, cxx, cxy, cyy, seen = tile_polynomial(shape, i, X0 + _HALF, Y0 + _HALF)
                if not seen:
                    continue
                place = planes.dtype.type(k - starts[tile])
                a, o = planes.dtype.type(cxx), planes.dtype.type(shape[i, 5])
                r, g, b = planes.dtype.type(shape[i, 6]), planes.dtype.type(shape[i, 7]), planes.dtype.type(shape[i, 8])
                for y in range(max(box[i, 2] - Y0, low), min(box[i, 3] - Y0, high)):
                    dy = y + 0.5 - _HALF
                    row0 = planes.dtype.type(c0 + dy * (cy + dy * cyy))
                    row1 = planes.dtype.type(cx + dy * cxy)
                    row = planes[y]
                    for x in range(TILE):
                        at = row[_X + x]
                        power = (a * at + row1) * at + row0
                        alpha = min(o * fast_exp(min(power, zero)), alpha_cap)
                        alpha = alpha if alpha >= alpha_min else zero
                        before = row[x]
                        after = before * (one - alpha)
                        going = after >= stop
                        weight = alpha * before if going else zero
                        row[x] = after if going else -abs(before)
                        row[_LAST + x] = row[_LAST + x] if going else min(row[_LAST + x], place)
                        row[_RED + x] += weight * r
                        row[_GREEN + x] += weight * g
                        row[_BLUE + x] += weight * b
            for y in range(min(TILE, height - Y0)):
                for x in range(columns):
                    left = abs(planes[y, x])
                    rgb[Y0 + y, X0 + x, 0] = planes[y, _RED + x] + left * background[0]
                    rgb[Y0 + y, X0 + x, 1] = planes[y, _GREEN + x] + left * background[1]
                    rgb[Y0 + y, X0 + x, 2] = planes[y, _BLUE + x] + left * background[2]
                    transmittance[Y0 + y, X0 + x] = left
                    last[Y0 + y, X0 + x] = planes[y, _LAST + x]


@parallel_kernel(relaxed=True)
def sum_back(
    starts: Any,
    ids: Any,
    slots: Any,
    shape: Any,
    box: Any,
    tiles_x: int,
    lanes: int,
    limits: Any,
    background: Any,
    error: Any,
    transmittance: Any,
    last: Any,
    removal: bool,
    records: Any,
) -> None:
    """Sum over the pixels of every splat in every tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        starts: see `blend`, as the next.
        ids: [intersections] int32.
        slots: [intersections] int32, the record of each of `ids`.
        shape: [N, 10] float64, as for `blend_counted`, as the next six.
        box: [N, 4] int32.
        tiles_x: tiles side by side.
        lanes: how many threads share the tiles; the result does not depend on it.
        limits: [3].
        background: [3].
        error: [H, W, 3], the picture less the one that is wanted.
        transmittance: [H, W], as `blend_counted` wrote it, as the next.
        last: [H, W].
        removal: which sums are wanted.
        records: [intersections, SUMS], written. If `removal`: sums of |d|², d · error, w and w², d being the change
            of the pixel if the splat were not there. Otherwise: of w · error for red, green, blue, and of w².
    """
    height, width = transmittance.shape
    for lane in numba.prange(lanes):
        planes = np.zeros((TILE, 10 * TILE), limits.dtype)
        deepest = np.zeros(TILE, limits.dtype)
        for x in range(TILE):
            planes[:, _X + x] = x + 0.5 - _HALF
        alpha_min, alpha_cap = limits[0], limits[1]
        zero, one = alpha_min - alpha_min, alpha_min / alpha_min
        for tile in range(lane, len(starts) - 1, lanes):
            X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
            columns, high = min(TILE, width - X0), min(TILE, height - Y0)
            planes[:, :TILE] = one
            planes[:, _LAST:] = zero  # pixels beyond the picture are finished before the first splat
            for y in range(high):
                row, most = planes[y], zero
                for x in range(columns):
                    row[x] = transmittance[Y0 + y, X0 + x]
                    row[_LAST + x] = last[Y0 + y, X0 + x]
                    row[_RED + x], row[_GREEN + x], row[_BLUE + x] = background[0], background[1], background[2]
                    row[_ERR_R + x] = error[Y0 + y, X0 + x, 0]
                    row[_ERR_G + x] = error[Y0 + y, X0 + x, 1]
                    row[_ERR_B + x] = error[Y0 + y, X0 + x, 2]
                    most = max(most, row[_LAST + x])
                deepest[y] = most
            for k in range(starts[tile + 1] - 1, starts[tile] - 1, -1):
                i = ids[k]
                c0, cx, cy, cxx, cxy, cyy, seen = tile_polynomial(shape, i, X0 + _HALF, Y0 + _HALF)
                place = planes.dtype.type(k - starts[tile])
                a, o = planes.dtype.type(cxx), planes.dtype.type(shape[i, 5])
                r, g, b = planes.dtype.type(shape[i, 6]), planes.dtype.type(shape[i, 7]), planes.dtype.type(shape[i, 8])
                m0, m1, m2, m3 = zero, zero, zero, zero
                for y in range(max(box[i, 2] - Y0, 0), min(box[i, 3] - Y0, high) if seen else 0):
                    if place >= deepest[y]:
                        continue
                    dy = y + 0.5 - _HALF
                    row0 = planes.dtype.type(c0 + dy * (cy + dy * cyy))
                    row1 = planes.dtype.type(cx + dy * cxy)
                    row = planes[y]
                    for x in range(TILE):
                        at = row[_X + x]
                        power = (a * at + row1) * at + row0
                        alpha = min(o * fast_exp(min(power, zero)), alpha_cap)
                        row[_ALPHA + x] = alpha if alpha >= alpha_min and place < row[_LAST + x] else zero
                    if removal:
                        for x in range(TILE):
                            alpha = row[_ALPHA + x]
                            before = row[x] / (one - alpha)
                            row[x] = before
                            dr, dg, db = row[_RED + x] - r, row[_GREEN + x] - g, row[_BLUE + x] - b
                            row[_RED + x] -= alpha * dr
                            row[_GREEN + x] -= alpha * dg
                            row[_BLUE + x] -= alpha * db
                            weight = alpha * before
                            m0 += weight * weight * (dr * dr + dg * dg + db * db)
                            m1 += weight * (dr * row[_ERR_R + x] + dg * row[_ERR_G + x] + db * row[_ERR_B + x])
                            m2 += weight
                            m3 += weight * weight
                    else:
                        for x in range(TILE):
                            alpha = row[_ALPHA + x]
                            before = row[x] / (one - alpha)
                            row[x] = before
                            weight = alpha * before
                            m0 += weight * row[_ERR_R + x]
                            m1 += weight * row[_ERR_G + x]
                            m2 += weight * row[_ERR_B + x]
                            m3 += weight * weight
                record = records[slots[k]]
                record[0], record[1], record[2], record[3] = m0, m1, m2, m3
