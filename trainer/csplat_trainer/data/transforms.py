# SPDX-License-Identifier: Apache-2.0
"""Readers of `transforms*.json`: sets of NeRF-synthetic (Blender), instant-ngp and nerfstudio.

Both hold camera-to-world matrices with OpenGL axes: x to the right, y up, z backwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from csplat.disk_files import read_json
from csplat.errors import InputError, counted
from csplat.types import F32, F64
from csplat_render.camera_files import (
    PERSPECTIVES,
    describe_scales,
    finite_number,
    focal_lengths,
    frame_values,
    viewmat_of_opengl,
)
from csplat_trainer.data.dataset import (
    ROLES,
    Shot,
    UnreadDataSet,
    read_point_cloud,
    read_split_lists,
    split_every,
    split_listed,
)
from csplat_trainer.data.image_files import (
    FoundImages,
    NoImagesError,
    abbreviate,
    describe_missing,
    find_images,
    normalise_name,
    printable,
)
from csplat_trainer.data.image_pixels import image_size, read_image_header
from csplat_trainer.data.lens import SPLIT_PANORAMAS, UNDISTORTER, Lens, is_panorama
from csplat_trainer.data.set_folder import SetFolder

_POINT_CLOUDS = ("sparse_pc.ply", "points3d.ply", "points3D.ply", "pointcloud.ply")
_BLENDER_AXES = "RFU"  # seen from the front: x to the right, y away, z up
_RATIONAL = "FULL_OPENCV"
_LIST_SHOWN_MAX, _NAME_SHOWN_MAX = 80, 200  # characters of a list and of a name in a message
_FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def read_blender(place: SetFolder, images: str | None = None) -> UnreadDataSet:
    """Read a set with `transforms_train.json` and, usually, `transforms_test.json` and `transforms_val.json`.

    Args:
        place: the folder of the files.
        images: name of the folder of images; `None`: from the files.

    Raises:
        InputError: a file has unexpected contents, or no image is found.
    """
    report: list[str] = []
    folder = place.path
    train_path = folder / "transforms_train.json"
    train = _read_shots(place, _read_document(place, train_path), train_path, images, report)
    test_path = folder / "transforms_test.json"
    if test_path.is_file():
        test = _read_shots(place, _read_document(place, test_path), test_path, images, report, needed=False)
    else:
        test = []
        report.append("there is no transforms_test.json: no test images")
    val_path = folder / "transforms_val.json"
    val = []
    if val_path.is_file():
        val = _read_shots(place, _read_document(place, val_path), val_path, images, report, needed=False)
    _check_distinct([*train, *test, *val], folder)
    points, colours = _read_points_next_to(train, place, report)
    return UnreadDataSet("Blender set", train, test, points, colours, report, coordinate_system=_BLENDER_AXES, val=val)


def read_transforms(place: SetFolder, path: Path, test_every: int, images: str | None = None) -> UnreadDataSet:
    """Read instant-ngp's `transforms.json`, or nerfstudio's, which may list a split and name a point cloud.

    Args:
        place: the folder of the set.
        path: the file, in this folder.
        test_every: see `split_every`; used if the file lists neither training, validation nor test images.
        images: name of the folder of images; `None`: from the file.

    Raises:
        InputError: the file has unexpected contents, or no image is found.
    """
    document, report = _read_document(place, path), list[str]()
    shots = _read_shots(place, document, path, images, report)
    points, colours = _read_points(place, document, shots, path, report)
    if "test_frames" in document:  # ScanNet++
        test = _read_shots(place, document, path, images, report, key="test_frames", needed=False)
        return UnreadDataSet("transforms.json set", shots, test, points, colours, report)
    lists = {role: names for role in ROLES if (names := _read_list(document, f"{role}_filenames", path))}
    files = path.name
    if not lists:
        lists, files = read_split_lists(place, (path.parent,))
    if lists:
        train, val, test = split_listed(shots, lists, files, report)
        return UnreadDataSet("transforms.json set", train, test, points, colours, report, val=val)
    train, test = split_every(shots, test_every, report)
    return UnreadDataSet("transforms.json set", train, test, points, colours, report, test_every)


def _check_distinct(shots: Sequence[Shot], folder: Path) -> None:
    """Refuse files that match several names, such as test/r_0 and train/r_0 if only r_0.png exists."""
    names: dict[Path, str] = {}
    for shot in shots:
        earlier = names.setdefault(shot.path, shot.name)
        if earlier != shot.name:
            raise InputError(f"{folder}: {earlier} and {shot.name} are both found as {shot.path.relative_to(folder)}")


@dataclass(frozen=True)
class _Frame:
    """An entry of a list of frames.

    Attributes:
        name: its file_path.
        number: its index in the list.
        values: all its values.
    """

    name: str
    number: int
    values: Mapping[str, Any]


def _read_shots(
    place: SetFolder,
    document: Mapping[str, Any],
    path: Path,
    images: str | None,
    report: list[str],
    *,
    key: str = "frames",
    needed: bool = True,
) -> list[Shot]:
    """Read the frames of a document that have an image and a pose; pixels stay unread.

    Args:
        place: the folder of the set.
        document: contents of the file.
        path: the file.
        images: name of the folder of images; `None`: from the file.
        report: lines on omitted frames, and on how images were found, are appended.
        key: name of the list of frames.
        needed: require at least one frame with an image.

    Raises:
        NoImagesError: `needed`, and no image exists.
        InputError: a frame is invalid, or an image or the folder of images is outside of the set.
    """
    folder = path.parent
    frames = _check_frames(document, key, path, report, needed=needed)
    names = [frame.name for frame in frames]
    try:
        if images is not None and not place.holds(folder / images):
            raise place.refusal(Path(images))
        image_files = (
            find_images(place, names, path.name, _image_folders(names, images)) if names else FoundImages(folder, {})
        )
    except NoImagesError:
        if needed:
            raise
        image_files = FoundImages(folder, {})
    if image_files.folder != folder:
        report.append(f"image folder: {image_files.folder.relative_to(folder).as_posix()}")
    report += image_files.notes
    report += describe_missing([name for name in names if name not in image_files.files], len(names), path.name)
    masks = _find_frame_masks(place, frames, path, report)
    shots = []
    for frame in frames:
        if frame.name in image_files.files:
            image, where = image_files.files[frame.name], f"{path}, frame {frame.number}"
            lens = _read_lens(frame_values(document, frame.values), image, where)
            viewmat = viewmat_of_opengl(frame.values.get("transform_matrix"), "transform_matrix", where)
            name = _display_name(frame.name, image, place.path)
            shots.append(Shot(name, image, lens, viewmat, masks.get(frame.name)))
    report += describe_scales(
        [frame.values["transform_matrix"] for frame in frames if frame.name in image_files.files], path.name
    )
    return shots


def _check_frames(
    document: Mapping[str, Any], field: str, path: Path, report: list[str], *, needed: bool
) -> list[_Frame]:
    """Check the frames of a list, and drop those that are marked as bad, have no finite pose, or are repeated.

    Frames without `transform_matrix` are kept; they are refused when their pose is read, if their image exists.

    Args:
        document: contents of the file.
        field: name of the list.
        path: the file, for messages.
        report: a line for each reason to drop frames is appended.
        needed: require at least one frame.

    Raises:
        InputError: the list or a frame is invalid, or a name occurs with two poses.
    """
    frames = document.get(field)
    if not isinstance(frames, list) or (needed and not frames):
        raise InputError(f"{path} lists no {field}")
    good: dict[str, _Frame] = {}
    bad, lost, repeated = [], [], []
    for number, frame in enumerate(frames):
        if not isinstance(frame, Mapping) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}, frame {number} has no file_path")
        name = frame["file_path"]
        if any(character < " " for character in name):
            raise InputError(f"{path}, frame {number}: file_path has control characters")
        key = PurePosixPath(name).as_posix()
        if frame.get("is_bad") is True:
            bad.append(name)
        elif _has_lost_pose(frame):
            lost.append(name)
        elif "transform_matrix" not in frame and "transform_matrix_start" in frame:
            raise InputError(
                f"{path}, frame {number} has no transform_matrix, but one for the start and one for the end of its"
                " exposure: rolling shutters are not supported"
            )
        elif key not in good:
            good[key] = _Frame(name, number, frame)
        elif good[key].values.get("transform_matrix") == frame.get("transform_matrix"):
            repeated.append(name)
        else:
            raise InputError(f"{path}, frame {number}: {name} occurs twice, with different poses; expected each once")
    for words, names in (("marked as bad", bad), ("without a finite pose", lost)):
        if names:
            report.append(f"{path.name}: {counted(len(names), 'frame')} {words}, dropped: {abbreviate(names)}")
    if repeated:
        report.append(f"{path.name}: {counted(len(repeated), 'frame')} repeated, read once: {abbreviate(repeated)}")
    if needed and not good:
        raise InputError(f"{path}: none of its {len(frames)} frames has a pose")
    return list(good.values())


def _has_lost_pose(frame: Mapping[str, Any]) -> bool:
    """Return True if a frame's pose is null, or has a number that is not finite, as when tracking was lost."""
    if "transform_matrix" not in frame:
        return False
    matrix = frame["transform_matrix"]
    try:
        return matrix is None or not np.isfinite(np.array(matrix, np.float64)).all()
    except (TypeError, ValueError, OverflowError):
        return False  # invalid contents are reported later


