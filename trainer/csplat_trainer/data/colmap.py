"""COLMAP sets as people have them: a sparse model next to folders of images.

    images/ images_2/ images_4/ images_8/     the same images, smaller and smaller
    sparse/0/{cameras,images,points3D}.{bin,txt}

A `test.txt` next to the model, one name a line, lists the test images, `val.txt` and `train.txt` the others. A folder
`masks` holds masks, black where an image does not count.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from csplat.errors import InputError, counted
from csplat.types import F32, F64
from csplat_trainer.data.colmap_files import ColmapImage, count_images, read_cameras, read_images, read_points
from csplat_trainer.data.dataset import Found, Shot
from csplat_trainer.data.image_files import find_images, find_masks, masks_among, missing_images
from csplat_trainer.data.lens import Lens
from csplat_trainer.data.point_cloud import read_point_cloud
from csplat_trainer.data.splits import lists_next_to, split_every, split_listed

#: With models in numbered folders, or one in itself; the last only if there is no other.
_MODEL_FOLDERS = (("sparse", "colmap/sparse"), ("distorted/sparse",))
_IMAGE_FOLDERS = ("images", "input", ".")
_UNDISTORTED_FIRST = "distorted"  # convert.py of 3DGS: images/ belongs to sparse/0, input/ to this folder's model


def find_model(folder: Path) -> tuple[Path, list[str]] | None:
    """Find the sparse model of a set: the one of most images, if there are several.

    Args:
        folder: the set's.

    Returns:
        The model's folder, and a line that names the others if there are any; `None` if there is no model.
    """
    for names in _MODEL_FOLDERS:
        inside = [folder / name for name in names if (folder / name).is_dir()]
        models = [path for one in inside for path in (*sorted(one.iterdir(), key=_number), one) if _is_model(path)]
        if models:
            return _largest(models, folder)
    return (folder, []) if _is_model(folder) else None


def read_colmap(folder: Path, model: Path, size: tuple[int, int] | None, images: str | None, test_every: int) -> Found:
    """Read a COLMAP set, but for the pixels.

    Args:
        folder: the set's.
        model: the sparse model's.
        size: of the images that are wanted; chooses among the folders of images.
        images: the folder of images, by name; `None`: the smallest that is large enough.
        test_every: see `split_every`; used where there is no test.txt.

    Raises:
        InputError: a file is damaged, or no image is there.
    """
    cameras_path, images_path = _file(model, "cameras"), _file(model, "images")
    assert cameras_path is not None
    assert images_path is not None
    registered, report = read_images(images_path)
    used = {image.camera for image in registered}
    cameras = read_cameras(cameras_path, used)
    same = images_path.with_suffix(".txt")
    if same != images_path and same.is_file() and (there := count_images(same)) != len(registered):
        what = f"{same.name} holds {counted(there, 'image')}, {images_path.name} {len(registered)}"
        report.append(f"{what}: {images_path.name} is read")
    other = cameras_path.with_suffix(".txt")
    if other != cameras_path and other.is_file() and not _agree(cameras, read_cameras(other, used)):
        report.append(f"{other.name} holds other cameras than {cameras_path.name}, which is read")
    if not registered:
        raise InputError(f"{images_path} holds no images")
    for image in registered:
        if image.camera not in cameras:
            raise InputError(f"{images_path}: {image.name} has camera {image.camera}, which {cameras_path} lacks")
    registered = _each_once(registered, images_path, report)
    names = [image.name for image in registered]
    found = find_images(folder, names, images_path.name, _folders(folder, model, images), size)
    report.append("images from " + ("the folder itself" if found.folder == folder else _relative(found.folder, folder)))
    report += found.notes
    report += missing_images([name for name in names if name not in found.files], len(names), images_path.name)
    masks = _masks(folder, found.files, report)
    shots = [
        Shot(image.name, found.files[image.name], cameras[image.camera], image.viewmat, masks.get(image.name))
        for image in registered
        if image.name in found.files
    ]
    points, colours = _points(model, report)
    lists, files = lists_next_to((model, model.parent, folder))
    if lists:
        train, val, test = split_listed(shots, lists, files, report)
        return Found("COLMAP set", train, test, points, colours, report, val=val)
    train, test = split_every(shots, test_every, report)
    return Found("COLMAP set", train, test, points, colours, report, test_every)


def _each_once(registered: list[ColmapImage], path: Path, report: list[str]) -> list[ColmapImage]:
    """Leave out images that are there again with the same pose and camera.

    Raises:
        InputError: an image has two poses or cameras.
    """
    first: dict[str, ColmapImage] = {}
    for image in registered:
        other = first.setdefault(PurePosixPath(image.name).as_posix(), image)
        if other.camera != image.camera or (other.viewmat != image.viewmat).any():
            raise InputError(
                f"{path}: {image.name} is there twice, with different poses or cameras; expected each once"
            )
    if len(first) < len(registered):
        report.append(f"{path.name}: {counted(len(registered) - len(first), 'image')} twice: read once")
    return list(first.values())


def _is_model(folder: Path) -> bool:
    return _file(folder, "cameras") is not None and _file(folder, "images") is not None


def _file(model: Path, name: str) -> Path | None:
    """Find a file of the model, binary before text; an empty one does not count if there is another."""
    there = [path for path in (model / f"{name}.bin", model / f"{name}.txt") if path.is_file()]
    return next((path for path in there if path.stat().st_size), there[0] if there else None)


def _number(path: Path) -> tuple[bool, int, str]:
    """Sort numbered folders by number, before others."""
    return not path.name.isdecimal(), int(path.name) if path.name.isdecimal() else 0, path.name


def _largest(models: list[Path], folder: Path) -> tuple[Path, list[str]]:
    if len(models) == 1:
        return models[0], []
    counts = [_count(model) for model in models]
    best = max(range(len(models)), key=counts.__getitem__)  # of equal ones the first
    said = [f"{counts[i]}" if counts[i] >= 0 else "no whole list of images" for i in range(len(models))]
    others = ", ".join(f"{_relative(models[i], folder)} has {said[i]}" for i in range(len(models)) if i != best)
    chosen = _relative(models[best], folder)
    return models[best], [
        f"there are {len(models)} models: {chosen} is read, with {counted(max(counts), 'image')}; {others}"
    ]


def _count(model: Path) -> int:
    """Count the images of a model; -1 if that is damaged."""
    path = _file(model, "images")
    try:
        return -1 if path is None else count_images(path)
    except InputError:
        return -1


def _folders(folder: Path, model: Path, images: str | None) -> tuple[str, ...]:
    """Name the folders to look for images in."""
    if images is not None:
        if not (folder / images).is_dir():
            raise InputError(f"{folder} has no folder {images}")
        return (images,)
    first, second, *others = _IMAGE_FOLDERS
    return (second, first, *others) if _UNDISTORTED_FIRST in _relative(model, folder).split("/") else _IMAGE_FOLDERS


def _agree(cameras: dict[int, Lens], others: dict[int, Lens]) -> bool:
    """Report whether cameras are the same, but for the digits that text leaves out."""

    def numbers(some: dict[int, Lens]) -> list[tuple[float, ...]]:
        return [(number, lens.width, lens.height, lens.fx, lens.cx) for number, lens in sorted(some.items())]

    return len(cameras) == len(others) and np.allclose(numbers(cameras), numbers(others), rtol=1e-4)


def _masks(folder: Path, images: dict[str, Path], report: list[str]) -> dict[str, Path]:
    """Find the masks of images; a folder of masks that fit none, or not all, is reported."""
    names = list(images)
    masks = find_masks(folder, names)
    if masks is None:
        report += masks_among(list(images.values()))
        return {}
    report += masks.notes
    without = [name for name in names if name not in masks.files]
    if without:
        share = f"{len(without)} of {counted(len(names), 'image')}"
        report.append(f"{masks.folder.name}/ has none for {share}: all pixels of {without[0]} count")
    return masks.files


def _points(model: Path, report: list[str]) -> tuple[F64, F32] | tuple[None, None]:
    """Read the points of a model; 3DGS keeps them as a PLY, too."""
    path = _file(model, "points3D")
    if path is not None:
        return read_points(path)
    if (model / "points3D.ply").is_file():
        report.append("points from points3D.ply")
        return read_point_cloud(model / "points3D.ply")
    return None, None


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)
