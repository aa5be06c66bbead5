# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.camera_paths."""

import numpy as np
import pytest
from cameras_cases import ball, figure, niche, same
from checked import cloud
from models import with_facts
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import intrinsics, look_at, orbit
from csplat_render.camera_paths import _best_arc, orbit_cameras
from csplat_render.first_view import first_view
from csplat_render.scene_frame import scene_frame
from csplat_render.up_estimate import estimate_up
from csplat_render.virtual_cameras import virtual_cameras

SMALL_K = intrinsics(64, 48, 60.0)


def project(points, camera):
    p = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return p[:, :2] / p[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + [camera.K[0, 2], camera.K[1, 2]]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(240, 320), (400, 100)])
def test_an_orbit_shows_an_object_entirely(size):
    model, count = figure()
    places = np.concatenate([project(model.means[:count], camera) for camera in orbit_cameras(model, 6, *size)])
    assert ((places > 0) & (places < size)).all()
    assert np.abs(2 * places / size - 1).max() > 0.8  # floaters do not increase the distance


@pytest.mark.slow
@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], [0.0, -0.8, 0.6]])
def test_an_orbit_goes_around_the_recorded_up(up):
    model, _ = figure()
    cameras = orbit_cameras(with_facts(model, entries={"up": up}), 8, 64, 48)
    right, down = (np.array([camera.viewmat[row, :3] @ np.array(up) for camera in cameras]) for row in (0, 1))
    assert np.ptp([camera.position @ np.array(up) for camera in cameras]) < 1e-5
    assert np.abs(right).max() < 1e-5
    assert down.max() < -0.9


@pytest.mark.slow
def test_an_orbit_of_unknown_up_is_upright_where_the_first_view_is():
    rows = np.random.default_rng(0).standard_normal((2000, 3))
    disc = cloud(rows / np.linalg.norm(rows, axis=1, keepdims=True) * (1.0, 1.0, 0.3))
    assert estimate_up(disc) is None
    for camera in (first_view(disc), *orbit_cameras(disc, 4, 64, 48)):
        assert camera.viewmat[1, 1] > 0.9  # images have y, as the scene, downwards
        assert abs(camera.viewmat[0, 1]) < 1e-6


@pytest.mark.slow
def test_a_path_in_surroundings_stays_in_front_of_walls_and_is_closed():
    extent = scene_frame(niche()).extent
    cameras = orbit_cameras(niche(), 48, 64, 48)
    assert same(cameras, orbit_cameras(niche(), 48, 64, 48))
    places = np.stack([camera.position for camera in cameras])
    assert places[:, 0].min() > -0.9
    assert np.ptp(places, axis=0).max() > 0.3 * extent
    steps = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)  # including from the last to the first
    assert steps.max() < 0.4 * extent


def test_the_best_arc_is_the_cyclic_run_with_the_largest_sum():
    cases = (
        ([[-1, 2, 3, -1], [-1, 4, -9, 0]], (0, 1, 2)),
        ([[3, -1, -1, 2], [1, 1, 1, 1]], (0, 3, 2)),  # across the end of a row
        ([[1, 0, -5, 0], [0, 2, 2, 2]], (1, 1, 3)),
        ([[1, 1, 1, 1]], (0, 0, 4)),
        ([[-3, -1, -2, -2]], (0, 1, 1)),
        ([[0, 1, 0, 1]], (0, 1, 3)),
    )
    assert [arc for _, arc in cases] == [_best_arc(np.array(gains, np.float64)) for gains, _ in cases]


def ring(count, spread=360.0):
    angles = np.radians(np.linspace(0.0, spread, count, endpoint=False))
    return [look_at([3 * np.cos(a), -1.0, 3 * np.sin(a)], [0, 0, 0], [0, -1, 0], SMALL_K, 64, 48) for a in angles]


@pytest.mark.slow
@pytest.mark.parametrize("spread", [360.0, 90.0])
def test_a_path_along_cameras_has_their_positions_and_directions(spread):
    known = ring(40, spread)
    places = np.stack([camera.position for camera in known])
    cameras = orbit_cameras(niche(), 24, 64, 48, along=known)
    for camera in cameras:
        assert np.linalg.norm(places - camera.position, axis=1).min() < 0.4
        assert camera.viewmat[2, :3] @ -camera.position > 0.95 * np.linalg.norm(camera.position)
    middle = np.mean([camera.position for camera in cameras], axis=0)
    assert np.linalg.norm(middle - places.mean(axis=0)) < 0.4
    far = look_at([0, 5000.0, 0], [0, 0, 0], [0, 0, 1], SMALL_K, 64, 48)
    assert same(cameras, orbit_cameras(niche(), 24, 64, 48, along=[*known, far]))
    carrying = with_facts(niche(), cameras=[camera.as_json() for camera in known])
    assert same(cameras, orbit_cameras(carrying, 24, 64, 48))  # the recorded cameras
    for camera in orbit_cameras(niche(), 3, 64, 48, along=known[:1]):  # one camera does not move
        assert np.allclose(known[0].viewmat, camera.viewmat)


@pytest.mark.slow
def test_a_path_sways_around_the_recorded_first_view():
    first = look_at([2.4, -0.8, 0.3], [0, 0, 0], [0, -1, 0], SMALL_K, 64, 48)
    cameras = orbit_cameras(with_facts(niche(), entries={"view": first.as_json(), "up": [0, -1, 0]}), 24, 64, 48)
    places = np.stack([camera.position for camera in cameras])
    assert np.allclose(places.mean(axis=0), first.position, atol=0.25)
    assert np.allclose(np.linalg.norm(places, axis=1), np.linalg.norm(first.position), atol=0.01)
    assert 0.4 < np.ptp(places[:, 2]) < 3.0  # sideways
    assert 0.05 < np.ptp(places[:, 1]) < 0.5 * np.ptp(places[:, 2])  # up and down
    assert all(camera.viewmat[2, :3] @ -camera.position > 0.99 * np.linalg.norm(camera.position) for camera in cameras)
    unread = with_facts(niche(), entries={"view": {"K": 1}, "up": [0, -1, 0]})
    assert 24 == len(orbit_cameras(unread, 24, 64, 48))  # the arc of a scene without a valid view


@pytest.mark.slow
def test_degenerate_scenes_have_cameras():
    scenes = {
        "without splats": cloud(np.zeros((0, 3)), np.zeros(0)),
        "one point": cloud(np.zeros((1, 3))),
        "transparent": ball(300, opacities=np.zeros(300, np.float32)),
        "huge splats": ball(300, scales=np.full((300, 3), 60.0, np.float32)),
        "tiny splats": ball(300, scales=np.full((300, 3), -60.0, np.float32)),
        "far away": ball(300, radius=1e15),
    }

    def check(model):
        cameras = [*virtual_cameras(model, 1), *orbit_cameras(model, 3)]
        assert 4 == len(cameras)
        assert all(np.isfinite(camera.viewmat).all() for camera in cameras)

    assert [] == failures(scenes, check)
    cameras = orbit_cameras(scenes["without splats"], 4, 64, 48)
    assert same(orbit([0, 0, 0], 1.0, [0, -1, 0], 4, SMALL_K, 64, 48, near=cameras[0].near), cameras)
    for make in (virtual_cameras, orbit_cameras):
        with pytest.raises(InputError, match="at least 1"):
            make(ball(), 0)
