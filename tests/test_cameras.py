"""Camera files and paths of cameras."""

import json
import math

import numpy as np
import pytest
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
    relative_to,
)
from csplat_render.camera_files import load_cameras, save_cameras

K = intrinsics(640, 480, 60.0)
UP = np.array([0.0, 0.0, 1.0])


def pixel(camera, point):
    x, y, z = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    return camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]


def test_a_file_gives_back_what_was_saved_bit_for_bit(tmp_path):
    cameras = [
        look_at([1.0, 2.0, 3.0], [0.1, 0.0, 0.0], UP, K, 640, 480, 0.01, "a/b.png"),
        look_at([-3.0, 0.3, 1.0], [0.0, 0.0, 0.2], UP, K, 320, 200),
    ]
    save_cameras(tmp_path / "c.json", cameras)
    back = load_cameras(tmp_path / "c.json")
    for camera, same in zip(cameras, back, strict=True):
        assert (camera.K == same.K).all()
        assert (camera.viewmat == same.viewmat).all()
        assert (camera.W, camera.H, camera.near, camera.image) == (same.W, same.H, same.near, same.image)


def test_near_and_image_may_be_left_out(tmp_path):
    entry = {"K": K.tolist(), "viewmat": np.eye(4).tolist(), "W": 640, "H": 480}
    (tmp_path / "c.json").write_text(json.dumps([entry]))
    (camera,) = load_cameras(tmp_path / "c.json")
    assert 0.2 == camera.near
    assert camera.image is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "not a JSON file"),
        ("[]", "not a camera file"),
        ("{}", "not a camera file"),
        ("[1]", "camera 0"),
        ('[{"K": 1}]', "camera 0.*viewmat"),
        (b"\xff\xfe", "not a JSON file"),
    ],
)
def test_refuses_what_is_no_camera_file(tmp_path, text, says):
    path = tmp_path / "c.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=says):
        load_cameras(path)


def test_an_absent_file_is_named():
    with pytest.raises(InputError, match=r"nowhere\.json"):
        load_cameras("nowhere.json")


def test_what_is_looked_at_lies_in_the_middle_and_up_is_up():
    camera = look_at([3.0, 1.0, 0.5], [0.2, -0.1, 0.4], UP, K, 640, 480)
    assert np.allclose(pixel(camera, np.array([0.2, -0.1, 0.4])), (320.0, 240.0))
    above = pixel(camera, np.array([0.2, -0.1, 0.6]))
    assert np.isclose(above[0], 320.0)
    assert above[1] < 240.0
    assert np.allclose(camera.position, [3.0, 1.0, 0.5])


def test_looking_along_up_is_no_special_case():
    camera = look_at([0.0, 0.0, 5.0], [0.0, 0.0, 0.0], UP, K, 640, 480)
    assert np.allclose(pixel(camera, np.zeros(3)), (320.0, 240.0))


def test_refuses_to_look_at_where_it_stands():
    with pytest.raises(InputError, match="where it stands"):
        look_at([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], UP, K, 640, 480)


def test_the_field_of_view_spans_the_width():
    assert np.isclose(320.0 / K[0, 0], np.tan(np.radians(30.0)))
    with pytest.raises(InputError, match="field of view"):
        intrinsics(640, 480, 180.0)


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [1, 0, 0], [0.6, 0.0, 0.8]])
def test_directions_are_unit_and_keep_their_elevation(up):
    for azimuth in (0.0, 77.0, 200.0):
        d = direction_at(up, azimuth, 25.0)
        assert np.isclose(np.linalg.norm(d), 1.0)
        assert np.isclose(np.degrees(np.arcsin(d @ np.array(up, float))), 25.0)


def test_an_orbit_turns_evenly_at_one_distance():
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


def test_the_central_camera_stands_and_looks_as_most_do():
    K = intrinsics(64, 48, 50.0)
    row = [look_at((x, 0, 0), (x, 0, 5), (0, -1, 0), K, 64, 48) for x in (-2, -1, 0, 1, 2)]
    aside = look_at((0, 0, 0), (5, 0, 0), (0, -1, 0), K, 64, 48)
    assert row[2] is central_camera([aside, *row])
    assert row[0] is central_camera(row[:1])
    far = look_at((0, 1e6, 0), (0, 1e6, 5), (0, -1, 0), K, 64, 48)
    assert row[2] is central_camera([*row, far])


def viewmats(positions, target=(0.0, 0.0, 4.0)):
    """Cameras at some places, which all look at a point."""
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


