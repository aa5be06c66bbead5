"""The loops over pixels for what the removal of each splat would change.

At a pixel a splat of alpha a with transmittance T in front of it has the weight w = T·a. Let C be its colour and B the
colour that is seen where it ends, background included, not multiplied with any transmittance. Without the splat the
pixel changes by d = w·(B − C): nothing else in the sum changes but the light that reaches what lies behind. So after
an ordinary picture, in which each pixel notes how far it got, the splats of a tile are gone through once more, back to
front: B follows from B ← B + a·(C − B), T from T ← T / (1 − a). Nothing is subtracted from a finished sum: what lies
deep behind is as exact as what lies in front.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from csplat_render.binning import TILE
from csplat_render.blending_steps import (
    CHECK,
    NUMBERS,
    aligned,
    alpha_at,
    gather,
    middles,
    narrow_rows,
    numbers_of,
    place,
    read_planes,
)
from csplat_render.jit import parallel_kernel

#: Numbers per record.
SUMS = 4

_AREA = TILE * TILE

# Where the planes of a tile begin, after transmittance: three colours of what lies behind, how far each pixel got,
# three differences from the picture that is wanted, what the current splat adds to two sums, its weight, positions.
_RED, _GREEN, _BLUE, _LAST, _ERR_R, _ERR_G, _ERR_B, _CHANGE, _PRODUCT, _WEIGHT, _X = (_AREA * k for k in range(1, 12))
_PLANES = 12


@parallel_kernel(relaxed=True)
def sum_removal(
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
    error: Any,
    transmittance: Any,
    last: Any,
    records: Any,
) -> None:
    """Sum over the pixels of every splat in every tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane: which of the threads this is.
        lanes: how many share the tiles; the result does not depend on it.
        starts: see `blend`, as the next.
        ids: [intersections] int32.
        slots: [intersections] int32, the record of each of `ids`.
        shape: [N, 10] float64, as for `blend_counted`, as the next four.
        box: [N, 4] int32.
        tiles_x: tiles side by side.
        limits: [3].
        background: [3].
        error: [H, W, 3], the picture less the one that is wanted; [0, 0, 3] where it is the one.
        transmittance: [H, W], as `blend_counted` wrote it, as the next.
        last: [H, W].
        records: [intersections, SUMS], written: sums of |d|², d · error, w and w², d being the change of the pixel if
            the splat were not there.
    """
    height, width = transmittance.shape
    # Planes of 16 × 16, one after the other, in one array: so the compiler sees what overlaps.
    planes, deepest = aligned(_PLANES * _AREA, limits), np.zeros(TILE, np.int64)
    ys = middles()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
    batch, rows = np.empty((CHECK, NUMBERS), limits.dtype), np.empty((CHECK, 2), np.int64)
    alpha_min, alpha_cap = limits[0], limits[1]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    is_wrong = error.shape[0] > 0
    for tile in range(lane, len(starts) - 1, lanes):
        X0, Y0, columns, high = place(tile, tiles_x, width, height)
        planes[:_LAST] = zero
        planes[_LAST:_ERR_R] = -one  # pixels beyond the picture got nowhere
        planes[_ERR_R:_X] = zero
        if is_wrong:
            read_planes(error, X0, Y0, columns, high, planes, _ERR_R)
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
            begin = max(start, end - CHECK)
            gather(ids, begin, end, shape, box, X0, Y0, 0, high, ys, batch, rows)
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
                row0, row1, a, o, r, g, b, _ = numbers_of(batch, j, first)
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
                        if is_wrong:
                            row[_PRODUCT + x] = weight * (
                                dr * row[_ERR_R + x] + dg * row[_ERR_G + x] + db * row[_ERR_B + x]
                            )
                m0, m1, m2, m3 = zero, zero, zero, zero
                for e in range((after_last - first) * TILE):
                    weight = body[_WEIGHT + e]
                    m0 += body[_CHANGE + e]
                    if is_wrong:
                        m1 += body[_PRODUCT + e]
                    m2 += weight
                    m3 += weight * weight
                record[0], record[1], record[2], record[3] = m0, m1, m2, m3
            end = begin
