# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera, cameras that look at or orbit a point, and sets of cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.types import F64, Mask

#: Default distance of the near plane, scene units.
DEFAULT_NEAR = 0.2

#: Maximum width and height of an image, pixels.
MAX_IMAGE_SIZE = 1 << 15

_ROTATION_TOLERANCE = 1e-3  # largest |entry| of R Rᵀ − 1; camera files have few digits


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: its pose, its intrinsics, and the size of its image.

    A world point p has the camera coordinates c = viewmat · p (x right, y down, z forward) and the image position
    K · c / c_z, in pixels. The centre of the first pixel is at (0.5, 0.5). Skew is not supported.

    Attributes:
        K: [3, 3] float64, (fx, 0, cx; 0, fy, cy; 0, 0, 1), in pixels, fx and fy above 0.
        viewmat: [4, 4] float64, world to camera, a rotation and a translation.
        W, H: width and height of the image, pixels.
        near: distance of the near plane, scene units; splats are drawn only if their centre is beyond it.
        image: name of the view's image file; `None`: there is none.

    Raises:
        InputError: a field has an invalid shape or value.
    """

    K: F64
    viewmat: F64
    W: int
    H: int
    near: float = DEFAULT_NEAR
    image: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", _checked_matrix("K", self.K, 3))
        object.__setattr__(self, "viewmat", _checked_matrix("viewmat", self.viewmat, 4))
        for name in ("W", "H"):
            object.__setattr__(self, name, _checked_size(name, getattr(self, name)))
        object.__setattr__(self, "near", _checked_near(self.near))
        if self.image is not None and not isinstance(self.image, str):
            raise InputError(f"the camera's image is {self.image!r}, expected a name or None")
        _check_intrinsics(self.K)
        _check_pose(self.viewmat)

    @property
    def position(self) -> F64:
        """Position of the camera, [3], world coordinates."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]), np.float64)

    def as_json(self) -> dict[str, Any]:
        """Return the camera as an entry of a camera file, a JSON object."""
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
        """Build a camera from an entry of a camera file; unknown keys are ignored.

        Args:
            entry: K, viewmat, W, H and, optionally, near and image.

        Raises:
            InputError: a key is missing or a value is invalid.
        """
        if not isinstance(entry, Mapping):
            raise InputError(f"a camera is a {type(entry).__name__}, expected an object with K, viewmat, W and H")
        missing = [key for key in ("K", "viewmat", "W", "H") if key not in entry]
        if missing:
            raise InputError(f"a camera has no {', '.join(missing)}")
        near, image = entry.get("near"), entry.get("image")
        near = DEFAULT_NEAR if near is None else near
        return cls(entry["K"], entry["viewmat"], entry["W"], entry["H"], near, image)


_ROW_TOLERANCE = 1e-5  # for values of the last row; files have few digits, or products of matrices


def check_last_row(pose: F64, name: str) -> None:
    """Check that a pose is affine, and recognise a transposed pose.

    Args:
        pose: [4, 4].
        name: name of the field and its place in the file, for messages.

    Raises:
        InputError: the last row is not 0 0 0 1.
    """
    expected = (0.0, 0.0, 0.0, 1.0)
    if np.abs(pose[3] - expected).max() <= _ROW_TOLERANCE:
        return
    row = " ".join(f"{value:.9g}" for value in pose[3])
    by_columns = (pose[:, 3] == expected).all()
    hint = ": the last column is 0 0 0 1, so it is transposed" if by_columns else ""
    raise InputError(f"{name} has the last row {row}, expected 0 0 0 1{hint}")


