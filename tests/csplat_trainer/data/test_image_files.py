"""Images of data sets: names and the files they are found to be; values of every kind of pixel, and masks."""

import json
import re
import struct
import unicodedata
import zlib

import numpy as np
import pytest
from image_files_cases import GREY, LABELS, RGB, SHAPE, UINT16, png_16
from PIL import ExifTags, Image, ImageFile
from posed_sets import (
    H,
    W,
    assert_dots_are_where_points_fall,
    cameras,
    change_frames,
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

from csplat.errors import InputError
from csplat_trainer.data import load
from csplat_trainer.data.image_files import match_names

pytest.importorskip("numba", reason="requires the extra [render]")


NFC, NFD = (unicodedata.normalize(form, "Köln.png") for form in ("NFC", "NFD"))
POSES = [to_opengl(camera) for camera in cameras(10)]  # poses of the frames of `write_transforms`


#: Listed name, existing names, the one that matches or the text of the error, words of the note.
NAMES = {
    "as it is": ("a/1.png", ["a/1.png", "1.png", "A/1.PNG"], "a/1.png", None),
    "a dot": ("./a//1.png", ["a/1.png"], "a/1.png", None),
    "no ending": ("a/1", ["a/1.png"], "a/1.png", None),
    "no ending, two files": ("a/1", ["a/1.png", "a/1.jpg"], "a/1 matches 2 files: a/1.jpg, a/1.png", None),
    "another ending": ("1.JPG", ["1.png"], "1.png", "with another ending"),
    "a version is no ending": ("v1.3", ["v1.png", "v1.2.png"], None, None),
    "a stem is no name": ("10", ["1.png", "100.png"], None, None),
    "backslashes": ("a\\1.png", ["a/1.png"], "a/1.png", "with / for \\, without surrounding spaces"),
    "a space at the end": ("a/1.png ", ["a/1.png"], "a/1.png", "with / for \\, without surrounding spaces"),
    "a backslash in a name": ("a\\1.png", ["a\\1.png", "a/1.png"], "a\\1.png", None),
    "another case": ("img_1.png", ["IMG_1.PNG"], "IMG_1.PNG", "in another case"),
    "another case rather than another ending": ("1.JPG", ["1.jpg", "1.png"], "1.jpg", "in another case"),
    "another case, two files": ("img_1.png", ["IMG_1.png", "Img_1.png"], "matches 2 files", None),
    "another case and ending": ("img_1.jpg", ["IMG_1.PNG"], "IMG_1.PNG", "with another ending"),
    "another Unicode form": (NFD, [NFC], NFC, "in another Unicode form"),
    "another Unicode form, the other way": (NFC, [NFD], NFD, "in another Unicode form"),
    "a URL": ("a/my%20file.png", ["a/my file.png"], "a/my file.png", "as a URL"),
    "a percent sign": ("100%25.png", ["100%25.png", "100%.png"], "100%25.png", None),
    "a file URL": ("file:///home/x/a/1.png", ["a/1.png"], "a/1.png", "without leading folders"),
    "a drive": ("C:\\scans\\a\\1.png", ["a/1.png"], "a/1.png", "without leading folders"),
    "an absolute path": ("/home/x/a/1.png", ["a/1.png", "1.png"], "a/1.png", "without leading folders"),
    "a folder more": ("photos/1.png", ["1.png"], "1.png", "without leading folders"),
    "a folder less": ("1.png", ["a/1.png"], "a/1.png", "in folders below"),
    "a folder less, two files": ("1.png", ["a/1.png", "b/1.png"], "1.png matches 2 files: a/1.png, b/1.png", None),
    "another folder": ("a/1.png", ["b/1.png"], None, None),
}


def test_names_are_matched_loosely_only_without_an_exact_match():
    def check(case):
        listed, known, expected, words = case
        if expected is not None and "matches" in expected:
            with pytest.raises(InputError, match=re.escape(expected)):
                match_names([listed], known, "list.txt")
            return
        matched, notes = match_names([listed], known, "list.txt")
        assert ({} if expected is None else {listed: expected}) == matched
        assert ([] if words is None else [f"1 name of list.txt found {words}: {listed} is {expected}"]) == notes

    assert [] == failures(NAMES, check)


def test_a_missing_name_is_not_searched_in_other_folders_if_others_are_found():
    known = ["images/1.png", "images_2/1.png", "images_2/2.png", "2.png"]
    assert ({"images/1.png": "images/1.png"}, []) == match_names(["images/1.png", "images/2.png"], known, "x")


def test_two_names_of_one_file_are_refused():
    with pytest.raises(InputError, match=r"x: A\.png and A\.PNG both match a\.png"):
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "note"),
    [
        ("Images", "images from Images"), ("input", "images from input"), ("images_2", "images from images_2"),
        (".", "images from the folder itself"), ("images/deeper", "9 names of images.txt found in folders below"),
    ],
)  # fmt: skip
def test_images_of_colmap_are_found_in_several_folders(colmap_set, folder, note):
    rename_in_images_txt(colmap_set, "im {:03}.png".format)
    move(colmap_set / "images", colmap_set / folder)
    data = load(colmap_set)
    assert any(note in line for line in data.report)
    assert_dots_are_where_points_fall([*data.train, *data.test])


