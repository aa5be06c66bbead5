# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.camera."""

import os
import subprocess
import sys

import numpy as np
import pytest
from cameras_cases import UP, K
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import camera_outliers, central_camera, intrinsics, look_at, orbit

DOWN = (0, -1, 0)
SMALL = intrinsics(64, 48, 50.0), 64, 48
ORIGIN = np.zeros(3)


def pixel(camera, point):
    x, y, z = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    return camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]


def test_the_target_is_in_the_middle_up_points_up_and_the_field_of_view_spans_the_width():
    camera = look_at([3.0, 1.0, 0.5], [0.2, -0.1, 0.4], UP, K, 640, 480)
    across, down = pixel(camera, np.array([0.2, -0.1, 0.6]))
    assert np.allclose(pixel(camera, np.array([0.2, -0.1, 0.4])), (320.0, 240.0))
    assert np.isclose(across, 320.0)
    assert down < 240.0
    assert np.allclose(camera.position, [3.0, 1.0, 0.5])
    along_up = look_at([0.0, 0.0, 5.0], ORIGIN, UP, K, 640, 480)
    assert np.allclose(pixel(along_up, ORIGIN), (320.0, 240.0))
    assert np.isclose(320.0 / K[0, 0], np.tan(np.radians(30.0)))


def test_impossible_cameras_are_refused():
    for message, make in {
        "position and target are the same": lambda: look_at([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], UP, K, 640, 480),
        "field of view": lambda: intrinsics(640, 480, 180.0),
        "orbit": lambda: orbit(ORIGIN, 4.0, UP, 0, K, 640, 480),
    }.items():
        with pytest.raises(InputError, match=message):
            make()


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [1, 0, 0], [0.6, 0.0, 0.8]])
def test_an_orbit_has_equal_steps_distances_and_elevations(up):
    centre = np.array([1.0, 2.0, 3.0])
    cameras = orbit(centre, 4.0, up, 12, K, 640, 480, elevation=30.0, near=0.05)
    offsets = np.array([camera.position - centre for camera in cameras])
    steps = np.linalg.norm(offsets - np.roll(offsets, 1, axis=0), axis=1)
    assert (12, 3) == offsets.shape
    assert np.allclose(np.linalg.norm(offsets, axis=1), 4.0)
    assert np.allclose(offsets @ np.array(up), 2.0)
    assert np.allclose(steps, steps[0])
    assert {0.05} == {camera.near for camera in cameras}


def test_the_central_camera_is_near_the_medians():
    row = [look_at((x, 0, 0), (x, 0, 5), DOWN, *SMALL) for x in (-2, -1, 0, 1, 2)]
    aside, far = look_at(ORIGIN, (5, 0, 0), DOWN, *SMALL), look_at((0, 1e6, 0), (0, 1e6, 5), DOWN, *SMALL)
    assert row[2] is central_camera([aside, *row]) is central_camera([*row, far])
    assert row[0] is central_camera(row[:1])


def viewmats(positions, target=(0.0, 0.0, 4.0)):
    """Return viewmats at some positions that look at a point."""
    return np.stack([look_at(position, target, DOWN, *SMALL).viewmat for position in positions])


def test_cameras_far_from_all_others_are_outliers():
    for count in (1, 2, 4):
        placed = np.random.default_rng(0).normal(size=(16, 3))
        placed[:count] *= 5000.0
        found = camera_outliers(viewmats(np.add(placed, (1e6, 2e6, 3e6)), (1e6, 2e6, 3e6 + 4)))
        assert [True] * count + [False] * (16 - count) == found.tolist()


def two_tripods():
    """Return viewmats that look in all directions from two places."""
    places = 1e-3 * np.random.default_rng(1).normal(size=(16, 3)) + np.where(np.arange(16) < 13, 0.0, 4.0)[:, None]
    ways = [(np.cos(angle), np.sin(angle), 0.1) for angle in np.linspace(0.0, 6.0, 16)]
    return np.stack([look_at(at, at + way, UP, *SMALL).viewmat for at, way in zip(places, ways, strict=True)])


def test_cameras_of_ordinary_sets_are_no_outliers():
    places = np.random.default_rng(0).normal(size=(90, 3))
    ahead = np.geomspace(5.0, 2000.0, 20)[:, None] * np.array([1.0, 0.0, 0.0])
    tripod = np.concatenate([1e-3 * places[:15], [(0.5, 0, 0)]])
    cases = {
        "one": (viewmats(places[:1]),),
        "all in one place": (viewmats(np.zeros((9, 3))),),
        "three, one of them far away": (viewmats([(0, 0, 0), (1, 0, 0), (1e5, 0, 0)]),),
        "a corridor": (viewmats(np.linspace((0, 0, 0), (1000, 0, 0), 200)),),
        "a flight towards a building": (viewmats([*places, *ahead]),),
        "two places": (viewmats([*places[:60], *np.add(places[60:], (1e4, 0, 0))]),),
        "close-ups and overviews": (viewmats([*(0.01 * places[:80]), *places[80:]]),),
        "a moved tripod": (viewmats(tripod), np.add(places, (0, 0, 3))),
        "a second tripod, without points": (two_tripods(),),
    }

    def check(case):
        assert not camera_outliers(*case).any()

    assert [] == failures(cases, check)


@pytest.mark.slow
def test_the_number_of_threads_does_not_change_the_cameras(sample_path):
    code = (
        "import json, sys, csplat, numpy as np; from csplat_render.virtual_cameras import virtual_cameras\n"
        "model = csplat.read(sys.argv[1]).select(np.arange(20_000) % 8_000)\n"
        "print(json.dumps([camera.as_json() for camera in virtual_cameras(model)]))"
    )
    words = [sys.executable, "-c", code, str(sample_path)]
    one, two = (
        subprocess.check_output(words, env={**os.environ, "OMP_NUM_THREADS": n, "OPENBLAS_NUM_THREADS": n})
        for n in ("1", "2")
    )
    assert one == two
    assert 8 == one.count(b"viewmat")
