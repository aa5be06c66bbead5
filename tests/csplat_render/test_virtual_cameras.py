"""Tests of csplat_render.virtual_cameras."""

import numpy as np
import pytest
from cameras_cases import ball, niche, same

from csplat_render.scene_frame import scene_frame
from csplat_render.virtual_cameras import SURROUNDING_DISTANCES, virtual_cameras


@pytest.mark.slow
def test_cameras_in_surroundings_look_at_the_subject():
    frame = scene_frame(niche())
    for camera in virtual_cameras(niche()):
        towards = frame.centre - camera.position
        distance = np.linalg.norm(towards)
        assert np.isclose(distance / frame.extent, SURROUNDING_DISTANCES).any()
        assert np.allclose(camera.viewmat[2, :3], towards / distance)


@pytest.mark.slow
def test_cameras_depend_on_scene_and_seed_alone():
    first = virtual_cameras(ball())
    assert same(first, virtual_cameras(ball()))
    assert same(first, virtual_cameras(ball(cameras=[{"K": np.eye(3).tolist()}])))  # training cameras
    assert not same(first, virtual_cameras(ball(), seed=1))


def test_cameras_scale_with_the_scene():
    small, large = ball(), ball(radius=128.0, sizes=0.03 * 128.0)
    for a, b in zip(virtual_cameras(small), virtual_cameras(large), strict=True):
        assert np.allclose(a.viewmat[:3, :3], b.viewmat[:3, :3], atol=1e-5)
        assert np.allclose(128.0 * a.viewmat[:3, 3], b.viewmat[:3, 3], rtol=1e-4, atol=1e-2)
