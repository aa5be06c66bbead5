"""Readers of `transforms*.json`: NeRF-synthetic (Blender) sets, and instant-ngp's and its kin.

Both hold camera-to-world matrices with OpenGL axes: x to the right, y up, z backwards.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat_trainer.data.dataset import Found, Lens, Shot, split_every
from csplat_trainer.data.pixels import find_image, image_size

__all__ = ["read_blender", "read_transforms"]

F64 = NDArray[np.float64]

_BLENDER_AXES = "RFU"  # seen from the front: x to the right, y away, z up
_NAMED_MISSING = 5  # files that a message names, at most
_SCALE_TOLERANCE = 1e-3
_PINHOLES = ("", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def read_blender(folder: Path) -> Found:
    """Read a set with `transforms_train.json` and, mostly, `transforms_test.json` beside it.

    Args:
        folder: where they lie. Nobody learns from the pictures of `transforms_val.json`, or is judged by them.

    Raises:
        InputError: a file is not what it is called, or no picture is there.
    """
    report: list[str] = []
    train = _shots(folder / "transforms_train.json", report)
    test_path = folder / "transforms_test.json"
    if test_path.is_file():
        test = _shots(test_path, report)
    else:
        test = []
        report.append("there is no transforms_test.json: no test pictures")
    val_path = folder / "transforms_val.json"
    val = _shots(val_path, report, needed=False) if val_path.is_file() else []
    return Found("Blender set", train, test, report=report, coordinate_system=_BLENDER_AXES, val=val)


def read_transforms(path: Path, test_every: int) -> Found:
    """Read instant-ngp's `transforms.json`, or nerfstudio's, which may name a split.

    Args:
        path: the file.
        test_every: see `split_every`; used where the file names no test pictures.

    Raises:
        InputError: the file is not what it is called, or no picture is there.
    """
    report: list[str] = []
    shots = _shots(path, report)
    named = _load(path).get("test_filenames")
    if isinstance(named, list) and named:
        held = {_plain(str(name), path.parent / str(name)) for name in named}
        train, test = [s for s in shots if s.name not in held], [s for s in shots if s.name in held]
        report.append(f"the file names {len(held)} test pictures, {len(test)} of them are there")
        return Found("transforms.json set", train, test, report=report)
    train, test = split_every(shots, test_every)
    if test:
        report.append(f"no split is named: every {test_every}th picture is a test picture")
    return Found("transforms.json set", train, test, report=report, test_every=test_every)


def _shots(path: Path, report: list[str], *, needed: bool = True) -> list[Shot]:
    """The shots of one file whose pictures are there; those that are not are reported. If needed, one at least."""
    document = _load(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames")
    shots, missing = [], []
    for number, frame in enumerate(frames):
        where = f"{path}, frame {number}"
        if not isinstance(frame, Mapping) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{where} has no file_path")
        name = frame["file_path"]
        image = find_image(path.parent / name)
        if image is None:
            missing.append(name)
            continue
        lens = _lens({**document, **frame}, image, where)
        viewmat = _viewmat(frame.get("transform_matrix"), where)
        shots.append(Shot(_plain(name, image), image, lens, viewmat, _mask(frame, path.parent, where)))
    if missing:
        shown = ", ".join(missing[:_NAMED_MISSING]) + (", …" if len(missing) > _NAMED_MISSING else "")
        report.append(f"{path.name}: {len(missing)} of {len(frames)} pictures are missing and left out: {shown}")
    if needed and not shots:
        raise InputError(f"{path}: none of its {len(frames)} pictures is there ({missing[0]}, …)")
    return shots


def _mask(frame: Mapping[str, Any], folder: Path, where: str) -> Path | None:
    """The mask of a frame, as nerfstudio names it: black where the picture does not count."""
    name = frame.get("mask_path")
    if name is None:
        return None
    mask = find_image(folder / name) if isinstance(name, str) else None
    if mask is None:
        raise InputError(f"{where}: there is no mask {name!r}")
    return mask


def _plain(name: str, image: Path) -> str:
    """A name as the file has it: without `./`, with its ending (Blender's sets leave it out)."""
    return PurePosixPath(name).with_name(image.name).as_posix()


def _load(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error
    if not isinstance(document, dict):
        raise InputError(f"{path} is not a set of posed pictures: wanted an object with frames")
    return document


def _lens(values: Mapping[str, Any], image: Path, where: str) -> Lens:
    """Intrinsics: focal lengths or angles of view, for the size named or the file's own."""
    model = str(values.get("camera_model", ""))
    if model.upper() not in _PINHOLES or values.get("is_fisheye"):
        raise InputError(f"{where}: camera model {model or 'fisheye'} is not supported, wanted a pinhole or OPENCV")
    if any(_number(values, key, where, 0.0) != 0.0 for key in ("k3", "k4")):
        raise InputError(f"{where}: distortion by k3 or k4 is not supported, wanted k1, k2, p1, p2")
    if "w" in values and "h" in values:
        width, height = _number(values, "w", where), _number(values, "h", where)
    else:
        width, height = (float(side) for side in image_size(image))
    if not (width >= 1.0 and height >= 1.0):
        raise InputError(f"{where}: pictures of {width:g}×{height:g} pixels")
    fx, fy = _focal(values, "x", width, where), _focal(values, "y", height, where)
    if fx is None and fy is None:
        raise InputError(f"{where}: no focal length, wanted fl_x or camera_angle_x")
    fx, fy = fx or fy, fy or fx  # square pixels unless both are named
    assert fx is not None
    assert fy is not None
    cx, cy = _number(values, "cx", where, width / 2.0), _number(values, "cy", where, height / 2.0)
    k1, k2, p1, p2 = (_number(values, key, where, 0.0) for key in ("k1", "k2", "p1", "p2"))
    return Lens(width, height, fx, fy, cx, cy, (k1, k2, p1, p2))


def _focal(values: Mapping[str, Any], axis: str, size: float, where: str) -> float | None:
    if values.get(f"fl_{axis}") is not None:
        focal = _number(values, f"fl_{axis}", where)
    elif values.get(f"camera_angle_{axis}") is not None:
        angle = _number(values, f"camera_angle_{axis}", where)
        if not 0.0 < angle < math.pi:
            raise InputError(f"{where}: camera_angle_{axis} is {angle:g}, wanted radians above 0 and below π")
        focal = 0.5 * size / math.tan(0.5 * angle)
    else:
        return None
    if focal <= 0.0:
        raise InputError(f"{where}: the focal length is {focal:g}, wanted above 0")
    return focal


def _number(values: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = values.get(key)
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: {key} is {value!r}, wanted a number")
    return float(value)


def _viewmat(matrix: Any, where: str) -> F64:
    """World to camera with OpenCV axes, from camera to world with OpenGL axes."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: transform_matrix is not a matrix of numbers") from None
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise InputError(f"{where}: transform_matrix has shape {list(pose.shape)}, wanted [4, 4], finite")
    axes = pose[:3, :3] * np.array([1.0, -1.0, -1.0])
    lengths = np.linalg.norm(axes, axis=0)
    scale = float(lengths.mean())  # some exporters leave the scale of the world in the axes
    if not (scale > 0.0 and np.linalg.det(axes) > 0.0 and np.abs(lengths / scale - 1.0).max() <= _SCALE_TOLERANCE):
        raise InputError(f"{where}: transform_matrix does not begin with a rotation (mirrored, sheared or zero)")
    u, _, vt = np.linalg.svd(axes / scale)  # the nearest rotation: files hold few digits
    viewmat = np.eye(4)
    viewmat[:3, :3] = (u @ vt).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ pose[:3, 3]
    return viewmat
