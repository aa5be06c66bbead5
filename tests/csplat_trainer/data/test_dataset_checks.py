"""Lenses of data sets, images that are straightened, and sets whose sizes, lenses or poses contradict the images."""

import json
import math
import re
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from posed_sets import (
    H,
    W,
    cameras,
    change_frames,
    change_transforms,
    frames_of,
    to_opengl,
    write_colmap,
    write_colmap_set,
    write_picture,
    write_transforms,
)
from tables import failures

from csplat.errors import InputError
from csplat_trainer.data import load
from csplat_trainer.data.colmap import read_cameras
from csplat_trainer.data.lens import Lens, distorted, undistorted_lens
from csplat_trainer.initial_splats import measure_extent, place_splats

pytest.importorskip("numba", reason="requires the extra [render]")


LENS_W, LENS_H = 120, 90
FOCAL = [100.0, 98.0, 62.0, 44.0]
ONE_FOCAL = [100.0, 61.0, 44.0]


#: Parameters of COLMAP's models with the distortions of ordinary lenses; None for models that are refused.
MODELS = {
    "SIMPLE_PINHOLE": ONE_FOCAL, "PINHOLE": FOCAL, "SIMPLE_RADIAL": [*ONE_FOCAL, 0.05],
    "RADIAL": [*ONE_FOCAL, -0.08, 0.02], "OPENCV": [*FOCAL, 0.05, -0.02, 0.001, -0.002],
    "OPENCV_FISHEYE": [*FOCAL, 0.05, -0.02, 0.01, -0.003],
    "FULL_OPENCV": [*FOCAL, 0.1, -0.05, 0.002, -0.003, 0.04, 0.2, -0.1, 0.03], "FOV": [*FOCAL, 0.6],
    "SIMPLE_RADIAL_FISHEYE": [*ONE_FOCAL, -0.04], "RADIAL_FISHEYE": [*ONE_FOCAL, 0.04, -0.01],
    "THIN_PRISM_FISHEYE": [*FOCAL, 0.03, -0.01, 0.001, -0.002, 0.01, -0.004, 0.003, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": None, "SIMPLE_DIVISION": None, "DIVISION": None, "SIMPLE_FISHEYE": ONE_FOCAL,
    "FISHEYE": FOCAL, "EUCM": None, "EQUIRECTANGULAR": None,
}  # fmt: skip


def colmap_pixel(model, parameters, x, y):
    """Project the direction (x, y, 1) by COLMAP's documentation of the model."""
    if len(parameters) > 3 and model not in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        fx, fy, cx, cy, *extra = parameters
    else:
        fx, cx, cy, *extra = parameters
        fy = fx
    if model == "FOV":
        r = math.hypot(x, y)
        factor = math.atan(2 * r * math.tan(extra[0] / 2)) / (r * extra[0])
        return fx * x * factor + cx, fy * y * factor + cy
    if "FISHEYE" in model:
        r = math.hypot(x, y)
        x, y = x * math.atan(r) / r, y * math.atan(r) / r
    r2 = x**2 + y**2
    radial, dx, dy = 1.0, 0.0, 0.0
    if model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        radial += sum(k * r2 ** (i + 1) for i, k in enumerate(extra))
    elif extra:
        k1, k2, p1, p2, *more = extra
        k3, k4, k5, k6 = [*more, 0.0, 0.0, 0.0, 0.0][:4]
        radial += k1 * r2 + k2 * r2**2 + k3 * r2**3
        if model == "THIN_PRISM_FISHEYE":
            radial, (dx, dy) = radial + k4 * r2**4, (more[2] * r2, more[3] * r2)
        else:
            radial /= 1.0 + k4 * r2 + k5 * r2**2 + k6 * r2**3
        dx += 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        dy += 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    return fx * (x * radial + dx) + cx, fy * (y * radial + dy) + cy


def read_lens(folder, model, parameters):
    path = folder / "cameras.txt"
    path.write_text(f"1 {model} {LENS_W} {LENS_H} {' '.join(str(value) for value in parameters)}\n")
    return read_cameras(path)[1]


def test_lens_models_agree_with_the_documentation_of_colmap(tmp_path):
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.6, 0.6, (40, 2))

    def check(case):
        model, parameters = case
        if parameters is None:
            remedy = "split panoramas" if model == "EQUIRECTANGULAR" else "use `colmap image_undistorter"
            with pytest.raises(InputError, match=f"the lens is {model}, expected one of .*: {remedy}"):
                read_lens(tmp_path, model, [1.0] * 4)
            return
        lens = read_lens(tmp_path, model, parameters)
        assert lens.distorts == (model not in ("SIMPLE_PINHOLE", "PINHOLE"))
        straight = Lens(LENS_W, LENS_H, 1.0, 1.0, 0.0, 0.0)
        found = np.stack(distorted(points[:, 0], points[:, 1], lens, straight), axis=1)
        assert np.allclose([colmap_pixel(model, parameters, x, y) for x, y in points], found, rtol=0, atol=1e-9)

    assert [] == failures({model: (model, parameters) for model, parameters in MODELS.items()}, check)


