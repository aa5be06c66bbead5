# SPDX-License-Identifier: Apache-2.0
"""The frame of a scene (centre, extent, up, kind), and a point cloud that represents its surface.

There are two kinds of scene: an *object* is viewed from outside; *surroundings* extend far beyond their dense middle.

Choosing cameras needs hundreds of rough images, not exact images. A `Cloud` replaces splats by points drawn from their
Gaussians. Each point represents a fraction of the splat's optical depth times its mean projected area. Binned into the
cells of a coarse image, the points determine coverage and occlusion within a few per cent. Sums have a fixed order and
do not use BLAS, so no result depends on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from csplat.model import SplatModel
from csplat.types import F64, I64, Mask
from csplat_render.camera import DEFAULT_NEAR, Camera, direction_at, look_at

#: Splats of lower opacity are never drawn.
MIN_OPACITY = 1.0 / 255.0

_MAX_LOG_SCALE = 60.0  # fourth powers of larger scales overflow
_NEAR = 0.05  # near plane, extents; at most DEFAULT_NEAR
_FAR_REACH = 4.0  # radius of an object, in radii of the sphere that contains half the opacity
_FAR_SHARE = 0.02  # fraction of the surface; if more is outside this radius, the scene is surroundings,
_FAR_OPACITY = 0.004  # and if this fraction of the opacity is outside, too: 0.9 % at least in captures of surroundings
_BOX_QUANTILES = (0.05, 0.5, 0.95)  # quantiles of opacity along an axis: the box's ends and its middle
_AREA_REACH = 0.5  # side of the largest area of a splat that counts, in radii that contain half the opacity
_OBJECT_REACH = 2.5  # extents from the middle of an object; captures reach 2.0, splats farther away are floaters
_CORE_SHARE = 0.25  # minimum fraction of the visible splats in the core of a scene
_CORE_GAP = 2.0  # ratio of the outer to the inner radius of the gap around a core
_GAP_SHARE = 0.01  # maximum fraction of the visible splats in that gap
_CORE_REACH = 8.0  # radii of a quarter of the splats; at most 4 in captures, whose frames are left as they are
_SINGLE_EXTENT = 3.0  # extent of splats at a single position, in standard deviations of the largest
_USUAL_UP = (0.0, -1.0, 0.0)  # what viewers assume of scenes of unknown axes
_FLAT = 0.6  # ratio of the shortest extent to the next; if it is smaller, the short axis points up

Kind = Literal["object", "surrounding"]


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """Position, extent, up direction and kind of a scene.

    Attributes:
        kind: `"object"` or `"surrounding"`.
        centre: [3] float64, relative to the model's origin.
        extent: unit of all distances, in scene units, above 0. Objects: half the diagonal of the box of the 5 % to 95 %
            quantiles of opacity along each axis. Surroundings: the radius around the centre that contains half the
            opacity.
        up: [3] float64, unit length.
    """

    kind: Kind
    centre: F64
    extent: float
    up: F64

    @property
    def near(self) -> float:
        """Near plane for cameras of this scene, scene units."""
        return min(DEFAULT_NEAR, _NEAR * self.extent)

    def camera_at(
        self,
        azimuth: float,
        elevation: float,
        distance: float,
        K: F64,
        width: int,
        height: int,
        offset: F64 | None = None,
    ) -> Camera:
        """Return a camera that looks at the centre, or at an offset from it.

        Args:
            azimuth, elevation: see `direction_at`, degrees.
            distance: distance from the centre, extents.
            K: [3, 3], intrinsics.
            width, height: pixels.
            offset: [3], extents; `None`: 0.
        """
        eye = self.centre + distance * self.extent * direction_at(self.up, azimuth, elevation)
        target = self.centre if offset is None else self.centre + self.extent * offset
        return look_at(eye, target, self.up, K, width, height, self.near)


def scene_frame(model: SplatModel) -> SceneFrame:
    """Compute the frame of a scene. A scene without splats is an object of extent 1 at the origin.

    If far splats hold most of the opacity, such as a dome of the sky, it is the frame of the scene's core.
    """
    if len(model) == 0:
        return SceneFrame("object", np.zeros(3), 1.0, np.array([0.0, -1.0, 0.0]))
    frame = _opacity_frame(model)
    core = _dense_core(model, frame)
    return frame if core.all() else _opacity_frame(model.select(core))


def object_body(model: SplatModel, frame: SceneFrame) -> SplatModel:
    """Return the splats of an object, without those far away: they are large if seen, and would outweigh it.

    Args:
        model: the scene.
        frame: its frame; surroundings have no end, and are returned as they are.
    """
    if frame.kind != "object":
        return model
    near = np.sum((model.means.astype(np.float64) - frame.centre) ** 2, axis=1) <= (_OBJECT_REACH * frame.extent) ** 2
    return model if near.all() or not near.any() else model.select(near)


def _opacity_frame(model: SplatModel) -> SceneFrame:
    """Compute the frame of at least one splat by quantiles of opacity."""
    alpha, areas = visible_opacity(model), surface_areas(model)
    means = model.means.astype(np.float64)
    low, middle, high = np.stack([weighted_quantiles(means[:, k], alpha, _BOX_QUANTILES) for k in range(3)], axis=1)
    half = (high - low) / 2.0
    up = _up(model, half)
    distances = np.sqrt(np.sum((means - middle) ** 2, axis=1))
    reach = float(weighted_quantiles(distances, alpha, (0.5,))[0])
    surface = alpha * np.minimum(areas, (_AREA_REACH * reach) ** 2)  # limited so that no floater outweighs a scene
    far = distances > _FAR_REACH * reach
    if np.sum(surface[far]) > _FAR_SHARE * np.sum(surface) and np.sum(alpha[far]) > _FAR_OPACITY * np.sum(alpha):
        return SceneFrame("surrounding", middle, reach, up)
    extent = float(np.sqrt(np.sum(half**2)))
    if extent <= 0.0:  # a single position
        extent = _SINGLE_EXTENT * float(np.sqrt(np.max(areas[alpha > 0.0]) / (2.0 * np.pi)))
    return SceneFrame("object", (low + high) / 2.0, extent, up)


def _dense_core(model: SplatModel, frame: SceneFrame) -> Mask:
    """Return the splats of a scene's core, [N] bool; all, if the frame fits them or nothing separates a core.

    The core has a gap around it, in which there are hardly any splats. Splats are counted, not weighed: those of a
    background are few, but large and opaque.
    """
    means = model.means.astype(np.float64)
    visible = model.opacities >= MIN_OPACITY
    everything: Mask = np.ones(len(model), np.bool_)
    if not visible.any():
        return everything
    middle = np.median(means[visible], axis=0)
    distances = np.sqrt(np.sum((means - middle) ** 2, axis=1))
    away = np.sort(distances[visible & (distances > 0.0)])  # many may be in one place
    first = int(_CORE_SHARE * len(away))
    shift = float(np.sqrt(np.sum((frame.centre - middle) ** 2)))
    if len(away) == 0 or max(frame.extent, shift) <= _CORE_REACH * away[first]:
        return everything
    beyond = np.searchsorted(away, _CORE_GAP * away[first:], side="right") - np.arange(first + 1, len(away) + 1)
    radius = away[first + int(np.argmax(beyond <= _GAP_SHARE * len(away)))]
    core: Mask = distances <= radius
    sizes = np.exp(_clipped_scales(model)[core].max(axis=1))
    return core if radius > float(np.median(sizes)) else everything  # splats in one place are no scene


def viewing_frame(model: SplatModel) -> SceneFrame:
    """Return the frame of a scene for viewers, which assume −y of an unknown up direction."""
    frame = scene_frame(model)
    return frame if model.metadata.up is not None else replace(frame, up=np.array(_USUAL_UP))


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points that represent the surface of a scene.

    Attributes:
        points: [P, 3] float64, drawn from the splats' Gaussians, relative to the model's origin.
        masses: [P] float64, optical depth × area represented by a point, square scene units.
        sizes: [P] float64, square root of the projected area of the point's splat, scene units.
    """

    points: F64
    masses: F64
    sizes: F64


