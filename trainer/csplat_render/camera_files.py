# SPDX-License-Identifier: Apache-2.0
"""Read and write csplat's camera files, and read other programs' camera files.

* csplat: a JSON list of {K, viewmat, W, H, near, image}: world to camera, OpenCV axes, pixel centres at +0.5; `near`
  and `image` are optional.
* cameras.json of INRIA: a list of {id, img_name, width, height, position, rotation, fx, fy}; `rotation` is camera to
  world by rows, OpenCV axes; the principal point is the centre of the image.
* Camera paths of nerfstudio: {render_width, render_height, camera_path: [{camera_to_world, fov, aspect}]}; 16 numbers
  by rows, OpenGL axes: x right, y up, z backwards; `fov` is vertical, in degrees.
* transforms.json of instant-ngp and nerfstudio: {w, h, fl_x or camera_angle_x, frames: [{file_path,
  transform_matrix}]}, OpenGL axes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from csplat.disk_files import read_json
from csplat.errors import InputError, counted
from csplat.types import F64
from csplat_render.camera import DEFAULT_NEAR, Camera, check_last_row, relative_to

#: Camera models of transforms.json that are a pinhole with or without OpenCV's distortion; "" if none is specified.
PERSPECTIVES = ("", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")

_ORIGIN_FAR = 100.0  # minimum distance of an origin in map coordinates from 0, in distances of the cameras from it
_FOCAL_RANGE = (0.05, 500.0)  # focal length relative to the image's side: 169 to 0.1 degrees of view (satellites)
_MAX_FOCAL_RATIO = 3.0  # between the horizontal and vertical focal length
_OFF_CENTRE = 10.0  # maximum distance of the principal point from 0, relative to the image's side
_SWAPPED = 0.02  # tolerance for a principal point that fits the swapped image size, relative to half a side
_NERFSTUDIO_NEAR = 0.01  # near plane of nerfstudio's renderer, scene units
_SCALE_TOLERANCE = 1e-3  # relative difference of the axes' lengths; also of a scale from 1 that is reported
_ANGLE_TOLERANCE = 0.01  # relative difference between a focal length and an angle of view; files have few digits
#: Files with poses that are not read: fields of the document, or of each entry of a list; and what to use instead.
_UNREAD = (
    (
        {"transform", "scale"},
        "is dataparser_transforms.json of nerfstudio, which has no cameras: export a camera path from its viewer",
    ),
    (
        {"file_path", "transform"},
        "has the poses of `ns-export cameras`, without focal lengths: export a camera path from its viewer",
    ),
    (
        {"path", "time"},
        "is a camera path of instant-ngp, in its own coordinates: use the transforms.json of the images",
    ),
    (
        {"K", "poses"},
        "has the cameras of Record3D: convert it with `ns-process-data record3d`, and use the transforms.json",
    ),
    (
        {"cameras", "shots", "points"},
        "is a reconstruction of OpenSfM: export it with `opensfm export_colmap`, and use --data",
    ),
    (
        {"background"},
        "has settings of the SuperSplat viewer, expected one of the formats that `csplat render --help` lists",
    ),
)
_COLMAP = {"cameras.bin", "images.bin", "cameras.txt", "images.txt"}
_LISTED_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # distortion_params
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def load_cameras(
    path: str | Path, report: list[str] | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> list[Camera]:
    """Read a camera file.

    Args:
        path: a JSON file in a format listed above. Its cameras are relative to the scene's origin. But if the origin is
            more than a hundred times farther from 0 than from the cameras, they are in map coordinates, and the origin
            is subtracted.
        report: lines about the interpretation of the file are appended.
        origin: [3], origin of the scene.

    Returns:
        The cameras, at least one, relative to the origin.

    Raises:
        InputError: the file does not exist, is not JSON, or contains no cameras.
    """
    path, report = Path(path), [] if report is None else report
    if path.is_dir() or path.name in _COLMAP:
        what = "a folder" if path.is_dir() else "a file of COLMAP"
        raise InputError(f"{path} is {what}, expected a JSON file of cameras; use --data for those of a data set")
    entries = read_json(path)
    cameras = parse_foreign_cameras(entries, str(path), report)
    if cameras is None:
        cameras = _parse_own_cameras(entries, path)
    for number, camera in enumerate(cameras):
        K = camera.K
        focals, middle = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
        check_intrinsics(focals, middle, (camera.W, camera.H), f"{path}, camera {number}")
    away = np.median([camera.position for camera in cameras], axis=0) - origin
    if _ORIGIN_FAR * float(np.linalg.norm(away)) < float(np.linalg.norm(origin)):
        report.append(f"{path}: the cameras are around the scene's origin, which is subtracted from their coordinates")
        cameras = [relative_to(origin, camera) for camera in cameras]
    return cameras


def save_cameras(path: str | Path, cameras: Sequence[Camera]) -> None:
    """Write a camera file that `load_cameras` reads without loss."""
    text = ",\n".join(json.dumps(camera.as_json(), allow_nan=False) for camera in cameras)
    Path(path).write_text(f"[\n{text}\n]\n", "utf-8")


def parse_foreign_cameras(document: object, where: str, report: list[str]) -> list[Camera] | None:
    """Parse a camera file of another program.

    Args:
        document: contents of a JSON file.
        where: the file, for messages.
        report: lines about the interpretation of the file are appended.

    Returns:
        The cameras; `None` if the file has none of the formats listed above.

    Raises:
        InputError: a field is missing or not a number, or a pose is invalid.
    """
    if isinstance(document, list) and document and isinstance(document[0], Mapping) and "rotation" in document[0]:
        cameras = _parse_each(document, where, "camera", _parse_inria)
        report.append(
            f"{where} is a cameras.json of INRIA: {counted(len(cameras), 'camera')}, principal points in the middle"
        )
        return cameras
    if not isinstance(document, Mapping):
        return None
    if isinstance(document.get("camera_path"), list):
        if not document["camera_path"] and document.get("keyframes"):
            raise InputError(
                f"{where} lists no cameras, but keyframes between which nerfstudio has not interpolated: generate the"
                " path in its viewer, with a duration above 0, and export it again"
            )
        cameras = _parse_each(
            document["camera_path"],
            where,
            "camera_path",
            lambda entry, place: _parse_nerfstudio(document, entry, place),
        )
        report.append(f"{where} is a camera path of nerfstudio: {counted(len(cameras), 'camera')}")
        return cameras
    if isinstance(document.get("frames"), list):
        cameras = _parse_each(
            document["frames"], where, "frame", lambda frame, place: _parse_frame(document, frame, place)
        )
        report.append(f"{where} is a transforms.json: {counted(len(cameras), 'camera')}")
        report += describe_scales([frame["transform_matrix"] for frame in document["frames"]], where)
        if any(values.get(key) for key in _DISTORTION for values in (document, *document["frames"])):
            report.append(f"{where}: lens distortion is ignored, renders are rectilinear")
        return cameras
    return None


def frame_values(document: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a frame of a transforms.json; they override the values that apply to all frames."""
    own = {**frame, **_intrinsics_of_matrix(frame)}
    values = {**document, **own}
    listed = values.get("distortion_params")  # nerfstudio
    if isinstance(listed, list) and len(listed) == len(_LISTED_DISTORTION):
        values |= dict(zip(_LISTED_DISTORTION, listed, strict=True))
    for axis in "xy":
        if f"fl_{axis}" in own and f"camera_angle_{axis}" not in own:
            values.pop(f"camera_angle_{axis}", None)
        degrees = values.get(f"{axis}_fov")  # instant-ngp
        if isinstance(degrees, int | float) and not {f"fl_{axis}", f"camera_angle_{axis}"} & set(values):
            values[f"camera_angle_{axis}"] = math.radians(degrees)
    return values


