# SPDX-License-Identifier: Apache-2.0
"""`load`: recognise a data set, read it, choose its origin and axes, and report findings."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from csplat.errors import InputError, counted
from csplat.scene_metadata import UNSPECIFIED, Direction, unit_up, up_of_axes
from csplat.types import F64, Mask
from csplat_render.camera import MAX_IMAGE_SIZE, camera_outliers, nearest_point
from csplat_trainer.data.colmap import find_model, read_colmap
from csplat_trainer.data.dataset import DataSet, Shot, UnreadDataSet, near_plane, open_shot
from csplat_trainer.data.dataset_checks import check_shots, describe_images, describe_lenses, describe_poses
from csplat_trainer.data.foreign_sets import describe_foreign
from csplat_trainer.data.image_files import IMAGE_ENDINGS, abbreviate
from csplat_trainer.data.image_pixels import opaque_images, read_image_header
from csplat_trainer.data.set_folder import SetFolder
from csplat_trainer.data.transforms import read_blender, read_transforms

_SET_LEVELS = 2  # how far the data set may be above its folder of images
_SETS = ("transforms_train.json", "transforms.json")
_MAX_NAMED = 3  # folders in a message, at most
_AGREES = math.cos(math.radians(30.0))  # least cosine between the conventional and the cameras' up direction


def load(
    path: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    *,
    images: str | None = None,
    test_every: int = 8,
    near: float | None = None,
    trust_paths: bool = False,
) -> DataSet:
    """Find the posed images of a data set. Their pixels are read on first access, or by `DataSet.read`.

    | recognised by | kind |
    |---|---|
    | `transforms_train.json` | NeRF-synthetic, made with Blender; RGBA |
    | `transforms.json` | instant-ngp, nerfstudio |
    | `sparse/0/cameras.bin` or `.txt` | COLMAP, such as Mip-NeRF 360, Tanks and Temples, Deep Blending |

    Files are checked for consistency (`dataset_checks`), and images are undistorted (`lens`). Images, masks, points and
    lists outside of the folder of the set are refused, whether by `..`, an absolute path or a link.

    Args:
        path: its folder, its `transforms.json`, or a folder of images in it, such as `garden/images_4`.
        size: width and height to which all images are scaled, each axis separately; `None`: unchanged.
        images: the folder of images, such as `images_4`. `None`: the set's own folder; for COLMAP sets with `size`, the
            folder with the smallest images that are large enough.
        test_every: every Nth image is a test image if the set specifies none; 0: no test images.
        near: near plane of the cameras, scene units; `None`: derived from the set.
        trust_paths: read files outside of the folder, too.

    Returns:
        All images, undistorted, with their cameras.

    Raises:
        InputError: there is no data set, it is damaged, has no images, or names files outside of its folder.
    """
    path, named = Path(path), None
    if images is None:
        named = path
        path, images = find_image_folder(path)
    place = SetFolder(path if path.is_dir() else path.parent, trust_paths, None if images is None else named)
    if size is not None and not all(1 <= side <= MAX_IMAGE_SIZE for side in size):
        raise InputError(f"size is {size[0]}×{size[1]}, expected 1 to {MAX_IMAGE_SIZE} pixels per side")
    unread = _read_by_kind(place, path, size, images, test_every)
    if not unread.train:
        raise InputError(f"{path} has no training images")
    unread = _drop_far_points(unread)
    doubts = describe_poses([*unread.train, *unread.test], unread.points)
    unread, origin = choose_origin(unread)
    unread = _resolve_links(unread, place)
    shots = [*unread.train, *unread.test]
    heads = {shot.path: read_image_header(shot.path) for shot in (*shots, *unread.val)}
    check_shots([*shots, *unread.val], heads)
    opaque = opaque_images(heads.values())
    heads |= {head.path: replace(head, has_alpha=False) for head in opaque}
    near = near_plane(shots, unread.points) if near is None else near
    train, test, val = (
        [open_shot(shot, heads[shot.path], size, near) for shot in part]
        for part in (unread.train, unread.test, unread.val)
    )
    name = f"{unread.kind} {path}"
    sizes = sorted({(image.camera.W, image.camera.H) for image in (*train, *test)})
    shown = ", ".join(f"{width}×{height}" for width, height in sizes[:3]) + (", …" if len(sizes) > 3 else "")
    points = "" if unread.points is None else f", {counted(len(unread.points), 'point')}"
    counts = f"{len(unread.train)} training and {counted(len(unread.test), 'test image')}"
    counts += f", {len(unread.val)} for validation," if unread.val else ""
    report = [f"{name}: {counts} of {shown} pixels{points}", *unread.report]
    masked = sum(shot.mask is not None for shot in shots)
    if masked:
        report.append(f"masks hide parts of {counted(masked, 'image')}, which do not count")
    if opaque:
        report.append(f"alpha is 1 everywhere in {counted(len(opaque), 'image')}: it is ignored")
    report += [*describe_lenses(shots), *describe_images(shots, heads), *doubts]
    with_alpha = sum(heads[shot.path].has_alpha for shot in shots)
    if 0 < with_alpha < len(shots):
        background = "white" if 2 * with_alpha >= len(shots) else "black"
        report.append(f"{with_alpha} of {len(shots)} images have transparency: the background of all is {background}")
    training_paths = {shot.path for shot in unread.train}
    both = sum(shot.path in training_paths for shot in unread.test)
    if both:
        report.append(
            f"{counted(both, 'test image')} used for training, too: scores do not show the quality of new views"
        )
    if (unread.points is None or not len(unread.points)) and not any(image.has_alpha for image in train):
        report.append("there are no points: splats start anywhere in view")
    colours = unread.points_rgb
    if colours is not None and len(colours) and (colours == colours[0]).all():
        shade = " ".join(f"{value:.3g}" for value in colours[0].tolist())
        report.append(f"all points have the colour {shade}: initial colours are taken from the images instead")
        colours = None
    axes, up, axes_note = _choose_axes(unread.coordinate_system, shots)
    data = DataSet(
        name,
        train,
        test,
        None if unread.points is None else unread.points.astype(np.float32),
        colours,
        tuple(line for line in (*report, axes_note) if line),
        axes,
        up,
        unread.test_every,
        size,
        images,
        val,
        origin,
    )
    outliers = describe_outliers(data)
    return replace(data, report=(*data.report, outliers)) if outliers else data


def find_image_folder(path: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Split the path of a folder of images in a data set.

    Args:
        path: a data set; or a folder of images in a data set, if the folder is not itself a data set.

    Returns:
        `garden` and `images_4` for `garden/images_4`; otherwise `path` and `None`.
    """
    path = Path(path)
    files = (file for pattern in ("*", "*/*") for file in path.glob(pattern))
    if path.is_dir() and not _is_set(path) and any(file.suffix.lower() in IMAGE_ENDINGS for file in files):
        for folder in path.parents[:_SET_LEVELS]:
            if _is_set(folder):
                return folder, path.relative_to(folder).as_posix()
    return path, None


