"""Binning: a radix sort of all visible splats by depth, then a stable counting sort into tiles, the order of blending.

No result depends on the number of threads: chunks of the depth order are fixed, and each writes to a range that a
prefix sum over all chunks has reserved.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.kernels import device_function, kernel, lane_range, parallel_kernel

#: Width and height of a tile in pixels.
TILE = 16

#: Bits of a pixel position within a tile.
TILE_BITS = 4

#: Number of runs of the depth order that are sorted into tiles independently.
CHUNKS = 8

_SMALL_BOX = 6  # tiles; in boxes up to this size all tiles are used, without intersecting the ellipse
_DIGIT = 11  # bits per pass of the radix sort; three passes cover a float32


@kernel
def depth_order(depth: Any, keys: Any, order: Any, keys2: Any, order2: Any) -> int:
    """Sort the drawn splats by float32 depth, then by index (stable radix sort).

    Args:
        depth: [N] float32, above 0 for splats that are drawn.
        keys, keys2: [N] uint32, scratch.
        order: [N] int32, scratch.
        order2: [N] int32, written: indices of the drawn splats, nearest first.

    Returns:
        Number of drawn splats.
    """
    bits = depth.view(np.uint32)  # positive floats sort like their bits
    buckets = 1 << _DIGIT
    mask = np.uint32(buckets - 1)
    counts = np.zeros((3, buckets), np.int64)
    n = 0
    for i in range(len(bits)):
        key = bits[i]
        if key != 0:
            keys[n] = key
            order[n] = i
            n += 1
            counts[0, key & mask] += 1
            counts[1, (key >> np.uint32(_DIGIT)) & mask] += 1
            counts[2, key >> np.uint32(2 * _DIGIT)] += 1
    for p in range(3):
        total = 0
        for b in range(buckets):
            count = counts[p, b]
            counts[p, b] = total
            total += count
    _scatter(n, np.uint32(0), mask, counts[0], keys, order, keys2, order2)
    _scatter(n, np.uint32(_DIGIT), mask, counts[1], keys2, order2, keys, order)
    _scatter(n, np.uint32(2 * _DIGIT), mask, counts[2], keys, order, keys2, order2)
    return n


@device_function
def _scatter(n: int, shift: Any, mask: Any, counts: Any, keys: Any, order: Any, keys2: Any, order2: Any) -> None:
    """Move `n` keys and their order to keys2 and order2, in the order of the digit from bit `shift` on; stable.

    `counts` has the first place of each digit, and is advanced.
    """
    for j in range(n):
        key = keys[j]
        b = (key >> shift) & mask
        to = counts[b]
        counts[b] = to + 1
        keys2[to] = key
        order2[to] = order[j]


@device_function
def _tile_box(j: int, box: Any) -> tuple[int, int, int, int, bool]:
    """Return first column, end of columns, first row and end of rows of the tiles of box j; and True if it is small.

    In small boxes, and in a single row or column of tiles, `_row_span` does not pay off. `box` is [V, 4], pixels.
    """
    first, last = box[j, 0] >> TILE_BITS, ((box[j, 1] - 1) >> TILE_BITS) + 1
    top, bottom = box[j, 2] >> TILE_BITS, ((box[j, 3] - 1) >> TILE_BITS) + 1
    width, height = last - first, bottom - top
    return first, last, top, bottom, width < 2 or height < 2 or width * height <= _SMALL_BOX


@device_function
def _row_span(tile_y: int, j: int, extent: Any, box: Any, first: int, last: int) -> tuple[int, int]:
    """Return the range of tiles in a row of tiles that the ellipse of a splat touches (see "Extent" in `projection`).

    The range is within the box's columns, `first` to `last`; it is all of them if the ellipse overflows, and empty if
    the ellipse lies to the right of them.

    Within the row's heights, the right end of the chord is farthest at the height of the ellipse's rightmost point,
    clamped to the row, and the left end at the height of its leftmost point.
    """
    py = extent[j, 5]
    low = max(tile_y * TILE, box[j, 2]) + 0.5 - py
    high = min(tile_y * TILE + TILE, box[j, 3]) - 0.5 - py
    widest = extent[j, 3]
    slope, half, flat = extent[j, 0], extent[j, 1], extent[j, 2]
    dy = low if widest < low else (high if widest > high else widest)
    t = 1.0 - (dy * flat) * (dy * flat)
    right = dy * slope + half * math.sqrt(t if t > 0.0 else 0.0)
    dy = low if -widest < low else (high if -widest > high else -widest)
    t = 1.0 - (dy * flat) * (dy * flat)
    left = dy * slope - half * math.sqrt(t if t > 0.0 else 0.0)
    if not (left <= right):
        return first, last  # NaN by overflow: use the box
    # Pixel centres are at least half a pixel inside a tile, which leaves a margin for rounding.
    x0, x1 = (extent[j, 4] + left) * (1.0 / TILE), (extent[j, 4] + right) * (1.0 / TILE)
    begin = first if x0 < first else (last if x0 > last else int(x0))
    end = last if x1 > last - 1 else (first if x1 < first else int(x1)) + 1
    return begin, end


@parallel_kernel()
def gather_by_depth(
    lane: int, lanes: int, order: Any, extent: Any, box: Any, sorted_extent: Any, sorted_box: Any
) -> None:
    """Copy extents and boxes into depth order so that the sort into tiles reads memory sequentially.

    Args:
        order: [V] int32, drawn splats, nearest first.
        extent, box: [N, 6] and [N, 4], see `project`.
        sorted_extent, sorted_box: [V, 6] and [V, 4], written.
    """
    for j in range(*lane_range(lane, lanes, len(order))):
        i = order[j]
        for k in range(6):
            sorted_extent[j, k] = extent[i, k]
        for k in range(4):
            sorted_box[j, k] = box[i, k]


@parallel_kernel()
def count_tiles(
    lane: int, lanes: int, order: Any, extent: Any, box: Any, tiles_x: int, counts: Any, touched: Any
) -> None:
    """Count the splats of each tile; parallel over chunks of the depth order.

    Args:
        order: [V] int32, drawn splats, nearest first.
        extent, box: [V, 6] and [V, 4], see `gather_by_depth`.
        tiles_x: number of tiles per row.
        counts: [CHUNKS, tiles] int32, written: number of splats per chunk and tile.
        touched: [N] int32, written for drawn splats: number of tiles; empty without gradients.
    """
    chunks = counts.shape[0]
    n = len(order)
    for chunk in range(lane, chunks, lanes):
        row = counts[chunk]
        row[:] = 0
        for j in range(n * chunk // chunks, n * (chunk + 1) // chunks):
            first, last, top, bottom, few = _tile_box(j, box)
            tiles = (last - first) * (bottom - top) if few else 0
            if few:
                for ty in range(top, bottom):
                    for t in range(ty * tiles_x + first, ty * tiles_x + last):
                        row[t] += 1
            else:
                for ty in range(top, bottom):
                    x0, x1 = _row_span(ty, j, extent, box, first, last)
                    tiles += max(x1 - x0, 0)
                    for t in range(ty * tiles_x + x0, ty * tiles_x + x1):
                        row[t] += 1
            if len(touched) > 0:
                touched[order[j]] = tiles


@kernel
def tile_starts(counts: Any, starts: Any) -> int:
    """Convert counts to offsets: the start of each tile, and the start of each chunk within it.

    Args:
        counts: [CHUNKS, tiles] int32, replaced by offsets relative to the tile's start.
        starts: [tiles + 1] int64, written.

    Returns:
        Number of intersections.
    """
    total = 0
    for t in range(counts.shape[1]):
        starts[t] = total
        within = 0
        for chunk in range(counts.shape[0]):
            count = counts[chunk, t]
            counts[chunk, t] = within
            within += count
        total += within
    starts[counts.shape[1]] = total
    return total


@parallel_kernel()
def fill_tiles(
    lane: int,
    lanes: int,
    order: Any,
    extent: Any,
    box: Any,
    tiles_x: int,
    counts: Any,
    starts: Any,
    ids: Any,
    offsets: Any,
    slots: Any,
    slot_tiles: Any,
) -> None:
    """Write the splats of each tile, nearest first; parallel over chunks of the depth order.

    Args:
        order, extent, box, tiles_x: as in `count_tiles`.
        counts: [CHUNKS, tiles] int32, from `tile_starts`; modified.
        starts: [tiles + 1] int64, from `tile_starts`.
        ids: [intersections] int32, written: splats, tile by tile.
        offsets: [N + 1] int64, index of each splat's first gradient record; empty without gradients.
        slots: [intersections] int32, written: the gradient record of each entry of `ids`.
        slot_tiles: [intersections] int32, written: the tile of each gradient record.
    """
    chunks = counts.shape[0]
    n = len(order)
    with_slots = len(offsets) > 0
    for chunk in range(lane, chunks, lanes):
        row = counts[chunk]
        for j in range(n * chunk // chunks, n * (chunk + 1) // chunks):
            i = order[j]
            slot = offsets[i] if with_slots else 0
            first, last, top, bottom, few = _tile_box(j, box)
            for ty in range(top, bottom):
                x0, x1 = first, last
                if not few:
                    x0, x1 = _row_span(ty, j, extent, box, first, last)
                for t in range(ty * tiles_x + x0, ty * tiles_x + x1):
                    to = starts[t] + row[t]
                    row[t] += 1
                    ids[to] = i
                    if with_slots:
                        slots[to] = slot
                        slot_tiles[slot] = t
                        slot += 1


@kernel
def record_offsets(depth: Any, touched: Any, offsets: Any) -> None:
    """Write the index of each splat's first gradient record: the prefix sum of `touched`."""
    total = 0
    for i in range(len(depth)):
        offsets[i] = total
        if depth[i] > 0.0:
            total += touched[i]
    offsets[len(depth)] = total
