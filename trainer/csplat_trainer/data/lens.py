# SPDX-License-Identifier: Apache-2.0
"""Lenses: the position of an undistorted image's pixel in the original, and the pinhole of the undistorted image.

A lens maps directions (x, y), with z = 1 ahead, to the image plane in two steps: a projection (perspective, equidistant
for fisheyes, or the FOV model), then a distortion of OpenCV's form:
https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html. All but the newest models of COLMAP are special cases:
https://github.com/colmap/colmap/blob/main/src/colmap/sensor/models.h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from csplat.errors import InputError
from csplat.types import F64

_ZOOM_STEP = 0.005
_MAX_ZOOM = 1.5
_BORDER_POINTS = 65
_RAY_POINTS = 33  # points per ray from the principal point to the border
_RAYS = 9  # rays to each side
#: Command that undistorts images of every lens that COLMAP supports.
UNDISTORTER = "`colmap image_undistorter --image_path IMAGES --input_path SPARSE --output_path OUT`"

#: Advice on images that show all directions, which no undistortion turns into one perspective image.
SPLIT_PANORAMAS = (
    "split panoramas into perspective images first, with panorama_sfm.py of COLMAP or `ns-process-data images"
    " --camera-type equirectangular`"
)

_BORDER_TOLERANCE = 1e-6  # pixels, for rounding
_SMALL = 1e-8  # radius below which a projection is its limit


@dataclass(frozen=True)
class Lens:
    """A camera's lens, for images of one size.

    Attributes:
        width, height: size of the images that the parameters apply to, pixels.
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels; the centre of the first pixel is at 0.5.
        radial: k1, k2, …: factors of r², r⁴, … in the radial polynomial.
        tangential: p1, p2.
        divisor: k4, k5, k6 of OpenCV's rational model: factors of the polynomial in the denominator.
        prism: sx1, sy1 of thin prisms.
        projection: projection that precedes the distortion.
        omega: parameter of the FOV model (Devernay and Faugeras 2001), radians.
        source: file and place that specify the lens, for messages.
    """

    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    divisor: tuple[float, ...] = ()
    prism: tuple[float, float] = (0.0, 0.0)
    projection: Literal["perspective", "equidistant", "fov"] = "perspective"
    omega: float = 0.0
    source: str = field(default="", compare=False)

    def scaled(self, width: int, height: int) -> Lens:
        """Return the lens for images of another size; each axis is scaled separately."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    @property
    def distorts(self) -> bool:
        """True if the lens is more than a pinhole."""
        factors = (*self.radial, *self.tangential, *self.divisor, *self.prism)
        return self.projection != "perspective" or any(value != 0.0 for value in factors)


def is_panorama(model: str) -> bool:
    """Return True for the name of a camera model whose images show all directions."""
    return model.upper() in {"EQUIRECTANGULAR", "SPHERICAL", "PANORAMA"}


@lru_cache(maxsize=64)  # images of a set share a few lenses
def undistorted_lens(lens: Lens) -> Lens:
    """Return the pinhole camera of a lens's undistorted images.

    The focal lengths grow in steps of 0.5 % until every pixel of the undistorted image maps into the distorted image,
    and no two to the same place, so that no pixel is undefined. The border of a fisheye image is cut off.

    Raises:
        InputError: no reasonable zoom achieves this, so the parameters are implausible.
    """
    zoom = 1.0
    while zoom <= _MAX_ZOOM:
        straight = Lens(lens.width, lens.height, lens.fx * zoom, lens.fy * zoom, lens.cx, lens.cy)
        if _border_is_inside(lens, straight) and _is_one_to_one(lens, straight):
            return straight
        zoom += _ZOOM_STEP
    where = f"{lens.source}: " if lens.source else ""
    names = ("radial", "tangential", "divisor", "prism", "omega")
    distortion = ", ".join(f"{name} {getattr(lens, name)}" for name in names if np.any(getattr(lens, name)))
    raise InputError(
        f"{where}the distortion ({distortion}) cannot be undone over the whole image: it folds, or requires a zoom of "
        f"more than {_MAX_ZOOM:g} to hide the border; check its parameters, or use {UNDISTORTER}"
    )