def _is_set(folder: Path) -> bool:
    """Return True if a folder has a file of frames, or a COLMAP model."""
    return any((folder / name).is_file() for name in _SETS) or find_model(folder) is not None


def _choose_axes(custom: str, shots: Sequence[Shot]) -> tuple[str, Direction | None, str]:
    """Return the axes of a set, its up direction, and a line for the report.

    Args:
        custom: conventional axes of sets of this kind. If files have other coordinates, the cameras determine up.
        shots: all shots of the set.
    """
    level, usual = estimate_up_of_cameras([shot.viewmat for shot in shots]), up_of_axes(custom)
    if level is None:
        return custom, usual, "" if usual else "the up direction is unknown: the cameras were held at all angles"
    if usual is None:
        return custom, level.up, str(level)
    if sum(a * b for a, b in zip(usual, level.up, strict=True)) < _AGREES:
        return UNSPECIFIED, level.up, f"{level}; sets of this kind usually have other axes"
    return custom, usual, ""


def _resolve_links(data: UnreadDataSet, place: SetFolder) -> UnreadDataSet:
    """Resolve the links of images and masks, so that the files read later are the files that were checked."""
    train, test, val = (
        [
            replace(shot, path=place.settled(shot.path), mask=None if shot.mask is None else place.settled(shot.mask))
            for shot in part
        ]
        for part in (data.train, data.test, data.val)
    )
    return replace(data, train=train, test=test, val=val)


