# SPDX-License-Identifier: Apache-2.0
"""Closed camera paths for films that loop without a jump.

An *object* is circled about its up axis, estimated if necessary (`with_estimated_up`), at a distance that shows all of
it. In *surroundings*, a circle would lead through walls. If cameras are known, the path follows their positions and
directions. If the scene specifies an initial view that is no estimate, the path sways around it. Otherwise the path
goes back and forth along the arc with the greatest surplus of visible detail.

These cameras are not used for scoring; `psnr` uses `virtual_cameras.virtual_cameras`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene_metadata import ESTIMATE, VIEW
from csplat.types import F64, Mask
from csplat_render.camera import Camera, camera_outliers, direction_at, intrinsics, look_at, orbit
from csplat_render.scene_frame import Cloud, SceneFrame, detail, object_body, sample_cloud, viewing_frame
from csplat_render.up_estimate import with_estimated_up
from csplat_render.virtual_cameras import FIELD_OF_VIEW, HIDING

ELEVATION = 20.0  # degrees above the horizon, for objects
_MARGIN = 0.08  # free margin around an object, as a fraction of half the image
_POINTS = 16_000  # cloud points for an object
_SHOWN = 0.999  # minimum fraction of an object's points inside each image; the rest is haze
_CELL = 0.1  # extents; parts are separated by a gap of at least one cell
_CELLS = 36  # number of cells in each direction from the centre
_PART = 0.02  # fraction of the surface; smaller parts are floaters
_BODY = 0.5  # fraction of the surface; if all parts together have less, the whole scene is shown
_TURNS = 24  # number of azimuths to try
_HEIGHTS = np.linspace(-0.2, 0.2, 5)  # heights of look-at points to try, relative to the object's middle and height

_ARC_POINTS = 12_000  # cloud points for surroundings
_ARC_SIZE = (640, 480)  # pixels of the images whose detail is compared
_ARC_ELEVATIONS = (5.0, 20.0, 40.0)  # degrees
_ARC_DISTANCES = (1.7, 1.3, 1.0, 0.7, 0.4)  # extents
_GOOD = 0.85  # detail from which a view is worth showing, as a fraction of the best view's detail
_ARC_MIN = 10.0  # degrees in each direction

_SWINGS = (30.0, 24.0, 18.0, 13.0, 9.0, 6.0)  # degrees in each direction from a known view; the widest is tried first
_SWING_CHECKS = 7  # number of views per swing whose detail is checked
_FLATTENED = 0.3  # ratio of the vertical to the horizontal swing
_NEAREST_MIDDLE = 0.3  # extents; minimum distance of the look-at point from a view

_REACH = 0.35  # distance over which cameras influence the path, as a fraction of the ellipse's longer half-axis
_EASE = 0.04  # standard deviation of the smoothing of directions, as a fraction of the path
_SHORT = 0.1  # length of a mean of unit vectors below which they cancel, and the nearest camera's direction is used
_TINY = 1e-9  # avoids divisions by 0


def orbit_cameras(
    model: SplatModel,
    count: int,
    width: int = 640,
    height: int = 480,
    *,
    elevation: float = ELEVATION,
    along: Sequence[Camera] = (),
) -> list[Camera]:
    """Return cameras on a closed path for a film.

    Args:
        model: the scene.
        count: number of cameras.
        width, height: pixels.
        elevation: degrees above the horizon, for objects.
        along: cameras for the path to follow, relative to the scene's origin. Default: the cameras of the scene for
            surroundings, none for an object.

    Raises:
        InputError: `count` is below 1, or a camera of the scene is invalid.
    """
    if count < 1:
        raise InputError(f"an orbit of {count} cameras, expected at least 1")
    frame, K = viewing_frame(with_estimated_up(model)), intrinsics(width, height, FIELD_OF_VIEW)
    if not along and frame.kind == "surrounding":
        along = [Camera.from_json(entry) for entry in model.metadata.cameras or ()]
    if along:
        eyes, ahead, up = _path_along(along, count, model.metadata.up)
        near = min(frame.near, *(camera.near for camera in along))
        return [look_at(eye, eye + way, up, K, width, height, near) for eye, way in zip(eyes, ahead, strict=True)]
    if len(model) == 0:
        return orbit(frame.centre, 1.0, frame.up, count, K, width, height, elevation=elevation, near=frame.near)
    rng = np.random.default_rng(0)
    if frame.kind == "object":
        body = main_parts(sample_cloud(object_body(model, frame), _POINTS, rng), frame)
        centre, distance = orbit_framing(body, frame, elevation, K, width, height)
        return orbit(centre, distance, frame.up, count, K, width, height, elevation=elevation, near=frame.near)
    cloud = sample_cloud(model, _ARC_POINTS, rng)
    first = _first_view(model)
    if first is not None:
        return _sway(cloud, first, frame, count, K, width, height)
    angles, elevation, distance = _arc(cloud, frame, count)
    return [frame.camera_at(float(angle), elevation, distance, K, width, height) for angle in angles]


def main_parts(cloud: Cloud, frame: SceneFrame) -> F64:
    """Return the points of the larger parts of an object, [M, 3], without floaters.

    Parts are connected sets of grid cells with two points or more. If the splats are too scattered, all points are
    returned.
    """
    side = 2 * _CELLS + 1
    with np.errstate(invalid="ignore", over="ignore"):
        places = np.floor(np.clip((cloud.points - frame.centre) / (_CELL * frame.extent), -_CELLS, _CELLS - 1))
    cells = np.ravel_multi_index(tuple(np.nan_to_num(places).astype(np.int64).T + _CELLS), (side,) * 3)
    masses = np.bincount(cells, cloud.masses, side**3)
    unassigned: Mask = np.bincount(cells, minlength=side**3) > 1
    kept: Mask = np.zeros_like(unassigned)
    while unassigned.any():
        heaviest = int(np.argmax(np.where(unassigned, masses, -1.0)))
        part = _connected_cells(heaviest, unassigned.reshape((side,) * 3)).ravel()
        if not np.sum(masses[part]) > _PART * np.sum(masses):
            break
        kept |= part
        unassigned &= ~part
    scattered = not np.sum(masses[kept]) > _BODY * np.sum(masses)
    return cloud.points if scattered else cloud.points[kept[cells]]


def _connected_cells(first: int, filled: Mask) -> Mask:
    """Return the filled cells, [n, n, n] bool, connected with the cell of flat index `first`."""
    connected: Mask = np.zeros_like(filled)
    connected.flat[first] = True
    while True:
        wider = connected
        for axis in range(3):  # wrapping around is harmless: border cells are empty or contain distant points
            wider = wider | np.roll(wider, 1, axis) | np.roll(wider, -1, axis)
        wider = wider & filled
        if (wider == connected).all():
            return connected
        connected = wider


def orbit_framing(body: F64, frame: SceneFrame, elevation: float, K: F64, width: int, height: int) -> tuple[F64, float]:
    """Find the shortest distance at which all images of an orbit show an object, among look-at points on its axis.

    Args:
        body: [M, 3], the object's points, at least one.
        frame: the scene's frame; its extent is the distance if the result is not finite or within the near plane.
        elevation: degrees above the horizon.
        K: [3, 3], intrinsics.
        width, height: pixels.

    Returns:
        [3], the look-at point; the distance from it, scene units.
    """
    up = frame.up
    first, second = direction_at(up, 0.0, 0.0), direction_at(up, 90.0, 0.0)
    sides = np.stack([_coordinates_along(body - frame.centre, axis) for axis in (first, second, up)])
    low, high = np.quantile(sides, [1.0 - _SHOWN, _SHOWN], axis=1)
    middle, tall = (low + high) / 2.0, float(high[2] - low[2])
    slopes = (1.0 - _MARGIN) * 0.5 * np.array([width / K[0, 0], height / K[1, 1]])
    best: tuple[float, F64] | None = None
    for share in _HEIGHTS:
        x, y, z = sides - (middle + np.array([0.0, 0.0, share * tall]))[:, None]
        distance = 0.0  # the largest that an azimuth needs
        e = math.radians(elevation)
        for azimuth in np.radians(np.arange(_TURNS) * 360.0 / _TURNS):
            out = x * math.cos(azimuth) + y * math.sin(azimuth)
            across = y * math.cos(azimuth) - x * math.sin(azimuth)
            nearer, above = out * math.cos(e) + z * math.sin(e), z * math.cos(e) - out * math.sin(e)
            needed = nearer + np.maximum(np.abs(across) / slopes[0], np.abs(above) / slopes[1])
            distance = max(distance, float(np.quantile(needed, _SHOWN)))
        if best is None or distance < best[0]:
            best = distance, middle + np.array([0.0, 0.0, share * tall])
    assert best is not None
    distance, (x, y, z) = best
    centre = frame.centre + x * first + y * second + z * up
    return centre, distance if math.isfinite(distance) and distance > frame.near else frame.extent


def _first_view(model: SplatModel) -> Camera | None:
    """Return the camera of a scene's initial view; `None` if it is absent, an estimate or invalid."""
    view = model.metadata.entries.get(VIEW)
    if not isinstance(view, Mapping) or view.get("from") == ESTIMATE:
        return None
    try:
        return Camera.from_json(view)
    except InputError:
        return None


