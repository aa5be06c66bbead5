"""Data sets read files within their folder, and others only if the user trusts them."""

import os
import shutil
from pathlib import Path

import pytest
from posed_sets import (
    cameras,
    change_frames,
    change_transforms,
    frames_of,
    rename_in_images_txt,
    write_blender,
    write_colmap_set,
    write_picture,
    write_transforms,
)
from tables import failures
from typer.testing import CliRunner

from csplat.errors import InputError
from csplat_tools.cli.app import app
from csplat_trainer.data import load
from csplat_trainer.data.set_folder import SetFolder

pytest.importorskip("numba", reason="requires the extra [render]")


PLY = "ply\nformat ascii 1.0\nelement vertex 1\n" + "property float {}\n" * 3 + "end_header\n1 2 3\n"


def copied(write, parent):
    """Return a new copy of the set that `write` writes, alone in a folder."""
    master = parent / write.__name__
    if not master.exists():
        write(master)
    return Path(shutil.copytree(master, parent / str(len(list(parent.iterdir()))) / "set"))


def swap_for_link(path, target):
    """Move a file or folder, and leave a link to it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(path, target)
    path.symlink_to(target, target_is_directory=target.is_dir())


def renamed(form):
    """Return a change of the names of all frames: {name} and {folder} are what they were."""

    def change(folder):
        for i, frame in enumerate(frames_of(folder)):
            change_frames(folder, [i], file_path=form.format(name=frame["file_path"], folder=folder))

    return change


def dots(folder):
    shutil.move(folder / "images" / "0003.png", folder.parent / "secret.png")
    change_frames(folder, [3], file_path="../secret.png")


def absolute(folder):
    dots(folder)
    change_frames(folder, [3], file_path=str(folder.parent / "secret.png"))


def all_outside(folder):
    shutil.move(folder / "images", folder.parent / "images")
    renamed("../{name}")(folder)


def mask(folder):
    write_picture(folder.parent / "mask.png", cameras(1)[0])
    change_frames(folder, range(10), mask_path="../mask.png")


def mask_link(folder):
    write_picture(folder / "mask.png", cameras(1)[0])
    swap_for_link(folder / "mask.png", folder.parent / "mask.png")
    change_frames(folder, range(10), mask_path="mask.png")


def mask_of_colmap(folder):
    write_picture(folder / "masks" / "im 003.png", cameras(9)[3])
    swap_for_link(folder / "masks", folder.parent / "masks")


def mask_next_to_image(folder):
    write_picture(folder / "images" / "im 003.png.mask.png", cameras(9)[3])
    swap_for_link(folder / "images" / "im 003.png.mask.png", folder.parent / "mask.png")


def points(folder):
    (folder.parent / "points.ply").write_text(PLY.format(*"xyz"))
    change_transforms(folder, ply_file_path=str(folder.parent / "points.ply"))


def points_link(folder):
    (folder / "sparse_pc.ply").write_text(PLY.format(*"xyz"))
    swap_for_link(folder / "sparse_pc.ply", folder.parent / "points.ply")


def listed(folder):
    (folder.parent / "list.txt").write_text("im 002.png\n")
    (folder / "test.txt").symlink_to(folder.parent / "list.txt")


def colmap_name(folder):
    (folder / "images" / "im 003.png").rename(folder.parent / "im 003.png")
    rename_in_images_txt(folder, lambda i: f"{'../../' * (i == 3)}im {i:03}.png")


def link_to(*names):
    def change(folder):
        for name in names:
            swap_for_link(folder / name, folder.parent / "elsewhere" / name)

    return change


#: Kind of the set, and a change that makes it read a file next to its folder.
OUTSIDE = {
    "..": (write_transforms, dots),
    "an absolute path": (write_transforms, absolute),
    "all images": (write_transforms, all_outside),
    "a device": (write_transforms, lambda folder: change_frames(folder, [3], file_path="/dev/zero")),
    "points are a device": (write_transforms, lambda folder: change_transforms(folder, ply_file_path="/dev/zero")),
    "an image is a link": (write_transforms, link_to("images/0003.png")),
    "the folder of images is a link": (write_transforms, link_to("images")),
    "a mask": (write_transforms, mask),
    "a mask is a link": (write_transforms, mask_link),
    "points": (write_transforms, points),
    "points are a link": (write_transforms, points_link),
    "transforms.json is a link": (write_transforms, link_to("transforms.json")),
    "transforms_train.json is a link": (write_blender, link_to("transforms_train.json")),
    "transforms_test.json is a link": (write_blender, link_to("transforms_test.json")),
    "training images are a link": (write_blender, link_to("train")),
    "a name of COLMAP": (write_colmap_set, colmap_name),
    "an image of COLMAP is a link": (write_colmap_set, link_to("images/im 003.png")),
    "images of COLMAP are a link": (write_colmap_set, link_to("images")),
    "the model is a link": (write_colmap_set, link_to("sparse")),
    "cameras.bin is a link": (write_colmap_set, link_to("sparse/0/cameras.bin")),
    "images.bin is a link": (write_colmap_set, link_to("sparse/0/images.bin")),
    "points3D.bin is a link": (write_colmap_set, link_to("sparse/0/points3D.bin")),
    "masks of COLMAP are a link": (write_colmap_set, mask_of_colmap),
    "a mask next to an image is a link": (write_colmap_set, mask_next_to_image),
    "the list of test images is a link": (write_colmap_set, listed),
}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
def test_sets_that_read_outside_of_their_folder_are_refused_unless_trusted(tmp_path):
    def check(case):
        write, change = case
        folder = copied(write, tmp_path)
        change(folder)
        with pytest.raises(InputError, match="the folder of the data set: move it there, or allow it with --trust-pat"):
            load(folder)
        assert len(load(folder, trust_paths=True).train) >= 5

    assert [] == failures(OUTSIDE, check)


def into_link(folder):
    shutil.move(folder, folder.parent / "elsewhere")
    folder.symlink_to(folder.parent / "elsewhere", target_is_directory=True)


def other_copy(folder):
    """Name the images of the folder from which the set was copied, which still exists."""
    shutil.copytree(folder / "images", folder.parent / "original" / "images")
    renamed(f"{folder.parent}/original/{{name}}")(folder)


INSIDE = {
    "the set is a link": into_link,
    "images are a link within the set": lambda folder: swap_for_link(folder / "images", folder / "originals"),
    "absolute paths into the set": renamed("{folder}/{name}"),
    "dots that lead back": renamed("../set/{name}"),
    "absolute paths of another machine": renamed("/home/me/scan/{name}"),
    "a share": renamed("\\\\server\\share\\{name}"),
    "a share with slashes": renamed("//server/share/{name}"),
    "a drive": renamed("Z:\\scan\\{name}"),
    "a URL of a file": renamed("file:///home/me/{name}"),
    "a home folder": renamed("~/{name}"),
    "paths of the original set": other_copy,
    "a long name": lambda folder: change_transforms(folder, ply_file_path="x" * 5000),
}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
def test_sets_within_their_folder_need_no_trust(tmp_path):
    def check(change):
        folder = copied(write_transforms, tmp_path)
        change(folder)
        assert 10 == len(load(folder, test_every=0).train)

    assert [] == failures(INSIDE, check)


def test_names_that_no_file_can_have_are_missing(tmp_path):
    write_transforms(tmp_path)
    for name in ("x" * 5000 + ".png", "a/" * 3000 + "b.png", "../" * 2000 + "b.png", "", "images"):
        change_frames(tmp_path, [3], file_path=name)
        data = load(tmp_path, test_every=0)
        assert 9 == len(data.train)
        assert max(map(len, data.report)) < 300


@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
def test_a_folder_of_images_that_the_user_names_may_be_a_link(tmp_path):
    write_colmap_set(tmp_path / "set")
    swap_for_link(tmp_path / "set" / "images", tmp_path / "photos")
    assert 7 == len(load(tmp_path / "set" / "images").train)
    with pytest.raises(InputError, match="is a link that leads out of"):
        load(tmp_path / "set", images="images")  # as from the metadata of a scene
    with pytest.raises(InputError, match=r"\.\./photos is outside of"):
        load(tmp_path / "set", images="../photos")


def test_no_server_is_asked_for_a_path(monkeypatch):
    asked = []
    monkeypatch.setattr("pathlib.Path.exists", lambda path: asked.append(path) or True)
    place = SetFolder(Path("set"))
    for name in ("//server/share/1.png", "\\\\server\\share\\1.png"):
        assert not place.finds_outside(place.path / name)
    assert [] == asked


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes on Windows")
def test_pipes_in_a_set_are_no_files(tmp_path):
    write_colmap_set(tmp_path)
    (tmp_path / "images" / "im 003.png").unlink()
    for name in ("images/im 003.png", "images/IM 003.png", "test.txt", "points3D.ply"):
        os.mkfifo(tmp_path / name)
    data = load(tmp_path)
    assert "images.bin: 1 of 9 images are missing and dropped: im 003.png" in data.report


@pytest.mark.slow
def test_the_option_is_taken_anywhere_on_the_command_line(tmp_path):
    write_transforms(tmp_path / "set")
    dots(tmp_path / "set")
    words = ["train", str(tmp_path / "set"), str(tmp_path / "o.ply"), "--iterations", "1", "--quiet"]
    refused = CliRunner().invoke(app, words)
    assert 1 == refused.exit_code
    assert "--trust-paths (E_INPUT)" in refused.stderr
    assert 1 == len(refused.stderr.splitlines())
    assert not (tmp_path / "o.ply").exists()
    assert 0 == CliRunner().invoke(app, [*words[:2], "--trust-paths", *words[2:]]).exit_code
    views = ["render", words[2], str(tmp_path / "r"), "--data", words[1]]
    assert 1 == CliRunner().invoke(app, views).exit_code
    assert 0 == CliRunner().invoke(app, ["--trust-paths", *views]).exit_code
    assert 2 == CliRunner().invoke(app, ["info", str(tmp_path / "o.ply"), "--trust-paths"]).exit_code