def _read_by_kind(
    place: SetFolder, path: Path, size: tuple[int, int] | None, images: str | None, test_every: int
) -> UnreadDataSet:
    """Read a set by the reader of its kind, without the pixels.

    Args:
        place: the folder of the set.
        path: the set: a folder, or a file of frames.
        size: requested width and height, by which a COLMAP set chooses its folder of images; `None`: the first folder.
        images: name of the folder of images; `None`: chosen by the reader.
        test_every: see `split_every`; not used for Blender sets.

    Raises:
        InputError: the path is no set, or its reader refuses it.
    """
    if path.is_file() and (foreign := describe_foreign(path)):
        raise InputError(foreign)
    if path.is_file() and path.suffix.lower() == ".json":
        if path.name == "transforms_train.json":
            return read_blender(place, images)
        return read_transforms(place, path, test_every, images)
    if not path.is_dir():
        zipped = path.suffix.lower() == ".zip" and path.is_file()
        remedy = ": unpack it, and name the folder" if zipped else ""
        raise InputError(f"{path} is neither a folder nor a transforms.json{remedy or _suggest_image_folders(path)}")
    model = find_model(path)
    if (path / "transforms_train.json").is_file():
        unread = read_blender(place, images)
    elif (path / "transforms.json").is_file():
        unread = read_transforms(place, path / "transforms.json", test_every, images)
    elif model is not None:
        unread = read_colmap(place, model[0], size, images, test_every)
        return replace(unread, report=[*model[1], *unread.report])
    elif not (place_hint := _suggest_subfolder(path)) and (foreign := describe_foreign(path)):
        raise InputError(foreign)
    else:
        raise InputError(
            f"{path} is not a data set: expected transforms_train.json (Blender), transforms.json (instant-ngp) "
            f"or sparse/0/cameras.bin (COLMAP), or a folder of images of such a set{place_hint or _suggest_poses(path)}"
        )
    if model is not None:
        unread = replace(unread, report=[*unread.report, "there is also a COLMAP model, which is ignored"])
    if unread.kind == "Blender set" and (path / "transforms.json").is_file():
        unread = replace(unread, report=[*unread.report, "there is also a transforms.json, which is ignored"])
    return unread


def _suggest_image_folders(path: Path) -> str:
    """Return a hint with the folders of images next to a path that does not exist, or ""."""
    siblings = sorted(path.parent.glob("*/")) if path.parent.is_dir() else []
    folders = [folder for folder in siblings if find_image_folder(folder)[1]]
    return f"; {path.parent} has {', '.join(folder.name for folder in folders)}" if folders else ""


def _suggest_poses(path: Path) -> str:
    """Return a hint for a folder of images without camera poses; "" if there are no images either."""
    files = (file for folder in (path, path / "images", path / "input") for file in folder.glob("*"))
    if any(file.suffix.lower() in (".jpg", ".jpeg", ".png") for file in files):
        return "; there are images, but no camera poses: compute them with COLMAP first"
    return ""


def _suggest_subfolder(path: Path) -> str:
    """Return a hint for a folder that is no set: the sets in it, or COLMAP's next step; "" if it has neither."""
    folders = [*sorted(path.glob("*/")), *sorted(path.glob("*/*/"))]
    sets = [folder for folder in folders if _is_set(folder)]
    if sets:
        names = ", ".join(folder.relative_to(path).as_posix() for folder in sets[:_MAX_NAMED])
        return f"; did you mean {names} in it?"
    if (path / "database.db").is_file():
        return "; it has a database of COLMAP, but no model yet: run `colmap mapper`"
    return ""


Origin = tuple[float, float, float]

_NEAR_SIZES = 256.0  # distance from 0, in sizes of the scene; beyond, a step of float32 exceeds 1.5e-5 of the size


