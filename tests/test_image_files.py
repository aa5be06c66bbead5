"""Names of images as data sets list them, and the files that they are found to be."""

import re
import unicodedata

import pytest

from csplat.errors import InputError

pytest.importorskip("scipy", reason="data sets need scipy: pip install 'csplat[render]'")
pytest.importorskip("PIL", reason="data sets need pillow: pip install 'csplat[render]'")

from posed_sets import (  # it needs what is looked for above
    W,
    assert_dots_are_where_points_fall,
    cameras,
    change_transforms,
    rename_in_images_txt,
    to_opengl,
    write_blender,
    write_colmap,
    write_colmap_set,
    write_picture,
    write_transforms,
)
from tables import failures

from csplat_trainer.data import load
from csplat_trainer.data.image_files import match_names

POSES = [to_opengl(camera) for camera in cameras(10)]  # poses of the frames of `write_transforms`

#: Listed name, existing names, the one that matches or the text of the error; words of the note.
NAMES = {
    "as it is": ("a/1.png", ["a/1.png", "1.png", "A/1.PNG"], "a/1.png", None),
    "a dot": ("./a//1.png", ["a/1.png"], "a/1.png", None),
    "no ending": ("a/1", ["a/1.png"], "a/1.png", None),
    "no ending, two files": ("a/1", ["a/1.png", "a/1.jpg"], "a/1 fits 2 names: a/1.jpg, a/1.png", None),
    "another ending": ("1.JPG", ["1.png"], "1.png", "with another ending"),
    "a version is no ending": ("v1.3", ["v1.png", "v1.2.png"], None, None),
    "a stem is no name": ("10", ["1.png", "100.png"], None, None),
    "backslashes": ("a\\1.png", ["a/1.png"], "a/1.png", "with / for \\, without spaces around it"),
    "a space at the end": ("a/1.png ", ["a/1.png"], "a/1.png", "with / for \\, without spaces around it"),
    "a backslash in a name": ("a\\1.png", ["a\\1.png", "a/1.png"], "a\\1.png", None),
    "another case": ("img_1.png", ["IMG_1.PNG"], "IMG_1.PNG", "in another case"),
    "another case rather than another ending": ("1.JPG", ["1.jpg", "1.png"], "1.jpg", "in another case"),
    "another case, two files": ("img_1.png", ["IMG_1.png", "Img_1.png"], "fits 2 names", None),
    "another case and ending": ("img_1.jpg", ["IMG_1.PNG"], "IMG_1.PNG", "with another ending"),
    "another Unicode form": (
        unicodedata.normalize("NFD", "Köln.png"),
        [unicodedata.normalize("NFC", "Köln.png")],
        unicodedata.normalize("NFC", "Köln.png"),
        "in another case",
    ),
    "a URL": ("a/my%20file.png", ["a/my file.png"], "a/my file.png", "as a URL"),
    "a percent sign": ("100%25.png", ["100%25.png", "100%.png"], "100%25.png", None),
    "a file URL": ("file:///home/x/a/1.png", ["a/1.png"], "a/1.png", "without leading folders"),
    "a drive": ("C:\\scans\\a\\1.png", ["a/1.png"], "a/1.png", "without leading folders"),
    "an absolute path": ("/home/x/a/1.png", ["a/1.png", "1.png"], "a/1.png", "without leading folders"),
    "a folder more": ("photos/1.png", ["1.png"], "1.png", "without leading folders"),
    "a folder less": ("1.png", ["a/1.png"], "a/1.png", "in folders below"),
    "a folder less, two files": ("1.png", ["a/1.png", "b/1.png"], "1.png fits 2 names: a/1.png, b/1.png", None),
    "another folder": ("a/1.png", ["b/1.png"], None, None),
}


def test_names_are_read_more_loosely_only_if_they_are_not_found_as_written():
    def check(case):
        listed, known, expected, words = case
        if expected is not None and "fits" in expected:
            with pytest.raises(InputError, match=re.escape(expected)):
                match_names([listed], known, "list.txt")
            return
        matched, notes = match_names([listed], known, "list.txt")
        assert ({} if expected is None else {listed: expected}) == matched
        assert ([] if words is None else [f"1 name of list.txt found {words}: {listed} is {expected}"]) == notes

    assert [] == failures(NAMES, check)


