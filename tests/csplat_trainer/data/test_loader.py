"""Readers of data sets, on tiny sets and on the shared ones."""

import json
from dataclasses import replace
from functools import partial
from random import Random

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFile
from posed_sets import (
    COLOURS,
    POINTS,
    H,
    W,
    assert_dots_are_where_points_fall,
    cameras,
    change_frames,
    change_transforms,
    frames_of,
    rename_in_images_txt,
    to_opengl,
    write_blender,
    write_colmap,
    write_colmap_set,
    write_picture,
    write_transforms,
)
from tables import failures

from csplat.errors import InputError
from csplat_render.camera import relative_to
from csplat_trainer.data import load
from csplat_trainer.initial_splats import measure_extent

pytest.importorskip("numba", reason="requires the extra [render]")


@pytest.fixture
def blender(tmp_path):
    write_blender(tmp_path)
    return tmp_path


@pytest.fixture
def ngp(tmp_path):
    write_transforms(tmp_path, missing=(4,))
    return tmp_path


@pytest.fixture
def colmap_set(tmp_path):
    write_colmap_set(tmp_path)
    return tmp_path


@pytest.fixture(params=["binary", "text"])
def colmap(tmp_path, request):
    write_colmap_set(tmp_path, text=request.param == "text")
    return tmp_path


def counts(data):
    return len(data.train), len(data.val), len(data.test)


def names(pictures):
    return [picture.camera.image for picture in pictures]


def test_blender_sets_keep_their_split_and_their_transparency(blender):
    data = load(blender)
    assert (5, 0, 3) == counts(data)
    assert data.name.startswith("Blender set")
    assert [f"test/r_{i}.png" for i in range(3)] == names(data.test)
    assert all(picture.has_alpha for picture in data.train)
    assert data.points is None
    for picture, camera in zip(data.train, cameras(5), strict=True):
        assert np.allclose(camera.viewmat, picture.camera.viewmat)
        assert np.allclose(camera.K, picture.camera.K)
    assert_dots_are_where_points_fall([*data.train, *data.test])
    (blender / "transforms_test.json").write_text('{"frames": []}')
    assert (5, 0, 0) == counts(load(blender))


def test_validation_images_may_be_missing(blender):
    document = json.loads((blender / "transforms_test.json").read_text())
    (blender / "transforms_val.json").write_text(json.dumps(document))
    assert 3 == len(load(blender).val)
    (blender / "transforms_val.json").write_text(json.dumps(document).replace("test", "val"))
    data = load(blender)
    assert (5, 0, 3) == counts(data)
    assert any("transforms_val.json: 3 of 3 images are missing" in line for line in data.report)


def test_missing_images_are_reported_and_every_eighth_is_a_test_image(ngp):
    data = load(ngp)
    assert (7, ["images/0000.png", "images/0009.png"]) == (len(data.train), names(data.test))
    assert any("1 of 10 images are missing" in line and "images/0004.png" in line for line in data.report)
    assert_dots_are_where_points_fall([*data.train, *data.test])
    assert len(load(ngp / "transforms.json", test_every=0).train) == 9


def test_colmap_sets_have_points_and_colours(colmap):
    data = load(colmap)
    assert (7, ["im 000.png", "im 008.png"]) == (len(data.train), names(data.test))
    assert data.name.startswith("COLMAP set")
    assert np.allclose(POINTS, data.points)
    assert (COLOURS / 255.0 == data.points_rgb).all()
    assert np.float32 == data.points.dtype == data.points_rgb.dtype
    for picture, camera in zip(data.train, cameras(9)[1:8], strict=True):
        assert np.allclose(camera.viewmat, picture.camera.viewmat)
    assert_dots_are_where_points_fall([*data.train, *data.test])


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


def test_images_of_one_name_in_two_folders_are_distinguished(colmap_set):
    for number in range(4):
        for camera in "ab":
            file = colmap_set / "images" / camera / f"{number}.png"
            file.parent.mkdir(exist_ok=True)
            (colmap_set / "images" / f"im 00{number + 4 * (camera == 'b')}.png").rename(file)
    rename_in_images_txt(colmap_set, lambda i: f"{'ab'[i // 4]}/{i % 4}.png" if i < 8 else "im 008.png")
    (colmap_set / "test.txt").write_text("b/1.png\n")
    data = load(colmap_set)
    assert (8, ["b/1.png"]) == (len(data.train), names(data.test))
    assert_dots_are_where_points_fall([*data.train, *data.test])
    (colmap_set / "test.txt").write_text("1.png\n")
    with pytest.raises(InputError, match=r"test\.txt: 1\.png matches 2 files: a/1\.png, b/1\.png"):
        load(colmap_set)