def choose_origin(data: UnreadDataSet) -> tuple[UnreadDataSet, Origin]:
    """Choose an origin for a set, and return its cameras and points relative to it, and the origin.

    The origin is 0 if the set is around 0 or near it. Else it is the middle of the cameras, rounded to a power of ten
    below the size of the scene: coordinates of maps (UTM, ECEF) are millions of metres, with a resolution of 0.5 in
    float32.

    Raises:
        InputError: a camera's position overflows float32.
    """
    shots = [*data.train, *data.test, *data.val]
    viewmats = np.stack([shot.viewmat for shot in shots])
    for shot in shots:
        if not np.abs(shot.viewmat[:3, 3]).max() < np.finfo(np.float32).max:
            far = float(np.abs(shot.viewmat[:3, 3]).max())
            raise InputError(f"the camera of {shot.name} is {far:.3g} units from 0, expected a place in the scene")
    viewmats = viewmats[~camera_outliers(viewmats, data.points)]
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    middle = np.median(positions, axis=0)
    if data.points is not None and len(data.points):
        subject = np.median(data.points, axis=0) - middle
    else:
        subject = nearest_point(positions - middle, viewmats[:, 2, :3])
    spread = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    size = max(spread, float(np.linalg.norm(subject)))
    if size == 0.0 or np.abs(middle).max() <= _NEAR_SIZES * size:
        return data, (0.0, 0.0, 0.0)
    digits = -math.floor(math.log10(size))
    x, y, z = (round(value, digits) + 0.0 for value in middle.tolist())  # no negative zeros
    origin = np.array([x, y, z])
    train, test, val = ([_relative_to(shot, origin) for shot in part] for part in (data.train, data.test, data.val))
    points = None if data.points is None else data.points - origin
    words = " ".join(str(value).removesuffix(".0") for value in (x, y, z))
    report = f"coordinates are far from 0: the scene is relative to the origin {words}"
    return replace(data, train=train, test=test, val=val, points=points, report=[*data.report, report]), (x, y, z)


_FAR_POINT = 8.0  # least distance of an outlier from the middle of the points, in median distances
_POINT_GAP = 2.0  # least distance of an outlier, in largest distances of the other points; or else
_FARTHEST_POINT = 100.0  # largest distance of others, in median distances; beyond, cameras see hardly any parallax
_MOST_FAR_POINTS = 0.1  # maximum fraction of outliers


