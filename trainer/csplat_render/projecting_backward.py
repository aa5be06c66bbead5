"""From the gradients on the picture back to the parameters of the splats, in float64.

With e = Σ⁻¹ d, the gradient of the exponent towards the centre is e and towards the covariance is
½ e eᵀ. The sums of these over the pixels come from the records of the tiles: moments about the
centre of each tile, which are moved to the centre of the splat here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.binning import TILE
from csplat_render.conventions import COMPENSATION_MIN, DILATION, LOG_SCALE_LIMIT
from csplat_render.harmonics import sh_basis, sh_basis_gradient
from csplat_render.jit import inline, parallel_kernel
from csplat_render.projecting import BLOCK, determinants, deviation, direction, perspective, rotation, rows, unit

_HUGE = 1e37  # gradients are clamped to this: they fit float32, whatever they are added to


@inline
def _clean(value: float) -> float:
    if not (abs(value) <= _HUGE):
        if value > 0.0:
            return _HUGE
        return -_HUGE if value < 0.0 else 0.0
    return value


@inline
def gather(begin: int, end: int, records: Any, tiles: Any, tiles_x: int, shape: Any, i: int) -> tuple[float, ...]:
    """Sum the records of a splat.

    Returns:
        Sums over the pixels of: slope, slope·e_x, slope·e_y, slope·e_x², slope·e_x·e_y,
        slope·e_y², and the gradients of red, green, blue and depth.
    """
    a, b, c = shape[i, 2], shape[i, 3], shape[i, 4]
    s0, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mxx, mxy, myy = 0.0, 0.0, 0.0
    red, green, blue, far = 0.0, 0.0, 0.0, 0.0
    for j in range(begin, end):
        tile = tiles[j]
        dx = (tile % tiles_x) * TILE + 0.5 * TILE - shape[i, 0]
        dy = (tile // tiles_x) * TILE + 0.5 * TILE - shape[i, 1]
        # e at the centre of the tile, first: the difference is small where the splat is seen.
        ex, ey = a * dx + b * dy, b * dx + c * dy
        m0, m1, m2 = np.float64(records[j, 0]), np.float64(records[j, 1]), np.float64(records[j, 2])
        fx, fy = a * m1 + b * m2, b * m1 + c * m2
        s0 += m0
        sx += fx + ex * m0
        sy += fy + ey * m0
        sxx += ex * (2.0 * fx + ex * m0)
        sxy += ex * fy + ey * (fx + ex * m0)
        syy += ey * (2.0 * fy + ey * m0)
        mxx += records[j, 3]
        mxy += records[j, 4]
        myy += records[j, 5]
        red += records[j, 6]
        green += records[j, 7]
        blue += records[j, 8]
        far += records[j, 9]
    sxx += a * (a * mxx + b * mxy) + b * (a * mxy + b * myy)
    sxy += b * (a * mxx + b * mxy) + c * (a * mxy + b * myy)
    syy += b * (b * mxx + c * mxy) + c * (b * mxy + c * myy)
    return s0, sx, sy, sxx, sxy, syy, red, green, blue, far


@parallel_kernel()
def project_backward(
    lane: int,
    lanes: int,
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    shN: Any,
    degree: int,
    view: Any,
    antialiased: bool,
    shape: Any,
    depth: Any,
    offsets: Any,
    records: Any,
    record_tiles: Any,
    tiles_x: int,
    g_means: Any,
    g_quats: Any,
    g_scales: Any,
    g_opacities: Any,
    g_sh0: Any,
    g_shN: Any,
    g_means2d: Any,
) -> None:
    """Gradients of every splat's parameters; parallel over blocks of splats, one splat at a time.

    Args:
        means: see `project`, as the next six.
        quats: see `project`.
        scales: see `project`.
        opacities: see `project`.
        shN: see `project`.
        degree: see `project`.
        view: see `project`.
        antialiased: see `project`.
        shape: see `project`.
        depth: [N] float32, above 0 for what was drawn.
        offsets: [N + 1] int64, where the records of each splat begin.
        records: [intersections, RECORD], see `blend_backward`.
        record_tiles: [intersections] int32, the tile of each record.
        tiles_x: tiles side by side.
        g_means: [N, 3], written, as the next six.
        g_quats: [N, 4].
        g_scales: [N, 3].
        g_opacities: [N].
        g_sh0: [N, 3].
        g_shN: [N, K, 3].
        g_means2d: [N], length of the gradient towards the centre on the picture, per pixel.
    """
    n = means.shape[0]
    higher = (degree + 1) * (degree + 1) - 1
    basis, weights = np.empty(16, np.float64), np.empty(16, np.float64)
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            g_means[i], g_quats[i], g_scales[i], g_opacities[i], g_sh0[i], g_means2d[i] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            g_shN[i] = 0.0
            if not (depth[i] > 0.0 and offsets[i + 1] > offsets[i]):
                continue
            s0_, sx, sy, sxx, sxy, syy, red, green, blue, far = gather(
                offsets[i], offsets[i + 1], records, record_tiles, tiles_x, shape, i
            )
            g_means2d[i] = _clean(math.sqrt(sx * sx + sy * sy))

            # What `project` computed.
            X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            x = view[0] * X + view[1] * Y + view[2] * Z + view[9]
            y = view[3] * X + view[4] * Y + view[5] * Z + view[10]
            z = view[6] * X + view[7] * Y + view[8] * Z + view[11]
            qw, qx, qy, qz, q_inverse = unit(quats[i])
            r = rotation(qw, qx, qy, qz)
            s0, s1, s2 = deviation(scales[i, 0]), deviation(scales[i, 1]), deviation(scales[i, 2])
            j0, j02, j1, j12, inside_x, inside_y = perspective(view, x, y, z)
            pq = rows(view, j0, j02, j1, j12)
            p0, p1, p2, q0, q1, q2 = pq
            u0 = s0 * (r[0] * p0 + r[3] * p1 + r[6] * p2)
            u1 = s1 * (r[1] * p0 + r[4] * p1 + r[7] * p2)
            u2 = s2 * (r[2] * p0 + r[5] * p1 + r[8] * p2)
            v0 = s0 * (r[0] * q0 + r[3] * q1 + r[6] * q2)
            v1 = s1 * (r[1] * q0 + r[4] * q1 + r[7] * q2)
            v2 = s2 * (r[2] * q0 + r[5] * q1 + r[8] * q2)

            # Opacity and its compensation; covariance (A, B; B, C).
            gA, gB, gC = 0.5 * sxx, sxy, 0.5 * syy
            if antialiased:
                A, B, C = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
                bare, dilated = determinants(pq, r, s0, s1, s2, A + C)
                ratio = bare / dilated
                if ratio > COMPENSATION_MIN:
                    g = 0.5 * s0_ / bare
                    gA += g * (C - ratio * (C + DILATION))
                    gC += g * (A - ratio * (A + DILATION))
                    gB -= g * 2.0 * B * (1.0 - ratio)
            g_opacities[i] = _clean(s0_ / np.float64(opacities[i]))

            # Half-axes on the picture, then standard deviations, axes, rows of the Jacobian.
            du0, dv0 = 2.0 * gA * u0 + gB * v0, 2.0 * gC * v0 + gB * u0
            du1, dv1 = 2.0 * gA * u1 + gB * v1, 2.0 * gC * v1 + gB * u1
            du2, dv2 = 2.0 * gA * u2 + gB * v2, 2.0 * gC * v2 + gB * u2
            if abs(scales[i, 0]) < LOG_SCALE_LIMIT:
                g_scales[i, 0] = _clean(du0 * u0 + dv0 * v0)
            if abs(scales[i, 1]) < LOG_SCALE_LIMIT:
                g_scales[i, 1] = _clean(du1 * u1 + dv1 * v1)
            if abs(scales[i, 2]) < LOG_SCALE_LIMIT:
                g_scales[i, 2] = _clean(du2 * u2 + dv2 * v2)
            du0, dv0, du1, dv1, du2, dv2 = du0 * s0, dv0 * s0, du1 * s1, dv1 * s1, du2 * s2, dv2 * s2
            r00, r10, r20 = du0 * p0 + dv0 * q0, du0 * p1 + dv0 * q1, du0 * p2 + dv0 * q2
            r01, r11, r21 = du1 * p0 + dv1 * q0, du1 * p1 + dv1 * q1, du1 * p2 + dv1 * q2
            r02, r12, r22 = du2 * p0 + dv2 * q0, du2 * p1 + dv2 * q1, du2 * p2 + dv2 * q2
            gw = 2.0 * (qx * (r21 - r12) + qy * (r02 - r20) + qz * (r10 - r01))
            gx = 2.0 * (qw * (r21 - r12) + qy * (r10 + r01) + qz * (r20 + r02)) - 4.0 * qx * (r11 + r22)
            gy = 2.0 * (qw * (r02 - r20) + qx * (r10 + r01) + qz * (r21 + r12)) - 4.0 * qy * (r00 + r22)
            gz = 2.0 * (qw * (r10 - r01) + qx * (r20 + r02) + qy * (r21 + r12)) - 4.0 * qz * (r00 + r11)
            radial = gw * qw + gx * qx + gy * qy + gz * qz
            g_quats[i, 0] = _clean((gw - radial * qw) * q_inverse)
            g_quats[i, 1] = _clean((gx - radial * qx) * q_inverse)
            g_quats[i, 2] = _clean((gy - radial * qy) * q_inverse)
            g_quats[i, 3] = _clean((gz - radial * qz) * q_inverse)
            gp0 = du0 * r[0] + du1 * r[1] + du2 * r[2]
            gp1 = du0 * r[3] + du1 * r[4] + du2 * r[5]
            gp2 = du0 * r[6] + du1 * r[7] + du2 * r[8]
            gq0 = dv0 * r[0] + dv1 * r[1] + dv2 * r[2]
            gq1 = dv0 * r[3] + dv1 * r[4] + dv2 * r[5]
            gq2 = dv0 * r[6] + dv1 * r[7] + dv2 * r[8]
            g_j0 = gp0 * view[0] + gp1 * view[1] + gp2 * view[2]
            g_j02 = gp0 * view[6] + gp1 * view[7] + gp2 * view[8]
            g_j1 = gq0 * view[3] + gq1 * view[4] + gq2 * view[5]
            g_j12 = gq0 * view[6] + gq1 * view[7] + gq2 * view[8]

            # Camera coordinates: by the Jacobian, by the centre on the picture, by the depth.
            cx, cy = sx * j0, sy * j1
            cz = far - (sx * j0 * x + sy * j1 * y) / z
            cz -= (g_j0 * j0 + g_j02 * j02 + g_j1 * j1 + g_j12 * j12) / z
            if inside_x:
                cx -= g_j02 * j0 / z
                cz -= g_j02 * j02 / z
            if inside_y:
                cy -= g_j12 * j1 / z
                cz -= g_j12 * j12 / z

            # Colour, and the direction in which it is seen.
            dx, dy, dz, inverse = direction(view, means[i])
            sh_basis(degree, dx, dy, dz, basis)
            red = red if shape[i, 6] > 0.0 else 0.0
            green = green if shape[i, 7] > 0.0 else 0.0
            blue = blue if shape[i, 8] > 0.0 else 0.0
            g_sh0[i, 0] = _clean(basis[0] * red)
            g_sh0[i, 1] = _clean(basis[0] * green)
            g_sh0[i, 2] = _clean(basis[0] * blue)
            weights[0] = 0.0
            for k in range(higher):
                g_shN[i, k, 0] = _clean(basis[k + 1] * red)
                g_shN[i, k, 1] = _clean(basis[k + 1] * green)
                g_shN[i, k, 2] = _clean(basis[k + 1] * blue)
                weights[k + 1] = red * shN[i, k, 0] + green * shN[i, k, 1] + blue * shN[i, k, 2]
            wx, wy, wz = sh_basis_gradient(degree, dx, dy, dz, weights)
            radial = wx * dx + wy * dy + wz * dz
            wx, wy, wz = (wx - radial * dx) * inverse, (wy - radial * dy) * inverse, (wz - radial * dz) * inverse
            g_means[i, 0] = _clean(view[0] * cx + view[3] * cy + view[6] * cz + wx)
            g_means[i, 1] = _clean(view[1] * cx + view[4] * cy + view[7] * cz + wy)
            g_means[i, 2] = _clean(view[2] * cx + view[5] * cy + view[8] * cz + wz)
