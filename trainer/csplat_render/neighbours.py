# SPDX-License-Identifier: Apache-2.0
"""Find the nearest neighbours of points in space."""

from __future__ import annotations

import numpy as np

from csplat.types import F64, I64
from csplat_render.kernels import call


def nearest_neighbours(points: F64, count: int, sizes: I64 | None = None) -> tuple[I64, F64]:
    """Find the nearest other points of each point, by row in the array.

    Of points at the same distance, the first is the one whose row differs least, then the one with the lower row.

    Args:
        points: [N, 3], finite.
        count: number of neighbours K, at least 1.
        sizes: [G], at least 1 each, number of points in each group; groups follow each other, and neighbours are in the
            same group. `None`: all points are one group.

    Returns:
        [N, K] int64, rows of the neighbours, the nearest first, then −1 if the group has fewer points; [N, K], their
        distances, then infinity.
    """
    points = np.ascontiguousarray(points, np.float64)
    sizes = np.full(min(len(points), 1), len(points)) if sizes is None else sizes
    rows, distances = np.empty((len(points), count), np.int64), np.empty((len(points), count))
    call("nearest_neighbours", points, np.ascontiguousarray(sizes, np.int64), len(sizes), count, rows, distances)
    return rows, distances
