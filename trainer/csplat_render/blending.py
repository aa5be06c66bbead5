"""Blending of the splats of each tile, front to back, 16 pixels of a row at a time; and its gradient.

Forward, at a pixel, with exponent E = −½ dᵀ Σ⁻¹ d and transmittance T = 1 before the first splat:

    alpha = min(opacity · exp(E), ALPHA_CAP), and 0 below ALPHA_MIN
    w = T · alpha
    colour += w · c
    T ← T · (1 − alpha)

In each tile, E is rewritten in float64 as a polynomial of x for each row of pixels, so float32 suffices for the pixels
however far away the centre of the splat is. This is done for a batch of splats at a time, so that the processor fetches
their scattered data in parallel.

Backward, the splats are blended once more, front to back. With L the loss and g the gradients of a pixel, the pixel
keeps `behind`, the contribution of all farther splats to g_colour·colour + g_alpha·alpha + g_depth·depth:

    own = w · (g_colour·c + g_alpha + g_depth z)
    behind ← behind − own
    slope = ∂L/∂E = own − behind · alpha / (1 − alpha), and 0 if alpha is capped

Each pair of splat and tile has its own record of gradients, so threads share no memory. The slow twin is
`reference_rasteriser`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.binning import TILE
from csplat_render.kernels import ParallelKernel, device_function, fast_exp2, inlined, parallel_kernel

#: Number of splats per batch; between batches, finished rows of the tile are skipped.
BATCH = 16

# Columns of a batch: the constant and the linear coefficient of the exponent of 2 for each row of the tile, then the
# quadratic coefficient, opacity, red, green, blue, depth.
ROW0, ROW1, TAIL = 0, TILE, 2 * TILE
BATCH_COLUMNS = TAIL + 6

HALF_TILE = 0.5 * TILE  # pixels

_LOG2E = math.log2(math.e)
_CACHE_LINE = 64  # bytes

# Where alpha >= 1/255, the gradient of the exponent is at most √(2 ln 255 / 0.3) ≈ 6 per pixel; it changes by at most
# 1 / 0.3 per pixel. Beyond these bounds at the centre of a tile, the splat is invisible in the tile.
_MAX_SLOPE = 1e3
_MIN_EXPONENT = -1e4


@device_function
def aligned_zeros(size: int, like: Any) -> Any:
    """Return zeros of the dtype of `like`, aligned to a cache line so that no row of 16 float32 crosses one."""
    store = np.zeros(size + _CACHE_LINE // like.itemsize, like.dtype)
    skip = -store.ctypes.data % _CACHE_LINE // like.itemsize
    return store[skip : skip + size]


@device_function
def pixel_centres() -> Any:
    """Return the positions of 16 pixel centres relative to the centre of a tile, float64."""
    ys = np.empty(TILE, np.float64)
    for y in range(TILE):
        ys[y] = y + (0.5 - HALF_TILE)
    return ys


@device_function
def tile_extent(tile: int, tiles_x: int, width: int, height: int) -> tuple[int, int, int, int]:
    """Return the first column and row of a tile, and the number of its columns and rows on the image."""
    X0, Y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
    return X0, Y0, min(TILE, width - X0), min(TILE, height - Y0)


@device_function
def begin_tile(T: Any, columns: int, one: Any) -> None:
    """Initialise transmittances; pixels outside the image are finished from the start.

    Args:
        T: [TILE, TILE or more], transmittances, written; negative for finished pixels.
        columns: number of columns on the image.
        one: 1, in the dtype of the pixels.
    """
    for y in range(TILE):
        for x in range(TILE):
            T[y, x] = one if x < columns else -one


@device_function
def load_state(state: Any, X0: int, Y0: int, columns: int, high: int, planes: Any) -> None:
    """Load the pixels of a tile as blended by an earlier slice of nearer splats.

    Args:
        state: [H, W, 5]: transmittance, negative for finished pixels, red, green, blue, and the fifth plane.
        X0, Y0: first column and row of the tile.
        columns, high: number of columns and rows on the image.
        planes: [TILE, 5 * TILE or more], written for pixels on the image.
    """
    for y in range(high):
        for x in range(columns):
            for k in range(5):
                planes[y, k * TILE + x] = state[Y0 + y, X0 + x, k]


@device_function
def store_state(state: Any, X0: int, Y0: int, columns: int, high: int, planes: Any) -> None:
    """Store the pixels of a tile for a later slice: the inverse of `load_state`."""
    for y in range(high):
        for x in range(columns):
            for k in range(5):
                state[Y0 + y, X0 + x, k] = planes[y, k * TILE + x]


@device_function
def read_planes(image: Any, X0: int, Y0: int, columns: int, high: int, planes: Any, at: int) -> None:
    """Copy a tile of an image [H, W, 3] into three consecutive planes of 16 × 16, starting at `at`."""
    for y in range(high):
        row = planes[at + y * TILE :]
        for x in range(columns):
            row[x] = image[Y0 + y, X0 + x, 0]
            row[TILE * TILE + x] = image[Y0 + y, X0 + x, 1]
            row[2 * TILE * TILE + x] = image[Y0 + y, X0 + x, 2]


@device_function
def tile_polynomial(shape: Any, i: int, x: float, y: float) -> tuple[float, float, float, float, float, float, bool]:
    """Expand the exponent of a splat around (x, y): E = c0 + cx·dx + cy·dy + cxx·dx² + cxy·dx·dy + cyy·dy².

    Returns:
        c0, cx, cy, cxx, cxy, cyy; and True if the splat may be visible in the tile around this point.
    """
    dx, dy = x - shape[i, 0], y - shape[i, 1]
    a, b, c = shape[i, 2], shape[i, 3], shape[i, 4]
    cx, cy = -(a * dx + b * dy), -(b * dx + c * dy)
    c0 = 0.5 * (dx * cx + dy * cy)
    seen = abs(cx) + abs(cy) < _MAX_SLOPE and c0 > _MIN_EXPONENT
    return c0, cx, cy, -0.5 * a, -b, -0.5 * c, seen


@device_function
def unfinished_rows(T: Any, low: int, high: int) -> tuple[int, int]:
    """Shrink a range of rows at both ends until its first and last row have an unfinished pixel."""
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


@device_function
def gather_batch(
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
    """Compute the coefficients of a batch of splats in a tile.

    In row y, the exponent of 2 is quadratic in x: E · log2(e) = (cxx x + cx + cxy y) x + c0 + (cy + cyy y) y.

    Args:
        ids, shape, box: as in `blend`.
        begin, end: range of `ids`, at most BATCH.
        X0, Y0: first column and row of the tile.
        low, high: range of the tile's rows that are not finished.
        ys: [TILE] float64, see `pixel_centres`.
        batch: [BATCH, BATCH_COLUMNS], written.
        rows: [BATCH, 2] int64, written: range of the tile's rows that each splat may touch.
    """
    for k in range(begin, end):
        i = ids[k]
        c0, cx, cy, cxx, cxy, cyy, seen = tile_polynomial(shape, i, X0 + HALF_TILE, Y0 + HALF_TILE)
        rows[k - begin, 0] = max(box[i, 2] - Y0, low) if seen else 0
        rows[k - begin, 1] = min(box[i, 3] - Y0, high) if seen else 0
        c0, cx, cy, cxx, cxy, cyy = c0 * _LOG2E, cx * _LOG2E, cy * _LOG2E, cxx * _LOG2E, cxy * _LOG2E, cyy * _LOG2E
        splat = batch[k - begin]
        for y in range(len(ys)):
            splat[ROW0 + y] = c0 + ys[y] * (cy + ys[y] * cyy)
            splat[ROW1 + y] = cx + ys[y] * cxy
        splat[TAIL] = cxx
        for n in range(5):
            splat[TAIL + 1 + n] = shape[i, 5 + n]


@device_function
def narrow_rows(count: int, batch: Any, rows: Any) -> None:
    """Narrow the rows that each splat may touch, because the box of a slanted splat is too large.

    A row is dropped if the maximum of the exponent of 2 within it, at x = −c1 / 2a clamped to the tile, is too small.

    Args:
        count: number of splats in the batch.
        batch: [BATCH, BATCH_COLUMNS], see `gather_batch`; the last column is the exponent of 2 below which the splat is
            not drawn.
        rows: [BATCH, 2] int64, modified.
    """
    edge = np.float32(HALF_TILE - 0.5)
    for j in range(count):
        splat = batch[j]
        a, least = splat[TAIL], splat[TAIL + 5]
        middle = np.float32(-0.5) / a
        first, end = np.int32(TILE), np.int32(0)
        for y in range(TILE):
            x = min(max(splat[ROW1 + y] * middle, -edge), edge)
            peak = (a * x + splat[ROW1 + y]) * x + splat[ROW0 + y]
            faint = peak < least  # False for NaN, the peak of an infinitely long splat
            first = min(first, np.int32(TILE) if faint else np.int32(y))
            end = max(end, np.int32(0) if faint else np.int32(y + 1))
        rows[j, 0] = max(rows[j, 0], first)
        rows[j, 1] = min(rows[j, 1], end)


@inlined
def batch_entry(batch: Any, j: int, first: int) -> tuple[Any, ...]:
    """Return a splat's entries of a batch: constant and linear coefficients from row `first` on, then the scalars."""
    splat = batch[j]
    row0, row1 = splat[ROW0 + first :], splat[ROW1 + first :]
    return row0, row1, splat[TAIL], splat[TAIL + 1], splat[TAIL + 2], splat[TAIL + 3], splat[TAIL + 4], splat[TAIL + 5]


