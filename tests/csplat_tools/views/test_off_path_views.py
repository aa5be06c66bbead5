# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.views.off_path_views."""

from dataclasses import replace

import captures
import numpy as np
import pytest

from csplat_render.camera import intrinsics, look_at, orbit
from csplat_tools.views import views_off_path

K = intrinsics(64, 48, 50.0)


@pytest.fixture(scope="module")
def ball():
    """Return 300 small splats on a ball of radius 1 around the origin."""
    scene = captures.shell(3)
    return replace(scene, scales=np.full_like(scene.scales, -4.0))


def around(count):
    """Return cameras on a circle, 4 units from the ball's centre."""
    return orbit(np.zeros(3), 4.0, (0.0, 0.0, 1.0), count, K, 64, 48, elevation=0.0)


def test_views_are_between_beside_and_beyond_the_cameras(ball):
    cameras = around(8)
    found = views_off_path(ball, cameras)
    assert {"between": 8, "beside": 8, "beyond": 8} == {kind: len(views) for kind, views in found.items()}
    for number, camera in enumerate(cameras):
        between, beside, beyond = (views[number] for views in found.values())
        assert 4.0 * np.cos(np.pi / 8) == pytest.approx(np.linalg.norm(between.position))
        assert np.cos(np.pi / 8) == pytest.approx(between.viewmat[2, :3] @ camera.viewmat[2, :3])
        shown = np.linalg.norm(beyond.position - camera.position) / 0.5  # distance of what the camera shows
        assert 2.9 < shown < 4.1
        np.testing.assert_allclose(camera.viewmat[:3, :3], beyond.viewmat[:3, :3])
        turned = np.degrees(np.arccos(beside.viewmat[2, :3] @ camera.viewmat[2, :3]))
        assert 15.0 == pytest.approx(turned)
        pivot = camera.position + shown * camera.viewmat[2, :3]
        np.testing.assert_allclose(pivot, beside.position + shown * beside.viewmat[2, :3], atol=1e-9)
        for view in (between, beside, beyond):
            assert (64, 48, camera.near, None) == (view.W, view.H, view.near, view.image)


def test_a_single_camera_has_no_neighbours_and_no_view_is_close_to_a_surface(ball):
    (alone,) = around(1)
    assert {"beside", "beyond"} == views_off_path(ball, [alone]).keys()
    assert {"between", "beside", "beyond"} == views_off_path(ball, [alone], around(3)).keys()
    inside = look_at((0.45, 0.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), K, 64, 48, 0.01)
    (beyond,) = views_off_path(ball, [inside])["beyond"]
    assert 0.6 < beyond.position[0] < 0.8  # 1.5 times as far, it would be in the wall
    assert {} == views_off_path(ball.select(slice(0)), [alone]) == views_off_path(ball, [])
