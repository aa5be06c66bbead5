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
from csplat.files import read_json
from csplat.types import F64, Mask
from csplat_render.camera import DEFAULT_NEAR, Camera
from csplat_render.camera_forms import check_intrinsics, foreign_cameras

_PARALLEL = 1e-6  # the sine of an angle below which two directions count as parallel
_FAR = 20.0  # usual distances from the middle beyond which a camera may be an outlier,
_AIMED = 0.7  # median cosine of `gaze` from which cameras look at one thing
_GAP = 4.0  # if it is this many times as far away as the farthest of the others,
_ORIGIN_FAR = 100.0  # times the distance of cameras from an origin, at least, that the origin is from 0
_MOST_OUTLIERS = 1.0 / 3.0  # share of the cameras: more of them are a part of the set


def load_cameras(
    path: str | Path, report: list[str] | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> list[Camera]:
    """Read a camera file.

    Args:
        path: a JSON file, see above. Its cameras are relative to the scene's origin. Where that is a hundred times as
            far from 0 as from the middle of the cameras, they are in coordinates of a map, and it is taken off.
        report: takes lines on how the file was understood.
        origin: [3], of the scene.

    Returns:
        Its cameras, at least one, relative to the origin.

    Raises:
        InputError: the file is absent, is not JSON, or holds something else than cameras.
    """
    path, report = Path(path), [] if report is None else report
    entries = read_json(path)
    cameras = foreign_cameras(entries, str(path), report)
    if cameras is None:
        cameras = _own_cameras(entries, path)
    for number, camera in enumerate(cameras):
        K = camera.K
        focals, middle = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
        check_intrinsics(focals, middle, (camera.W, camera.H), f"{path}, camera {number}")
    away = np.median([camera.position for camera in cameras], axis=0) - origin
    if _ORIGIN_FAR * float(np.linalg.norm(away)) < float(np.linalg.norm(origin)):
        report.append(f"{path}: the cameras stand around the scene's origin, which is taken off their coordinates")
        cameras = [relative_to(origin, camera) for camera in cameras]
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
    outliers = camera_outliers(np.stack([camera.viewmat for camera in cameras]))
    cameras = [camera for camera, outlier in zip(cameras, outliers, strict=True) if not outlier]
    places = np.stack([camera.position for camera in cameras])
    ahead = np.stack([camera.viewmat[2, :3] for camera in cameras])
    away = np.sqrt(np.sum((places - places.mean(axis=0)) ** 2, axis=1))
    turned = np.sqrt(np.sum((ahead - ahead.mean(axis=0)) ** 2, axis=1))
    return cameras[int(np.argmin(away / max(float(away.mean()), 1e-300) + turned))]


def camera_outliers(viewmats: F64, points: NDArray[np.floating] | None = None) -> Mask:
    """Find cameras that stand far away from all others, as structure from motion leaves them where it fails.

    What cameras look at counts, too: of a set whose cameras stand close together, one is no outlier that is only as
    far away as that. Distances that grow little by little (a flight towards a building) belong to the set.

    Args:
        viewmats: [N, 4, 4], world to camera, OpenCV axes.
        points: [P, 3], points of the scene, where they are known.

    Returns:
        [N], true for outliers: none of fewer than four cameras, a third of all at most.
    """
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    middle = np.median(positions, axis=0)
    with np.errstate(over="ignore"):  # beyond the square root of float64 all are infinitely far away
        distances = np.sqrt(np.sum((positions - middle) ** 2, axis=1))
    order = np.argsort(distances, kind="stable")
    away = distances[order]
    for first in range(math.ceil((1.0 - _MOST_OUTLIERS) * len(away)), len(away)):
        if first < 3 or not away[first] > max(_FAR * away[len(away) // 2], _GAP * away[first - 1]):
            continue
        others = order[:first]
        if points is not None and len(points):
            subject = np.median(points, axis=0)
        else:
            near, axes = positions[others] - middle, viewmats[others, 2, :3]
            if gaze(near, axes) < _AIMED:  # a tripod, a street: nothing tells how large the scene is
                continue
            subject = nearest_point(near, axes) + middle
        if away[first] > _FAR * float(np.sqrt(np.sum((subject - middle) ** 2))):
            outliers: Mask = distances >= away[first]
            return outliers
    return np.zeros(len(distances), np.bool_)


def gaze(positions: F64, axes: F64) -> float:
    """Return the median cosine between where cameras look and where the point lies that is nearest to all their lines.

    Args:
        positions: [N, 3], where cameras stand, relative to a point among them.
        axes: [N, 3], unit length, where they look.

    Returns:
        1 for cameras that look at one thing from several sides, -1 for those that look away from their middle.
    """
    towards = nearest_point(positions, axes) - positions
    lengths = np.maximum(np.linalg.norm(towards, axis=1), np.finfo(np.float64).tiny)
    return float(np.median(np.einsum("ni,ni->n", axes, towards) / lengths))


def nearest_point(positions: F64, axes: F64) -> F64:
    """Find the point nearest to all lines of sight, by least squares over the distances from the lines.

    Args:
        positions: [N, 3], where cameras stand.
        axes: [N, 3], unit length, where they look.

    Returns:
        [3]. Of lines that are parallel the point nearest to the mean position: it has a little weight.
    """
    weight = 1e-6 * len(positions)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    left = across.sum(axis=0) + weight * np.eye(3)
    right = np.einsum("nij,nj->i", across, positions) + weight * positions.mean(axis=0)
    return np.asarray(np.linalg.solve(left, right), np.float64)


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
