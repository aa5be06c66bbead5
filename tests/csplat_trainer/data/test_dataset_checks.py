# SPDX-License-Identifier: Apache-2.0
"""Lenses of data sets, images that are straightened, and sets whose sizes, lenses or poses contradict the images.

Also: csplat_trainer.data.foreign_sets, csplat_trainer.data.lens.
"""

import json
import math
import re
import struct
from dataclasses import replace

import numpy as np
import posed_sets as sets
import pytest
from PIL import Image
from posed_sets import H, W, assert_refused, cameras, report_of

from csplat.errors import InputError
from csplat_trainer.data import dataset, load
from csplat_trainer.data.colmap import read_cameras
from csplat_trainer.data.lens import Lens, distorted
from csplat_trainer.initial_splats import measure_extent, place_splats

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
    "FISHEYE": FOCAL, "EUCM": None, "EQUIRECTANGULAR": None, "ABSENT": None,
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


@pytest.mark.parametrize(("number", "model"), [*enumerate(MODELS)])
def test_lens_models_agree_with_the_documentation_of_colmap(tmp_path, number, model):
    points, file, parameters = np.random.default_rng(3).uniform(-0.6, 0.6, (40, 2)), tmp_path / "a.bin", MODELS[model]
    values = parameters or [1.0] * 4
    file.write_bytes(struct.pack(f"<QiiQQ{len(values)}d", 1, 1, number, LENS_W, LENS_H, *values))
    if parameters is None:
        remedy = "split panoramas" if model == "EQUIRECTANGULAR" else "use `colmap image_undistorter"
        with pytest.raises(InputError, match=f"the lens is {model}, expected one of .*: {remedy}"):
            read_lens(tmp_path, model, values)
        with pytest.raises(InputError, match=f"camera 1: the lens is {model.replace('ABSENT', 'of number 18')},"):
            read_cameras(file)
        return
    lens = read_lens(tmp_path, model, parameters)
    assert read_cameras(file)[1] == lens
    assert lens.distorts == (model not in ("SIMPLE_PINHOLE", "PINHOLE"))
    straight = Lens(LENS_W, LENS_H, 1.0, 1.0, 0.0, 0.0)
    found = np.stack(distorted(points[:, 0], points[:, 1], lens, straight), axis=1)
    assert np.allclose([colmap_pixel(model, parameters, x, y) for x, y in points], found, rtol=0, atol=1e-9)


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


def write_lens_transforms(folder, **values):
    frames = [{"file_path": "images/im 000.png", "transform_matrix": np.eye(4).tolist()}]
    focal = dict(zip(("fl_x", "fl_y", "cx", "cy"), FOCAL, strict=True))
    (folder / "transforms.json").write_text(json.dumps({**focal, "w": LENS_W, "h": LENS_H, **values, "frames": frames}))


RATIONAL = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), MODELS["FULL_OPENCV"][4:], strict=True))
FISHEYE = dict(zip(("k1", "k2", "k3", "k4"), MODELS["OPENCV_FISHEYE"][4:], strict=True))
#: Model, parameters, and the fields of transforms.json or None for a set of COLMAP.
LENSES = [
    *((model, MODELS[model], None) for model in (
        "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FOV", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")),
    ("FULL_OPENCV", [*FOCAL, *[0.0] * 8], None),  # a pinhole
    ("FULL_OPENCV", MODELS["FULL_OPENCV"], {"camera_model": "FULL_OPENCV", **RATIONAL}),
    ("FULL_OPENCV", [*MODELS["FULL_OPENCV"][:9], 0.0, 0.0, 0.0],
     {"camera_model": "OPENCV", **{key: RATIONAL[key] for key in ("k1", "k2", "p1", "p2", "k3")}}),
    ("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"], {"camera_model": "OPENCV_FISHEYE", **FISHEYE}),
    ("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"], {"is_fisheye": True, **FISHEYE}),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("model", "parameters", "values"), LENSES)
