# SPDX-License-Identifier: Apache-2.0
"""COLMAP sets: a sparse model, binary or text, next to folders of images.

    images/ images_2/ images_4/ images_8/     the same images, smaller and smaller
    sparse/0/{cameras,images,points3D}.{bin,txt}

A `test.txt` next to the model lists the test images, one name per line; `val.txt` and `train.txt` list the others. A
folder `masks` contains masks, black for pixels that do not count.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from csplat.disk_files import read_text
from csplat.errors import InputError, counted
from csplat.file_source import describe_substitute, read_bytes
from csplat.types import F32, F64
from csplat_trainer.data.dataset import (
    Shot,
    UnreadDataSet,
    finite_points,
    read_point_cloud,
    read_split_lists,
    split_every,
    split_listed,
)
from csplat_trainer.data.image_files import (
    FoundImages,
    abbreviate,
    describe_masks_among,
    describe_missing,
    find_images,
    find_masks,
    printable,
)
from csplat_trainer.data.lens import SPLIT_PANORAMAS, UNDISTORTER, Lens, is_panorama
from csplat_trainer.data.set_folder import SetFolder

#: Folders with models in numbered subfolders, or with a model; the last folder is used only if there is no other.
_MODEL_FOLDERS = (("sparse", "colmap/sparse"), ("distorted/sparse",))
_IMAGE_FOLDERS = ("images", "input", ".")
# Bytes of the smallest records of binary models, and of the elements of their lists.
_CAMERA_SIZE_MIN = 24  # id, model, width, height
_IMAGE_SIZE_MIN = 73  # id, pose, camera, end of the name, number of keypoints
_KEYPOINT_SIZE = 24  # position, point
_POINT_SIZE_MIN = 51  # id, position, colour, error, length of the track
_TRACK_ELEMENT_SIZE = 8  # image, keypoint
_UNDISTORTED_FIRST = "distorted"  # by convert.py of 3DGS: images/ belongs to sparse/0, input/ to this folder's model


def find_model(folder: Path) -> tuple[Path, list[str]] | None:
    """Find the sparse model in the folder of a set; of several models, choose the model with the most images.

    Returns:
        The model's folder, and a line that names other models, if any; `None` if there is no model.
    """
    for names in _MODEL_FOLDERS:
        inside = [folder / name for name in names if (folder / name).is_dir()]
        models = [
            path
            for parent in inside
            for path in (*sorted(parent.iterdir(), key=_number_key), parent)
            if _is_model(path)
        ]
        if models:
            return _choose_largest(models, folder)
    return (folder, []) if _is_model(folder) else None


def read_colmap(
    place: SetFolder, model: Path, size: tuple[int, int] | None, images: str | None, test_every: int
) -> UnreadDataSet:
    """Read a COLMAP set without the pixels.

    Args:
        place: folder of the set.
        model: folder of the sparse model.
        size: requested size of the images; determines the folder of images.
        images: name of the folder of images; `None`: the smallest that is large enough.
        test_every: see `split_every`; used if there are no lists of images.

    Raises:
        InputError: a file is damaged, or no image exists.
    """
    folder = place.path
    cameras_path, images_path = _find_file(model, "cameras"), _find_file(model, "images")
    assert cameras_path is not None
    assert images_path is not None
    images_text, cameras_text = images_path.with_suffix(".txt"), cameras_path.with_suffix(".txt")
    for path in (cameras_path, images_path, images_text, cameras_text):
        place.checked(path)
    registered, report = read_images(images_path)
    used = {image.camera for image in registered}
    cameras = read_cameras(cameras_path, used, report)
    if images_text != images_path and images_text.is_file() and (there := count_images(images_text)) != len(registered):
        what = f"{images_text.name} has {counted(there, 'image')}, {images_path.name} {len(registered)}"
        report.append(f"{what}: {images_path.name} is read")
    if (
        cameras_text != cameras_path
        and cameras_text.is_file()
        and not _are_equal(cameras, read_cameras(cameras_text, used))
    ):
        report.append(f"{cameras_text.name} has other cameras than {cameras_path.name}, which is read")
    if not registered:
        raise InputError(f"{images_path} has no images")
    for image in registered:
        if image.camera not in cameras:
            raise InputError(f"{images_path}: {image.name} has camera {image.camera}, which {cameras_path} lacks")
    registered = _drop_repeated(registered, images_path, report)
    names = [image.name for image in registered]
    image_files = find_images(place, names, images_path.name, _image_folders(place, model, images), size)
    shown = "that of the set" if image_files.folder == folder else _relative_name(image_files.folder, folder)
    report.append(f"image folder: {shown}")
    report += image_files.notes
    report += describe_missing([name for name in names if name not in image_files.files], len(names), images_path.name)
    masks = _find_image_masks(place, image_files.files, report)
    shots = [
        Shot(
            _shown_name(image.name, image_files),
            image_files.files[image.name],
            cameras[image.camera],
            image.viewmat,
            masks.get(image.name),
        )
        for image in registered
        if image.name in image_files.files
    ]
    points, colours = _read_model_points(place, model, report)
    lists, files = read_split_lists(place, (model, model.parent, folder))
    if lists:
        train, val, test = split_listed(shots, lists, files, report)
        return UnreadDataSet("COLMAP set", train, test, points, colours, report, val=val)
    train, test = split_every(shots, test_every, report)
    return UnreadDataSet("COLMAP set", train, test, points, colours, report, test_every)


def _shown_name(name: str, images: FoundImages) -> str:
    """Return the name of an image, or the name of its file if the former is not UTF-8."""
    return name if name == printable(name) else printable(_relative_name(images.files[name], images.folder))


def _drop_repeated(registered: list[ColmapImage], path: Path, report: list[str]) -> list[ColmapImage]:
    """Drop repeated images with the same pose and camera.

    Raises:
        InputError: an image has two poses or cameras.
    """
    first: dict[str, ColmapImage] = {}
    for image in registered:
        earlier = first.setdefault(PurePosixPath(image.name).as_posix(), image)
        if earlier.camera != image.camera or (earlier.viewmat != image.viewmat).any():
            raise InputError(f"{path}: {image.name} occurs twice, with different poses or cameras; expected each once")
    if len(first) < len(registered):
        report.append(f"{path.name}: {counted(len(registered) - len(first), 'image')} twice: read once")
    return list(first.values())


def _is_model(folder: Path) -> bool:
    """Return True if a folder has files of cameras and of images."""
    return _find_file(folder, "cameras") is not None and _find_file(folder, "images") is not None


def _find_file(model: Path, name: str) -> Path | None:
    """Find a file of the model, binary before text, and empty files last."""
    there = [path for path in (model / f"{name}.bin", model / f"{name}.txt") if path.is_file()]
    return next((path for path in there if path.stat().st_size), there[0] if there else None)


def _number_key(path: Path) -> tuple[bool, int, str]:
    """Return a key that sorts numbered folders by number, before others."""
    return not path.name.isdecimal(), int(path.name) if path.name.isdecimal() else 0, path.name


def _choose_largest(models: list[Path], folder: Path) -> tuple[Path, list[str]]:
    """Return the model with the most images, the first of equal models; and a line on the others, if there are any."""
    if len(models) == 1:
        return models[0], []
    counts = [_count_or_damaged(model) for model in models]
    best = max(range(len(models)), key=counts.__getitem__)
    words = [f"{counts[i]}" if counts[i] >= 0 else "a damaged list of images" for i in range(len(models))]
    others = ", ".join(f"{_relative_name(models[i], folder)} has {words[i]}" for i in range(len(models)) if i != best)
    chosen = _relative_name(models[best], folder)
    return models[best], [
        f"there are {len(models)} models: {chosen} is read, with {counted(max(counts), 'image')}; {others}"
    ]


def _count_or_damaged(model: Path) -> int:
    """Return the number of images of a model; -1 if it is damaged."""
    path = _find_file(model, "images")
    try:
        return -1 if path is None else count_images(path)
    except InputError:
        return -1


def _image_folders(place: SetFolder, model: Path, images: str | None) -> tuple[str, ...]:
    """Return the folders to search for images, relative to the folder of the set.

    Args:
        place: the folder of the set.
        model: folder of the sparse model.
        images: the requested folder, which is then the only one; `None`: the usual folders.

    Raises:
        InputError: the requested folder does not exist, or is outside of the set.
    """
    if images is not None:
        if not place.holds(place.path / images):
            raise place.refusal(Path(images))
        if not (place.path / images).is_dir():
            raise InputError(f"{place.path} has no folder {images}")
        return (images,)
    if _UNDISTORTED_FIRST not in _relative_name(model, place.path).split("/"):
        return _IMAGE_FOLDERS
    first, second, *others = _IMAGE_FOLDERS
    return (second, first, *others)


def _are_equal(cameras: dict[int, Lens], text_cameras: dict[int, Lens]) -> bool:
    """Return True if cameras have equal ids, sizes, fx and cx, up to the precision of text files."""

    def rows(lenses: dict[int, Lens]) -> list[tuple[float, ...]]:
        return [(number, lens.width, lens.height, lens.fx, lens.cx) for number, lens in sorted(lenses.items())]

    return len(cameras) == len(text_cameras) and np.allclose(rows(cameras), rows(text_cameras), rtol=_TEXT_TOLERANCE)


def _find_image_masks(place: SetFolder, images: dict[str, Path], report: list[str]) -> dict[str, Path]:
    """Find the masks of images, by names of images; report how they were found, and images without a mask."""
    names = list(images)
    masks = find_masks(place, images)
    if masks is None:
        report += describe_masks_among(list(images.values()))
        return {}
    report += masks.notes
    without = [name for name in names if name not in masks.files]
    if without:
        share = f"{len(without)} of {counted(len(names), 'image')}"
        report.append(f"{masks.folder.name}/ has no masks for {share}: all pixels of {without[0]} count")
    return masks.files


def _read_model_points(place: SetFolder, model: Path, report: list[str]) -> tuple[F64, F32] | tuple[None, None]:
    """Read the points [M, 3] and colours [M, 3] of a model, or of the PLY that 3DGS writes; `None` without both."""
    path = _find_file(model, "points3D")
    if path is not None:
        return read_points(place.checked(path), report)
    if (model / "points3D.ply").is_file():
        report.append("points from points3D.ply")
        return read_point_cloud(place.checked(model / "points3D.ply"))
    return None, None


def _relative_name(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, with `/`; the path itself if it is not below the folder."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


_TEXT_TOLERANCE = 1e-4  # relative difference of cameras in text and binary files; text may have few digits
_UNIT_TOLERANCE = 0.01  # tolerance of a quaternion's length; text files may hold few digits

# Camera models, by their numbers in binary files.
_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
)

# Parameters, in their order, of the models that can be undone.
_LAYOUTS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
}


_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?$")
_ID_DIGITS = 20  # digits of the longest id or size; COLMAP counts in 64 bits
_POSE_WORDS = 10  # words of a line of images.txt: id, rotation (4), translation (3), camera, name (may have spaces)
_WORD_SHOWN_MAX = 80  # maximum number of characters of a word in a message
_NO_NUMBER = re.compile(r"^[+-]?(nan\(.*\)|1\.#(ind|qnan|snan|inf)0*)$", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image.

    Attributes:
        name: path below the folder of images.
        camera: id of its camera.
        viewmat: [4, 4] float64, world to camera; COLMAP's axes are OpenCV's.
    """

    name: str
    camera: int
    viewmat: F64