def test_lens_models_of_binary_files_have_the_numbers_of_colmap(tmp_path):
    file = tmp_path / "cameras.bin"

    def check(case):
        number, (model, parameters) = case
        values = parameters or [1.0] * 4
        file.write_bytes(struct.pack(f"<QiiQQ{len(values)}d", 1, 1, number, LENS_W, LENS_H, *values))
        if parameters is None:
            with pytest.raises(InputError, match=f"camera 1: the lens is {model},"):
                read_cameras(file)
        else:
            assert read_lens(tmp_path, model, parameters) == read_cameras(file)[1]

    cases = dict(zip(MODELS, enumerate(MODELS.items()), strict=True))
    assert [] == failures(cases | {"99": (99, ("of number 99", None))}, check)


@pytest.mark.parametrize("text", [False, True])
def test_a_lens_without_distortion_is_a_pinhole(tmp_path, text):
    shots = cameras(3)
    for i, camera in enumerate(shots):
        write_picture(tmp_path / "images" / f"im {i:03}.png", camera)
    write_colmap(tmp_path / "sparse", shots, "FULL_OPENCV", [50.0, 51.0, 24.0, 16.0] + [0.0] * 8, text)
    data = load(tmp_path)
    assert [50.0, 51.0, 1.0] == np.diag(data.train[0].camera.K).tolist()
    assert not any("is undone" in line for line in data.report)


def scene(x, y):
    """Return a smooth function of directions: red, green, blue, 0..255."""
    return 127.5 + 100.0 * np.stack([np.sin(9 * x + 2 * y), np.cos(8 * y - 3 * x), np.sin(7 * x * y + 5 * x)], axis=-1)


def photograph(lens, path):
    """Write an image of the scene through a lens, whose inverse is found by iteration."""
    v, u = np.mgrid[0:LENS_H, 0:LENS_W] + 0.5
    plain = Lens(LENS_W, LENS_H, lens.fx, lens.fy, lens.cx, lens.cy)
    at_u, at_v = u.copy(), v.copy()
    for _ in range(60):
        found_u, found_v = distorted(at_u, at_v, lens, plain)
        at_u, at_v = at_u + (u - found_u), at_v + (v - found_v)
    colours = scene((at_u - lens.cx) / lens.fx, (at_v - lens.cy) / lens.fy)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.clip(np.rint(colours), 0, 255).astype(np.uint8)).save(path)


def assert_is_straight(picture):
    """Compare an undistorted image with the scene through its pinhole; interpolation errs by a few levels."""
    K = picture.camera.K
    v, u = np.mgrid[0:LENS_H, 0:LENS_W] + 0.5
    error = np.abs(picture.pixels - scene((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]))
    assert error.mean() < 0.7
    assert error.max() < 4.0


@pytest.mark.slow
def test_images_of_every_kind_of_lens_are_undistorted(tmp_path):
    def check(model):
        folder, parameters = tmp_path / model, MODELS[model]
        lens = read_lens(tmp_path, model, parameters)
        photograph(lens, folder / "images" / "im 000.png")
        write_colmap(folder / "sparse", cameras(1), model, parameters, text=True, width=LENS_W, height=LENS_H)
        data = load(folder, test_every=0)
        assert_is_straight(data.train[0])
        notes = [line for line in data.report if "distortion is undone" in line or "fisheye images are cropped" in line]
        assert (0 if not lens.distorts else 2 if "FISHEYE" in model else 1) == len(notes)

    models = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FOV", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")
    assert [] == failures({model: model for model in models}, check)


