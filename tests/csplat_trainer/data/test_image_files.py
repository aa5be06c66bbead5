# SPDX-License-Identifier: Apache-2.0
"""Images of data sets: names and the files they are found to be; values of every kind of pixel, and masks."""

import json
import re
import struct
import unicodedata
import zlib

import numpy as np
import posed_sets as sets
import pytest
from image_files_cases import GREY, LABELS, RGB, SHAPE, UINT16, png_16
from PIL import ExifTags, Image, ImageFile
from posed_sets import H, W, assert_refused, cameras, names, report_of, sizes

from csplat.errors import InputError
from csplat_trainer.data import load
from csplat_trainer.data.image_files import match_names

NFC, NFD = (unicodedata.normalize(form, "Köln.png") for form in ("NFC", "NFD"))


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


@pytest.mark.parametrize(("listed", "known", "expected", "words"), NAMES.values(), ids=NAMES)
def test_names_are_matched_loosely_only_without_an_exact_match(listed, known, expected, words):
    if expected is not None and "matches" in expected:
        with pytest.raises(InputError, match=re.escape(expected)):
            match_names([listed], known, "list.txt")
        return
    matched, notes = match_names([listed], known, "list.txt")
    assert ({} if expected is None else {listed: expected}) == matched
    assert ([] if words is None else [f"1 name of list.txt found {words}: {listed} is {expected}"]) == notes


def test_names_of_a_list_are_matched_together():
    known = ["images/1.png", "images_2/1.png", "images_2/2.png", "2.png"]  # a missing name is not searched elsewhere
    assert ({"images/1.png": "images/1.png"}, []) == match_names(["images/1.png", "images/2.png"], known, "x")
    with pytest.raises(InputError, match=r"x: A\.png and A\.PNG both match a\.png"):
        match_names(["A.png", "A.PNG"], ["a.png"], "x")
    assert {"1.png": "1.png"} == match_names(["1.jpg", "1.png"], ["1.png"], "x")[0]
    listed = ["K\xf6ln.png".encode("cp1252").decode("utf-8", "surrogateescape")]
    assert ({}, []) == match_names(listed, ["Koeln.png", "a.png"], "x")
    with pytest.raises(InputError, match="names match different files in Windows-1252 and CP437: rename"):
        match_names(listed, ["Köln.png", "K÷ln.png"], "x")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "folder", "note"),
    [
        ("im {:03}.png", "Images", "image folder: Images"), ("im {:03}.png", "images_2", "image folder: images_2"),
        ("im {:03}.png", "input", "image folder: input"), ("im {:03}.png", ".", "image folder: that of the set"),
        ("im {:03}.png", "images/deeper", "9 names of images.txt found in folders below"),
        ("D:\\photos\\im {:03}.jpg", "images", "9 names of images.txt found"), ("./im {:03}.png", "images", "images"),
    ],
)  # fmt: skip
def test_images_of_colmap_are_found_in_several_folders(colmap_set, name, folder, note):
    sets.rename_in_images_txt(colmap_set, name.format)
    move(colmap_set / "images", colmap_set / folder)
    data = load(colmap_set)
    assert (7, 0, 2) == sizes(data)
    assert any(note in line for line in data.report)
    sets.assert_dots_are_where_points_fall([*data.train, *data.test])


def test_training_and_test_images_must_be_different_files(blender_set):
    move(blender_set / "train", blender_set)
    move(blender_set / "test", blender_set / "away")
    assert_refused(r"train/r_0\.png and test/r_0\.png are both found as r_0\.png", blender_set)
    (blender_set / "transforms_test.json").unlink()
    assert 5 == len(load(blender_set).train)


def test_masks_are_found_like_images(transforms_set):
    (transforms_set / "masks").mkdir()
    for i in range(10):
        Image.fromarray(255 * LABELS).save(transforms_set / "masks" / f"{i:04}.png")
    assert "folder masks is ignored, since transforms.json does not" in report_of(transforms_set)
    for i in range(10):
        sets.change_frames(transforms_set, [i], mask_path=f"masks\\{i:04}.png")
    report = report_of(transforms_set)
    assert "masks hide parts of 10 images, which do not count" in report
    assert "10 names of transforms.json found with / for \\" in report


#: Title of a code page, its name, and names of files.
CODE_PAGES = [
    ("GBK", "gbk", "图像{}.png"), ("Shift-JIS", "cp932", "写真表示{}.png"),
    ("Shift-JIS", "cp932", "ソース{}.JPG"),  # with bytes of backslashes
    ("Big5", "big5", "圖像功能{}.png"), ("EUC-KR", "euc_kr", "사진{}.png"),
    ("Windows-1252", "cp1252", "Gebäude_{}.png"), ("Windows-1251", "cp1251", "Дом_{}.png"),
    ("Windows-1250", "cp1250", "Łódź_{}.png"), ("CP437", "cp437", "Größe_{}.png"),
]  # fmt: skip


