"""Cameras to decide by: many, small, from all around, more of them until they agree with some that were kept aside.

The views decide what is needed, and a choice fits the views that it was made with better than others. Many small
pictures overfit less than few large ones of as many pixels. How far they do is known without a render of the result:
the predicted error of what is to go, on the views that chose it and on views that did not, has to be about the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.cameras import direction, intrinsics, look_at
from csplat_render.cloud import detail, sample_cloud
from csplat_render.conventions import ALPHA_MIN
from csplat_render.removal import Removal, measure_removal
from csplat_render.virtual import FIELD_OF_VIEW, Frame, scene_frame

__all__ = ["VIEW_SIZE", "Views", "camera_sequence", "find_views", "reduced", "removal_keys", "split_views"]

F64 = NDArray[np.float64]

#: Width and height of the pictures that decide, in pixels.
VIEW_SIZE = (240, 180)

_POINTS = 20_000
_OBJECT_DISTANCE = (0.95, 1.6)  # extents from the centre
_OBJECT_HEIGHT = (-0.95, 0.98)  # sines of elevations: objects are looked at from below, too
_OBJECT_OFFSET = 0.2  # how far beside the centre a camera looks, extents
_AROUND_DISTANCE = (0.35, 1.45)
_AROUND_HEIGHT = (-0.12, 0.7)
_AROUND_OFFSET = 0.35
_OUTWARDS = 5  # one view of so many looks away from the middle of surroundings
_HIDING = 0.4  # extents; as for virtual cameras: what is nearer only hides
_GOOD_DETAIL = 0.4  # of the best view's; views of walls from behind say nothing
_CANDIDATES = 3  # for each view in surroundings
_STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)  # powers of 1 / the root of x⁴ = x + 1
_HELD_OUT = 8  # one of so many of the user's own cameras is kept aside

#: What is told how far a stage has come: its name, and 0 to 1.
Progress = Callable[[str, float], None]

_BATCH = 40  # virtual views that are added at a time
_CHECKS = 16  # virtual views that are kept aside
# dB between what is predicted for used views and for others, below which there are enough. Fits follow their views
# farther than choices do: at 1 dB lego60k stops at 40 views, and is 3 dB better on others with 160.
_AGREED = 0.1
_SETTLED = 0.005  # share of the splats that the check views alone show, below which there are enough


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras to decide by, others to check by, and what the ones to decide by say.

    Attributes:
        used: they decide.
        check: they were kept aside.
        removal: of the source, measured from `used`.
        gap: dB by which the error that is predicted for the share that is to go is larger in `check` than in `used`.
    """

    used: list[Camera]
    check: list[Camera]
    removal: Removal
    gap: float


def find_views(
    model: SplatModel,
    cameras: Sequence[Camera] | None,
    gone: float,
    *,
    size: tuple[int, int] = VIEW_SIZE,
    most: int = 160,
    seed: int = 0,
    background: ArrayLike = (0.0, 0.0, 0.0),
    threads: int | None = None,
    progress: Progress | None = None,
) -> Views:
    """Choose the views, and measure the source from them.

    Args:
        model: the source.
        cameras: the user's own, of which all but every eighth are used; None for virtual ones, batch by batch until
            no new splats appear and used and unused views agree, or there are `most`.
        gone: share of the splats that is to go; what is predicted for it has to agree.
        size: of the pictures; the user's cameras keep their shape and are never enlarged.
        most: virtual views at most.
        seed: of the virtual views.
        background: red, green, blue behind everything.
        threads: how many; None for all.
        progress: is told how much is done.

    Raises:
        InputError: there are fewer than two cameras.
    """

    def measured(views: Sequence[Camera]) -> Removal:
        return measure_removal(model, views, background=background, threads=threads, progress=progress)

    if cameras is not None:
        used, check = split_views(reduced(cameras, size))
        removal = measured(used)
        return Views(used, check, removal, _gap(model, removal, measured(check), gone))
    if most < 1:
        raise InputError(f"{most} views, wanted 1 at least")
    all_views = camera_sequence(model, most + _CHECKS, size, seed=seed)
    # Evenly from the whole sequence: its beginning is not spread as evenly as all of it.
    aside = np.linspace(0, len(all_views) - 1, _CHECKS + 2).astype(int)[1:-1]
    check = [all_views[i] for i in aside]
    rest = [view for i, view in enumerate(all_views) if i not in set(aside.tolist())]
    checked = measured(check)
    removal, count = measured(rest[:_BATCH]), min(_BATCH, len(rest))
    while count < len(rest):
        missed = int(np.count_nonzero(checked.seen & ~removal.seen))
        if missed <= _SETTLED * len(model) and _gap(model, removal, checked, gone) < _AGREED:
            break
        removal += measured(rest[count : count + _BATCH])
        count = min(count + _BATCH, len(rest))
    return Views(rest[:count], check, removal, _gap(model, removal, checked, gone))


def removal_keys(model: SplatModel, removal: Removal, *, keep_unseen: bool = True) -> F64:
    """By what splats go, the smallest first.

    Args:
        model: the scene.
        removal: of the scene.
        keep_unseen: what no view saw goes last, instead of first.

    Returns:
        [N] float64: −1 where no picture can show a splat, its alpha being too small to be drawn; the error of its
        removal; infinity for what no view saw.
    """
    keys = np.where(removal.seen, removal.error, np.inf if keep_unseen else -0.5)
    keys[model.opacities < ALPHA_MIN] = -1.0
    return keys


def _gap(model: SplatModel, used: Removal, check: Removal, gone: float) -> float:
    """How much larger, in dB, the predicted error is where it was not looked at."""
    order = np.argsort(removal_keys(model, used), kind="stable")[: int(gone * len(model))]
    order = order[np.isfinite(removal_keys(model, used)[order])]
    there = float(np.sum(used.error[order])) / used.value_count
    elsewhere = float(np.sum(check.error[order])) / check.value_count
    return 10.0 * math.log10(elsewhere / there) if there > 0.0 and elsewhere > 0.0 else 0.0


def camera_sequence(model: SplatModel, count: int, size: tuple[int, int] = VIEW_SIZE, *, seed: int = 0) -> list[Camera]:
    """Virtual cameras around a scene, spread evenly at any count: the first ones of a longer list are the same.

    Args:
        model: the scene; its own cameras are not looked at.
        count: how many.
        size: width and height of the pictures, pixels.
        seed: where the sequence begins.

    Returns:
        `count` cameras, by a low-discrepancy sequence over directions, distances and what they look at. In
        surroundings those that show little detail are left out.
    """
    frame = scene_frame(model)
    K = intrinsics(*size, FIELD_OF_VIEW)
    if frame.kind == "object" or not len(model):
        return [_around_object(frame, point, K, size) for point in _sequence(count, seed)]
    points = _sequence(_CANDIDATES * count, seed)
    cameras = [_in_surroundings(frame, number, point, K, size) for number, point in enumerate(points)]
    cloud = sample_cloud(model, _POINTS, np.random.default_rng(seed))
    details = np.array([detail(cloud, camera, _HIDING * frame.extent) for camera in cameras])
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


def split_views(cameras: Sequence[Camera]) -> tuple[list[Camera], list[Camera]]:
    """Keep every eighth camera aside, to check by.

    Raises:
        InputError: there are fewer than two.
    """
    if len(cameras) < 2:
        raise InputError(f"{len(cameras)} cameras, wanted 2 at least: one to decide by, one to check by")
    every = min(_HELD_OUT, len(cameras))
    return [c for i, c in enumerate(cameras) if i % every != every // 2], list(cameras[every // 2 :: every])


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
