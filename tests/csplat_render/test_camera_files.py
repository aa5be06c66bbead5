"""Tests of csplat_render.camera_files."""

import json
import math

import numpy as np
import pytest
from cameras_cases import UP, K
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import (
    intrinsics,
    look_at,
    relative_to,
)
from csplat_render.camera_files import load_cameras, save_cameras


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