def write_lens_transforms(folder, **values):
    fx, fy, cx, cy = FOCAL
    frames = [{"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}]
    document = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": LENS_W, "h": LENS_H, **values, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))


def test_lenses_of_transforms_json_are_undistorted(tmp_path):
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    rational = dict(zip(names, MODELS["FULL_OPENCV"][4:], strict=True))
    brown = {key: rational[key] for key in names[:5]}
    fisheye = dict(zip(("k1", "k2", "k3", "k4"), MODELS["OPENCV_FISHEYE"][4:], strict=True))

    def check(case):
        model, parameters, values = case
        photograph(read_lens(tmp_path, model, parameters), tmp_path / "images" / "a.png")
        write_lens_transforms(tmp_path, **values)
        assert_is_straight(load(tmp_path).train[0])

    cases = {
        "rational": ("FULL_OPENCV", MODELS["FULL_OPENCV"], {"camera_model": "FULL_OPENCV", **rational}),
        "k3": ("FULL_OPENCV", [*MODELS["FULL_OPENCV"][:9], 0.0, 0.0, 0.0], {"camera_model": "OPENCV", **brown}),
        "fisheye": ("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"], {"camera_model": "OPENCV_FISHEYE", **fisheye}),
        "is_fisheye": ("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"], {"is_fisheye": True, **fisheye}),
    }
    assert [] == failures(cases, check)


def test_factors_of_other_lens_models_are_refused(tmp_path):
    (tmp_path / "images").mkdir()
    Image.new("RGB", (LENS_W, LENS_H)).save(tmp_path / "images" / "a.png")
    for values, message in (
        ({"camera_model": "OPENCV", "k4": 0.1}, "k4 is 0.1 with camera_model OPENCV, expected 0"),
        ({"k5": 0.1}, "k5 is 0.1 with camera_model not named"), ({"is_fisheye": True, "p1": 0.1}, "p1 is 0.1"),
        ({"k3": "much"}, "k3 is 'much', expected a number"),
        ({"k1": -1.4}, r"radial \(-1.4, 0.0, 0.0\)\) cannot be undone"),
        ({"camera_model": "FISHEYE624"}, "camera_model is FISHEYE624, expected one of .*undistorter"),
    ):  # fmt: skip
        write_lens_transforms(tmp_path, **values)
        with pytest.raises(InputError, match=message):
            load(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("radial", "tangential"),
    [
        ((0.06, -0.08), (-0.001, 0.0002)), ((-0.3, 0.1), (0.0, 0.0)), ((0.2,), (0.01, 0.01)),
        ((0.0, 0.0, 0.1), (0.0, 0.0)),
    ],
)  # fmt: skip
def test_undistortion_stays_within_the_image(radial, tangential):
    lens = Lens(540, 960, 688.0, 687.0, 277.0, 482.0, radial, tangential)
    v, u = np.mgrid[0:960, 0:540] + 0.5
    x, y = distorted(u, v, lens, undistorted_lens(lens))
    assert 0.0 <= x.min() < x.max() <= 540.0
    assert 0.0 <= y.min() < y.max() <= 960.0


POSE = np.array(to_opengl(cameras(10)[0]))
SHEARED = POSE @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
PIXELS = 51.47  # pixels; the approximate focal length of the set


#: Fields of transforms.json, and the text of the error.
FIELDS = {
    "an angle in degrees": ({"fl_x": None, "fl_y": None, "camera_angle_x": 50.0}, r"is 50 \(degrees\?\), expected rad"),
    "lengths and angles that differ": (
        {"camera_angle_x": 0.5}, r"frame 0: fl_x is 51\.\d+, expected 93\.99\d* from camera_angle_x = 0\.5 and 48 pix",
    ),
    "down, too": ({"camera_angle_y": 0.5}, "fl_y is 51.* from camera_angle_y = 0.5 and 32 pixels"),
    "no unit of pixels": ({"fl_x": 1.07, "fl_y": 1.07}, "frame 1: the focal length across is 1.07 for 48 pixels, ex"),
    "micrometres": ({"fl_x": 35000, "fl_y": 35000}, "the focal length across is 35000 for 48 pixels"),
    "different axes": ({"fl_y": 4 * PIXELS}, "expected about the same: one of them is wrong"),
    "far outside": ({"cx": 960.0}, r"the principal point is 960 16 in 48×32 pixels, expected about the middle"),
    "swapped": ({"cx": H / 2, "cy": W / 2}, "16 24 in 48×32 pixels, expected about 24 16: width and height, or its"),
    "width and height swapped": ({"w": H, "h": W}, "24 16 in 32×48 pixels, expected about 16 24"),
}  # fmt: skip


