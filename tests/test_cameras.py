"""Camera files and paths of cameras."""

import json

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render.camera import Camera
from csplat_render.cameras import central_camera, direction, intrinsics, load_cameras, look_at, orbit, save_cameras

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
        d = direction(up, azimuth, 25.0)
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
