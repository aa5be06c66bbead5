"""Projection of splats to ellipses on the image, and its gradient, in float64.

Forward. With R and t the rotation and translation of the camera, r_k the axes of the splat and s_k its standard
deviations:

    c = R·mean + t = (x, y, z)                           centre in camera coordinates
    J = (fx/z, 0, −fx x/z²; 0, fy/z, −fy y/z²)           Jacobian of the perspective, x/z and y/z clamped (`FOV_MARGIN`)
    (p; q) = J R
    u_k = s_k r_k·p,  v_k = s_k r_k·q                    projected half-axes
    Σ = (A, B; B, C) = (u·u, u·v; u·v, v·v) + dilation   covariance on the image
    det Σ = |u×v|² + dilation (u·u + v·v) + dilation²,  (u×v)_k = s_i s_j r_k·(p×q)

The determinant is a sum of squares, which is accurate however long and thin the splat is. The code calls the entries of
J other than 0 j0, j02, j1 and j12.

Extent. A splat of opacity o is drawn within the ellipse dᵀ Σ⁻¹ d ≤ ρ², ρ² = 2 ln(o / alpha_min), whose half-width is
ρ √A and whose half-height is ρ √C. At height y above its centre, its chord is

    x = (B / C) y ± ρ √(det Σ / C) · √(1 − (y / (ρ √C))²)

and it reaches farthest to the right, ρ √A, at y = ρ B / √A.

Backward. With d the distance of a pixel from the centre m of the ellipse and e = Σ⁻¹ d, the exponent E = −½ dᵀ Σ⁻¹ d
has ∂E/∂m = e and ∂E/∂Σ = ½ e eᵀ. Writing g_x for ∂loss/∂x and `slope` for ∂loss/∂E of a pixel:

    g_m = Σ slope·e                      g_A = ½ Σ slope·e_x²,  g_B = Σ slope·e_x e_y,  g_C = ½ Σ slope·e_y²
    g_opacity = Σ slope / opacity        (alpha = opacity · exp(E))
    g_u = 2 g_A u + g_B v,  g_v = 2 g_C v + g_B u
    g_log(s_k) = g_u_k u_k + g_v_k v_k   (u_k and v_k are proportional to s_k)
    g_r_k = s_k (g_u_k p + g_v_k q)      then through the rotation matrix and the normalisation of the quaternion
    g_p = Σ_k s_k g_u_k r_k,  g_q = Σ_k s_k g_v_k r_k
    g_J = (g_p; g_q) Rᵀ
    g_c = Jᵀ g_m + (∂J/∂c) g_J + g_depth (0, 0, 1)
    g_mean = Rᵀ g_c + (I − n nᵀ) / |mean − camera| · ∂(colour)/∂n    for the viewing direction n

In the antialiased mode the opacity is multiplied by √ratio (Yu et al., Mip-Splatting, 2024), where ratio = bare /
dilated is the quotient of the determinants without and with the dilation. With g = ½ Σ slope / bare this adds

    g_A += g (C_bare − ratio (C_bare + dilation))
    g_B −= 2 g B (1 − ratio)
    g_C += g (A_bare − ratio (A_bare + dilation))

The sums over pixels are stored per tile as moments about the centre of the tile; `sum_records` moves them to the
centre of the splat. `reference_rasteriser` is the slow twin; gradients are compared with its finite differences.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csplat import spherical_harmonics
from csplat.spherical_harmonics import BASIS_SIZE
from csplat_render.binning import TILE
from csplat_render.conventions import COMPENSATION_MIN, DILATION, LOG_SCALE_LIMIT
from csplat_render.kernels import device_function, parallel_kernel

sh_basis = device_function(spherical_harmonics.sh_basis)
sh_basis_gradient = device_function(spherical_harmonics.sh_basis_gradient)

#: Number of splats that a thread processes at a time.
BLOCK = 512

_REACH_MARGIN = 1e-6  # relative, and in standard deviations


@device_function
def rotation_matrix(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Return the rotation matrix of a unit quaternion, row by row; its columns are the axes of the splat."""
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


@device_function
def unit_quaternion(q: Any) -> tuple[float, float, float, float, float]:
    """Return the normalised quaternion and 1 / its length; for zero the identity and 0."""
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    squared = w * w + x * x + y * y + z * z
    if squared == 0.0:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(squared)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@device_function
def standard_deviation(log_scale: float) -> float:
    """Return the standard deviation of a log scale, which is clamped to ± `LOG_SCALE_LIMIT`."""
    return math.exp(min(max(np.float64(log_scale), -LOG_SCALE_LIMIT), LOG_SCALE_LIMIT))