def read_cameras(path: Path, used: Collection[int] | None = None, report: list[str] | None = None) -> dict[int, Lens]:
    """Read cameras.bin or cameras.txt.

    Args:
        path: the file; its suffix determines the form.
        used: ids of the cameras to read; lenses of others are ignored. `None`: all.
        report: a line is appended if numbers have decimal commas.

    Raises:
        InputError: the file is damaged, or has a lens that is not supported.
    """
    cameras = {}
    if path.suffix == ".txt":
        rows = list(_read_rows(path))
        _check_commas(path, [(words[2:], where) for words, where in rows], report)
        for words, where in rows:
            number = _parse_id(words[0], where)
            if used is not None and number not in used:
                continue
            numbers = _parse_numbers(words[2:], where)
            if len(numbers) < 2:
                raise InputError(f"{where}: expected id, model, width, height, parameters")
            cameras[number] = _make_lens(words[1].upper(), numbers[0], numbers[1], numbers[2:], where)
        return cameras
    data = _BinaryFile(path)
    for _ in range(data.read_count(_CAMERA_SIZE_MIN)):
        number, model, width, height = data.unpack("<iiQQ")
        name = _MODELS[model] if 0 <= model < len(_MODELS) else f"of number {model}"
        # Other models are refused below, so their number of parameters does not matter.
        parameter_count = len(_LAYOUTS.get(name, "").split())
        values = [float(value) for value in data.unpack(f"<{parameter_count}d")]
        if used is None or number in used or not parameter_count:  # the record size of an unknown model is unknown
            cameras[number] = _make_lens(name, float(width), float(height), values, f"{path}, camera {number}")
    data.end()
    return cameras


