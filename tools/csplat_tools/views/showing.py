"""Views for pictures that people look at: what is shown there is what somebody would go and look at.

The views of `psnr` are spread all around a scene, whatever is there: of an indoor capture some look at the back of what
no photograph shows, or at a wall from nearby; a scene that does not say which way is up may lie on its side. That is
fair to files, but a picture of it tells nobody anything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.cloud import detail, sample_cloud
from csplat_render.standing import standing
from csplat_render.virtual import HIDING, far_apart, scene_frame
from csplat_tools.views.placing import camera_sequence
from csplat_tools.views.viewset import VIRTUAL, ViewSet

__all__ = ["showing_cameras"]

_COUNT, _SIZE = 6, (640, 480)
_TRIED, _POINTS, _SEED = 64, 40_000, 0
_GOOD_DETAIL = 0.8  # of the best view's


def showing_cameras(source: SplatModel, views: ViewSet) -> Sequence[Camera]:
    """Views to take pictures from.

    Args:
        source: the scene.
        views: a user's own views that judge are shown; where they are virtual, others are looked for.

    Returns:
        Cameras relative to the scene's origin: of many virtual ones those far apart that show fine splats with nothing
        before them.
    """
    if views.name != VIRTUAL or not len(source):
        return views.judges
    told = standing(source)
    own = views.judges if told is source else ()  # they would show it lying on its side
    cameras = [*own, *camera_sequence(told, _TRIED, _SIZE, seed=_SEED)]
    cloud, nearest = sample_cloud(source, _POINTS, np.random.default_rng(_SEED)), HIDING * scene_frame(source).extent
    details = np.array([detail(cloud, camera, nearest) for camera in cameras])
    good = np.flatnonzero(details >= _GOOD_DETAIL * details.max())
    positions = np.stack([cameras[i].position for i in good])
    chosen = far_apart(positions, int(np.argmax(details[good])), min(_COUNT, len(good)))
    return [cameras[good[i]] for i in chosen]
