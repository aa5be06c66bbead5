"""Data sets that contradict themselves: sizes, lenses and poses that do not fit the images."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from csplat.errors import InputError

pytest.importorskip("scipy", reason="data sets need scipy: pip install 'csplat[render]'")
pytest.importorskip("PIL", reason="data sets need pillow: pip install 'csplat[render]'")

from PIL import Image  # it needs what is looked for above
from posed_sets import H, W, cameras, change_transforms, to_opengl, write_colmap, write_colmap_set, write_transforms
from tables import failures

from csplat_trainer.data import load
from csplat_trainer.initial_splats import measure_extent, place_splats

POSE = np.array(to_opengl(cameras(10)[0]))
SHEARED = POSE @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
PIXELS = 51.47  # the focal length of the set, about

#: Fields of transforms.json, and the text of the error.
FIELDS = {
    "an angle in degrees": (
        {"fl_x": None, "fl_y": None, "camera_angle_x": 50.0},
        r"is 50 \(degrees\?\), expected radians",
    ),
    "lengths and angles that differ": (
        {"camera_angle_x": 0.5},
        r"frame 0: fl_x is 51\.\d+, expected 93\.99\d* as camera_angle_x = 0\.5 says for 48 pixels",
    ),
    "down, too": ({"camera_angle_y": 0.5}, "fl_y is 51.* as camera_angle_y = 0.5 says for 32 pixels"),
    "no unit of pixels": (
        {"fl_x": 1.07, "fl_y": 1.07},
        "frame 1: the focal length across is 1.07 for 48 pixels, expected 2.4",
    ),
    "micrometres": ({"fl_x": 35000, "fl_y": 35000}, "the focal length across is 35000 for 48 pixels"),
    "one is another's": ({"fl_y": 4 * PIXELS}, "expected about the same: one of them is wrong"),
    "far outside": ({"cx": 960.0}, r"the principal point is 960 16 in 48×32 pixels, expected about the middle"),
    "swapped": (
        {"cx": H / 2, "cy": W / 2},
        "16 24 in 48×32 pixels, expected about 24 16: width and height, or its two",
    ),
    "width and height swapped": ({"w": H, "h": W}, "24 16 in 32×48 pixels, expected about 16 24"),
}

#: transform_matrix of a frame, and the text of the error.
MATRICES = {
    "by columns": (POSE.T, "frame 0: transform_matrix has the last row .* expected 0 0 0 1: .* it is transposed"),
    "another last row": (np.vstack([POSE[:3], [0, 0, 0, 2]]), "has the last row 0 0 0 2, expected 0 0 0 1 "),
    "mirrored": (POSE @ np.diag([1, 1, -1, 1.0]), "determinant -1, expected a rotation: it is mirrored"),
    "sheared": (SHEARED, "begins with axes of lengths 1, 1.02, 1"),
    "4 by 3": (POSE[:, :3], r"has shape \[4, 3\]"),
}


def refusals(folder, cases, change):
    """Check that a set with each of the changes is refused in the words of the case."""
    write_transforms(folder)
    file = folder / "transforms.json"
    whole = json.loads(file.read_text())

    def check(case):
        value, says = case
        file.write_text(json.dumps({**whole, **change(whole, value)}))
        with pytest.raises(InputError, match=says):
            load(folder)

    return failures(cases, check)


def test_fields_that_contradict_each_other_are_refused(tmp_path):
    assert [] == refusals(tmp_path, FIELDS, lambda _, fields: fields)


def test_matrices_that_are_no_poses_are_refused(tmp_path):
    def change(whole, matrix):
        return {"frames": [{**whole["frames"][0], "transform_matrix": matrix.tolist()}, *whole["frames"][1:]]}

    cases = {name: (matrix, says.replace("0 0 0 1 ", "0 0 0 1$")) for name, (matrix, says) in MATRICES.items()}
    assert [] == refusals(tmp_path, cases, change)


def test_a_length_of_one_frame_counts_more_than_an_angle_of_all(tmp_path):
    write_transforms(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    own = [{**frame, "fl_x": 77.0, "fl_y": 77.0} for frame in frames]
    change_transforms(tmp_path, frames=own, camera_angle_x=0.5)
    assert {77.0} == {picture.camera.K[0, 0] for picture in load(tmp_path).train}


def test_an_image_whose_sides_are_swapped_is_refused(tmp_path):
    write_colmap_set(tmp_path)
    Image.new("RGB", (H, W)).save(tmp_path / "images" / "im 003.png")
    found = r"im 003\.png is 32×48 pixels, expected the shape of 48×32"
    with pytest.raises(InputError, match=rf"{found}, which .*cameras\.bin, camera 7 states: the sides are swapped"):
        load(tmp_path)


def test_an_image_of_another_shape_than_its_camera_is_reported(tmp_path):
    write_colmap_set(tmp_path)
    Image.new("RGB", (W, 24)).save(tmp_path / "images" / "im 003.png")
    report = load(tmp_path).report
    assert any("1 image not of the shape of their cameras' (im 003.png: 48×24, 48×32)" in line for line in report)


def test_a_mask_of_another_shape_than_its_image_is_refused(tmp_path):
    write_transforms(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    change_transforms(tmp_path, frames=[{**frame, "mask_path": "mask.png"} for frame in frames])
    Image.new("L", (W // 2, H // 2), 255).save(tmp_path / "mask.png")
    assert load(tmp_path).train[0].mask.all()
    Image.new("L", (W, W), 255).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match=r"mask\.png is 48×48 pixels, expected the shape of 48×32, its image's"):
        load(tmp_path)


def test_the_scale_of_a_world_is_taken_off_and_reported(tmp_path):
    write_transforms(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert not any("scaled" in line for line in load(tmp_path).report)
    scaled = (np.array(frames[1]["transform_matrix"]) @ np.diag([2.0, 2.0, 2.0, 1.0])).tolist()
    change_transforms(tmp_path, frames=[frames[0], {**frames[1], "transform_matrix": scaled}, *frames[2:]])
    data = load(tmp_path)
    assert "transforms.json: 1 pose scaled (the first by 2), which is taken off: places stay" in data.report
    assert np.allclose(cameras(10)[1].viewmat, data.train[0].camera.viewmat)


def test_smaller_images_may_be_rounded_either_way(tmp_path):
    write_transforms(tmp_path)
    files = sorted((tmp_path / "images").glob("*.png"))

    def notes(width, height, of):
        """Return lines on shapes, of images of one size and a camera of another."""
        for path in files:
            Image.new("RGB", (width, height)).save(path)
        w, h = of
        change_transforms(tmp_path, w=w, h=h, cx=w / 2, cy=h / 2, fl_x=w, fl_y=w)
        return [line for line in load(tmp_path).report if "shape" in line]

    for size, of in (
        ((649, 420), (1297, 840)),
        ((648, 420), (1297, 840)),
        ((618, 411), (4946, 3286)),
        ((619, 410), (4946, 3286)),
        ((324, 210), (1297, 840)),
        ((1297, 840), (648, 420)),
    ):
        assert [] == notes(*size, of), size
    (line,) = notes(480, 324, (480, 320))
    assert line.startswith("10 images not of the shape of their cameras' (0001.png: 480×324, 480×320)")


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
def test_cameras_and_poses_that_are_no_use_do_not_refuse_a_set(tmp_path, text):
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
    assert f"{name}: 1 image without a finite pose, left out: im 003.png" in data.report


def test_doubtful_lenses_and_poses_are_reported(tmp_path):
    write_colmap_set(tmp_path)
    assert not any("principal" in line or "one place" in line for line in load(tmp_path).report)
    shots = cameras(9)
    write_colmap(tmp_path / "sparse" / "0", shots[:1] * 9, parameters=[PIXELS, PIXELS, 6.0, 4.0])
    report = load(tmp_path).report
    assert not any("see none of the points" in line for line in report)
    assert any("camera 7: the principal point is 6 4 in 48×32 pixels, far from the middle" in line for line in report)
    assert any("all 9 cameras stand at one place" in line for line in report)
    inverse = [replace(shot, viewmat=np.linalg.inv(shot.viewmat)) for shot in shots]
    write_colmap(tmp_path / "sparse" / "0", inverse)
    line = "9 of 9 cameras (im 001.png, …) see none of the points: with inverted poses they would: the file holds"
    assert any(line in said for said in load(tmp_path).report)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda pose: pose, None),
        (np.linalg.inv, "all 10 cameras stand at one place"),
        (lambda pose: pose @ np.diag([1, -1, -1, 1]), "all cameras look away from what they stand around"),
    ],
)
def test_poses_of_other_conventions_are_reported(tmp_path, change, says):
    write_transforms(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    for frame in frames:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    change_transforms(tmp_path, frames=frames)
    found = [line for line in load(tmp_path).report if "cameras look" in line or "one place" in line]
    assert [] == found if says is None else says in found[0]


def test_one_camera_far_away_does_not_make_the_others_look_inverted(tmp_path):
    write_transforms(tmp_path)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    frames[2]["transform_matrix"][0][3] += 5000.0
    change_transforms(tmp_path, frames=frames)
    report = load(tmp_path).report
    assert not any("cameras look" in line for line in report)
    assert any("the camera of images/0002.png stands 4,9" in line or "stands 5,0" in line for line in report)


def test_points_of_one_colour_get_those_of_the_images(tmp_path):
    write_colmap_set(tmp_path, text=True)
    file = tmp_path / "sparse" / "0" / "points3D.txt"
    file.write_text("1 0 0 0 0 0 0 1\n2 0.4 0.1 0.2 0 0 0 1\n")
    data = load(tmp_path)
    assert data.points_rgb is None
    assert "all points have the colour 0 0 0: splats start with the colours of the images there" in data.report
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