def read_images(path: Path) -> tuple[list[ColmapImage], list[str]]:
    """Read images.bin or images.txt; the keypoints of each image are skipped.

    Returns:
        The images, and lines on unusual contents: the layout of the text; images without a finite pose, which are
        dropped; rotations that are not of unit length, which are normalised.

    Raises:
        InputError: the file is damaged.
    """
    entries: list[tuple[str, int, Sequence[float], str]] = []  # name, camera, pose, place in the file
    notes: list[str] = []
    if path.suffix == ".txt":
        lines, notes = _read_pose_lines(path)
        _check_commas(path, [(line.split(None, _POSE_WORDS - 1)[1:8], where) for line, where in lines], notes)
        for line, where in lines:
            words = line.split(None, _POSE_WORDS - 1)
            if len(words) < _POSE_WORDS:
                raise InputError(f"{where}: expected id, rotation, translation, camera and name")
            entries.append((words[9].rstrip(), _parse_id(words[8], where), _parse_numbers(words[1:8], where), where))
    else:
        data = _BinaryFile(path)
        for _ in range(data.read_count(_IMAGE_SIZE_MIN)):
            number, *pose, camera = data.unpack("<i7di")
            name = data.string()
            (keypoint_count,) = data.unpack("<Q")
            data.skip(_KEYPOINT_SIZE * keypoint_count)
            entries.append((name, camera, pose, f"{path}, image {number}"))
        data.end()
    finite = [entry for entry in entries if np.isfinite(entry[2]).all()]
    lost = [name for name, _, pose, _ in entries if not np.isfinite(pose).all()]
    if lost:
        notes.append(f"{path.name}: {counted(len(lost), 'image')} without a finite pose, dropped: {abbreviate(lost)}")
    lengths = [(float(np.linalg.norm(pose[:4])), name) for name, _, pose, _ in finite]
    unnormalised = [
        f"{name} has length {length:.4g}" for length, name in lengths if abs(length - 1.0) > _UNIT_TOLERANCE
    ]
    if unnormalised:
        what = f"{counted(len(unnormalised), 'rotation')} QW QX QY QZ not of unit length, normalised"
        notes.append(f"{path.name}: {what}: {abbreviate(unnormalised)}")
    return [ColmapImage(name, camera, _viewmat_of_pose(pose, where)) for name, camera, pose, where in finite], notes


