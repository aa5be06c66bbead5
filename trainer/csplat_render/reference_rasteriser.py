# SPDX-License-Identifier: Apache-2.0
"""The exact reference: renders directly from the equations of `conventions`, in float64 NumPy, slow.

Every splat is evaluated at every pixel. The reference shares the conventions of the rasteriser but none of its methods:
no tiles, no bounds, no fast exponential. Outcomes of comparisons (too faint, capped, finished, clamped, which splat is
nearer) can be recorded and reused, so that finite differences are taken of a smooth function.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.model import sh_degree_of
from csplat.spherical_harmonics import evaluate_sh
from csplat_render.camera import Camera
from csplat_render.conventions import (
    ALPHA_CAP,
    ALPHA_MIN,
    COMPENSATION_MIN,
    DILATION,
    FOV_MARGIN,
    LOG_SCALE_LIMIT,
    TRANSMITTANCE_MIN,
    HasSplats,
    RenderResult,
)

Array = NDArray[Any]

_CHUNK = 64  # splats evaluated at a time


@dataclass
class Decisions:
    """Recorded outcomes of a render's comparisons; `render_exact` reuses them if they are passed in again."""

    order: Array | None = None
    masks: list[Array] = field(default_factory=list)
    _next: int = -1

    def ask(self, mask: Array) -> Array:
        """Record the outcome of a comparison, or return its recorded outcome."""
        if self._next < 0:
            self.masks.append(mask)
            return mask
        self._next += 1
        return self.masks[self._next - 1]

    def replay(self) -> None:
        """Return the recorded outcomes from now on, starting with the first comparison."""
        self._next = 0


def render_exact(
    splats: HasSplats,
    camera: Camera,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    sh_degree: int | None = None,
    transmittance_min: float = TRANSMITTANCE_MIN,
    decisions: Decisions | None = None,
) -> RenderResult:
    """Render the image of `Rasteriser.forward` from the equations.

    Args:
        splats: the splats to render.
        camera: the camera to render from.
        background: red, green, blue of the background.
        antialiased: compensate for the dilation by scaling opacities.
        sh_degree: highest SH degree; `None`: the splats' own degree.
        transmittance_min: transmittance at which a pixel is finished; 0: never.
        decisions: records the outcomes of all comparisons, or replays recorded outcomes.

    Returns:
        The image, float64; `intersections` is 0.
    """
    decisions = Decisions() if decisions is None else decisions
    available = sh_degree_of(splats.shN.shape[1])
    degree = available if sh_degree is None else min(sh_degree, available)
    with np.errstate(all="ignore"):
        order, drawn, ignored = _project(splats, camera, degree, antialiased, decisions)
        rgb, transmittance, depth = _blend(drawn, camera, transmittance_min, decisions)
        radii = np.zeros(len(splats.means), np.float32)
        radii[order] = 3.0 * np.sqrt(np.linalg.eigvalsh(drawn["covariance"])[:, 1])
    rgb += transmittance[..., None] * np.asarray(background, np.float64)
    return RenderResult(rgb, 1.0 - transmittance, depth, radii, len(order), 0, ignored)


