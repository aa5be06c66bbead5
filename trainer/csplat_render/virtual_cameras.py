"""Virtual cameras around a scene that has none, the cameras of `psnr`; the scene's frame, and its up-axis estimate.

Two kinds of scene are distinguished by where their surface lies. An *object* is seen from outside, from all sides and
slightly to steeply above, so near that it covers at least half of each image. *Surroundings* reach much farther than
their dense middle; cameras are placed around or inside of that middle, where nothing close by hides it.

Distances are part of what a PSNR means (the same error scores 33, 39 and 48 dB from one, two and four times as far
away), so they are fixed multiples of the scene's extent: `OBJECT_DISTANCES`, `SURROUNDING_DISTANCES`. Everything comes
from the source alone; the seed decides directions.

Choosing cameras needs hundreds of rough images, not exact ones. A `Cloud` replaces splats by points drawn from their
Gaussians; each point represents a share of its splat's optical depth times the area that the splat shows on average.
Binned into the cells of a coarse image the points tell, within a few per cent, how much is covered and what hides what.
All sums are taken in a fixed order and no matrix product is left to BLAS: the same on any number of threads.

The up axis of a scene that does not specify it is estimated for viewing, never for a file. People who photograph an
object walk around it and look down on it, seldom up at it. So an object shows fine splats from above, and from below
large and smeared ones, or the ground under it. The sum of all directions, weighted by the detail that is visible from
there, points up. Measured on 12 objects: six have a sum of 0.34 to 0.64 within 14 degrees of the true up axis (lego,
donut, the sample; angel, st-peter, seal); five, photographed from all sides, have 0.05 to 0.09, which decides nothing;
a kitchen that is open at one side has 0.26 towards that side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from csplat.editing.up_axis import Direction, up_of, with_up
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F64, I64
from csplat_render.camera import DEFAULT_NEAR, Camera, direction_at, intrinsics, look_at, orbit

#: Splats of lower opacity are never drawn.
MIN_OPACITY = 1.0 / 255.0

_MAX_LOG_SCALE = 60.0  # beyond, squares of squares overflow


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points that represent a scene's surface.

    Attributes:
        points: [P, 3] float64, drawn from the splats' Gaussians, relative to the model's origin.
        masses: [P] float64, optical depth × area that a point represents, square scene units.
        sizes: [P] float64, square root of the area of the point's splat, scene units.
    """

    points: F64
    masses: F64
    sizes: F64


def visible_opacity(model: SplatModel) -> F64:
    """Return opacities in float64, 0 for splats that are never drawn; all 1 if none is drawn."""
    alpha = model.opacities.astype(np.float64)
    alpha[alpha < MIN_OPACITY] = 0.0
    return alpha if alpha.any() else np.ones_like(alpha)


def surface_areas(model: SplatModel) -> F64:
    """Return the mean projected area of each splat over all directions, [N], square scene units, for a peak of 1.

    The integral of a projected Gaussian is 2π·σa·σb; over all directions the product of the two
    standard deviations is about ((σ0σ1)^p + (σ0σ2)^p + (σ1σ2)^p) / 3)^(1/p), p = 1.6 (Thomsen's
    formula for the surface of an ellipsoid, a quarter of which is its mean shadow).
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
        every: number of the scene's splats that each of the model's represents.

    Returns:
        `count` points. Splats are drawn in proportion to the square root of their mass, so that a few
        large ones do not take all points.
    """
    alpha = visible_opacity(model)
    areas = surface_areas(model)
    # The integral of −ln(1 − alpha·G) over a Gaussian is the dilogarithm of alpha times its area.
    mass = (alpha + alpha**2 / 4.0 + alpha**3 / 9.0 + alpha**4 / 16.0) * areas
    chance = np.sqrt(mass)
    sums = np.cumsum(chance)
    at = (np.arange(count) + rng.random()) / count * sums[-1]
    last = int(np.flatnonzero(chance).max(initial=0))  # rounding must not reach past it
    index = np.minimum(np.searchsorted(sums, at, side="right"), last)
    s = np.exp(_clipped_scales(model)[index])
    offsets = _rotate(model.quats[index].astype(np.float64), rng.standard_normal((count, 3)) * s)
    # Mass over the expected number of a splat's points: chance · sums[-1] / count.
    return Cloud(
        points=np.asfortranarray(model.means[index].astype(np.float64) + offsets),  # `_project_cloud` takes columns
        masses=chance[index] * (sums[-1] / count) * every,
        sizes=np.sqrt(areas[index]),
    )


