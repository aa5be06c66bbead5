# SPDX-License-Identifier: Apache-2.0
"""Estimate the up axis of a scene that does not specify it, for viewing; files mark it as an estimate (`estimated`).

Objects are usually photographed from all around and from above, seldom from below. So they show fine splats from above,
and large, smeared splats or the ground from below. The sum of all viewing directions, weighted by the detail visible
from each, points up. If an object was photographed from all sides, or a room is open on one side, the sum is short, and
the estimate is inconclusive.
"""

from __future__ import annotations

import numpy as np

from csplat.model import SplatModel
from csplat.scene_metadata import Direction
from csplat_render.camera import intrinsics, look_at
from csplat_render.scene_frame import detail, object_body, sample_cloud, scene_frame
from csplat_render.virtual_cameras import FIELD_OF_VIEW

#: Cloud points for each splat of a small scene; more show no more of it.
POINTS_PER_SPLAT = 32

_UP_CERTAIN = 0.3  # minimum length of a conclusive sum
_UP_NEAR_AXIS = 0.9  # minimum cosine with an axis: programs use one of their axes as up
_UP_POINTS = 10_000  # cloud points, but at most POINTS_PER_SPLAT for each splat
_UP_DIRECTIONS = 32  # number of views
_UP_IMAGE_SIZE = 320  # pixels, width and height of the views
_UP_DISTANCE = 2.0  # extents, from the centre
_UP_CELL, _UP_FINE = 20, 2.0  # pixels, see `detail`


def estimate_up(model: SplatModel, every: int = 1) -> Direction | None:
    """Estimate the up axis of an object, one of ± x, y, z.

    Args:
        model: the scene.
        every: number of splats of the full scene that each splat of the model represents.

    Returns:
        The axis; `None` if the scene or its cameras determine it, if the estimate is uncertain, and for surroundings.
    """
    if len(model) == 0 or model.metadata.cameras or model.metadata.up is not None:
        return None
    frame = scene_frame(model)
    if frame.kind != "object":
        return None
    body = object_body(model, frame)
    cloud = sample_cloud(body, min(_UP_POINTS, POINTS_PER_SPLAT * len(body)), np.random.default_rng(0), every)
    K = intrinsics(_UP_IMAGE_SIZE, _UP_IMAGE_SIZE, FIELD_OF_VIEW)
    heights = 1.0 - (2.0 * np.arange(_UP_DIRECTIONS) + 1.0) / _UP_DIRECTIONS  # spiral that covers the sphere evenly
    turns, radii = np.pi * (1.0 + 5.0**0.5) * np.arange(_UP_DIRECTIONS), np.sqrt(1.0 - heights**2)
    directions = np.stack([radii * np.cos(turns), radii * np.sin(turns), heights], axis=1)
    details = np.empty(_UP_DIRECTIONS)
    for i, direction in enumerate(directions):
        eye, across = frame.centre + _UP_DISTANCE * frame.extent * direction, np.eye(3)[np.argmin(np.abs(direction))]
        details[i] = detail(
            cloud,
            look_at(eye, frame.centre, across, K, _UP_IMAGE_SIZE, _UP_IMAGE_SIZE, frame.near),
            0.0,
            cell=_UP_CELL,
            fine=_UP_FINE,
        )
    total = float(np.sum(details))
    # The factor 3 gives length 1 if detail is proportional to 1 + the cosine with the up axis.
    sums = 3.0 * np.sum(details[:, None] * directions, axis=0) / total if total > 0.0 else np.zeros(3)
    axis = int(np.argmax(np.abs(sums)))
    if not abs(sums[axis]) >= max(_UP_CERTAIN, _UP_NEAR_AXIS * float(np.sqrt(np.sum(sums**2)))):
        return None
    x, y, z = (float(np.sign(sums[axis])) if k == axis else 0.0 for k in range(3))
    return x, y, z


def with_estimated_up(model: SplatModel) -> SplatModel:
    """Return the scene for viewing, with the estimated up direction if it does not specify its own."""
    return model.with_metadata(model.metadata.with_up(estimate_up(model), estimated=True))