def _sway(cloud: Cloud, first: Camera, frame: SceneFrame, count: int, K: F64, width: int, height: int) -> list[Camera]:
    """Return cameras on an ellipse around a known camera, looking at a fixed point.

    The ellipse is the widest on which the checked views show enough detail, or the narrowest if there is none.
    """
    ahead, eye = first.viewmat[2, :3], first.position
    depth = max(float(np.sum((frame.centre - eye) * ahead)), frame.extent * _NEAREST_MIDDLE)
    middle, side, near = eye + depth * ahead, first.viewmat[0, :3], min(frame.near, first.near)

    def swung(width_degrees: float, turn: float) -> Camera:
        """Return the camera at an angle `turn`, radians, on an ellipse; at a width of 0, the known camera."""
        aside = math.radians(width_degrees) * math.sin(turn)
        above = math.radians(width_degrees) * _FLATTENED * math.cos(turn)
        way = -ahead + math.tan(aside) * side + math.tan(above) * frame.up
        way = way / float(np.sqrt(np.sum(way**2)))
        return look_at(middle + depth * way, middle, frame.up, K, width, height, near)

    turns = 2.0 * math.pi * np.arange(count) / count
    nearest = HIDING * depth
    good = _GOOD * detail(cloud, swung(0.0, 0.0), nearest)
    checks = np.linspace(0.0, 2.0 * math.pi, _SWING_CHECKS, endpoint=False)
    for swing in _SWINGS:
        if min(detail(cloud, swung(swing, turn), nearest) for turn in checks) >= good:
            break
    return [swung(swing, float(turn)) for turn in turns]