@inlined
def alpha_at(x: Any, c0: Any, c1: Any, a: Any, o: Any, alpha_min: Any, alpha_cap: Any, zero: Any) -> tuple[Any, Any]:
    """Return alpha of a splat at a pixel, o · 2**((a x + c1) x + c0), without and with thresholds.

    Args:
        x: position in the row.
        c0, c1, a: constant, linear and quadratic coefficient of the exponent of 2 in this row.
        o: opacity.
        alpha_min: smaller values become 0.
        alpha_cap: larger values become this.
        zero: 0, in the dtype of the pixels.
    """
    full = o * fast_exp2(min((a * x + c1) * x + c0, zero))
    alpha = min(full, alpha_cap)
    return full, alpha if alpha >= alpha_min else zero


@inlined
def transmit(before: Any, alpha: Any, stop: Any, zero: Any, one: Any) -> tuple[Any, Any, Any]:
    """Return True if a splat does not finish a pixel; its weight in the pixel; and the new transmittance.

    A pixel whose transmittance would fall below `stop` is finished: its transmittance stays, with a negative sign.
    """
    after = before * (one - alpha)
    going = after >= stop
    return going, alpha * before if going else zero, after if going else -abs(before)


def _make_blend(counted: bool) -> ParallelKernel[...]:
    """Return the kernel `blend`, or if `counted`, `blend_counted`, which stores each pixel's last splat, not depth.

    `counted` is a constant of the compiled kernel, so neither variant tests it.
    """

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
        fifth: Any,
        used: Any,
        state: Any,
    ) -> None:
        """Blend the splats of every tile; parallel over tiles, vectorised over the 16 pixels of a row.

        Args:
            lane, lanes: see `parallel_kernel`; the result does not depend on the number of lanes.
            starts: [tiles + 1] int64, start of each tile's splats in `ids`.
            ids: [intersections] int32, splats, tile by tile, nearest first.
            shape: [N, 10] float64, see `project`; if `counted`, with the last column of `ProjectedView.shape`.
            box: [N, 4] int32, see `project`.
            tiles_x: number of tiles per row.
            limits: [3], minimum alpha, maximum alpha, minimum transmittance; float32 or float64, the dtype of pixels.
            background: [3].
            rgb: [H, W, 3], written.
            transmittance: [H, W], written: weight of the background.
            fifth: [H, W], written: the sum of weight · depth; if `counted`, the position, relative to its tile's start,
                of the last splat that covers the pixel's row before the pixel is finished, −1 if there is none.
            used: [tiles] int64, written: end of the blended splats of each tile.
            state: [H, W, 5], modified: the pixels after an earlier slice, see `load_state`; empty: there are no slices.
        """
        height, width = transmittance.shape
        # One row of memory per row of pixels, so that the compiler knows that they do not overlap: 16 transmittances,
        # then 16 values each of red, green, blue and the fifth plane, and the positions in a row.
        planes = aligned_zeros(TILE * 6 * TILE, limits).reshape((TILE, 6 * TILE))
        ys = pixel_centres()
        for y in range(TILE):
            for x in range(TILE):
                planes[y, 5 * TILE + x] = ys[x]
        batch, rows = np.empty((BATCH, BATCH_COLUMNS), limits.dtype), np.empty((BATCH, 2), np.int64)
        alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
        zero, one = alpha_min - alpha_min, alpha_min / alpha_min  # in the dtype of the pixels
        nothing = -one if counted else zero
        for tile in range(lane, len(used), lanes):
            X0, Y0, columns, on_render = tile_extent(tile, tiles_x, width, height)
            low, high = 0, on_render
            begin_tile(planes, columns, one)
            planes[:, TILE : 4 * TILE] = zero
            planes[:, 4 * TILE : 5 * TILE] = nothing
            if len(state):
                load_state(state, X0, Y0, columns, on_render, planes)
            end = starts[tile + 1]
            for begin in range(starts[tile], end, BATCH):
                low, high = unfinished_rows(planes, low, high)
                if low >= high:
                    end = begin
                    break
                count = min(BATCH, end - begin)
                gather_batch(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows)
                if counted:
                    narrow_rows(count, batch, rows)
                for j in range(count):
                    first = rows[j, 0]
                    body = planes[first : rows[j, 1]]
                    row0, row1, a, o, r, g, b, d = batch_entry(batch, j, first)
                    if counted:
                        d = planes.dtype.type(begin + j - starts[tile])
                    for y in range(len(body)):
                        row, c0, c1 = body[y], row0[y], row1[y]
                        for x in range(TILE):
                            _, alpha = alpha_at(row[5 * TILE + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                            going, weight, row[x] = transmit(row[x], alpha, stop, zero, one)
                            row[TILE + x] += weight * r
                            row[2 * TILE + x] += weight * g
                            row[3 * TILE + x] += weight * b
                            if counted:
                                row[4 * TILE + x] = d if going else row[4 * TILE + x]
                            else:
                                row[4 * TILE + x] += weight * d
            used[tile] = end
            if len(state):
                store_state(state, X0, Y0, columns, on_render, planes)
            for y in range(on_render):
                for x in range(columns):
                    remaining = abs(planes[y, x])  # negative for finished pixels
                    rgb[Y0 + y, X0 + x, 0] = planes[y, TILE + x] + remaining * background[0]
                    rgb[Y0 + y, X0 + x, 1] = planes[y, 2 * TILE + x] + remaining * background[1]
                    rgb[Y0 + y, X0 + x, 2] = planes[y, 3 * TILE + x] + remaining * background[2]
                    transmittance[Y0 + y, X0 + x] = remaining
                    fifth[Y0 + y, X0 + x] = planes[y, 4 * TILE + x]

    return blend


#: Blend an image and its depth.
blend = _make_blend(counted=False)

#: Blend an image, and store the position of each pixel's last splat.
blend_counted = _make_blend(counted=True)


#: Numbers per record: moments of slope about the centre of the tile (1, x, y, xx, xy, yy), and gradients with respect
#: to red, green, blue and depth.
RECORD = 10

_AREA = TILE * TILE

# Offsets of the planes of a tile: after transmittance, `behind`, the gradients, slope and weight of the current splat,
# and positions relative to the centre of the tile.
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
    """Compute one record of gradients per splat and tile; parallel over tiles, vectorised over the pixels of a row.

    Args:
        lane, lanes, starts, ids, shape, box, tiles_x, limits: as in `blend`.
        used, rgb, transmittance, depth: results of `blend`.
        slots: [intersections] int32, the record of each entry of `ids`.
        grad_rgb: [H, W, 3], gradient of the loss with respect to rgb.
        grad_alpha: [H, W], gradient with respect to alpha = 1 − transmittance.
        grad_depth: [H, W], gradient with respect to depth.
        records: [intersections, RECORD], written.
    """
    height, width = transmittance.shape
    # Planes of 16 × 16 one after the other in one array, so that the compiler knows which parts overlap.
    planes = aligned_zeros(_PLANES * _AREA, limits)
    T = planes[:_AREA].reshape((TILE, TILE))
    ys = pixel_centres()
    for e in range(_AREA):
        planes[_X + e] = ys[e % TILE]
        planes[_Y + e] = ys[e // TILE]
    batch, rows = np.empty((BATCH, BATCH_COLUMNS), limits.dtype), np.empty((BATCH, 2), np.int64)
    alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
    zero, one = alpha_min - alpha_min, alpha_min / alpha_min
    for tile in range(lane, len(used), lanes):
        X0, Y0, columns, high = tile_extent(tile, tiles_x, width, height)
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
        for begin in range(starts[tile], used[tile], BATCH):
            low, high = unfinished_rows(T, low, high)
            count = min(BATCH, used[tile] - begin)
            gather_batch(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows)
            for j in range(count):
                record = records[slots[begin + j]]
                first, last = rows[j, 0], rows[j, 1]
                if first >= last:
                    record[:] = zero
                    continue
                body = planes[first * TILE :]
                row0, row1, a, o, r, g, b, d = batch_entry(batch, j, first)
                for y in range(last - first):
                    row, c0, c1 = body[y * TILE :], row0[y], row1[y]
                    for x in range(TILE):
                        full, alpha = alpha_at(row[_X + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                        going, weight, row[x] = transmit(row[x], alpha, stop, zero, one)
                        colour = row[_RED + x] * r + row[_GREEN + x] * g + row[_BLUE + x] * b
                        own = weight * (colour + row[_ALPHA + x] + row[_DEPTH + x] * d)
                        behind = row[_BEHIND + x] - own
                        row[_BEHIND + x] = behind
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