def distorted(u: F64, v: F64, lens: Lens, straight: Lens) -> tuple[F64, F64]:
    """Return the positions of pixels of the undistorted image in the distorted image.

    Args:
        u, v: horizontal and vertical pixel coordinates, of any shape.
        lens: lens of the original.
        straight: pinhole of the undistorted image.
    """
    x, y = (u - straight.cx) / straight.fx, (v - straight.cy) / straight.fy
    if lens.projection != "perspective":
        nearer = _projection_factor(np.hypot(x, y), lens)
        x, y = x * nearer, y * nearer
    r2 = x * x + y * y
    radial = 1.0 + _polynomial(lens.radial, r2)
    if any(lens.divisor):
        radial = radial / (1.0 + _polynomial(lens.divisor, r2))
    p1, p2 = lens.tangential
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    if any(lens.prism):
        xd, yd = xd + lens.prism[0] * r2, yd + lens.prism[1] * r2
    return lens.fx * xd + lens.cx, lens.fy * yd + lens.cy


def _projection_factor(r: F64, lens: Lens) -> F64:
    """Return the projected radius of directions, divided by the tangents of their angles, `r`, of any shape.

    The lens is equidistant or FOV; an omega near 0 is a pinhole, with the factor 1.
    """
    tangent, scale = (2.0 * math.tan(lens.omega / 2.0), lens.omega) if lens.projection == "fov" else (1.0, 1.0)
    if abs(scale) < _SMALL:
        return np.ones_like(r)
    safe = np.maximum(r, _SMALL)
    return np.asarray(np.arctan(safe * tangent) / (safe * scale), np.float64)


def _polynomial(factors: tuple[float, ...], r2: F64) -> F64:
    """Return factors[0] r² + factors[1] r⁴ + …, by Horner's rule, skipping zeros at the end; 0 without factors."""
    last = max((i for i, factor in enumerate(factors) if factor != 0.0), default=0)
    total = r2 * (factors[last] if factors else 0.0)
    for factor in reversed(factors[:last]):
        total = r2 * (factor + total)
    return total


def _border(lens: Lens, count: int) -> tuple[F64, F64]:
    """Return u and v of `count` centres of pixels along each of the four sides, [4 count]."""
    u = np.linspace(0.5, lens.width - 0.5, count)
    v = np.linspace(0.5, lens.height - 0.5, count)
    ends_u, ends_v = np.repeat(u[[0, -1]], count), np.repeat(v[[0, -1]], count)
    return np.concatenate([ends_u, u, u]), np.concatenate([np.tile(v, 2), ends_v])


def _border_is_inside(lens: Lens, straight: Lens) -> bool:
    """Return True if the border of the undistorted image is within the distorted image."""
    x, y = distorted(*_border(lens, _BORDER_POINTS), lens, straight)
    margin = 0.5 - _BORDER_TOLERANCE  # colours are valid up to half a pixel beyond the outermost centres
    inside = (x >= 0.5 - margin) & (x <= lens.width - 0.5 + margin)
    inside &= (y >= 0.5 - margin) & (y <= lens.height - 0.5 + margin)
    return bool(inside.all())


def _is_one_to_one(lens: Lens, straight: Lens) -> bool:
    """Return True if distances from the principal point do not fall along rays, as they may with polynomials."""
    u, v = _border(lens, _RAYS)
    along = np.linspace(0.0, 1.0, _RAY_POINTS)[:, None]
    x, y = distorted(lens.cx + along * (u - lens.cx), lens.cy + along * (v - lens.cy), lens, straight)
    distances = np.hypot((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
    return bool((np.diff(distances, axis=0) >= 0.0).all())