#: transform_matrix of a frame, and the text of the error.
MATRICES = {
    "by columns": (POSE.T, "frame 0: transform_matrix has the last row .* expected 0 0 0 1: .* it is transposed"),
    "another last row": (np.vstack([POSE[:3], [0, 0, 0, 2]]), "has the last row 0 0 0 2, expected 0 0 0 1$"),
    "mirrored": (POSE @ np.diag([1, 1, -1, 1.0]), "determinant -1, expected a rotation: it is mirrored"),
    "sheared": (SHEARED, "begins with axes of lengths 1, 1.02, 1"),
    "4 by 3": (POSE[:, :3], r"has shape \[4, 3\]"),
}


def refusals(folder, cases):
    """Return the cases whose changed fields of transforms.json are not refused with their message."""
    write_transforms(folder)
    document = (folder / "transforms.json").read_text()

    def check(case):
        fields, message = case
        (folder / "transforms.json").write_text(document)
        change_transforms(folder, **fields)
        with pytest.raises(InputError, match=message):
            load(folder)

    return failures(cases, check)


def test_contradictory_fields_are_refused(tmp_path):
    assert [] == refusals(tmp_path, FIELDS)


def test_invalid_matrices_are_refused(tmp_path):
    def first(matrix):
        return {"frames": [{"file_path": "images/0000.png", "transform_matrix": matrix.tolist()}]}

    assert [] == refusals(tmp_path, {name: (first(matrix), message) for name, (matrix, message) in MATRICES.items()})


def test_the_focal_length_of_a_frame_overrides_the_angle_of_all(tmp_path):
    write_transforms(tmp_path)
    change_frames(tmp_path, range(10), fl_x=77.0, fl_y=77.0)
    change_transforms(tmp_path, camera_angle_x=0.5)
    assert {77.0} == {picture.camera.K[0, 0] for picture in load(tmp_path).train}


def test_an_image_of_another_shape_than_its_camera_is_reported_or_refused(tmp_path):
    write_colmap_set(tmp_path)
    Image.new("RGB", (W, 24)).save(tmp_path / "images" / "im 003.png")
    line = "image with another aspect ratio than their cameras (im 003.png: 48×24, 48×32)"
    assert any(line in note for note in load(tmp_path).report)
    Image.new("RGB", (H, W)).save(tmp_path / "images" / "im 003.png")
    message = (
        r"im 003\.png has 32×48 pixels, expected the aspect ratio of 48×32, given by .*cameras\.bin, camera 7: the"
    )
    with pytest.raises(InputError, match=f"{message} sides are swapped"):
        load(tmp_path)


