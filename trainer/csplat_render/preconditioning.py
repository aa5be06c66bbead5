"""What a splat's own coefficients are to each other in a fit of colours: a matrix each, factored and solved by.

Views from few directions tell a splat's spherical harmonics hardly apart: so its block of the normal matrix, squared
weights times Y Yᵀ summed over views, is far from a diagonal, and conjugate gradients that know it want half the steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat_render.jit import parallel_kernel
from csplat_render.projecting import BLOCK

__all__ = ["factor", "no_blocks", "solve"]

F32 = NDArray[np.float32]

_LEAST = 1e-3  # of the ridge: what is left of a pivot where rounding took all of it


def no_blocks(splats: int, coefficients: int) -> F32:
    """Zeros for the lower triangles of the blocks, row by row: [N, B (B + 1) / 2]."""
    return np.zeros((splats, coefficients * (coefficients + 1) // 2), np.float32)


@parallel_kernel()
def factor(lane: int, lanes: int, blocks: Any, free: Any, ridge: Any) -> None:
    """Replace blocks by their Cholesky factors; parallel over splats.

    Args:
        lane, lanes: see `blend`.
        blocks: [N, B (B + 1) / 2] float32, see `no_blocks`; the ridges come to their diagonals.
        free: [N, B] bool; what is not free has nothing to do with the others.
        ridge: [B] float32, above 0.
    """
    n, size = free.shape
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            own = blocks[i]
            for k in range(size):
                row = k * (k + 1) // 2
                for m in range(k + 1):
                    other = m * (m + 1) // 2
                    left = np.float64(own[row + m]) if free[i, k] and free[i, m] else 0.0
                    for j in range(m):
                        left -= np.float64(own[row + j]) * own[other + j]
                    if m < k:
                        own[row + m] = left / own[other + m]
                    else:
                        own[row + k] = np.sqrt(max(left + ridge[k], _LEAST * ridge[k]))


@parallel_kernel()
def solve(lane: int, lanes: int, factors: Any, vector: Any, result: Any) -> None:
    """Multiply with the inverse of the blocks; parallel over splats.

    Args:
        lane, lanes: see `blend`.
        factors: as `factor` left them.
        vector: [N, B, 3] float32; 0 in what is not free.
        result: [N, B, 3] float32, written; 0 there too.
    """
    n, size, channels = vector.shape
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            own, x = factors[i], result[i]
            for c in range(channels):
                for k in range(size):
                    row = k * (k + 1) // 2
                    left = np.float64(vector[i, k, c])
                    for j in range(k):
                        left -= np.float64(own[row + j]) * x[j, c]
                    x[k, c] = left / own[row + k]
                for k in range(size - 1, -1, -1):
                    left = np.float64(x[k, c])
                    for j in range(k + 1, size):
                        left -= np.float64(own[j * (j + 1) // 2 + k]) * x[j, c]
                    x[k, c] = left / own[k * (k + 1) // 2 + k]
