"""Paths of a camera for a film: whole objects, surroundings without their walls, along cameras that are known."""

import numpy as np
import pytest

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.camera import intrinsics, look_at, orbit
from csplat_render.camera_paths import orbit_cameras
from csplat_render.scene_frame import scene_frame

pytestmark = pytest.mark.slow  # two CPU seconds together

K = intrinsics(64, 48, 60.0)
SLANTED = [0.0, -0.8, 0.6]


def model_of(means, size=0.03, **fields):
    n = len(means)
    sizes = np.broadcast_to(np.asarray(size, np.float32).reshape(-1, 1), (n, 3))
    return SplatModel(
        means=np.asarray(means, np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        scales=np.log(sizes).astype(np.float32),
        opacities=np.full(n, 0.9, np.float32),
        sh0=np.zeros((n, 3), np.float32),
        **fields,
    )


def figure(seed=0):
    """A round body, thin legs (y points down), a few crumbs far away."""
    rng = np.random.default_rng(seed)
    body = rng.standard_normal((4000, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    heights = 0.95 + 1.2 * rng.random(120)
    legs = np.stack([np.where(np.arange(120) % 2, 0.3, -0.3), heights, 0.02 * rng.standard_normal(120)], axis=1)
    crumbs = [[9.0, 9.0, 9.0], [-8.0, 0.0, 0.0], [-8.1, 0.1, 0.0]]
    return model_of(np.concatenate([body, legs, crumbs])), 4120


def same(cameras, others):
    return all((a.viewmat == b.viewmat).all() for a, b in zip(cameras, others, strict=True))


def on_picture(points, camera):
    p = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return p[:, :2] / p[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + [camera.K[0, 2], camera.K[1, 2]]


@pytest.mark.parametrize("size", [(240, 320), (400, 100)])
def test_an_orbit_shows_an_object_whole_down_to_its_feet(size):
    model, count = figure()
    assert "object" == scene_frame(model).kind
    cameras = orbit_cameras(model, 6, *size)
    if size == (240, 320):
        assert same(cameras, orbit_cameras(figure()[0], 6, *size))
    places = np.concatenate([on_picture(model.means[:count], camera) for camera in cameras])
    assert ((places > 0) & (places < size)).all()
    filled = np.max(np.abs(places - np.array(size) / 2) / (np.array(size) / 2), axis=0)
    assert filled.max() > 0.8  # and crumbs do not push it away


@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], SLANTED])
def test_an_orbit_goes_about_what_the_scene_says_is_up(up):
    model, _ = figure()
    cameras = orbit_cameras(SplatModel(**{**vars(model), "metadata": {"up": up}}), 8, 64, 48)
    heights = [camera.position @ np.array(up) for camera in cameras]
    assert np.ptp(heights) < 1e-5
    for camera in cameras:
        assert abs(camera.viewmat[0, :3] @ np.array(up)) < 1e-5
        assert -camera.viewmat[1, :3] @ np.array(up) > 0.9


def niche(seed=0):
    """Fine things before a coarse wall at x = -1, a coarse room far around them."""
    rng = np.random.default_rng(seed)
    things = 0.3 * rng.standard_normal((5000, 3))
    wall = np.stack([np.full(900, -1.0), *(6.0 * rng.random((2, 900)) - 3.0)], axis=1)
    room = rng.standard_normal((1500, 3))
    room *= 6.0 / np.linalg.norm(room, axis=1, keepdims=True)
    return model_of(np.concatenate([things, wall, room]), np.repeat([0.02, 0.3, 0.4], [5000, 900, 1500]))


def test_a_path_inside_of_surroundings_stays_before_the_wall_and_goes_back():
    model = niche()
    frame = scene_frame(model)
    assert "surrounding" == frame.kind
    cameras = orbit_cameras(model, 48, 64, 48)
    assert same(cameras, orbit_cameras(niche(), 48, 64, 48))
    places = np.stack([camera.position for camera in cameras])
    assert places[:, 0].min() > -0.9
    assert np.ptp(places, axis=0).max() > 0.3 * frame.extent
    steps = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)  # the last one to the first, too
    assert steps.max() < 0.4 * frame.extent


