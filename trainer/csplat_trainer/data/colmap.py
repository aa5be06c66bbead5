"""COLMAP sets as people have them: a sparse model beside folders of pictures.

    images/ images_2/ images_4/ images_8/     the same pictures, smaller and smaller
    sparse/0/{cameras,images,points3D}.{bin,txt}

A `test.txt` beside the model, one name a line, names the test pictures. A folder `masks` holds masks, black where a
picture does not count, called like it, with or without `.png` at the end.
"""

from __future__ import annotations

import re
from pathlib import Path

from csplat.errors import InputError
from csplat_trainer.data.colmap_files import read_cameras, read_images, read_points
from csplat_trainer.data.dataset import Found, Shot, split_every
from csplat_trainer.data.pixels import find_image, image_size

__all__ = ["find_model", "read_colmap"]

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "distorted/sparse/0", ".")
_NAMED_MISSING = 5


def find_model(folder: Path) -> Path | None:
    """The folder of the sparse model inside a set's folder; `None` where there is none."""
    for inside in _MODEL_FOLDERS:
        if _file(folder / inside, "cameras") and _file(folder / inside, "images"):
            return folder / inside
    return None


def read_colmap(folder: Path, model: Path, size: tuple[int, int] | None, images: str | None, test_every: int) -> Found:
    """Read a COLMAP set, but for the pixels.

    Args:
        folder: the set's.
        model: the sparse model's.
        size: of the pictures that are wanted; chooses among the folders of pictures.
        images: the folder of pictures, by name; `None`: the smallest that is large enough.
        test_every: see `split_every`; used where there is no test.txt.

    Raises:
        InputError: a file is damaged, or no picture is there.
    """
    cameras_path, images_path = _file(model, "cameras"), _file(model, "images")
    assert cameras_path is not None
    assert images_path is not None
    cameras, registered = read_cameras(cameras_path), read_images(images_path)
    if not registered:
        raise InputError(f"{images_path} holds no pictures")
    pictures = _picture_folder(folder, [image.name for image in registered], size, images)
    report = [f"pictures from {pictures.name}"]
    shots, missing = [], []
    for image in registered:
        if image.camera not in cameras:
            raise InputError(f"{images_path}: {image.name} has camera {image.camera}, which {cameras_path} lacks")
        path = find_image(pictures / image.name)
        if path is None:
            missing.append(image.name)
        else:
            mask = find_image(folder / "masks" / image.name)
            shots.append(Shot(image.name, path, cameras[image.camera], image.viewmat, mask))
    if missing:
        shown = ", ".join(missing[:_NAMED_MISSING]) + (", …" if len(missing) > _NAMED_MISSING else "")
        report.append(f"{len(missing)} of {len(registered)} pictures are missing and left out: {shown}")
    if not shots:
        raise InputError(f"{pictures}: none of the {len(registered)} pictures is there ({missing[0]}, …)")
    points_path = _file(model, "points3D")
    points, colours = read_points(points_path) if points_path is not None else (None, None)
    named = _named(shots, model, folder, report)
    if named is not None:
        return Found("COLMAP set", *named, points, colours, report)
    train, test = split_every(shots, test_every)
    if test:
        report.append(f"no split is named: every {test_every}th picture is a test picture")
    return Found("COLMAP set", train, test, points, colours, report, test_every)


def _file(model: Path, name: str) -> Path | None:
    """A file of the model, binary before text."""
    return next((path for path in (model / f"{name}.bin", model / f"{name}.txt") if path.is_file()), None)


def _named(shots: list[Shot], model: Path, folder: Path, report: list[str]) -> tuple[list[Shot], list[Shot]] | None:
    """The split that a test.txt names; `None` where there is none."""
    for path in (model / "test.txt", folder / "test.txt"):
        if path.is_file():
            held = {line.strip() for line in path.read_text("utf-8").splitlines() if line.strip()}
            held |= {Path(name).stem for name in held}
            test = [shot for shot in shots if shot.name in held or Path(shot.name).stem in held]
            report.append(f"{path.name} names the test pictures")
            return [shot for shot in shots if shot not in test], test
    return None


def _picture_folder(folder: Path, names: list[str], size: tuple[int, int] | None, images: str | None) -> Path:
    """Where to read pictures from: the folder that was named, or the cheapest that is large enough."""
    if images is not None:
        if not (folder / images).is_dir():
            raise InputError(f"{folder} has no folder {images}")
        return folder / images
    present = [path for path in sorted(folder.iterdir()) if path.is_dir() and re.fullmatch(r"images(_\d+)?", path.name)]
    present = [path for path in present if any(find_image(path / name) for name in names)]
    if not present:
        raise InputError(f"{folder} has no folder of pictures: wanted images, images_2, images_4 or images_8")
    largest_first = sorted(present, key=lambda path: int(path.name.partition("_")[2] or 1))
    chosen = largest_first[0]
    if size is not None:
        for path in largest_first[1:]:
            first = next(file for name in names if (file := find_image(path / name)) is not None)
            width, height = image_size(first)
            if width >= size[0] and height >= size[1]:
                chosen = path
    return chosen