def count_images(path: Path) -> int:
    """Count the images of images.bin or images.txt."""
    return len(_read_pose_lines(path)[0]) if path.suffix == ".txt" else _BinaryFile(path).read_count(_IMAGE_SIZE_MIN)


def read_points(path: Path, report: list[str] | None = None) -> tuple[F64, F32]:
    """Read points3D.bin or points3D.txt.

    Args:
        path: the file; its suffix determines the form.
        report: a line is appended if numbers have decimal commas.

    Returns:
        Points, [P, 3] float64, and their colours, [P, 3] float32 in 0..1. Points that are not finite, or overflow
        float32, are dropped.
    """
    points: list[tuple[float, ...]] = []
    if path.suffix == ".txt":
        rows = list(_read_rows(path))
        _check_commas(path, [(words[1:8], where) for words, where in rows], report)
        for words, where in rows:
            if len(words) < 7:
                raise InputError(f"{where}: expected id, position and colour")
            points.append(tuple(_parse_numbers(words[1:7], where)))
    else:
        data = _BinaryFile(path)
        for _ in range(data.read_count(_POINT_SIZE_MIN)):
            _, x, y, z, red, green, blue, _, track_length = data.unpack("<Q3d3BdQ")
            data.skip(_TRACK_ELEMENT_SIZE * track_length)
            points.append((x, y, z, red, green, blue))
        data.end()
    table = np.array(points, np.float64).reshape(-1, 6)
    return finite_points(table[:, :3], table[:, 3:])


