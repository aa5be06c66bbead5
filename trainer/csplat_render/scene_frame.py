"""The frame of a scene (centre, extent, up, kind), and the cloud of points that represents its surface.

Two kinds of scene are distinguished by where their surface lies. An *object* is seen from outside. *Surroundings* reach
much farther than their dense middle.

Choosing cameras needs hundreds of rough images, not exact ones. A `Cloud` replaces splats by points drawn from their
Gaussians; each point represents a share of its splat's optical depth times the area that the splat shows on average.
Binned into the cells of a coarse image the points tell, within a few per cent, how much is covered and what hides what.
All sums are taken in a fixed order and no matrix product is left to BLAS: the same on any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from csplat.editing.up_axis import up_of
from csplat.model import SplatModel
from csplat.types import F64, I64
from csplat_render.camera import DEFAULT_NEAR, Camera

#: Splats of lower opacity are never drawn.
MIN_OPACITY = 1.0 / 255.0

_MAX_LOG_SCALE = 60.0  # beyond, squares of squares overflow
_NEAR = 0.05  # near plane in extents, DEFAULT_NEAR at most
_FAR_REACH = 4.0  # times the distance within which half the opacity lies; farther surface belongs to no object
_FAR_SHARE = 0.02  # fraction of the surface; with more of it beyond, a scene is surroundings
_FLAT = 0.6  # ratio of the shortest extent to the next, below which the short axis points up

Kind = Literal["object", "surrounding"]


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