def test_transforms_json_may_list_its_split(ngp):
    whole, document = frames_of(ngp), (ngp / "transforms.json").read_text()
    cases = [
        ({"train": range(6), "val": (6, 7)}, (5, 2, 0), "transforms.json: 2 images on no list, dropped"),
        ({"val": (6, 7)}, (7, 2, 0), "transforms.json names 2 validation images"),
        ({"test": (3, 4)}, (8, 0, 1), "names 2 test images, found 1"),
        ({"test": (6, 7), "val": (7, 8)}, (6, 1, 2), "several lists, not used as validation images: images/0007.png"),
        ({"train": range(10), "val": (2,), "test": (3,)}, (7, 1, 1), "not used as training images: images/0002.png"),
        ({"train": range(6), "test": (4,)}, (5, 0, 0), "names 1 test image, found 0"),
        ({"frames": whole[:8], "test_frames": whole[8:]}, (7, 0, 2), ""), ({"test_frames": []}, (9, 0, 0), ""),
        ({"test_frames": whole[:2]}, (9, 0, 2), "2 test images used for training, too"),
    ]  # fmt: skip

    def check(case):
        change, split, message = case
        (ngp / "transforms.json").write_text(document)
        roles = [role for role in ("train", "val", "test") if role in change]
        named = {f"{role}_filenames": [f"./images/{i:04}.png" for i in change[role]] for role in roles}
        change_transforms(ngp, **(named or change))
        data = load(ngp)
        assert split == counts(data)
        assert any(message in line.replace("./", "") for line in data.report)
        assert data.test_every is None

    assert [] == failures(dict(enumerate(cases)), check)


def write_points(path, columns, *rows):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property {one}" for one in columns)]
    path.write_text("\n".join([*lines, "end_header", *rows, ""]))