def _checked_matrix(name: str, value: ArrayLike, size: int) -> F64:
    """Return a read-only matrix, [size, size] float64; raise an `InputError` unless it is finite."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"the camera's {name} is not a matrix of numbers") from None
    if matrix.shape != (size, size):
        raise InputError(f"the camera's {name} has shape {list(matrix.shape)}, expected [{size}, {size}]")
    if not np.isfinite(matrix).all():
        raise InputError(f"the camera's {name} contains NaN or infinity")
    matrix.flags.writeable = False
    return matrix


def _checked_size(name: str, value: Any) -> int:
    """Return a number of pixels as an int; raise an `InputError` unless it is whole, and 1 to `MAX_IMAGE_SIZE`."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"the camera's {name} is {value!r}, expected a number of pixels")
    if not (math.isfinite(value) and value == int(value) and 1 <= value <= MAX_IMAGE_SIZE):
        raise InputError(f"the camera's {name} is {value}, expected 1 to {MAX_IMAGE_SIZE} pixels")
    return int(value)


def _checked_near(value: Any) -> float:
    """Return the distance of the near plane, scene units; raise an `InputError` unless it is finite and above 0."""
    try:
        near = float(value)
    except (TypeError, ValueError):
        raise InputError(f"the camera's near plane is {value!r}, expected a distance above 0") from None
    if not (math.isfinite(near) and near > 0.0):
        raise InputError(f"the camera's near plane is {near:g}, expected a distance above 0")
    return near


def _check_intrinsics(K: F64) -> None:
    """Raise an `InputError` unless K, [3, 3], has focal lengths above 0 and no skew."""
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise InputError(f"the camera's focal lengths are {K[0, 0]:g} and {K[1, 1]:g} pixels, expected above 0")
    if K[0, 1] != 0.0 or K[1, 0] != 0.0 or (K[2] != (0.0, 0.0, 1.0)).any():
        raise InputError("the camera's K has skew or a last row other than 0 0 1, expected (fx 0 cx; 0 fy cy; 0 0 1)")


def _check_pose(viewmat: F64) -> None:
    """Raise an `InputError` unless a viewmat, [4, 4], is a rotation (to `_ROTATION_TOLERANCE`) and a translation."""
    R = viewmat[:3, :3]
    check_last_row(viewmat, "the camera's viewmat")
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R @ R.T - np.eye(3)).max()
        proper = np.linalg.det(R) > 0.0
    if not (off <= _ROTATION_TOLERANCE and proper):
        raise InputError("the camera's viewmat does not begin with a rotation (mirrored, scaled or sheared)")


_PARALLEL = 1e-6  # sine of the angle below which two directions count as parallel
_OUTLIER_DISTANCE = 20.0  # minimum distance of an outlier from the middle, in median distances of all cameras
_OUTLIER_GAP = 4.0  # minimum distance of an outlier, in largest distances of the other cameras
_CONVERGENT = 0.7  # minimum `convergence` of cameras that look at one subject
_MOST_OUTLIERS = 1.0 / 3.0  # maximum fraction of outliers
_OTHERS_MIN = 3  # minimum number of cameras that are not outliers
_TOWARDS_MEAN = 1e-6  # weight of the distance from the mean position, next to that from a line of sight
_SMALLEST_UNIT = 1e-300  # scene units; avoids a division by 0 if all cameras are in one place


def central_camera(cameras: Sequence[Camera]) -> Camera:
    """Return the most typical camera of a set: the nearest to the mean position and viewing direction.

    Distances of positions are in units of their mean distance from the mean position.

    Args:
        cameras: at least one.
    """
    outliers = camera_outliers(np.stack([camera.viewmat for camera in cameras]))
    cameras = [camera for camera, outlier in zip(cameras, outliers, strict=True) if not outlier]
    places = np.stack([camera.position for camera in cameras])
    ahead = np.stack([camera.viewmat[2, :3] for camera in cameras])
    distances = np.sqrt(np.sum((places - places.mean(axis=0)) ** 2, axis=1))
    deviations = np.sqrt(np.sum((ahead - ahead.mean(axis=0)) ** 2, axis=1))
    unit = max(float(distances.mean()), _SMALLEST_UNIT)
    return cameras[int(np.argmin(distances / unit + deviations))]


