"""The numbers that rasteriser and exact twin share, and the three modes.

They are those of the first published implementation of Gaussian splatting: alpha = opacity ·
exp(−½ dᵀ Σ⁻¹ d) with Σ the projected covariance plus `DILATION`, capped at `ALPHA_CAP`, left out
below `ALPHA_MIN`; splats blended front to back in the order of float32 depth, then of index, until
the next one would bring the transmittance below `TRANSMITTANCE_MIN`; colour = spherical harmonics
+ ½, at least 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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

#: The perspective is linearised at most this far outside the picture, in half-widths of it.
FOV_MARGIN = 0.3

#: Log-scales count as if they lay within this of 0 (a factor of 5e34): all products stay finite.
LOG_SCALE_LIMIT = 80.0

#: Smallest ratio of determinants from which the antialiased mode computes its compensation.
COMPENSATION_MIN = 0.000025

Mode = Literal["exact", "standard", "fast"]
MODES: tuple[Mode, ...] = ("exact", "standard", "fast")


@dataclass(frozen=True)
class Settings:
    """Thresholds of a mode: the smallest alpha that is drawn, and the transmittance at which a pixel is finished."""

    alpha_min: float
    transmittance_min: float


_SETTINGS = {
    "standard": Settings(ALPHA_MIN, TRANSMITTANCE_MIN),
    # A larger smallest alpha shrinks every splat; what shines through with less than 1/255 is left out.
    "fast": Settings(1.5 * ALPHA_MIN, ALPHA_MIN),
}


def settings_of(mode: str) -> Settings:
    """Settings of a mode of the rasteriser.

    Raises:
        InputError: there is no such mode, or it is the twin's.
    """
    if mode not in _SETTINGS:
        raise InputError(f"the rasteriser's mode is {mode!r}, wanted one of {', '.join(_SETTINGS)}")
    return _SETTINGS[mode]


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