def test_points_are_read_from_ply_file_path(ngp):
    rows = [f"{x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(POINTS, COLOURS, strict=True)]
    columns = ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")
    write_points(ngp / "cloud.ply", columns, *rows)
    change_transforms(ngp, ply_file_path="cloud.ply")
    data = load(ngp)
    assert np.allclose(POINTS, data.points)
    assert (COLOURS / 255.0 == data.points_rgb).all()
    assert "points from cloud.ply" in data.report
    change_transforms(ngp, ply_file_path="absent.ply")
    assert any("ply_file_path absent.ply does not exist" in line for line in load(ngp).report)
    write_points(ngp / "absent.ply", ("float y",), "1")
    with pytest.raises(InputError, match=r"absent\.ply has columns y, expected x, y, z"):
        load(ngp)


def test_points_of_a_blender_set_are_read_if_nothing_is_transparent(blender):
    write_points(blender / "points3d.ply", ("float x", "float y", "float z"), "1 2 3")
    data = load(blender)
    assert data.points is None
    assert any("points3d.ply is ignored" in line for line in data.report)
    for path in blender.glob("t*/*.png"):
        Image.new("RGB", (W, H)).save(path)
    assert [[1.0, 2.0, 3.0]] == load(blender).points.tolist()


@pytest.mark.parametrize("name", ["sparse_pc.ply", "points3D.ply", "pointcloud.ply"])
def test_points_next_to_transforms_json_are_read(ngp, name):
    write_points(ngp / name, ("float x", "float y", "float z"), "1 2 3")
    assert [[1.0, 2.0, 3.0]] == load(ngp).points.tolist()


def test_points_of_colmap_may_be_absent_or_a_ply(colmap_set):
    model = colmap_set / "sparse" / "0"
    (model / "points3D.bin").unlink()
    for text in (None, "# 3D point list with one line of data per point:\n"):
        if text is not None:
            (model / "points3D.txt").write_text(text)
        data = load(colmap_set)
        assert data.points is None or 0 == len(data.points)
        assert any("there are no points: splats start anywhere" in line for line in data.report)
    (model / "points3D.txt").unlink()
    write_points(model / "points3D.ply", ("double x", "double y", "double z"), "1 2 3")
    data = load(colmap_set)
    assert [[1.0, 2.0, 3.0]] == data.points.tolist()
    assert data.points_rgb is None


def test_lines_of_keypoints_may_be_absent(tmp_path):
    write_colmap_set(tmp_path, text=True)
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    poses = [line for line in lines if "png" in line]
    for text, reported in (
        (poses, True), ([line for line in lines if line.strip()], True), ([f"{line}\r" for line in lines], False),
    ):  # fmt: skip
        file.write_text("\n".join(text), newline="")
        data = load(tmp_path)
        assert (7, 0, 2) == counts(data)
        assert reported == ("without a line of keypoints" in " ".join(data.report))
    file.write_text("\n".join([poses[0], "1 2 3", "4 5 6", *poses[1:]]))
    with pytest.raises(InputError, match="line 3: these are keypoints"):
        load(tmp_path)


def test_a_duplicated_image_of_a_model_is_refused(colmap_set):
    rename_in_images_txt(colmap_set, lambda i: f"im 00{max(i, 1)}.png")
    with pytest.raises(InputError, match=r"im 001\.png occurs twice, with different poses"):
        load(colmap_set)
    file = colmap_set / "sparse" / "0" / "images.txt"
    rename_in_images_txt(colmap_set, "im {:03}.png".format)
    file.write_text(file.read_text() + next(line for line in file.read_text().splitlines() if "im 003" in line))
    data = load(colmap_set)
    assert (7, 0, 2) == counts(data)
    assert "images.txt: 1 image twice: read once" in data.report


def test_frames_that_cannot_be_used_are_left_out(ngp):
    frames, bad = frames_of(ngp), "1 frame without a finite pose, dropped: images/0003.png"
    rounded = [*frames[3]["transform_matrix"][:3], [0.0, -1e-17, 0.0, 1.0000001]]
    cases = {
        "bad": ({"is_bad": True}, "1 frame marked as bad, dropped: images/0003.png"),
        "no pose": ({"transform_matrix": None}, bad),
        "infinite": ({"transform_matrix": [[-np.inf] * 4] * 4}, bad),
        "nan": ({"transform_matrix": [[np.nan] * 4] * 3}, bad),
        "no mask": ({"mask_path": ""}, None),
        "rounded last row": ({"transform_matrix": rounded}, None),
        "duplicate": ({"file_path": "./images//0002.png", "transform_matrix": frames[2]["transform_matrix"]},
                      "1 frame repeated, read once: ./images//0002.png"),
    }  # fmt: skip

    def check(case):
        change, line = case
        change_transforms(ngp, frames=frames)
        change_frames(ngp, [3], **change)
        data = load(ngp, test_every=0)
        assert (9 if line is None else 8) == len(data.train)
        assert line is None or f"transforms.json: {line}" in data.report

    assert [] == failures(cases, check)


def test_intrinsics_of_other_programs_are_read(ngp):
    document = json.loads((ngp / "transforms.json").read_text())
    matrix = [[60.0, 0, 25.0, 0], [0, 61.0, 17.0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    change_frames(ngp, range(10), intrinsic_matrix=matrix)
    assert [[60.0, 0, 25.0], [0, 61.0, 17.0], [0, 0, 1]] == load(ngp).train[0].camera.K.tolist()
    change_frames(ngp, range(10), distortion_params=[0.1, 0, 0, 0, 0, 0])
    assert any("lens distortion is undone" in line for line in load(ngp).report)
    bare = {name: value for name, value in document.items() if name not in ("fl_x", "fl_y")}
    (ngp / "transforms.json").write_text(json.dumps({**bare, "x_fov": 50.0}))
    assert np.isclose(document["fl_x"], load(ngp).train[0].camera.K[0, 0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text", "split"),
    [
        ("test.txt", "\"0003.png\"\n'0005.png'\n", (7, 0, 2)),
        ("test.txt", "# held out\nimages/0003.png, images/0005.png,\n", (7, 0, 2)),
        ("test_list.txt", "images\\0003.png\n", (8, 0, 1)), ("val.txt", "images/0003\n", (8, 1, 0)),
        ("train.txt", "images/0003.png\nimages/0005.png\n", (2, 0, 0)), ("train.txt", "other.png\n", (9, 0, 0)),
        ("train_test_lists.json", '{"train": ["images/0001.png"], "test": ["0003.png"]}', (1, 0, 1)),
    ],
)  # fmt: skip
def test_lists_of_images_may_be_next_to_transforms_json(ngp, name, text, split):
    (ngp / name).write_text(text)
    data = load(ngp)
    assert split == counts(data)


def test_binary_and_text_files_that_differ_are_reported(colmap_set):
    model = colmap_set / "sparse" / "0"
    for text, message in (("PINHOLE 48 32 51.47 51.47 24 16", False), ("PINHOLE 48 32 99 99 24 16", True)):
        (model / "cameras.txt").write_text(f"  # comment\n7 {text}\n")
        report = load(colmap_set).report
        assert message == ("cameras.txt has other cameras than cameras.bin, which is read" in report), report
    write_colmap(colmap_set / "away", cameras(9), text=True)
    (colmap_set / "away" / "images.txt").rename(model / "images.txt")
    write_colmap(model, cameras(3))
    assert "images.txt has 9 images, images.bin 3: images.bin is read" in load(colmap_set).report


def test_the_largest_model_of_several_folders_is_read(colmap_set):
    (colmap_set / "sparse" / "0").rename(colmap_set / "sparse" / "10")
    write_colmap(colmap_set / "colmap" / "sparse" / "0", cameras(4))
    write_colmap(colmap_set / "sparse", cameras(2), text=True)
    write_colmap(colmap_set / "sparse" / "1", cameras(9))
    (colmap_set / "sparse" / "1" / "images.bin").write_bytes(b"")
    data = load(colmap_set)
    assert (7, 0, 2) == counts(data)
    others = "sparse/1 has a damaged list of images, sparse has 2, colmap/sparse/0 has 4"
    assert f"there are 4 models: sparse/10 is read, with 9 images; {others}" in data.report


def test_names_in_lists_may_contain_separators(colmap_set):
    unusual = {3: "a,3.png", 4: "#4.png", 5: "'5'.png"}
    rename_in_images_txt(colmap_set, lambda i: unusual.get(i, f"im {i:03}.png"))
    for i, name in unusual.items():
        (colmap_set / "images" / f"im {i:03}.png").rename(colmap_set / "images" / name)
    (colmap_set / "Test.txt").write_text("a,3.png\n#4.png\n'5'.png\n./im 006.png\nim 006.png\n")
    data = load(colmap_set)
    assert [*unusual.values(), "im 006.png"] == names(data.test)


def test_names_may_be_numbers_and_keypoints_may_be_nan(tmp_path):
    write_colmap_set(tmp_path, text=True)
    rename_in_images_txt(tmp_path, lambda i: "7 8 0" if i == 3 else f"im {i:03}.png")
    (tmp_path / "images" / "im 003.png").rename(tmp_path / "images" / "7 8 0")
    file = tmp_path / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace("1.5 2.5 -1", "nan nan -1"))
    assert 9 == len(load(tmp_path, test_every=0).train)


def test_text_replaces_an_empty_binary_file_of_a_model(colmap_set):
    write_colmap(colmap_set / "sparse" / "0", cameras(9), text=True)
    (colmap_set / "sparse" / "0" / "cameras.bin").write_bytes(b"")
    assert 7 == len(load(colmap_set).train)


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-32"])
def test_text_files_may_begin_with_a_byte_order_mark(tmp_path, encoding):
    write_colmap_set(tmp_path, text=True)
    for name in ("cameras", "images", "points3D"):
        file = tmp_path / "sparse" / "0" / f"{name}.txt"
        file.write_text(file.read_text(), encoding)
    (tmp_path / "test.txt").write_text("im 002.png\r\nim 005.png\r\n", encoding)
    data = load(tmp_path)
    assert ["im 002.png", "im 005.png"] == names(data.test)
    assert 3 == len(data.points)
    write_transforms(tmp_path)
    document = tmp_path / "transforms.json"
    document.write_text(document.read_text(), encoding)
    assert 10 == len(load(document, test_every=0).train)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("im 002.png\nK\xf6ln.png".encode("cp1252"), r"K\\xf6ln\.png is no image in any code page"),
        ("im 002.png".encode("utf-16-le"), "byte 1 is 0"), (bytes(range(256)), "is not a text file in UTF-8"),
    ],
)  # fmt: skip
def test_text_in_another_encoding_is_refused(colmap_set, data, message):
    (colmap_set / "test.txt").write_bytes(data)
    with pytest.raises(InputError, match=message):
        load(colmap_set)


@pytest.mark.slow
def test_the_smallest_sufficient_folder_of_images_is_read(tmp_path):
    shots = cameras(9, 96, 64)
    for scale, folder in ((1, "images"), (2, "images_2"), (4, "images_4")):
        for i, camera in enumerate(shots):
            write_picture(tmp_path / folder / f"im {i:03}.png", camera, scale=scale)
    write_colmap(tmp_path / "sparse" / "0", shots, width=96, height=64)
    for size, folder in (
        (None, "images"), ((48, 32), "images_2"), ((40, 30), "images_2"), ((96, 64), "images"), ((12, 8), "images_4"),
    ):  # fmt: skip
        data, wanted = load(tmp_path, size), size or (96, 64)
        assert f"images from {folder}" in data.report
        camera = data.train[0].camera
        assert wanted == (camera.W, camera.H) == data.train[0].pixels.shape[1::-1]
        assert np.allclose(np.diag([wanted[0] / 96, wanted[1] / 64, 1]) @ shots[0].K, camera.K)
    assert_dots_are_where_points_fall(load(tmp_path, (48, 32)).train)
    named = load(tmp_path, images="images_4")
    assert (24, 16) == (named.train[0].camera.W, named.train[0].camera.H)
    assert_dots_are_where_points_fall(named.train)
    with pytest.raises(InputError, match="images_8"):
        load(tmp_path, images="images_8")


def test_a_folder_of_images_may_be_given_for_its_set(tmp_path, monkeypatch):
    shots = cameras(9)
    for folder in ("images", "small/images_2"):
        for i, camera in enumerate(shots):
            write_picture(tmp_path / "garden" / folder / f"im {i:03}.png", camera)
    write_colmap(tmp_path / "garden" / "sparse" / "0", shots)
    monkeypatch.chdir(tmp_path)
    for path, images in (("garden/images", "images"), ("garden/small/images_2", "small/images_2"), ("garden", None)):
        data = load(path)
        assert (images, "COLMAP set garden") == (data.images, data.name)
        assert f"images from {images or 'images'}" in data.report
    with pytest.raises(InputError, match=r"garden/images_4 is neither a folder .*; garden has images, small"):
        load("garden/images_4")
    with pytest.raises(InputError, match=r"garden/sparse is not a data set: .* or a folder of images of such a set"):
        load("garden/sparse")
    (tmp_path / "garden" / "images" / "transforms.json").write_text("{}")  # a set of its own
    with pytest.raises(InputError, match="lists no frames"):
        load("garden/images")


def test_colours_of_transparent_pixels_do_not_bleed(tmp_path):
    pixels = np.zeros((H, W, 4), np.uint8)
    pixels[:, : W // 2] = (200, 100, 50, 255)
    pixels[:, W // 2 :] = (0, 255, 0, 0)
    (tmp_path / "train").mkdir()
    Image.fromarray(pixels).save(tmp_path / "train" / "r_0.png")
    frame = {"file_path": "./train/r_0", "transform_matrix": to_opengl(cameras(1)[0])}
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))
    data = load(tmp_path, (17, 11))
    small = data.train[0].pixels
    assert np.abs(small[small[..., 3] > 60][:, :3].astype(int) - (200, 100, 50)).max() <= 8
    assert any("no transforms_test.json" in line for line in data.report)


def test_the_near_plane_follows_the_distance_of_the_cameras(blender):
    assert np.isclose(0.03 * np.sqrt(10.0), load(blender).train[0].camera.near)
    assert 0.011 == load(blender, near=0.011).train[0].camera.near


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "at"),
    [
        (write_colmap_set, (-2.7e6, -4.3e6, 3.85e6)), (partial(write_colmap_set, text=True), (0.0, 0.0, 9000.0)),
        (write_transforms, (500123.25, 4649876.5, 214.75)),
    ],
    ids=["ECEF", "one axis", "UTM"],
)  # fmt: skip
def test_a_set_far_from_0_gets_an_origin(tmp_path, write, at):
    write(tmp_path / "near", at=(20.0, -30.0, 10.0))
    write(tmp_path / "far", at=at)
    near, far = load(tmp_path / "near"), load(tmp_path / "far")
    assert (0.0, 0.0, 0.0) == near.origin
    assert any("coordinates are far from 0" in line for line in far.report)
    assert np.abs(np.subtract(at, far.origin)).max() < 4.0
    assert all(float(value).is_integer() for value in far.origin)
    shift = np.subtract(at, (20.0, -30.0, 10.0)) - far.origin
    for one, other in zip((*near.train, *near.test), (*far.train, *far.test), strict=True):
        assert np.allclose(one.camera.position + shift, other.camera.position, atol=1e-6)
        assert near.train[0].camera.near == pytest.approx(other.camera.near)
    assert_dots_are_where_points_fall([*far.train, *far.test], POINTS + at - far.origin)
    if near.points is not None:
        assert np.array_equal((POINTS + np.array((20.0, -30.0, 10.0))).astype(np.float32), near.points)
        assert np.allclose(POINTS + at, far.points + np.array(far.origin), atol=1e-6)
        assert np.float32 == far.points.dtype


