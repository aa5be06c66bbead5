"""Camera files, paths of cameras, and virtual cameras."""

import os
import subprocess
import sys

import numpy as np
import pytest
from cameras_cases import UP, K
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import (
    Camera,
    camera_outliers,
    central_camera,
    direction_at,
    intrinsics,
    look_at,
    orbit,
)


def pixel(camera, point):
    x, y, z = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    return camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]


def test_the_target_is_in_the_middle_and_up_points_up():
    camera = look_at([3.0, 1.0, 0.5], [0.2, -0.1, 0.4], UP, K, 640, 480)
    assert np.allclose(pixel(camera, np.array([0.2, -0.1, 0.4])), (320.0, 240.0))
    above = pixel(camera, np.array([0.2, -0.1, 0.6]))
    assert np.isclose(above[0], 320.0)
    assert above[1] < 240.0
    assert np.allclose(camera.position, [3.0, 1.0, 0.5])


def test_a_camera_may_look_along_up_but_not_at_its_own_position():
    camera = look_at([0.0, 0.0, 5.0], [0.0, 0.0, 0.0], UP, K, 640, 480)
    assert np.allclose(pixel(camera, np.zeros(3)), (320.0, 240.0))
    with pytest.raises(InputError, match="position and target are the same"):
        look_at([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], UP, K, 640, 480)


def test_the_field_of_view_spans_the_width():
    assert np.isclose(320.0 / K[0, 0], np.tan(np.radians(30.0)))
    with pytest.raises(InputError, match="field of view"):
        intrinsics(640, 480, 180.0)


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [1, 0, 0], [0.6, 0.0, 0.8]])
def test_directions_have_unit_length_and_their_elevation(up):
    for azimuth in (0.0, 77.0, 200.0):
        d = direction_at(up, azimuth, 25.0)
        assert np.isclose(np.linalg.norm(d), 1.0)
        assert np.isclose(np.degrees(np.arcsin(d @ np.array(up, float))), 25.0)


def test_an_orbit_has_equal_steps_and_distances():
    centre = np.array([1.0, 2.0, 3.0])
    cameras = orbit(centre, 4.0, UP, 12, K, 640, 480, elevation=30.0, near=0.05)
    assert 12 == len(cameras)
    offsets = np.array([camera.position - centre for camera in cameras])
    assert np.allclose(np.linalg.norm(offsets, axis=1), 4.0)
    assert np.allclose(offsets[:, 2], 2.0)
    steps = np.linalg.norm(offsets - np.roll(offsets, 1, axis=0), axis=1)
    assert np.allclose(steps, steps[0])
    assert all(isinstance(camera, Camera) and camera.near == 0.05 for camera in cameras)
    with pytest.raises(InputError, match="orbit"):
        orbit(centre, 4.0, UP, 0, K, 640, 480)


def test_the_central_camera_is_near_the_medians():
    K = intrinsics(64, 48, 50.0)
    row = [look_at((x, 0, 0), (x, 0, 5), (0, -1, 0), K, 64, 48) for x in (-2, -1, 0, 1, 2)]
    aside = look_at((0, 0, 0), (5, 0, 0), (0, -1, 0), K, 64, 48)
    assert row[2] is central_camera([aside, *row])
    assert row[0] is central_camera(row[:1])
    far = look_at((0, 1e6, 0), (0, 1e6, 5), (0, -1, 0), K, 64, 48)
    assert row[2] is central_camera([*row, far])


def viewmats(positions, target=(0.0, 0.0, 4.0)):
    """Return viewmats at some positions that look at a point."""
    K = intrinsics(64, 48, 50.0)
    return np.stack([look_at(position, target, (0, -1, 0), K, 64, 48).viewmat for position in positions])


def test_cameras_far_from_all_others_are_outliers():
    rng = np.random.default_rng(0)
    near = rng.normal(size=(16, 3))
    for count in (1, 2, 4):
        placed = near.copy()
        placed[:count] *= 5000.0
        placed += (1e6, 2e6, 3e6)
        found = camera_outliers(viewmats(placed, (1e6, 2e6, 3e6 + 4)))
        assert [True] * count + [False] * (16 - count) == found.tolist()


def test_cameras_of_ordinary_sets_are_no_outliers():
    places = np.random.default_rng(0).normal(size=(90, 3))
    ahead = np.geomspace(5.0, 2000.0, 20)[:, None] * np.array([1.0, 0.0, 0.0])

    def check(case):
        assert not camera_outliers(viewmats(case[0]), *case[1:]).any()

    cases = {
        "one": (places[:1],),
        "all in one place": (np.zeros((9, 3)),),
        "three, one of them far away": ([(0, 0, 0), (1, 0, 0), (1e5, 0, 0)],),
        "a corridor": (np.linspace((0, 0, 0), (1000, 0, 0), 200),),
        "a flight towards a building": (np.concatenate([places, ahead]),),
        "two places": (np.concatenate([places[:60], places[60:] + np.array((1e4, 0, 0))]),),
        "close-ups and overviews": (np.concatenate([0.01 * places[:80], places[80:]]),),
        "a moved tripod": (
            np.concatenate([1e-3 * places[:15], [(0.5, 0, 0)]]),
            np.add(places, [0, 0, 3]),
        ),
    }
    assert [] == failures(cases, check)


def test_a_second_tripod_without_points_is_no_outlier():
    K, rng = intrinsics(64, 48, 50.0), np.random.default_rng(1)
    places = 1e-3 * rng.normal(size=(16, 3)) + np.where(np.arange(16) < 13, 0.0, 4.0)[:, None]
    turned = [(np.cos(a), np.sin(a), 0.1) for a in np.linspace(0.0, 6.0, 16)]
    cameras = [look_at(place, place + way, (0, 0, 1), K, 64, 48) for place, way in zip(places, turned, strict=True)]
    assert not camera_outliers(np.stack([camera.viewmat for camera in cameras])).any()


THREADS = """
import json
import numpy as np
from csplat.model import SplatModel, normalise_quats
from csplat_render.virtual_cameras import virtual_cameras

rng = np.random.default_rng(0)
f = lambda *shape: rng.standard_normal((20000, *shape)).astype(np.float32)
model = SplatModel(means=f(3), quats=normalise_quats(f(4)), scales=f(3) - 4, opacities=abs(np.tanh(f())), sh0=f(3))
print(json.dumps([camera.to_json() for camera in virtual_cameras(model)]))
"""


@pytest.mark.slow
def test_the_number_of_threads_does_not_change_the_cameras():
    out = []
    for threads in ("1", "2"):
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        out.append(subprocess.check_output([sys.executable, "-c", THREADS], env=environment))
    assert out[0] == out[1]
    assert 8 == out[0].count(b"viewmat")
