# SPDX-License-Identifier: Apache-2.0
"""Virtual cameras around a scene that has none: the cameras of `psnr`.

An *object* is viewed from all sides at low to high elevations, close enough to cover at least half of each image. In
*surroundings*, cameras are placed around or inside the dense middle, at positions from which it is not occluded.

A PSNR depends on distances: the same error gives 33, 39 and 48 dB at distances of one, two and four extents. So they
are fixed multiples of the scene's extent: `OBJECT_DISTANCES`, `SURROUNDING_DISTANCES`. Cameras depend on nothing but
the source and the seed, which determines directions.

The cameras of a scene of several parts far from each other are around each part in turn: from outside of all, a part
would cover a few pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene_parts import find_parts, median_size, part_min, split_parts
from csplat.types import F64
from csplat_render.camera import Camera, intrinsics, orbit
from csplat_render.scene_frame import (
    Cloud,
    SceneFrame,
    covered_fraction,
    detail,
    sample_cloud,
    scene_frame,
    share_within,
)

#: Horizontal field of view, degrees.
FIELD_OF_VIEW = 60.0

#: Extents, distances from the centre of an object, in the order of trial.
OBJECT_DISTANCES = (1.25, 1.125, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)

#: Extents, distances from the centre of surroundings, in the order of trial.
SURROUNDING_DISTANCES = (1.3, 0.8, 0.5)

#: Minimum fraction of each image that an object covers.
MIN_COVER = 0.5

#: Extents; nearer splats in surroundings occlude others but show no detail.
HIDING = 0.4

_COVER_MARGIN = 0.015  # error of the estimated cover
_OBJECT_ELEVATIONS = (5.0, 25.0, 50.0)  # degrees
_SURROUNDING_ELEVATIONS = (3.0, 15.0, 35.0)  # degrees
_PROMISING = 4  # number of directions in which nearer cameras are tried
_TARGET_OFFSET = 0.05  # extents; maximum distance of the look-at point from an object's centre along each axis
_CLEAR_RADIUS = 0.32  # radius around a camera that must be clear, as a fraction of its distance from the centre
_CLEAR_SHARE = 0.01  # maximum fraction of an object's surface within this radius
_HOPELESS = 0.8  # fraction of the needed cover; distances whose predicted cover is below it are not tried
_SECTOR_STEPS = (0.0, 1.0 / 3.0, -1.0 / 3.0)  # azimuths to try in a sector, from its middle, as fractions of its width
_EMPTY_DISTANCE = 2.2  # extents; from the centre of an empty scene
_GOOD_DETAIL = 0.65  # minimum detail, as a fraction of the best view's
_AZIMUTH_STEP = 15.0  # degrees
_POINTS = 60_000  # cloud points
_PART_SAMPLE = 1 << 16  # splats on which parts are found

T = TypeVar("T")

_CameraAt = Callable[..., Camera]  # `SceneFrame.camera_at` without intrinsics


def is_clear(frame: SceneFrame, cloud: Cloud, camera: Camera) -> bool:
    """Return True if hardly any surface is close to a camera, where it would look like fog or be seen from inside."""
    radius = _CLEAR_RADIUS * float(np.linalg.norm(camera.position - frame.centre))
    return share_within(cloud, camera.position, radius) <= _CLEAR_SHARE


def virtual_cameras(
    model: SplatModel, count: int = 8, width: int = 640, height: int = 480, seed: int = 0, every: int = 1
) -> list[Camera]:
    """Return cameras around a scene, chosen from the scene alone.

    Args:
        model: the scene. Its own cameras, if any, are not used.
        count: number of cameras, at least 1.
        width, height: pixels.
        seed: determines the first azimuth and the exact look-at points.
        every: number of splats of the full scene that each splat of the model represents.

    Returns:
        `count` cameras, the same for the same arguments. An object covers at least half of each image if that is
        possible.

    Raises:
        InputError: `count` is below 1 or the image size is invalid.
    """
    if count < 1:
        raise InputError(f"{count} virtual cameras, expected at least 1")
    around = partial(_cameras_around, size=(width, height), seed=seed, every=every)
    return deal(viewed_parts(model), count, around)


def _cameras_around(model: SplatModel, count: int, size: tuple[int, int], seed: int, every: int) -> list[Camera]:
    """Return `count` cameras around a scene or a part of it, as in `virtual_cameras`; `size` is width and height."""
    rng = np.random.default_rng(seed)
    frame = scene_frame(model)
    begin = 360.0 * float(rng.random())
    if len(model) == 0:
        K = intrinsics(*size, FIELD_OF_VIEW)
        return orbit(frame.centre, _EMPTY_DISTANCE, frame.up, count, K, *size, near=frame.near)
    cloud = sample_cloud(model, _POINTS, rng, every)
    K = intrinsics(*size, FIELD_OF_VIEW)
    camera_at = partial(frame.camera_at, K=K, width=size[0], height=size[1])
    if frame.kind == "object":
        return _around_object(frame, camera_at, cloud, count, begin, rng)
    return _in_surroundings(frame, camera_at, cloud, count, begin)


def viewed_parts(model: SplatModel) -> list[SplatModel]:
    """Return what of a scene is viewed each for itself, the largest first: its parts, or the scene if it has none.

    In place of a rest that surrounds a part, such as a sky, it is the whole scene. Splats at one place, which look like
    one splat, are not viewed.
    """
    step = max(1, len(model) // _PART_SAMPLE)
    points = model.means[::step].astype(np.float64)
    parts = find_parts(points, model.scales[::step])
    *models, rest = split_parts(model, parts)
    if parts and len(rest) >= part_min(len(points)) * (len(model) / len(points)):
        middle = np.median(rest.means, axis=0)
        reach = float(np.median(np.linalg.norm(rest.means - middle, axis=1)))
        surrounds = any(float(np.linalg.norm(middle - part.centre)) <= reach for part in parts)
        models.append(model if surrounds else rest)
    models = [part for part in models if part is model or _is_spread(part)]
    return sorted(models, key=len, reverse=True) or [model]


def _is_spread(part: SplatModel) -> bool:
    """Return True if half the splats of a part are farther from its middle than they are large."""
    distances = np.linalg.norm(part.means - np.median(part.means, axis=0), axis=1)
    return float(np.median(distances)) > median_size(part.scales.max(axis=1))


def deal(parts: Sequence[SplatModel], count: int, place: Callable[[SplatModel, int], Sequence[T]]) -> list[T]:
    """Place `count` cameras, the first around the first part, and so on in turn; `place` places a number of them."""
    shares = [(count + len(parts) - 1 - number) // len(parts) for number in range(len(parts))]
    placed = [place(part, share) if share else [] for part, share in zip(parts, shares, strict=True)]
    return [cameras[turn] for turn in range(shares[0]) for cameras in placed if turn < len(cameras)]


def _around_object(
    frame: SceneFrame, camera_at: _CameraAt, cloud: Cloud, count: int, begin: float, rng: np.random.Generator
) -> list[Camera]:
    """Place a camera in each of `count` equal sectors, by `_object_view`.

    Args:
        frame: the scene's frame.
        camera_at: `frame.camera_at` for the image.
        cloud: points of the scene.
        count: number of cameras.
        begin: azimuth of the middle of the first sector, degrees.
        rng: determines the look-at points.
    """
    width = 360.0 / count
    cameras = []
    for sector in range(count):
        offset = _TARGET_OFFSET * (2.0 * rng.random(3) - 1.0)
        elevations = np.roll(_OBJECT_ELEVATIONS, -sector)
        angles = [
            (begin + (sector + step) * width, float(elevation)) for elevation in elevations for step in _SECTOR_STEPS
        ]
        cameras.append(_object_view(frame, camera_at, cloud, angles, offset))
    return cameras


def _object_view(
    frame: SceneFrame, camera_at: _CameraAt, cloud: Cloud, angles: list[tuple[float, float]], offset: F64
) -> Camera:
    """Return the farthest view with sufficient cover and nothing close to the camera.

    If there is none, return the view with the largest cover.

    Args:
        frame, camera_at, cloud: as in `_around_object`.
        angles: azimuths and elevations to try, degrees, at least one.
        offset: [3], from the centre to the look-at point, extents.
    """
    needed = MIN_COVER + _COVER_MARGIN
    best, best_rank = camera_at(*angles[0], OBJECT_DISTANCES[0], offset=offset), (False, -1.0)
    highest, highest_at = 1.0, OBJECT_DISTANCES[0]
    for distance in OBJECT_DISTANCES:
        if highest * (highest_at / distance) ** 2 < _HOPELESS * needed:
            continue  # the cover at the last distance implies that this distance is not sufficient either
        covers = []
        for angle in angles:
            camera = camera_at(*angle, distance, offset=offset)
            covers.append(covered_fraction(cloud, camera))
            enough = covers[-1] >= needed
            if enough and is_clear(frame, cloud, camera):
                return camera
            if (enough, covers[-1]) > best_rank:
                best, best_rank = camera, (enough, covers[-1])
        highest, highest_at = max(covers), distance
        ranked = np.argsort(-np.array(covers), kind="stable")  # only the most promising angles are tried nearer
        angles = [angles[i] for i in ranked[:_PROMISING]]
    return best


def _in_surroundings(frame: SceneFrame, camera_at: _CameraAt, cloud: Cloud, count: int, begin: float) -> list[Camera]:
    """Choose views with fine detail that are farthest from each other.

    If too few have fine detail, the views with the most are used; if `count` exceeds all positions, views repeat.

    Args:
        frame, camera_at, cloud: as in `_around_object`.
        count: number of cameras.
        begin: first azimuth, degrees.
    """
    azimuths = begin + np.arange(0.0, 360.0, _AZIMUTH_STEP)
    angles = [(azimuth, elevation) for azimuth in azimuths for elevation in _SURROUNDING_ELEVATIONS]
    cameras = [camera_at(*angle, distance) for distance in SURROUNDING_DISTANCES for angle in angles]
    details = np.array([detail(cloud, camera, HIDING * frame.extent) for camera in cameras])
    good = details >= _GOOD_DETAIL * details.max()
    enough = len(angles)
    while enough < len(cameras) and np.count_nonzero(good[:enough]) < count:
        enough += len(angles)  # nearer views are used only if there are too few farther views
    pool = np.flatnonzero(good[:enough])
    if len(pool) < count:
        pool = np.argsort(-details, kind="stable")[: max(count, len(pool))]
    positions = np.stack([camera.position for camera in cameras])
    chosen = farthest_points(positions[pool], int(np.argmax(details[pool])), min(count, len(pool)))
    views = [cameras[i] for i in pool[chosen]]
    return [views[i % len(views)] for i in range(count)]


def farthest_points(points: F64, first: int, count: int) -> list[int]:
    """Return the indices of `count` points, each the farthest from all points before it."""
    chosen = [first]
    gap = np.sum((points - points[first]) ** 2, axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
    return chosen
