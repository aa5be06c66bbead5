"""From splats to ellipses on the picture, in float64: the kernel and the pieces that its gradient shares.

With p and q the two rows of the linearised perspective times the camera's rotation (both in world
coordinates), r_k the axes of the splat and s_k its standard deviations, the projected half-axes are
u_k = s_k r_k·p and v_k = s_k r_k·q, and the covariance is (u·u, u·v; u·v, v·v) + dilation. Its
determinant is computed as |u×v|² + dilation (u·u + v·v) + dilation², with (u×v)_k = s_i s_j
r_k·(p×q): sums of squares, which lose nothing however long and thin the splat is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat_render.conventions import COMPENSATION_MIN, DILATION, LOG_SCALE_LIMIT
from csplat_render.harmonics import sh_basis
from csplat_render.jit import inline, parallel_kernel

#: Splats that one thread takes at a time.
BLOCK = 512


@inline
def rotation(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Rotation matrix of a unit quaternion, row by row; its columns are the splat's axes."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@inline
def unit(q: Any) -> tuple[float, float, float, float, float]:
    """A quaternion at unit length, and 1 / its length; zero is the identity, with 0."""
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    squared = w * w + x * x + y * y + z * z
    if squared == 0.0:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(squared)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inline
def deviation(log_scale: float) -> float:
    """Standard deviation of a log-scale, which is clamped."""
    return math.exp(min(max(np.float64(log_scale), -LOG_SCALE_LIMIT), LOG_SCALE_LIMIT))


@inline
def perspective(view: Any, x: float, y: float, z: float) -> tuple[float, float, float, float, bool, bool]:
    """Jacobian of the perspective: (j0, 0, j02; 0, j1, j12); and whether x/z and y/z were inside the limits."""
    over = 1.0 / z
    tx, ty = x * over, y * over
    inside_x = view[17] < tx < view[18]
    inside_y = view[19] < ty < view[20]
    tx = min(max(tx, view[17]), view[18])
    ty = min(max(ty, view[19]), view[20])
    j0, j1 = view[12] * over, view[13] * over
    return j0, -j0 * tx, j1, -j1 * ty, inside_x, inside_y


@inline
def rows(view: Any, j0: float, j02: float, j1: float, j12: float) -> tuple[float, float, float, float, float, float]:
    """The rows p and q: Jacobian times the camera's rotation."""
    return (
        j0 * view[0] + j02 * view[6],
        j0 * view[1] + j02 * view[7],
        j0 * view[2] + j02 * view[8],
        j1 * view[3] + j12 * view[6],
        j1 * view[4] + j12 * view[7],
        j1 * view[5] + j12 * view[8],
    )


@inline
def determinants(pq: Any, r: Any, s0: float, s1: float, s2: float, trace: float) -> tuple[float, float]:
    """Determinant of the projected covariance, without and with the dilation."""
    c0 = pq[1] * pq[5] - pq[2] * pq[4]
    c1 = pq[2] * pq[3] - pq[0] * pq[5]
    c2 = pq[0] * pq[4] - pq[1] * pq[3]
    w0 = s1 * s2 * (r[0] * c0 + r[3] * c1 + r[6] * c2)
    w1 = s2 * s0 * (r[1] * c0 + r[4] * c1 + r[7] * c2)
    w2 = s0 * s1 * (r[2] * c0 + r[5] * c1 + r[8] * c2)
    bare = w0 * w0 + w1 * w1 + w2 * w2
    return bare, bare + DILATION * trace + DILATION * DILATION


@inline
def compensation(bare: float, dilated: float) -> float:
    """Factor of the opacity in the antialiased mode: what the dilation added, taken off again."""
    return math.sqrt(max(bare / dilated, COMPENSATION_MIN))


@inline
def direction(view: Any, mean: Any) -> tuple[float, float, float, float]:
    """Direction from the camera to a point, of unit length, and 1 / the distance."""
    x, y, z = mean[0] - view[21], mean[1] - view[22], mean[2] - view[23]
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@inline
def finite_shape(i: int, means: Any, quats: Any, scales: Any, opacities: Any) -> bool:
    """Return True if everything but the colour of a splat is finite."""
    total = opacities[i] - opacities[i]  # NaN or infinity less itself is NaN
    total += (means[i, 0] - means[i, 0]) + (means[i, 1] - means[i, 1]) + (means[i, 2] - means[i, 2])
    total += (scales[i, 0] - scales[i, 0]) + (scales[i, 1] - scales[i, 1]) + (scales[i, 2] - scales[i, 2])
    total += (quats[i, 0] - quats[i, 0]) + (quats[i, 1] - quats[i, 1])
    total += (quats[i, 2] - quats[i, 2]) + (quats[i, 3] - quats[i, 3])
    return bool(total == 0.0)


