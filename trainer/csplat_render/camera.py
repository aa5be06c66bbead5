"""`Camera`: a pinhole camera, and the JSON form in which cameras are stored."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from csplat.errors import InputError
from csplat.types import F64

#: Distance of the near plane in scene units, if a camera does not specify it.
DEFAULT_NEAR = 0.2

#: Largest width and height of a picture, in pixels.
MAX_IMAGE_SIZE = 1 << 15

_ROTATION_TOLERANCE = 1e-3  # in the entries of R Rᵀ − 1; camera files hold few digits


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: its pose, its intrinsics, and the size of its image.

    A point p of the world has camera coordinates c = viewmat · p (x to the right, y down, z
    forward) and falls on the picture at K · c / c_z, in pixels; the centre of the first pixel lies
    at (0.5, 0.5). Skew is not supported: K holds focal lengths and principal point alone.

    Attributes:
        K: [3, 3] float64, (fx, 0, cx; 0, fy, cy; 0, 0, 1), in pixels, fx and fy above 0.
        viewmat: [4, 4] float64, world to camera, a rotation and a translation.
        W: width of the picture in pixels.
        H: height of the picture in pixels.
        near: splats whose centre is not farther than this along z are not drawn; scene units.
        image: name of the photograph that was taken here, if there is one.

    Raises:
        InputError: a field does not hold what is said above.
    """

    K: F64
    viewmat: F64
    W: int
    H: int
    near: float = DEFAULT_NEAR
    image: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", _matrix("K", self.K, 3))
        object.__setattr__(self, "viewmat", _matrix("viewmat", self.viewmat, 4))
        for name in ("W", "H"):
            object.__setattr__(self, name, _size(name, getattr(self, name)))
        object.__setattr__(self, "near", _near(self.near))
        if self.image is not None and not isinstance(self.image, str):
            raise InputError(f"the camera's image is {self.image!r}, wanted a name or nothing")
        _check_intrinsics(self.K)
        _check_pose(self.viewmat)

    @property
    def position(self) -> F64:
        """Position of the camera in world coordinates, [3]."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]), np.float64)

    def to_json(self) -> dict[str, Any]:
        """The camera as one entry of a camera file, a JSON object."""
        entry: dict[str, Any] = {
            "K": self.K.tolist(),
            "viewmat": self.viewmat.tolist(),
            "W": self.W,
            "H": self.H,
            "near": self.near,
        }
        if self.image is not None:
            entry["image"] = self.image
        return entry

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Camera:
        """Make a camera of one entry of a camera file; keys that are not known are ignored.

        Args:
            entry: K, viewmat, W, H and, if they are not the defaults, near and image.

        Raises:
            InputError: a key is missing or a value is not valid for `Camera`.
        """
        if not isinstance(entry, Mapping):
            raise InputError(f"a camera is a {type(entry).__name__}, wanted an object with K, viewmat, W and H")
        missing = [key for key in ("K", "viewmat", "W", "H") if key not in entry]
        if missing:
            raise InputError(f"a camera has no {', '.join(missing)}")
        near, image = entry.get("near"), entry.get("image")
        near = DEFAULT_NEAR if near is None else near
        return cls(entry["K"], entry["viewmat"], entry["W"], entry["H"], near, image)


_ROW_TOLERANCE = 1e-5  # of values of the last row; files hold few digits, or are products of matrices


def check_last_row(pose: F64, name: str) -> None:
    """Check that a pose moves points and does nothing else; one that is written by columns is recognised.

    Args:
        pose: [4, 4].
        name: name of the field and its place in the file.

    Raises:
        InputError: its last row is not 0 0 0 1.
    """
    wanted = (0.0, 0.0, 0.0, 1.0)
    if np.abs(pose[3] - wanted).max() <= _ROW_TOLERANCE:
        return
    found = " ".join(f"{value:.9g}" for value in pose[3])
    by_columns = (pose[:, 3] == wanted).all()
    hint = ": its last column is that, so it is transposed" if by_columns else ""
    raise InputError(f"{name} has the last row {found}, expected 0 0 0 1{hint}")


def _matrix(name: str, value: ArrayLike, size: int) -> F64:
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"the camera's {name} is not a matrix of numbers") from None
    if matrix.shape != (size, size):
        raise InputError(f"the camera's {name} has shape {list(matrix.shape)}, wanted [{size}, {size}]")
    if not np.isfinite(matrix).all():
        raise InputError(f"the camera's {name} holds values that are NaN or infinite")
    matrix.flags.writeable = False
    return matrix


def _size(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"the camera's {name} is {value!r}, wanted a number of pixels")
    if not (math.isfinite(value) and value == int(value) and 1 <= value <= MAX_IMAGE_SIZE):
        raise InputError(f"the camera's {name} is {value}, wanted 1 to {MAX_IMAGE_SIZE} pixels")
    return int(value)


def _near(value: Any) -> float:
    try:
        near = float(value)
    except (TypeError, ValueError):
        raise InputError(f"the camera's near plane is {value!r}, wanted a distance above 0") from None
    if not (math.isfinite(near) and near > 0.0):
        raise InputError(f"the camera's near plane is {near:g}, wanted a distance above 0")
    return near


def _check_intrinsics(K: F64) -> None:
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise InputError(f"the camera's focal lengths are {K[0, 0]:g} and {K[1, 1]:g} pixels, wanted above 0")
    if K[0, 1] != 0.0 or K[1, 0] != 0.0 or (K[2] != (0.0, 0.0, 1.0)).any():
        raise InputError("the camera's K has skew or a last row other than 0 0 1, wanted (fx 0 cx; 0 fy cy; 0 0 1)")


def _check_pose(viewmat: F64) -> None:
    R = viewmat[:3, :3]
    check_last_row(viewmat, "the camera's viewmat")
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R @ R.T - np.eye(3)).max()
        proper = np.linalg.det(R) > 0.0
    if not (off <= _ROTATION_TOLERANCE and proper):
        raise InputError("the camera's viewmat does not begin with a rotation (mirrored, scaled or sheared)")
