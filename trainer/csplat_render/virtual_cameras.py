"""Virtual cameras around a scene that has none: the cameras of `psnr`.

An *object* is seen from all sides and slightly to steeply above, so near that it covers at least half of each image. In
*surroundings*, cameras are placed around or inside of the dense middle, where nothing close by hides it.

Distances are part of what a PSNR means (the same error scores 33, 39 and 48 dB from one, two and four times as far
away), so they are fixed multiples of the scene's extent: `OBJECT_DISTANCES`, `SURROUNDING_DISTANCES`. Everything comes
from the source alone; the seed decides directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F64
from csplat_render.camera import Camera, direction_at, intrinsics, look_at, orbit
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

#: Distances from the centre of an object, in extents, in the order in which they are tried.
OBJECT_DISTANCES = (1.25, 1.125, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)

#: Distances from the centre of surroundings, in extents, in the order in which they are tried.
SURROUNDING_DISTANCES = (1.3, 0.8, 0.5)

#: Least fraction of each image that an object covers.
MIN_COVER = 0.5

#: Distance in extents below which splats in surroundings hide others without showing detail.
HIDING = 0.4

_COVER_MARGIN = 0.015  # error of the estimated cover
_OBJECT_ELEVATIONS = (5.0, 25.0, 50.0)
_SURROUNDING_ELEVATIONS = (3.0, 15.0, 35.0)
_PROMISING = 4  # number of directions in which nearer cameras are tried
_TARGET_OFFSET = 0.05  # extents; largest distance of the look-at point from an object's centre
_CLEAR_RADIUS = 0.32  # fraction of a camera's distance from the centre: radius that has to be clear of an object
_CLEAR_SHARE = 0.01  # fraction of an object's surface that may lie within it
_GOOD_DETAIL = 0.65  # fraction of the best view's detail
_AZIMUTH_STEP = 15.0  # degrees
_POINTS = 60_000  # points of a cloud


def is_clear(frame: SceneFrame, cloud: Cloud, camera: Camera) -> bool:
    """Return True if hardly any surface is so near to a camera that it would show as fog, or from inside."""
    radius = _CLEAR_RADIUS * float(np.linalg.norm(camera.position - frame.centre))
    return share_within(cloud, camera.position, radius) <= _CLEAR_SHARE


def virtual_cameras(
    model: SplatModel, count: int = 8, width: int = 640, height: int = 480, seed: int = 0, every: int = 1
) -> list[Camera]:
    """Return cameras around a scene, chosen from the scene alone.

    Args:
        model: the scene. Its training cameras, if it has any, are not used.
        count: number of cameras, at least 1.
        width: pixels.
        height: pixels.
        seed: determines the first azimuth and the exact look-at points.
        every: number of the scene's splats that each of the model's represents.

    Returns:
        `count` cameras, the same for the same arguments. An object covers at least half of each
        image, if a nearer camera can achieve it.

    Raises:
        InputError: `count` is below 1 or the size is not that of an image.
    """
    if count < 1:
        raise InputError(f"{count} virtual cameras, expected at least 1")
    rng = np.random.default_rng(seed)
    frame = scene_frame(model)
    begin = 360.0 * float(rng.random())
    if len(model) == 0:
        K = intrinsics(width, height, FIELD_OF_VIEW)
        return orbit(frame.centre, 2.2, frame.up, count, K, width, height, near=frame.near)
    cloud = sample_cloud(model, _POINTS, rng, every)
    K = intrinsics(width, height, FIELD_OF_VIEW)
    views = _CameraPlacement(frame, K, width, height)
    if frame.kind == "object":
        return _around_object(views, cloud, count, begin, rng)
    return _in_surroundings(views, cloud, count, begin)


@dataclass(frozen=True, eq=False)
class _CameraPlacement:
    """A scene frame and intrinsics, for cameras given by angles in degrees and lengths in extents."""

    frame: SceneFrame
    K: F64
    width: int
    height: int

    def at(self, azimuth: float, elevation: float, distance: float, offset: F64 | None = None) -> Camera:
        frame = self.frame
        eye = frame.centre + distance * frame.extent * direction_at(frame.up, azimuth, elevation)
        target = frame.centre if offset is None else frame.centre + frame.extent * offset
        return look_at(eye, target, frame.up, self.K, self.width, self.height, frame.near)


def _around_object(
    views: _CameraPlacement, cloud: Cloud, count: int, begin: float, rng: np.random.Generator
) -> list[Camera]:
    """Place one camera in each of `count` equal sectors, as far away as the object covers enough of the image."""
    width = 360.0 / count
    cameras = []
    for sector in range(count):
        offset = _TARGET_OFFSET * (2.0 * rng.random(3) - 1.0)
        elevations = np.roll(_OBJECT_ELEVATIONS, -sector)
        angles = [
            (begin + (sector + step) * width, float(elevation))
            for elevation in elevations
            for step in (0.0, 1.0 / 3.0, -1.0 / 3.0)
        ]
        cameras.append(_object_view(views, cloud, angles, offset))
    return cameras


def _object_view(views: _CameraPlacement, cloud: Cloud, angles: list[tuple[float, float]], offset: F64) -> Camera:
    """Return the farthest view of which the object covers enough, with nothing close by."""
    needed = MIN_COVER + _COVER_MARGIN
    best, best_rank = views.at(*angles[0], OBJECT_DISTANCES[0], offset), (False, -1.0)
    highest, highest_at = 1.0, OBJECT_DISTANCES[0]
    for distance in OBJECT_DISTANCES:
        if highest * (highest_at / distance) ** 2 < 0.8 * needed:
            continue  # the cover from farther away shows that this distance is not enough either
        covers = []
        for angle in angles:
            camera = views.at(*angle, distance, offset)
            covers.append(covered_fraction(cloud, camera))
            enough = covers[-1] >= needed
            if enough and is_clear(views.frame, cloud, camera):
                return camera
            if (enough, covers[-1]) > best_rank:
                best, best_rank = camera, (enough, covers[-1])
        highest, highest_at = max(covers), distance
        ranked = np.argsort(-np.array(covers), kind="stable")  # only the most promising come nearer
        angles = [angles[i] for i in ranked[:_PROMISING]]
    return best


def _in_surroundings(views: _CameraPlacement, cloud: Cloud, count: int, begin: float) -> list[Camera]:
    """Choose, among the views that show fine detail, those with the largest distances from each other."""
    azimuths = begin + np.arange(0.0, 360.0, _AZIMUTH_STEP)
    angles = [(azimuth, elevation) for azimuth in azimuths for elevation in _SURROUNDING_ELEVATIONS]
    cameras = [views.at(*angle, distance) for distance in SURROUNDING_DISTANCES for angle in angles]
    details = np.array([detail(cloud, camera, HIDING * views.frame.extent) for camera in cameras])
    good = details >= _GOOD_DETAIL * details.max()
    enough = len(angles)
    while enough < len(cameras) and np.count_nonzero(good[:enough]) < count:
        enough += len(angles)  # nearer views only if the farther ones are too few
    pool = np.flatnonzero(good[:enough])
    if len(pool) < count:
        pool = np.argsort(-details, kind="stable")[: max(count, len(pool))]
    positions = np.stack([camera.position for camera in cameras])
    chosen = farthest_points(positions[pool], int(np.argmax(details[pool])), min(count, len(pool)))
    picked = [cameras[i] for i in pool[chosen]]
    return [picked[i % len(picked)] for i in range(count)]


def farthest_points(points: F64, first: int, count: int) -> list[int]:
    """Return the indices of `count` points, each the farthest from those before it."""
    chosen = [first]
    gap = np.sum((points - points[first]) ** 2, axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
    return chosen