def test_a_mask_of_another_shape_than_its_image_is_refused(tmp_path):
    write_transforms(tmp_path)
    change_frames(tmp_path, range(10), mask_path="mask.png")
    Image.new("L", (W // 2, H // 2), 255).save(tmp_path / "mask.png")
    assert load(tmp_path).train[0].mask.all()
    Image.new("L", (W, W), 255).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match=r"mask\.png has 48×48 pixels, expected the aspect ratio of 48×32, that of"):
        load(tmp_path)


def test_the_scale_of_poses_is_removed_and_reported(tmp_path):
    write_transforms(tmp_path)
    frames = frames_of(tmp_path)
    assert not any("scaled" in line for line in load(tmp_path).report)
    scaled = (np.array(frames[1]["transform_matrix"]) @ np.diag([2.0, 2.0, 2.0, 1.0])).tolist()
    change_frames(tmp_path, [1], transform_matrix=scaled)
    data = load(tmp_path)
    assert "transforms.json: 1 pose scaled (the first by 2): removed, positions stay" in data.report
    assert np.allclose(cameras(10)[1].viewmat, data.train[0].camera.viewmat)


def test_smaller_images_may_be_rounded_either_way(tmp_path):
    write_transforms(tmp_path)
    change_transforms(tmp_path, frames=frames_of(tmp_path)[:1])
    for size, (w, h), note in (
        ((649, 420), (1297, 840), None), ((648, 420), (1297, 840), None), ((618, 411), (4946, 3286), None),
        ((619, 410), (4946, 3286), None), ((324, 210), (1297, 840), None), ((1297, 840), (648, 420), None),
        ((480, 324), (480, 320), "1 image with another aspect ratio than their cameras (0000.png: 480×324, 480×320)"),
    ):  # fmt: skip
        Image.new("RGB", size).save(tmp_path / "images" / "0000.png")
        change_transforms(tmp_path, w=w, h=h, cx=w / 2, cy=h / 2, fl_x=w, fl_y=w)
        notes = [line for line in load(tmp_path, test_every=0).report if "aspect ratio" in line]
        assert [] == notes if note is None else notes[0].startswith(note), size


def test_a_rotation_of_another_length_is_normalised_and_reported(tmp_path):
    write_colmap_set(tmp_path, text=True)
    file = tmp_path / "sparse" / "0" / "images.txt"
    pose = next(line for line in file.read_text().splitlines() if "im 002" in line)
    number, *quaternion, x, y, z, camera, im, name = pose.split(" ")
    longer = " ".join(str(2.0 * float(value)) for value in quaternion)
    file.write_text(file.read_text().replace(pose, f"{number} {longer} {x} {y} {z} {camera} {im} {name}"))
    data = load(tmp_path)
    line = "images.txt: 1 rotation QW QX QY QZ not of unit length, normalised: im 002.png has length 2"
    assert line in data.report
    assert np.allclose(cameras(9)[2].viewmat, data.train[1].camera.viewmat)


@pytest.mark.parametrize("text", [False, True])
def test_invalid_cameras_and_poses_are_left_out(tmp_path, text):
    write_colmap_set(tmp_path, text=text)
    model = tmp_path / "sparse" / "0"
    if text:
        file = model / "cameras.txt"
        file.write_text(f"{file.read_text()}8 OPENCV_FISHEYE 48 32 -nan(ind) 1 1 1 1 1 1 1\n9 LENS 1 1\n")
        file = model / "images.txt"
        pose = next(line for line in file.read_text().splitlines() if "im 003" in line)
        number, *_, camera, im, name = pose.split(" ")
        lost = f"{number} -nan(ind) nan 1.#IND -1.#QNAN00 0 0 0 {camera} {im} {name}"
        file.write_text(file.read_text().replace(pose, lost))
    else:
        data = (model / "cameras.bin").read_bytes()
        other = struct.pack("<iiQQ8d", 8, 5, 48, 32, *[np.nan] * 8)
        (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + data[8:] + other)
        data = (model / "images.bin").read_bytes()
        at = data.index(b"im 003.png") - 4 - 56
        (model / "images.bin").write_bytes(data[:at] + struct.pack("<7d", *[np.nan] * 7) + data[at + 56 :])
    data = load(tmp_path, test_every=0)
    assert 8 == len(data.train)
    name = "images.txt" if text else "images.bin"
    assert f"{name}: 1 image without a finite pose, dropped: im 003.png" in data.report


def test_doubtful_lenses_and_poses_are_reported(tmp_path):
    write_colmap_set(tmp_path)
    assert not any("principal" in line or "one place" in line for line in load(tmp_path).report)
    shots = cameras(9)
    write_colmap(tmp_path / "sparse" / "0", shots[:1] * 9, parameters=[PIXELS, PIXELS, 6.0, 4.0])
    report = load(tmp_path).report
    assert not any("see none of the points" in line for line in report)
    assert any("camera 7: the principal point is 6 4 in 48×32 pixels, far from the middle" in line for line in report)
    assert any("all 9 cameras are at one place" in line for line in report)
    inverse = [replace(shot, viewmat=np.linalg.inv(shot.viewmat)) for shot in shots]
    write_colmap(tmp_path / "sparse" / "0", inverse)
    line = "9 of 9 cameras (im 001.png, …) see none of the points: with inverted poses they would: invert the poses"
    assert any(line in note for note in load(tmp_path).report)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda pose: pose, None), (np.linalg.inv, "all 10 cameras are at one place"),
        (lambda pose: pose @ np.diag([1, -1, -1, 1]), "all cameras look outwards"),
    ],
)  # fmt: skip
def test_poses_of_other_conventions_are_reported(tmp_path, change, message):
    write_transforms(tmp_path)
    frames = frames_of(tmp_path)
    for frame in frames:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    change_transforms(tmp_path, frames=frames)
    notes = [line for line in load(tmp_path).report if "cameras look" in line or "one place" in line]
    assert [] == notes if message is None else message in notes[0]