def test_outlier_cameras_are_reported_and_ignored(tmp_path):
    write_colmap_set(tmp_path)
    usual = load(tmp_path).train[0].camera.near
    for moved, words in (
        ([3], "the camera of im 003.png is"),
        ([3, 5], "the cameras of im 003.png, im 005.png are"),
        ([8], "1 test image will score badly"),
    ):
        shots = cameras(9)
        for i in moved:
            shots[i] = relative_to((3000.0, -4000.0 - 100 * i, 0.0), shots[i])
        write_colmap(tmp_path / "sparse" / "0", shots)
        data = load(tmp_path)
        assert (7, 0, 2) == counts(data)
        assert [words in line for line in data.report if "times the usual distance" in line] == [True]
        assert usual == pytest.approx(data.train[0].camera.near, rel=0.05)
        assert measure_extent(data.inliers).extent < 5.0
        assert (0.0, 0.0, 0.0) == data.origin
    write_colmap_set(tmp_path / "near")
    assert not any("usual distance" in line for line in load(tmp_path / "near").report)


def test_a_camera_beyond_float32_is_refused(tmp_path):
    write_colmap_set(tmp_path)
    shots = cameras(9)
    shots[3] = relative_to((1e39, 0.0, 0.0), shots[3])
    write_colmap(tmp_path / "sparse" / "0", shots)
    with pytest.raises(InputError, match=r"camera of im 003.png is .* units from 0"):
        load(tmp_path)


