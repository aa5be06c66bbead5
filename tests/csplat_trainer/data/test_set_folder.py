# SPDX-License-Identifier: Apache-2.0
"""Data sets read files within their folder, and others only if the user trusts them."""

import os
import shutil
from pathlib import Path

import posed_sets as sets
import pytest
from posed_sets import assert_refused, cameras, change_frames, report_of
from typer.testing import CliRunner

from csplat_tools.cli.app import app
from csplat_trainer.data import load
from csplat_trainer.data.set_folder import SetFolder

COLUMNS = "property float x\nproperty float y\nproperty float z\n"
PLY = f"ply\nformat ascii 1.0\nelement vertex 1\n{COLUMNS}end_header\n1 2 3\n"


def swap_for_link(path, target):
    """Move a file or folder, and leave a link to it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(path, target)
    path.symlink_to(target, target_is_directory=target.is_dir())


def renamed(form):
    """Return a change of the names of all frames: {name} and {folder} are what they were."""

    def change(folder):
        for i, frame in enumerate(sets.frames_of(folder)):
            change_frames(folder, [i], file_path=form.format(name=frame["file_path"], folder=folder))

    return change


def dots(folder):
    shutil.move(folder / "images" / "0003.png", folder.parent / "secret.png")
    change_frames(folder, [3], file_path="../secret.png")


def mask(folder):
    sets.write_picture(folder.parent / "mask.png", cameras(1)[0])
    change_frames(folder, range(10), mask_path="../mask.png")


def points(folder):
    (folder.parent / "points.ply").write_text(PLY)
    sets.change_transforms(folder, ply_file_path=str(folder.parent / "points.ply"))


def colmap_name(folder):
    (folder / "images" / "im 003.png").rename(folder.parent / "im 003.png")
    sets.rename_in_images_txt(folder, lambda i: f"{'../../' * (i == 3)}im {i:03}.png")


def link_to(name, *, mask=None, text=None):
    """Return a change that replaces a file or folder by a link, after writing it as a mask or a text."""

    def change(folder):
        if mask is not None:
            sets.write_picture(folder / mask, cameras(9)[3])
        if text is not None:
            (folder / name).write_text(text)
        swap_for_link(folder / name, folder.parent / "elsewhere" / name)
        if mask == "mask.png":
            change_frames(folder, range(10), mask_path=mask)

    return change


#: Changes of each kind of set that make it read a file next to its folder.
OUTSIDE = {
    sets.write_transforms: {
        "..": dots, "a mask": mask, "points": points,
        "a device": lambda folder: change_frames(folder, [3], file_path="/dev/zero"),
        "points are a device": lambda folder: sets.change_transforms(folder, ply_file_path="/dev/zero"),
        "an image is a link": link_to("images/0003.png"), "images are a link": link_to("images"),
        "a mask is a link": link_to("mask.png", mask="mask.png"),
        "points are a link": link_to("sparse_pc.ply", text=PLY),
        "transforms.json is a link": link_to("transforms.json"),
    },
    sets.write_blender: {
        name: link_to(name) for name in ("transforms_train.json", "transforms_test.json", "train")
    },
    sets.write_colmap_set: {
        "a name": colmap_name, "an image is a link": link_to("images/im 003.png"), "images": link_to("images"),
        "the model": link_to("sparse"), "cameras.bin": link_to("sparse/0/cameras.bin"),
        "images.bin": link_to("sparse/0/images.bin"), "points3D.bin": link_to("sparse/0/points3D.bin"),
        "masks": link_to("masks", mask="masks/im 003.png"), "a list": link_to("test.txt", text="im 002.png\n"),
        "a mask": link_to("images/im 003.png.mask.png", mask="images/im 003.png.mask.png"),
    },
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
@pytest.mark.parametrize(("write", "name"), [(write, name) for write, changes in OUTSIDE.items() for name in changes])
def test_sets_that_read_outside_of_their_folder_are_refused_unless_trusted(tmp_path, write, name):
    folder = write(tmp_path / "set")
    OUTSIDE[write][name](folder)
    assert_refused("the folder of the data set: move it there, or allow it with --trust-pat", folder)
    assert len(load(folder, trust_paths=True).train) >= 5


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
    "a long name": lambda folder: sets.change_transforms(folder, ply_file_path="x" * 5000),
}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
@pytest.mark.parametrize("change", INSIDE.values(), ids=INSIDE)
def test_sets_within_their_folder_need_no_trust(tmp_path, change):
    folder = sets.write_transforms(tmp_path / "set")
    change(folder)
    assert 10 == len(load(folder, test_every=0).train)


def test_names_that_no_file_can_have_are_missing(transforms_set):
    for name in ("x" * 5000 + ".png", "a/" * 3000 + "b.png", "../" * 2000 + "b.png", "", "images"):
        change_frames(transforms_set, [3], file_path=name)
        data = load(transforms_set, test_every=0)
        assert 9 == len(data.train)
        assert max(map(len, data.report)) < 300


@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
def test_a_folder_of_images_that_the_user_names_may_be_a_link(tmp_path):
    folder = sets.write_colmap_set(tmp_path / "set")
    swap_for_link(folder / "images", tmp_path / "photos")
    assert 7 == len(load(folder / "images").train)
    assert_refused("is a link that leads out of", folder, images="images")  # as from the metadata of a scene
    assert_refused(r"\.\./photos is outside of", folder, images="../photos")


def test_no_server_is_asked_for_a_path(monkeypatch):
    asked = []
    monkeypatch.setattr("pathlib.Path.exists", lambda path: asked.append(path) or True)
    place = SetFolder(Path("set"))
    for name in ("//server/share/1.png", "\\\\server\\share\\1.png"):
        assert not place.finds_outside(place.path / name)
    assert [] == asked


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes on Windows")
def test_pipes_and_links_to_nowhere_are_no_files(colmap_set):
    (colmap_set / "images" / "im 003.png").unlink()
    for name in ("images/im 003.png", "images/IM 003.png", "test.txt", "points3D.ply"):
        os.mkfifo(colmap_set / name)
    (colmap_set / "images" / "im 005.png").unlink()
    (colmap_set / "images" / "im 005.png").symlink_to(colmap_set / "absent.png")
    assert "images.bin: 2 of 9 images are missing and dropped: im 003.png" in report_of(colmap_set)


@pytest.mark.slow
def test_the_option_is_taken_anywhere_on_the_command_line(tmp_path):
    dots(sets.write_transforms(tmp_path / "set"))
    words = ["train", str(tmp_path / "set"), str(tmp_path / "o.ply"), "--iterations", "1", "--quiet"]
    refused = CliRunner().invoke(app, words)
    assert (1, 1) == (refused.exit_code, len(refused.stderr.splitlines()))
    assert "--trust-paths (E_INPUT)" in refused.stderr
    assert not (tmp_path / "o.ply").exists()
    views = ["render", words[2], str(tmp_path / "r"), "--data", words[1]]
    for status, run in (
        (0, [*words[:2], "--trust-paths", *words[2:]]), (1, views), (0, ["--trust-paths", *views]),
        (2, ["info", words[2], "--trust-paths"]),
    ):  # fmt: skip
        assert status == CliRunner().invoke(app, run).exit_code