def ring(count, spread=360.0):
    angles = np.radians(np.linspace(0.0, spread, count, endpoint=False))
    return [look_at([3 * np.cos(a), -1.0, 3 * np.sin(a)], [0, 0, 0], [0, -1, 0], K, 64, 48) for a in angles]


@pytest.mark.parametrize(("spread", "off"), [(360.0, 0.4), (90.0, 0.4)])
def test_a_path_leads_along_cameras_and_looks_as_they_do(spread, off):
    known = ring(40, spread)
    places = np.stack([camera.position for camera in known])
    cameras = orbit_cameras(niche(), 24, 64, 48, along=known)
    for camera in cameras:
        assert np.linalg.norm(places - camera.position, axis=1).min() < off
        towards = -camera.position / np.linalg.norm(camera.position)
        assert camera.viewmat[2, :3] @ towards > 0.95
    middle = np.mean([camera.position for camera in cameras], axis=0)
    assert np.linalg.norm(middle - places.mean(axis=0)) < 0.4
    far = look_at([0, 5000.0, 0], [0, 0, 0], [0, 0, 1], K, 64, 48)
    assert same(cameras, orbit_cameras(niche(), 24, 64, 48, along=[*known, far]))


def test_surroundings_that_carry_cameras_are_travelled_along_them():
    known = ring(40, 90.0)
    carrying = SplatModel(**{**vars(niche()), "cameras": [camera.to_json() for camera in known]})
    wanted = orbit_cameras(niche(), 8, 64, 48, along=known)
    assert same(wanted, orbit_cameras(carrying, 8, 64, 48))


def test_a_film_sways_around_the_view_that_a_scene_is_shown_from_first():
    first = look_at([2.4, -0.8, 0.3], [0, 0, 0], [0, -1, 0], K, 64, 48)
    known = {**vars(niche()), "metadata": {"view": first.to_json(), "up": [0, -1, 0]}}
    cameras = orbit_cameras(SplatModel(**known), 24, 64, 48)
    places = np.stack([camera.position for camera in cameras])
    assert np.allclose(places.mean(axis=0), first.position, atol=0.25)
    assert np.allclose(np.linalg.norm(places, axis=1), np.linalg.norm(first.position), atol=0.01)
    assert 0.4 < np.ptp(places[:, 2]) < 3.0  # aside
    assert 0.05 < np.ptp(places[:, 1]) < 0.5 * np.ptp(places[:, 2])  # up and down
    assert all(camera.viewmat[2, :3] @ -camera.position > 0.99 * np.linalg.norm(camera.position) for camera in cameras)
    unread = SplatModel(**{**known, "metadata": {"view": {"K": 1}, "up": [0, -1, 0]}})
    assert len(orbit_cameras(unread, 24, 64, 48)) == 24  # the arc for a scene without a readable view


def test_one_camera_that_is_known_makes_a_film_that_stands_still():
    (known,) = ring(1)
    for camera in orbit_cameras(niche(), 3, 64, 48, along=[known]):
        assert np.allclose(known.viewmat, camera.viewmat)


def test_scenes_of_nothing_one_point_and_no_end_have_a_path():
    for means, size in ((np.zeros((0, 3)), 0.1), (np.zeros((1, 3)), 0.1), (figure()[0].means, 1e25)):
        assert all(np.isfinite(camera.viewmat).all() for camera in orbit_cameras(model_of(means, size), 3))


def test_refuses_a_path_of_no_cameras():
    with pytest.raises(InputError, match="at least 1"):
        orbit_cameras(niche(), 0)


def test_the_circle_of_an_empty_scene_is_one(make_model):
    cameras = orbit_cameras(make_model(0), 4, 64, 48)
    wanted = orbit([0, 0, 0], 1.0, [0, -1, 0], 4, K, 64, 48, near=cameras[0].near)
    assert same(wanted, cameras)
