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
from csplat_render.blending import CHECK, NUMBERS, ROW0, ROW1, THEN, aligned, alive_rows, gather, middles
from csplat_render.jit import fast_exp2, inline, parallel_kernel

__all__ = ["SUMS", "blend_counted", "sum_removal"]

#: Numbers per record.
SUMS = 4

_AREA = TILE * TILE

# Where the planes of a tile begin, after transmittance: three colours of what lies behind, how far each pixel got,
# three differences from the picture that is wanted, what the current splat adds to two sums, its weight, positions.
_RED, _GREEN, _BLUE, _LAST, _ERR_R, _ERR_G, _ERR_B, _CHANGE, _PRODUCT, _WEIGHT, _X = (_AREA * k for k in range(1, 12))
_PLANES = 12

_HALF = 0.5 * TILE


@inline
def narrow_rows(count: int, batch: Any, rows: Any) -> None:
    """Narrow the rows of a tile that each splat may touch: its box is generous, at a slant above all.

    Args:
        count: splats of the batch.
        batch: [CHECK, NUMBERS], see `gather`; in place of a depth the exponent of 2 below which nothing is drawn.
        rows: [CHECK, 2] int64, changed.
    """
    edge = np.float32(_HALF - 0.5)
    for j in range(count):
        one = batch[j]
        a, least = one[THEN], one[THEN + 5]
        middle = np.float32(-0.5) / a
        first, end = np.int32(TILE), np.int32(0)
        for y in range(TILE):
            at = min(max(one[ROW1 + y] * middle, -edge), edge)
            peak = (a * at + one[ROW1 + y]) * at + one[ROW0 + y]
            faint = peak < least  # NaN, of a splat without end, is not
            first = min(first, np.int32(TILE) if faint else np.int32(y))
            end = max(end, np.int32(0) if faint else np.int32(y + 1))
        rows[j, 0] = max(rows[j, 0], first)
        rows[j, 1] = min(rows[j, 1], end)


