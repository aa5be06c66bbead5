"""COLMAP's sparse models, binary and text: cameras, images, points3D."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from csplat.errors import InputError, counted
from csplat.files import read_text
from csplat.inputs import stand_in
from csplat.types import F32, F64
from csplat_trainer.data.image_files import shown
from csplat_trainer.data.lens import UNDISTORTER, Lens
from csplat_trainer.data.point_cloud import finite_points

_UNIT_TOLERANCE = 0.01  # of a quaternion's length; text files may hold few digits

# By their numbers in binary files.
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


def read_cameras(path: Path, used: Collection[int] | None = None) -> dict[int, Lens]:
    """Read cameras.bin or cameras.txt.

    Args:
        path: the file; its ending tells which.
        used: ids of the cameras to read: others may have any lens; `None`: all.

    Raises:
        InputError: the file is damaged, or holds a lens that cannot be undone here.
    """
    cameras = {}
    if path.suffix == ".txt":
        for words, where in _lines(path):
            number = _integer(words[0], where)
            if used is not None and number not in used:
                continue
            numbers = _numbers(words[2:], where)
            if len(numbers) < 2:
                raise InputError(f"{where}: expected id, model, width, height, parameters")
            cameras[number] = _lens(words[1].upper(), numbers[0], numbers[1], numbers[2:], where)
        return cameras
    data = _Bytes(path)
    for _ in range(data.count(24)):
        number, model, width, height = data.unpack("<iiQQ")
        name = _MODELS[model] if 0 <= model < len(_MODELS) else f"of number {model}"
        # How many parameters others have is of no interest: they are refused.
        parameter_count = len(_LAYOUTS.get(name, "").split())
        values = [float(value) for value in data.unpack(f"<{parameter_count}d")]
        if used is None or number in used or not parameter_count:  # of a lens without a name the end is not known
            cameras[number] = _lens(name, float(width), float(height), values, f"{path}, camera {number}")
    data.end()
    return cameras


def read_images(path: Path) -> tuple[list[ColmapImage], list[str]]:
    """Read images.bin or images.txt; the keypoints of each image are skipped.

    Returns:
        The images, and lines on what is unusual: the layout of the text; images without a finite pose, which are left
        out; rotations that are not of unit length, which are normalised.

    Raises:
        InputError: the file is damaged.
    """
    found: list[tuple[str, int, Sequence[float], str]] = []  # name, camera, pose, and where it stands
    notes: list[str] = []
    if path.suffix == ".txt":
        lines, notes = _image_lines(path)
        for line, where in lines:
            words = line.split(None, 9)
            if len(words) < 10:
                raise InputError(f"{where}: expected id, rotation, translation, camera and name")
            found.append((words[9].rstrip(), _integer(words[8], where), _numbers(words[1:8], where), where))
    else:
        data = _Bytes(path)
        for _ in range(data.count(73)):
            number, *pose, camera = data.unpack("<i7di")
            name = data.string()
            (matches,) = data.unpack("<Q")
            data.skip(24 * matches)
            found.append((name, camera, pose, f"{path}, image {number}"))
        data.end()
    finite = [one for one in found if np.isfinite(one[2]).all()]
    lost = [name for name, _, pose, _ in found if not np.isfinite(pose).all()]
    if lost:
        notes.append(f"{path.name}: {counted(len(lost), 'image')} without a finite pose, left out: {shown(lost)}")
    lengths = [(float(np.linalg.norm(pose[:4])), name) for name, _, pose, _ in finite]
    other = [f"{name} has length {length:.4g}" for length, name in lengths if abs(length - 1.0) > _UNIT_TOLERANCE]
    if other:
        what = f"{counted(len(other), 'rotation')} QW QX QY QZ not of unit length, normalised"
        notes.append(f"{path.name}: {what}: {shown(other)}")
    return [ColmapImage(name, camera, _viewmat(pose, where)) for name, camera, pose, where in finite], notes


def count_images(path: Path) -> int:
    """Count the images of images.bin or images.txt."""
    return len(_image_lines(path)[0]) if path.suffix == ".txt" else _Bytes(path).count(73)


def read_points(path: Path) -> tuple[F64, F32]:
    """Read points3D.bin or points3D.txt.

    Returns:
        Points, [P, 3] float64, and their colours, [P, 3] float32 in 0..1. Points that are not
        finite, or beyond float32, are left out.
    """
    points: list[tuple[float, ...]] = []
    if path.suffix == ".txt":
        for words, where in _lines(path):
            if len(words) < 7:
                raise InputError(f"{where}: wanted id, position and colour")
            points.append(tuple(_numbers(words[1:7], where)))
    else:
        data = _Bytes(path)
        for _ in range(data.count(51)):
            _, x, y, z, red, green, blue, _, track = data.unpack("<Q3d3BdQ")
            data.skip(8 * track)
            points.append((x, y, z, red, green, blue))
        data.end()
    table = np.array(points, np.float64).reshape(-1, 6)
    return finite_points(table[:, :3], table[:, 3:])


class _Bytes:
    """A binary file that is read from front to back, never beyond its end."""

    def __init__(self, path: Path) -> None:
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from error
        instead = stand_in(self._data[:64])
        if instead:
            raise InputError(f"{path} is {instead}")
        self._path = path
        self._at = 0

    def unpack(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        self._need(size)
        values = struct.unpack_from(layout, self._data, self._at)
        self._at += size
        return values

    def count(self, smallest: int) -> int:
        """The number of records that follow, each of at least `smallest` bytes."""
        count = int(self.unpack("<Q")[0])
        self._need(count * smallest)
        return count

    def string(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise InputError(f"{self._path} ends within a name at byte {self._at}")
        name = self._data[self._at : end]
        if any(byte < ord(" ") for byte in name):
            raise InputError(f"{self._path}: the name at byte {self._at} holds control characters")
        self._at = end + 1
        try:
            return name.decode("utf-8")
        except UnicodeDecodeError:
            return name.decode("cp1252", "replace")  # COLMAP on Windows writes the bytes of the system's code page

    def skip(self, size: int) -> None:
        self._need(size)
        self._at += size

    def end(self) -> None:
        if self._at != len(self._data):
            raise InputError(f"{self._path}: {len(self._data) - self._at} bytes follow its last record")

    def _need(self, size: int) -> None:
        if size > len(self._data) - self._at:
            raise InputError(f"{self._path} ends at byte {len(self._data)}, wanted {size} more from byte {self._at}")


def _lines(path: Path) -> Iterator[tuple[list[str], str]]:
    """Give the words of each line that is neither empty nor a comment, and where it stands."""
    for number, line in enumerate(read_text(path).split("\n"), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.split(), f"{path}, line {number}"


def _image_lines(path: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Tell the lines of poses in images.txt from the lines of keypoints that follow them.

    COLMAP writes two lines for each image, of which the second, empty or three numbers for each keypoint, is often
    left out by people who write known poses.

    Returns:
        The lines of poses, each with where it stands; and a line for the report if any has no second one.
    """
    written = [
        (line, f"{path}, line {number}")
        for number, line in enumerate(read_text(path).split("\n"), 1)
        if not line.lstrip().startswith("#")
    ]
    while written and not written[0][0].strip():
        written.pop(0)
    if all(_is_pose(line) for line, _ in written[::2] if line.strip()) and all(
        _is_keypoints(line.split()) for line, _ in written[1::2]
    ):
        return [pair for pair in written[::2] if pair[0].strip()], []
    poses: list[tuple[str, str]] = []
    single = 0
    expected = False  # whether a line of keypoints may follow
    for line, where in written:
        if not _is_keypoints(line.split()):
            single += expected
            poses.append((line, where))
            expected = True
        elif line.strip() and not expected:
            raise InputError(
                f"{where}: these are keypoints, expected an image: id, rotation, translation, camera, name"
            )
        else:
            expected = False
    if not single:
        return poses, []
    return poses, [f"{path.name}: {counted(single, 'image')} without a line of keypoints, which may be left out"]


