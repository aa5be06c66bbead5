# SPDX-License-Identifier: Apache-2.0
"""Readers of data sets, on tiny sets.

Also: csplat_trainer.data.dataset, csplat_trainer.data.transforms.
"""

import json
from dataclasses import replace
from functools import partial
from random import Random

import numpy as np
import posed_sets as sets
import pytest
from PIL import Image, ImageFile
from posed_sets import H, W, assert_refused, cameras, names, report_of, sizes
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import relative_to
from csplat_trainer.data import load
from csplat_trainer.data.loader import point_outliers
from csplat_trainer.initial_splats import measure_extent

colmap_text = partial(sets.write_colmap_set, text=True)


@pytest.fixture
def ngp(tmp_path):
    return sets.write_transforms(tmp_path, missing=(4,))


def test_blender_sets_keep_their_split_and_their_transparency(blender_set):
    data = load(blender_set)
    assert (5, 0, 3) == sizes(data)
    assert data.name.startswith("Blender set")
    assert [f"test/r_{i}.png" for i in range(3)] == names(data.test)
    assert all(picture.has_alpha for picture in data.train)
    assert data.points is None
    for picture, camera in zip(data.train, cameras(5), strict=True):
        assert np.allclose(camera.viewmat, picture.camera.viewmat)
        assert np.allclose(camera.K, picture.camera.K)
        assert np.isclose(0.03 * np.sqrt(10.0), picture.camera.near)  # follows the distance of the cameras
    assert 0.011 == load(blender_set, near=0.011).train[0].camera.near
    sets.assert_dots_are_where_points_fall([*data.train, *data.test])
    text = (blender_set / "transforms_test.json").read_text()
    (blender_set / "transforms_val.json").write_text(text)
    assert (5, 3, 3) == sizes(load(blender_set))
    (blender_set / "transforms_val.json").write_text(text.replace("test", "val"))
    assert "transforms_val.json: 3 of 3 images are missing" in report_of(blender_set)
    (blender_set / "transforms_test.json").write_text('{"frames": []}')
    assert (5, 0, 0) == sizes(load(blender_set))
    data = load(sets.write_blender(blender_set, up=(0, -1, 0)))
    assert ("unspecified", (0, -1, 0)) == (data.coordinate_system, data.up)
    assert any("usually have other axes" in line for line in data.report)


def test_missing_images_are_reported_and_invalid_ones_refused(ngp):
    data, path = load(ngp), ngp / "images" / "0001.png"
    assert (7, ["images/0000.png", "images/0009.png"]) == (len(data.train), names(data.test))  # every eighth
    assert any("1 of 10 images are missing" in line and "images/0004.png" in line for line in data.report)
    sets.assert_dots_are_where_points_fall([*data.train, *data.test])
    assert 9 == len(load(ngp / "transforms.json", test_every=0, images="images").train)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=r"0001\.png is a PNG that is truncated: copy or export it again"):
        load(ngp).read()
    path.write_text("not a picture")
    assert_refused(r"0001\.png", ngp)
    for path in (ngp / "images").iterdir():
        path.unlink()
    assert_refused("none of its 10 images", ngp)


@pytest.mark.parametrize("text", [False, True])
def test_colmap_sets_have_points_and_colours(tmp_path, text):
    data = load(sets.write_colmap_set(tmp_path, text=text))
    assert (7, ["im 000.png", "im 008.png"]) == (len(data.train), names(data.test))
    assert data.name.startswith("COLMAP set")
    assert np.allclose(sets.POINTS, data.points)
    assert (sets.COLOURS / 255.0 == data.points_rgb).all()
    assert np.float32 == data.points.dtype == data.points_rgb.dtype
    for picture, camera in zip(data.train, cameras(9)[1:8], strict=True):
        assert np.allclose(camera.viewmat, picture.camera.viewmat)
    sets.assert_dots_are_where_points_fall([*data.train, *data.test])