@parallel_kernel(relaxed=True)
def blend_counted(
    lane: int,
    lanes: int,
    starts: Any,
    ids: Any,
    shape: Any,
    box: Any,
    tiles_x: int,
    limits: Any,
    background: Any,
    rgb: Any,
    transmittance: Any,
    last: Any,
) -> None:
    """Blend as `blend` does, and note how far each pixel got; parallel over tiles, vectorised over 16 pixels.

    Args:
        lane: which of the threads this is.
        lanes: how many share the tiles; the result does not depend on it.
        starts: see `blend`, as the next seven.
        ids: [intersections] int32.
        shape: [N, 10] float64, but see `narrow_rows`.
        box: [N, 4] int32.
        tiles_x: tiles side by side.
        limits: [3].
        background: [3].
        rgb: [H, W, 3], written.
        transmittance: [H, W], written.
        last: [H, W], written: place, counted from its tile's start, of the last splat of those whose rows the pixel
            lies in that came before it was finished; −1 if there is none.
    """
    height, width = transmittance.shape
    # Rows of memory as in `blend`: transmittances, red, green, blue, places, positions.
    planes = aligned(TILE * 6 * TILE, limits).reshape((TILE, 6 * TILE))
    ys = middles()
    for y in range(TILE):
        planes[y, 5 * TILE :] = ys
    batch, rows = np.empty((CHECK, NUMBERS), limits.dtype), np.empty((CHECK, 2), np.int64)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    for tile in range(lane, len(starts) - 1, lanes):
        X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        columns, low, high = min(TILE, width - X0), 0, min(TILE, height - Y0)
        planes[:, : 4 * TILE] = zero
        planes[:, 4 * TILE : 5 * TILE] = -one
        planes[:, :columns] = one
        planes[:, columns:TILE] = -one  # finished from the start: they are not on the picture
        end = starts[tile + 1]
        for begin in range(starts[tile], end, CHECK):
            low, high = alive_rows(planes, low, high)
            if low >= high:
                break
            count = min(CHECK, end - begin)
            gather(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows)
            narrow_rows(count, batch, rows)
            for j in range(count):
                first, after_last = rows[j, 0], rows[j, 1]
                body, row0, row1 = planes[first:after_last], batch[j, ROW0 + first :], batch[j, ROW1 + first :]
                a, o = batch[j, THEN], batch[j, THEN + 1]
                r, g, b = batch[j, THEN + 2], batch[j, THEN + 3], batch[j, THEN + 4]
                place = planes.dtype.type(begin + j - starts[tile])
                for y in range(len(body)):
                    row, c0, c1 = body[y], row0[y], row1[y]
                    for x in range(TILE):
                        at = row[5 * TILE + x]
                        power = (a * at + c1) * at + c0
                        alpha = min(o * fast_exp2(min(power, zero)), alpha_cap)
                        alpha = alpha if alpha >= alpha_min else zero
                        before = row[x]
                        after = before * (one - alpha)
                        going = after >= stop
                        weight = alpha * before if going else zero
                        row[x] = after if going else -abs(before)  # finished: negative from here on
                        row[TILE + x] += weight * r
                        row[2 * TILE + x] += weight * g
                        row[3 * TILE + x] += weight * b
                        row[4 * TILE + x] = place if going else row[4 * TILE + x]
        for y in range(min(TILE, height - Y0)):
            for x in range(columns):
                left = abs(planes[y, x])
                rgb[Y0 + y, X0 + x, 0] = planes[y, TILE + x] + left * background[0]
                rgb[Y0 + y, X0 + x, 1] = planes[y, 2 * TILE + x] + left * background[1]
                rgb[Y0 + y, X0 + x, 2] = planes[y, 3 * TILE + x] + left * background[2]
                transmittance[Y0 + y, X0 + x] = left
                last[Y0 + y, X0 + x] = planes[y, 4 * TILE + x]


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
        shape: [N, 10] float64, as for `blend_counted`, as the next six.
        box: [N, 4] int32.
        tiles_x: tiles side by side.
        limits: [3].
        background: [3].
        error: [H, W, 3], the picture less the one that is wanted.
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
    for tile in range(lane, len(starts) - 1, lanes):
        X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        columns, high = min(TILE, width - X0), min(TILE, height - Y0)
        planes[:_LAST] = zero
        planes[_LAST:_ERR_R] = -one  # pixels beyond the picture got nowhere
        planes[_ERR_R:_X] = zero
        start, end = starts[tile], starts[tile]
        for y in range(high):
            row = planes[y * TILE :]
            deepest[y] = -1
            for x in range(columns):
                row[x] = transmittance[Y0 + y, X0 + x]
                row[_LAST + x] = last[Y0 + y, X0 + x]
                row[_RED + x], row[_GREEN + x], row[_BLUE + x] = background[0], background[1], background[2]
                row[_ERR_R + x] = error[Y0 + y, X0 + x, 0]
                row[_ERR_G + x] = error[Y0 + y, X0 + x, 1]
                row[_ERR_B + x] = error[Y0 + y, X0 + x, 2]
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
                body, row0, row1 = planes[first * TILE :], batch[j, ROW0 + first :], batch[j, ROW1 + first :]
                a, o = batch[j, THEN], batch[j, THEN + 1]
                r, g, b = batch[j, THEN + 2], batch[j, THEN + 3], batch[j, THEN + 4]
                place = planes.dtype.type(k)
                for y in range(after_last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        at = row[_X + x]
                        power = (a * at + c1) * at + c0
                        alpha = min(o * fast_exp2(min(power, zero)), alpha_cap)
                        alpha = alpha if alpha >= alpha_min else zero
                        alpha = alpha if place <= row[_LAST + x] else zero
                        before = row[x] / (one - alpha)
                        row[x] = before
                        weight = alpha * before
                        dr, dg, db = row[_RED + x] - r, row[_GREEN + x] - g, row[_BLUE + x] - b
                        row[_RED + x] -= alpha * dr
                        row[_GREEN + x] -= alpha * dg
                        row[_BLUE + x] -= alpha * db
                        row[_WEIGHT + x] = weight
                        row[_CHANGE + x] = weight * weight * (dr * dr + dg * dg + db * db)
                        row[_PRODUCT + x] = weight * (
                            dr * row[_ERR_R + x] + dg * row[_ERR_G + x] + db * row[_ERR_B + x]
                        )
                m0, m1, m2, m3 = zero, zero, zero, zero
                for e in range((after_last - first) * TILE):
                    weight = body[_WEIGHT + e]
                    m0 += body[_CHANGE + e]
                    m1 += body[_PRODUCT + e]
                    m2 += weight
                    m3 += weight * weight
                record[0], record[1], record[2], record[3] = m0, m1, m2, m3
            end = begin
