# SPDX-License-Identifier: Apache-2.0
"""Place views off the path of given cameras: between, beside and beyond them.

Nothing is fitted to these views. The PSNR in them is the price of savings on what no camera sees, which views on the
path do not show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from csplat.model import SplatModel
from csplat.types import F64
from csplat_render import Camera
from csplat_render.scene_frame import Cloud, sample_cloud, scene_frame
from csplat_render.virtual_cameras import is_clear
from csplat_tools.views.virtual_views import evenly_spaced

_MOST = 12  # views of each kind
_POINTS = 20_000  # points to sample from the scene
_SEED = 3000
_TURNS = (15.0, 10.0, 5.0)  # degrees by which a view turns about what it shows; the first that is clear is taken
_RETREATS = (1.5, 1.35, 1.2)  # factors of the distance from what it shows


def views_off_path(source: SplatModel, test: Sequence[Camera], path: Sequence[Camera] = ()) -> dict[str, list[Camera]]:
    """Place views off the path of cameras.

    Args:
        source: the scene.
        test: the cameras next to which views are placed, of which at most `_MOST` are used, evenly spread.
        path: other cameras of the scene.

    Returns:
        Views by kind, with the image sizes of their cameras. *between*: halfway from a camera to the nearest camera in
        another place. *beside*: turned by 15 degrees about what the camera shows, to either side, up and down in turn.
        *beyond*: 1.5 times as far from what it shows. Where a surface is close to such a view, smaller turns and
        distances are tried, and the view is left out if none is clear. A kind without views is left out.
    """
    if not len(source) or not test:
        return {}
    frame, cloud = scene_frame(source), sample_cloud(source, _POINTS, np.random.default_rng(_SEED))
    every = [*test, *path]
    positions = np.array([camera.position for camera in every])
    found: dict[str, list[Camera]] = {"between": [], "beside": [], "beyond": []}
    for number, camera in enumerate(evenly_spaced([replace(camera, image=None) for camera in test], _MOST)):
        distance = _shown_distance(cloud, camera)
        apart = np.linalg.norm(positions - camera.position, axis=1)
        others = np.flatnonzero(apart > 1e-3 * distance)
        candidates = {
            "between": [_halfway(camera, every[others[np.argmin(apart[others])]])] if len(others) else [],
            "beside": [_turned(camera, distance, degrees, number % 4) for degrees in _TURNS],
            "beyond": [_moved_back(camera, (factor - 1.0) * distance) for factor in _RETREATS],
        }
        for kind, views in candidates.items():
            found[kind] += [view for view in views if is_clear(frame, cloud, view)][:1]
    return {kind: views for kind, views in found.items() if views}


def _shown_distance(cloud: Cloud, camera: Camera) -> float:
    """Return the median distance of the points that a camera shows along its axis, at least its near distance."""
    points = cloud.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    points = points[points[:, 2] > camera.near]
    pixels = points[:, :2] / points[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
    depths = points[((pixels >= 0.0) & (pixels < (camera.W, camera.H))).all(axis=1), 2]
    return max(float(np.median(depths)), camera.near) if len(depths) else 1.0


def _halfway(camera: Camera, other: Camera) -> Camera:
    """Return a camera with the mean position and direction of two, and the image of the first."""
    left, _, right = np.linalg.svd(camera.viewmat[:3, :3] + other.viewmat[:3, :3])
    turn: F64 = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right  # the nearest rotation
    return _posed(camera, turn, 0.5 * (camera.position + other.position))


def _turned(camera: Camera, distance: float, degrees: float, way: int) -> Camera:
    """Return a camera turned about the point at a distance on its axis, 0 and 2 sideways, 1 and 3 up and down."""
    angle = math.radians(degrees if way < 2 else -degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    by = [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]], [[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]
    old = camera.viewmat[:3, :3]
    turn: F64 = np.array(by[way % 2]) @ old
    return _posed(camera, turn, camera.position + distance * (old[2] - turn[2]))


def _moved_back(camera: Camera, distance: float) -> Camera:
    """Return a camera moved backwards along its axis."""
    turn = camera.viewmat[:3, :3]
    return _posed(camera, turn, camera.position - distance * turn[2])


def _posed(camera: Camera, turn: F64, position: F64) -> Camera:
    """Return a camera with another rotation, world to camera, and another position."""
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ position
    return replace(camera, viewmat=viewmat)
