"""Linear forms from a place on a render to the derivative of a splat's exponent with respect to its covariance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.conventions import COMPENSATION_MIN
from csplat_render.kernels import parallel_kernel
from csplat_render.projection import (
    BLOCK,
    determinants,
    jacobian_rows,
    perspective_jacobian,
    rotation_matrix,
    standard_deviation,
    unit_quaternion,
)

#: Numbers per splat that determine how its exponent depends on its covariance.
FORM = 12


@parallel_kernel()
def covariance_forms(lane: int, lanes: int, means: Any, quats: Any, scales: Any, view: Any, antialiased: bool,
                     shape: Any, near: Any, forms: Any) -> None:  # fmt: skip
    """Compute the forms that turn a place on a render into the exponent's derivative towards a splat's covariance.

    With Σ2 the covariance on the render, M the linearised perspective and γ² the trace of the covariance Σ, the
    exponent's derivative towards Σ / γ² is t = h hᵀ + C, h = γ/√2 · Mᵀ Σ2⁻¹ d, d the distance from the centre in
    pixels. C is 0 but in the antialiased mode, whose opacity depends on the covariance too. Parallel over blocks.

    Args:
        means: see `project`, as the next two.
        quats: see `project`.
        scales: see `project`.
        view: see `project`.
        antialiased: see `project`.
        shape: see `project`.
        near: [N] float32, above 0 for splats that are drawn.
        forms: [N, FORM] float64, written for splats that are drawn: the matrix of h, [3, 2] row by row; C, as xx yy zz
            xy xz yz.
    """
    n = means.shape[0]
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not near[i] > 0.0:
                continue
            X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            x = view[0] * X + view[1] * Y + view[2] * Z + view[9]
            y = view[3] * X + view[4] * Y + view[5] * Z + view[10]
            z = view[6] * X + view[7] * Y + view[8] * Z + view[11]
            j0, j02, j1, j12, _, _ = perspective_jacobian(view, x, y, z)
            pq = jacobian_rows(view, j0, j02, j1, j12)
            s0, s1, s2 = (
                standard_deviation(scales[i, 0]),
                standard_deviation(scales[i, 1]),
                standard_deviation(scales[i, 2]),
            )
            half = 0.5 * (s0 * s0 + s1 * s1 + s2 * s2)
            a, b, c = shape[i, 2], shape[i, 3], shape[i, 4]
            size = math.sqrt(half)
            for k in range(3):
                p, q = pq[k], pq[3 + k]
                forms[i, 2 * k], forms[i, 2 * k + 1] = size * (p * a + q * b), size * (p * b + q * c)
            forms[i, 6:] = 0.0
            if antialiased:
                qw, qx, qy, qz, _ = unit_quaternion(quats[i])
                r = rotation_matrix(qw, qx, qy, qz)
                A, B, C = 0.0, 0.0, 0.0
                for k, s in enumerate((s0, s1, s2)):
                    u = s * (r[k] * pq[0] + r[3 + k] * pq[1] + r[6 + k] * pq[2])
                    v = s * (r[k] * pq[3] + r[3 + k] * pq[4] + r[6 + k] * pq[5])
                    A, B, C = A + u * u, B + u * v, C + v * v
                bare, dilated = determinants(pq, r, s0, s1, s2, A + C)
                if bare > COMPENSATION_MIN * dilated:
                    # The logarithm of √(det Σ2 / det (Σ2 + dilation)), towards Σ2: half the difference of inverses.
                    da, db, dc = C / bare - a, -B / bare - b, A / bare - c
                    for e, (k, m) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
                        left, right = pq[k] * da + pq[3 + k] * db, pq[k] * db + pq[3 + k] * dc
                        forms[i, 6 + e] = half * (left * pq[m] + right * pq[3 + m])
