"""Definitions that the rasteriser and its exact reference share: constants, modes, splats, and results.

The constants are those of the first published implementation of Gaussian splatting: alpha = opacity ·
exp(−½ dᵀ Σ⁻¹ d) with Σ the projected covariance plus `DILATION`, capped at `ALPHA_CAP`, left out below `ALPHA_MIN`;
splats are blended front to back in the order of float32 depth, then of index, until the next one would bring the
transmittance below `TRANSMITTANCE_MIN`; colour = spherical harmonics + ½, at least 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat_render.camera import Camera

#: Added to both variances of the projected covariance, in square pixels.
DILATION = 0.3

#: A splat covers a pixel with at most this alpha.
ALPHA_CAP = 0.99

#: A splat does not touch a pixel that it covers with less than this alpha.
ALPHA_MIN = 1.0 / 255.0

#: A pixel is finished before the splat that would bring its transmittance below this.
TRANSMITTANCE_MIN = 1e-4

#: The perspective is linearised at most this far outside the image, in half-widths of the image.
FOV_MARGIN = 0.3

#: Log-scales are clamped to this distance from 0 (a factor of 5e34), so that all products are finite.
LOG_SCALE_LIMIT = 80.0

#: Smallest ratio of determinants from which the antialiased mode computes its compensation.
COMPENSATION_MIN = 0.000025

Mode = Literal["exact", "standard", "fast"]
MODES: tuple[Mode, ...] = ("exact", "standard", "fast")


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of a mode: the smallest alpha that is drawn, and the transmittance at which a pixel is finished."""

    alpha_min: float
    transmittance_min: float


_THRESHOLDS = {
    "standard": Thresholds(ALPHA_MIN, TRANSMITTANCE_MIN),
    # A larger minimum of alpha shrinks every splat; light that passes with less than 1/255 is left out.
    "fast": Thresholds(1.5 * ALPHA_MIN, ALPHA_MIN),
}


def thresholds_of(mode: str) -> Thresholds:
    """Return the thresholds of a mode of the rasteriser.

    Raises:
        InputError: there is no such mode, or it is that of the exact reference.
    """
    if mode not in _THRESHOLDS:
        raise InputError(f"the rasteriser's mode is {mode!r}, expected one of {', '.join(_THRESHOLDS)}")
    return _THRESHOLDS[mode]


def view_vector(camera: Camera) -> NDArray[np.float64]:
    """Return the numbers of a camera that the kernels need, in one row.

    Returns:
        [24] float64: rotation (9, row by row), translation, fx, fy, cx, cy, near plane, smallest
        and largest x/z and y/z at which the perspective is linearised, camera position.
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
    """Anything that can be rendered: a `SplatModel`, `UncheckedSplats`, or any object with these arrays."""

    @property
    def means(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def quats(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def scales(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def opacities(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def sh0(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def shN(self) -> Array: ...  # noqa: D102, N802 - as in Splats


@dataclass(frozen=True, eq=False)
class UncheckedSplats:
    """The arrays of N splats, of which only the shapes are checked: rows that hold NaN are not drawn.

    Attributes:
        means: [N, 3], centres.
        quats: [N, 4], rotations w x y z, of any length.
        scales: [N, 3], natural logarithms of the standard deviations.
        opacities: [N], alpha.
        sh0: [N, 3].
        shN: [N, K, 3], K = 0, 3, 8 or 15.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array


@dataclass(frozen=True, eq=False)
class RenderResult:
    """A rendered image.

    Attributes:
        rgb: [H, W, 3], not clipped: colours may exceed 1.
        alpha: [H, W], 1 − transmittance.
        depth: [H, W], sum of weight · depth, not divided by alpha.
        radii: [N] float32, 3 standard deviations of each splat along its longest axis, in pixels;
            0 for splats that are not drawn.
        drawn: number of splats in view.
        intersections: number of pairs of splat and tile, to which the time is proportional.
        ignored: number of splats that hold NaN or infinity.
    """

    rgb: Array
    alpha: Array
    depth: Array
    radii: Array
    drawn: int
    intersections: int
    ignored: int


@dataclass(frozen=True, eq=False)
class VisibleSplats:
    """Splats that are visible in a render.

    Attributes:
        near: [N] float32, depths, by which splats are sorted; 0 for splats that are not drawn.
        tiles: [N] integers, number of tiles that each splat may touch; 0 likewise.
        ignored: number of splats that hold NaN or infinity.
    """

    near: Array
    tiles: Array
    ignored: int


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of a loss; the arrays are the rasteriser's and hold until its next `backward`.

    Attributes:
        means: [N, 3].
        quats: [N, 4], through the normalisation.
        scales: [N, 3], towards the logarithms.
        opacities: [N], towards alpha.
        sh0: [N, 3].
        shN: [N, K, 3]; 0 beyond the degree that was rendered.
        means2d: [N], length of the gradient towards the centre on the image, per pixel.
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