def visible_opacity(model: SplatModel) -> F64:
    """Return opacities as float64, 0 for splats that are never drawn; all 1 if no splat is drawn."""
    alpha = model.opacities.astype(np.float64)
    alpha[alpha < MIN_OPACITY] = 0.0
    return alpha if alpha.any() else np.ones_like(alpha)


def surface_areas(model: SplatModel) -> F64:
    """Return the mean projected area of each splat over all directions, [N], square scene units, for a peak of 1.

    The integral of a projected Gaussian is 2π·σa·σb. Averaged over all directions, σa·σb is about
    (((σ0σ1)^p + (σ0σ2)^p + (σ1σ2)^p) / 3)^(1/p), p = 1.6 (Thomsen's formula for the surface of an ellipsoid, which is
    four times its mean projected area).
    """
    s = np.exp(_clipped_scales(model))
    p = 1.6
    products = (s[:, 0] * s[:, 1]) ** p + (s[:, 0] * s[:, 2]) ** p + (s[:, 1] * s[:, 2]) ** p
    areas: F64 = 2.0 * np.pi * (products / 3.0) ** (1.0 / p)
    return areas


def sample_cloud(model: SplatModel, count: int, rng: np.random.Generator, every: int = 1) -> Cloud:
    """Draw points from a scene's splats.

    Args:
        model: the scene, at least one splat.
        count: number of points.
        rng: source of random numbers.
        every: number of splats of the full scene that each splat of the model represents.

    Returns:
        `count` points. Splats are chosen in proportion to the square root of their mass so that a few large ones do not
        get all points.
    """
    alpha = visible_opacity(model)
    areas = surface_areas(model)
    # ∫ −ln(1 − alpha·G) over a Gaussian G of area A is Li2(alpha) · A, Li2(x) = Σ x^k / k².
    mass = (alpha + alpha**2 / 4.0 + alpha**3 / 9.0 + alpha**4 / 16.0) * areas
    chance = np.sqrt(mass)
    sums = np.cumsum(chance)
    levels = (np.arange(count) + rng.random()) / count * sums[-1]
    last = int(np.flatnonzero(chance).max(initial=0))  # rounding must not go beyond it
    index = np.minimum(np.searchsorted(sums, levels, side="right"), last)
    s = np.exp(_clipped_scales(model)[index])
    offsets = _rotate(model.quats[index].astype(np.float64), rng.standard_normal((count, 3)) * s)
    # The mass of a splat divided by its expected number of points is chance · sums[-1] / count.
    return Cloud(
        points=np.asfortranarray(model.means[index].astype(np.float64) + offsets),  # `_project_cloud` reads columns
        masses=chance[index] * (sums[-1] / count) * every,
        sizes=np.sqrt(areas[index]),
    )


