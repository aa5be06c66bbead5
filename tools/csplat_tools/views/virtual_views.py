# SPDX-License-Identifier: Apache-2.0
"""Place virtual cameras around a scene, for training and for extra tests.

Training views are many and small, since many small renders overfit less than a few large renders with the same number
of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.types import F64
from csplat_render import Camera
from csplat_render.camera import direction_at, intrinsics, look_at, relative_to
from csplat_render.scene_frame import SceneFrame, detail, sample_cloud, scene_frame
from csplat_render.virtual_cameras import FIELD_OF_VIEW, HIDING, deal, is_clear, viewed_parts, virtual_cameras

T = TypeVar("T")

#: Default number of virtual training views of small scenes, and width and height of their renders, pixels; for larger
#: scenes see `default_views`.
VIEW_COUNT = 160
VIEW_SIZE = (240, 180)

#: Additional virtual views, held out to check choices made on the training views.
HELD_OUT_COUNT = 16


@dataclass(frozen=True)
class VirtualViewSizes:
    """Counts, widths and heights in pixels of virtual views to which nothing is fitted.

    Attributes:
        test: test views, which are the views of `psnr`.
        validation: a set of validation views, as large as test views, since PSNR depends on the size. A set of more
            views would have other distances, since each has less room to avoid a poor view.
        validation_sets: number of sets. The PSNR of eight views differs from the PSNR of eight others by 0.1 to 1.9 dB
            (one standard deviation, eleven scenes).
        extra: views of each kind of `extra_test_cameras`.
    """

    test: tuple[int, int, int] = (8, 640, 480)
    validation: tuple[int, int, int] = (12, 640, 480)
    validation_sets: int = 4
    extra: tuple[int, int, int] = (12, 320, 240)


#: The default, used for all published figures.
VIRTUAL_SIZES = VirtualViewSizes()

_PIXELS = 50  # pixels of all views together per splat
_LARGEST = 2.0  # largest factor of width and height; all renders are in memory, and larger renders would be too few
_POINTS = 20_000  # points to sample from the scene
_OBJECT_DISTANCE = (0.95, 1.6)  # distance from the centre of an object, extents
_OBJECT_HEIGHT = (-0.95, 0.98)  # sines of elevations; objects are seen from below, too
_OBJECT_OFFSET = 0.2  # largest offset of a camera's target from the centre, per axis, extents
_AROUND_DISTANCE = (0.35, 1.45)  # the same for surrounding scenes
_AROUND_HEIGHT = (-0.12, 0.7)
_AROUND_OFFSET = 0.35
_BODY = (1.0, 99.0)  # percentiles of positions along each axis; cameras outside look at the middle of this box
_OUTWARDS = 5  # every Nth view looks away from the middle of a surrounding scene
_GOOD_DETAIL = 0.4  # least detail as a fraction of the best view's; views of walls from behind are useless
_CANDIDATES = 3  # candidates per view
_STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)  # powers of 1 / the root of x⁴ = x + 1


def default_views(splats: int) -> tuple[int, tuple[int, int]]:
    """Return the default count of virtual training views, and their width and height, by the number of splats.

    The cost of a render depends on splats more than on pixels, so for many splats fewer and larger views are more
    efficient. At the same PSNR a file of 290,000 splats is 16 % smaller with 110 views of 348x261 than with 160 of
    240x180.
    """
    larger = min(max(math.sqrt(_PIXELS * splats / (VIEW_COUNT * math.prod(VIEW_SIZE))), 1.0), _LARGEST)
    width, height = (round(larger * side) for side in VIEW_SIZE)
    return round(VIEW_COUNT / larger), (width, height)


def camera_sequence(
    model: SplatModel, count: int, size: tuple[int, int] = VIEW_SIZE, *, seed: int = 0, reach: float = 1.0
) -> list[Camera]:
    """Place virtual cameras around a scene, evenly spread at any count.

    Args:
        model: the scene; its own cameras are not used.
        count: number of cameras.
        size: width and height of the renders, pixels.
        seed: start of the sequence.
        reach: factor of the largest distance from the centre of a surrounding scene.

    Returns:
        `count` cameras, by a low-discrepancy sequence over directions, distances and targets. There are more
        candidates than needed: last come, and are dropped, cameras around an object whose view is hidden from nearby,
        and cameras in a surrounding scene that show little detail. Cameras of a scene of several parts are around each
        in turn.
    """
    return deal(viewed_parts(model), count, partial(_cameras_around, size=size, seed=seed, reach=reach))


def _cameras_around(model: SplatModel, count: int, size: tuple[int, int], seed: int, reach: float) -> list[Camera]:
    """Return `count` cameras around a scene or a part of it, as in `camera_sequence`."""
    frame = scene_frame(model)
    K = intrinsics(*size, FIELD_OF_VIEW)
    points = _sequence(_CANDIDATES * count, seed)
    if not len(model):
        return [_around_object(frame, point, K, size) for point in points[:count]]
    cloud = sample_cloud(model, _POINTS, np.random.default_rng(seed))
    if frame.kind == "object":
        around = [_around_object(frame, point, K, size) for point in points]
        return sorted(around, key=lambda camera: not is_clear(frame, cloud, camera))[:count]
    distances = _AROUND_DISTANCE[0], reach * _AROUND_DISTANCE[1]
    cameras = [_in_surroundings(frame, number, point, distances, K, size) for number, point in enumerate(points)]
    details = np.array([detail(cloud, camera, HIDING * frame.extent) for camera in cameras])
    inwards = np.arange(len(cameras)) % _OUTWARDS != 0
    best = np.where(inwards, details[inwards].max(), details[~inwards].max())
    good = np.flatnonzero(details >= _GOOD_DETAIL * best)
    others = np.setdiff1d(np.argsort(-details, kind="stable"), good, assume_unique=True)  # most detail first
    return [cameras[i] for i in [*good, *others][:count]]


def cameras_on_part(
    scene: SplatModel, part: SplatModel, count: int, size: tuple[int, int] = VIEW_SIZE, *, seed: int = 0, reach: float
) -> list[Camera]:
    """Place virtual cameras around a scene, and turn them to a part of it.

    If the part has most of the splats, the cameras are mostly around the part. This suits levels of detail: with
    cameras around the whole scene, levels 1 and 2 of garden500k in buckets have 0.7 dB less.

    Args:
        scene: the part together with splats that stand for the rest.
        part: splats of the scene. A part that is small from a camera fills its view; of a larger part, some place is
            in the middle of the view.
        count, size, seed, reach: as for `camera_sequence`.
    """
    frame, means = scene_frame(scene), part.means.astype(np.float64)
    low, high = np.percentile(means, _BODY, axis=0)
    centre, radius = (low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0
    places = means[np.random.default_rng(seed).integers(len(means), size=count)]
    cameras = []
    for camera, place in zip(camera_sequence(scene, count, size, seed=seed, reach=reach), places, strict=True):
        eye = camera.position
        sine = radius / max(float(np.linalg.norm(eye - centre)), radius, math.ulp(0.0))
        angle = 2.0 * math.degrees(math.asin(sine))
        fills = angle < FIELD_OF_VIEW
        K = intrinsics(*size, angle if fills else FIELD_OF_VIEW)
        cameras.append(look_at(eye, centre if fills else place, frame.up, K, *size, frame.near))
    return cameras


def shrink_cameras(cameras: Sequence[Camera], size: tuple[int, int] = VIEW_SIZE) -> list[Camera]:
    """Reduce views to about the number of pixels of `size`, if they have more."""
    smaller = []
    for camera in cameras:
        factor = (size[0] * size[1] / (camera.W * camera.H)) ** 0.5
        if factor >= 1.0:
            smaller.append(camera)
            continue
        width, height = max(1, round(camera.W * factor)), max(1, round(camera.H * factor))
        K = np.diag([width / camera.W, height / camera.H, 1.0]) @ camera.K
        smaller.append(replace(camera, K=K, W=width, H=height))
    return smaller


def _sequence(count: int, seed: int) -> F64:
    """Return [count, 6] points in the unit cube; the first three coordinates are evenly spread, the others random."""
    rng = np.random.default_rng(seed)
    start = rng.random(len(_STEPS))
    even = np.mod(start + np.arange(1, count + 1)[:, None] * np.array(_STEPS), 1.0)
    return np.concatenate([even, rng.random((count, 3))], axis=1)


def _interpolate(bounds: tuple[float, float], fraction: float) -> float:
    """Return the number at a fraction of the way from the first bound to the second."""
    return bounds[0] + (bounds[1] - bounds[0]) * fraction


def _around_object(frame: SceneFrame, point: F64, K: F64, size: tuple[int, int]) -> Camera:
    """Return the camera of a point of `_sequence` that looks at a place near the centre of an object from outside.

    Coordinates 0 to 2 determine azimuth, height and distance, the others the place. `size` is width and height.
    """
    height = _interpolate(_OBJECT_HEIGHT, point[1])
    along = direction_at(frame.up, 360.0 * point[0], math.degrees(math.asin(height)))
    eye = frame.centre + frame.extent * _interpolate(_OBJECT_DISTANCE, point[2]) * along
    target = frame.centre + frame.extent * _OBJECT_OFFSET * (2.0 * point[3:] - 1.0)
    return look_at(eye, target, frame.up, K, *size, frame.near)


def _in_surroundings(
    frame: SceneFrame, number: int, point: F64, distances: tuple[float, float], K: F64, size: tuple[int, int]
) -> Camera:
    """Return the camera of a point of `_sequence` inside of surroundings, at distances from the centre in extents.

    Every `_OUTWARDS`th by its number looks outwards from near the centre, the others inwards at a place near it.
    """
    along = direction_at(frame.up, 360.0 * point[0], math.degrees(math.asin(_interpolate(_AROUND_HEIGHT, point[1]))))
    offset = _AROUND_OFFSET * (2.0 * point[3:] - 1.0)
    if number % _OUTWARDS == 0:
        eye = frame.centre + frame.extent * offset
        target = eye + along
    else:
        eye = frame.centre + frame.extent * _interpolate(distances, point[2]) * along
        target = frame.centre + frame.extent * offset
    return look_at(eye, target, frame.up, K, *size, frame.near)


def evenly_spaced(items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` items, evenly spread over their order."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[i] for i in places]


_SEED = 2000  # seed of extra test views; validation views use 1000 and above
_NEARER, _FARTHER = (0.6, 0.7, 0.8, 0.9), 2.0  # factors of the distance from the middle of the scene


def extra_test_cameras(source: SplatModel) -> dict[str, list[Camera]]:
    """Place virtual cameras like the cameras of `psnr` at other positions, and nearer to and farther from the middle.

    They are used for reports only. Nearer cameras stay outside of the objects that they look at.

    Args:
        source: the scene; its own cameras are not used.

    Returns:
        12 cameras of each kind, by its name in reports.
    """
    groups = zip(*deal(viewed_parts(source), VIRTUAL_SIZES.extra[0], _extra_cameras), strict=True)
    return dict(zip(("beside", "farther", "nearer"), map(list, groups), strict=True))


def _extra_cameras(part: SplatModel, count: int) -> list[tuple[Camera, Camera, Camera]]:
    """Return `count` cameras at other positions around a part of a scene, each with one farther and one nearer."""
    frame = scene_frame(part)
    others = virtual_cameras(part, count, *VIRTUAL_SIZES.extra[1:], seed=_SEED)
    farther = [at_distance(camera, frame.centre, _FARTHER) for camera in others]
    if not len(part):
        return list(zip(others, farther, others, strict=True))
    cloud = sample_cloud(part, _POINTS, np.random.default_rng(_SEED))
    candidates = [[at_distance(camera, frame.centre, times) for times in _NEARER] + [camera] for camera in others]
    nearer = [
        next((camera for camera in distances if is_clear(frame, cloud, camera)), distances[-1])
        for distances in candidates
    ]
    return list(zip(others, farther, nearer, strict=True))


def at_distance(camera: Camera, centre: NDArray[np.float64], times: float) -> Camera:
    """Multiply the distance of a camera from a centre, [3], which it sees in the same direction as before."""
    turn = camera.viewmat[:3, :3]
    eye = -turn.T @ camera.viewmat[:3, 3]
    return relative_to((1.0 - times) * (eye - centre), camera)
