"""Choose views whose images are worth showing to people.

The views of `psnr` are spread all around a scene, whatever they show: in an indoor capture some see the back of objects
that no photograph shows, or a wall from nearby; a scene without a known up direction may lie on its side. That is fair
to files, but such images are of no use to a reader.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.virtual_cameras import HIDING, detail, farthest_points, sample_cloud, scene_frame, with_estimated_up
from csplat_tools.views.placing import camera_sequence
from csplat_tools.views.viewset import VIRTUAL, ViewSet

_COUNT, _SIZE = 6, (640, 480)  # largest number of views; their width and height, pixels
_TRIED, _POINTS, _SEED = 64, 40_000, 0  # candidates; points sampled from the scene; seed of both
_GOOD_DETAIL = 0.8  # least detail as a fraction of the best view's


def showing_cameras(source: SplatModel, views: ViewSet) -> Sequence[Camera]:
    """Return the views to show.

    Args:
        source: the scene.
        views: the user's own test views are shown; if they are virtual, others are searched.

    Returns:
        Cameras relative to the scene's origin: the test views, or virtual ones far apart from each other that show fine
        splats with nothing in front of them.
    """
    if views.name != VIRTUAL or not len(source):
        return views.judges
    told = with_estimated_up(source)
    own = views.judges if told is source else ()  # else they would show it lying on its side
    cameras = [*own, *camera_sequence(told, _TRIED, _SIZE, seed=_SEED)]
    cloud, nearest = sample_cloud(source, _POINTS, np.random.default_rng(_SEED)), HIDING * scene_frame(source).extent
    details = np.array([detail(cloud, camera, nearest) for camera in cameras])
    good = np.flatnonzero(details >= _GOOD_DETAIL * details.max())
    positions = np.stack([cameras[i].position for i in good])
    chosen = farthest_points(positions, int(np.argmax(details[good])), min(_COUNT, len(good)))
    return [cameras[good[i]] for i in chosen]