class _BinaryFile:
    """A binary file that is read from front to back, never beyond its end."""

    def __init__(self, path: Path) -> None:
        try:
            self._data = read_bytes(path)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from error
        instead = describe_substitute(self._data[:64])
        if instead:
            raise InputError(f"{path} is {instead}")
        self._path = path
        self._offset = 0

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Read values of a `struct` layout; raise an `InputError` if the file ends before."""
        size = struct.calcsize(layout)
        self._need(size)
        values = struct.unpack_from(layout, self._data, self._offset)
        self._offset += size
        return values

    def read_count(self, least_size: int) -> int:
        """Read the number of records that follow.

        Args:
            least_size: bytes that every record has at least.

        Raises:
            InputError: the file is too short for this number of records.
        """
        count = int(self.unpack("<Q")[0])
        self._need(count * least_size)
        return count

    def string(self) -> str:
        """Read a string that ends with a zero byte; bytes that are not UTF-8 become lone surrogates.

        Raises:
            InputError: the file ends before, or the string has control characters.
        """
        end = self._data.find(b"\0", self._offset)
        if end < 0:
            raise InputError(f"{self._path} ends within a name at byte {self._offset}")
        name = self._data[self._offset : end]
        if any(byte < ord(" ") for byte in name):
            raise InputError(f"{self._path}: the name at byte {self._offset} has control characters")
        self._offset = end + 1
        return name.decode("utf-8", "surrogateescape")  # COLMAP on Windows writes in the system's code page

    def skip(self, size: int) -> None:
        """Pass over `size` bytes; raise an `InputError` if the file ends before."""
        self._need(size)
        self._offset += size

    def end(self) -> None:
        """Raise an `InputError` unless all bytes have been read."""
        if self._offset != len(self._data):
            raise InputError(f"{self._path}: {len(self._data) - self._offset} bytes follow its last record")

    def _need(self, size: int) -> None:
        """Raise an `InputError` unless `size` bytes remain."""
        if size > len(self._data) - self._offset:
            raise InputError(
                f"{self._path} ends at byte {len(self._data)}, expected {size} more from byte {self._offset}"
            )


def _read_rows(path: Path) -> Iterator[tuple[list[str], str]]:
    """Yield the words of each line that is neither empty nor a comment, and its place in the file."""
    for number, line in enumerate(read_text(path).split("\n"), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.split(), f"{path}, line {number}"


def _read_pose_lines(path: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Separate the lines of poses in images.txt from the lines of keypoints that follow them.

    COLMAP writes two lines per image. The second, empty or with three numbers per keypoint, is often omitted in
    hand-written files with known poses.

    Returns:
        The lines of poses, each with its place in the file; and a line for the report if a second line is missing.
    """
    lines = read_text(path, any_bytes=True).split("\n")
    first = next((number for number, line in enumerate(lines) if line.strip() and not _is_comment(line)), len(lines))
    numbers = array("q", (number for number in range(first, len(lines)) if not _is_comment(lines[number])))

    def with_place(number: int) -> tuple[str, str]:
        return lines[number], f"{path}, line {number + 1}"

    if all(_is_pose(lines[number]) for number in numbers[::2] if lines[number].strip()) and all(
        _is_keypoints(lines[number].split()) for number in numbers[1::2]
    ):
        return [with_place(number) for number in numbers[::2] if lines[number].strip()], []
    # The lines are no pairs, so each is judged by its words, and keypoints may or may not follow a pose.
    poses: list[tuple[str, str]] = []
    missing_count = 0
    keypoints_may_follow = False
    for number in numbers:
        line = lines[number]
        if not _is_keypoints(line.split()):
            if keypoints_may_follow:
                missing_count += 1
            poses.append(with_place(number))
            keypoints_may_follow = True
        elif line.strip() and not keypoints_may_follow:
            place = with_place(number)[1]
            raise InputError(
                f"{place}: these are keypoints, expected an image: id, rotation, translation, camera, name"
            )
        else:
            keypoints_may_follow = False
    if not missing_count:
        return poses, []
    return poses, [f"{path.name}: {counted(missing_count, 'image')} without a line of keypoints, which is optional"]


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _is_keypoints(words: list[str]) -> bool:
    """Return True if a line holds x, y and the id of a point, any number of times."""
    if len(words) % 3:
        return False
    try:
        return all(_parse_number(word) is not None for word in words)
    except ValueError:
        return False


def _is_pose(line: str) -> bool:
    """Return True if a line has enough words, with whole numbers where a pose has the ids of image and camera."""
    words = line.split(None, _POSE_WORDS - 1)
    return len(words) == _POSE_WORDS and words[0].isdecimal() and words[8].isdecimal()


def _parse_numbers(words: list[str], where: str) -> list[float]:
    """Parse words as numbers, each as `_parse_number` does.

    Raises:
        InputError: a word, printed with its place `where`, is not a number.
    """
    values = []
    for word in words:
        try:
            values.append(_parse_number(word))
        except ValueError:
            raise InputError(f"{where}: {printable(word[:_WORD_SHOWN_MAX])!r} is not a number") from None
    return values