@pytest.mark.parametrize(("title", "page", "form"), CODE_PAGES)
def test_names_in_other_code_pages_are_matched_by_their_bytes(title, page, form):
    files = [form.format(i) for i in range(3)]
    raw = [name.encode(page).decode("utf-8", "surrogateescape") for name in files]
    misread = [name.encode("utf-8").decode("cp437") for name in files]
    for listed, known in ((raw, files), (files, raw), (misread, files), (files, misread)):
        matched, (note,) = match_names(listed, known, "images.bin")
        assert dict(zip(listed, known, strict=True)) == matched
        assert f"found in the code page {title if raw in (listed, known) else ''}" in note
        note.encode("utf-8")


@pytest.mark.slow
def test_sets_with_names_in_another_code_page_are_read(colmap_text_set):
    files = [f"面図表{i}.png" for i in range(10)]  # in code page 932, some bytes are backslashes
    model, document = colmap_text_set / "sparse" / "0", colmap_text_set / "transforms.json"
    sets.rename_in_images_txt(colmap_text_set, files.__getitem__)
    (model / "images.txt").write_bytes((model / "images.txt").read_text("utf-8").encode("cp932"))
    (colmap_text_set / "test.txt").write_bytes(files[2].encode("cp932"))
    for i, name in enumerate(files[:9]):
        (colmap_text_set / "images" / f"im {i:03}.png").rename(colmap_text_set / "images" / name)
    assert [files[2]] == names(load(colmap_text_set).test)
    sets.write_colmap(model, cameras(9))
    data = (model / "images.bin").read_bytes()
    for i, name in enumerate(files):
        data = data.replace(b"im %03d.png\0" % i, name.encode("cp932") + b"\0")
    (model / "images.bin").write_bytes(data)
    read = load(colmap_text_set)
    assert ([files[2]], True) == (names(read.test), files[3] in names(read.train))
    assert any("9 names of images.bin found in the code page" in line for line in read.report)
    sets.write_transforms(colmap_text_set)
    for i, name in enumerate(files):
        sets.change_frames(colmap_text_set, [i], file_path=f"images/{name}")
    text = json.dumps(json.loads(document.read_text()), ensure_ascii=False)
    document.write_bytes(text.encode("cp932"))
    read = load(document)
    assert [f"images/{name}" for name in files[:9]] == sorted(names([*read.train, *read.test]))


def test_masks_that_fit_no_image_are_reported(colmap_set):
    sets.write_picture(colmap_set / "images" / "im 003_mask.png", cameras(9)[3])
    assert "masks next to the images, such as im 003_mask.png" in report_of(colmap_set)
    sets.write_picture(colmap_set / "masks" / "other.png", cameras(9)[0])
    assert "masks/ has no masks for 9 of 9 images" in report_of(colmap_set)
    sets.write_picture(colmap_set / "masks" / "IM 003.png", cameras(9)[3])
    report = report_of(colmap_set)
    assert "masks/ has no masks for 8 of 9 images: all pixels of im 000.png count" in report
    assert "1 name of masks/ found in another case: im 003.png is IM 003.png" in report


@pytest.mark.slow
@pytest.mark.parametrize("name", [
    "masks/im 003.png", "masks/im 003.png.png", "masks/im 003.jpg", "Masks/im 003.png", "mask/im 003_mask.png",
    "masks/mask_im 003.jpg", "masks/im 003.mask.png", "masks/im 003.png.mask.png", "masks/IM 003.PNG.MASK.PNG",
    "_mask/im 003.png", "masks/im 003.png_mask.png", "images/im 003.png.mask.png", "images/im 003.PNG.Mask.png",
])  # fmt: skip
def test_masks_have_names_of_several_programs(colmap_set, name):
    sets.write_picture(colmap_set / name, cameras(9)[3])
    data = load(colmap_set)
    assert (7, 0, 2) == sizes(data)
    assert "masks hide parts of 1 image, which do not count" in data.report
    assert ["im 003.png"] == names(picture for picture in data.train if picture.masked is not None)


def test_hidden_files_are_ignored(colmap_set):
    for folder in (".cache", "__MACOSX", "images/set"):
        (colmap_set / folder).mkdir()
    for path in list((colmap_set / "images").glob("*.png")):
        for name in (f".cache/{path.name}", f"__MACOSX/{path.name}", f"images/set/._{path.name}"):
            (colmap_set / name).write_bytes(path.read_bytes())
        path.rename(path.parent / "set" / path.name)
    assert 9 == len(load(colmap_set, test_every=0).train)


def move(source, target):
    """Move the files of a folder."""
    files = list(source.iterdir())
    target.mkdir(parents=True, exist_ok=True)
    for path in files:
        path.rename(target / path.name)
    if source != target and not any(source.iterdir()):
        source.rmdir()