def test_a_missing_name_is_not_looked_for_in_other_folders_if_others_are_found():
    known = ["images/1.png", "images_2/1.png", "images_2/2.png", "2.png"]
    assert ({"images/1.png": "images/1.png"}, []) == match_names(["images/1.png", "images/2.png"], known, "x")


def test_two_names_of_one_file_are_refused():
    with pytest.raises(InputError, match=r"x: A\.png and A\.PNG both fit a\.png"):
        match_names(["A.png", "A.PNG"], ["a.png"], "x")
    assert {"1.png": "1.png"} == match_names(["1.jpg", "1.png"], ["1.png"], "x")[0]


@pytest.fixture
def colmap_set(tmp_path):
    write_colmap_set(tmp_path)
    return tmp_path


@pytest.fixture
def transforms(tmp_path):
    write_transforms(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("folder", "says"),
    [
        ("Images", "images from Images"),
        ("input", "images from input"),
        ("images_2", "images from images_2"),
        (".", "images from the folder itself"),
        ("images/deeper", "9 names of images.txt found in folders below"),
    ],
)
def test_images_of_colmap_lie_in_folders_of_several_names(colmap_set, folder, says):
    rename_in_images_txt(colmap_set, "im {:03}.png".format)
    move(colmap_set / "images", colmap_set / folder)
    data = load(colmap_set)
    assert any(says in line for line in data.report)
    assert_dots_are_where_points_fall([*data.train, *data.test])


def test_originals_belong_to_the_distorted_model(colmap_set):
    for camera, i in zip(cameras(9), range(9), strict=True):
        write_picture(colmap_set / "input" / f"im {i:03}.png", camera)
    move(colmap_set / "sparse", colmap_set / "distorted" / "sparse")
    assert "images from input" in load(colmap_set).report


@pytest.mark.parametrize(
    "name", ["IM {:03}.PNG", "photos/im {:03}.png", "D:\\photos\\im {:03}.png", "im {:03}.jpg", "./im {:03}.png"]
)
def test_images_of_colmap_have_names_of_another_machine(colmap_set, name):
    rename_in_images_txt(colmap_set, name.format)
    data = load(colmap_set)
    assert (7, 2) == (len(data.train), len(data.test))
    assert_dots_are_where_points_fall([*data.train, *data.test])
    assert any("9 names of images.txt found" in line for line in data.report) == (not name.startswith("."))


def test_spaces_within_names_are_kept(colmap_set):
    rename_in_images_txt(colmap_set, "im  {:03}.png".format)
    for path in (colmap_set / "images").iterdir():
        path.rename(path.with_name(path.name.replace("im ", "im  ")))
    assert 7 == len(load(colmap_set).train)


def test_the_message_names_the_folders_that_were_tried(colmap_set):
    rename_in_images_txt(colmap_set, "other{}.png".format)
    with pytest.raises(InputError) as raised:
        load(colmap_set)
    message = str(raised.value)
    assert "none of its 9 images is there (other0.png, …)" in message
    assert f"looked in {colmap_set}/images, {colmap_set}/input, {colmap_set} itself" in message
    assert "there are other images, such as im 000.png" in message


@pytest.mark.parametrize(
    ("path", "folder"),
    [
        ("images\\{:04}.png", "images"),
        ("./uploads\\images/{:04}.png", "uploads/images"),
        ("C:\\Users\\me\\scan\\images\\{:04}.png", "images"),
        ("/home/me/scan/images/{:04}.png", "images"),
        ("../scan/images/{:04}.png", "images"),
        ("images/{:04}.png", "images_4"),
        ("images/{:04}.png", "Images"),
        ("images/{:04}.png", "input"),
        ("images/{:04}.png", "."),
        ("{:04}.png", "images"),
        ("photos/{:04}.JPG", "photos"),
        ("photos/{:04}", "PHOTOS"),
    ],
)
def test_frames_name_images_of_another_machine(transforms, path, folder):
    move(transforms / "images", transforms / folder)
    frames = [{"file_path": path.format(i), "transform_matrix": matrix} for i, matrix in enumerate(POSES)]
    change_transforms(transforms, frames=frames)
    data = load(transforms, test_every=0)
    assert 10 == len(data.train)
    assert_dots_are_where_points_fall(data.train)
    assert any("10 names of transforms.json found" in line or "images from images" in line for line in data.report)