def test_test_txt_names_the_test_images(colmap_set):
    for folder, text, split, line in (
        ("sparse/0", "im 002.png\nim 005.png\n", ["im 002.png", "im 005.png"], None),
        ("sparse/0", "im 002\n", ["im 002.png"], None),
        (".", "im 002.png\nother.png\n", ["im 002.png"], "names 2 test images, found 1; missing: other.png"),
        (".", "other.png\n", [], "names 1 test image, found 0; missing: other.png"),
    ):
        (colmap_set / folder / "test.txt").write_text(text)
        data = load(colmap_set)
        (colmap_set / folder / "test.txt").unlink()
        assert (9 - len(split), split) == (len(data.train), names(data.test))
        assert data.trained_on(data.background).test_every is None
        assert line is None or f"test.txt {line}" in data.report


@pytest.mark.slow
def test_transforms_json_or_lists_next_to_it_select_images(ngp):
    whole, document = sets.frames_of(ngp), (ngp / "transforms.json").read_text()
    rounded = [*whole[3]["transform_matrix"][:3], [0.0, -1e-17, 0.0, 1.0000001]]
    again = {"file_path": "images//0002.png", "transform_matrix": whole[2]["transform_matrix"]}
    bad = "1 frame without a finite pose, dropped: images/0003.png"

    def listed(**roles):
        return {f"{role}_filenames": [f"./images/{i:04}.png" for i in numbers] for role, numbers in roles.items()}

    def third(**fields):
        return {"frames": [*whole[:3], {**whole[3], **fields}, *whole[4:]]}

    cases = [  # a list's name or None, its text or fields of transforms.json, the split, and words of the report
        (None, listed(train=range(6), val=(6, 7)), (5, 2, 0), "transforms.json: 2 images on no list, dropped"),
        (None, listed(val=(6, 7)), (7, 2, 0), "transforms.json names 2 validation images"),
        (None, listed(test=(3, 4)), (8, 0, 1), "names 2 test images, found 1"),
        (None, listed(test=(6, 7), val=(7, 8)), (6, 1, 2), "lists, not used as validation images: images/0007.png"),
        (None, listed(train=range(10), val=(2,), test=(3,)), (7, 1, 1), "not used as training images: images/0002.png"),
        (None, listed(train=range(6), test=(4,)), (5, 0, 0), "names 1 test image, found 0"),
        (None, {"frames": whole[:8], "test_frames": whole[8:]}, (7, 0, 2), ""),
        (None, {"test_frames": []}, (9, 0, 0), ""),
        (None, {"test_frames": whole[:2]}, (9, 0, 2), "2 test images used for training, too"),
        (None, third(is_bad=True), (7, 0, 1), "transforms.json: 1 frame marked as bad, dropped: images/0003.png"),
        (None, third(transform_matrix=None), (7, 0, 1), bad),
        (None, third(transform_matrix=[[-np.inf] * 4] * 4), (7, 0, 1), bad),
        (None, third(transform_matrix=[[np.nan] * 4] * 3), (7, 0, 1), bad),
        (None, third(mask_path=""), (7, 0, 2), ""), (None, third(transform_matrix=rounded), (7, 0, 2), ""),
        (None, third(**again), (7, 0, 1), "1 frame repeated, read once: images//0002.png"),
        ("test.txt", "\"0003.png\"\n'0005.png'\n", (7, 0, 2), ""),
        ("test.txt", "# held out\nimages/0003.png, images/0005.png,\n", (7, 0, 2), ""),
        ("test_list.txt", "images\\0003.png\n", (8, 0, 1), ""), ("val.txt", "images/0003\n", (8, 1, 0), ""),
        ("train.txt", "images/0003.png\nimages/0005.png\n", (2, 0, 0), ""), ("train.txt", "other.png\n", (9, 0, 0), ""),
        ("train_test_lists.json", '{"train": ["images/0001.png"], "test": ["0003.png"]}', (1, 0, 1), ""),
    ]  # fmt: skip

    def check(case):
        name, change, split, words = case
        (ngp / "transforms.json").write_text(document)
        if name is None:
            sets.change_transforms(ngp, **change)
        else:
            (ngp / name).write_text(change)
        data = load(ngp)
        if name is not None:
            (ngp / name).unlink()
        assert split == sizes(data)
        assert any(words in line.replace("./", "") for line in data.report)
        assert data.test_every == (None if name or "frames" not in change or "test_frames" in change else 8)

    assert [] == failures({str(number): case for number, case in enumerate(cases)}, check)