@inline
def finite_colour(i: int, sh0: Any, shN: Any, higher: int) -> bool:
    """Return True if the coefficients of a splat that are used are finite."""
    total = (sh0[i, 0] - sh0[i, 0]) + (sh0[i, 1] - sh0[i, 1]) + (sh0[i, 2] - sh0[i, 2])
    for k in range(higher):
        total += (shN[i, k, 0] - shN[i, k, 0]) + (shN[i, k, 1] - shN[i, k, 1]) + (shN[i, k, 2] - shN[i, k, 2])
    return bool(total == 0.0)


@inline
def beyond(at: float, size: int, squared_reach: float) -> bool:
    """Return True if an extent around `at` ends more than half a pixel outside of 0 to `size`."""
    distance = max(-at, at - size) - 1.0
    return bool(distance > 0.0 and distance * distance > squared_reach)


@parallel_kernel()
def project(
    lane: int,
    lanes: int,
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    sh0: Any,
    shN: Any,
    degree: int,
    view: Any,
    width: int,
    height: int,
    antialiased: bool,
    alpha_min: float,
    shape: Any,
    extent: Any,
    box: Any,
    depth: Any,
    radii: Any,
    ignored: Any,
) -> None:
    """Project every splat; parallel over blocks of splats, one splat at a time.

    Args:
        means: [N, 3], float32 or float64, as the next five.
        quats: [N, 4], of any length.
        scales: [N, 3], logarithms.
        opacities: [N], alpha.
        sh0: [N, 3].
        shN: [N, K, 3], K at least (degree + 1)**2 - 1.
        degree: degree of the spherical harmonics that are evaluated.
        view: [24], see `view_vector`.
        width: width of the image, pixels.
        height: height of the image, pixels.
        antialiased: compensate the dilation.
        alpha_min: smallest alpha that is drawn.
        shape: [N, 10] float64, written for splats in view: centre x and y, inverse covariance a
            b c, opacity, red, green, blue, depth.
        extent: [N, 6] float64, written, of the ellipse of `alpha_min`: how far the middle of its
            chord moves per row, its half-width at the height of the centre, 1 / its half-height,
            the height at which it reaches farthest to the right; centre x and y.
        box: [N, 4] int32, written: x0, x1, y0, y1 of the pixels that it may touch, x1 and y1 beyond.
        depth: [N] float32, written: 0 for what is not drawn.
        radii: [N] float32, written: 3 standard deviations along the longest axis; 0 as above.
        ignored: [ceil(N / BLOCK)] int64, written: how many splats held NaN or infinity.
    """
    n = means.shape[0]
    higher = (degree + 1) * (degree + 1) - 1
    basis = np.empty(16, np.float64)
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        bad = 0
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            depth[i], radii[i] = 0.0, 0.0
            if not finite_shape(i, means, quats, scales, opacities):
                bad += 1
                continue
            X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            z = view[6] * X + view[7] * Y + view[8] * Z + view[11]
            if not (z > view[16] and opacities[i] >= alpha_min):
                bad += not finite_colour(i, sh0, shN, higher)
                continue
            x = view[0] * X + view[1] * Y + view[2] * Z + view[9]
            y = view[3] * X + view[4] * Y + view[5] * Z + view[10]
            px = view[12] * (x / z) + view[14]
            py = view[13] * (y / z) + view[15]
            s0, s1, s2 = deviation(scales[i, 0]), deviation(scales[i, 1]), deviation(scales[i, 2])
            j0, j02, j1, j12, _, _ = perspective(view, x, y, z)
            pq = rows(view, j0, j02, j1, j12)
            p0, p1, p2, q0, q1, q2 = pq
            opacity = np.float64(opacities[i])
            reach = 2.0 * math.log(opacity / alpha_min)
            # No axis of the splat is longer on the picture than its longest standard deviation allows.
            longest = max(s0, s1, s2)
            longest *= longest
            most_a, most_c = p0 * p0 + p1 * p1 + p2 * p2, q0 * q0 + q1 * q1 + q2 * q2
            if beyond(px, width, reach * (longest * most_a + DILATION)) or beyond(
                py, height, reach * (longest * most_c + DILATION)
            ):
                bad += not finite_colour(i, sh0, shN, higher)
                continue
            qw, qx, qy, qz, _ = unit(quats[i])
            r = rotation(qw, qx, qy, qz)
            u0 = s0 * (r[0] * p0 + r[3] * p1 + r[6] * p2)
            u1 = s1 * (r[1] * p0 + r[4] * p1 + r[7] * p2)
            u2 = s2 * (r[2] * p0 + r[5] * p1 + r[8] * p2)
            v0 = s0 * (r[0] * q0 + r[3] * q1 + r[6] * q2)
            v1 = s1 * (r[1] * q0 + r[4] * q1 + r[7] * q2)
            v2 = s2 * (r[2] * q0 + r[5] * q1 + r[8] * q2)
            A = u0 * u0 + u1 * u1 + u2 * u2
            B = u0 * v0 + u1 * v1 + u2 * v2
            C = v0 * v0 + v1 * v1 + v2 * v2
            bare, dilated = determinants(pq, r, s0, s1, s2, A + C)
            A += DILATION
            C += DILATION
            if antialiased:
                opacity *= compensation(bare, dilated)
                reach = 2.0 * math.log(max(opacity / alpha_min, 1.0))
            if not (opacity >= alpha_min and math.isfinite(dilated) and math.isfinite(px) and math.isfinite(py)):
                bad += not finite_colour(i, sh0, shN, higher)
                continue
            # opacity · exp(−½ d²) = alpha_min; a little more, so that rounding never takes a pixel away.
            reach = math.sqrt(reach) * (1.0 + 1e-6) + 1e-6
            root_a, root_c = math.sqrt(A), math.sqrt(C)
            rx, ry = reach * root_a, reach * root_c
            x0 = math.ceil(min(max(px - rx - 0.5, 0.0), np.float64(width)))
            x1 = math.floor(min(max(px + rx + 0.5, 0.0), np.float64(width)))
            y0 = math.ceil(min(max(py - ry - 0.5, 0.0), np.float64(height)))
            y1 = math.floor(min(max(py + ry + 0.5, 0.0), np.float64(height)))
            if x1 <= x0 or y1 <= y0:
                bad += not finite_colour(i, sh0, shN, higher)
                continue
            dx, dy, dz, _ = direction(view, means[i])
            sh_basis(degree, dx, dy, dz, basis)
            red, green, blue = basis[0] * sh0[i, 0], basis[0] * sh0[i, 1], basis[0] * sh0[i, 2]
            for k in range(higher):
                red += basis[k + 1] * shN[i, k, 0]
                green += basis[k + 1] * shN[i, k, 1]
                blue += basis[k + 1] * shN[i, k, 2]
            if not math.isfinite(red + green + blue):
                bad += 1
                continue
            over, over_a, over_c = 1.0 / dilated, 1.0 / root_a, 1.0 / root_c
            box[i, 0], box[i, 1], box[i, 2], box[i, 3] = x0, x1, y0, y1
            shape[i, 0], shape[i, 1] = px, py
            shape[i, 2], shape[i, 3], shape[i, 4] = C * over, -B * over, A * over
            shape[i, 5] = opacity
            shape[i, 6], shape[i, 7], shape[i, 8] = max(red + 0.5, 0.0), max(green + 0.5, 0.0), max(blue + 0.5, 0.0)
            shape[i, 9] = z
            extent[i, 0], extent[i, 1] = B * over_c * over_c, reach * math.sqrt(dilated) * over_c
            extent[i, 2], extent[i, 3], extent[i, 4], extent[i, 5] = 1.0 / ry, reach * B * over_a, px, py
            near32 = np.float32(z)
            if math.isfinite(near32):
                depth[i] = near32
                half = 0.5 * (A - C)
                radii[i] = 3.0 * math.sqrt(0.5 * (A + C) + math.sqrt(half * half + B * B))
        ignored[block] = bad
