"""Steps of all loops over the pixels of a tile: a batch of its splats, alpha at a pixel, and the order of pixels.

A splat's exponent is rewritten for each tile, in float64, as one polynomial of x for each row: so float32
is enough for the pixels, however far away the centre of the splat lies. That is done for a batch
of splats at a time, because their numbers lie anywhere in memory: the processor fetches many at once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.binning import TILE
from csplat_render.jit import fast_exp2, inline, spliced

#: Splats of a batch, between two looks at which rows of a tile are finished.
CHECK = 16

# Numbers of a splat in a batch: for each row of the tile the constant and the linear coefficient of
# the exponent of 2, then the quadratic one, opacity, red, green, blue, depth.
ROW0, ROW1, THEN = 0, TILE, 2 * TILE
NUMBERS = THEN + 6

#: From the corner of a tile to its middle.
HALF = 0.5 * TILE

_LOG2E = math.log2(math.e)
_CACHE_LINE = 64  # bytes

# If a splat has alpha >= 1/255, the gradient of its exponent is at most √(2 ln 255 / 0.3) ≈ 6 per
# pixel, and changes by at most 1/0.3 per pixel: a tile whose centre has more than this shows nothing.
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
    ys = np.empty(TILE, np.float64)
    for y in range(TILE):
        ys[y] = y + (0.5 - HALF)
    return ys


@inline
def place(tile: int, tiles_x: int, width: int, height: int) -> tuple[int, int, int, int]:
    """First column and row of a tile, and how many of either lie on the picture."""
    X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
    return X0, Y0, min(TILE, width - X0), min(TILE, height - Y0)


@inline
def begin_tile(T: Any, columns: int, one: Any) -> None:
    """Let all light through; columns that are not on the picture are finished from the start.

    Args:
        T: [TILE, TILE or more], transmittances, written; a pixel that is finished has a negative one.
        columns: number of columns on the image.
        one: 1, of the dtype of the pixels.
    """
    for y in range(TILE):
        for x in range(TILE):
            T[y, x] = one if x < columns else -one


@inline
def go_on(state: Any, X0: int, Y0: int, columns: int, high: int, planes: Any) -> None:
    """Begin a tile where nearer splats left it.

    Args:
        state: [H, W, 5]: transmittance, negative if a pixel is finished, red, green, blue, and the fifth plane.
        X0, Y0: first column and row of the tile.
        columns, high: number of columns and rows on the image.
        planes: [TILE, 5 * TILE or more], written on the picture.
    """
    for y in range(high):
        for x in range(columns):
            for k in range(5):
                planes[y, k * TILE + x] = state[Y0 + y, X0 + x, k]


@inline
def leave(state: Any, X0: int, Y0: int, columns: int, high: int, planes: Any) -> None:
    """Keep a tile for farther splats: the opposite of `go_on`."""
    for y in range(high):
        for x in range(columns):
            for k in range(5):
                state[Y0 + y, X0 + x, k] = planes[y, k * TILE + x]


@inline
def read_planes(picture: Any, X0: int, Y0: int, columns: int, high: int, planes: Any, at: int) -> None:
    """Copy a tile of a picture, [H, W, 3], into three planes of 16 × 16 that lie one after the other from `at` on."""
    for y in range(high):
        row = planes[at + y * TILE :]
        for x in range(columns):
            row[x] = picture[Y0 + y, X0 + x, 0]
            row[TILE * TILE + x] = picture[Y0 + y, X0 + x, 1]
            row[2 * TILE * TILE + x] = picture[Y0 + y, X0 + x, 2]


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
    """Narrow a range of rows to the rows in which some pixel is not finished."""
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
    """Write the numbers of some splats in a tile that the loop over pixels needs.

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
        c0, cx, cy, cxx, cxy, cyy, seen = tile_polynomial(shape, i, X0 + HALF, Y0 + HALF)
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


@inline
def narrow_rows(count: int, batch: Any, rows: Any) -> None:
    """Narrow the rows of a tile that each splat may touch: its box is generous, at a slant above all.

    Args:
        count: splats of the batch.
        batch: [CHECK, NUMBERS], see `gather`; in place of a depth the exponent of 2 below which nothing is drawn.
        rows: [CHECK, 2] int64, changed.
    """
    edge = np.float32(HALF - 0.5)
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


@spliced
def numbers_of(batch: Any, j: int, first: int) -> tuple[Any, ...]:
    """Return a splat's numbers in a batch: both coefficients by row, from row `first` on; the others as in `gather`."""
    splat = batch[j]
    row0, row1 = splat[ROW0 + first :], splat[ROW1 + first :]
    return row0, row1, splat[THEN], splat[THEN + 1], splat[THEN + 2], splat[THEN + 3], splat[THEN + 4], splat[THEN + 5]


@spliced
def alpha_at(x: Any, c0: Any, c1: Any, a: Any, o: Any, alpha_min: Any, alpha_cap: Any, zero: Any) -> tuple[Any, Any]:
    """Alpha of a splat at a pixel, without cap and floor, and with both.

    Args:
        x: position in the row.
        c0: constant coefficient of the exponent of 2 in this row.
        c1: linear coefficient.
        a: quadratic coefficient.
        o: opacity.
        alpha_min: smaller values become 0.
        alpha_cap: larger values become this.
        zero: 0, of the dtype of the pixels.
    """
    full = o * fast_exp2(min((a * x + c1) * x + c0, zero))
    alpha = min(full, alpha_cap)
    return full, alpha if alpha >= alpha_min else zero


@spliced
def passed(before: Any, alpha: Any, stop: Any, zero: Any, one: Any) -> tuple[Any, Any, Any]:
    """Go on behind a splat: whether the pixel does, the splat's share of it, and what is to be kept as transmittance.

    A pixel whose transmittance would fall below `stop` is finished: it keeps what it had, negative from then on.
    """
    after = before * (one - alpha)
    going = after >= stop
    return going, alpha * before if going else zero, after if going else -abs(before)