def point_outliers(points: F64) -> Mask:
    """Find points that are far away from all others, as structure from motion places points seen at small angles.

    Distances that grow gradually, as in the background of a scene, are no outliers up to `_FARTHEST_POINT`.

    Args:
        points: [P, 3].

    Returns:
        [P], True for outliers, at most a tenth of all.
    """
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    with np.errstate(over="ignore"):  # squares may overflow to infinity
        distances = np.sqrt(np.sum((points - np.median(points, axis=0)) ** 2, axis=1))
    away = np.sort(distances)
    first, usual = max(1, math.ceil((1.0 - _MOST_FAR_POINTS) * len(away))), away[len(away) // 2]
    least = np.maximum(_FAR_POINT * usual, np.minimum(_POINT_GAP * away[first - 1 : -1], _FARTHEST_POINT * usual))
    far = away[first:] > least
    if usual == 0.0 or away[first - 1] > _FARTHEST_POINT * usual or not far.any():
        return np.zeros(len(points), np.bool_)
    outliers: Mask = distances >= away[first + int(np.argmax(far))]
    return outliers


def _drop_far_points(data: UnreadDataSet) -> UnreadDataSet:
    """Drop outliers among a set's points, and report them: splats that start there are not seen, but stay."""
    if data.points is None:
        return data
    outliers = point_outliers(data.points)
    if not outliers.any():
        return data
    distances = np.linalg.norm(data.points - np.median(data.points, axis=0), axis=1)
    nearest, usual = float(distances[outliers].min()), float(np.median(distances[~outliers]))
    count = int(np.count_nonzero(outliers))
    report = (
        f"{count:,} of {counted(len(outliers), 'point')} {'is' if count == 1 else 'are'} at least {nearest:,.4g} units"
        f" from the middle of the others, {nearest / usual:,.4g} times the usual distance: left out"
    )
    colours = None if data.points_rgb is None else data.points_rgb[~outliers]
    return replace(data, points=data.points[~outliers], points_rgb=colours, report=[*data.report, report])


def describe_outliers(data: DataSet) -> str:
    """Return a sentence on the cameras that are far from all others; "" if there are none.

    They keep their roles: a training image that shows nothing has no effect.
    """
    if not data.outliers:
        return ""
    positions = np.stack([image.camera.position for image in (*data.outliers, *data.train, *data.test, *data.val)])
    distances = np.linalg.norm(positions - np.median(positions[len(data.outliers) :], axis=0), axis=1)
    nearest, usual = float(distances[: len(data.outliers)].min()), float(np.median(distances[len(data.outliers) :]))
    times = f", {nearest / usual:,.4g} times the usual distance" if usual > 0.0 else ""
    names = [str(image.camera.image) for image in data.outliers]
    subject = f"the camera of {names[0]} is" if len(names) == 1 else f"the cameras of {abbreviate(names)} are"
    text = f"{subject} {nearest:,.4g} units from the others{times}: ignored for the scene's extent; check the poses"
    tested = sum(image in data.test for image in data.outliers)
    return f"{text}, {counted(tested, 'test image')} will score badly" if tested else text


def _relative_to(shot: Shot, origin: F64) -> Shot:
    """Return a shot for points relative to an origin [3]: its viewmat · (p − origin) is the old viewmat · p."""
    viewmat = shot.viewmat.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ origin
    return replace(shot, viewmat=viewmat)


_TURNED = 0.03  # least second eigenvalue of the cameras' right axes if cameras look in various directions
_TILT_MAX = 20.0  # degrees; cameras held less level do not determine up
_UNDECIDED = 0.1  # cosine with the cameras' mean up, below which they look down, and up is opposite to their view


@dataclass(frozen=True)
class UpEstimate:
    """Up direction estimated from the cameras of a set.

    Attributes:
        up: unit length, in the scene's coordinates.
        tilt_degrees: median angle between the images' horizons and level horizons or, if `by_horizons` is False,
            between the cameras' own up and `up`. It is robust to some images in portrait orientation.
        by_horizons: True if up is the direction in which the cameras' right axes point least, since cameras are mostly
            held level. This requires cameras that look in various directions; otherwise up is the mean of the
            cameras' own.
    """

    up: Direction
    tilt_degrees: float
    by_horizons: bool

    def __str__(self) -> str:
        """Return the estimate in words."""
        words = " ".join(f"{value:g}" for value in self.up)
        what = "horizon" if self.by_horizons else "own up"
        return f"up is {words} by the cameras: for half of them the {what} is within {self.tilt_degrees:.1f} degrees"


def estimate_up_of_cameras(viewmats: Sequence[F64]) -> UpEstimate | None:
    """Estimate up from the cameras of a set.

    Args:
        viewmats: [4, 4] each, world to camera, OpenCV axes: rows are right, down, forward. At least one.

    Returns:
        The estimate; `None` if the cameras were held at all angles.
    """
    rotations = np.stack([viewmat[:3, :3] for viewmat in viewmats])
    right, own_up, forward = rotations[:, 0], -rotations[:, 1], rotations[:, 2]
    values, directions = np.linalg.eigh(np.mean(right[:, :, None] * right[:, None, :], axis=0))
    mean_up = np.mean(own_up, axis=0)
    estimates: list[UpEstimate] = []
    if values[1] > _TURNED:
        up = directions[:, 0]
        towards = float(np.sum(up * mean_up))
        if abs(towards) < _UNDECIDED:
            towards = -float(np.sum(up * np.mean(forward, axis=0)))
        up = up if towards >= 0.0 else -up
        estimates.append(_measure_up(up, np.arcsin(np.clip(np.sum(right * up, axis=1), -1.0, 1.0)), by_horizons=True))
    length = float(np.sqrt(np.sum(mean_up**2)))
    if length > _UNDECIDED:
        up = mean_up / length
        estimates.append(_measure_up(up, np.arccos(np.clip(np.sum(own_up * up, axis=1), -1.0, 1.0)), by_horizons=False))
    return next((estimate for estimate in estimates if estimate.tilt_degrees <= _TILT_MAX), None)


def _measure_up(up: F64, angles: F64, *, by_horizons: bool) -> UpEstimate:
    """Return an up direction [3] with its tilt, the median of the absolute angles of the cameras [V], radians."""
    tilt = float(np.degrees(np.median(np.abs(angles))))
    return UpEstimate(unit_up([float(value) for value in up]), tilt, by_horizons)
