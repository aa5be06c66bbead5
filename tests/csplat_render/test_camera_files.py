# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.camera_files."""

import json
import math

import numpy as np
import pytest
from cameras_cases import UP, K
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import intrinsics, look_at, relative_to
from csplat_render.camera_files import load_cameras, save_cameras


def written(tmp_path, content):
    """Write bytes, or an object as JSON, and return the path."""
    path = tmp_path / "c.json"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return path


def test_saved_cameras_are_loaded_exactly_and_near_and_image_may_be_left_out(tmp_path):
    cameras = [
        look_at([1.0, 2.0, 3.0], [0.1, 0.0, 0.0], UP, K, 640, 480, 0.01, "a/b.png"),
        look_at([-3.0, 0.3, 1.0], [0.0, 0.0, 0.2], UP, K, 320, 200),
    ]
    save_cameras(tmp_path / "c.json", cameras)
    assert [camera.as_json() for camera in cameras] == [c.as_json() for c in load_cameras(tmp_path / "c.json")]
    least = {"K": K.tolist(), "viewmat": np.eye(4).tolist(), "W": 640, "H": 480}
    for further in ({}, {"background": [1.0, 1.0, 1.0]}):  # unknown keys are ignored
        (bare,) = load_cameras(written(tmp_path, [least | further]))
        assert (0.2, None) == (bare.near, bare.image)
    (alone,) = load_cameras(written(tmp_path, least))  # as the element's `camera` gives it
    assert bare.as_json() == alone.as_json()


def test_cameras_relative_to_the_origin_or_to_0_are_distinguished(tmp_path):
    K, place, path = intrinsics(64, 48, 50.0), np.array((500123.0, 4649876.0, 214.0)), tmp_path / "cameras.json"
    own = [look_at((x, 3, 0), (0, 0, 5), (0, -1, 0), K, 64, 48) for x in (-2, 0, 2)]
    absolute = [relative_to(-place, camera) for camera in own]
    near = np.array((0.0, 3.0, 1.0))
    for cameras, origin, note_count in ((own, place, 0), (absolute, place, 1), (own, 0 * place, 0), (own, near, 0)):
        save_cameras(path, cameras)
        notes = []
        found = load_cameras(path, notes, origin)
        assert all(np.allclose(a.viewmat, b.viewmat) for a, b in zip(own, found, strict=True))
        assert note_count == len(notes)


