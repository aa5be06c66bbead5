"""Up, from how the cameras of a set were held."""

import numpy as np
import pytest

from csplat_render.camera import intrinsics, look_at
from csplat_trainer.data.loader import estimate_up_of_cameras

K = intrinsics(64, 48, 60.0)
UP = np.array([0.6, -0.8, 0.0])


def rolled(viewmat, degrees):
    """The same camera, turned about what it looks along."""
    a = np.radians(degrees)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return turn @ viewmat


def around(count, *, pitch=0.0, spread=360.0, rolls=0.0, seed=0):
    """Return cameras that look outwards, `pitch` degrees below the horizon, and are held nearly level."""
    first = np.array([0.0, 0.0, 1.0])
    second, rng = np.cross(UP, first), np.random.default_rng(seed)
    for a in np.radians(np.linspace(0.0, spread, count, endpoint=False)):
        ahead = np.cos(a) * first + np.sin(a) * second - np.tan(np.radians(pitch)) * UP
        yield rolled(look_at([0, 0, 0], ahead, UP, K, 64, 48).viewmat, rolls * rng.standard_normal())


def degrees_off(level):
    return float(np.degrees(np.arccos(np.clip(np.sum(np.array(level.up) * UP), -1.0, 1.0))))


@pytest.mark.parametrize("pitch", [-40.0, 0.0, 40.0, 70.0, 89.0])
def test_cameras_that_look_up_or_down_say_the_same(pitch):
    level = estimate_up_of_cameras(list(around(12, pitch=pitch)))
    assert level.by_horizons
    assert level.tilt_degrees < 0.01
    assert degrees_off(level) < 0.01


def test_cameras_that_look_to_one_side_are_asked_for_their_own_up():
    level = estimate_up_of_cameras(list(around(5, spread=10.0, pitch=5.0)))
    assert not level.by_horizons
    assert 4.0 < degrees_off(level) < 6.0


def test_hands_that_shake_move_it_little_and_are_told():
    level = estimate_up_of_cameras(list(around(60, rolls=6.0)))
    assert degrees_off(level) < 3.0
    assert 2.0 < level.tilt_degrees < 6.0
    assert f"within {level.tilt_degrees:.1f} degrees" in str(level)


def test_some_pictures_with_the_camera_on_its_side_change_little():
    viewmats = [rolled(one, 90.0 * (number % 5 == 0)) for number, one in enumerate(around(60))]
    assert degrees_off(estimate_up_of_cameras(viewmats)) < 2.0


def test_cameras_that_were_held_at_all_angles_say_nothing():
    rng = np.random.default_rng(1)
    viewmats = [look_at([0, 0, 0], *rng.standard_normal((2, 3)), K, 64, 48).viewmat for _ in range(40)]
    assert estimate_up_of_cameras(viewmats) is None
