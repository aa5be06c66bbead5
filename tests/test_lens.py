"""Lenses of COLMAP and of transforms.json: where they put pixels, and images that are straightened."""

import json
import math
import struct

import numpy as np
import pytest

from csplat.errors import InputError

pytest.importorskip("scipy", reason="data sets need scipy: pip install 'csplat[render]'")
pytest.importorskip("PIL", reason="data sets need pillow: pip install 'csplat[render]'")

from PIL import Image  # it needs what is looked for above
from posed_sets import cameras, write_colmap, write_picture
from tables import failures

from csplat_trainer.data import load
from csplat_trainer.data.colmap import read_cameras
from csplat_trainer.data.lens import Lens, distorted, undistorted_lens

W, H = 120, 90
FOCAL = [100.0, 98.0, 62.0, 44.0]
ONE_FOCAL = [100.0, 61.0, 44.0]

#: Parameters of the models of COLMAP that are read, with the distortions of ordinary lenses.
MODELS = {
    "SIMPLE_PINHOLE": ONE_FOCAL,
    "PINHOLE": FOCAL,
    "SIMPLE_RADIAL": [*ONE_FOCAL, 0.05],
    "RADIAL": [*ONE_FOCAL, -0.08, 0.02],
    "OPENCV": [*FOCAL, 0.05, -0.02, 0.001, -0.002],
    "OPENCV_FISHEYE": [*FOCAL, 0.05, -0.02, 0.01, -0.003],
    "FULL_OPENCV": [*FOCAL, 0.1, -0.05, 0.002, -0.003, 0.04, 0.2, -0.1, 0.03],
    "FOV": [*FOCAL, 0.6],
    "SIMPLE_RADIAL_FISHEYE": [*ONE_FOCAL, -0.04],
    "RADIAL_FISHEYE": [*ONE_FOCAL, 0.04, -0.01],
    "THIN_PRISM_FISHEYE": [*FOCAL, 0.03, -0.01, 0.001, -0.002, 0.01, -0.004, 0.003, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": None,
    "SIMPLE_DIVISION": None,
    "DIVISION": None,
    "SIMPLE_FISHEYE": ONE_FOCAL,
    "FISHEYE": FOCAL,
    "EUCM": None,
    "EQUIRECTANGULAR": None,
}


def colmap_pixel(model, parameters, x, y):
    """Project the direction (x, y, 1) one at a time, as COLMAP's documentation of each model has it."""
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
    path.write_text(f"1 {model} {W} {H} {' '.join(str(value) for value in parameters)}\n")
    return read_cameras(path)[1]


def test_every_model_of_colmap_puts_pixels_where_colmap_does(tmp_path):
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.6, 0.6, (40, 2))

    def check(case):
        model, parameters = case
        if parameters is None:
            with pytest.raises(InputError, match=f"the lens is {model}, expected one of .*colmap image_undistorter"):
                read_lens(tmp_path, model, [1.0] * 4)
            return
        lens = read_lens(tmp_path, model, parameters)
        assert lens.distorts == (model not in ("SIMPLE_PINHOLE", "PINHOLE"))
        straight = Lens(W, H, 1.0, 1.0, 0.0, 0.0)
        found = np.stack(distorted(points[:, 0], points[:, 1], lens, straight), axis=1)
        assert np.allclose([colmap_pixel(model, parameters, x, y) for x, y in points], found, rtol=0, atol=1e-9)

    assert [] == failures({model: (model, parameters) for model, parameters in MODELS.items()}, check)


def test_models_of_binary_files_have_the_numbers_of_colmap(tmp_path):
    file = tmp_path / "cameras.bin"

    def check(case):
        number, (model, parameters) = case
        values = parameters or [1.0] * 4
        file.write_bytes(struct.pack(f"<QiiQQ{len(values)}d", 1, 1, number, W, H, *values))
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
    """A smooth image over directions: red, green, blue, 0..255."""
    return 127.5 + 100.0 * np.stack([np.sin(9 * x + 2 * y), np.cos(8 * y - 3 * x), np.sin(7 * x * y + 5 * x)], axis=-1)


def photograph(lens, path):
    """Paint the scene as a lens sees it: directions of pixels are found step by step."""
    v, u = np.mgrid[0:H, 0:W] + 0.5
    plain = Lens(W, H, lens.fx, lens.fy, lens.cx, lens.cy)
    at_u, at_v = u.copy(), v.copy()
    for _ in range(60):
        found_u, found_v = distorted(at_u, at_v, lens, plain)
        at_u, at_v = at_u + (u - found_u), at_v + (v - found_v)
    colours = scene((at_u - lens.cx) / lens.fx, (at_v - lens.cy) / lens.fy)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.clip(np.rint(colours), 0, 255).astype(np.uint8)).save(path)