def test_originals_belong_to_the_distorted_model(colmap_set):
    for camera, i in zip(cameras(9), range(9), strict=True):
        write_picture(colmap_set / "input" / f"im {i:03}.png", camera)
    move(colmap_set / "sparse", colmap_set / "distorted" / "sparse")
    assert "images from input" in load(colmap_set).report


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["IM {:03}.PNG", "photos/im {:03}.png", "D:\\photos\\im {:03}.png", "im {:03}.jpg", "./im {:03}.png"]
)
def test_names_of_images_of_another_machine_are_found(colmap_set, name):
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
    assert "none of its 9 images exists (other0.png, …)" in message
    assert f"searched {colmap_set}/images, {colmap_set}/input, {colmap_set} itself" in message
    assert "there are other images, such as im 000.png" in message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "folder"),
    [
        ("images\\{:04}.png", "images"), ("./uploads\\images/{:04}.png", "uploads/images"),
        ("C:\\Users\\me\\scan\\images\\{:04}.png", "images"), ("/home/me/scan/images/{:04}.png", "images"),
        ("../scan/images/{:04}.png", "images"), ("images/{:04}.png", "images_4"), ("images/{:04}.png", "Images"),
        ("images/{:04}.png", "input"), ("images/{:04}.png", "."), ("{:04}.png", "images"),
        ("photos/{:04}.JPG", "photos"), ("photos/{:04}", "PHOTOS"),
    ],
)  # fmt: skip
def test_paths_of_frames_of_another_machine_are_found(transforms, path, folder):
    move(transforms / "images", transforms / folder)
    frames = [{"file_path": path.format(i), "transform_matrix": matrix} for i, matrix in enumerate(POSES)]
    change_transforms(transforms, frames=frames)
    data = load(transforms, test_every=0)
    assert 10 == len(data.train)
    assert_dots_are_where_points_fall(data.train)
    assert any("10 names of transforms.json found" in line or "images from images" in line for line in data.report)


def test_training_and_test_images_must_be_different_files(tmp_path):
    write_blender(tmp_path)
    move(tmp_path / "train", tmp_path)
    move(tmp_path / "test", tmp_path / "away")
    with pytest.raises(InputError, match=r"train/r_0\.png and test/r_0\.png are both found as r_0\.png"):
        load(tmp_path)
    (tmp_path / "transforms_test.json").unlink()
    assert 5 == len(load(tmp_path).train)


def test_another_folder_of_images_may_be_chosen(transforms):
    for i, camera in enumerate(cameras(10)):
        write_picture(transforms / "images_2" / f"{i:04}.png", camera, scale=2)
    assert W // 2 == load(transforms, images="images_2").train[0].camera.W
    assert W == load(transforms).train[0].camera.W


def test_masks_are_found_like_images(transforms):
    for i, camera in enumerate(cameras(10)):
        write_picture(transforms / "masks" / f"{i:04}.png", camera)
    assert any("folder masks is ignored, since transforms.json does not" in line for line in load(transforms).report)
    for i in range(10):
        change_frames(transforms, [i], mask_path=f"masks\\{i:04}.png")
    report = load(transforms).report
    assert "masks hide parts of 10 images, which do not count" in report
    assert any("10 names of transforms.json found with / for \\" in line for line in report)


#: Names on disk, and the code page in which a list has them, with its title.
CODE_PAGES = {
    "GBK": ("图像{}.png", "gbk", "GBK"),
    "Shift-JIS": ("写真表示{}.png", "cp932", "Shift-JIS"),
    "Shift-JIS with bytes of backslashes": ("ソース{}.JPG", "cp932", "Shift-JIS"),
    "Big5": ("圖像功能{}.png", "big5", "Big5"),
    "EUC-KR": ("사진{}.png", "euc_kr", "EUC-KR"),
    "Windows-1252": ("Gebäude_{}.png", "cp1252", "Windows-1252"),
    "Windows-1251": ("Дом_{}.png", "cp1251", "Windows-1251"),
    "Windows-1250": ("Łódź_{}.png", "cp1250", "Windows-1250"),
    "code page of zips": ("Größe_{}.png", "cp437", "CP437"),
}