def _image_folders(names: Sequence[str], images: str | None) -> list[str]:
    """Return the folders to search for images: the names' folder, then its last part, then the usual folders."""
    if images is not None:
        return [images]
    own = PurePosixPath(normalise_name(names[0])).parent
    return [".", *([] if own.is_absolute() else [str(own)]), own.name or ".", "images", "input"]


def _find_frame_masks(place: SetFolder, frames: Sequence[_Frame], path: Path, report: list[str]) -> dict[str, Path]:
    """Find the masks that frames name in `mask_path`, as in nerfstudio: black for pixels that do not count.

    Returns:
        Mask files by names of frames; a frame without `mask_path` has no mask.

    Raises:
        InputError: a `mask_path` is not a string, or a mask does not exist.
    """
    named: dict[str, str] = {}
    for frame in frames:
        mask = frame.values.get("mask_path")
        if mask not in (None, ""):
            if not isinstance(mask, str):
                raise InputError(f"{path}, frame {frame.number}: mask_path is {mask!r}, expected a name")
            named[frame.name] = mask
    if not named:
        if (path.parent / "masks").is_dir():
            report.append(f"the folder masks is ignored, since {path.name} does not refer to it (mask_path)")
        return {}
    try:
        masks = list(dict.fromkeys(named.values()))
        mask_files = find_images(place, masks, path.name, _image_folders(masks, None))
    except NoImagesError:
        mask_files = FoundImages(path.parent, {})
    report += mask_files.notes
    missing = next(((name, mask) for name, mask in named.items() if mask not in mask_files.files), None)
    if missing is not None:
        name, mask = missing
        raise InputError(f"{path}: the mask {mask[:_NAME_SHOWN_MAX]!r} of {abbreviate([name])} does not exist")
    return {name: mask_files.files[mask] for name, mask in named.items()}