def test_images_of_every_kind_of_lens_are_undistorted(tmp_path, model, parameters, values):
    lens, folder = read_lens(tmp_path, model, parameters), tmp_path / "set"
    photograph(lens, folder / "images" / "im 000.png")
    if values is None:
        sets.write_colmap(folder / "sparse", cameras(1), model, parameters, text=True, width=LENS_W, height=LENS_H)
    else:
        write_lens_transforms(folder, **values)
    data = load(folder, test_every=0)
    assert_is_straight(data.train[0])
    notes = [line for line in data.report if "distortion is undone" in line or "fisheye images are cropped" in line]
    assert (0 if not lens.distorts else 2 if "FISHEYE" in model else 1) == len(notes)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_pixels_are_interpolated_between_centres_and_colours_weighted_by_alpha(channels):
    rng = np.random.default_rng(channels)
    pixels = rng.integers(0, 256, (5, 7, channels), np.uint8)
    x, y = rng.uniform(-2.0, 9.0, 200), rng.uniform(-2.0, 7.0, 200)  # the image ends at 7 and 5
    values = pixels.astype(np.float64)
    if channels == 4:
        values[..., :3] *= values[..., 3:]
    found = dataset._interpolate(np.moveaxis(values, 2, 0), x, y)
    column, row = np.clip(x - 0.5, 0, 6), np.clip(y - 0.5, 0, 4)
    weights = np.maximum(0.0, 1.0 - np.abs(np.arange(7) - column[:, None]))[:, None]
    weights = weights * np.maximum(0.0, 1.0 - np.abs(np.arange(5) - row[:, None]))[..., None]
    expected = np.einsum("nyx,yxc->nc", weights, values)
    if channels == 4:
        expected[:, :3] /= np.maximum(expected[:, 3:], 1e-3)
    assert np.abs(expected - found).max() < 0.5 + 1e-9


def test_factors_of_other_lens_models_are_refused(tmp_path):
    (tmp_path / "images").mkdir()
    Image.new("RGB", (LENS_W, LENS_H)).save(tmp_path / "images" / "im 000.png")
    for values, message in (
        ({"camera_model": "OPENCV", "k4": 0.1}, "k4 is 0.1 with camera_model OPENCV, expected 0"),
        ({"k5": 0.1}, "k5 is 0.1 with camera_model not named"), ({"is_fisheye": True, "p1": 0.1}, "p1 is 0.1"),
        ({"k3": "much"}, "k3 is 'much', expected a number"),
        ({"k1": -1.4}, r"radial \(-1.4, 0.0, 0.0\)\) cannot be undone"),
        ({"camera_model": "FISHEYE624"}, "camera_model is FISHEYE624, expected one of .*undistorter"),
    ):  # fmt: skip
        write_lens_transforms(tmp_path, **values)
        assert_refused(message, tmp_path)


POSE, OTHER = (np.array(sets.to_opengl(camera)) for camera in cameras(2))
SHEARED = POSE @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
PIXELS = 51.47  # pixels; the approximate focal length of the set


def frames(*matrices, paths=("images/0000.png",)):
    rows = zip(paths, matrices, strict=True)
    return {"frames": [{"file_path": path, "transform_matrix": np.asarray(one).tolist()} for path, one in rows]}