def covered_fraction(cloud: Cloud, camera: Camera, cell: int = 10) -> float:
    """Return the fraction of an image that the scene covers, 0 to 1.

    Args:
        cloud: the scene.
        camera: the camera.
        cell: side of the coarse image's cells, pixels.
    """
    cells, _, depths, _ = _project_cloud(cloud, camera, cell)
    sums = np.bincount(cells, depths, _cell_count(camera, cell))
    return float(np.sum(-np.expm1(-sums))) / len(sums)


def detail(cloud: Cloud, camera: Camera, nearest: float, cell: int = 20, fine: float = 4.0) -> float:
    """Return the fraction of an image that shows fine splats with nothing in front, 0 to 1.

    Views far from the training cameras show large, smeared splats, or a wall from behind.

    Args:
        cloud: the scene.
        camera: the camera.
        nearest: distance below which splats hide others without showing detail; scene units.
        cell: side of the coarse image's cells, pixels.
        fine: splats up to this size count fully, larger ones less in proportion; pixels.
    """
    cells, z, depths, sizes = _project_cloud(cloud, camera, cell)
    if len(cells) == 0:
        return 0.0
    order = np.lexsort((z, cells))
    cells, z, depths, sizes = cells[order], z[order], depths[order], sizes[order]
    behind = np.cumsum(depths)
    before = behind - depths
    first = np.searchsorted(cells, cells, side="left")
    seen = np.exp(before[first] - before) * -np.expm1(-depths)
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
    values, weights = values[weights > 0.0], weights[weights > 0.0]  # weight 0 must not affect neighbours
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    result: F64 = np.interp(np.array(at) * sums[-1], sums, values[order])
    return result