def _read_points(
    place: SetFolder, document: Mapping[str, Any], shots: Sequence[Shot], path: Path, report: list[str]
) -> tuple[F64 | None, F32 | None]:
    """Read points and colours [M, 3] of nerfstudio's `ply_file_path`, in the coordinates of the cameras.

    Without `ply_file_path`, the points next to the set are read. If the named file does not exist, there are none.

    Raises:
        InputError: `ply_file_path` is not a string, is outside of the set, or is not a complete PLY.
    """
    name = document.get("ply_file_path")
    if name is None:
        return _read_points_next_to(shots, place, report)
    if not isinstance(name, str):
        raise InputError(f"{path}: ply_file_path is {name!r}, expected a name")
    candidates = (
        path.parent / name,
        path.parent / normalise_name(name),
        path.parent / PurePosixPath(normalise_name(name)).name,
    )
    cloud = next((candidate for candidate in candidates if place.finds(candidate)), None)
    if cloud is None and place.finds_outside(candidates[0]):
        raise place.refusal(Path(name), f"{path.name}, ply_file_path")
    if cloud is None:
        report.append(f"{path.name}: ply_file_path {abbreviate([name])} does not exist: no points")
        return None, None
    report.append(f"points from {cloud.name}")
    return read_point_cloud(place.checked(cloud, path.name))


def _read_points_next_to(train: Sequence[Shot], place: SetFolder, report: list[str]) -> tuple[F64 | None, F32 | None]:
    """Read the points and colours [M, 3] that 3DGS and similar programs write next to a Blender set.

    If images have transparency, points are ignored: they are often random, and the visual hull is better.
    """
    cloud = next((path for name in _POINT_CLOUDS if (path := place.path / name).is_file()), None)
    if cloud is None:
        return None, None
    if train and read_image_header(train[0].path).has_alpha:
        report.append(f"{cloud.name} is ignored: the images' transparency determines where splats start")
        return None, None
    report.append(f"points from {cloud.name}")
    return read_point_cloud(place.checked(cloud))


