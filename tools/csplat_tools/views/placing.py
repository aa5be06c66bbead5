"""Virtual cameras that teach: many, small, spread evenly at any count; and a user's own, made as small.

Many small pictures overfit less than few large ones of as many pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.cameras import direction, intrinsics, look_at
from csplat_render.cloud import detail, sample_cloud
from csplat_render.virtual import FIELD_OF_VIEW, HIDING, Frame, is_clear, scene_frame

__all__ = [
    "CHECKS",
    "VIEW_COUNT",
    "VIEW_SIZE",
    "VIRTUAL_SIZES",
    "VirtualSizes",
    "camera_sequence",
    "evenly",
    "reduced",
    "usual_views",
]

F64 = NDArray[np.float64]
T = TypeVar("T")

#: Virtual views that teach, unless others are asked for: how many at most; width and height of their pictures, pixels.
#: Those of small scenes: see `usual_views`.
VIEW_COUNT = 160
VIEW_SIZE = (240, 180)

#: Virtual views beside those that are asked for: whether what these taught holds elsewhere, they say.
CHECKS = 16


@dataclass(frozen=True)
class VirtualSizes:
    """Virtual views that fit nothing: how many there are, and the width and height of their pictures in pixels.

    Attributes:
        judging: those of `psnr`.
        deciding: those that decide.
        elsewhere: those of `elsewhere`, of each kind.
    """

    judging: tuple[int, int, int] = (8, 640, 480)
    deciding: tuple[int, int, int] = (12, 320, 240)
    elsewhere: tuple[int, int, int] = (12, 320, 240)


#: The usual ones, by which all published figures were measured.
VIRTUAL_SIZES = VirtualSizes()

_PIXELS = 50  # of all views together, for every splat
_LARGEST = 2.0  # times as wide and high: all pictures are in memory, and larger ones would be too few
_POINTS = 20_000
_OBJECT_DISTANCE = (0.95, 1.6)  # extents from the centre
_OBJECT_HEIGHT = (-0.95, 0.98)  # sines of elevations: objects are looked at from below, too
_OBJECT_OFFSET = 0.2  # how far beside the centre a camera looks, extents
_AROUND_DISTANCE = (0.35, 1.45)
_AROUND_HEIGHT = (-0.12, 0.7)
_AROUND_OFFSET = 0.35
_OUTWARDS = 5  # one view of so many looks away from the middle of surroundings
_GOOD_DETAIL = 0.4  # of the best view's; views of walls from behind say nothing
_CANDIDATES = 3  # for each view
_STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)  # powers of 1 / the root of x⁴ = x + 1


def usual_views(splats: int) -> tuple[int, tuple[int, int]]:
    """How many virtual views teach at most, and the width and height of their pictures, by how many splats there are.

    A picture costs by the splat, not by the pixel: of many splats, fewer and larger ones say more in less time. At the
    same PSNR a file of 290,000 splats is 16 % smaller with 110 views of 348x261 than with 160 of 240x180.
    """
    larger = min(max(math.sqrt(_PIXELS * splats / (VIEW_COUNT * math.prod(VIEW_SIZE))), 1.0), _LARGEST)
    width, height = (round(larger * side) for side in VIEW_SIZE)
    return round(VIEW_COUNT / larger), (width, height)


def camera_sequence(model: SplatModel, count: int, size: tuple[int, int] = VIEW_SIZE, *, seed: int = 0) -> list[Camera]:
    """Virtual cameras around a scene, spread evenly at any count: the first ones of a longer list are the same.

    Args:
        model: the scene; its own cameras are not looked at.
        count: how many.
        size: width and height of the pictures, pixels.
        seed: where the sequence begins.

    Returns:
        `count` cameras, by a low-discrepancy sequence over directions, distances and what they look at. Those that an
        object hides from nearby are left out, and in surroundings those that show little detail.
    """
    frame = scene_frame(model)
    K = intrinsics(*size, FIELD_OF_VIEW)
    points = _sequence(_CANDIDATES * count, seed)
    if not len(model):
        return [_around_object(frame, point, K, size) for point in points[:count]]
    cloud = sample_cloud(model, _POINTS, np.random.default_rng(seed))
    if frame.kind == "object":
        around = [_around_object(frame, point, K, size) for point in points]
        return sorted(around, key=lambda camera: not is_clear(frame, cloud, camera))[:count]
    cameras = [_in_surroundings(frame, number, point, K, size) for number, point in enumerate(points)]
    details = np.array([detail(cloud, camera, HIDING * frame.extent) for camera in cameras])
    inwards = np.arange(len(cameras)) % _OUTWARDS != 0
    best = np.where(inwards, details[inwards].max(), details[~inwards].max())
    good = np.flatnonzero(details >= _GOOD_DETAIL * best)
    rest = np.setdiff1d(np.argsort(-details, kind="stable"), good, assume_unique=True)
    return [cameras[i] for i in [*good, *rest][:count]]


def reduced(cameras: Sequence[Camera], size: tuple[int, int] = VIEW_SIZE) -> list[Camera]:
    """The same views in pictures of about as many pixels as `size` has, if they have more."""
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
    """[count, 6] points in the unit cube; the first three coordinates evenly spread, the others random."""
    rng = np.random.default_rng(seed)
    start = rng.random(len(_STEPS))
    even = np.mod(start + np.arange(1, count + 1)[:, None] * np.array(_STEPS), 1.0)
    return np.concatenate([even, rng.random((count, 3))], axis=1)


def _between(bounds: tuple[float, float], at: float) -> float:
    return bounds[0] + (bounds[1] - bounds[0]) * at


def _around_object(frame: Frame, point: F64, K: F64, size: tuple[int, int]) -> Camera:
    height = _between(_OBJECT_HEIGHT, point[1])
    along = direction(frame.up, 360.0 * point[0], math.degrees(math.asin(height)))
    eye = frame.centre + frame.extent * _between(_OBJECT_DISTANCE, point[2]) * along
    target = frame.centre + frame.extent * _OBJECT_OFFSET * (2.0 * point[3:] - 1.0)
    return look_at(eye, target, frame.up, K, *size, frame.near)


def _in_surroundings(frame: Frame, number: int, point: F64, K: F64, size: tuple[int, int]) -> Camera:
    along = direction(frame.up, 360.0 * point[0], math.degrees(math.asin(_between(_AROUND_HEIGHT, point[1]))))
    offset = _AROUND_OFFSET * (2.0 * point[3:] - 1.0)
    if number % _OUTWARDS == 0:
        eye = frame.centre + frame.extent * offset
        target = eye + along
    else:
        eye = frame.centre + frame.extent * _between(_AROUND_DISTANCE, point[2]) * along
        target = frame.centre + frame.extent * offset
    return look_at(eye, target, frame.up, K, *size, frame.near)


def evenly(those: Sequence[T], most: int) -> list[T]:
    """So many of those at most, spread over their order."""
    places = np.linspace(0, len(those) - 1, min(most, len(those))).round().astype(int)
    return [those[i] for i in places]
