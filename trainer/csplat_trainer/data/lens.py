"""Lenses: the position of an undistorted image's pixel in the original, and the pinhole of the undistorted image.

A lens maps directions (x, y), with z = 1 ahead, to the plane of the image in two steps: a projection (perspective,
equidistant as fisheyes have it, or the FOV model), then a distortion, of OpenCV's form in all of them:
https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html. COLMAP's models but the newest are special cases:
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
_RAY_POINTS = 33  # from the principal point to the border
_RAYS = 9  # to each side
#: Command that straightens images of every lens that COLMAP supports.
UNDISTORTER = "`colmap image_undistorter --image_path IMAGES --input_path SPARSE --output_path OUT`"

_SMALL = 1e-8  # radius below which a projection is its limit


@dataclass(frozen=True)
class Lens:
    """A camera's lens, for images of one size.

    Attributes:
        width: width of the images that the numbers apply to, pixels.
        height: the same.
        fx: focal length across, pixels.
        fy: focal length down, pixels.
        cx: principal point, pixels; the centre of the first pixel lies at 0.5.
        cy: the same.
        radial: k1, k2, …: factors of r², r⁴, … in the radial polynomial.
        tangential: p1, p2.
        divisor: k4, k5, k6 of OpenCV's rational model: as `radial`, of the polynomial that divides.
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
        """The same lens for images of another size; each axis is scaled by itself."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    @property
    def distorts(self) -> bool:
        """True if the lens is more than a pinhole."""
        factors = (*self.radial, *self.tangential, *self.divisor, *self.prism)
        return self.projection != "perspective" or any(value != 0.0 for value in factors)


@lru_cache(maxsize=64)  # images of a set share a few lenses
def undistorted_lens(lens: Lens) -> Lens:
    """Return the pinhole camera of a lens's undistorted images.

    The focal lengths grow, in steps of half a per cent, until every pixel of the straight image lies within the
    distorted one, and none twice: no pixel at the border is undefined. A fisheye's border is cut off.

    Raises:
        InputError: no reasonable zoom achieves that: the parameters do not describe such a lens.
    """
    zoom = 1.0
    while zoom <= _MAX_ZOOM:
        straight = Lens(lens.width, lens.height, lens.fx * zoom, lens.fy * zoom, lens.cx, lens.cy)
        if _border_is_inside(lens, straight) and _is_one_to_one(lens, straight):
            return straight
        zoom += _ZOOM_STEP
    where = f"{lens.source}: " if lens.source else ""
    names = ("radial", "tangential", "divisor", "prism", "omega")
    found = ", ".join(f"{name} {getattr(lens, name)}" for name in names if np.any(getattr(lens, name)))
    raise InputError(
        f"{where}the distortion ({found}) cannot be undone over the whole image: it folds, or reaches farther beyond "
        f"the border than a zoom of {_MAX_ZOOM:g} cuts off; check its numbers, or use {UNDISTORTER}"
    )


def distorted(u: F64, v: F64, lens: Lens, straight: Lens) -> tuple[F64, F64]:
    """Return the positions of pixels of the undistorted image in the distorted one.

    Args:
        u: horizontal pixel coordinates, of any shape.
        v: vertical pixel coordinates, of the same shape.
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
    """Return the projected radius of a direction, divided by the tangent of its angle, `r`."""
    tangent, scale = (2.0 * math.tan(lens.omega / 2.0), lens.omega) if lens.projection == "fov" else (1.0, 1.0)
    if abs(scale) < _SMALL:
        return np.ones_like(r)
    safe = np.maximum(r, _SMALL)
    return np.asarray(np.arctan(safe * tangent) / (safe * scale), np.float64)


def _polynomial(factors: tuple[float, ...], r2: F64) -> F64:
    """Return factors[0] r² + factors[1] r⁴ + …, by Horner's rule; zeros at the end cost nothing."""
    last = max((i for i, factor in enumerate(factors) if factor != 0.0), default=0)
    total = r2 * (factors[last] if factors else 0.0)
    for factor in reversed(factors[:last]):
        total = r2 * (factor + total)
    return total


def _border(lens: Lens, count: int) -> tuple[F64, F64]:
    """Return centres of pixels along the four sides, `count` of each."""
    u = np.linspace(0.5, lens.width - 0.5, count)
    v = np.linspace(0.5, lens.height - 0.5, count)
    ends_u, ends_v = np.repeat(u[[0, -1]], count), np.repeat(v[[0, -1]], count)
    return np.concatenate([ends_u, u, u]), np.concatenate([np.tile(v, 2), ends_v])


def _border_is_inside(lens: Lens, straight: Lens) -> bool:
    x, y = distorted(*_border(lens, _BORDER_POINTS), lens, straight)
    margin = 0.5 - 1e-6  # up to half a pixel beyond the centres the border's colour is valid
    inside = (x >= 0.5 - margin) & (x <= lens.width - 0.5 + margin)
    inside &= (y >= 0.5 - margin) & (y <= lens.height - 0.5 + margin)
    return bool(inside.all())


def _is_one_to_one(lens: Lens, straight: Lens) -> bool:
    """Return True if the order of distances from the principal point is kept, which polynomials may violate."""
    u, v = _border(lens, _RAYS)
    along = np.linspace(0.0, 1.0, _RAY_POINTS)[:, None]
    x, y = distorted(lens.cx + along * (u - lens.cx), lens.cy + along * (v - lens.cy), lens, straight)
    distances = np.hypot((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
    return bool((np.diff(distances, axis=0) >= 0.0).all())
