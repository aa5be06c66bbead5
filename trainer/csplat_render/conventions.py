# SPDX-License-Identifier: Apache-2.0
"""Shared definitions of the rasteriser and its exact reference: constants, modes, splats and results.

The conventions follow INRIA's implementation (Kerbl et al., 3D Gaussian Splatting, 2023):

    alpha = min(opacity · exp(−½ dᵀ Σ⁻¹ d), ALPHA_CAP), and 0 below ALPHA_MIN
    Σ = projected covariance + DILATION · I
    colour = max(Σ_k Y_k(direction) · sh_k + ½, 0)

Splats are blended front to back by float32 depth, then by index. A pixel is finished before the splat that would bring
its transmittance below `TRANSMITTANCE_MIN`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.model import sh_degree_of
from csplat_render.camera import Camera

#: Square pixels, added to both variances of the projected covariance.
DILATION = 0.3

#: Maximum alpha of a splat in a pixel.
ALPHA_CAP = 0.99

#: Splats with a smaller alpha in a pixel do not contribute to it.
ALPHA_MIN = 1.0 / 255.0

#: Transmittance below which a pixel never falls.
TRANSMITTANCE_MIN = 1e-4

#: Distance outside the image up to which the perspective is linearised, as a multiple of half the image's size.
FOV_MARGIN = 0.3

#: Log scales are clamped to ± this (a factor of 5e34) so that all products are finite.
LOG_SCALE_LIMIT = 80.0

#: Minimum ratio of determinants in the compensation of the antialiased mode.
COMPENSATION_MIN = 0.000025

Mode = Literal["exact", "standard", "fast"]
MODES: tuple[Mode, ...] = ("exact", "standard", "fast")

#: The CPU; a GPU; a GPU if there is one, otherwise the CPU; or the GPU's shaders on the CPU, for tests.
Backend = Literal["cpu", "gpu", "auto", "software"]


_THRESHOLDS = {
    "standard": (ALPHA_MIN, TRANSMITTANCE_MIN),
    "fast": (1.5 * ALPHA_MIN, ALPHA_MIN),  # shrinks every splat, and omits light of a transmittance below 1/255
}


def thresholds_of(mode: str) -> tuple[float, float]:
    """Return the minimum alpha and the minimum transmittance of a mode of the rasteriser.

    Raises:
        InputError: the rasteriser has no such mode.
    """
    if mode not in _THRESHOLDS:
        raise InputError(f"the rasteriser's mode is {mode!r}, expected one of {', '.join(_THRESHOLDS)}")
    return _THRESHOLDS[mode]


def view_vector(camera: Camera) -> NDArray[np.float64]:
    """Return the parameters of a camera for the compiled library.

    Returns:
        [24] float64: rotation (9, row by row), translation, fx, fy, cx, cy, near plane, bounds of x/z and of y/z within
        which the perspective is linearised, camera position.
    """
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    margin_x, margin_y = FOV_MARGIN * 0.5 * camera.W / fx, FOV_MARGIN * 0.5 * camera.H / fy
    limits = [
        -cx / fx - margin_x,
        (camera.W - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (camera.H - cy) / fy + margin_y,
    ]
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    return np.array([*R.ravel(), *t, fx, fy, cx, cy, camera.near, *limits, *camera.position], np.float64)


Array = NDArray[Any]


class HasSplats(Protocol):
    """An object with the arrays of splats, such as a `SplatModel` or `UncheckedSplats`."""

    @property
    def means(self) -> Array: ...  # noqa: D102 - as in `UncheckedSplats`
    @property
    def quats(self) -> Array: ...  # noqa: D102 - as in `UncheckedSplats`
    @property
    def scales(self) -> Array: ...  # noqa: D102 - as in `UncheckedSplats`
    @property
    def opacities(self) -> Array: ...  # noqa: D102 - as in `UncheckedSplats`
    @property
    def sh0(self) -> Array: ...  # noqa: D102 - as in `UncheckedSplats`
    @property
    def shN(self) -> Array: ...  # noqa: D102, N802 - as in `UncheckedSplats`


@dataclass(frozen=True, eq=False)
class UncheckedSplats:
    """The arrays of N splats with unchecked values: splats with NaN or infinity are not drawn.

    Attributes:
        means: [N, 3], centres.
        quats: [N, 4], rotations w x y z, of any length.
        scales: [N, 3], natural logarithms of the standard deviations.
        opacities: [N], alpha.
        sh0: [N, 3].
        shN: [N, K, 3], K = 0, 3, 8, 15 or 24.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array