@pytest.mark.slow
def test_names_in_other_code_pages_are_matched_by_their_bytes():
    def check(case):
        form, page, title = case
        names = [form.format(i) for i in range(3)]
        raw = [name.encode(page).decode("utf-8", "surrogateescape") for name in names]
        misread = [name.encode("utf-8").decode("cp437") for name in names]
        for listed, files in ((raw, names), (names, raw), (misread, names), (names, misread)):
            matched, (note,) = match_names(listed, files, "images.bin")
            assert dict(zip(listed, files, strict=True)) == matched
            assert f"found in the code page {title if raw in (listed, files) else ''}" in note
            note.encode("utf-8")

    assert [] == failures(CODE_PAGES, check)


def test_bytes_that_fit_no_file_or_several_are_no_match():
    listed = ["K\xf6ln.png".encode("cp1252").decode("utf-8", "surrogateescape")]
    assert ({}, []) == match_names(listed, ["Koeln.png", "a.png"], "x")
    with pytest.raises(InputError, match="names match different files in Windows-1252 and CP437: rename"):
        match_names(listed, ["Köln.png", "K÷ln.png"], "x")


@pytest.mark.slow
def test_sets_with_names_in_another_code_page_are_read(colmap_set):
    names = [f"図面表{i}.png" for i in range(9)]  # in code page 932, some bytes are backslashes
    model = colmap_set / "sparse" / "0" / "images.bin"
    data = model.read_bytes()
    for i, name in enumerate(names):
        (colmap_set / "images" / f"im {i:03}.png").rename(colmap_set / "images" / name)
        data = data.replace(b"im %03d.png\0" % i, name.encode("cp932") + b"\0")
    model.write_bytes(data)
    (colmap_set / "test.txt").write_bytes(names[2].encode("cp932"))
    read = load(colmap_set)
    assert [names[2]] == [image.camera.image for image in read.test]
    assert names[3] in [image.camera.image for image in read.train]
    assert any("9 names of images.bin found in the code page" in line for line in read.report)
    rename_in_images_txt(colmap_set, names.__getitem__)
    text = model.with_suffix(".txt")
    text.write_bytes(text.read_text("utf-8").encode("cp932"))
    assert [names[2]] == [image.camera.image for image in load(colmap_set).test]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "form"), [("cp932", "表{}.png"), ("cp1252", "Größe{}.png")])
def test_a_transforms_json_may_be_in_another_code_page(transforms, page, form):
    names = [form.format(i) for i in range(10)]
    for i, name in enumerate(names):
        (transforms / "images" / f"{i:04}.png").rename(transforms / "images" / name)
        change_frames(transforms, [i], file_path=f"images/{name}")
    file = transforms / "transforms.json"
    file.write_bytes(json.dumps(json.loads(file.read_text()), ensure_ascii=False).encode(page))
    data = load(transforms, test_every=0)
    assert [f"images/{name}" for name in names] == sorted(image.camera.image for image in data.train)


def test_a_link_to_nowhere_is_a_missing_image(colmap_set):
    (colmap_set / "images" / "im 003.png").unlink()
    (colmap_set / "images" / "im 003.png").symlink_to(colmap_set / "absent.png")
    assert "images.bin: 1 of 9 images are missing and dropped: im 003.png" in load(colmap_set).report


def test_masks_next_to_the_images_are_reported(colmap_set):
    write_picture(colmap_set / "images" / "im 003_mask.png", cameras(9)[3])
    assert any("masks next to the images, such as im 003_mask.png" in line for line in load(colmap_set).report)


def test_masks_that_fit_no_image_are_reported(colmap_set):
    (colmap_set / "masks").mkdir()
    write_picture(colmap_set / "masks" / "other.png", cameras(9)[0])
    assert any("masks/ has no masks for 9 of 9 images" in line for line in load(colmap_set).report)
    write_picture(colmap_set / "masks" / "IM 003.png", cameras(9)[3])
    report = load(colmap_set).report
    assert any("masks/ has no masks for 8 of 9 images: all pixels of im 000.png count" in line for line in report)
    assert any("1 name of masks/ found in another case: im 003.png is IM 003.png" in line for line in report)


MASK_NAMES = [
    "masks/im 003.png", "masks/im 003.png.png", "masks/im 003.jpg", "Masks/im 003.png", "mask/im 003_mask.png",
    "masks/mask_im 003.jpg", "masks/im 003.mask.png", "masks/im 003.png.mask.png", "masks/IM 003.PNG.MASK.PNG",
    "_mask/im 003.png", "masks/im 003.png_mask.png", "images/im 003.png.mask.png", "images/im 003.PNG.Mask.png",
]  # fmt: skip


@pytest.mark.slow
def test_masks_have_names_of_several_programs(colmap_set):
    def check(name):
        (colmap_set / name).parent.mkdir(exist_ok=True)
        write_picture(colmap_set / name, cameras(9)[3])
        data = load(colmap_set)
        (colmap_set / name).unlink()
        if not name.startswith("images"):
            (colmap_set / name).parent.rmdir()
        assert 9 == len(data.train) + len(data.test)
        assert "masks hide parts of 1 image, which do not count" in data.report
        assert ["im 003.png"] == [picture.camera.image for picture in data.train if picture.masked is not None]

    assert [] == failures({name: name for name in MASK_NAMES}, check)


