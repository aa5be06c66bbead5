"""The loop over pixels, forward: tile by tile, splats front to back, a row of 16 pixels at a time."""

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
    go_on,
    leave,
    middles,
    narrow_rows,
    numbers_of,
    passed,
    place,
)
from csplat_render.jit import ParallelKernel, parallel_kernel


def _blender(counted: bool) -> ParallelKernel[...]:
    """Make `blend`, or the kernel that notes how far pixels got where `blend` adds up depth."""

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
            lane: which of the threads this is.
            lanes: how many share the tiles; the result does not depend on it.
            starts: [tiles + 1] int64, where the splats of each tile begin in `ids`.
            ids: [intersections] int32, splats, tile by tile, nearest first.
            shape: [N, 10] float64, see `project`; where counted see `narrow_rows`.
            box: [N, 4] int32, see `project`.
            tiles_x: tiles side by side.
            limits: [3], smallest alpha, largest alpha, smallest transmittance; its dtype, float32 or
                float64, is that of the pixels.
            background: [3].
            rgb: [H, W, 3], written.
            transmittance: [H, W], written: what the background shines through with.
            fifth: [H, W], written: the sum of weight · depth; where counted the place, from its tile's start, of the
                last splat of those whose rows the pixel lies in that came before it was finished, −1 if there is none.
            used: [tiles] int64, written: the end of what was looked at of each tile.
            state: [H, W, 5], changed: what nearer splats left of each pixel, see `go_on`; where it is empty there are
                none, and nothing is kept for farther ones.
        """
        height, width = transmittance.shape
        # One row of memory per row of pixels, so that the compiler sees that nothing overlaps:
        # 16 transmittances, then 16 each of red, green, blue, the fifth; and the positions in a row.
        planes = aligned(TILE * 6 * TILE, limits).reshape((TILE, 6 * TILE))
        ys = middles()
        for y in range(TILE):
            for x in range(TILE):
                planes[y, 5 * TILE + x] = ys[x]
        batch, rows = np.empty((CHECK, NUMBERS), limits.dtype), np.empty((CHECK, 2), np.int64)
        alpha_min, alpha_cap, stop = limits[0], limits[1], limits[2]
        zero, one = alpha_min - alpha_min, alpha_min / alpha_min
        nothing = -one if counted else zero
        for tile in range(lane, len(used), lanes):
            X0, Y0, columns, on_picture = place(tile, tiles_x, width, height)
            low, high = 0, on_picture
            begin_tile(planes, columns, one)
            planes[:, TILE : 4 * TILE] = zero
            planes[:, 4 * TILE : 5 * TILE] = nothing
            if len(state):
                go_on(state, X0, Y0, columns, on_picture, planes)
            end = starts[tile + 1]
            for begin in range(starts[tile], end, CHECK):
                low, high = alive_rows(planes, low, high)
                if low >= high:
                    end = begin
                    break
                count = min(CHECK, end - begin)
                gather(ids, begin, begin + count, shape, box, X0, Y0, low, high, ys, batch, rows)
                if counted:
                    narrow_rows(count, batch, rows)
                for j in range(count):
                    first = rows[j, 0]
                    body = planes[first : rows[j, 1]]
                    row0, row1, a, o, r, g, b, d = numbers_of(batch, j, first)
                    if counted:
                        d = planes.dtype.type(begin + j - starts[tile])
                    for y in range(len(body)):
                        row, c0, c1 = body[y], row0[y], row1[y]
                        for x in range(TILE):
                            _, alpha = alpha_at(row[5 * TILE + x], c0, c1, a, o, alpha_min, alpha_cap, zero)
                            going, weight, row[x] = passed(row[x], alpha, stop, zero, one)
                            row[TILE + x] += weight * r
                            row[2 * TILE + x] += weight * g
                            row[3 * TILE + x] += weight * b
                            if counted:
                                row[4 * TILE + x] = d if going else row[4 * TILE + x]
                            else:
                                row[4 * TILE + x] += weight * d
            used[tile] = end
            if len(state):
                leave(state, X0, Y0, columns, on_picture, planes)
            for y in range(on_picture):
                for x in range(columns):
                    left = abs(planes[y, x])
                    rgb[Y0 + y, X0 + x, 0] = planes[y, TILE + x] + left * background[0]
                    rgb[Y0 + y, X0 + x, 1] = planes[y, 2 * TILE + x] + left * background[1]
                    rgb[Y0 + y, X0 + x, 2] = planes[y, 3 * TILE + x] + left * background[2]
                    transmittance[Y0 + y, X0 + x] = left
                    fifth[Y0 + y, X0 + x] = planes[y, 4 * TILE + x]

    return blend


#: A picture, with its depth.
blend = _blender(counted=False)

#: A picture, and how far each pixel got.
blend_counted = _blender(counted=True)
