"""Views that are used neither for fitting, nor for choices, nor for the main score: they check a file elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.camera import relative_to
from csplat_render.virtual_cameras import is_clear, sample_cloud, scene_frame, virtual_cameras
from csplat_tools.views import placing

_SEED = 2000  # seed of these views; validation views use 1000 and more
_NEARER, _FARTHER = (0.6, 0.7, 0.8, 0.9), 2.0  # factors of the distance from the middle of the scene
_POINTS = 20_000  # points that are sampled from the scene


def elsewhere(source: SplatModel) -> dict[str, list[Camera]]:
    """Place virtual cameras like those of `psnr` at other places, and the same nearer to and farther from the middle.

    Nearer ones stay outside of the objects that they look at.

    Args:
        source: the scene; its own cameras are not used.

    Returns:
        12 cameras of each kind: `beside`, `nearer`, `farther`.
    """
    frame = scene_frame(source)
    beside = virtual_cameras(source, *placing.VIRTUAL_SIZES.elsewhere, seed=_SEED)
    found = {"beside": beside, "farther": [_at(camera, frame.centre, _FARTHER) for camera in beside]}
    if not len(source):
        return {**found, "nearer": beside}
    cloud = sample_cloud(source, _POINTS, np.random.default_rng(_SEED))
    tried = [[_at(camera, frame.centre, times) for times in _NEARER] + [camera] for camera in beside]
    nearer = [next((one for one in those if is_clear(frame, cloud, one)), those[-1]) for those in tried]
    return {**found, "nearer": nearer}


def _at(camera: Camera, centre: NDArray[np.float64], times: float) -> Camera:
    """Return the camera with its distance from a centre multiplied."""
    turn = camera.viewmat[:3, :3]
    eye = -turn.T @ camera.viewmat[:3, 3]
    return relative_to((1.0 - times) * (eye - centre), camera)