def test_cameras_that_belong_to_a_set_are_no_outliers():
    rng = np.random.default_rng(0)
    ones = rng.normal(size=(90, 3))
    ahead = np.geomspace(5.0, 2000.0, 20)[:, None] * np.array([1.0, 0.0, 0.0])
    for name, positions, points in (
        ("one", ones[:1], None),
        ("all in one place", np.zeros((9, 3)), None),
        ("three, one of them far away", [(0, 0, 0), (1, 0, 0), (1e5, 0, 0)], None),
        ("a corridor", np.linspace((0, 0, 0), (1000, 0, 0), 200), None),
        ("a flight towards a building", np.concatenate([ones, ahead]), None),
        ("two places", np.concatenate([ones[:60], ones[60:] + np.array((1e4, 0, 0))]), None),
        ("close-ups and overviews", np.concatenate([0.01 * ones[:80], ones[80:]]), None),
        ("a tripod that was moved once", np.concatenate([1e-3 * ones[:15], [(0.5, 0, 0)]]), ones + np.array((0, 0, 3))),
    ):
        assert not camera_outliers(viewmats(positions), points).any(), name


def test_a_second_tripod_is_no_outlier_where_nothing_tells_the_size_of_the_scene():
    K, rng = intrinsics(64, 48, 50.0), np.random.default_rng(1)
    places = 1e-3 * rng.normal(size=(16, 3)) + np.where(np.arange(16) < 13, 0.0, 4.0)[:, None]
    turned = [(np.cos(a), np.sin(a), 0.1) for a in np.linspace(0.0, 6.0, 16)]
    cameras = [look_at(place, place + way, (0, 0, 1), K, 64, 48) for place, way in zip(places, turned, strict=True)]
    assert not camera_outliers(np.stack([camera.viewmat for camera in cameras])).any()


def test_cameras_around_an_origin_far_from_0_are_told_from_those_around_0(tmp_path):
    K, place, path = intrinsics(64, 48, 50.0), np.array((500123.0, 4649876.0, 214.0)), tmp_path / "cameras.json"
    own = [look_at((x, 3, 0), (0, 0, 5), (0, -1, 0), K, 64, 48) for x in (-2, 0, 2)]
    for cameras, origin, said in (
        (own, place, 0),
        ([relative_to(-place, one) for one in own], place, 1),
        (own, np.zeros(3), 0),
        (own, np.array((0.0, 3.0, 1.0)), 0),
    ):
        save_cameras(path, cameras)
        notes = []
        found = load_cameras(path, notes, origin)
        assert all(np.allclose(a.viewmat, b.viewmat) for a, b in zip(own, found, strict=True))
        assert said == len(notes)


def standing(**fields):
    """Return a camera of INRIA at 1 2 3 that looks along x, z up: 64 by 48 pixels, focal length 50; or else."""
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

#: Files of other programs that hold this camera, its principal point, and a word of the report.
FOREIGN = {
    "INRIA": ([standing()], (32, 24), "INRIA"),
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
    "distortion": ({**TRANSFORMS, "k1": 0.1}, (32, 24), "the distortion of its lens is left out"),
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


#: Invalid files, and the text of the error.
WRONG = {
    "INRIA, no focal length": ([standing(), standing(fx=None)], "camera 1: fx is None, expected a number"),
    "INRIA, no position": ([standing(position=None)], "camera 0: rotation and position have other shapes"),
    "INRIA, another entry": ([standing(), {"K": 1}], "camera 1: width is None"),
    "INRIA, no rotation": ([standing(rotation=[[1, 1, 1]] * 3)], "camera 0: the camera's viewmat does not begin"),
    "INRIA, no object": ([standing(), 3], "camera 1 is int, expected an object"),
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
    "no pixels": ([standing(fx=0.8, fy=1.0)], "camera 0: the focal length across is 0.8 for 64 pixels, expected 3.2"),
    "swapped": ({**TRANSFORMS, "cx": 24, "cy": 32}, "camera 0: the principal point is 24 32 in 64×48 pixels, expected"),
    "another object": ({"cameras": []}, "expected a list of {K, viewmat, W, H}, cameras.json of INRIA"),
}


def test_faults_of_camera_files_name_the_camera_and_the_field(tmp_path):
    def check(case):
        document, says = case
        (tmp_path / "c.json").write_text(json.dumps(document))
        with pytest.raises(InputError, match=says):
            load_cameras(tmp_path / "c.json")

    assert [] == failures(WRONG, check)