def _is_keypoints(words: list[str]) -> bool:
    """Report whether a line holds x, y and the id of a point, any number of times."""
    if len(words) % 3:
        return False
    try:
        return all(float(_NO_NUMBER.sub("nan", word)) is not None for word in words)
    except ValueError:
        return False


def _is_pose(line: str) -> bool:
    words = line.split(None, 9)
    return len(words) == 10 and words[0].isdecimal() and words[8].isdecimal()


def _numbers(words: list[str], where: str) -> list[float]:
    """Read numbers, those that are none among them: C++ programs on Windows write `-nan(ind)` and `1.#IND`."""
    words = [_NO_NUMBER.sub("nan", word) for word in words]
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def _integer(word: str, where: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise InputError(f"{where}: {word!r} is not an id") from None


def _lens(model: str, width: float, height: float, values: list[float], where: str) -> Lens:
    layout = _LAYOUTS.get(model, "").split()
    if not layout:
        raise InputError(f"{where}: the lens is {model}, expected one of {', '.join(_LAYOUTS)}: use {UNDISTORTER}")
    if len(values) != len(layout):
        raise InputError(f"{where}: the lens {model} has {len(values)} parameters, expected {' '.join(layout)}")
    named = dict(zip(layout, values, strict=True))
    fx = named.pop("f", None)
    fx, fy = (named.pop("fx"), named.pop("fy")) if fx is None else (fx, fx)
    if not (width >= 1 and height >= 1 and fx > 0 and fy > 0 and np.isfinite(values).all()):
        raise InputError(f"{where}: the lens {model} has a size or focal length that is no number above 0")
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


def _viewmat(pose: Sequence[float], where: str) -> F64:
    """Return the matrix of a rotation w x y z and a translation."""
    q, t = np.array(pose[:4], np.float64), np.array(pose[4:7], np.float64)
    length = float(np.linalg.norm(q))
    if not (np.isfinite(length) and length > 0.0):
        raise InputError(f"{where}: the rotation is zero, or beyond what a number holds")
    w, x, y, z = q / length
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = t
    return viewmat
