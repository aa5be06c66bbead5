"""Virtual cameras around a scene that has none: the cameras of `psnr`.

Two kinds of scene are distinguished by where their surface lies. An *object* is seen from outside,
from all sides and slightly to steeply above, so near that it covers at least half of each image.
*Surroundings* reach much farther than their dense middle; cameras are placed around or inside of that
middle, where nothing close by hides it.

Distances are part of what a PSNR means (the same error scores 33, 39 and 48 dB from one, two and
four times as far away), so they are fixed multiples of the scene's extent: `OBJECT_DISTANCES`,
`SURROUNDING_DISTANCES`. Everything comes from the source alone; the seed decides directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F64
from csplat.upright import up_of
from csplat_render.camera import DEFAULT_NEAR, Camera
from csplat_render.cameras import direction, intrinsics, look_at, orbit
from csplat_render.cloud import (
    Cloud,
    cover,
    detail,
    sample_cloud,
    share_within,
    surface_areas,
    visible_opacity,
    weighted_quantiles,
)

Kind = Literal["object", "surrounding"]

#: Horizontal field of view, degrees.
FIELD_OF_VIEW = 60.0

#: Distances from the centre of an object that are tried in turn, in extents.
OBJECT_DISTANCES = (1.25, 1.125, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)

#: Distances from the centre of surroundings that are tried in turn, in extents.
SURROUNDING_DISTANCES = (1.3, 0.8, 0.5)

#: An object covers at least this much of each picture.
MIN_COVER = 0.5

#: Extents; what is nearer to a camera in surroundings only hides.
HIDING = 0.4

_COVER_MARGIN = 0.015  # the estimate of the cover errs by as much
_OBJECT_ELEVATIONS = (5.0, 25.0, 50.0)
_SURROUNDING_ELEVATIONS = (3.0, 15.0, 35.0)
_PROMISING = 4  # directions in which a camera comes nearer to an object
_TARGET_OFFSET = 0.05  # objects are looked at this far from their centre, at most, in extents
_CLEAR_RADIUS = 0.32  # fraction of the distance from the centre: hardly anything may be so near to a camera
_CLEAR_SHARE = 0.01  # fraction of an object's surface that may lie there
_NEAR = 0.05  # near plane in extents, DEFAULT_NEAR at most
_FAR_REACH = 4.0  # times the distance within which half the opacity lies: no object's surface
_FAR_SHARE = 0.02  # fraction of the surface; with more than that beyond, a scene is no object
_FLAT = 0.6  # an extent this much shorter than the next one points up
_GOOD_DETAIL = 0.65  # fraction of the best view's detail
_AZIMUTH_STEP = 15.0  # degrees
_POINTS = 60_000


@dataclass(frozen=True, eq=False)
class Frame:
    """Position, extent, up direction and kind of a scene.

    Attributes:
        kind: `"object"` or `"surrounding"`.
        centre: [3] float64, relative to the model's origin.
        extent: length that all distances are multiples of, scene units, above 0. Objects: half
            the diagonal of the box that holds 5 to 95 % of the opacity along each axis.
            Surroundings: the distance from the centre within which half the opacity lies.
        up: [3] float64, unit length.
    """

    kind: Kind
    centre: F64
    extent: float
    up: F64

    @property
    def near(self) -> float:
        """Near plane that suits the extent, scene units."""
        return min(DEFAULT_NEAR, _NEAR * self.extent)


def scene_frame(model: SplatModel) -> Frame:
    """Return the centre of a scene, its extent, its up direction and its kind.

    A scene without splats is an object of extent 1 at the origin.
    """
    if len(model) == 0:
        return Frame("object", np.zeros(3), 1.0, np.array([0.0, -1.0, 0.0]))
    alpha, areas = visible_opacity(model), surface_areas(model)
    means = model.means.astype(np.float64)
    low, middle, high = np.stack([weighted_quantiles(means[:, k], alpha, (0.05, 0.5, 0.95)) for k in range(3)], axis=1)
    half = (high - low) / 2.0
    up = _up(model, half)
    distances = np.sqrt(np.sum((means - middle) ** 2, axis=1))
    reach = float(weighted_quantiles(distances, alpha, (0.5,))[0])
    surface = alpha * np.minimum(areas, (0.5 * reach) ** 2)  # no floater outweighs a scene
    if np.sum(surface[distances > _FAR_REACH * reach]) > _FAR_SHARE * np.sum(surface):
        return Frame("surrounding", middle, reach, up)
    extent = float(np.sqrt(np.sum(half**2)))
    if extent <= 0.0:  # one splat, or several in one place
        extent = 3.0 * float(np.sqrt(np.max(areas[alpha > 0.0]) / (2.0 * np.pi)))
    return Frame("object", (low + high) / 2.0, extent, up)


def is_clear(frame: Frame, cloud: Cloud, camera: Camera) -> bool:
    """Return True if hardly any of a scene is so near to a camera that it would show it as fog, or from inside."""
    radius = _CLEAR_RADIUS * float(np.linalg.norm(camera.position - frame.centre))
    return share_within(cloud, camera.position, radius) <= _CLEAR_SHARE


def virtual_cameras(
    model: SplatModel, count: int = 8, width: int = 640, height: int = 480, seed: int = 0, every: int = 1
) -> list[Camera]:
    """Cameras around a scene, chosen from the scene alone.

    Args:
        model: the scene. Its training cameras, if it has any, are not looked at.
        count: number of cameras, at least 1.
        width: pixels.
        height: pixels.
        seed: decides where around the scene the cameras begin, and what exactly they look at.
        every: number of the scene's splats that each of the model's represents.

    Returns:
        `count` cameras, the same for the same arguments. An object covers at least half of each
        picture, as far as coming nearer helps.

    Raises:
        InputError: `count` is below 1 or the size is no picture's.
    """
    if count < 1:
        raise InputError(f"{count} virtual cameras, wanted at least 1")
    rng = np.random.default_rng(seed)
    frame = scene_frame(model)
    begin = 360.0 * float(rng.random())
    if len(model) == 0:
        K = intrinsics(width, height, FIELD_OF_VIEW)
        return orbit(frame.centre, 2.2, frame.up, count, K, width, height, near=frame.near)
    cloud = sample_cloud(model, _POINTS, rng, every)
    K = intrinsics(width, height, FIELD_OF_VIEW)
    views = _Views(frame, K, width, height)
    if frame.kind == "object":
        return _around_object(views, cloud, count, begin, rng)
    return _in_surroundings(views, cloud, count, begin)


@dataclass(frozen=True, eq=False)
class _Views:
    """Makes cameras in terms of a frame: angles in degrees, lengths in extents."""

    frame: Frame
    K: F64
    width: int
    height: int

    def at(self, azimuth: float, elevation: float, distance: float, offset: F64 | None = None) -> Camera:
        frame = self.frame
        eye = frame.centre + distance * frame.extent * direction(frame.up, azimuth, elevation)
        target = frame.centre if offset is None else frame.centre + frame.extent * offset
        return look_at(eye, target, frame.up, self.K, self.width, self.height, frame.near)


def _around_object(views: _Views, cloud: Cloud, count: int, begin: float, rng: np.random.Generator) -> list[Camera]:
    """One camera in each of `count` equal sectors, from as far away as the object covers enough."""
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


def _object_view(views: _Views, cloud: Cloud, angles: list[tuple[float, float]], offset: F64) -> Camera:
    """The first view that covers enough with nothing close by, the farthest tried first."""
    needed = MIN_COVER + _COVER_MARGIN
    best, best_rank = views.at(*angles[0], OBJECT_DISTANCES[0], offset), (False, -1.0)
    highest, highest_at = 1.0, OBJECT_DISTANCES[0]
    for distance in OBJECT_DISTANCES:
        if highest * (highest_at / distance) ** 2 < 0.8 * needed:
            continue  # the cover from farther away shows that this distance does not suffice either
        covers = []
        for angle in angles:
            camera = views.at(*angle, distance, offset)
            covers.append(cover(cloud, camera))
            enough = covers[-1] >= needed
            if enough and is_clear(views.frame, cloud, camera):
                return camera
            if (enough, covers[-1]) > best_rank:
                best, best_rank = camera, (enough, covers[-1])
        highest, highest_at = max(covers), distance
        ranked = np.argsort(-np.array(covers), kind="stable")  # only the most promising come nearer
        angles = [angles[i] for i in ranked[:_PROMISING]]
    return best


def _in_surroundings(views: _Views, cloud: Cloud, count: int, begin: float) -> list[Camera]:
    """Choose, among the views that show fine detail, those that lie farthest apart."""
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
    chosen = far_apart(positions[pool], int(np.argmax(details[pool])), min(count, len(pool)))
    picked = [cameras[i] for i in pool[chosen]]
    return [picked[i % len(picked)] for i in range(count)]


def far_apart(points: F64, first: int, count: int) -> list[int]:
    """Positions of `count` points, each the farthest from those before it."""
    chosen = [first]
    gap = np.sum((points - points[first]) ** 2, axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
    return chosen


def _up(model: SplatModel, half: F64) -> F64:
    """Return the up direction: the scene's own; else the short axis of a flat scene; else −y, as in a PLY."""
    said = up_of(model.metadata, model.coordinate_system)
    if said is not None:
        named: F64 = np.array(said)
        named /= np.sqrt(np.sum(named**2))  # six digits are not unit length
        return named
    up = np.zeros(3)
    order = np.argsort(half, kind="stable")
    axis = int(order[0]) if half[order[0]] < _FLAT * half[order[1]] else 1
    up[axis] = -1.0 if axis == 1 else 1.0
    return up