def test_an_outlier_camera_does_not_make_the_others_look_inverted(tmp_path):
    write_transforms(tmp_path)
    frames = frames_of(tmp_path)
    frames[2]["transform_matrix"][0][3] += 5000.0
    change_transforms(tmp_path, frames=frames)
    assert not any("cameras look" in line for line in load(tmp_path).report)


def test_points_of_one_colour_get_colours_of_the_images(tmp_path):
    write_colmap_set(tmp_path, text=True)
    file = tmp_path / "sparse" / "0" / "points3D.txt"
    file.write_text("1 0 0 0 0 0 0 1\n2 0.4 0.1 0.2 0 0 0 1\n")
    data = load(tmp_path)
    assert data.points_rgb is None
    assert "all points have the colour 0 0 0: initial colours are taken from the images instead" in data.report
    splats = place_splats(data.train, measure_extent(data.train), 2, 0, np.random.default_rng(0), points=data.points)
    colours = 0.5 + 0.28209479177387814 * splats["sh0"][np.argsort(splats["means"][:, 0])]
    assert colours[1, 1] > 0.1  # a green dot lies there, on black
    assert np.allclose(0.0, colours[1, [0, 2]], atol=1e-6)


@pytest.mark.parametrize("name", ["images/im 003.png", "sparse/0/images.bin", "test.txt"])
def test_pointers_of_git_lfs_are_named(tmp_path, name):
    write_colmap_set(tmp_path)
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(InputError, match=r"is a pointer of Git LFS, not the file itself: run `git lfs pull`"):
        load(tmp_path).read()
    (tmp_path / name).write_text("<!DOCTYPE html><html>")
    with pytest.raises(InputError, match=r"is a web page \(HTML\)"):
        load(tmp_path).read()


def with_commas(name, columns=slice(None)):
    """Return a change of a model's text file: commas for points in some columns of its lines."""

    def change(folder):
        path = folder / "sparse" / "0" / name
        lines = [line.split(" ") for line in path.read_text().split("\n")]
        for words in lines:
            if words[0] != "#":
                words[columns] = [word.replace(".", ",") for word in words[columns]]
        path.write_text("\n".join(" ".join(words) for words in lines))

    return change


def replaced(name, old, new):
    def change(folder):
        path = folder / "sparse" / "0" / name
        path.write_text(path.read_text().replace(old, new, 1))

    return change


#: Changes of a model in text, and the note or the error.
COMMAS = {
    "images": ([with_commas("images.txt", slice(0, 8))], "images.txt: decimal commas are read as points: "),
    "keypoints too": ([with_commas("images.txt", slice(0, 8)), replaced("images.txt", "1.5 2", "1,5 2")], "images.txt"),
    "cameras": ([with_commas("cameras.txt")], "cameras.txt: decimal commas are read as points: "),
    "points": ([with_commas("points3D.txt")], "points3D.txt: decimal commas are read as points: 0,05 is 0.05, …"),
    "one of many": ([replaced("points3D.txt", "0.05", "0,05")], "0,05 has a comma, but 0.03 in line 2 a point"),
    "thousands": ([replaced("points3D.txt", "0.05", "1,234.5")], "'1,234.5' has a comma, expected a number"),
    "separators": ([replaced("cameras.txt", "48 32", "48, 32")], "'48,' has a comma, expected a number such"),
    "a word": ([replaced("cameras.txt", "48 32", "48 x32")], "cameras.txt, line 2: 'x32' is not a number"),
    "digits in groups": ([replaced("points3D.txt", "0.05", "1_0")], "points3D.txt, line 2: '1_0' is not a number"),
}  # fmt: skip


@pytest.mark.slow
def test_decimal_commas_are_read_or_named(tmp_path):
    write_colmap_set(tmp_path / "set", text=True)
    expected = load(tmp_path / "set")

    def check(case):
        changes, message = case
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        shutil.copytree(tmp_path / "set", folder)
        for change in changes:
            change(folder)
        if not message.startswith(("images.txt", "cameras.txt: dec", "points3D.txt: dec")):
            with pytest.raises(InputError, match=re.escape(message)):
                load(folder)
            return
        read = load(folder)
        assert any(line.startswith(message) for line in read.report)
        assert (read.points == expected.points).all()
        for one, other in zip(read.train, expected.train, strict=True):
            assert (one.camera.viewmat == other.camera.viewmat).all()
            assert (one.camera.K == other.camera.K).all()

    assert [] == failures(COMMAS, check)