def test_other_files_and_folders_and_invalid_json_are_refused(tmp_path):
    (tmp_path / "set.zip").write_bytes(b"PK")
    for name in ("no", "bad", "raw"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad" / "transforms.json").write_text("{")
    (tmp_path / "raw" / "database.db").write_bytes(b"")
    write_transforms(tmp_path / "outer" / "garden")
    for name, message in (
        ("no", "is not a data set"), ("absent", "neither a folder"), ("set.zip", "unpack it"),
        ("bad", "not a JSON file"), ("raw", "run `colmap mapper`"), ("outer", "did you mean garden in it"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            load(tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["sparse", "sparse/model", "colmap/sparse/0", "distorted/sparse/0", "."])
def test_models_are_found_in_several_folders(colmap_set, model):
    target = colmap_set / model
    for file in sorted((colmap_set / "sparse" / "0").iterdir()):
        target.mkdir(parents=True, exist_ok=True)
        file.rename(target / file.name)
    assert 7 == len(load(colmap_set).train)


def test_invalid_fields_of_transforms_json_are_refused(ngp):
    frames, file = frames_of(ngp), ngp / "transforms.json"
    document = file.read_text()

    def second(matrix):
        return {"frames": [*frames[:2], {**frames[2], "transform_matrix": matrix}]}

    cases = [
        ({"frames": []}, "lists no frames"), ({"frames": [{"transform_matrix": []}]}, "frame 0 has no file_path"),
        ({"fl_x": -5}, "fl_x is -5, expected above 0"), ({"fl_x": "wide"}, "fl_x is 'wide'"),
        ({"fl_x": 10**400}, "an integer has 401 digits, expected at most 300"),
        (second([[10**400, 0, 0, 0]] * 4), "an integer has 401 digits"),
        ({"camera_model": "EQUIRECTANGULAR"}, "is EQUIRECTANGULAR, expected one of PINHOLE, .*: split panoramas"),
        ({"w": 0}, "w and h are 0 and 32"), ({"k1": -30.0}, "cannot be undone"),
        ({"frames": [{"file_path": "images/0000.png", "transform_matrix_start": 1}]}, "rolling shutters"),
        ({"frames": [*frames, {**frames[2], "file_path": "./images/0003.png"}]},
         r"frame 10: \./images/0003\.png occurs twice, with different poses"),
        ({"frames": [{**frames[0], "file_path": "a\nb.png"}]}, "frame 0: file_path has control characters"),
        *((second(matrix), "frame 2") for matrix in ([], [[1]], [[0.0] * 4] * 4, [["x"] * 4] * 4)),
        (second(np.diag([1.0, 1, -1, 1]).tolist()), "frame 2"),
    ]  # fmt: skip

    def check(case):
        change, message = case
        file.write_text(document)
        change_transforms(ngp, **change)
        with pytest.raises(InputError, match=message):
            load(ngp)

    assert [] == failures({f"{number}: {case[1]}": case for number, case in enumerate(cases)}, check)


def test_missing_invalid_and_truncated_images_are_refused(ngp):
    path = ngp / "images" / "0001.png"
    path.write_bytes(path.read_bytes()[:60])
    data = load(ngp)
    with pytest.raises(InputError, match=r"0001\.png is a PNG that is truncated: copy or export it again"):
        data.read()
    path.write_text("not a picture")
    with pytest.raises(InputError, match=r"0001\.png"):
        load(ngp)
    for path in (ngp / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="none of its 10 images"):
        load(ngp)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blender", "ngp", "colmap"])
@pytest.mark.parametrize("size", [None, (24, 16)])
def test_images_are_decoded_lazily(request, monkeypatch, kind, size):
    folder = request.getfixturevalue(kind if kind != "colmap" else "colmap_set")
    decoded = set()
    decode = ImageFile.ImageFile.load
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda file: decoded.add(file.filename) or decode(file))
    data = load(folder, size)
    wanted = (size or (W, H))[::-1]
    assert (kind == "blender") == len(decoded)  # one image shows that there is transparency
    assert all(picture.has_alpha == (kind == "blender") for picture in (*data.train, *data.test))
    assert data.background == ((1.0, 1.0, 1.0) if kind == "blender" else (0.0, 0.0, 0.0))
    decoded.clear()
    assert wanted == data.test[0].pixels.shape[:2]
    assert wanted == replace(data.test[0], camera=data.test[0].camera).pixels.shape[:2]
    assert 1 == len(decoded)  # an image with another camera shares the pixels
    data.read()
    assert len(data.train) + len(data.test) == len(decoded)


@pytest.mark.slow
@pytest.mark.parametrize("orientation", [6, 8])
def test_exif_rotation_is_applied_if_the_camera_is_upright(ngp, orientation):
    for path in sorted((ngp / "images").glob("*.png")):
        with Image.open(path) as shown:
            lying = shown.transpose(Image.Transpose.ROTATE_90 if orientation == 6 else Image.Transpose.ROTATE_270)
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        lying.save(path, exif=exif)
    data = load(ngp)
    assert {(W, H)} == {(picture.camera.W, picture.camera.H) for picture in data.train}
    assert_dots_are_where_points_fall([*data.train, *data.test])
    change_transforms(ngp, w=H, h=W, cx=H / 2, cy=W / 2)
    as_stored = load(ngp).train[0]
    assert (H, W) == (as_stored.camera.W, as_stored.camera.H) == as_stored.pixels.shape[1::-1]


def _hide(path, size):
    """Write a mask with a black left third."""
    width, height = size
    values = np.full((height, width), 255, np.uint8)
    values[:, : width // 3] = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ngp", "colmap"])
@pytest.mark.parametrize(("size", "sides"), [(None, (W, H)), ((24, 16), (W, H)), (None, (2 * W, 2 * H))])
def test_a_mask_excludes_pixels(request, kind, size, sides):
    folder = request.getfixturevalue("ngp" if kind == "ngp" else "colmap_set")
    if kind == "ngp":
        change_frames(folder, [1], mask_path="masks/one.png")
        _hide(folder / "masks" / "one.png", sides)
    else:
        _hide(folder / "masks" / "im 001.png.png", sides)
    data = load(folder, size)
    assert "masks hide parts of 1 image, which do not count" in data.report
    first, *others = data.train
    width, height = size or (W, H)
    assert (width // 3) * height == (~first.mask).sum()
    assert not first.mask[:, : width // 3].any()
    assert all(picture.mask is None for picture in (*others, *data.test))


def test_a_missing_or_black_mask_is_refused(ngp):
    change_frames(ngp, [1], mask_path="masks/one.png")
    with pytest.raises(InputError, match=r"mask 'masks/one\.png' of images/0001\.png does not exist"):
        load(ngp)
    (ngp / "masks").mkdir()
    Image.fromarray(np.zeros((H, W), np.uint8)).save(ngp / "masks" / "one.png")
    with pytest.raises(InputError, match=r"the mask of images/0001\.png hides all of it"):
        load(ngp).read()


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


def test_transparency_of_a_palette_is_known_before_decoding(blender):
    path = blender / "train" / "r_0.png"
    with Image.open(path) as image:
        image.quantize(16).save(path, transparency=0)
    picture = load(blender).train[0]
    assert picture.has_alpha
    assert (H, W, 4) == picture.pixels.shape


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        ("blender", {"test_every": 5}, {"background": [1.0] * 3}),
        ("ngp", {}, {"background": [0.0] * 3, "test_every": 8}),
        ("ngp", {"test_every": 0}, {"background": [0.0] * 3, "test_every": 0}),
        ("colmap_set", {"test_every": 5, "images": "images"}, {"test_every": 5, "images": "images"}),
        ("colmap_set", {"size": (24, 16), "near": 0.004}, {"size": [24, 16], "near": 0.004, "test_every": 8}),
    ],
)
def test_a_set_records_its_options(request, kind, options, expected):
    data = load(request.getfixturevalue(kind), **options)
    record = data.trained_on(data.background).as_json()
    assert expected == {name: record[name] for name in expected}
    assert {"background", "near", *expected, *(("test_every",) if kind != "blender" else ())} == set(record)
    assert data.coordinate_system == ("RFU" if kind == "blender" else "unspecified")
    assert (0, 0, 1) == data.up
    assert any("up is 0 0 1 by the cameras" in line for line in data.report) == (kind != "blender")


def test_a_blender_set_in_other_coordinates_has_unspecified_axes(tmp_path):
    write_blender(tmp_path, up=(0, -1, 0))
    data = load(tmp_path)
    assert ("unspecified", (0, -1, 0)) == (data.coordinate_system, data.up)
    assert any("usually have other axes" in line for line in data.report)


@pytest.mark.slow
@pytest.mark.parametrize(
    "write", [write_blender, write_transforms, write_colmap_set, partial(write_colmap_set, text=True)]
)
def test_a_damaged_set_is_read_or_refused(tmp_path, write):
    write(tmp_path)
    (tmp_path / "test.txt").write_text("im 002.png\n0003.png\n")
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".png")
    rng = Random(0)  # noqa: S311 - no secrets are drawn
    for _ in range(50):
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
    """Change, remove or insert bytes, some of them words that are special to readers."""
    words = (b"nan", b"-nan(ind)", b"1e400", b"null", b"[]", b"..", b"\\", b"\xff", b"\0", b"\n", b"#", b"9" * 12, b'"')
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 3))):
        at, kind = rng.randrange(len(result) + 1), rng.randrange(4)
        if kind == 0:
            result[at : at + 8] = rng.randbytes(8)
        elif kind == 1:
            del result[at : at + rng.choice((1, 4, 40, 10**6))]
        elif kind == 2:
            result[at:at] = rng.choice(words)
        else:
            word = rng.choice(words)
            result[at : at + len(word)] = word
    return bytes(result)