def _arc(cloud: Cloud, frame: SceneFrame, count: int) -> tuple[F64, float, float]:
    """Return a path inside surroundings, on the arc with the greatest surplus of detail.

    The surplus is the sum over azimuths of the detail minus `_GOOD` times the best view's detail. The path swings along
    the arc and back, or goes round if the arc is a full circle.

    Returns:
        [count] azimuths, degrees; elevation, degrees; distance from the centre, extents.
    """
    K = intrinsics(*_ARC_SIZE, FIELD_OF_VIEW)
    azimuths = np.arange(_TURNS) * 360.0 / _TURNS
    circles = [(elevation, distance) for distance in _ARC_DISTANCES for elevation in _ARC_ELEVATIONS]
    details = np.array(
        [
            [detail(cloud, frame.camera_at(a, *circle, K, *_ARC_SIZE), HIDING * frame.extent) for a in azimuths]
            for circle in circles
        ]
    )
    number, start, length = _best_arc(details - _GOOD * details.max())
    turns = np.arange(count) / count
    if length == _TURNS:
        return 360.0 * turns, *circles[number]
    step = 360.0 / _TURNS
    half = max(0.5 * (length - 1) * step, _ARC_MIN)
    return (start + 0.5 * (length - 1)) * step + half * np.sin(2.0 * np.pi * turns), *circles[number]