def test_decimal_commas_in_json_are_named(tmp_path):
    write_transforms(tmp_path)
    file = tmp_path / "transforms.json"
    text, message = file.read_text(), r"is not a JSON file: .*; it has a decimal comma, "
    for changed, comma in ((text.replace('"cx": 24.0', '"cx": 24,5'), "24,5"), (text.replace("0.", "0,"), r"-?0,0\d+")):
        file.write_text(changed)
        with pytest.raises(InputError, match=f"{message}{comma}, expected a"):
            load(tmp_path)
    file.write_text(text)
    change_frames(tmp_path, [3], transform_matrix=[[0, 5] * 4] * 4)
    with pytest.raises(InputError, match=r"transform_matrix has shape \[4, 8\], as if by decimal commas"):
        load(tmp_path)


#: Files of other programs, with their beginnings, and a part of the message.
FOREIGN = {
    "Polycam": ("keyframes/corrected_cameras/1.json", "{}", "a raw export of Polycam, which is not read: convert it"),
    "Polycam, uncorrected": ("keyframes/cameras/1.json", "{}", "`ns-process-data polycam`"),
    "Record3D": ("scan.r3d", "PK", "`ns-process-data record3d`"),
    "Metashape": ("Scan.PSX", "<document/>", "a project of Metashape"),
    "cameras of Metashape": ("cameras.xml", '<?xml version="1.0"?>\n<document version="1.5">', "process-data meta"),
    "RealityScan": ("rc.csv", "#name,x,y,alt", "a camera list of RealityScan (RealityCapture)"),
    "XMP": ("images/1.xmp", '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description xcr:Version="3"', "XMP files of Re"),
    "OpenMVG": ("reconstruction/sfm_data.json", "{}", "openMVG_main_openMVG2Colmap"),
    "Meshroom": ("cameras.sfm", "{}", "a scene of Meshroom"),
    "OpenSfM": ("opensfm/reconstruction.json", "[]", "`opensfm export_colmap`"),
    "Bundler": ("bundle/bundle.out", "# Bundle file v0.3", "a file of Bundler"),
    "VisualSFM": ("scan.nvm", "NVM_V3", "a file of VisualSFM"), "Pix4D": ("scan.p4d", "", "a project of Pix4D"),
    "LLFF": ("poses_bounds.npy", "", "llff2nerf"), "NeuS": ("cameras_sphere.npz", "", "a set of NeuS"),
    "Stray Scanner": ("odometry.csv", "timestamp, frame", "a capture of Stray Scanner"),
    "3DGS": ("cfg_args", "Namespace()", "name the data set that it was trained on"),
    "LAS": ("cloud.laz", "LASF", "training needs images with poses"), "a video": ("walk.MOV", "", "take frames of it"),
}  # fmt: skip


@pytest.mark.slow
def test_sets_of_other_programs_are_named_with_a_way_out(tmp_path):
    def check(case):
        name, begin, message = case
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text(begin)
        Image.new("RGB", (8, 8)).save(folder / "photo.png")
        with pytest.raises(InputError, match=re.escape(message)) as raised:
            load(folder)
        assert "\n" not in str(raised.value)
        if "Polycam" not in message and "polycam" not in message:
            with pytest.raises(InputError, match=re.escape(message)):
                load(folder / name)

    assert [] == failures(FOREIGN, check)


def test_other_files_do_not_hide_a_set(tmp_path):
    write_transforms(tmp_path / "scan")
    for name in ("scan/bundle.out", "scan/cameras.xml", "scan/scan.mp4", "scan/cloud.las", "walk.mp4"):
        (tmp_path / name).write_text("<document/>")
    assert load(tmp_path / "scan").train
    with pytest.raises(InputError, match=r"is not a data set: .*; did you mean scan in it"):
        load(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "list.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"other is not a data set: expected transforms_train\.json"):
        load(tmp_path / "other")


@pytest.mark.parametrize("name", ["a.JPG", "images/a.png", "input/a.jpeg"])
def test_images_without_poses_are_named(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"is not a data set: .*; there are images, but no camera poses: compute them"):
        load(tmp_path)