XYZ = ("float x", "float y", "float z")


def write_points(path, columns, *rows):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property {one}" for one in columns)]
    path.write_text("\n".join([*lines, "end_header", *rows, ""]))


def test_points_are_read_from_ply_file_path_or_next_to_transforms_json(ngp):
    for name in ("sparse_pc.ply", "points3D.ply", "pointcloud.ply"):
        write_points(ngp / name, XYZ, "1 2 3")
        assert [[1.0, 2.0, 3.0]] == load(ngp).points.tolist()
        (ngp / name).unlink()
    rows = [f"{x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(sets.POINTS, sets.COLOURS, strict=True)]
    write_points(ngp / "cloud.ply", (*XYZ, "uchar red", "uchar green", "uchar blue"), *rows)
    sets.change_transforms(ngp, ply_file_path="cloud.ply")
    data = load(ngp)
    assert np.allclose(sets.POINTS, data.points)
    assert (sets.COLOURS / 255.0 == data.points_rgb).all()
    assert "points from cloud.ply" in data.report
    sets.change_transforms(ngp, ply_file_path="absent.ply")
    assert "ply_file_path absent.ply does not exist" in report_of(ngp)
    write_points(ngp / "absent.ply", ("float y",), "1")
    assert_refused(r"absent\.ply has columns y, expected x, y, z", ngp)


def test_transparent_pixels_do_not_bleed_and_points_are_read_if_there_are_none(blender_set):
    pixels = np.zeros((H, W, 4), np.uint8)
    pixels[:, : W // 2] = (200, 100, 50, 255)
    pixels[:, W // 2 :] = (0, 255, 0, 0)
    Image.fromarray(pixels).save(blender_set / "train" / "r_0.png")
    (blender_set / "transforms_test.json").unlink()
    write_points(blender_set / "points3d.ply", XYZ, "1 2 3")
    data = load(blender_set, (17, 11))
    small = data.train[0].pixels
    assert np.abs(small[small[..., 3] > 60][:, :3].astype(int) - (200, 100, 50)).max() <= 8
    assert any("no transforms_test.json" in line for line in data.report)
    assert any("points3d.ply is ignored" in line for line in data.report)
    for path in blender_set.glob("t*/*.png"):
        Image.new("RGB", (W, H)).save(path)
    assert [[1.0, 2.0, 3.0]] == load(blender_set).points.tolist()


def test_points_of_colmap_may_be_absent_or_a_ply(colmap_set):
    model = colmap_set / "sparse" / "0"
    (model / "points3D.bin").unlink()
    assert "there are no points: splats start anywhere" in report_of(colmap_set)
    (model / "points3D.txt").write_text("# 3D point list with one line of data per point:\n")
    assert "there are no points: splats start anywhere" in report_of(colmap_set)
    (model / "points3D.txt").unlink()
    write_points(model / "points3D.ply", ("double x", "double y", "double z"), "1 2 3")
    data = load(colmap_set)
    assert [[1.0, 2.0, 3.0]] == data.points.tolist()
    assert data.points_rgb is None


def test_images_of_a_model_may_lack_keypoints_and_be_listed_twice_with_one_pose(colmap_text_set):
    file = colmap_text_set / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    poses, note = [line for line in lines if "png" in line], "without a line of keypoints"
    for rows, words in (
        (poses, note), ([line for line in lines if line.strip()], note), ([f"{line}\r" for line in lines], None),
        ([*lines, poses[3]], "images.txt: 1 image twice: read once"),
    ):  # fmt: skip
        file.write_text("\n".join(rows), newline="")
        data = load(colmap_text_set)
        assert (7, 0, 2) == sizes(data)
        report = "\n".join(data.report)
        assert note not in report if words is None else words in report
    for rows, message in (
        ([poses[0], "1 2 3", "4 5 6", *poses[1:]], "line 3: these are keypoints"),
        ([line.replace("im 003", "im 001") for line in lines], r"im 001\.png occurs twice, with different poses"),
    ):
        file.write_text("\n".join(rows))
        assert_refused(message, colmap_text_set)


def test_intrinsics_of_other_programs_are_read(ngp):
    document = json.loads((ngp / "transforms.json").read_text())
    matrix = [[60.0, 0, 25.0, 0], [0, 61.0, 17.0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    sets.change_frames(ngp, range(10), intrinsic_matrix=matrix)
    assert [[60.0, 0, 25.0], [0, 61.0, 17.0], [0, 0, 1]] == load(ngp).train[0].camera.K.tolist()
    sets.change_frames(ngp, range(10), distortion_params=[0.1, 0, 0, 0, 0, 0])
    assert "lens distortion is undone" in report_of(ngp)
    focal = document.pop("fl_x")
    del document["fl_y"]
    (ngp / "transforms.json").write_text(json.dumps({**document, "x_fov": 50.0}))
    assert np.isclose(focal, load(ngp).train[0].camera.K[0, 0])
    sets.change_transforms(ngp, camera_angle_x=0.5)
    sets.change_frames(ngp, range(10), fl_x=77.0, fl_y=77.0)  # overrides what the document states for all
    assert {77.0} == {picture.camera.K[0, 0] for picture in load(ngp).train}


def test_binary_and_text_files_that_differ_are_reported(colmap_set):
    model, line = colmap_set / "sparse" / "0", "cameras.txt has other cameras than cameras.bin, which is read"
    (model / "cameras.txt").write_text("  # comment\n7 PINHOLE 48 32 51.47 51.47 24 16\n")
    assert line not in report_of(colmap_set)
    (model / "cameras.txt").write_text("7 PINHOLE 48 32 99 99 24 16\n")
    assert line in report_of(colmap_set)
    sets.write_colmap(colmap_set / "away", cameras(9), text=True)
    (colmap_set / "away" / "images.txt").rename(model / "images.txt")
    sets.write_colmap(model, cameras(3))
    assert "images.txt has 9 images, images.bin 3: images.bin is read" in report_of(colmap_set)
    for name in ("cameras", "images"):  # without a binary file, the text is read
        (model / f"{name}.bin").write_bytes(b"")
    assert (7, 0, 2) == sizes(load(colmap_set))


def test_models_are_found_in_several_folders_and_the_largest_is_read(colmap_set):
    last = colmap_set / "sparse" / "0"
    for folder in ("sparse", "sparse/model", "colmap/sparse/0", "distorted/sparse/0", ".", "sparse/10"):
        (colmap_set / folder).mkdir(parents=True, exist_ok=True)
        for name in ("cameras.bin", "images.bin", "points3D.bin"):
            (last / name).rename(colmap_set / folder / name)
        last = colmap_set / folder
        assert 7 == len(load(colmap_set).train)
    sets.write_colmap(colmap_set / "colmap" / "sparse" / "0", cameras(4))
    sets.write_colmap(colmap_set / "sparse", cameras(2), text=True)
    sets.write_colmap(colmap_set / "sparse" / "1", cameras(9))
    (colmap_set / "sparse" / "1" / "images.bin").write_bytes(b"")
    others = "sparse/1 has a damaged list of images, sparse has 2, colmap/sparse/0 has 4"
    assert f"there are 4 models: sparse/10 is read, with 9 images; {others}" in report_of(colmap_set)


def test_names_may_contain_separators_and_keypoints_may_be_nan(colmap_set):
    unusual = {2: "im  002.png", 3: "a,3.png", 4: "#4.png", 5: "'5'.png", 7: "7 8 0"}
    sets.rename_in_images_txt(colmap_set, lambda i: unusual.get(i, f"im {i:03}.png"))
    for i, name in unusual.items():
        (colmap_set / "images" / f"im {i:03}.png").rename(colmap_set / "images" / name)
    file = colmap_set / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace("1.5 2.5 -1", "nan nan -1"))
    (colmap_set / "Test.txt").write_text("a,3.png\n#4.png\n'5'.png\n./im 006.png\nim 006.png\n")
    data = load(colmap_set)
    assert ["a,3.png", "#4.png", "'5'.png", "im 006.png"] == names(data.test)
    assert {"im  002.png", "7 8 0"} <= {*names(data.train)}


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-32"])
def test_text_files_may_begin_with_a_byte_order_mark(colmap_text_set, encoding):
    for file in (colmap_text_set / "sparse" / "0").iterdir():
        file.write_text(file.read_text(), encoding)
    (colmap_text_set / "test.txt").write_text("im 002.png\r\nim 005.png\r\n", encoding)
    data = load(colmap_text_set)
    assert (["im 002.png", "im 005.png"], 3) == (names(data.test), len(data.points))
    document = sets.write_transforms(colmap_text_set) / "transforms.json"
    document.write_text(document.read_text(), encoding)
    assert 10 == len(load(document, test_every=0).train)


@pytest.mark.slow
def test_the_smallest_sufficient_folder_of_images_is_read(tmp_path):
    shots = cameras(9, 96, 64)
    for scale, folder in ((1, "images"), (2, "images_2"), (4, "images_4")):
        for i, camera in enumerate(shots):
            sets.write_picture(tmp_path / folder / f"im {i:03}.png", camera, scale=scale)
    sets.write_colmap(tmp_path / "sparse" / "0", shots, width=96, height=64)
    for size, folder in (
        (None, "images"), ((48, 32), "images_2"), ((40, 30), "images_2"), ((96, 64), "images"), ((12, 8), "images_4"),
    ):  # fmt: skip
        data, wanted = load(tmp_path, size), size or (96, 64)
        assert f"image folder: {folder}" in data.report
        assert wanted == (data.train[0].camera.W, data.train[0].camera.H) == data.train[0].pixels.shape[1::-1]
        assert np.allclose(np.diag([wanted[0] / 96, wanted[1] / 64, 1]) @ shots[0].K, data.train[0].camera.K)
    named = load(tmp_path, images="images_4")
    assert (24, 16) == (named.train[0].camera.W, named.train[0].camera.H)
    sets.assert_dots_are_where_points_fall([*load(tmp_path, (48, 32)).train, *named.train])
    assert_refused("images_8", tmp_path, images="images_8")


def test_a_folder_of_images_may_be_given_for_its_set(tmp_path, monkeypatch):
    sets.write_colmap_set(tmp_path / "garden")
    (tmp_path / "garden" / "small").mkdir()
    (tmp_path / "garden" / "small" / "images_2").symlink_to(tmp_path / "garden" / "images")
    monkeypatch.chdir(tmp_path)
    for path, images in (("garden/images", "images"), ("garden/small/images_2", "small/images_2"), ("garden", None)):
        data = load(path)
        assert (images, "COLMAP set garden") == (data.images, data.name)
        assert f"image folder: {images or 'images'}" in data.report
    assert_refused(r"garden/images_4 is neither a folder .*; garden has images, small", "garden/images_4")
    assert_refused(r"garden/sparse is not a data set: .* or a folder of images of such a set", "garden/sparse")
    (tmp_path / "garden" / "images" / "transforms.json").write_text("{}")  # a set of its own
    assert_refused("lists no frames", "garden/images")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "at"),
    [
        (sets.write_colmap_set, (-2.7e6, -4.3e6, 3.85e6)), (colmap_text, (0.0, 0.0, 9000.0)),
        (sets.write_transforms, (500123.25, 4649876.5, 214.75)),
    ],
    ids=["ECEF", "one axis", "UTM"],
)  # fmt: skip
def test_a_set_far_from_0_gets_an_origin(tmp_path, write, at):
    beside = np.array((20.0, -30.0, 10.0))
    near, far = load(write(tmp_path / "near", at=beside)), load(write(tmp_path / "far", at=at))
    assert (0.0, 0.0, 0.0) == near.origin
    assert any("coordinates are far from 0" in line for line in far.report)
    assert np.abs(np.subtract(at, far.origin)).max() < 4.0
    assert all(float(value).is_integer() for value in far.origin)
    for one, other in zip((*near.train, *near.test), (*far.train, *far.test), strict=True):
        assert np.allclose(one.camera.position + at - beside - far.origin, other.camera.position, atol=1e-6)
        assert near.train[0].camera.near == pytest.approx(other.camera.near)
    sets.assert_dots_are_where_points_fall([*far.train, *far.test], sets.POINTS + at - far.origin)
    if near.points is not None:
        assert np.array_equal((sets.POINTS + beside).astype(np.float32), near.points)
        assert np.allclose(sets.POINTS + at, far.points + np.array(far.origin), atol=1e-6)
        assert np.float32 == far.points.dtype


def test_outlier_cameras_are_reported_and_ignored_and_refused_beyond_float32(colmap_set):
    usual = load(colmap_set).train[0].camera.near
    assert "usual distance" not in report_of(colmap_set)
    for moved, words in (
        ([3], "the camera of im 003.png is"), ([3, 5], "the cameras of im 003.png, im 005.png are"),
        ([8], "1 test image will score badly"),
    ):  # fmt: skip
        shots = cameras(9)
        for i in moved:
            shots[i] = relative_to((3000.0, -4000.0 - 100 * i, 0.0), shots[i])
        sets.write_colmap(colmap_set / "sparse" / "0", shots)
        data = load(colmap_set)
        assert (7, 0, 2) == sizes(data)
        assert [words in line for line in data.report if "times the usual distance" in line] == [True]
        assert usual == pytest.approx(data.train[0].camera.near, rel=0.05)
        assert measure_extent(data.inliers).extent < 5.0
        assert (0.0, 0.0, 0.0) == data.origin
    shots[3] = relative_to((1e39, 0.0, 0.0), cameras(9)[3])
    sets.write_colmap(colmap_set / "sparse" / "0", shots)
    assert_refused(r"camera of im 003.png is .* units from 0", colmap_set)


def test_outlier_points_are_reported_and_left_out(tmp_path):
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near, none = directions * rng.random((1000, 1)) ** (1 / 3), directions[:0]
    background = directions[:100] * 10.0 ** np.linspace(0.0, 1.5, 100)[:, None]
    cases = {
        **{
            f"{count} at {distance:g} radii": (near, directions[:count] * distance)
            for count in (1, 10, 50)
            for distance in (10.0, 1e3, 1e6, 1e300)
        },
        "50 at 10 to a million radii": (near, directions[:50] * 10.0 ** np.linspace(1.0, 6.0, 50)[:, None]),
        "a background that thins out": (np.concatenate([near, background]), none),
        "a dome": (np.concatenate([near, directions[:300] * 60.0]), none),
        "one place": (np.concatenate([np.zeros((40, 3)), np.ones((2, 3))]), none),
        "no points": (none, none),
    }

    def check(case):
        expected = np.repeat([False, True], [len(part) for part in case])
        assert np.array_equal(expected, point_outliers(np.concatenate(case)))

    assert [] == failures(cases, check)
    place = colmap_text(tmp_path)
    file = place / "sparse" / "0" / "points3D.txt"
    rows = [f"{i} {' '.join(map(str, point))} 1 2 3 0.5 1 0 2 0\n" for i, point in enumerate(near.tolist())]
    file.write_text("".join(rows))
    clean = load(place)
    file.write_text("".join([*(f"{i} 5000 {i} 7 9 9 9 0.5 1 0 2 0\n" for i in range(10)), *rows]))
    data = load(place)
    assert np.array_equal(clean.points, data.points)
    assert np.array_equal(clean.points_rgb, data.points_rgb)
    assert not any("left out" in line for line in clean.report)
    assert [line for line in data.report if line.startswith("10 of 1,010 points are at least 5,000 units")]


@pytest.mark.slow
@pytest.mark.parametrize("write", [sets.write_blender, sets.write_transforms, sets.write_colmap_set])
@pytest.mark.parametrize("size", [None, (24, 16)])
def test_images_are_decoded_lazily(tmp_path, monkeypatch, write, size):
    decoded, decode, is_blender = set(), ImageFile.ImageFile.load, write is sets.write_blender
    write(tmp_path)
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda file: decoded.add(file.filename) or decode(file))
    data, wanted = load(tmp_path, size), (size or (W, H))[::-1]
    assert is_blender == len(decoded)  # one image shows that there is transparency
    assert all(picture.has_alpha == is_blender for picture in (*data.train, *data.test))
    assert (float(is_blender),) * 3 == data.background
    decoded.clear()
    assert wanted == data.test[0].pixels.shape[:2]
    assert wanted == replace(data.test[0], camera=data.test[0].camera).pixels.shape[:2]
    assert 1 == len(decoded)  # an image with another camera shares the pixels
    data.read()
    assert len(data.train) + len(data.test) == len(decoded)


@pytest.mark.parametrize(("size", "sides"), [(None, (W, H)), ((24, 16), (W, H)), (None, (2 * W, 2 * H))])
def test_a_mask_excludes_pixels(transforms_set, size, sides):
    values = np.full(sides[::-1], 255, np.uint8)
    values[:, : sides[0] // 3] = 0
    Image.fromarray(values).save(transforms_set / "mask.png")
    sets.change_frames(transforms_set, [1], mask_path="mask.png")
    data, (width, height) = load(transforms_set, size), size or (W, H)
    assert "masks hide parts of 1 image, which do not count" in data.report
    first, *others = data.train
    assert (width // 3) * height == (~first.mask).sum()
    assert not first.mask[:, : width // 3].any()
    assert all(picture.mask is None for picture in (*others, *data.test))


def test_opaque_alpha_is_ignored(ngp):
    for number in (1, 2, 3):
        with Image.open(ngp / "images" / f"000{number}.png") as image:
            image.convert("RGBA").save(ngp / "images" / f"000{number}.png")
    data = load(ngp)
    assert (0.0, 0.0, 0.0) == data.background
    assert not any(picture.has_alpha for picture in data.train)
    assert (H, W, 3) == data.train[0].pixels.shape
    assert "alpha is 1 everywhere in 3 images: it is ignored" in data.report
    Image.new("RGBA", (W, H)).save(ngp / "images" / "0005.png")
    data = load(ngp)
    assert 4 == sum(picture.has_alpha for picture in (*data.train, *data.test))
    assert (0.0, 0.0, 0.0) == data.background
    assert "4 of 9 images have transparency: the background of all is black" in data.report


@pytest.mark.slow
def test_a_set_records_its_options(tmp_path):
    black, white = {"background": [0.0] * 3}, {"background": [1.0] * 3}
    for number, (write, options, expected) in enumerate((
        (sets.write_blender, {"test_every": 5}, white),
        (sets.write_transforms, {}, {**black, "test_every": 8}),
        (sets.write_transforms, {"test_every": 0}, {**black, "test_every": 0}),
        (sets.write_colmap_set, {"test_every": 5, "images": "images"}, {**black, "test_every": 5, "images": "images"}),
        (colmap_text, {"size": (24, 16), "near": 0.04}, {**black, "size": [24, 16], "near": 0.04, "test_every": 8}),
    )):  # fmt: skip
        data, is_blender = load(write(tmp_path / str(number)), **options), write is sets.write_blender
        record = data.trained_on(data.background).as_json()
        assert expected == {name: record[name] for name in record if name in expected or name != "near"}
        assert "near" in record
        assert ("RFU" if is_blender else "unspecified", (0, 0, 1)) == (data.coordinate_system, data.up)
        assert data.up_is_estimated != is_blender
        assert any("up is 0 0 1 by the cameras" in line for line in data.report) != is_blender


@pytest.mark.slow
@pytest.mark.parametrize("write", [sets.write_blender, sets.write_transforms, sets.write_colmap_set, colmap_text])
def test_a_damaged_set_is_read_or_refused(tmp_path, write):
    write(tmp_path)
    (tmp_path / "test.txt").write_text("im 002.png\n0003.png\n")
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".png")
    rng = Random(0)  # noqa: S311 - no secrets are drawn
    for _ in range(20):
        file = rng.choice(files)
        data = file.read_bytes()
        file.write_bytes(damaged(data, rng))
        try:
            lines = load(tmp_path).report
        except InputError as error:
            lines = (str(error),)
        assert all("\n" not in line for line in lines)
        file.write_bytes(data)


def damaged(data, rng):
    """Insert, or replace bytes by, words that are special to readers or random."""
    words = (b"nan", b"-nan(ind)", b"1e400", b"null", b"[]", b"..", b"\\", b"\xff", b"\0", b"\n", b"#", b"9" * 12, b'"')
    at, removed = rng.randrange(len(data) + 1), rng.choice((0, 1, 4, 8, 40, 10**6))
    return data[:at] + rng.choice((*words, b"", rng.randbytes(8))) + data[at + removed :]