def test_invalid_lines_of_text_files_are_refused(tmp_path):
    write_colmap_set(tmp_path, text=True)
    pose = "1 1 0 0 0 0 0 0"
    for name, text, message in (
        ("images", "1 2 3\n", "line 1"), ("images", "1 a b c d e f g 7 name\n", "line 1"),
        ("images", "1 0 0 0 0 0 0 0 7 name\n", "line 1"), ("images", f"{pose} x name\n", "line 1"),
        ("images", f"{pose} 9 im 001.png\n\n", "has camera 9"), ("cameras", "7 PINHOLE 48\n", "expected id, model"),
        ("points3D", "1 2 3\n", "expected id, position and colour"),
    ):  # fmt: skip
        file = tmp_path / "sparse" / "0" / f"{name}.txt"
        before = file.read_text()
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            load(tmp_path)
        file.write_text(before)


def test_points_of_shared_desk_have_the_colours_of_its_images(data_dir):
    data = load(data_dir / "images" / "desk29")
    assert (25, 4) == (len(data.train), len(data.test))
    assert (7562, 3) == data.points.shape
    right, mirrored = [], []
    for picture in data.test:
        camera = picture.camera
        c = data.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        p = c @ camera.K.T
        u, v = (p[:, :2] / p[:, 2:]).T
        inside = (c[:, 2] > 0) & (u >= 0) & (u < camera.W) & (v >= 0) & (v < camera.H)
        assert inside.mean() > 0.9
        u, v = u[inside].astype(int), v[inside].astype(int)
        for errors, row in ((right, v), (mirrored, camera.H - 1 - v)):
            errors.append(np.abs(picture.pixels[row, u] / 255.0 - data.points_rgb[inside]).mean())
    assert np.mean(right) < 0.6 * np.mean(mirrored)