def _intrinsics_of_matrix(frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a frame's `intrinsic_matrix` (NeuS2) under the names of instant-ngp."""
    if "intrinsic_matrix" not in frame or "fl_x" in frame:
        return {}
    try:
        matrix = np.array(frame["intrinsic_matrix"], np.float64)
    except (TypeError, ValueError, OverflowError):
        return {}
    if matrix.ndim != 2 or min(matrix.shape) < 3:
        return {}
    places = {"fl_x": (0, 0), "fl_y": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return {name: float(matrix[place]) for name, place in places.items()}


def check_intrinsics(
    focals: tuple[float, float], middle: tuple[float, float], size: tuple[float, float], where: str
) -> None:
    """Check that intrinsics are plausible; detects focal lengths in other units and swapped numbers.

    Args:
        focals: horizontal and vertical focal length, pixels.
        middle: principal point, pixels.
        size: width and height, pixels.
        where: file and place, for messages; "" for none.

    Raises:
        InputError: the intrinsics are implausible.
    """
    where = f"{where}: " if where else ""
    (fx, fy), (cx, cy), (width, height) = focals, middle, size
    low, high = _FOCAL_RANGE
    for name, focal, side in (("across", fx, width), ("down", fy, height)):
        if not low <= focal / side <= high:
            raise InputError(
                f"{where}the focal length {name} is {focal:g} for {side:g} pixels, expected {low * side:g} to "
                f"{high * side:g}: specify it in pixels of images of that size, not in millimetres or other units"
            )
    if not 1.0 / _MAX_FOCAL_RATIO <= fx / fy <= _MAX_FOCAL_RATIO:
        raise InputError(
            f"{where}the focal lengths are {fx:g} across and {fy:g} down, expected about the same: one of them is wrong"
        )
    point = f"{where}the principal point is {cx:g} {cy:g} in {width:g}×{height:g} pixels"
    far = _OFF_CENTRE  # the point is outside the image if the image is a tile of a larger image
    if not (-far * width <= cx <= far * width and -far * height <= cy <= far * height):
        raise InputError(f"{point}, expected about the middle")
    away = max(abs(2.0 * cx / width - 1.0), abs(2.0 * cy / height - 1.0))
    away_if_swapped = max(abs(2.0 * cx / height - 1.0), abs(2.0 * cy / width - 1.0))
    if away_if_swapped <= _SWAPPED < away:
        middle_text = f"{0.5 * width:g} {0.5 * height:g}"
        raise InputError(f"{point}, expected about {middle_text}: width and height, or its two numbers, are swapped")


def finite_number(values: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """Look up a finite number.

    Raises:
        InputError: the value is missing without a default, or not a finite number.
    """
    value = values.get(key)
    if value is None and default is not None:
        return default
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:  # an integer beyond float64
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{where}: {key} is {repr(value)[:40]}, expected a number")
    return number


def focal_lengths(
    values: Mapping[str, Any], width: float, height: float, where: str, *, fisheye: bool = False
) -> tuple[float, float]:
    """Return the focal lengths of a transforms.json, which may specify angles of view instead.

    Args:
        values: at least one of fl_x, fl_y, camera_angle_x, camera_angle_y.
        width, height: size of the images, pixels.
        where: file and place, for messages.
        fisheye: do not compare angles of view with focal lengths, because a fisheye is not a pinhole.

    Returns:
        The horizontal and vertical focal length, pixels; equal if only one is specified.

    Raises:
        InputError: no value is specified, a value is out of range, or two values contradict each other.
    """
    fx = _focal_along(values, "x", width, where, fisheye=fisheye)
    fy = _focal_along(values, "y", height, where, fisheye=fisheye)
    if fx is None and fy is None:
        raise InputError(f"{where}: no focal length, expected fl_x or camera_angle_x")
    fx, fy = fx or fy, fy or fx  # square pixels unless both are specified
    assert fx is not None
    assert fy is not None
    return fx, fy


def viewmat_of_opengl(matrix: Any, name: str, where: str) -> F64:
    """Convert camera to world with OpenGL axes into world to camera with OpenCV axes.

    Args:
        matrix: [4, 4] or [3, 4], by rows.
        name: name of the field, for messages.
        where: file and place, for messages.

    Raises:
        InputError: the matrix is not a rotation with a translation, up to a common scale.
    """
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: {name} is not a matrix of numbers") from None
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        hint = ", as if by decimal commas" if pose.ndim == 2 and pose.shape[1] == 8 else ""
        raise InputError(f"{where}: {name} has shape {list(pose.shape)}{hint}, expected [4, 4], finite")
    if len(pose) == 4:
        check_last_row(pose, f"{where}: {name}")
    axes = pose[:3, :3] * np.array([1.0, -1.0, -1.0])
    lengths = np.linalg.norm(axes, axis=0)
    scale = float(lengths.mean())  # some exporters include the scale of the world in the axes
    determinant = float(np.linalg.det(axes))
    if not (scale > 0.0 and determinant > 0.0 and np.abs(lengths / scale - 1.0).max() <= _SCALE_TOLERANCE):
        lengths_text = ", ".join(f"{length:.4g}" for length in lengths)
        raise InputError(
            f"{where}: {name} begins with axes of lengths {lengths_text} and determinant {determinant:.4g}, expected a "
            "rotation: it is mirrored, sheared or zero"
        )
    u, _, vt = np.linalg.svd(axes / scale)  # u vᵀ is the nearest rotation: files have few digits
    viewmat = np.eye(4)
    viewmat[:3, :3] = (u @ vt).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ pose[:3, 3]
    return viewmat


def describe_scales(matrices: Sequence[Any], where: str) -> list[str]:
    """Report poses with a scale in their axes, which `viewmat_of_opengl` removes.

    Args:
        matrices: the poses, valid for `viewmat_of_opengl`.
        where: the file, for messages.
    """
    scales = [float(np.linalg.norm(np.array(matrix, np.float64)[:3, :3], axis=0).mean()) for matrix in matrices]
    scaled = [scale for scale in scales if abs(scale - 1.0) > _SCALE_TOLERANCE]
    if not scaled:
        return []
    return [f"{where}: {counted(len(scaled), 'pose')} scaled (the first by {scaled[0]:g}): removed, positions stay"]


def _parse_own_cameras(entries: object, path: Path) -> list[Camera]:
    """Parse a list of cameras in csplat's own form, or a single one.

    Args:
        entries: contents of a JSON file.
        path: the file, for messages.

    Raises:
        InputError: a camera is invalid, or there are none; the message names the contents of known other files.
    """
    first = entries[0] if isinstance(entries, list) and entries else entries
    keys = first.keys() if isinstance(first, Mapping) else set[str]()
    hints = [hint for fields, hint in _UNREAD if fields <= keys]
    if hints and not {"K", "viewmat"} <= keys:  # cameras may have further keys
        raise InputError(f"{path} {hints[0]}")
    if {"K", "viewmat"} <= keys and isinstance(entries, Mapping):  # one camera, as viewers give it
        entries = [entries]
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{path} is not a camera file, expected a list of {{K, viewmat, W, H}}, cameras.json of INRIA, a camera "
            "path of nerfstudio, or transforms.json"
        )
    cameras = []
    for number, entry in enumerate(entries):
        try:
            cameras.append(Camera.from_json(entry))
        except InputError as error:
            raise InputError(f"{path}, camera {number}: {error}") from error
    return cameras


def _parse_each(
    entries: list[Any], where: str, kind: str, parse: Callable[[Mapping[str, Any], str], Camera]
) -> list[Camera]:
    """Parse the entries of a list.

    Args:
        entries: the list.
        where: the file, for messages.
        kind: a word for an entry, for messages.
        parse: returns the camera of an entry; its second argument is the file and the entry, for messages.

    Raises:
        InputError: the list is empty, or an entry is not an object or invalid.
    """
    if not entries:
        raise InputError(f"{where} lists no cameras")
    cameras = []
    for index, entry in enumerate(entries):
        place = f"{where}, {kind} {index}"
        if not isinstance(entry, Mapping):
            raise InputError(f"{place} is {type(entry).__name__}, expected an object")
        cameras.append(parse(entry, place))
    return cameras


def _make_camera(
    where: str,
    focals: tuple[float, float],
    middle: tuple[float, float],
    viewmat: F64,
    size: tuple[float, float],
    near: float,
    image: Any,
) -> Camera:
    """Build a camera; error messages begin with `where`.

    Args:
        where: file and entry.
        focals, middle: fx, fy and cx, cy, pixels.
        viewmat: [4, 4].
        size: width and height, pixels.
        near: near plane, scene units.
        image: name of the image, or `None`.

    Raises:
        InputError: the size, the intrinsics, the pose or the near plane is invalid.
    """
    (fx, fy), (cx, cy), (width, height) = focals, middle, size
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    try:
        return Camera.from_json({"K": K, "viewmat": viewmat, "W": width, "H": height, "near": near, "image": image})
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _parse_inria(entry: Mapping[str, Any], where: str) -> Camera:
    """Parse an entry of cameras.json; the principal point is the middle of the image.

    Raises:
        InputError: a value is missing, not a number or of another shape, or the rotation is invalid.
    """
    width, height = finite_number(entry, "width", where), finite_number(entry, "height", where)
    focals = finite_number(entry, "fx", where), finite_number(entry, "fy", where)
    try:
        rotation, position = (np.array(entry.get(key), np.float64) for key in ("rotation", "position"))
    except (TypeError, ValueError, OverflowError):
        rotation = position = np.zeros(0)
    if rotation.shape != (3, 3) or position.shape != (3,):
        raise InputError(f"{where}: rotation or position has another shape, expected [3, 3] and [3]")
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ position
    middle = width / 2.0, height / 2.0
    return _make_camera(where, focals, middle, viewmat, (width, height), DEFAULT_NEAR, entry.get("img_name"))


def _parse_nerfstudio(document: Mapping[str, Any], entry: Mapping[str, Any], where: str) -> Camera:
    """Parse an entry of a camera path, whose image size and camera type are in the document.

    `fov` is vertical, in degrees; the principal point is the middle of the image.

    Raises:
        InputError: the camera is not a perspective, or a value is missing or out of range.
    """
    kind = str(document.get("camera_type") or "perspective")
    if kind.lower() != "perspective":
        raise InputError(f"{where}: camera_type is {kind}, expected perspective")
    width, height = finite_number(document, "render_width", where), finite_number(document, "render_height", where)
    angle = finite_number(entry, "fov", where)
    if not 0.0 < angle < 180.0:
        raise InputError(f"{where}: fov is {angle:g}, expected degrees above 0 and below 180")
    matrix = entry.get("camera_to_world")
    if isinstance(matrix, list) and len(matrix) == 16:
        matrix = [matrix[row : row + 4] for row in range(0, 16, 4)]
    viewmat = viewmat_of_opengl(matrix, "camera_to_world", where)
    focal, middle = 0.5 * height / math.tan(math.radians(angle) / 2.0), (width / 2.0, height / 2.0)
    return _make_camera(where, (focal, focal), middle, viewmat, (width, height), _NERFSTUDIO_NEAR, None)


def _parse_frame(document: Mapping[str, Any], frame: Mapping[str, Any], where: str) -> Camera:
    """Parse a frame of transforms.json; the document has the values that the frame lacks. Distortion is ignored.

    Raises:
        InputError: the camera is not a perspective, or a value is missing, out of range or contradicts another.
    """
    values = frame_values(document, frame)
    if values.get("w") is None or values.get("h") is None:
        raise InputError(f"{where}: w and h are missing, expected the size of the images (--data reads it from them)")
    width, height = finite_number(values, "w", where), finite_number(values, "h", where)
    model = str(values.get("camera_model") or "").upper()
    if values.get("is_fisheye") or model not in PERSPECTIVES:
        raise InputError(
            f"{where}: camera_model is {model or 'a fisheye'}, expected one of {', '.join(PERSPECTIVES[1:])}"
        )
    fx, fy = focal_lengths(values, width, height, where)
    cx, cy = finite_number(values, "cx", where, width / 2.0), finite_number(values, "cy", where, height / 2.0)
    viewmat = viewmat_of_opengl(values.get("transform_matrix"), "transform_matrix", where)
    return _make_camera(where, (fx, fy), (cx, cy), viewmat, (width, height), _NERFSTUDIO_NEAR, values.get("file_path"))


def _focal_along(values: Mapping[str, Any], axis: str, size: float, where: str, *, fisheye: bool) -> float | None:
    """Return the focal length along an axis, pixels, from `fl_*` or `camera_angle_*`; `None` if neither is specified.

    Args:
        values: values of a frame.
        axis: "x" or "y".
        size: width or height of the images, pixels.
        where: file and place, for messages.
        fisheye: do not compare the two if both are specified.

    Raises:
        InputError: a value is out of range, or the two contradict each other.
    """
    length, angle = values.get(f"fl_{axis}"), values.get(f"camera_angle_{axis}")
    by_angle = None
    if angle is not None and not (fisheye and length is not None):
        radians = finite_number(values, f"camera_angle_{axis}", where)
        if not 0.0 < radians < math.pi:
            hint = " (degrees?)" if math.pi <= radians < 180.0 else ""
            raise InputError(f"{where}: camera_angle_{axis} is {radians:g}{hint}, expected radians above 0 and below π")
        by_angle = 0.5 * size / math.tan(0.5 * radians)
    if length is None:
        return by_angle
    focal = finite_number(values, f"fl_{axis}", where)
    if focal <= 0.0:
        raise InputError(f"{where}: fl_{axis} is {focal:g}, expected above 0")
    if by_angle is not None and abs(by_angle / focal - 1.0) > _ANGLE_TOLERANCE:
        raise InputError(
            f"{where}: fl_{axis} is {focal:g}, expected {by_angle:.6g} from camera_angle_{axis} = {angle:g} and "
            f"{size:g} pixels: remove the wrong one"
        )
    return focal