def _best_arc(gains: F64) -> tuple[int, int, int]:
    """Return row, first column and length of the run of at least one column with the largest sum; rows are cyclic."""
    turns = gains.shape[1]
    most, best = -math.inf, (0, 0, 1)
    for row, gain in enumerate(gains):
        sums = np.concatenate([[0.0], np.cumsum(np.tile(gain, 2))])
        for length in range(1, turns + 1):
            totals = sums[length : length + turns] - sums[:turns]
            start = int(np.argmax(totals))
            if totals[start] > most + 1e-12:  # more than rounding; of equal runs, the first row's shortest is kept
                most, best = float(totals[start]), (row, start, length)
    return best


def _path_along(cameras: Sequence[Camera], count: int, up: Sequence[float] | None) -> tuple[F64, F64, F64]:
    """Compute a path along the given cameras.

    The path starts as the ellipse with the covariance of the cameras' positions. Each of its points then moves to the
    weighted mean position of the cameras around it, and looks in their weighted mean direction.

    Returns:
        [count, 3] positions; [count, 3] directions of unit length; [3] the up direction.
    """
    outliers = camera_outliers(np.stack([camera.viewmat for camera in cameras]))
    cameras = [camera for camera, outlier in zip(cameras, outliers, strict=True) if not outlier]
    rotations = np.stack([camera.viewmat[:3, :3] for camera in cameras])
    positions = np.stack([camera.position for camera in cameras])
    above = -np.mean(rotations[:, 1], axis=0) if up is None else np.array(up, np.float64)
    above = above / max(float(np.sqrt(np.sum(above**2))), _TINY)
    middle = positions.mean(axis=0)
    flat = positions - middle
    flat = flat - _coordinates_along(flat, above)[:, None] * above
    values, axes = np.linalg.eigh(np.mean(flat[:, :, None] * flat[:, None, :], axis=0))
    halves = np.sqrt(2.0 * np.maximum(values[1:], 0.0))  # for points on an ellipse, these are its half-axes
    angles = 2.0 * np.pi * np.arange(count) / count
    plan = np.cos(angles)[:, None] * halves[1] * axes[:, 2] + np.sin(angles)[:, None] * halves[0] * axes[:, 1]
    gaps = np.sum((plan[:, None, :] - flat[None, :, :]) ** 2, axis=2)
    reach = max(_REACH * float(halves[1]), _TINY)
    weights = np.exp((gaps.min(axis=1, keepdims=True) - gaps) / (2.0 * reach**2))
    weights /= np.sum(weights, axis=1, keepdims=True)
    ahead = _smooth(np.einsum("ij,jk->ik", weights, rotations[:, 2]))
    lengths = np.sqrt(np.sum(ahead**2, axis=1, keepdims=True))
    nearest = rotations[np.argmin(gaps, axis=1), 2]
    ahead = np.where(lengths > _SHORT, ahead / np.maximum(lengths, _TINY), nearest)
    return np.einsum("ij,jk->ik", weights, positions), ahead, above


def _smooth(rows: F64) -> F64:
    """Return the rows [N, 3] of a closed path, smoothed with a Gaussian of standard deviation `_EASE`; cyclic."""
    count = len(rows)
    steps = np.arange(count)
    gaps = np.minimum(steps, count - steps) / count
    weights = np.exp(-0.5 * (gaps / _EASE) ** 2)
    circulant = weights[(steps[:, None] - steps[None, :]) % count]
    result: F64 = np.einsum("ij,jk->ik", circulant, rows) / np.sum(weights)
    return result


def _coordinates_along(rows: F64, axis: F64) -> F64:
    """Return the coordinates [N] of rows [N, 3] along a unit axis; without BLAS, whose rounding depends on threads."""
    result: F64 = np.sum(rows * axis, axis=1)
    return result