def checked_splats(splats: HasSplats) -> UncheckedSplats:
    """Convert the arrays to C-contiguous arrays of float32, and check their shapes."""
    means = np.ascontiguousarray(splats.means, np.float32)
    n = len(means) if means.ndim else 0
    shapes: dict[str, tuple[int, ...]] = {
        "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh0": (n, 3)
    }  # fmt: skip
    arrays = {name: np.ascontiguousarray(getattr(splats, name), np.float32) for name in (*shapes, "shN")}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise InputError(f"{name} has shape {list(arrays[name].shape)}, expected {list(shape)}")
    shN = arrays["shN"]
    if shN.ndim != 3 or shN.shape[::2] != (n, 3):
        raise InputError(f"shN has shape {list(shN.shape)}, expected [{n}, K, 3]")
    sh_degree_of(shN.shape[1])
    return UncheckedSplats(**arrays)


def checked_degree(sh_degree: int | None, coefficient_count: int) -> int:
    """Return the SH degree to render, at most the degree of the coefficients."""
    available = sh_degree_of(coefficient_count)
    if sh_degree is None:
        return available
    if sh_degree < 0:
        raise InputError(f"sh_degree is {sh_degree}, expected 0 or more")
    return min(sh_degree, available)


def checked_background(background: ArrayLike) -> Array:
    """Return a background as an array of three finite numbers, float32."""
    colour: Array = np.zeros(0, np.float32)
    with suppress(TypeError, ValueError):
        colour = np.asarray(background, np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InputError(f"the background is {background!r}, expected red, green and blue")
    return colour


class Render(Protocol):
    """A rendered image, by any backend."""

    @property
    def rgb(self) -> Array: ...  # noqa: D102 - as in `RenderResult`
    @property
    def alpha(self) -> Array: ...  # noqa: D102 - as in `RenderResult`
    @property
    def ignored(self) -> int: ...  # noqa: D102 - as in `RenderResult`


@dataclass(frozen=True, eq=False)
class RenderResult:
    """An image rendered on the CPU.

    Attributes:
        rgb: [H, W, 3], not clipped: colours may exceed 1.
        alpha: [H, W], 1 − transmittance.
        depth: [H, W], sum of weight · depth, not divided by alpha.
        radii: [N] float32, pixels, 3 standard deviations of each splat along its longest axis; 0 if it is not drawn.
        drawn: number of splats in view.
        intersections: number of pairs of splat and tile; the time is proportional to it.
        ignored: number of splats with NaN or infinity.
    """

    rgb: Array = field(repr=False)
    alpha: Array = field(repr=False)
    depth: Array = field(repr=False)
    radii: Array = field(repr=False)
    drawn: int
    intersections: int
    ignored: int


@dataclass(frozen=True, eq=False)
class VisibleSplats:
    """The splats that are visible in a render.

    Attributes:
        near: [N] float32, depths by which splats are sorted; 0 for splats that are not drawn.
        tiles: [N] integers, number of tiles that each splat may touch; 0 for splats that are not drawn.
        ignored: number of splats with NaN or infinity.
    """

    near: Array
    tiles: Array
    ignored: int


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of a loss with respect to the splats; the rasteriser's next gradients overwrite the arrays.

    Attributes:
        means: [N, 3].
        quats: [N, 4], through the normalisation.
        scales: [N, 3], with respect to the logarithms.
        opacities: [N], with respect to alpha, or to logits if these were rendered.
        sh0: [N, 3].
        shN: [N, K, 3], 0 above the rendered degree.
        means2d: [N], norm of the gradient with respect to the centre on the image, per pixel.
        radii: [N] float32, see `RenderResult`.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array
    means2d: Array
    radii: Array