#: Fields of transforms.json, and the text of the error.
INVALID = {
    "no frames": ({"frames": []}, "lists no frames"),
    "no path": ({"frames": [{"transform_matrix": []}]}, "frame 0 has no file_path"),
    "a negative length": ({"fl_x": -5}, "fl_x is -5, expected above 0"),
    "a word": ({"fl_x": "wide"}, "fl_x is 'wide'"),
    "a large integer": ({"fl_x": 10**400}, "an integer has 401 digits, expected at most 300"),
    "a large integer in a matrix": (frames([[10**400, 0, 0, 0]] * 4), "an integer has 401 digits"),
    "a panorama": ({"camera_model": "EQUIRECTANGULAR"}, "is EQUIRECTANGULAR, expected one of PINHOLE, .*: split pano"),
    "no pixels": ({"w": 0}, "w and h are 0 and 32"), "too much distortion": ({"k1": -30.0}, "cannot be undone"),
    "a rolling shutter": ({"frames": [{"file_path": "images/0000.png", "transform_matrix_start": 1}]}, "rolling shutt"),
    "an image twice": (frames(POSE, OTHER, paths=("a.png", "./a.png")), r"frame 1: \./a\.png occurs twice, with diff"),
    "a line in a name": (frames(POSE, paths=["a\nb"]), "file_path has control characters"),
    "no matrix": (frames([]), "frame 0"), "a number": (frames([[1]]), "frame 0"),
    "zeros": (frames(np.zeros((4, 4))), "frame 0"), "words": (frames([["x"] * 4] * 4), "frame 0"),
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
    "by columns": (frames(POSE.T), "frame 0: transform_matrix has the last row .* expected 0 0 0 1: .* is transposed"),
    "another last row": (frames([*POSE[:3], [0, 0, 0, 2]]), "has the last row 0 0 0 2, expected 0 0 0 1$"),
    "mirrored": (frames(POSE @ np.diag([1, 1, -1, 1])), "determinant -1, expected a rotation: it is mirrored"),
    "sheared": (frames(SHEARED), "begins with axes of lengths 1, 1.02, 1"),
    "4 by 3": (frames(POSE[:, :3]), r"has shape \[4, 3\]"),
    "decimal commas": (frames([[0, 5] * 4] * 4), r"matrix has shape \[4, 8\], as if by decimal commas"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("fields", "message"), INVALID.values(), ids=INVALID)
def test_invalid_or_contradictory_fields_are_refused(transforms_set, fields, message):
    sets.change_transforms(transforms_set, **fields)
    assert_refused(message, transforms_set)


def test_an_image_of_another_shape_than_its_camera_is_reported_or_refused(colmap_set):
    Image.new("RGB", (W, 24)).save(colmap_set / "images" / "im 003.png")
    line = "image with another aspect ratio than their cameras (im 003.png: 48×24, 48×32)"
    assert line in report_of(colmap_set)
    Image.new("RGB", (H, W)).save(colmap_set / "images" / "im 003.png")
    message = r"im 003\.png has 32×48 pixels, expected the aspect ratio of 48×32, given by .*cameras\.bin, camera 7:"
    assert_refused(f"{message} the sides are swapped", colmap_set)


def test_poses_of_other_conventions_are_reported_and_their_scale_removed(transforms_set):
    poses = [np.array(frame["transform_matrix"]) for frame in sets.frames_of(transforms_set)]
    away = np.zeros((4, 4))
    away[0, 3] = 5000.0
    sine, cosine = np.sin(np.radians(8.0)), np.cos(np.radians(8.0))
    aside = np.array([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
    words = ("scaled", "cameras look", "one place")
    for changed, message in (
        (poses, None), (map(np.linalg.inv, poses), "all 10 cameras are at one place"),
        ((pose @ np.diag([1, -1, -1, 1]) for pose in poses), "all cameras look outwards"),
        ((pose @ np.diag([1, -1, -1, 1]) @ aside for pose in poses), None),  # lines of sight do not meet
        ((pose + away * (i == 2) for i, pose in enumerate(poses)), None),  # an outlier
        ((pose @ np.diag([2, 2, 2, 1]) for pose in poses), "10 poses scaled (the first by 2): removed, positions stay"),
    ):  # fmt: skip
        for i, pose in enumerate(changed):
            sets.change_frames(transforms_set, [i], transform_matrix=pose.tolist())
        data = load(transforms_set)
        notes = [line for line in data.report if any(word in line for word in words)]
        assert [] == notes if message is None else message in notes[0]
    assert np.allclose(cameras(10)[1].viewmat, data.train[0].camera.viewmat)


def test_smaller_images_may_be_rounded_either_way(transforms_set):
    sets.change_transforms(transforms_set, frames=sets.frames_of(transforms_set)[:1])
    for size, (w, h), note in (
        ((649, 420), (1297, 840), None), ((648, 420), (1297, 840), None), ((618, 411), (4946, 3286), None),
        ((619, 410), (4946, 3286), None), ((324, 210), (1297, 840), None), ((1297, 840), (648, 420), None),
        ((480, 324), (480, 320), "1 image with another aspect ratio than their cameras (0000.png: 480×324, 480×320)"),
    ):  # fmt: skip
        Image.new("RGB", size).save(transforms_set / "images" / "0000.png")
        sets.change_transforms(transforms_set, w=w, h=h, cx=w / 2, cy=h / 2, fl_x=w, fl_y=w)
        notes = [line for line in load(transforms_set, test_every=0).report if "aspect ratio" in line]
        assert [] == notes if note is None else notes[0].startswith(note), size


def test_a_rotation_of_another_length_is_normalised_and_reported(colmap_text_set):
    file = colmap_text_set / "sparse" / "0" / "images.txt"
    pose = next(line for line in file.read_text().splitlines() if "im 002" in line)
    number, *quaternion, x, y, z, rest = pose.split(" ", 8)
    longer = " ".join(str(2.0 * float(value)) for value in quaternion)
    file.write_text(file.read_text().replace(pose, f"{number} {longer} {x} {y} {z} {rest}"))
    data = load(colmap_text_set)
    line = "images.txt: 1 rotation QW QX QY QZ not of unit length, normalised: im 002.png has length 2"
    assert line in data.report
    assert np.allclose(cameras(9)[2].viewmat, data.train[1].camera.viewmat)


@pytest.mark.parametrize("text", [False, True])
def test_invalid_cameras_and_poses_are_left_out(tmp_path, text):
    model = sets.write_colmap_set(tmp_path, text=text) / "sparse" / "0"
    if text:
        with (model / "cameras.txt").open("a") as file:
            file.write("8 OPENCV_FISHEYE 48 32 -nan(ind) 1 1 1 1 1 1 1\n9 LENS 1 1\n")
        content = (model / "images.txt").read_text()
        pose = next(line for line in content.splitlines() if "im 003" in line)
        lost = f"{pose.split(' ')[0]} -nan(ind) nan 1.#IND -1.#QNAN00 0 0 0 7 im 003.png"
        (model / "images.txt").write_text(content.replace(pose, lost))
    else:
        data = (model / "cameras.bin").read_bytes()
        other = struct.pack("<iiQQ8d", 8, 5, 48, 32, *[np.nan] * 8)
        (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + data[8:] + other)
        data = (model / "images.bin").read_bytes()
        at = data.index(b"im 003.png") - 4 - 56
        (model / "images.bin").write_bytes(data[:at] + struct.pack("<7d", *[np.nan] * 7) + data[at + 56 :])
    read = load(tmp_path, test_every=0)
    assert 8 == len(read.train)
    name = "images.txt" if text else "images.bin"
    assert f"{name}: 1 image without a finite pose, dropped: im 003.png" in read.report


def test_doubtful_lenses_and_poses_are_reported(colmap_set):
    shots, report = cameras(9), report_of(colmap_set)
    assert "principal" not in report
    assert "one place" not in report
    sets.write_colmap(colmap_set / "sparse" / "0", shots[:1] * 9, parameters=[PIXELS, PIXELS, 6.0, 4.0])
    report = report_of(colmap_set)
    assert "see none of the points" not in report
    assert "camera 7: the principal point is 6 4 in 48×32 pixels, far from the middle" in report
    assert "all 9 cameras are at one place" in report
    inverse = [replace(shot, viewmat=np.linalg.inv(shot.viewmat)) for shot in shots]
    sets.write_colmap(colmap_set / "sparse" / "0", inverse)
    line = "9 of 9 cameras (im 001.png, …) see none of the points: with inverted poses they would: invert the poses"
    assert line in report_of(colmap_set)


def test_points_of_one_colour_get_colours_of_the_images(colmap_text_set):
    (colmap_text_set / "sparse" / "0" / "points3D.txt").write_text("1 0 0 0 0 0 0 1\n2 0.4 0.1 0.2 0 0 0 1\n")
    data = load(colmap_text_set)
    assert data.points_rgb is None
    assert "all points have the colour 0 0 0: initial colours are taken from the images instead" in data.report
    splats = place_splats(data.train, measure_extent(data.train), 2, 0, np.random.default_rng(0), points=data.points)
    colours = 0.5 + 0.28209479177387814 * splats["sh0"][np.argsort(splats["means"][:, 0])]
    assert colours[1, 1] > 0.1  # a green dot lies there, on black
    assert np.allclose(0.0, colours[1, [0, 2]], atol=1e-6)


def test_files_of_other_kinds_and_encodings_are_named(colmap_set):
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
    kinds = ((pointer, "Git LFS, .*run `git lfs pull`"), (b"<!DOCTYPE html><html>", r"is a web page \(HTML\)"))
    for name, data, message in (
        *((name, *kind) for name in ("images/im 003.png", "sparse/0/images.bin", "test.txt") for kind in kinds),
        ("test.txt", "im 002.png\nK\xf6ln.png".encode("cp1252"), r"K\\xf6ln\.png is no image in any code page"),
        ("test.txt", "im 002.png".encode("utf-16-le"), "byte 1 is 0"),
        ("test.txt", bytes(range(256)), "is not a text file in UTF-8"),
    ):
        before = (colmap_set / name).read_bytes() if (colmap_set / name).exists() else b""
        (colmap_set / name).write_bytes(data)
        with pytest.raises(InputError, match=message):
            load(colmap_set).read()
        (colmap_set / name).write_bytes(before)


POINT, COMMA = r"(?<=\d)\.(?=\d)", "decimal commas are read as points: "
#: File of a model in text, a pattern and its replacement, and the note or the error.
LINES = {
    "images": ("images", rf"{POINT}(?=.* 7 im )", ",", f"images.txt: {COMMA}"),
    "keypoints, too": ("images", POINT, ",", f"images.txt: {COMMA}"),
    "cameras": ("cameras", POINT, ",", f"cameras.txt: {COMMA}"),
    "points": ("points3D", POINT, ",", f"points3D.txt: {COMMA}0,05 is 0.05, …"),
    "one of many": ("points3D", r"0\.05", "0,05", "0,05 has a comma, but 0.03 in line 2 a point"),
    "thousands": ("points3D", r"0\.05", "1,234.5", "'1,234.5' has a comma, expected a number"),
    "separators": ("cameras", "48 32", "48, 32", "'48,' has a comma, expected a number such"),
    "a word": ("cameras", "48 32", "48 x32", "cameras.txt, line 2: 'x32' is not a number"),
    "digits in groups": ("points3D", r"0\.05", "1_0", "points3D.txt, line 2: '1_0' is not a number"),
    "few fields of an image": ("images", "^(?s:.*)$", "1 2 3\n", "line 1"),
    "words in an image": ("images", "^(?s:.*)$", "1 a b c d e f g 7 name\n", "line 1"),
    "a rotation of 0": ("images", "^(?s:.*)$", "1 0 0 0 0 0 0 0 7 name\n", "line 1"),
    "a camera's name": ("images", "^(?s:.*)$", "1 1 0 0 0 0 0 0 x name\n", "line 1"),
    "an absent camera": ("images", "^(?s:.*)$", "1 1 0 0 0 0 0 0 9 im 001.png\n\n", "has camera 9"),
    "few fields of a camera": ("cameras", "^(?s:.*)$", "7 PINHOLE 48\n", "expected id, model"),
    "few fields of a point": ("points3D", "^(?s:.*)$", "1 2 3\n", "expected id, position and colour"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "pattern", "replacement", "message"), LINES.values(), ids=LINES)
def test_decimal_commas_are_read_or_named_and_invalid_lines_refused(
    colmap_text_set, name, pattern, replacement, message
):
    expected, path = load(colmap_text_set), colmap_text_set / "sparse" / "0" / f"{name}.txt"
    path.write_text(re.sub(pattern, replacement, path.read_text()))
    if COMMA not in message:
        assert_refused(re.escape(message), colmap_text_set)
        return
    read = load(colmap_text_set)
    assert any(line.startswith(message) for line in read.report)
    assert (read.points == expected.points).all()
    for one, other in zip(read.train, expected.train, strict=True):
        assert (one.camera.viewmat == other.camera.viewmat).all()
        assert (one.camera.K == other.camera.K).all()


def test_decimal_commas_in_json_are_named(transforms_set):
    file = transforms_set / "transforms.json"
    text, message = file.read_text(), r"is not a JSON file: .*; it has a decimal comma, "
    for changed, comma in ((text.replace('"cx": 24.0', '"cx": 24,5'), "24,5"), (text.replace("0.", "0,"), r"-?0,0\d+")):
        file.write_text(changed)
        assert_refused(f"{message}{comma}, expected a", transforms_set)


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
@pytest.mark.parametrize(("name", "begin", "message"), FOREIGN.values(), ids=FOREIGN)
def test_sets_of_other_programs_are_named_with_a_way_out(tmp_path, name, begin, message):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(begin)
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.png")
    with pytest.raises(InputError, match=re.escape(message)) as raised:
        load(tmp_path)
    assert "\n" not in str(raised.value)
    if "Polycam" not in message and "polycam" not in message:
        assert_refused(re.escape(message), tmp_path / name)


def test_other_files_do_not_hide_a_set(tmp_path):
    sets.write_transforms(tmp_path / "scan")
    for name in (
        "scan/bundle.out", "scan/cameras.xml", "scan/a.las", "a.mp4", "other/a.csv", "raw/database.db", "set.zip",
        "1/a.JPG", "2/images/a.png", "3/input/a.jpeg",
    ):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("<document/>")
    assert load(tmp_path / "scan").train
    for name, message in (
        (".", "did you mean scan in it"), ("other", r"expected transforms_train\.json"), ("raw", "run `colmap mapper`"),
        *((number, "there are images, but no camera poses: compute them") for number in "123"),
    ):  # fmt: skip
        assert_refused(f"is not a data set: .*{message}", tmp_path / name)
    assert_refused("unpack it", tmp_path / "set.zip")