@device_function
def perspective_jacobian(view: Any, x: float, y: float, z: float) -> tuple[float, float, float, float, bool, bool]:
    """Return j0, j02, j1, j12 of the perspective's Jacobian; and True for each of x/z and y/z within its bounds."""
    over = 1.0 / z
    tx, ty = x * over, y * over
    inside_x = view[17] < tx < view[18]
    inside_y = view[19] < ty < view[20]
    tx = min(max(tx, view[17]), view[18])
    ty = min(max(ty, view[19]), view[20])
    j0, j1 = view[12] * over, view[13] * over
    return j0, -j0 * tx, j1, -j1 * ty, inside_x, inside_y


@device_function
def jacobian_rows(
    view: Any, j0: float, j02: float, j1: float, j12: float
) -> tuple[float, float, float, float, float, float]:
    """Return the rows p and q of the Jacobian times the camera's rotation."""
    return (
        j0 * view[0] + j02 * view[6],
        j0 * view[1] + j02 * view[7],
        j0 * view[2] + j02 * view[8],
        j1 * view[3] + j12 * view[6],
        j1 * view[4] + j12 * view[7],
        j1 * view[5] + j12 * view[8],
    )


@device_function
def determinants(pq: Any, r: Any, s0: float, s1: float, s2: float, trace: float) -> tuple[float, float]:
    """Return the determinant of the projected covariance, without and with the dilation."""
    c0 = pq[1] * pq[5] - pq[2] * pq[4]
    c1 = pq[2] * pq[3] - pq[0] * pq[5]
    c2 = pq[0] * pq[4] - pq[1] * pq[3]
    w0 = s1 * s2 * (r[0] * c0 + r[3] * c1 + r[6] * c2)
    w1 = s2 * s0 * (r[1] * c0 + r[4] * c1 + r[7] * c2)
    w2 = s0 * s1 * (r[2] * c0 + r[5] * c1 + r[8] * c2)
    bare = w0 * w0 + w1 * w1 + w2 * w2
    return bare, bare + DILATION * trace + DILATION * DILATION


@device_function
def compensation(bare: float, dilated: float) -> float:
    """Return the factor of the opacity in the antialiased mode, which compensates for the dilation."""
    return math.sqrt(max(bare / dilated, COMPENSATION_MIN))


@device_function
def view_direction(view: Any, mean: Any) -> tuple[float, float, float, float]:
    """Return the unit direction from the camera to a point, and 1 / the distance."""
    x, y, z = mean[0] - view[21], mean[1] - view[22], mean[2] - view[23]
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@device_function
def is_finite_shape(i: int, means: Any, quats: Any, scales: Any, opacities: Any) -> bool:
    """Return True if all values of a splat except its colour are finite."""
    total = opacities[i] - opacities[i]  # NaN if the value is NaN or infinite
    total += (means[i, 0] - means[i, 0]) + (means[i, 1] - means[i, 1]) + (means[i, 2] - means[i, 2])
    total += (scales[i, 0] - scales[i, 0]) + (scales[i, 1] - scales[i, 1]) + (scales[i, 2] - scales[i, 2])
    total += (quats[i, 0] - quats[i, 0]) + (quats[i, 1] - quats[i, 1])
    total += (quats[i, 2] - quats[i, 2]) + (quats[i, 3] - quats[i, 3])
    return bool(total == 0.0)


@device_function
def is_finite_colour(i: int, sh0: Any, shN: Any, higher: int) -> bool:
    """Return True if the SH coefficients of a splat up to the rendered degree are finite."""
    total = (sh0[i, 0] - sh0[i, 0]) + (sh0[i, 1] - sh0[i, 1]) + (sh0[i, 2] - sh0[i, 2])
    for k in range(higher):
        total += (shN[i, k, 0] - shN[i, k, 0]) + (shN[i, k, 1] - shN[i, k, 1]) + (shN[i, k, 2] - shN[i, k, 2])
    return bool(total == 0.0)