def _read_list(document: Mapping[str, Any], key: str, path: Path) -> list[str]:
    """Return the names under a key, [] if it is absent or null; raise an `InputError` if they are no list of names."""
    names = document.get(key)
    if names is None:
        return []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: {key} is {str(names)[:_LIST_SHOWN_MAX]}, expected a list of names")
    return names


def _display_name(name: str, image: Path, folder: Path) -> str:
    """Return an image's name without `./`, with the ending that Blender omits; if not UTF-8, its name on disk."""
    if name != printable(name) and image.is_relative_to(folder):
        return printable(image.relative_to(folder).as_posix())
    return printable(PurePosixPath(normalise_name(name)).with_name(image.name).as_posix())


def _read_document(place: SetFolder, path: Path) -> dict[str, Any]:
    """Read a JSON object; raise an `InputError` for other contents, or a file outside of the set."""
    document = read_json(place.checked(path), any_bytes=True)
    if not isinstance(document, dict):
        raise InputError(f"{path} is not a set of posed images: expected an object with frames")
    return document


def _read_lens(values: Mapping[str, Any], image: Path, where: str) -> Lens:
    """Read the intrinsics and distortion of a frame; the size is read from the image file if w or h is missing.

    Args:
        values: values of the frame, and the document's values that it does not override.
        image: the frame's image file.
        where: the frame's place, for messages.

    Raises:
        InputError: a value is missing or invalid, or the camera model or one of its coefficients is not supported.
    """
    model = str(values.get("camera_model") or "").strip()
    fisheye = model.upper() in _FISHEYES or bool(values.get("is_fisheye"))
    if not fisheye:
        _check_perspective(model, where)
    width, height = _read_size(values, image, where)
    fx, fy = focal_lengths(values, width, height, where, fisheye=fisheye)
    cx, cy = finite_number(values, "cx", where, width / 2.0), finite_number(values, "cy", where, height / 2.0)
    k1, k2, k3, k4, k5, k6 = (finite_number(values, f"k{i}", where, 0.0) for i in range(1, 7))
    p1, p2 = finite_number(values, "p1", where, 0.0), finite_number(values, "p2", where, 0.0)
    # OpenCV's rational model divides by k4 to k6, other programs multiply; only the model's name distinguishes them.
    unsupported = {"k5": k5, "k6": k6} | ({"p1": p1, "p2": p2} if fisheye else {"k4": k4})
    nonzero_unsupported = [f"{key} is {value:g}" for key, value in unsupported.items() if value != 0.0]
    if nonzero_unsupported and (fisheye or model.upper() != _RATIONAL):
        raise InputError(
            f"{where}: {nonzero_unsupported[0]} with camera_model {model or 'not named'}, expected 0: k4 to k6 belong "
            f"to {_RATIONAL}, k1 to k4 to OPENCV_FISHEYE; or use {UNDISTORTER}"
        )
    if fisheye:
        return Lens(width, height, fx, fy, cx, cy, (k1, k2, k3, k4), projection="equidistant", source=where)
    return Lens(width, height, fx, fy, cx, cy, (k1, k2, k3), (p1, p2), (k4, k5, k6), source=where)


def _check_perspective(model: str, where: str) -> None:
    """Refuse a camera model that is not a supported perspective model."""
    if model.upper() not in PERSPECTIVES:
        remedy = f"use {UNDISTORTER}, or undistort images in the program that computed the poses"
        raise InputError(
            f"{where}: camera_model is {model}, expected one of {', '.join(PERSPECTIVES[1:] + _FISHEYES)}: "
            f"{SPLIT_PANORAMAS if is_panorama(model) else remedy}"
        )


def _read_size(values: Mapping[str, Any], image: Path, where: str) -> tuple[float, float]:
    """Read width and height in pixels, from the image file if w or h is missing."""
    if "w" in values and "h" in values:
        width, height = finite_number(values, "w", where), finite_number(values, "h", where)
    else:
        width, height = (float(side) for side in image_size(image))
    if not (width >= 1.0 and height >= 1.0):
        raise InputError(f"{where}: w and h are {width:g} and {height:g}, expected at least 1")
    return width, height