def test_hidden_files_are_ignored(tmp_path):
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


def test_a_set_reports_how_its_pixels_are_read(transforms):
    red, blue = (Image.new("RGB", (W, H), colour) for colour in ("red", "blue"))
    for write, line in (
        (lambda path: Image.fromarray((UINT16 // 16)).save(path), "10 images of 16-bit grey: 0 to 65535 is read as"),
        (lambda path: png_16(path, (RGB.astype(">u2") << 4).astype(">u2")), "10 images of 16-bit colours: 0 to 255 is"),
        (lambda path: red.save(path, save_all=True, append_images=[blue]), "10 files with several images: the first"),
    ):
        for path in (transforms / "images").iterdir():
            write(path)
        data = load(transforms)
        assert any(note.startswith(line) for note in data.report)
    assert (data.train[0].pixels == (255, 0, 0)).all()


@pytest.mark.slow
@pytest.mark.parametrize(("orientation", "square", "reported"), [(1, 0, 0), (3, 0, 1), (6, 0, 0), (6, 1, 1)])
def test_an_ambiguous_exif_rotation_is_reported(transforms, orientation, square, reported):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for path in (transforms / "images").iterdir():
        with Image.open(path) as image:
            (Image.new("RGB", (W, W)) if square else image).save(path, exif=exif)
    if square:  # otherwise, 6 would swap the sides, which contradicts the cameras
        change_transforms(transforms, h=W, cy=W / 2)
    data = load(transforms)
    if not square:
        assert_dots_are_where_points_fall([*data.train, *data.test])
    line = f"EXIF turns 10 images (0001.png: orientation {orientation}): read as stored"
    assert reported == sum(line in note for note in data.report) == sum("EXIF" in note for note in data.report)


VOC = Image.fromarray(LABELS, "P")


VOC.putpalette([0, 0, 0, 128, 0, 0])


def test_images_and_masks_much_larger_than_their_cameras_are_refused_before_decoding(transforms, monkeypatch):
    path, large = transforms / "images" / "0003.png", Image.new("1", (6000, 4000))
    original = path.read_bytes()
    for name in (path, transforms / "mask.png"):
        large.save(name)
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda file: pytest.fail(f"{file.filename} is decoded"))
    with pytest.raises(InputError, match=r"0003\.png has 6000×4000 pixels, expected about 48×32 as its camera"):
        load(transforms)
    path.write_bytes(original)
    change_frames(transforms, range(10), mask_path="mask.png")
    with pytest.raises(InputError, match=r"mask\.png has 6000×4000 pixels, expected about 48×32 as its image"):
        load(transforms)


def test_images_without_a_camera_have_a_budget(transforms):
    document = json.loads((transforms / "transforms.json").read_text())
    kept = {name: value for name, value in document.items() if name not in ("w", "h", "cx", "cy")}
    (transforms / "transforms.json").write_text(json.dumps({**kept, "fl_x": 9000.0, "fl_y": 9000.0}))
    file = transforms / "images" / "0000.png"
    head, data = b"IHDR" + struct.pack(">II", 13_300, 13_300), file.read_bytes()
    head += data[24:29]
    file.write_bytes(data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:])
    with pytest.raises(InputError, match=r"0000\.png has 13300×13300 pixels in [0-9,]+ bytes, expected at most 67,1"):
        load(transforms)


def test_other_formats_in_a_set_are_named(transforms):
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\nshowpage\n"
    (transforms / "mask.png").write_bytes(eps)
    change_frames(transforms, range(10), mask_path="mask.png")
    with pytest.raises(InputError, match=r"mask\.png is PostScript"):
        load(transforms)
    (transforms / "images" / "0003.png").write_bytes(eps)
    with pytest.raises(InputError, match=r"0003\.png is PostScript \(EPS\), which is not read"):
        load(transforms)


def test_masks_of_0_and_1_are_reported_and_grey_ones_refused(transforms):
    Image.fromarray(LABELS).save(transforms / "mask.png")
    change_frames(transforms, range(10), mask_path="mask.png")
    data = load(transforms)
    assert "masks such as mask.png: values are 0 and 1: 1 counts as white" in data.report
    assert (data.train[0].mask == SHAPE).all()
    Image.fromarray(GREY // 4).save(transforms / "mask.png")
    with pytest.raises(InputError, match=r"mask\.png is a mask of values from 0 to 63, expected at least 128"):
        load(transforms)
    Image.fromarray(np.ones((H, W), np.uint8)).save(transforms / "mask.png")
    assert load(transforms).train[0].mask.all()