@device_function
def is_outside(at: float, size: int, squared_reach: float) -> bool:
    """Return True if the interval of half-length √squared_reach around `at` is more than 1 pixel outside 0..size."""
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
    """Project every splat; parallel over blocks of splats, not vectorised.

    Args:
        means, quats, scales, opacities, sh0, shN: the splats, float32 or float64; quaternions of any length, scales as
            logarithms, shN [N, K, 3] with K at least (degree + 1)**2 - 1.
        degree: SH degree to evaluate.
        view: [24], see `view_vector`.
        width, height: size of the image, pixels.
        antialiased: compensate for the dilation.
        alpha_min: smallest alpha that is drawn.
        shape: [N, 10] float64, written for splats in view: centre x and y, inverse covariance a b c (Σ⁻¹ = (a, b; b,
            c)), opacity, red, green, blue, depth.
        extent: [N, 6] float64, written, see the equations above: B / C, ρ √(det Σ / C), 1 / (ρ √C), ρ B / √A; centre x
            and y.
        box: [N, 4] int32, written: pixels that the splat may touch, columns x0 to x1 - 1 and rows y0 to y1 - 1.
        depth: [N] float32, written: depth; 0 for splats that are not drawn.
        radii: [N] float32, written: 3 standard deviations along the longest axis; 0 for splats that are not drawn.
        ignored: [ceil(N / BLOCK)] int64, written: number of splats with NaN or infinity.
    """
    n = means.shape[0]
    higher = (degree + 1) * (degree + 1) - 1
    basis = np.empty(BASIS_SIZE, np.float64)
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        bad = 0
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            depth[i], radii[i] = 0.0, 0.0
            if not is_finite_shape(i, means, quats, scales, opacities):
                bad += 1
                continue
            X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            z = view[6] * X + view[7] * Y + view[8] * Z + view[11]
            if not (z > view[16] and opacities[i] >= alpha_min):
                bad += not is_finite_colour(i, sh0, shN, higher)
                continue
            x = view[0] * X + view[1] * Y + view[2] * Z + view[9]
            y = view[3] * X + view[4] * Y + view[5] * Z + view[10]
            px = view[12] * (x / z) + view[14]
            py = view[13] * (y / z) + view[15]
            s0, s1, s2 = (
                standard_deviation(scales[i, 0]),
                standard_deviation(scales[i, 1]),
                standard_deviation(scales[i, 2]),
            )
            j0, j02, j1, j12, _, _ = perspective_jacobian(view, x, y, z)
            pq = jacobian_rows(view, j0, j02, j1, j12)
            p0, p1, p2, q0, q1, q2 = pq
            opacity = np.float64(opacities[i])
            reach = 2.0 * math.log(opacity / alpha_min)
            # Early rejection: |u|² ≤ (max s)² |p|², |v|² ≤ (max s)² |q|².
            longest = max(s0, s1, s2)
            longest_squared = longest * longest
            most_a, most_c = p0 * p0 + p1 * p1 + p2 * p2, q0 * q0 + q1 * q1 + q2 * q2
            if is_outside(px, width, reach * (longest_squared * most_a + DILATION)) or is_outside(
                py, height, reach * (longest_squared * most_c + DILATION)
            ):
                bad += not is_finite_colour(i, sh0, shN, higher)
                continue
            qw, qx, qy, qz, _ = unit_quaternion(quats[i])
            r = rotation_matrix(qw, qx, qy, qz)
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
                bad += not is_finite_colour(i, sh0, shN, higher)
                continue
            # ρ, slightly enlarged so that rounding never loses a pixel.
            reach = math.sqrt(reach) * (1.0 + _REACH_MARGIN) + _REACH_MARGIN
            root_a, root_c = math.sqrt(A), math.sqrt(C)
            rx, ry = reach * root_a, reach * root_c
            x0 = math.ceil(min(max(px - rx - 0.5, 0.0), np.float64(width)))
            x1 = math.floor(min(max(px + rx + 0.5, 0.0), np.float64(width)))
            y0 = math.ceil(min(max(py - ry - 0.5, 0.0), np.float64(height)))
            y1 = math.floor(min(max(py + ry + 0.5, 0.0), np.float64(height)))
            if x1 <= x0 or y1 <= y0:
                bad += not is_finite_colour(i, sh0, shN, higher)
                continue
            dx, dy, dz, _ = view_direction(view, means[i])
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


_MAX_GRADIENT = 1e37  # gradients are clamped to ± this so that sums of them fit in float32


@device_function
def _clamp(value: float) -> float:
    """Return a gradient clamped to ± `_MAX_GRADIENT`; 0 for NaN."""
    if not (abs(value) <= _MAX_GRADIENT):
        if value > 0.0:
            return _MAX_GRADIENT
        return -_MAX_GRADIENT if value < 0.0 else 0.0
    return value


