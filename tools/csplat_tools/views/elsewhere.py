"""Views that nothing was fitted to, chosen or judged by: what a file looks like from where nobody looked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.cameras import relative_to
from csplat_render.virtual import scene_frame, virtual_cameras

__all__ = ["elsewhere"]

_VIEWS = (12, 320, 240)  # of each kind; width and height of their pictures
_SEED = 2000  # those that decide have 1000 and more
_DISTANCES = {"beside": 1.0, "nearer": 0.6, "farther": 2.0}  # from the middle of the scene, times the usual


def elsewhere(source: SplatModel) -> dict[str, list[Camera]]:
    """Virtual cameras as those of `psnr`, but others, and the same nearer to the scene's middle and farther from it.

    Args:
        source: the scene; its own cameras are not looked at.

    Returns:
        12 cameras of each kind: `beside`, `nearer`, `farther`.
    """
    centre = scene_frame(source).centre
    beside = virtual_cameras(source, *_VIEWS, seed=_SEED)
    return {kind: [_at(camera, centre, times) for camera in beside] for kind, times in _DISTANCES.items()}


def _at(camera: Camera, centre: NDArray[np.float64], times: float) -> Camera:
    """The camera with its distance from a centre multiplied."""
    turn = camera.viewmat[:3, :3]
    eye = -turn.T @ camera.viewmat[:3, 3]
    return relative_to((1.0 - times) * (eye - centre), camera)
