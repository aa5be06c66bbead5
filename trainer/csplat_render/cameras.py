"""Camera files, and cameras on a path: looking at a point, orbiting around it.

A camera file is a JSON list of {K, viewmat, W, H, near, image}: world to camera, OpenCV axes,
pixel centres at +0.5; `near` and `image` may be left out. Files of other programs are read too: `camera_forms`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.files import read_text
from csplat_render.camera import DEFAULT_NEAR, Camera
from csplat_render.camera_forms import check_intrinsics, foreign_cameras

__all__ = ["central_camera", "intrinsics", "load_cameras", "look_at", "orbit", "relative_to", "resized", "save_cameras"]

F64 = NDArray[np.float64]

_PARALLEL = 1e-6  # the sine of an angle below which two directions count as parallel


def load_cameras(path: str | Path, report: list[str] | None = None) -> list[Camera]:
    """Read a camera file.

    Args:
        path: a JSON file, see above.
        report: takes lines on how the file of another program was understood.

    Returns:
        Its cameras, at least one.

    Raises:
        InputError: the file is absent, is not JSON, or holds something else than cameras.
    """
    path = Path(path)
    try:
        entries = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error
    cameras = foreign_cameras(entries, str(path), [] if report is None else report)
    if cameras is None:
        cameras = _own_cameras(entries, path)
    for number, camera in enumerate(cameras):
        K = camera.K
        focals, middle = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
        check_intrinsics(focals, middle, (camera.W, camera.H), f"{path}, camera {number}")
    return cameras


def _own_cameras(entries: object, path: Path) -> list[Camera]:
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{path} is not a camera file, expected a list of {{K, viewmat, W, H}}, cameras.json of INRIA, a camera "
            "path of nerfstudio, or transforms.json"
        )
    cameras = []
    for number, entry in enumerate(entries):
        try:
            cameras.append(Camera.from_json(entry))
        except InputError as error:
            raise InputError(f"{path}, camera {number}: {error}") from error
    return cameras


def central_camera(cameras: Sequence[Camera]) -> Camera:
    """The camera that stands and looks most as all do: of a set, the one to begin with.

    It is the nearest one to their mean: places count as shares of the mean distance from it, directions as they are.

    Args:
        cameras: one at least.
    """
    places = np.stack([camera.position for camera in cameras])
    ahead = np.stack([camera.viewmat[2, :3] for camera in cameras])
    away = np.sqrt(np.sum((places - places.mean(axis=0)) ** 2, axis=1))
    turned = np.sqrt(np.sum((ahead - ahead.mean(axis=0)) ** 2, axis=1))
    return cameras[int(np.argmin(away / max(float(away.mean()), 1e-300) + turned))]


def save_cameras(path: str | Path, cameras: Sequence[Camera]) -> None:
    """Write a camera file that `load_cameras` reads back without loss."""
    text = ",\n".join(json.dumps(camera.to_json(), allow_nan=False) for camera in cameras)
    Path(path).write_text(f"[\n{text}\n]\n", "utf-8")


def relative_to(origin: Sequence[float] | F64, camera: Camera) -> Camera:
    """The same camera for a scene whose coordinates are relative to an origin.

    Args:
        origin: [3], in the camera's coordinates.
        camera: where the photograph was taken.
    """
    shift = np.asarray(origin, np.float64)
    if not shift.any():
        return camera
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ shift
    return replace(camera, viewmat=viewmat)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Let a camera take the same picture in another size.

    Raises:
        InputError: the picture's shape would change by more than the rounding of a pixel.
    """
    across, down = width / camera.W, height / camera.H
    if abs(camera.H * across - height) > 1.0 and abs(camera.W * down - width) > 1.0:
        raise InputError(
            f"a camera takes pictures of {camera.W}x{camera.H} pixels: at {width}x{height} they would be distorted"
        )
    return replace(camera, K=np.diag([across, down, 1.0]) @ camera.K, W=width, H=height)


def intrinsics(width: int, height: int, field_of_view: float) -> F64:
    """K of a camera that looks through the middle of its picture.

    Args:
        width: pixels.
        height: pixels.
        field_of_view: across the width, degrees, above 0 and below 180.

    Returns:
        [3, 3] float64.
    """
    if not 0.0 < field_of_view < 180.0:
        raise InputError(f"the field of view is {field_of_view:g} degrees, wanted above 0 and below 180")
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
    """A camera at one point that looks at another.

    Args:
        position: [3], where it stands.
        target: [3], what lies in the middle of the picture (at the principal point).
        up: [3], what points upwards in the picture; where it is parallel to the line of sight, any
            direction across is taken.
        K: [3, 3], intrinsics.
        width: pixels.
        height: pixels.
        near: near plane, scene units.
        image: a name.

    Raises:
        InputError: position and target are the same point.
    """
    eye = np.array(position, np.float64)
    forward = np.array(target, np.float64) - eye
    length = math.sqrt(float(np.sum(forward**2)))
    if not (math.isfinite(length) and length > 0.0):
        raise InputError("a camera cannot look at the point where it stands")
    forward = forward / length
    right = _cross(forward, np.array(up, np.float64))
    if math.sqrt(float(np.sum(right**2))) <= _PARALLEL:
        right = _cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    right = right / math.sqrt(float(np.sum(right**2)))
    down = _cross(forward, right)
    viewmat = np.eye(4)
    for row, axis in enumerate((right, down, forward)):
        viewmat[row, :3] = axis
        viewmat[row, 3] = -float(np.sum(axis * eye))  # no BLAS: the same on any machine's threads
    return Camera(K, viewmat, width, height, near, image)


def direction(up: ArrayLike, azimuth: float, elevation: float) -> F64:
    """A unit vector by its angles.

    Args:
        up: [3], unit length, which way is up.
        azimuth: degrees around `up`, to the right-hand side.
        elevation: degrees above the horizon.

    Returns:
        [3] float64. Azimuth 0 is an axis of the scene that lies most nearly across `up`.
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
    """`np.cross` of two vectors, to the bit, without what that spends on axes: cameras are tried by the hundred."""
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
    """Cameras on a full circle around a point, all looking at it.

    Args:
        centre: [3], what they look at.
        distance: from the centre, scene units, above 0.
        up: [3], unit length, the axis of the circle.
        count: how many; played in a loop they turn evenly.
        K: [3, 3], intrinsics.
        width: pixels.
        height: pixels.
        elevation: degrees above the horizon, above −90 and below 90.
        near: near plane, scene units.
    """
    if count < 1:
        raise InputError(f"an orbit of {count} cameras, wanted at least 1")
    middle = np.array(centre, np.float64)
    return [
        look_at(middle + distance * direction(up, 360.0 * i / count, elevation), middle, up, K, width, height, near)
        for i in range(count)
    ]