def _project(
    splats: HasSplats, camera: Camera, degree: int, antialiased: bool, decisions: Decisions
) -> tuple[Array, dict[str, Array], int]:
    """Project the splats in front of the near plane.

    Returns:
        [n], their indices, nearest first, or in the recorded order. Their projections: `centre` [n, 2], pixels;
        `covariance` [n, 2, 2], square pixels, with its inverse (a b; b c), `a`, `b`, `c` [n]; `opacity` and `depth`
        [n]; `colour` [n, 3]. The number of splats with NaN or infinity, which are ignored.
    """
    coefficients = np.concatenate([splats.sh0[:, None], splats.shN[:, : (degree + 1) ** 2 - 1]], 1, dtype=np.float64)
    arrays = [splats.means, splats.quats, splats.scales, splats.opacities[:, None], coefficients]
    finite = np.all([np.isfinite(array).all(tuple(range(1, array.ndim))) for array in arrays], axis=0)
    index = np.flatnonzero(finite)
    means, quats, scales, opacities, coefficients = (np.asarray(array[index], np.float64) for array in arrays)

    # Camera coordinates, term by term: a matrix product may round differently, which could change the order.
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    X, Y, Z = means.T
    x, y, z = (R[k, 0] * X + R[k, 1] * Y + R[k, 2] * Z + t[k] for k in range(3))
    if decisions.order is None:
        order = np.argsort(z.astype(np.float32), kind="stable")
        decisions.order = order[(z[order] > camera.near) & (z[order].astype(np.float32) < np.inf)]
    order = decisions.order
    means, scales, coefficients, x, y, z = (v[order] for v in (means, scales, coefficients, x, y, z))
    opacity = opacities[order, 0]

    # Σ = M Mᵀ with M = rotation · diag(s); its image under the linearised perspective is (J R M) (J R M)ᵀ.
    w, i, j, k = _unit_quats(quats[order]).T
    rotation = np.array(
        [
            [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
            [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
            [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
        ]
    ).transpose(2, 0, 1)
    M = rotation * np.exp(np.clip(scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))[:, None, :]
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    tx = _clamp_tangent(x / z, fx, cx, camera.W, decisions)
    ty = _clamp_tangent(y / z, fy, cy, camera.H, decisions)
    zero = np.zeros_like(z)
    jacobian = np.array([[fx / z, zero, -fx * tx / z], [zero, fy / z, -fy * ty / z]]).transpose(2, 0, 1)
    half_axes = jacobian @ R @ M
    bare_covariance = half_axes @ half_axes.transpose(0, 2, 1)
    covariance = bare_covariance + DILATION * np.eye(2)
    # Cauchy–Binet: the determinant of A Aᵀ is the sum of the squared 2 × 2 minors of A.
    minors = np.cross(half_axes[:, 0], half_axes[:, 1])
    bare = (minors * minors).sum(1)
    dilated = bare + DILATION * np.trace(bare_covariance, axis1=1, axis2=2) + DILATION**2
    if antialiased:
        ratio = bare / dilated
        opacity = opacity * np.sqrt(np.where(decisions.ask(ratio > COMPENSATION_MIN), ratio, COMPENSATION_MIN))

    direction = means - camera.position
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    colour = np.einsum("nk,nkc->nc", evaluate_sh(degree, direction), coefficients) + 0.5
    colour = np.where(decisions.ask(colour > 0.0), colour, 0.0)
    drawn = {
        "centre": np.stack([fx * x / z + cx, fy * y / z + cy], 1),
        "covariance": covariance,
        "a": covariance[:, 1, 1] / dilated,
        "b": -covariance[:, 0, 1] / dilated,
        "c": covariance[:, 0, 0] / dilated,
        "opacity": opacity,
        "colour": colour,
        "depth": z,
    }
    return index[order], drawn, int(np.count_nonzero(~finite))


def _unit_quats(quats: Array) -> Array:
    """Return quats [n, 4] of unit length; the identity for length 0."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(length > 0.0, quats / length, [1.0, 0.0, 0.0, 0.0])


def _clamp_tangent(tangent: Array, focal: float, centre: float, size: int, decisions: Decisions) -> Array:
    """Clamp tangents x/z or y/z, [n], to the image plus `FOV_MARGIN`; the perspective is linearised there.

    Focal length, centre and size are measured along the axis, in pixels. `decisions` records both comparisons.
    """
    margin = FOV_MARGIN * 0.5 * size / focal
    low, high = -centre / focal - margin, (size - centre) / focal + margin
    return np.where(decisions.ask(tangent > low), np.where(decisions.ask(tangent < high), tangent, high), low)


def _blend(
    drawn: dict[str, Array], camera: Camera, transmittance_min: float, decisions: Decisions
) -> tuple[Array, Array, Array]:
    """Blend the splats of `_project` front to back, `_CHUNK` at a time.

    Returns:
        [H, W, 3], colour without background; [H, W], transmittance; [H, W], sum of weight · depth.
    """
    ys, xs = np.mgrid[: camera.H, : camera.W].reshape(2, -1) + 0.5
    before = np.ones(len(xs))
    rgb, depth = np.zeros((len(xs), 3)), np.zeros(len(xs))
    unfinished = np.ones(len(xs), bool)
    for start in range(0, len(drawn["depth"]), _CHUNK):
        chunk = {name: values[start : start + _CHUNK, None] for name, values in drawn.items()}
        dx, dy = xs - chunk["centre"][..., 0], ys - chunk["centre"][..., 1]
        power = -0.5 * (chunk["a"] * dx * dx + 2.0 * chunk["b"] * dx * dy + chunk["c"] * dy * dy)
        alpha = chunk["opacity"] * np.exp(np.minimum(power, 0.0))
        alpha = np.where(decisions.ask(alpha < ALPHA_CAP), alpha, ALPHA_CAP)
        alpha = np.where(decisions.ask(alpha >= ALPHA_MIN), alpha, 0.0)
        after = before * np.cumprod(1.0 - alpha, axis=0)
        seen = decisions.ask(unfinished & (after >= transmittance_min))
        through = np.concatenate([before[None], after[:-1]])
        weight = np.where(seen, alpha * through, 0.0)
        rgb += np.einsum("sp,sc->pc", weight, chunk["colour"][:, 0])
        depth += (weight * chunk["depth"]).sum(0)
        count = seen.sum(0)  # a finished pixel stays finished, so the first `count` splats are blended
        before = np.where(count > 0, np.take_along_axis(after, np.maximum(count - 1, 0)[None], 0)[0], before)
        unfinished = seen[-1]
    return rgb.reshape(camera.H, camera.W, 3), before.reshape(camera.H, camera.W), depth.reshape(camera.H, camera.W)
