"""The loop over pixels that takes a picture back to the colours of splats: the transpose of drawing them.

It wants the weight of each splat at each pixel alone, nothing of what lies behind: front to back, as for a picture.
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
    begin_tile,
    gather,
    middles,
    numbers_of,
    passed,
    place,
    read_planes,
)
from csplat_render.jit import parallel_kernel

#: Numbers per record.
COLOUR_SUMS = 4

_AREA = TILE * TILE

# Where the planes of a tile begin, after transmittance: the picture, the current splat's weight, positions.
_RED, _GREEN, _BLUE, _WEIGHT, _X = (_AREA * k for k in range(1, 6))
_PLANES = 6

# What a splat that finishes a pixel seems to weigh there: nothing beside the smallest weight, 4e-7, but not 0.
_TRACE = 1e-12


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
    """Take a picture back to the splats of every tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane: which of the threads this is.
        lanes: how many share the tiles; the result does not depend on it.
        starts: see `blend`.
        used: [tiles] int64, as `blend` wrote it.
        ids: see `blend`.
        slots: [intersections] int32, the record of each of `ids`.
        shape: see `blend`, as the next three; colours are not read.
        box: [N, 4] int32.
        tiles_x: tiles side by side.
        limits: [3].
        error: [H, W, 3], what is taken back.
        records: [intersections, COLOUR_SUMS], written: sums of w · error for red, green, blue, and of w²; the last is
            0 for what could as well be absent: it neither shows nor finishes a pixel.
    """
    height, width = error.shape[:2]
    planes = aligned(_PLANES * _AREA, limits)
    T, ys = planes[:_AREA].reshape((TILE, TILE)), middles()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
    batch, rows = np.empty((CHECK, NUMBERS), limits.dtype), np.empty((CHECK, 2), np.int64)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    trace = planes.dtype.type(_TRACE)
    for tile in range(lane, len(used), lanes):
        X0, Y0, columns, high = place(tile, tiles_x, width, height)
        begin_tile(T, columns, one)
        planes[_RED:_WEIGHT] = zero
        read_planes(error, X0, Y0, columns, high, planes, _RED)
        # Rows that are finished are gone through: so a sum is added up in one order, whatever lies in front.
        for begin in range(starts[tile], used[tile], CHECK):
            count = min(CHECK, used[tile] - begin)
            gather(ids, begin, begin + count, shape, box, X0, Y0, 0, high, ys, batch, rows)
            for j in range(count):
                record = records[slots[begin + j]]
                first, last = rows[j, 0], rows[j, 1]
                if first >= last:
                    record[:] = zero
                    continue
                body = planes[first * TILE :]
                row0, row1, a, o, _, _, _, _ = numbers_of(batch, j, first)
                for y in range(last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        _, alpha = alpha_at(row[_X + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                        before = row[x]
                        going, weight, row[x] = passed(before, alpha, stop, zero, one)
                        row[_WEIGHT + x] = weight if going else max(before, zero) * trace
                m0, m1, m2, m3 = zero, zero, zero, zero
                for e in range((last - first) * TILE):
                    weight = body[_WEIGHT + e]
                    m0 += weight * body[_RED + e]
                    m1 += weight * body[_GREEN + e]
                    m2 += weight * body[_BLUE + e]
                    m3 += weight * weight
                record[0], record[1], record[2], record[3] = m0, m1, m2, m3
        for k in range(used[tile], starts[tile + 1]):
            records[slots[k]] = zero