def covered_fraction(cloud: Cloud, camera: Camera, cell: int = 10) -> float:
    """Return the fraction of an image that the scene covers, 0 to 1.

    Args:
        cloud: the scene.
        camera: the camera.
        cell: side of a cell of the coarse image, pixels.
    """
    cells, _, depths, _ = _project_cloud(cloud, camera, cell)
    sums = np.bincount(cells, depths, _cell_count(camera, cell))
    return float(np.sum(-np.expm1(-sums))) / len(sums)


def detail(cloud: Cloud, camera: Camera, nearest: float, cell: int = 20, fine: float = 4.0) -> float:
    """Return the fraction of an image that shows fine splats, 0 to 1.

    Views far from the training cameras show large, smeared splats, or a wall from behind.

    Args:
        cloud: the scene.
        camera: the camera.
        nearest: splats nearer than this occlude others but show no detail; scene units.
        cell: side of a cell of the coarse image, pixels.
        fine: splats up to this size count fully, larger ones in inverse proportion to their size; pixels.
    """
    cells, z, depths, sizes = _project_cloud(cloud, camera, cell)
    if len(cells) == 0:
        return 0.0
    order = _by_cell_and_depth(cells, z)
    cells, z, depths, sizes = cells[order], z[order], depths[order], sizes[order]
    behind = np.cumsum(depths)
    before = behind - depths
    starts = np.flatnonzero(np.diff(cells, prepend=-1))  # the nearest point of each cell
    in_front = np.repeat(before[starts], np.diff(starts, append=len(cells))) - before
    seen = np.exp(in_front) * -np.expm1(-depths)
    shown = np.where(z < nearest, 0.0, fine / np.maximum(sizes, fine))
    return float(np.sum(seen * shown)) / _cell_count(camera, cell)


def share_within(cloud: Cloud, centre: F64, radius: float) -> float:
    """Return the fraction of the scene's surface within `radius` of a point, 0 to 1."""
    near = np.sum((cloud.points - centre) ** 2, axis=1) < radius**2
    total = float(np.sum(cloud.masses))
    return float(np.sum(cloud.masses[near])) / total if total > 0.0 else 0.0