@device_function
def sum_records(begin: int, end: int, records: Any, tiles: Any, tiles_x: int, shape: Any, i: int) -> tuple[float, ...]:
    """Sum the gradient records of a splat over its tiles.

    Let D be the vector from the splat's centre to the tile's, δ the vector from the tile's centre to a pixel, and
    e = Σ⁻¹ (D + δ). The sums of slope·e and slope·e eᵀ follow from the moments Σ slope·(1, δ, δ δᵀ) in the record.

    Returns:
        Sums over the pixels of: slope, slope·e_x, slope·e_y, slope·e_x², slope·e_x·e_y, slope·e_y², and the gradients
        with respect to red, green, blue and depth.
    """
    a, b, c = shape[i, 2], shape[i, 3], shape[i, 4]
    s0, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mxx, mxy, myy = 0.0, 0.0, 0.0
    red, green, blue, far = 0.0, 0.0, 0.0, 0.0
    for j in range(begin, end):
        tile = tiles[j]
        dx = (tile % tiles_x) * TILE + 0.5 * TILE - shape[i, 0]
        dy = (tile // tiles_x) * TILE + 0.5 * TILE - shape[i, 1]
        # Σ⁻¹ D first: the result is small in tiles in which the splat is visible.
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
    """Compute the gradients of every splat's parameters; parallel over blocks of splats, not vectorised.

    Args:
        means, quats, scales, opacities, shN, degree, view, antialiased, shape: as in `project`.
        depth: [N] float32, above 0 for splats that are drawn.
        offsets: [N + 1] int64, index of each splat's first record.
        records: [intersections, RECORD], see `blend_backward`.
        record_tiles: [intersections] int32, the tile of each record.
        tiles_x: number of tiles per row.
        g_means, g_quats, g_scales, g_opacities, g_sh0, g_shN: written, gradients, see `Gradients`.
        g_means2d: [N], written, norm of the gradient with respect to the centre on the image, per pixel.
    """
    n = means.shape[0]
    higher = (degree + 1) * (degree + 1) - 1
    basis, weights = np.empty(BASIS_SIZE, np.float64), np.empty(BASIS_SIZE, np.float64)
    for block in range(lane, (n + BLOCK - 1) // BLOCK, lanes):
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            g_means[i], g_quats[i], g_scales[i], g_opacities[i], g_sh0[i], g_means2d[i] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            g_shN[i] = 0.0
            if not (depth[i] > 0.0 and offsets[i + 1] > offsets[i]):
                continue
            s0_, sx, sy, sxx, sxy, syy, red, green, blue, far = sum_records(
                offsets[i], offsets[i + 1], records, record_tiles, tiles_x, shape, i
            )
            g_means2d[i] = _clamp(math.sqrt(sx * sx + sy * sy))

            # Recompute intermediate values of `project`.
            X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            x = view[0] * X + view[1] * Y + view[2] * Z + view[9]
            y = view[3] * X + view[4] * Y + view[5] * Z + view[10]
            z = view[6] * X + view[7] * Y + view[8] * Z + view[11]
            qw, qx, qy, qz, q_inverse = unit_quaternion(quats[i])
            r = rotation_matrix(qw, qx, qy, qz)
            s0, s1, s2 = (
                standard_deviation(scales[i, 0]),
                standard_deviation(scales[i, 1]),
                standard_deviation(scales[i, 2]),
            )
            j0, j02, j1, j12, inside_x, inside_y = perspective_jacobian(view, x, y, z)
            pq = jacobian_rows(view, j0, j02, j1, j12)
            p0, p1, p2, q0, q1, q2 = pq
            u0 = s0 * (r[0] * p0 + r[3] * p1 + r[6] * p2)
            u1 = s1 * (r[1] * p0 + r[4] * p1 + r[7] * p2)
            u2 = s2 * (r[2] * p0 + r[5] * p1 + r[8] * p2)
            v0 = s0 * (r[0] * q0 + r[3] * q1 + r[6] * q2)
            v1 = s1 * (r[1] * q0 + r[4] * q1 + r[7] * q2)
            v2 = s2 * (r[2] * q0 + r[5] * q1 + r[8] * q2)

            # g_A, g_B, g_C and g_opacity.
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
            g_opacities[i] = _clamp(s0_ / np.float64(opacities[i]))

            # g_u and g_v, then g_log(s), g_r and the quaternion, g_p and g_q, g_J.
            du0, dv0 = 2.0 * gA * u0 + gB * v0, 2.0 * gC * v0 + gB * u0
            du1, dv1 = 2.0 * gA * u1 + gB * v1, 2.0 * gC * v1 + gB * u1
            du2, dv2 = 2.0 * gA * u2 + gB * v2, 2.0 * gC * v2 + gB * u2
            if abs(scales[i, 0]) < LOG_SCALE_LIMIT:
                g_scales[i, 0] = _clamp(du0 * u0 + dv0 * v0)
            if abs(scales[i, 1]) < LOG_SCALE_LIMIT:
                g_scales[i, 1] = _clamp(du1 * u1 + dv1 * v1)
            if abs(scales[i, 2]) < LOG_SCALE_LIMIT:
                g_scales[i, 2] = _clamp(du2 * u2 + dv2 * v2)
            du0, dv0, du1, dv1, du2, dv2 = du0 * s0, dv0 * s0, du1 * s1, dv1 * s1, du2 * s2, dv2 * s2
            r00, r10, r20 = du0 * p0 + dv0 * q0, du0 * p1 + dv0 * q1, du0 * p2 + dv0 * q2
            r01, r11, r21 = du1 * p0 + dv1 * q0, du1 * p1 + dv1 * q1, du1 * p2 + dv1 * q2
            r02, r12, r22 = du2 * p0 + dv2 * q0, du2 * p1 + dv2 * q1, du2 * p2 + dv2 * q2
            gw = 2.0 * (qx * (r21 - r12) + qy * (r02 - r20) + qz * (r10 - r01))
            gx = 2.0 * (qw * (r21 - r12) + qy * (r10 + r01) + qz * (r20 + r02)) - 4.0 * qx * (r11 + r22)
            gy = 2.0 * (qw * (r02 - r20) + qx * (r10 + r01) + qz * (r21 + r12)) - 4.0 * qy * (r00 + r22)
            gz = 2.0 * (qw * (r10 - r01) + qx * (r20 + r02) + qy * (r21 + r12)) - 4.0 * qz * (r00 + r11)
            radial = gw * qw + gx * qx + gy * qy + gz * qz
            g_quats[i, 0] = _clamp((gw - radial * qw) * q_inverse)
            g_quats[i, 1] = _clamp((gx - radial * qx) * q_inverse)
            g_quats[i, 2] = _clamp((gy - radial * qy) * q_inverse)
            g_quats[i, 3] = _clamp((gz - radial * qz) * q_inverse)
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

            # g_c: through the centre on the image, the depth and the Jacobian.
            cx, cy = sx * j0, sy * j1
            cz = far - (sx * j0 * x + sy * j1 * y) / z
            cz -= (g_j0 * j0 + g_j02 * j02 + g_j1 * j1 + g_j12 * j12) / z
            if inside_x:
                cx -= g_j02 * j0 / z
                cz -= g_j02 * j02 / z
            if inside_y:
                cy -= g_j12 * j1 / z
                cz -= g_j12 * j12 / z

            # g_sh0 and g_shN, and g_mean through the viewing direction.
            dx, dy, dz, inverse = view_direction(view, means[i])
            sh_basis(degree, dx, dy, dz, basis)
            red = red if shape[i, 6] > 0.0 else 0.0
            green = green if shape[i, 7] > 0.0 else 0.0
            blue = blue if shape[i, 8] > 0.0 else 0.0
            g_sh0[i, 0] = _clamp(basis[0] * red)
            g_sh0[i, 1] = _clamp(basis[0] * green)
            g_sh0[i, 2] = _clamp(basis[0] * blue)
            weights[0] = 0.0
            for k in range(higher):
                g_shN[i, k, 0] = _clamp(basis[k + 1] * red)
                g_shN[i, k, 1] = _clamp(basis[k + 1] * green)
                g_shN[i, k, 2] = _clamp(basis[k + 1] * blue)
                weights[k + 1] = red * shN[i, k, 0] + green * shN[i, k, 1] + blue * shN[i, k, 2]
            wx, wy, wz = sh_basis_gradient(degree, dx, dy, dz, weights)
            radial = wx * dx + wy * dy + wz * dz
            wx, wy, wz = (wx - radial * dx) * inverse, (wy - radial * dy) * inverse, (wz - radial * dz) * inverse
            g_means[i, 0] = _clamp(view[0] * cx + view[3] * cy + view[6] * cz + wx)
            g_means[i, 1] = _clamp(view[1] * cx + view[4] * cy + view[7] * cz + wy)
            g_means[i, 2] = _clamp(view[2] * cx + view[5] * cy + view[8] * cz + wz)