def assert_is_straight(picture, what):
    """Compare an undistorted image with the scene as its pinhole sees it: interpolation errs by a few levels."""
    K = picture.camera.K
    v, u = np.mgrid[0:H, 0:W] + 0.5
    wanted = scene((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    error = np.abs(picture.pixels - wanted)
    assert error.mean() < 0.7, what
    assert error.max() < 4.0, what


def test_images_of_every_model_are_straight(tmp_path):
    def check(case):
        model, parameters = case
        folder = tmp_path / model
        lens = read_lens(tmp_path, model, parameters)
        photograph(lens, folder / "images" / "im 000.png")
        write_colmap(folder / "sparse", cameras(1), model, parameters, text=True, width=W, height=H)
        data = load(folder, test_every=0)
        assert_is_straight(data.train[0], model)
        told = [line for line in data.report if "distortion is undone" in line or "fisheye images are cut" in line]
        assert (0 if not lens.distorts else 2 if "FISHEYE" in model else 1) == len(told)

    assert [] == failures({model: (model, values) for model, values in MODELS.items() if values}, check)


def write_transforms(folder, **values):
    fx, fy, cx, cy = FOCAL
    frames = [{"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}]
    document = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": W, "h": H, **values, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))


def test_transforms_json_states_the_same_lenses(tmp_path):
    k = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), MODELS["FULL_OPENCV"][4:], strict=True))
    fisheye = dict(zip(("k1", "k2", "k3", "k4"), MODELS["OPENCV_FISHEYE"][4:], strict=True))

    def check(case):
        model, parameters, values = case
        photograph(read_lens(tmp_path, model, parameters), tmp_path / "images" / "a.png")
        write_transforms(tmp_path, **values)
        assert_is_straight(load(tmp_path).train[0], values)

    brown = {key: k[key] for key in ("k1", "k2", "p1", "p2", "k3")}
    cases = {
        "rational": ("FULL_OPENCV", MODELS["FULL_OPENCV"], {"camera_model": "FULL_OPENCV", **k}),
        "k3": ("FULL_OPENCV", [*MODELS["FULL_OPENCV"][:9], 0.0, 0.0, 0.0], {"camera_model": "OPENCV", **brown}),
        "fisheye": ("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"], {"camera_model": "OPENCV_FISHEYE", **fisheye}),
        "is_fisheye": ("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"], {"is_fisheye": True, **fisheye}),
    }
    assert [] == failures(cases, check)


def test_factors_that_a_model_does_not_have_are_refused(tmp_path):
    Image.new("RGB", (W, H)).save(tmp_path / "a.png")
    (tmp_path / "images").mkdir()
    (tmp_path / "a.png").rename(tmp_path / "images" / "a.png")

    def check(case):
        values, says = case
        write_transforms(tmp_path, **values)
        with pytest.raises(InputError, match=says):
            load(tmp_path)

    cases = {
        "k4 of another rule": ({"camera_model": "OPENCV", "k4": 0.1}, "k4 is 0.1 with camera_model OPENCV, expected 0"),
        "no model": ({"k5": 0.1}, "k5 is 0.1 with camera_model not named"),
        "tangential fisheye": ({"is_fisheye": True, "p1": 0.1}, "p1 is 0.1"),
        "no number": ({"k3": "much"}, "k3 is 'much', expected a number"),
        "a lens that folds": ({"k1": -1.4}, r"radial \(-1.4, 0.0, 0.0\)\) cannot be undone"),
        "another model": ({"camera_model": "FISHEYE624"}, "camera_model is FISHEYE624, expected one of .*undistorter"),
    }
    assert [] == failures(cases, check)


def test_distortion_moves_pixels_as_opencv_says():
    """One point worked out by hand: x = 0.5, y = -0.25, r² = 0.3125."""
    lens = Lens(100, 80, 100.0, 90.0, 50.0, 40.0, (0.1, -0.02), (0.01, -0.03))
    straight = Lens(100, 80, 100.0, 90.0, 50.0, 40.0)
    radial = 1 + 0.1 * 0.3125 - 0.02 * 0.3125**2
    xd = 0.5 * radial + 2 * 0.01 * 0.5 * -0.25 + -0.03 * (0.3125 + 2 * 0.25)
    yd = -0.25 * radial + 0.01 * (0.3125 + 2 * 0.0625) + 2 * -0.03 * 0.5 * -0.25
    x, y = distorted(np.array([100.0]), np.array([40.0 - 0.25 * 90.0]), lens, straight)
    assert np.isclose(50.0 + 100.0 * xd, x[0])
    assert np.isclose(40.0 + 90.0 * yd, y[0])


@pytest.mark.parametrize(
    ("radial", "tangential"),
    [
        ((0.06, -0.08), (-0.001, 0.0002)),
        ((-0.3, 0.1), (0.0, 0.0)),
        ((0.2,), (0.01, 0.01)),
        ((0.0, 0.0, 0.1), (0.0, 0.0)),
    ],
)
def test_undistortion_never_looks_beyond_the_picture(radial, tangential):
    lens = Lens(540, 960, 688.0, 687.0, 277.0, 482.0, radial, tangential)
    v, u = np.mgrid[0:960, 0:540] + 0.5
    x, y = distorted(u, v, lens, undistorted_lens(lens))
    assert x.min() >= 0.0
    assert x.max() <= 540.0
    assert y.min() >= 0.0
    assert y.max() <= 960.0