def test_a_set_reports_how_its_pixels_are_read(transforms_set):
    red, blue = (Image.new("RGB", (W, H), colour) for colour in ("red", "blue"))
    for write, line in (
        (lambda path: Image.fromarray((UINT16 // 16)).save(path), "10 images of 16-bit grey: 0 to 65535 is read as"),
        (lambda path: png_16(path, (RGB.astype(">u2") << 4).astype(">u2")), "10 images of 16-bit colours: 0 to 255 is"),
        (lambda path: red.save(path, save_all=True, append_images=[blue]), "10 files with several images: the first"),
    ):
        for path in (transforms_set / "images").iterdir():
            write(path)
        data = load(transforms_set)
        assert any(note.startswith(line) for note in data.report)
    assert (data.train[0].pixels == (255, 0, 0)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("orientation", "kind"),
    [(1, "stored"), (3, "ambiguous"), (6, "stored"), (6, "square"), (6, "lying"), (8, "lying")],
)
def test_exif_rotation_is_applied_if_it_is_unambiguous_and_the_camera_is_upright(transforms_set, orientation, kind):
    exif, turned = Image.Exif(), {6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
    exif[ExifTags.Base.Orientation] = orientation
    for path in (transforms_set / "images").iterdir():
        with Image.open(path) as image:
            image.load()
        image = Image.new("RGB", (W, W)) if kind == "square" else image
        (image.transpose(turned[orientation]) if kind == "lying" else image).save(path, exif=exif)
    if kind == "square":  # otherwise, 6 would swap the sides, which contradicts the cameras
        sets.change_transforms(transforms_set, h=W, cy=W / 2)
    data = load(transforms_set)
    if kind != "square":
        assert {(W, H)} == {(picture.camera.W, picture.camera.H) for picture in data.train}
        sets.assert_dots_are_where_points_fall([*data.train, *data.test])
    if kind == "lying":
        sets.change_transforms(transforms_set, w=H, h=W, cx=H / 2, cy=W / 2)
        assert (H, W) == load(transforms_set).train[0].pixels.shape[1::-1]
        return
    line = f"EXIF turns 10 images (0001.png: orientation {orientation}): read as stored"
    notes = [note for note in data.report if "EXIF" in note]
    assert [line in note for note in notes] == [True] * (kind in ("ambiguous", "square"))


def test_images_and_masks_much_larger_than_their_cameras_are_refused_before_decoding(transforms_set, monkeypatch):
    path, large = transforms_set / "images" / "0003.png", Image.new("1", (6000, 4000))
    original = path.read_bytes()
    for name in (path, transforms_set / "mask.png"):
        large.save(name)
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda file: pytest.fail(f"{file.filename} is decoded"))
    assert_refused(r"0003\.png has 6000×4000 pixels, expected about 48×32 as its camera", transforms_set)
    path.write_bytes(original)
    sets.change_frames(transforms_set, range(10), mask_path="mask.png")
    assert_refused(r"mask\.png has 6000×4000 pixels, expected about 48×32 as its image", transforms_set)


def test_other_formats_are_named_and_images_without_a_camera_have_a_budget(transforms_set):
    file, frames = transforms_set / "images" / "0000.png", sets.frames_of(transforms_set)
    data = file.read_bytes()
    sets.change_frames(transforms_set, range(10), mask_path="mask.png")
    for name in ("mask.png", "images/0000.png"):
        (transforms_set / name).write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\nshowpage\n")
        assert_refused(rf"{name[-8:]} is PostScript \(EPS\), which is not read", transforms_set)
    document = {"fl_x": 9000.0, "fl_y": 9000.0, "frames": frames}
    (transforms_set / "transforms.json").write_text(json.dumps(document))
    head = b"IHDR" + struct.pack(">II", 13_300, 13_300) + data[24:29]
    file.write_bytes(data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:])
    assert_refused(r"0000\.png has 13300×13300 pixels in [0-9,]+ bytes, expected at most 67,1", transforms_set)


def test_masks_of_other_values_or_sizes_are_read_or_refused(transforms_set):
    file = transforms_set / "mask.png"
    sets.change_frames(transforms_set, range(10), mask_path="mask.png")
    assert_refused(r"mask 'mask\.png' of images/0000\.png does not exist", transforms_set)
    Image.new("L", (W, H)).save(file)
    with pytest.raises(InputError, match=r"the mask of images/000\d\.png hides all of it"):
        load(transforms_set).read()
    for values, message in (
        (GREY // 4, r"mask\.png is a mask of values from 0 to 63, expected at least 128"),
        (np.full((W, W), 255, np.uint8), r"mask\.png has 48×48 pixels, expected the aspect ratio of 48×32, that of"),
    ):
        Image.fromarray(values).save(file)
        assert_refused(message, transforms_set)
    for values in (np.full((H // 2, W // 2), 255, np.uint8), np.ones((H, W), np.uint8)):
        Image.fromarray(values).save(file)
        assert load(transforms_set).train[0].mask.all()
    Image.fromarray(LABELS).save(file)
    data = load(transforms_set)
    assert "masks such as mask.png: values are 0 and 1: 1 counts as white" in data.report
    assert (data.train[0].mask == SHAPE).all()