def camera_outliers(viewmats: F64, points: NDArray[np.floating] | None = None) -> Mask:
    """Find cameras that are far away from all others, for example due to failures of structure from motion.

    The distance of the subject matters, too: if cameras are close together, a camera no farther away than the subject
    is not an outlier. Nor are distances that grow gradually, as in a flight towards a building.

    Args:
        viewmats: [N, 4, 4], world to camera, OpenCV axes.
        points: [P, 3], points of the scene; `None`: unknown.

    Returns:
        [N], True for outliers: none among fewer than four cameras, at most a third of all.
    """
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    middle = np.median(positions, axis=0)
    with np.errstate(over="ignore"):  # squares may overflow to infinity
        distances = np.sqrt(np.sum((positions - middle) ** 2, axis=1))
    order = np.argsort(distances, kind="stable")
    away = distances[order]
    for first in range(math.ceil((1.0 - _MOST_OUTLIERS) * len(away)), len(away)):
        if first < _OTHERS_MIN or not away[first] > max(
            _OUTLIER_DISTANCE * away[len(away) // 2], _OUTLIER_GAP * away[first - 1]
        ):
            continue
        others = order[:first]
        if points is not None and len(points):
            subject = np.median(points, axis=0)
        else:
            near, axes = positions[others] - middle, viewmats[others, 2, :3]
            if convergence(near, axes) < _CONVERGENT:  # tripod or street: the size of the scene is unknown
                continue
            subject = nearest_point(near, axes) + middle
        if away[first] > _OUTLIER_DISTANCE * float(np.sqrt(np.sum((subject - middle) ** 2))):
            outliers: Mask = distances >= away[first]
            return outliers
    return np.zeros(len(distances), np.bool_)


def convergence(positions: F64, axes: F64) -> float:
    """Return the median cosine between viewing directions and directions to the point nearest to all lines of sight.

    Args:
        positions: [N, 3], positions of cameras, relative to a point among them.
        axes: [N, 3], viewing directions, unit length.

    Returns:
        1 for cameras around a subject, −1 for cameras that look outwards.
    """
    towards = nearest_point(positions, axes) - positions
    lengths = np.maximum(np.linalg.norm(towards, axis=1), np.finfo(np.float64).tiny)
    return float(np.median(np.einsum("ni,ni->n", axes, towards) / lengths))


def nearest_point(positions: F64, axes: F64) -> F64:
    """Find the point nearest to all lines of sight by least squares: minimise Σ |(I − a aᵀ)(x − p)|² over x.

    Args:
        positions: [N, 3], positions p of cameras.
        axes: [N, 3], viewing directions a, unit length.

    Returns:
        [3]. A small additional term favours points near the mean position, which matters for parallel lines.
    """
    weight = _TOWARDS_MEAN * len(positions)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = across.sum(axis=0) + weight * np.eye(3)
    vector = np.einsum("nij,nj->i", across, positions) + weight * positions.mean(axis=0)
    return np.asarray(np.linalg.solve(matrix, vector), np.float64)


def relative_to(origin: Sequence[float] | F64, camera: Camera) -> Camera:
    """Return the camera for scene coordinates that are relative to an origin.

    Args:
        origin: [3], in the world coordinates of the camera.
        camera: the camera to move.
    """
    shift = np.asarray(origin, np.float64)
    if not shift.any():
        return camera
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ shift
    return replace(camera, viewmat=viewmat)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera with another image size.

    Raises:
        InputError: the aspect ratio changes by more than the rounding of a pixel of either image.
    """
    across, down = width / camera.W, height / camera.H
    if abs(camera.H * across - height) > max(1.0, across) and abs(camera.W * down - width) > max(1.0, down):
        raise InputError(
            f"the camera's image has {camera.W}x{camera.H} pixels: at {width}x{height} it would be distorted"
        )
    return replace(camera, K=np.diag([across, down, 1.0]) @ camera.K, W=width, H=height)


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with another image size that shows at least what this one shows, as viewers fit a first view.

    Args:
        camera: the camera, with the principal point in the middle of its image.
        width, height: pixels.
    """
    factor = min(width / camera.W, height / camera.H)
    K = np.diag([factor, factor, 1.0]) @ camera.K
    K[:2, 2] = width / 2.0, height / 2.0
    return replace(camera, K=K, W=width, H=height)


def intrinsics(width: int, height: int, field_of_view: float) -> F64:
    """Return K of a camera whose principal point is the centre of its image.

    Args:
        width, height: pixels.
        field_of_view: horizontal, degrees, above 0 and below 180.

    Returns:
        [3, 3] float64.
    """
    if not 0.0 < field_of_view < 180.0:
        raise InputError(f"the field of view is {field_of_view:g} degrees, expected above 0 and below 180")
    focal = 0.5 * width / math.tan(math.radians(field_of_view) / 2.0)
    return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])


