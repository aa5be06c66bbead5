# SPDX-License-Identifier: Apache-2.0
"""Initial splats: at known points, inside the visual hull of the masks, or anywhere in a box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64
from csplat_render.camera import Camera
from csplat_render.neighbours import nearest_neighbours
from csplat_trainer.parameters import ParameterArrays
from csplat_trainer.posed_images import PosedImage

_OPACITY = 0.5  # initial opacity
_BATCH = 20_000  # points drawn at a time
_BATCHES = 400  # largest number of batches
_MASK = 0.02  # least alpha of pixels of the object
_MISSES = 0.02  # fraction of the images that may miss a point of the hull, due to rounding to pixels
_ROUNDING = 1e-9  # tolerance of that fraction in float64
_UNSEEN_COLOUR = 0.5  # grey, of points without a pixel of the object
_SPACING_MIN = 1e-4  # least size of a splat, as a fraction of the median size
_TINY = 1e-6  # scene units; least size of a box, and least distance of a guess of the focus
_EXTENT_FACTOR = 1.1  # INRIA's margin around the cameras
_EXTENT_MIN = 1e-3  # scene units; least extent if all cameras are in one place
_GUESS_WEIGHT = 1e-3  # weight of the guess of the focus, relative to a camera's line of sight
_NEIGHBOURS = 3  # number of neighbours whose distance determines a splat's size
_BOX_FRACTION = 0.9  # fraction of the median camera's field of view at the distance of the focus
_PHOTO_BOX = 1.5  # half the box as a multiple of that distance, for images without alpha, which show surroundings


@dataclass(frozen=True)
class SceneExtent:
    """Extent and focus of a scene, estimated from its cameras.

    Attributes:
        extent: 1.1 times the largest distance of a camera from their centre (INRIA's unit of the learning rate of the
            means), scene units.
        focus: [3], the point nearest to all lines of sight.
        half: half the side of the box around `focus` for initial splats, scene units.
    """

    extent: float
    focus: F64
    half: float


def measure_extent(images: Sequence[PosedImage]) -> SceneExtent:
    """Measure the extent and the focus of the scene.

    Args:
        images: at least one, without outliers: `DataSet.inliers`.
    """
    cameras = [image.camera for image in images]
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.viewmat[2, :3] for camera in cameras])
    spread = np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()
    # Least squares over the distances from the lines; the small term makes it well-posed for parallel lines.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weight = _GUESS_WEIGHT * len(cameras)
    guess = (positions + axes * max(float(spread), _TINY)).mean(axis=0)
    normal_matrix = across.sum(axis=0) + weight * np.eye(3)
    focus = np.linalg.solve(normal_matrix, np.einsum("nij,nj->i", across, positions) + weight * guess)
    distance = float(np.median(np.linalg.norm(positions - focus, axis=1)))
    half_view = float(np.median([0.5 * min(c.W / c.K[0, 0], c.H / c.K[1, 1]) for c in cameras]))
    half = distance * half_view * _BOX_FRACTION
    if not any(image.has_alpha for image in images):
        half = distance * _PHOTO_BOX
    extent = _EXTENT_FACTOR * float(spread)
    if extent <= 0.0:  # all cameras in one place
        extent = max(distance, _EXTENT_MIN)
    return SceneExtent(extent, focus, max(half, _TINY))


def place_splats(
    images: Sequence[PosedImage],
    scene: SceneExtent,
    count: int,
    sh_degree: int,
    rng: Generator,
    *,
    init: str = "auto",
    points: F32 | None = None,
    colours: F32 | None = None,
) -> ParameterArrays:
    """Place the initial splats.

    Args:
        images: images of the training views.
        scene: extent and focus of the scene.
        count: number of splats.
        sh_degree: SH degree of the parameters; bands above 0 begin at zero.
        rng: source of random choices.
        init: `points`, `hull`, `box`, or `auto` for the first that is possible.
        points: [P, 3], points of the scene, if the data set has any.
        colours: [P, 3] in 0..1, their colours; `None`: mean colours from the images.

    Raises:
        InputError: there are no points or masks as required, or points are not finite.
    """
    have_points = points is not None and len(points) > 0
    have_masks = any(image.has_alpha for image in images)
    if init == "points" and not have_points:
        raise InputError("init='points' requires points, but the data set has none: expected init='hull' or 'box'")
    if init == "hull" and not have_masks:
        raise InputError("init='hull' requires images with alpha: expected init='points' or 'box'")
    if have_points and init in ("points", "auto"):
        assert points is not None
        bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        if bad:
            raise InputError(f"{bad} of the data set's {len(points)} points are NaN or infinite, expected finite ones")
        if not any(len(_pixels_at(image, points.astype(np.float64))[0]) for image in images):
            raise InputError(
                f"no camera sees any of the data set's {len(points)} points, expected both in the same coordinates:"
                " TrainOptions(init='box') starts without points"
            )
        if colours is None:
            colours = _sample_images(images, points.astype(np.float64))[2].astype(np.float32)
        means, colour = _at_points(points, colours, count, scene, rng)
    else:
        masked = have_masks and init in ("hull", "auto")
        means, colour = _in_box(images, scene, count, rng, masked=masked)
    return _initial_parameters(means, colour, sh_degree, scene, rng)


def _at_points(points: F32, colours: F32, count: int, scene: SceneExtent, rng: Generator) -> tuple[F64, F64]:
    """Choose `count` of the points [M, 3], and their colours [M, 3]; if there are fewer, repeat some with noise.

    The noise has the distance to the neighbours as its standard deviation along each axis.

    Returns:
        Means and colours, [count, 3] each.
    """
    order = rng.permutation(len(points))
    chosen = np.concatenate([order, rng.integers(0, len(points), max(0, count - len(points)))])[:count]
    means = points[chosen].astype(np.float64)
    colour = np.asarray(colours, np.float64)
    repeated = np.arange(len(chosen)) >= len(points)
    if repeated.any():
        spread = _neighbour_distances(points.astype(np.float64), scene)[chosen[repeated]]
        means[repeated] += rng.standard_normal((int(repeated.sum()), 3)) * spread[:, None]
    return means, colour[chosen]


def _in_box(
    images: Sequence[PosedImage], scene: SceneExtent, count: int, rng: Generator, *, masked: bool
) -> tuple[F64, F64]:
    """Draw points in the box that cameras see, inside the visual hull if `masked`, with the mean of their pixels.

    Points are repeated if fewer than `count` are found in `_BATCHES` batches; without any, all of the box is used, in
    grey.

    Returns:
        Means and colours, [count, 3] each.
    """
    kept: list[F64] = []
    colours: list[F64] = []
    total = 0
    for _ in range(_BATCHES):
        points = scene.focus + scene.half * rng.uniform(-1.0, 1.0, (_BATCH, 3))
        seen, hits, colour = _sample_images(images, points)
        keep = seen > 0
        if masked:
            keep &= hits >= (1.0 - _MISSES) * seen - _ROUNDING
            keep &= 2 * seen >= len(images)  # the object is in view of most cameras
        kept.append(points[keep])
        colours.append(colour[keep])
        total += int(keep.sum())
        if total >= count:
            break
    if total == 0:  # inconsistent masks, or cameras without a common subject
        return scene.focus + scene.half * rng.uniform(-1.0, 1.0, (count, 3)), np.full((count, 3), _UNSEEN_COLOUR)
    means, colour = np.concatenate(kept), np.concatenate(colours)
    chosen = np.concatenate([np.arange(total), rng.integers(0, total, max(0, count - total))])[:count]
    return means[chosen], colour[chosen]


def _sample_images(images: Sequence[PosedImage], points: F64) -> tuple[NDArray[np.int64], NDArray[np.int64], F64]:
    """Count the images that see each of the points [M, 3], and that see the object there; and average its colour.

    Returns:
        [M] and [M], the counts; [M, 3], the mean colour, 0.5 if no image sees the object.
    """
    seen, hits = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    colour = np.zeros((len(points), 3))
    for image in images:
        inside, pixels = _pixels_at(image, points)
        seen[inside] += 1
        on = pixels[:, 3] >= _MASK
        hits[inside[on]] += 1
        colour[inside[on]] += pixels[on, :3]
    return seen, hits, np.where(hits[:, None] > 0, colour / np.maximum(hits, 1)[:, None], _UNSEEN_COLOUR)


def _pixels_at(image: PosedImage, points: F64) -> tuple[NDArray[np.int64], F64]:
    """Return the indices [n] of the points inside an image, and its pixels there, [n, 4], RGBA in 0..1."""
    camera: Camera = image.camera
    V, K = camera.viewmat, camera.K
    x, y, z = (points @ V[axis, :3] + V[axis, 3] for axis in range(3))
    ahead = z > camera.near
    depth = np.where(ahead, z, 1.0)
    u, v = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
    inside = np.flatnonzero(ahead & (u >= 0) & (u < camera.W) & (v >= 0) & (v < camera.H))
    if image.mask is not None:
        inside = inside[image.mask[v[inside].astype(np.int64), u[inside].astype(np.int64)]]
    return inside, image.at(v[inside].astype(np.int64), u[inside].astype(np.int64))


def _initial_parameters(means: F64, colour: F64, sh_degree: int, scene: SceneExtent, rng: Generator) -> ParameterArrays:
    """Return balls at means [N, 3] with colours [N, 3] in 0..1, as large as the distance to their neighbours.

    Rotations are random, opacities `_OPACITY`, SH bands above 0 zero.
    """
    count = len(means)
    spacing = np.log(_neighbour_distances(means, scene)).astype(np.float32)
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return {
        "means": means.astype(np.float32),
        "quats": quats.astype(np.float32),
        "scales": np.repeat(spacing[:, None], 3, axis=1),
        "logits": np.full(count, math.log(_OPACITY / (1.0 - _OPACITY)), np.float32),
        "sh0": ((colour - 0.5) / SH_C0).astype(np.float32),
        "shN": np.zeros((count, (sh_degree + 1) ** 2 - 1, 3), np.float32),
    }


def _neighbour_distances(points: F64, scene: SceneExtent) -> F64:
    """Return the root mean square distance of points [M, 3] to the `_NEIGHBOURS` nearest other points, [M], never 0.

    If most points coincide with other points, return the distance between points that fill the box evenly.
    """
    evenly = 2.0 * scene.half / max(1, len(points)) ** (1.0 / 3.0)
    if len(points) < 2:
        return np.full(len(points), evenly)
    k = min(_NEIGHBOURS, len(points) - 1)
    spacing: F64 = np.sqrt(np.square(nearest_neighbours(points, k)[1]).mean(axis=1))
    typical = float(np.median(spacing))
    return np.maximum(spacing, _SPACING_MIN * typical) if typical > 0.0 else np.where(spacing > 0.0, spacing, evenly)
