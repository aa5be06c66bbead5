"""Estimates of the up axis, of scenes and of data sets."""

from __future__ import annotations

import numpy as np
import pytest

from csplat import decode, encode, read_ply
from csplat.model import SplatModel
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_paths import orbit_cameras
from csplat_render.up_estimate import estimate_up, with_estimated_up
from csplat_tools.cli.shared_options import parse_up, up_word
from csplat_tools.views import display_cameras, find_view_set
from csplat_trainer.data.loader import estimate_up_of_cameras

AXES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def photographed_from(up, seed=0, **fields):
    """A ball of fine splats, whose far side from a direction nobody saw: there they are few and large."""
    places = np.random.default_rng(seed).standard_normal((4000, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    unseen = places @ np.array(up, float) < -0.2
    kept = ~unseen | (np.arange(4000) % 40 == 0)
    sizes = np.where(unseen, 0.3, 0.03)[kept]
    n = int(kept.sum())
    return SplatModel(
        means=places[kept].astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        scales=np.log(np.tile(sizes[:, None], 3)).astype(np.float32),
        opacities=np.full(n, 0.9, np.float32),
        sh0=np.zeros((n, 3), np.float32),
        **fields,
    )


@pytest.mark.parametrize("up", AXES)
def test_up_is_from_where_an_object_was_seen(up):
    assert list(up) == with_estimated_up(photographed_from(up)).metadata["up"]  # what `estimate_up` returns
    assert up == parse_up(up_word(up))


def test_nothing_is_guessed_where_nothing_tells_it():
    assert estimate_up(photographed_from((0, 0, 0))) is None  # seen from all sides
    assert estimate_up(photographed_from((0.6, 0.6, 0.6))) is None  # between the axes
    assert estimate_up(photographed_from((0, 0, 1)).select(np.arange(0))) is None


@pytest.mark.parametrize("said", [{"metadata": {"up": [1, 0, 0]}}, {"coordinate_system": "RDF"}])
def test_what_a_scene_says_is_not_doubted(said):
    model = photographed_from((0, 0, 1), **said)
    assert estimate_up(model) is None
    assert with_estimated_up(model) is model


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_pictures_to_look_at_stand_upright_and_the_judges_stay():
    model = photographed_from((0, 1, 0))
    views = find_view_set(model, count=0)
    for camera in [*orbit_cameras(model, 4, 64, 48), *display_cameras(model, views)]:
        assert abs(camera.viewmat[0, 1]) < 1e-6
        assert camera.viewmat[1, 1] < 0.0  # down the picture
    assert all(camera.viewmat[1, 1] > 0.0 for camera in views.test)  # as in a PLY


def test_a_file_says_no_more_than_its_source():
    assert "up" not in decode(encode(photographed_from((0, 0, 1)))).metadata


@pytest.mark.parametrize(
    ("name", "up"), [("lego60k", (0, 0, 1)), ("donut", (0, 0, 1)), ("horse", None), ("jacket", None)]
)
def test_real_objects_seem_to_stand_as_they_do(data_dir, name, up):
    assert up == estimate_up(read_ply(data_dir / "ply" / f"{name}.ply"))


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