def look_at(
    position: ArrayLike,
    target: ArrayLike,
    up: ArrayLike,
    K: F64,
    width: int,
    height: int,
    near: float = DEFAULT_NEAR,
    image: str | None = None,
) -> Camera:
    """Return a camera that looks at a point.

    Args:
        position: [3], position of the camera.
        target: [3], the point shown at the principal point.
        up: [3], the direction that points upwards in the image; if it is parallel to the line of sight, an arbitrary
            perpendicular direction is used.
        K: [3, 3], intrinsics.
        width, height: pixels.
        near: near plane, scene units.
        image: name of an image file.

    Raises:
        InputError: position and target are equal.
    """
    eye = np.array(position, np.float64)
    forward = np.array(target, np.float64) - eye
    length = math.sqrt(float(np.sum(forward**2)))
    if not (math.isfinite(length) and length > 0.0):
        raise InputError("the camera's position and target are the same point")
    forward = forward / length
    right = _cross(forward, np.array(up, np.float64))
    if math.sqrt(float(np.sum(right**2))) <= _PARALLEL:
        right = _cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    right = right / math.sqrt(float(np.sum(right**2)))
    down = _cross(forward, right)
    viewmat = np.eye(4)
    for row, axis in enumerate((right, down, forward)):
        viewmat[row, :3] = axis
        viewmat[row, 3] = -float(np.sum(axis * eye))  # without BLAS, so the result does not depend on threads
    return Camera(K, viewmat, width, height, near, image)


def direction_at(up: ArrayLike, azimuth: float, elevation: float) -> F64:
    """Return the unit vector of an azimuth and an elevation.

    Args:
        up: [3], unit length, the up direction.
        azimuth: degrees around `up`, right-handed; 0 is the scene axis most nearly perpendicular to `up`.
        elevation: degrees above the horizon.

    Returns:
        [3] float64.
    """
    u = np.array(up, np.float64)
    first = np.eye(3)[int(np.argmin(np.abs(u)))]
    first = first - u * float(np.sum(first * u))
    first = first / math.sqrt(float(np.sum(first**2)))
    second = _cross(u, first)
    a, e = math.radians(azimuth), math.radians(elevation)
    result: F64 = (first * math.cos(a) + second * math.sin(a)) * math.cos(e) + u * math.sin(e)
    return result


def _cross(a: F64, b: F64) -> F64:
    """Return the vector product [3] of two vectors [3].

    It equals `np.cross` bit for bit, whose overhead would matter for hundreds of cameras.
    """
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def orbit(
    centre: ArrayLike,
    distance: float,
    up: ArrayLike,
    count: int,
    K: F64,
    width: int,
    height: int,
    *,
    elevation: float = 20.0,
    near: float = DEFAULT_NEAR,
) -> list[Camera]:
    """Return evenly spaced cameras on a circle around a point, looking at it.

    Args:
        centre: [3], the point to look at.
        distance: distance from the centre, scene units, above 0.
        up: [3], unit length, the axis of the circle.
        count: number of cameras, at least 1.
        K: [3, 3], intrinsics.
        width, height: pixels.
        elevation: degrees above the horizon, above −90 and below 90.
        near: near plane, scene units.
    """
    if count < 1:
        raise InputError(f"an orbit of {count} cameras, expected at least 1")
    middle = np.array(centre, np.float64)
    return [
        look_at(middle + distance * direction_at(up, 360.0 * i / count, elevation), middle, up, K, width, height, near)
        for i in range(count)
    ]