def inria(**fields):
    """Return an INRIA camera at 1 2 3 that looks along x, z up, 64 by 48 pixels, focal length 50, with changes."""
    pose = {"position": [1, 2, 3], "rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "fx": 50.0, "fy": 50.0}
    return {"id": 0, "img_name": "a.png", "width": 64, "height": 48, **pose, **fields}


OPENGL = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
TRANSPOSED = np.transpose(OPENGL).tolist()
SCALED = (np.array(OPENGL) * [[2, 2, 2, 1]]).tolist()
ENTRY = {"camera_to_world": np.ravel(OPENGL).tolist(), "fov": math.degrees(2 * math.atan(24 / 50)), "aspect": 4 / 3}
NERFSTUDIO = {"camera_type": "perspective", "render_width": 64, "render_height": 48, "camera_path": [ENTRY], "fps": 24}
FRAME = {"file_path": "images/a.png", "transform_matrix": OPENGL}
OWN = FRAME | {"w": 64, "h": 48, "camera_angle_x": 2 * math.atan(32 / 50), "cx": 30, "cy": 20}
TRANSFORMS = {"w": 64, "h": 48, "fl_x": 50.0, "frames": [FRAME]}


def nerfstudio(**fields):
    """Return a path of nerfstudio with this camera, with changes of its entry."""
    return NERFSTUDIO | {"camera_path": [ENTRY | fields]}


#: Files of other programs with this camera, its principal point, and a part of the report.
FOREIGN = {
    "INRIA": ([inria()], (32, 24), "INRIA"),
    "nerfstudio": (NERFSTUDIO, (32, 24), "nerfstudio"),
    "nerfstudio, by rows": (nerfstudio(camera_to_world=OPENGL), (32, 24), "path"),
    "transforms": (TRANSFORMS, (32, 24), "transforms.json"),
    "own fields of a frame": ({"frames": [OWN]}, (30, 20), "1 camera"),
    "a scaled world": (TRANSFORMS | {"frames": [{"transform_matrix": SCALED}]}, (32, 24), "1 pose scaled"),
    "distortion": (TRANSFORMS | {"k1": 0.1}, (32, 24), "lens distortion is ignored"),
}


def test_camera_files_of_other_programs_are_read(tmp_path):
    wanted = look_at([1, 2, 3], [2, 2, 3], UP, K, 64, 48).viewmat

    def check(case):
        document, middle, word = case
        report = []
        (camera,) = load_cameras(written(tmp_path, document), report)
        assert np.allclose(wanted, camera.viewmat)
        assert np.allclose([50.0, 50.0, *middle], [camera.K[0, 0], camera.K[1, 1], *camera.K[:2, 2]])
        assert (64, 48) == (camera.W, camera.H)
        assert any(word in line for line in report)

    assert [] == failures(FOREIGN, check)


FAR_TOO_LARGE = r"c\.json is not a JSON file: an integer has \d[\d,]* digits"
LAST_ROW = "has the last row 1 2 3 1, expected 0 0 0 1: .* transposed"

#: Invalid files, and a part of the error.
WRONG = {
    "no JSON": (b"{", "not a JSON file"),
    "no UTF-8": (b"\xff\xfe", "not a JSON file"),
    "an empty list": (b"[]", "not a camera file"),
    "an empty object": (b"{}", "not a camera file"),
    "a number": (b"[1]", "camera 0"),
    "ours, no viewmat": (b'[{"K": 1}]', "camera 0.*viewmat"),
    "a huge size": (b'[{"W": %d}]' % 10**400, FAR_TOO_LARGE),
    "a huge focal length": (b'{"fl_x": ' + b"9" * 5000 + b', "frames": []}', FAR_TOO_LARGE),
    "ours, transposed": ([{"K": K.tolist(), "viewmat": TRANSPOSED, "W": 640, "H": 480}], f"0: .*viewmat {LAST_ROW}"),
    "INRIA, no focal length": ([inria(), inria(fx=None)], "camera 1: fx is None, expected a number"),
    "INRIA, no position": ([inria(position=None)], "camera 0: rotation or position has another shape"),
    "INRIA, another entry": ([inria(), {"K": 1}], "camera 1: width is None"),
    "INRIA, no rotation": ([inria(rotation=[[1, 1, 1]] * 3)], "camera 0: the camera's viewmat does not begin"),
    "INRIA, no object": ([inria(), 3], "camera 1 is int, expected an object"),
    "nerfstudio, panorama": (NERFSTUDIO | {"camera_type": "equirectangular"}, "camera_type is equirectangular"),
    "nerfstudio, no size": (NERFSTUDIO | {"render_width": None}, "camera_path 0: render_width is None"),
    "nerfstudio, angle": (nerfstudio(fov=200), "fov is 200, expected degrees"),
    "nerfstudio, empty": (NERFSTUDIO | {"camera_path": []}, "lists no cameras"),
    "nerfstudio, transposed": (nerfstudio(camera_to_world=np.ravel(TRANSPOSED).tolist()), f"_to_world {LAST_ROW}"),
    "nerfstudio, keyframes": (NERFSTUDIO | {"camera_path": [], "keyframes": [{}]}, "keyframes .*: generate the path"),
    "nerfstudio, transform": ({"transform": [], "scale": 0.2}, "is dataparser_transforms.json of nerfstudio"),
    "nerfstudio, exported": ([{"file_path": "a", "transform": []}], "has the poses of `ns-export cameras`, without f"),
    "transforms, no size": ({"camera_angle_x": 0.8, "frames": [FRAME]}, "frame 0: w and h are missing, .*--data"),
    "transforms, fisheye": (TRANSFORMS | {"is_fisheye": True}, "frame 0: camera_model is a fisheye"),
    "transforms, no matrix": (TRANSFORMS | {"frames": [{}]}, "frame 0: transform_matrix has shape"),
    "no pixels": ([inria(fx=0.8, fy=1.0)], "camera 0: the focal length across is 0.8 for 64 pixels, expected 3.2"),
    "swapped": (TRANSFORMS | {"cx": 24, "cy": 32}, "camera 0: the principal point is 24 32 in 64×48 pixels, expected"),
    "instant-ngp": ({"path": [{"R": [0, 0, 0, 1]}], "time": 1.0}, "is a camera path of instant-ngp"),
    "Record3D": ({"w": 64, "h": 48, "K": [1] * 9, "poses": []}, "has the cameras of Record3D"),
    "OpenSfM": ([{"cameras": {}, "shots": {}, "points": {}}], "is a reconstruction of OpenSfM"),
    "SuperSplat 1": ({"camera": {}, "background": {}, "animTracks": []}, "has settings of the SuperSplat viewer"),
    "SuperSplat 2": ({"version": 2, "cameras": [], "background": {}}, "has settings of the SuperSplat viewer"),
    "another object": ({"cameras": []}, "expected a list of {K, viewmat, W, H}, cameras.json of INRIA"),
}  # fmt: skip


def test_faults_of_camera_files_name_the_camera_and_the_field(tmp_path):
    def check(case):
        document, message = case
        with pytest.raises(InputError, match=message):
            load_cameras(written(tmp_path, document))

    assert [] == failures(WRONG, check)


def test_absent_files_and_data_sets_are_no_camera_files(tmp_path):
    (tmp_path / "images.txt").write_text("# Image list with two lines of data per image:\n")
    advice = "expected a JSON file of cameras; use --data for those of a d"
    for path, message in (
        (tmp_path / "images.txt", f"is a file of COLMAP, {advice}"),
        (tmp_path, f"is a folder, {advice}"),
        (tmp_path / "nowhere.json", r"nowhere\.json"),
    ):
        with pytest.raises(InputError, match=message):
            load_cameras(path)
