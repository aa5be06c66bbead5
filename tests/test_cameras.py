"""Camera files, paths of cameras, and virtual cameras."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from checked import cloud
from tables import failures

from csplat import read_ply
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.camera import (
    Camera,
    camera_outliers,
    central_camera,
    direction_at,
    intrinsics,
    look_at,
    orbit,
    relative_to,
)
from csplat_render.camera_files import load_cameras, save_cameras
from csplat_render.camera_paths import orbit_cameras
from csplat_render.scene_frame import covered_fraction, sample_cloud, scene_frame, weighted_quantiles
from csplat_render.virtual_cameras import OBJECT_DISTANCES, SURROUNDING_DISTANCES, virtual_cameras

K = intrinsics(640, 480, 60.0)
UP = np.array([0.0, 0.0, 1.0])


def pixel(camera, point):
    x, y, z = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    return camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]


def test_saved_cameras_are_loaded_exactly(tmp_path):
    cameras = [
        look_at([1.0, 2.0, 3.0], [0.1, 0.0, 0.0], UP, K, 640, 480, 0.01, "a/b.png"),
        look_at([-3.0, 0.3, 1.0], [0.0, 0.0, 0.2], UP, K, 320, 200),
    ]
    save_cameras(tmp_path / "c.json", cameras)
    assert [camera.to_json() for camera in cameras] == [c.to_json() for c in load_cameras(tmp_path / "c.json")]


def test_near_and_image_may_be_left_out(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps([{"K": K.tolist(), "viewmat": np.eye(4).tolist(), "W": 640, "H": 480}]))
    (camera,) = load_cameras(tmp_path / "c.json")
    assert (0.2, None) == (camera.near, camera.image)


FAR_TOO_LARGE = r"c\.json is not a JSON file: an integer has \d[\d,]* digits"
NO_CAMERAS = {
    b"{": "not a JSON file", b"\xff\xfe": "not a JSON file", b"[]": "not a camera file", b"{}": "not a camera file",
    b"[1]": "camera 0", b'[{"K": 1}]': "camera 0.*viewmat",
    b'[{"W": %d}]' % 10**400: FAR_TOO_LARGE, b'{"fl_x": ' + b"9" * 5000 + b', "frames": []}': FAR_TOO_LARGE,
}  # fmt: skip


def test_other_and_absent_files_are_refused(tmp_path):
    def check(case):
        text, message = case
        (tmp_path / "c.json").write_bytes(text)
        with pytest.raises(InputError, match=message):
            load_cameras(tmp_path / "c.json")

    assert [] == failures({repr(case[0][:30]): case for case in NO_CAMERAS.items()}, check)
    with pytest.raises(InputError, match=r"nowhere\.json"):
        load_cameras("nowhere.json")


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


def test_cameras_relative_to_the_origin_or_to_0_are_distinguished(tmp_path):
    K, place, path = intrinsics(64, 48, 50.0), np.array((500123.0, 4649876.0, 214.0)), tmp_path / "cameras.json"
    own = [look_at((x, 3, 0), (0, 0, 5), (0, -1, 0), K, 64, 48) for x in (-2, 0, 2)]
    for cameras, origin, note_count in (
        (own, place, 0),
        ([relative_to(-place, camera) for camera in own], place, 1),
        (own, np.zeros(3), 0),
        (own, np.array((0.0, 3.0, 1.0)), 0),
    ):
        save_cameras(path, cameras)
        notes = []
        found = load_cameras(path, notes, origin)
        assert all(np.allclose(a.viewmat, b.viewmat) for a, b in zip(own, found, strict=True))
        assert note_count == len(notes)


def inria(**fields):
    """Return an INRIA camera at 1 2 3 that looks along x, z up, 64 by 48 pixels, focal length 50, with changes."""
    inria = {"position": [1, 2, 3], "rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "fx": 50.0, "fy": 50.0}
    return {"id": 0, "img_name": "a.png", "width": 64, "height": 48, **inria, **fields}


OPENGL = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]

ENTRY = {
    "camera_to_world": [value for row in OPENGL for value in row],
    "fov": math.degrees(2 * math.atan(24 / 50)),
    "aspect": 4 / 3,
}

NERFSTUDIO = {"camera_type": "perspective", "render_width": 64, "render_height": 48, "camera_path": [ENTRY], "fps": 24}
FRAME = {"file_path": "images/a.png", "transform_matrix": OPENGL}
TRANSFORMS = {"w": 64, "h": 48, "fl_x": 50.0, "frames": [FRAME]}

#: Files of other programs with this camera, its principal point, and a part of the report.
FOREIGN = {
    "INRIA": ([inria()], (32, 24), "INRIA"),
    "nerfstudio": (NERFSTUDIO, (32, 24), "nerfstudio"),
    "nerfstudio, by rows": ({**NERFSTUDIO, "camera_path": [{**ENTRY, "camera_to_world": OPENGL}]}, (32, 24), "path"),
    "transforms": (TRANSFORMS, (32, 24), "transforms.json"),
    "own fields of a frame": (
        {"frames": [{**FRAME, "w": 64, "h": 48, "camera_angle_x": 2 * math.atan(32 / 50), "cx": 30, "cy": 20}]},
        (30, 20),
        "1 camera",
    ),
    "a scaled world": (
        {**TRANSFORMS, "frames": [{"transform_matrix": (np.array(OPENGL) * [[2, 2, 2, 1]]).tolist()}]},
        (32, 24),
        "1 pose scaled",
    ),
    "distortion": ({**TRANSFORMS, "k1": 0.1}, (32, 24), "lens distortion is ignored"),
}


def test_camera_files_of_other_programs_are_read(tmp_path):
    wanted = look_at([1, 2, 3], [2, 2, 3], UP, K, 64, 48).viewmat

    def check(case):
        document, middle, word = case
        (tmp_path / "c.json").write_text(json.dumps(document))
        report = []
        (camera,) = load_cameras(tmp_path / "c.json", report)
        assert np.allclose(wanted, camera.viewmat)
        assert np.allclose([50.0, 50.0, *middle], [camera.K[0, 0], camera.K[1, 1], *camera.K[:2, 2]])
        assert (64, 48) == (camera.W, camera.H)
        assert any(word in line for line in report)

    assert [] == failures(FOREIGN, check)


#: Invalid files, and a part of the error.
WRONG = {
    "INRIA, no focal length": ([inria(), inria(fx=None)], "camera 1: fx is None, expected a number"),
    "INRIA, no position": ([inria(position=None)], "camera 0: rotation or position has another shape"),
    "INRIA, another entry": ([inria(), {"K": 1}], "camera 1: width is None"),
    "INRIA, no rotation": ([inria(rotation=[[1, 1, 1]] * 3)], "camera 0: the camera's viewmat does not begin"),
    "INRIA, no object": ([inria(), 3], "camera 1 is int, expected an object"),
    "nerfstudio, panorama": ({**NERFSTUDIO, "camera_type": "equirectangular"}, "camera_type is equirectangular"),
    "nerfstudio, no size": ({**NERFSTUDIO, "render_width": None}, "camera_path 0: render_width is None"),
    "nerfstudio, angle": ({**NERFSTUDIO, "camera_path": [{**ENTRY, "fov": 200}]}, "fov is 200, expected degrees"),
    "nerfstudio, empty": ({**NERFSTUDIO, "camera_path": []}, "lists no cameras"),
    "transposed": (
        {**NERFSTUDIO, "camera_path": [{**ENTRY, "camera_to_world": np.transpose(OPENGL).ravel().tolist()}]},
        "camera_to_world has the last row 1 2 3 1, expected 0 0 0 1: .* transposed",
    ),
    "transforms, no size": ({"camera_angle_x": 0.8, "frames": [FRAME]}, "frame 0: w and h are missing, .*--data"),
    "transforms, fisheye": ({**TRANSFORMS, "is_fisheye": True}, "frame 0: camera_model is a fisheye"),
    "transforms, no matrix": ({**TRANSFORMS, "frames": [{}]}, "frame 0: transform_matrix has shape"),
    "ours, transposed": (
        [{"K": K.tolist(), "viewmat": np.transpose(OPENGL).tolist(), "W": 640, "H": 480}],
        "camera 0: the camera's viewmat has the last row 1 2 3 1, expected 0 0 0 1: .* transposed",
    ),
    "no pixels": ([inria(fx=0.8, fy=1.0)], "camera 0: the focal length across is 0.8 for 64 pixels, expected 3.2"),
    "swapped": ({**TRANSFORMS, "cx": 24, "cy": 32}, "camera 0: the principal point is 24 32 in 64×48 pixels, expected"),
    "nerfstudio, keyframes": (
        {**NERFSTUDIO, "camera_path": [], "keyframes": [{}]},
        "lists no cameras, but keyframes .*: generate the path in its viewer",
    ),
    "nerfstudio, transform": ({"transform": [], "scale": 0.2}, "is dataparser_transforms.json of nerfstudio"),
    "nerfstudio, exported": ([{"file_path": "a", "transform": []}], "has the poses of `ns-export cameras`, without f"),
    "instant-ngp": ({"path": [{"R": [0, 0, 0, 1]}], "time": 1.0}, "is a camera path of instant-ngp"),
    "Record3D": ({"w": 64, "h": 48, "K": [1] * 9, "poses": []}, "has the cameras of Record3D"),
    "OpenSfM": ([{"cameras": {}, "shots": {}, "points": {}}], "is a reconstruction of OpenSfM"),
    "SuperSplat 1": ({"camera": {}, "background": {}, "animTracks": []}, "has settings of the SuperSplat viewer"),
    "SuperSplat 2": ({"version": 2, "cameras": [], "background": {}}, "has settings of the SuperSplat viewer"),
    "another object": ({"cameras": []}, "expected a list of {K, viewmat, W, H}, cameras.json of INRIA"),
}


def test_faults_of_camera_files_name_the_camera_and_the_field(tmp_path):
    def check(case):
        document, message = case
        (tmp_path / "c.json").write_text(json.dumps(document))
        with pytest.raises(InputError, match=message):
            load_cameras(tmp_path / "c.json")

    assert [] == failures(WRONG, check)


def test_files_of_data_sets_are_no_camera_files(tmp_path):
    (tmp_path / "images.txt").write_text("# Image list with two lines of data per image:\n")
    for path, what in ((tmp_path / "images.txt", "is a file of COLMAP"), (tmp_path, "is a folder")):
        with pytest.raises(InputError, match=rf"{what}, expected a JSON file of cameras; use --data for those of a d"):
            load_cameras(path)


SMALL_K = intrinsics(64, 48, 60.0)
SLANTED = [0.0, -0.8, 0.6]


def figure(seed=0):
    """Return a round body with thin legs (y points down) and a few floaters, and the number of splats without these."""
    rng = np.random.default_rng(seed)
    heights = 0.95 + 1.2 * rng.random(60)
    legs = np.stack([np.where(np.arange(60) % 2, 0.3, -0.3), heights, 0.02 * rng.standard_normal(60)], axis=1)
    crumbs = [[9.0, 9.0, 9.0], [-8.0, 0.0, 0.0], [-8.1, 0.1, 0.0]]
    return cloud(np.concatenate([on_a_sphere(rng, 2000), legs, crumbs])), 2060


def on_a_sphere(rng, count, radius=1.0):
    points = rng.standard_normal((count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def same(cameras, others):
    return all((a.viewmat == b.viewmat).all() for a, b in zip(cameras, others, strict=True))


def project(points, camera):
    p = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return p[:, :2] / p[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + [camera.K[0, 2], camera.K[1, 2]]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(240, 320), (400, 100)])
def test_an_orbit_shows_an_object_entirely(size):
    model, count = figure()
    assert "object" == scene_frame(model).kind
    cameras = orbit_cameras(model, 6, *size)
    places = np.concatenate([project(model.means[:count], camera) for camera in cameras])
    assert ((places > 0) & (places < size)).all()
    filled = np.max(np.abs(places - np.array(size) / 2) / (np.array(size) / 2), axis=0)
    assert filled.max() > 0.8  # floaters do not increase the distance


@pytest.mark.slow
@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], SLANTED])
def test_an_orbit_goes_around_the_recorded_up(up):
    model, _ = figure()
    cameras = orbit_cameras(SplatModel(**{**vars(model), "metadata": {"up": up}}), 8, 64, 48)
    heights = [camera.position @ np.array(up) for camera in cameras]
    assert np.ptp(heights) < 1e-5
    for camera in cameras:
        assert abs(camera.viewmat[0, :3] @ np.array(up)) < 1e-5
        assert -camera.viewmat[1, :3] @ np.array(up) > 0.9


def niche(seed=0):
    """Return fine splats in front of a coarse wall at x = -1, within a large coarse room."""
    rng = np.random.default_rng(seed)
    things = 0.3 * rng.standard_normal((5000, 3))
    wall = np.stack([np.full(900, -1.0), *(6.0 * rng.random((2, 900)) - 3.0)], axis=1)
    sizes = np.repeat([0.02, 0.3, 0.4], [5000, 900, 1500])
    return cloud(np.concatenate([things, wall, on_a_sphere(rng, 1500, 6.0)]), sizes)


@pytest.mark.slow
def test_a_path_in_surroundings_stays_in_front_of_walls_and_is_closed():
    model = niche()
    frame = scene_frame(model)
    assert "surrounding" == frame.kind
    cameras = orbit_cameras(model, 48, 64, 48)
    assert same(cameras, orbit_cameras(niche(), 48, 64, 48))
    places = np.stack([camera.position for camera in cameras])
    assert places[:, 0].min() > -0.9
    assert np.ptp(places, axis=0).max() > 0.3 * frame.extent
    steps = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)  # including from the last to the first
    assert steps.max() < 0.4 * frame.extent


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
        towards = -camera.position / np.linalg.norm(camera.position)
        assert camera.viewmat[2, :3] @ towards > 0.95
    middle = np.mean([camera.position for camera in cameras], axis=0)
    assert np.linalg.norm(middle - places.mean(axis=0)) < 0.4
    far = look_at([0, 5000.0, 0], [0, 0, 0], [0, 0, 1], SMALL_K, 64, 48)
    assert same(cameras, orbit_cameras(niche(), 24, 64, 48, along=[*known, far]))
    carrying = SplatModel(**{**vars(niche()), "cameras": [camera.to_json() for camera in known]})
    assert same(cameras, orbit_cameras(carrying, 24, 64, 48))  # the recorded cameras
    for camera in orbit_cameras(niche(), 3, 64, 48, along=known[:1]):  # one camera does not move
        assert np.allclose(known[0].viewmat, camera.viewmat)


@pytest.mark.slow
def test_a_path_sways_around_the_recorded_first_view():
    first = look_at([2.4, -0.8, 0.3], [0, 0, 0], [0, -1, 0], SMALL_K, 64, 48)
    known = {**vars(niche()), "metadata": {"view": first.to_json(), "up": [0, -1, 0]}}
    cameras = orbit_cameras(SplatModel(**known), 24, 64, 48)
    places = np.stack([camera.position for camera in cameras])
    assert np.allclose(places.mean(axis=0), first.position, atol=0.25)
    assert np.allclose(np.linalg.norm(places, axis=1), np.linalg.norm(first.position), atol=0.01)
    assert 0.4 < np.ptp(places[:, 2]) < 3.0  # sideways
    assert 0.05 < np.ptp(places[:, 1]) < 0.5 * np.ptp(places[:, 2])  # up and down
    assert all(camera.viewmat[2, :3] @ -camera.position > 0.99 * np.linalg.norm(camera.position) for camera in cameras)
    unread = SplatModel(**{**known, "metadata": {"view": {"K": 1}, "up": [0, -1, 0]}})
    assert len(orbit_cameras(unread, 24, 64, 48)) == 24  # the arc of a scene without a valid view


# Virtual cameras.
def ball(count=1500, radius=1.0, seed=0, **fields):
    return cloud(on_a_sphere(np.random.default_rng(seed), count, radius), **fields)


def test_objects_and_surroundings_are_distinguished():
    assert "object" == scene_frame(ball()).kind
    assert "surrounding" == scene_frame(niche()).kind


def test_floaters_and_transparent_splats_do_not_change_the_frame_of_a_scene():
    clean = ball()
    fog = 50.0 * np.random.default_rng(1).standard_normal((1500, 3))
    foggy = cloud(np.concatenate([clean.means, fog]), opacities=np.repeat(np.array([0.9, 0.001], np.float32), 1500))
    for model, tolerance in ((foggy, 1e-6), (cloud(np.concatenate([clean.means, [[300.0, 0.0, 0.0]]])), 0.05)):
        assert "object" == scene_frame(model).kind
        assert np.allclose(scene_frame(clean).centre, scene_frame(model).centre, atol=tolerance)
        assert np.isclose(scene_frame(clean).extent, scene_frame(model).extent, rtol=tolerance)


def tower():
    return cloud(np.random.default_rng(0).random((5000, 3)) * [0.3, 3.0, 0.3], 0.02)


@pytest.mark.parametrize(("make", "count", "seed"), [(ball, 8, 0), (tower, 3, 0), (ball, 1, 3)])
def test_an_object_covers_half_of_each_render(make, count, seed):
    model = make()
    frame, sample = scene_frame(model), sample_cloud(model, 50_000, np.random.default_rng(9))
    cameras = virtual_cameras(model, count, seed=seed)
    assert [(640, 480)] * count == [(camera.W, camera.H) for camera in cameras]
    for camera in cameras:
        assert covered_fraction(sample, camera) >= 0.5
        distance = np.linalg.norm(camera.position - frame.centre) / frame.extent
        assert np.isclose(distance, OBJECT_DISTANCES).any()
        assert camera.near == min(0.2, 0.05 * frame.extent)


def test_cameras_surround_an_object():
    frame = scene_frame(ball())
    offsets = np.array([camera.position - frame.centre for camera in virtual_cameras(ball())])
    angles = np.sort(np.degrees(np.arctan2(offsets[:, 2], offsets[:, 0])))
    assert np.diff(np.append(angles, angles[0] + 360.0)).max() < 100.0
    assert (offsets[:, 1] < 0.0).all()  # above: y points down by default


@pytest.mark.slow
def test_cameras_in_surroundings_look_at_the_subject():
    model = niche()
    frame = scene_frame(model)
    for camera in virtual_cameras(model):
        towards = frame.centre - camera.position
        distance = np.linalg.norm(towards) / frame.extent
        assert np.isclose(distance, SURROUNDING_DISTANCES).any()
        assert np.allclose(camera.viewmat[2, :3], towards / np.linalg.norm(towards))


@pytest.mark.parametrize(("letters", "up"), [("RUB", [0, 1, 0]), ("RDF", [0, -1, 0]), ("RFU", [0, 0, 1])])
def test_up_follows_from_the_coordinate_system(letters, up):
    assert (scene_frame(ball(coordinate_system=letters)).up == up).all()


def test_up_of_a_flat_scene_is_normal_to_its_plane():
    means = np.random.default_rng(0).standard_normal((2000, 3)) * [1.0, 1.0, 0.1]
    assert (scene_frame(cloud(means)).up == [0, 0, 1]).all()


def test_cameras_are_deterministic_and_depend_on_the_seed():
    model = ball()
    first = virtual_cameras(model)
    assert same(first, virtual_cameras(model))
    assert not same(first, virtual_cameras(model, seed=1))
    carrying = ball(cameras=[{"K": np.eye(3).tolist()}])  # training cameras, which are ignored
    assert same(first, virtual_cameras(carrying))


def test_cameras_scale_with_the_scene():
    small, large = ball(), ball(radius=128.0, sizes=0.03 * 128.0)
    for a, b in zip(virtual_cameras(small), virtual_cameras(large), strict=True):
        assert np.allclose(a.viewmat[:3, :3], b.viewmat[:3, :3], atol=1e-5)
        assert np.allclose(128.0 * a.viewmat[:3, 3], b.viewmat[:3, 3], rtol=1e-4, atol=1e-2)


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


def test_weighted_quantiles_agree_with_values_by_hand():
    values = np.array([5.0, 1.0, 3.0, 2.0, 4.0])
    assert np.allclose([1.0, 3.0, 5.0], weighted_quantiles(values, np.ones(5), (0.2, 0.6, 1.0)))
    weights = np.array([1.0, 3.0, 0.0, 0.0, 0.0])  # weights of the values 5 and 1
    assert np.allclose([1.0, 3.0, 5.0], weighted_quantiles(values, weights, (0.75, 0.875, 1.0)))


@pytest.mark.parametrize("name", ["donut", "horse", "plane3", "fox60k_noreg"])
def test_distances_agree_with_the_cameras_of_the_shared_scenes(data_dir, name):
    model = read_ply(data_dir / "ply" / f"{name}.ply")
    frame = scene_frame(model)

    def distance(cameras):
        return np.median([np.linalg.norm(camera.position - frame.centre) for camera in cameras]) / frame.extent

    wanted = distance(load_cameras(data_dir / "psnr_cameras" / f"{name}.json"))
    assert 0.8 < distance(virtual_cameras(model)) / wanted < 1.25