def _cell_count(camera: Camera, cell: int) -> int:
    return -(-camera.W // cell) * -(-camera.H // cell)


def _project_cloud(cloud: Cloud, camera: Camera, cell: int) -> tuple[I64, F64, F64, F64]:
    """Project the points into the cells of a coarse image.

    Returns:
        For the M points inside it: the cell's number, row by row; the depth along z; the optical
        depth that the point adds to its cell; the size of its splat in pixels.
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
    # Integers first: the same for values that are not negative, in a tenth of the time of `//` of floats.
    cells = v[inside].astype(np.int64) // cell * columns + u[inside].astype(np.int64) // cell
    scale = camera.K[0, 0] / z
    return cells, z, cloud.masses[inside] * (scale / cell) ** 2, cloud.sizes[inside] * scale


def _clipped_scales(model: SplatModel) -> F64:
    return np.clip(model.scales.astype(np.float64), -_MAX_LOG_SCALE, _MAX_LOG_SCALE)


def _rotate(q: F64, v: F64) -> F64:
    """Rotate vectors [N, 3] by quaternions [N, 4] (w x y z, nearly unit)."""
    w, u = q[:, :1], q[:, 1:]
    t = 2.0 * np.cross(u, v)
    result: F64 = v + w * t + np.cross(u, t)
    return result


Kind = Literal["object", "surrounding"]

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
_NEAR = 0.05  # near plane in extents, DEFAULT_NEAR at most
_FAR_REACH = 4.0  # times the distance within which half the opacity lies; farther surface belongs to no object
_FAR_SHARE = 0.02  # fraction of the surface; with more of it beyond, a scene is surroundings
_FLAT = 0.6  # ratio of the shortest extent to the next, below which the short axis points up
_GOOD_DETAIL = 0.65  # fraction of the best view's detail
_AZIMUTH_STEP = 15.0  # degrees
_POINTS = 60_000  # points of a cloud


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """Position, extent, up direction and kind of a scene.

    Attributes:
        kind: `"object"` or `"surrounding"`.
        centre: [3] float64, relative to the model's origin.
        extent: unit of all distances, in scene units, above 0. Objects: half
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
        """Near plane for the extent, scene units."""
        return min(DEFAULT_NEAR, _NEAR * self.extent)


def scene_frame(model: SplatModel) -> SceneFrame:
    """Return the centre of a scene, its extent, its up direction and its kind.

    A scene without splats is an object of extent 1 at the origin.
    """
    if len(model) == 0:
        return SceneFrame("object", np.zeros(3), 1.0, np.array([0.0, -1.0, 0.0]))
    alpha, areas = visible_opacity(model), surface_areas(model)
    means = model.means.astype(np.float64)
    low, middle, high = np.stack([weighted_quantiles(means[:, k], alpha, (0.05, 0.5, 0.95)) for k in range(3)], axis=1)
    half = (high - low) / 2.0
    up = _up(model, half)
    distances = np.sqrt(np.sum((means - middle) ** 2, axis=1))
    reach = float(weighted_quantiles(distances, alpha, (0.5,))[0])
    surface = alpha * np.minimum(areas, (0.5 * reach) ** 2)  # so that no floater outweighs a scene
    if np.sum(surface[distances > _FAR_REACH * reach]) > _FAR_SHARE * np.sum(surface):
        return SceneFrame("surrounding", middle, reach, up)
    extent = float(np.sqrt(np.sum(half**2)))
    if extent <= 0.0:  # one splat, or several in one place
        extent = 3.0 * float(np.sqrt(np.max(areas[alpha > 0.0]) / (2.0 * np.pi)))
    return SceneFrame("object", (low + high) / 2.0, extent, up)


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
        raise InputError(f"{count} virtual cameras, wanted at least 1")
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


def _up(model: SplatModel, half: F64) -> F64:
    """Return the up direction: the scene's own; else the short axis of a flat scene; else −y, as in a PLY."""
    stored = up_of(model.metadata, model.coordinate_system)
    if stored is not None:
        direction: F64 = np.array(stored)
        direction /= np.sqrt(np.sum(direction**2))  # six digits are not exactly unit length
        return direction
    up = np.zeros(3)
    order = np.argsort(half, kind="stable")
    axis = int(order[0]) if half[order[0]] < _FLAT * half[order[1]] else 1
    up[axis] = -1.0 if axis == 1 else 1.0
    return up


_UP_CERTAIN = 0.3  # least length of the sum that is not by chance
_UP_NEAR_AXIS = 0.9  # least cosine with an axis: programs make one of their axes up
_UP_POINTS, _UP_DIRECTIONS, _UP_IMAGE_SIZE = 10_000, 32, 320
_UP_DISTANCE = 2.0  # extents
_UP_CELL, _UP_FINE = 20, 2.0  # pixels


def estimate_up(model: SplatModel, every: int = 1) -> Direction | None:
    """Estimate which axis of an object, or its opposite, is up.

    Args:
        model: the scene.
        every: number of the scene's splats that each of the model's represents.

    Returns:
        `None` if the scene or its cameras determine the up axis, if the estimate is uncertain, and for surroundings.
    """
    if len(model) == 0 or model.cameras or up_of(model.metadata, model.coordinate_system) is not None:
        return None
    frame = scene_frame(model)
    if frame.kind != "object":
        return None
    cloud = sample_cloud(model, _UP_POINTS, np.random.default_rng(0), every)
    K = intrinsics(_UP_IMAGE_SIZE, _UP_IMAGE_SIZE, FIELD_OF_VIEW)
    heights = 1.0 - (2.0 * np.arange(_UP_DIRECTIONS) + 1.0) / _UP_DIRECTIONS  # a spiral: evenly over the sphere
    turns, radii = np.pi * (1.0 + 5.0**0.5) * np.arange(_UP_DIRECTIONS), np.sqrt(1.0 - heights**2)
    ways = np.stack([radii * np.cos(turns), radii * np.sin(turns), heights], axis=1)
    details = np.empty(_UP_DIRECTIONS)
    for i, way in enumerate(ways):
        eye, across = frame.centre + _UP_DISTANCE * frame.extent * way, np.eye(3)[np.argmin(np.abs(way))]
        details[i] = detail(
            cloud,
            look_at(eye, frame.centre, across, K, _UP_IMAGE_SIZE, _UP_IMAGE_SIZE, frame.near),
            0.0,
            cell=_UP_CELL,
            fine=_UP_FINE,
        )
    total = float(np.sum(details))
    sums = 3.0 * np.sum(details[:, None] * ways, axis=0) / total if total > 0.0 else np.zeros(3)
    axis = int(np.argmax(np.abs(sums)))
    if not abs(sums[axis]) >= max(_UP_CERTAIN, _UP_NEAR_AXIS * float(np.sqrt(np.sum(sums**2)))):
        return None
    x, y, z = (float(np.sign(sums[axis])) if k == axis else 0.0 for k in range(3))
    return x, y, z


def with_estimated_up(model: SplatModel) -> SplatModel:
    """Return the scene for viewing: with the estimated up direction if it does not specify its own."""
    return with_up(model, estimate_up(model))