def _parse_number(word: str) -> float:
    """Parse a number with a point or comma, or NaN, which C++ programs on Windows write as `-nan(ind)` and `1.#IND`."""
    if "_" in word:  # Python's separator of digits
        raise ValueError
    return float(_NO_NUMBER.sub("nan", word.replace(",", ".") if _DECIMAL_COMMA.match(word) else word))


def _check_commas(path: Path, rows: Iterable[tuple[list[str], str]], report: list[str] | None) -> None:
    """Report decimal commas, as programs write in some languages.

    Args:
        path: the file.
        rows: words that should be numbers, and their place in the file.
        report: a line is appended if there are decimal commas; `None`: they are only checked.

    Raises:
        InputError: the file has other commas, or commas as well as points, so that either may separate thousands.
    """
    comma: tuple[str, str] | None = None  # the first word with a comma, and its place
    point: tuple[str, str] | None = None
    for words, where in rows:
        for word in words:
            if "," in word:
                if not _DECIMAL_COMMA.match(word):
                    shown = printable(word[:_WORD_SHOWN_MAX])
                    raise InputError(f"{where}: {shown!r} has a comma, expected a number such as 0.5")
                comma = comma or (word, where)
            elif "." in word and not _NO_NUMBER.match(word):
                point = point or (word, where)
    if comma and point:
        raise InputError(
            f"{comma[1]}: {comma[0]} has a comma, but {point[0]} in {point[1].rpartition(', ')[2]} a point: expected "
            "points, and no separators of thousands"
        )
    if comma and report is not None:
        report.append(f"{path.name}: decimal commas are read as points: {comma[0]} is {_parse_number(comma[0]):g}, …")


def _parse_id(word: str, where: str) -> int:
    """Parse a whole number of at most `_ID_DIGITS` characters, else raise an `InputError`."""
    if len(word) > _ID_DIGITS or not re.fullmatch("-?[0-9]+", word):
        raise InputError(f"{where}: {word[:_WORD_SHOWN_MAX]!r} is not an id")
    return int(word)


def _make_lens(model: str, width: float, height: float, values: list[float], where: str) -> Lens:
    """Convert a camera of COLMAP.

    Args:
        model: name of the camera model, in capitals.
        width, height: size of the images, pixels.
        values: parameters of the model, in the order of `_LAYOUTS`.
        where: place in the file, for messages.

    Raises:
        InputError: the model is not supported, or has other or impossible parameters.
    """
    layout = _LAYOUTS.get(model, "").split()
    if not layout:
        remedy = SPLIT_PANORAMAS if is_panorama(model) else f"use {UNDISTORTER}"
        raise InputError(f"{where}: the lens is {model}, expected one of {', '.join(_LAYOUTS)}: {remedy}")
    if len(values) != len(layout):
        raise InputError(f"{where}: the lens {model} has {len(values)} parameters, expected {' '.join(layout)}")
    named = dict(zip(layout, values, strict=True))
    fx = named.pop("f", None)
    fx, fy = (named.pop("fx"), named.pop("fy")) if fx is None else (fx, fx)
    if not (width >= 1 and height >= 1 and fx > 0 and fy > 0 and np.isfinite(values).all()):
        raise InputError(f"{where}: the lens {model} has a size or focal length that is not a number above 0")
    cx, cy = named.pop("cx"), named.pop("cy")
    k1, k2, k3, k4, k5, k6 = (named.get(f"k{i}", 0.0) for i in range(1, 7))
    tangential, prism = (named.get("p1", 0.0), named.get("p2", 0.0)), (named.get("sx1", 0.0), named.get("sy1", 0.0))
    if model == "FOV":
        return Lens(width, height, fx, fy, cx, cy, projection="fov", omega=named["omega"], source=where)
    if model.endswith("FISHEYE"):
        radial = (k1, k2, k3, k4)
        return Lens(
            width, height, fx, fy, cx, cy, radial, tangential, prism=prism, projection="equidistant", source=where
        )
    return Lens(width, height, fx, fy, cx, cy, (k1, k2, k3), tangential, (k4, k5, k6), source=where)


def _viewmat_of_pose(pose: Sequence[float], where: str) -> F64:
    """Return the matrix [4, 4] of a pose: a rotation w x y z of any length above 0, and a translation.

    Raises:
        InputError: the rotation is zero or overflows.
    """
    q, t = np.array(pose[:4], np.float64), np.array(pose[4:7], np.float64)
    length = float(np.linalg.norm(q))
    if not (np.isfinite(length) and length > 0.0):
        raise InputError(f"{where}: the rotation is zero or overflows")
    w, x, y, z = q / length
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = t
    return viewmat