def weighted_quantiles(values: F64, weights: F64, at: tuple[float, ...]) -> F64:
    """Return quantiles of weighted values, linear between neighbours.

    Args:
        values: [N], at least one.
        weights: [N], not negative, not all 0.
        at: positions of the quantiles, 0 to 1.

    Returns:
        One value for each of `at`.
    """
    values, weights = values[weights > 0.0], weights[weights > 0.0]  # weight 0 must not affect the interpolation
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    result: F64 = np.interp(np.array(at) * sums[-1], sums, values[order])
    return result


def _up(model: SplatModel, half: F64) -> F64:
    """Return the scene's own up direction, else the short axis of a flat scene (+x, −y or +z), else −y.

    Args:
        model: the scene.
        half: [3], half the size of the scene's box along each axis, scene units.

    Returns:
        [3], unit length.
    """
    stored = model.metadata.up
    if stored is not None:
        direction: F64 = np.array(stored)
        direction /= np.sqrt(np.sum(direction**2))  # stored with six digits
        return direction
    up = np.zeros(3)
    order = np.argsort(half, kind="stable")
    axis = int(order[0]) if half[order[0]] < _FLAT * half[order[1]] else 1
    up[axis] = -1.0 if axis == 1 else 1.0
    return up


def _cell_count(camera: Camera, cell: int) -> int:
    """Return the number of cells of an image; those at its right and lower edge may be smaller than `cell` pixels."""
    return -(-camera.W // cell) * -(-camera.H // cell)


def _project_cloud(cloud: Cloud, camera: Camera, cell: int) -> tuple[I64, F64, F64, F64]:
    """Project the points into the cells of a coarse image.

    Returns:
        For the n points inside the image, [n] each: index of the cell, row by row; depth along z; optical depth that
        the point adds to its cell; size of its splat, pixels.
    """
    V = camera.viewmat
    x, y, z = (
        V[i, 0] * cloud.points[:, 0] + V[i, 1] * cloud.points[:, 1] + V[i, 2] * cloud.points[:, 2] + V[i, 3]
        for i in range(3)
    )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        u = camera.K[0, 0] * x / z + camera.K[0, 2]
        v = camera.K[1, 1] * y / z + camera.K[1, 2]
        inside = (z > camera.near) & (u >= 0.0) & (u < camera.W) & (v >= 0.0) & (v < camera.H)
    z = z[inside]
    columns = -(-camera.W // cell)
    # Conversion to integers first is ten times faster than `//` of floats, and equal for non-negative values.
    cells = v[inside].astype(np.int64) // cell * columns + u[inside].astype(np.int64) // cell
    scale = camera.K[0, 0] / z
    return cells, z, cloud.masses[inside] * (scale / cell) ** 2, cloud.sizes[inside] * scale


def _by_cell_and_depth(cells: I64, z: F64) -> I64:
    """Return the order of points by cell, then by depth, to about seven digits, then as given.

    One integer holds cell, leading bits of the depth, and index: sorting integers is faster than `lexsort`.

    Args:
        cells: [n], not negative, n at least 1.
        z: [n], positive.
    """
    index_bits, cell_bits = len(z).bit_length(), max(1, int(cells.max()).bit_length())
    depth_bits = 64 - index_bits - cell_bits
    keys = cells.astype(np.uint64) << np.uint64(index_bits + depth_bits)
    keys |= z.view(np.uint64) >> np.uint64(63 - depth_bits) << np.uint64(index_bits)  # the sign bit is 0
    keys |= np.arange(len(z), dtype=np.uint64)
    keys.sort()
    order: I64 = (keys & np.uint64(2**index_bits - 1)).astype(np.int64)
    return order


def _clipped_scales(model: SplatModel) -> F64:
    """Return the log scales [N, 3], limited to ± `_MAX_LOG_SCALE`."""
    return np.clip(model.scales.astype(np.float64), -_MAX_LOG_SCALE, _MAX_LOG_SCALE)


def _rotate(q: F64, v: F64) -> F64:
    """Return vectors [N, 3] rotated by quaternions [N, 4] (w x y z, nearly of unit length)."""
    w, u = q[:, :1], q[:, 1:]
    t = 2.0 * np.cross(u, v)
    result: F64 = v + w * t + np.cross(u, t)
    return result
