"""The loop over pixels, forward: tile by tile, splats front to back, a row of 16 pixels at a time.

A splat's exponent is rewritten for each tile, in float64, as one polynomial of x for each row: so float32
is enough for the pixels, however far away the centre of the splat lies. That is done for a batch
of splats at a time, because their numbers lie anywhere in memory: the processor fetches many at once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.binning import TILE
from csplat_render.jit import fast_exp2, inline, parallel_kernel

__all__ = [
    "CHECK",
    "NUMBERS",
    "ROW0",
    "ROW1",
    "THEN",
    "aligned",
    "alive_rows",
    "blend",
    "gather",
    "middles",
    "tile_polynomial",
]

#: Splats of a batch, between two looks at which rows of a tile are finished.
CHECK = 16

# Numbers of a splat in a batch: for each row of the tile the constant and the linear coefficient of
# the exponent of 2, then the quadratic one, opacity, red, green, blue, depth.
ROW0, ROW1, THEN = 0, TILE, 2 * TILE
NUMBERS = THEN + 6

_HALF = 0.5 * TILE
_LOG2E = math.log2(math.e)
_CACHE_LINE = 64  # bytes

# Where a splat has alpha >= 1/255 the gradient of its exponent is at most √(2 ln 255 / 0.3) ≈ 6 per
# pixel, and changes by at most 1/0.3 per pixel: a tile whose centre says more than this sees nothing.
_STEEPEST = 1e3
_DEEPEST = -1e4


@inline
def aligned(size: int, like: Any) -> Any:
    """Zeros that begin at a cache line, so that 16 float32 never lie in two; `like` has their dtype."""
    store = np.zeros(size + _CACHE_LINE // like.itemsize, like.dtype)
    skip = -store.ctypes.data % _CACHE_LINE // like.itemsize
    return store[skip : skip + size]


@inline
def middles() -> Any:
    """Positions of the 16 pixels of a row, or of the rows, about the middle of a tile; float64."""
    return np.arange(TILE) + (0.5 - _HALF)


@inline
def tile_polynomial(shape: Any, i: int, x: float, y: float) -> tuple[float, float, float, float, float, float, bool]:
    """Exponent of a splat around the point (x, y): c0 + cx·dx + cy·dy + cxx·dx² + cxy·dx·dy + cyy·dy².

    Returns:
        c0, cx, cy, cxx, cxy, cyy, and whether anything of the splat can be seen in the tile there.
    """
    dx, dy = x - shape[i, 0], y - shape[i, 1]
    a, b, c = shape[i, 2], shape[i, 3], shape[i, 4]
    cx, cy = -(a * dx + b * dy), -(b * dx + c * dy)
    c0 = 0.5 * (dx * cx + dy * cy)
    seen = abs(cx) + abs(cy) < _STEEPEST and c0 > _DEEPEST
    return c0, cx, cy, -0.5 * a, -b, -0.5 * c, seen


@inline
def alive_rows(T: Any, low: int, high: int) -> tuple[int, int]:
    """Narrow a range of rows to those where some pixel is not finished."""
    while low < high:
        best = T[low, 0]
        for x in range(1, TILE):
            best = max(best, T[low, x])
        if best > 0.0:
            break
        low += 1
    while low < high:
        best = T[high - 1, 0]
        for x in range(1, TILE):
            best = max(best, T[high - 1, x])
        if best > 0.0:
            break
        high -= 1
    return low, high


@inline
def gather(
    ids: Any,
    begin: int,
    end: int,
    shape: Any,
    box: Any,
    X0: int,
    Y0: int,
    low: int,
    high: int,
    ys: Any,
    batch: Any,
    rows: Any,
) -> None:
    """Write what the loop over pixels wants to know of some splats in a tile.

    Args:
        ids: see `blend`, as shape and box.
        begin: first of `ids`.
        end: last of `ids`, plus 1; at most CHECK of them.
        shape: see `blend`.
        box: see `blend`.
        X0: first column of the tile.
        Y0: first row of the tile.
        low: first of the tile's rows that is not finished.
        high: last of them, plus 1.
        ys: [TILE] float64, see `middles`.
        batch: [CHECK, NUMBERS], written.
        rows: [CHECK, 2] int64, written: first row of the tile that each splat may touch, and last plus 1.
    """
    for k in range(begin, end):
        i = ids[k]
        c0, cx, cy, cxx, cxy, cyy, seen = tile_polynomial(shape, i, X0 + _HALF, Y0 + _HALF)
        rows[k - begin, 0] = max(box[i, 2] - Y0, low) if seen else 0
        rows[k - begin, 1] = min(box[i, 3] - Y0, high) if seen else 0
        c0, cx, cy, cxx, cxy, cyy = c0 * _LOG2E, cx * _LOG2E, cy * _LOG2E, cxx * _LOG2E, cxy * _LOG2E, cyy * _LOG2E
        one = batch[k - begin]
        for y in range(len(ys)):
            one[ROW0 + y] = c0 + ys[y] * (cy + ys[y] * cyy)
            one[ROW1 + y] = cx + ys[y] * cxy
        one[THEN] = cxx
        for n in range(5):
            one[THEN + 1 + n] = shape[i, 5 + n]


@parallel_kernel(relaxed=True)
def blend(
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
    depth: Any,
    used: Any,
) -> None:
    """Blend the splats of every tile; parallel over tiles, vectorised over the 16 pixels of a row.

    Args:
        lane: which of the threads this is.
        lanes: how many share the tiles; the result does not depend on it.
        starts: [tiles + 1] int64, where the splats of each tile begin in `ids`.
        ids: [intersections] int32, splats, tile by tile, nearest first.
        shape: [N, 10] float64, see `project`.
        box: [N, 4] int32, see `project`.
        tiles_x: tiles side by side.
        limits: [3], smallest alpha, largest alpha, smallest transmittance; its dtype, float32 or
            float64, is that of the pixels.
        background: [3].
        rgb: [H, W, 3], written.
        transmittance: [H, W], written: what the background shines through with.
        depth: [H, W], written: the sum of weight · depth.
        used: [tiles] int64, written: the end of what was looked at of each tile.
    """
    height, width = transmittance.shape
    # One row of memory per row of pixels, so that the compiler sees that nothing overlaps:
    # 16 transmittances, then 16 each of red, green, blue, depth; and the positions in a row.
    planes = aligned(TILE * 6 * TILE, limits).reshape((TILE, 6 * TILE))
    ys = middles()
    for y in range(TILE):
        planes[y, 5 * TILE :] = ys
    batch, rows = np.empty((CHECK, NUMBERS), limits.dtype), np.empty((CHECK, 2), np.int64)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    for tile in range(lane, len(used), lanes):
        X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        columns, low, high = min(TILE, width - X0), 0, min(TILE, height - Y0)
        planes[:, : 5 * TILE] = zero
        planes[:, :columns] = one
        planes[:, columns:TILE] = -one  # finished from the start: they are not on the picture
        end = starts[tile + 1]
        for begin in range(starts[tile], end, CHECK):
            low, high = alive_rows(planes, low, high)
            if low >= high:
                end = begin
                break
            count = min(CHECK, end - begin)
            gather(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows)
            for j in range(count):
                first, last = rows[j, 0], rows[j, 1]
                body, row0, row1 = planes[first:last], batch[j, ROW0 + first :], batch[j, ROW1 + first :]
                a, o = batch[j, THEN], batch[j, THEN + 1]
                r, g, b, d = batch[j, THEN + 2], batch[j, THEN + 3], batch[j, THEN + 4], batch[j, THEN + 5]
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
                        row[4 * TILE + x] += weight * d
        used[tile] = end
        for y in range(min(TILE, height - Y0)):
            for x in range(columns):
                left = abs(planes[y, x])
                rgb[Y0 + y, X0 + x, 0] = planes[y, TILE + x] + left * background[0]
                rgb[Y0 + y, X0 + x, 1] = planes[y, 2 * TILE + x] + left * background[1]
                rgb[Y0 + y, X0 + x, 2] = planes[y, 3 * TILE + x] + left * background[2]
                transmittance[Y0 + y, X0 + x] = left
                depth[Y0 + y, X0 + x] = planes[y, 4 * TILE + x]