def test_frames_without_images_do_not_take_those_of_others(tmp_path):
    write_transforms(tmp_path)
    (tmp_path / "images" / "0003.png").rename(tmp_path / "0003.png")
    data = load(tmp_path, test_every=0)
    assert 9 == len(data.train)
    assert "transforms.json: 1 of 10 images are missing and left out: images/0003.png" in data.report


def test_training_and_test_images_of_blender_are_not_the_same_files(tmp_path):
    write_blender(tmp_path)
    move(tmp_path / "train", tmp_path)
    move(tmp_path / "test", tmp_path / "away")
    with pytest.raises(InputError, match=r"train/r_0\.png and test/r_0\.png are both found as r_0\.png"):
        load(tmp_path)
    (tmp_path / "transforms_test.json").unlink()
    assert 5 == len(load(tmp_path).train)


def test_images_of_transforms_json_may_be_taken_from_a_folder_that_is_named(transforms):
    for i, camera in enumerate(cameras(10)):
        write_picture(transforms / "images_2" / f"{i:04}.png", camera, scale=2)
    assert W // 2 == load(transforms, images="images_2").train[0].camera.W
    assert W == load(transforms).train[0].camera.W


def test_masks_are_found_as_images_are(transforms):
    (transforms / "masks").mkdir()
    for i, camera in enumerate(cameras(10)):
        write_picture(transforms / "masks" / f"{i:04}.png", camera)
    assert any("folder masks, which transforms.json does not mention" in line for line in load(transforms).report)
    frames = [
        {"file_path": f"images/{i:04}.png", "mask_path": f"masks\\{i:04}.png", "transform_matrix": matrix}
        for i, matrix in enumerate(POSES)
    ]
    change_transforms(transforms, frames=frames)
    data = load(transforms)
    assert "masks hide parts of 10 images: they do not count" in data.report
    assert any(
        "10 names of transforms.json found with / for \\, without spaces around it" in line for line in data.report
    )


def test_a_link_to_nowhere_is_a_missing_image(colmap_set):
    (colmap_set / "images" / "im 003.png").unlink()
    (colmap_set / "images" / "im 003.png").symlink_to(colmap_set / "absent.png")
    assert "images.bin: 1 of 9 images are missing and left out: im 003.png" in load(colmap_set).report


def test_masks_next_to_the_images_are_reported(colmap_set):
    write_picture(colmap_set / "images" / "im 003_mask.png", cameras(9)[3])
    assert any("masks next to the images, such as im 003_mask.png" in line for line in load(colmap_set).report)


def test_masks_that_fit_no_image_are_reported(colmap_set):
    (colmap_set / "masks").mkdir()
    write_picture(colmap_set / "masks" / "other.png", cameras(9)[0])
    assert any("masks/ has none for 9 of 9 images" in line for line in load(colmap_set).report)
    write_picture(colmap_set / "masks" / "IM 003.png", cameras(9)[3])
    report = load(colmap_set).report
    assert any("masks/ has none for 8 of 9 images: all pixels of im 000.png count" in line for line in report)
    assert any("1 name of masks/ found in another case: im 003.png is IM 003.png" in line for line in report)


@pytest.mark.parametrize(
    "name",
    [
        "masks/im 003.png",
        "masks/im 003.png.png",
        "masks/im 003.jpg",
        "Masks/im 003.png",
        "mask/im 003_mask.png",
        "masks/mask_im 003.jpg",
        "masks/im 003.mask.png",
    ],
)
def test_masks_have_names_of_several_programs(colmap_set, name):
    (colmap_set / name).parent.mkdir()
    write_picture(colmap_set / name, cameras(9)[3])
    data = load(colmap_set)
    assert "masks hide parts of 1 image: they do not count" in data.report
    assert ["im 003.png"] == [picture.camera.image for picture in data.train if picture.masked is not None]


def test_hidden_files_are_no_candidates(tmp_path):
    shots = cameras(3)
    write_colmap(tmp_path / "sparse" / "0", shots)
    for i, camera in enumerate(shots):
        for folder in (".cache", "__MACOSX", "images/set"):
            write_picture(tmp_path / folder / f"im {i:03}.png", camera)
        write_picture(tmp_path / "images" / "set" / f"._im {i:03}.png", camera)
    assert 3 == len(load(tmp_path, test_every=0).train)


def move(source, target):
    """Move the files of a folder."""
    files = list(source.iterdir())
    target.mkdir(parents=True, exist_ok=True)
    for path in files:
        path.rename(target / path.name)
    if source != target and not any(source.iterdir()):
        source.rmdir()
