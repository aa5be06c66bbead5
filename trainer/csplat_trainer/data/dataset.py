# SPDX-License-Identifier: Apache-2.0
"""Data sets, and functions shared by their readers: unread shots, splits, undistorted images, point clouds."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import ExifTags, Image

from csplat.disk_files import read_json, read_text
from csplat.errors import InputError, counted
from csplat.image_opener import open_image
from csplat.lint import Finding
from csplat.ply.ply_reader import parse_ply
from csplat.scene_metadata import UNSPECIFIED, Direction, TrainingRecord, up_of_axes
from csplat.types import F32, F64, U8, Mask
from csplat_render.camera import DEFAULT_NEAR, Camera, camera_outliers, nearest_point
from csplat_trainer.data.image_files import abbreviate, match_names, normalise_name, printable
from csplat_trainer.data.image_pixels import MASK_THRESHOLD, ImageHeader, mask_values, rgb_pixels
from csplat_trainer.data.lens import Lens, distorted, undistorted_lens
from csplat_trainer.data.set_folder import SetFolder
from csplat_trainer.posed_images import PosedImage, UnreadMask, UnreadPixels

_BLACK, _WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_NEAR_FRACTION = 0.03  # near plane as a fraction of the cameras' distance from their subject


@dataclass(frozen=True, eq=False)
class DataSet:
    """Posed images for training, validation and tests.

    Attributes:
        name: kind and path, for messages: `COLMAP set /data/garden`.
        train: training images, at least one.
        test: test images; none if the set is too small or specifies none.
        points: [P, 3] float32, points of the scene, relative to `origin`, if any.
        points_rgb: [P, 3] float32 in 0..1, their colours, if any.
        report: lines on findings, omissions and changes.
        coordinate_system: as in `SplatModel`, if this kind of set has a convention.
        up: up direction; `None` if neither the kind of set nor its cameras determine it.
        test_every: every Nth image is a test image; `None` if the set specifies its test images.
        size: width and height that the images are scaled to; `None`: unchanged.
        images: the requested folder of images; `None`: chosen by the reader.
        val: validation images of the set, which are neither training nor test images.
        origin: [3] float64, the point that points and cameras are relative to, in the coordinates of the set's files.
            It differs from 0 if coordinates are so large that float32 would lose visible detail.
    """

    name: str
    train: list[PosedImage]
    test: list[PosedImage]
    points: F32 | None = None
    points_rgb: F32 | None = None
    report: tuple[str, ...] = ()
    coordinate_system: str = UNSPECIFIED
    up: Direction | None = None
    test_every: int | None = None
    size: tuple[int, int] | None = None
    images: str | None = None
    val: list[PosedImage] = field(default_factory=list)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def up_is_estimated(self) -> bool:
        """True if the cameras determine the up direction, and not the kind of set."""
        return self.up is not None and self.up != up_of_axes(self.coordinate_system)

    @property
    def background(self) -> tuple[float, float, float]:
        """Background colour: white if at least half of the images have alpha, as in published tables; else black."""
        images = (*self.train, *self.test)
        return _WHITE if 2 * sum(image.has_alpha for image in images) >= len(images) else _BLACK

    def trained_on(self, background: tuple[float, float, float]) -> TrainingRecord:
        """Return the record for a scene that was trained on this set and evaluated on a background colour."""
        return TrainingRecord(background, self.test_every, self.size, self.train[0].camera.near, self.images)

    @cached_property
    def outliers(self) -> list[PosedImage]:
        """Images whose cameras are far from all others (`camera_outliers`)."""
        images = [*self.train, *self.test, *self.val]
        outliers = camera_outliers(np.stack([image.camera.viewmat for image in images]), self.points)
        return [image for image, outlier in zip(images, outliers, strict=True) if outlier]

    @property
    def inliers(self) -> list[PosedImage]:
        """Training images that determine the extent of the scene: all but outliers, or all if only outliers exist."""
        outliers = {id(image) for image in self.outliers}
        return [image for image in self.train if id(image) not in outliers] or self.train

    def read(self) -> None:
        """Read all training and test images, to detect damaged files early.

        Raises:
            InputError: a file is not an image, or is truncated.
        """
        for image in (*self.train, *self.test):
            _ = image.pixels, image.mask


@dataclass(frozen=True, eq=False)
class Shot:
    """An unread image of a data set, with its camera.

    Attributes:
        name: name of the image in the set's files.
        path: the image file.
        lens: lens of the camera.
        viewmat: [4, 4] float64, world to camera, OpenCV axes.
        mask: path of the mask, an image that is black for pixels that do not count.
    """

    name: str
    path: Path
    lens: Lens
    viewmat: F64
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class UnreadDataSet:
    """Result of a reader: everything but the pixels.

    Attributes:
        kind: kind of the set, such as `Blender set`.
        train, test, val: training, test and validation shots.
        points: [P, 3] float64 or `None`.
        points_rgb: [P, 3] float32 in 0..1 or `None`.
        report, test_every, coordinate_system: as in `DataSet`.
    """

    kind: str
    train: list[Shot]
    test: list[Shot]
    points: F64 | None = None
    points_rgb: F32 | None = None
    report: list[str] = field(default_factory=list)
    test_every: int | None = None
    coordinate_system: str = UNSPECIFIED
    val: list[Shot] = field(default_factory=list)


def near_plane(shots: Sequence[Shot], points: F64 | None = None) -> float:
    """Return the near plane for a data set: a small fraction of the distance to the cameras' subject.

    Poses that were computed from images have arbitrary units, so the renderer's default, which is an upper limit here,
    may be beyond the scene.

    Args:
        shots: at least one; outliers are ignored.
        points: [P, 3], points of the scene, if known.
    """
    viewmats = np.stack([shot.viewmat for shot in shots])
    viewmats = viewmats[~camera_outliers(viewmats, points)]
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    focus = nearest_point(positions, viewmats[:, 2, :3])
    distance = float(np.median(np.linalg.norm(positions - focus, axis=1)))
    return min(DEFAULT_NEAR, _NEAR_FRACTION * distance) if distance > 0.0 else DEFAULT_NEAR


_SCANNET = "train_test_lists.json"  # split file of ScanNet++

#: Roles by names of lists.
ROLES = {"train": "training", "val": "validation", "test": "test"}


def read_split_lists(place: SetFolder, folders: Sequence[Path]) -> tuple[dict[str, list[str]], str]:
    """Read the files that list images: ScanNet++'s `train_test_lists.json`, or text files with a name per line.

    Text files are called `test.txt` or `test_list.txt`, and likewise for `val` and `train`.

    Args:
        place: the folder of the set.
        folders: folders to search; the first with lists is used.

    Returns:
        Lines by `train`, `val` and `test`, and the files' names.

    Raises:
        InputError: a file is not text, or is a link that leads out of the folder of the set.
    """
    for folder in folders:
        document = folder / _SCANNET
        if document.is_file():
            return _read_scannet_lists(place.checked(document)), document.name
        files = {role: path for role in ROLES for path in _find_list_files(folder, role)[:1]}
        if files:
            texts = {role: read_text(place.checked(path), any_bytes=True) for role, path in files.items()}
            lists = {role: text.split("\n") for role, text in texts.items()}
            return lists, ", ".join(path.name for path in files.values())
    return {}, ""


def _read_scannet_lists(path: Path) -> dict[str, list[str]]:
    """Return the names by role; a role without a list is omitted. Raise an `InputError` without any list of names."""
    document = read_json(path, any_bytes=True)
    lists = {role: document.get(role) for role in ROLES} if isinstance(document, dict) else {}
    name_lists = {role: names for role, names in lists.items() if isinstance(names, list)}
    if not name_lists or not all(isinstance(name, str) for names in name_lists.values() for name in names):
        raise InputError(f"{path} has no lists of names, expected train, val or test")
    return name_lists


def _find_list_files(folder: Path, role: str) -> list[Path]:
    """Find the text files that may list the images of a role, names in any case, `test.txt` before `test_list.txt`."""
    names = {path.name.casefold(): path for path in folder.glob("*.[tT][xX][tT]") if path.is_file()}
    return [names[name] for name in (f"{role}.txt", f"{role}_list.txt") if name in names]


def _names_in(line: str, known: Container[str]) -> list[str]:
    """Return the names in a line of a list: its parts between commas, without quotes.

    A line that is one of the `known` names, as it is or normalised, is a single name even if it has commas, quotes or a
    leading `#`. Every other line with a leading `#` is a comment, and has no names.
    """
    line = line.strip()
    if line in known or normalise_name(line) in known:
        return [line]
    if line.startswith("#"):
        return []
    return [name for cell in line.split(",") if (name := cell.strip().strip("\"'").strip())]


def split_every(shots: Sequence[Shot], every: int, report: list[str]) -> tuple[list[Shot], list[Shot]]:
    """Make the first and then every Nth image a test image, in the order of their names.

    Args:
        shots: all images.
        every: N, usually 8; 0: no test images.
        report: a line is appended if there are test images.

    Returns:
        Training images, test images.

    Raises:
        InputError: N is 1 or negative.
    """
    if every < 0 or every == 1:
        raise InputError(f"test_every is {every}, expected at least 2, or 0 for no test images")
    ordered = sorted(shots, key=lambda shot: shot.name)
    if every == 0 or len(ordered) < 2:
        return ordered, []
    report.append(f"the set specifies no split: every {every}th image is a test image")
    return [s for i, s in enumerate(ordered) if i % every], ordered[::every]


def split_listed(
    shots: Sequence[Shot], lists: Mapping[str, Sequence[str]], where: str, report: list[str]
) -> tuple[list[Shot], list[Shot], list[Shot]]:
    """Split images by lists of names.

    A list that names none of the images is ignored. An image on several lists gets the role of the first of test,
    validation, training. An image on no list is a training image, unless training images are listed; then it is
    dropped.

    Args:
        shots: all images.
        lists: names, or lines of a file, by `train`, `val` and `test`, at least one of them.
        where: the file with the lists, for messages.
        report: lines on each list are appended.

    Returns:
        Training, validation and test images.

    Raises:
        InputError: a name fits two images.
    """
    by_name = {shot.name: shot for shot in shots}
    roles: dict[str, str] = {}
    heeded = []
    for role, word in reversed(ROLES.items()):
        if role not in lists:
            continue
        cells = [name for line in lists[role] for name in _names_in(line, by_name)]
        names = list({PurePosixPath(name).as_posix(): name for name in cells}.values())
        matched, notes = match_names(names, by_name, where)
        report += notes
        missing = [name for name in names if name not in matched]
        unread = next((name for name in missing if name != printable(name)), None)
        if unread is not None:
            raise InputError(
                f"{where} is not a text file in UTF-8 ({printable(unread)} is no image in any code page): save it as "
                "UTF-8"
            )
        line = f"{where} names {counted(len(names), f'{word} image')}"
        report.append(f"{line}, found {len(matched)}; missing: {abbreviate(missing)}" if missing else line)
        heeded += [role] if matched else []
        twice = [name for name in matched.values() if name in roles]
        if twice:
            report.append(
                f"{where}: {counted(len(twice), 'image')} on several lists, not used as {word} images:"
                f" {abbreviate(twice)}"
            )
        roles = {**dict.fromkeys(matched.values(), role), **roles}
    unlisted = [shot.name for shot in shots if shot.name not in roles]
    if "train" not in heeded:
        roles |= dict.fromkeys(unlisted, "train")
    elif unlisted:
        report.append(f"{where}: {counted(len(unlisted), 'image')} on no list, dropped: {abbreviate(unlisted)}")
    train, val, test = ([shot for shot in shots if roles.get(shot.name) == role] for role in ("train", "val", "test"))
    return train, val, test


_ROWS = 8  # rows of pixels that are interpolated at once, in caches
_ALPHA_MIN = 1e-3  # of 255; divisor of interpolated colours where alpha is 0, and the colour does not matter

# EXIF orientations that swap width and height, and the inverse: quarter turns anticlockwise, then a flip.
_ON_ITS_SIDE = {5: (1, True), 6: (-1, False), 7: (-1, True), 8: (1, False)}


def open_shot(shot: Shot, head: ImageHeader, size: tuple[int, int] | None, near: float) -> PosedImage:
    """Return the undistorted image of a shot, RGBA if the file has transparency; pixels and mask are read on access.

    Args:
        shot: the shot to convert.
        head: header of its file.
        size: width and height of the image; `None`: the file's own size.
        near: near plane of the camera, scene units.

    Raises:
        InputError: the distortion of the lens cannot be undone.
    """
    width, height = shown_size(shot.path, head.size, shot.lens)
    lens = shot.lens.scaled(width, height)
    straight = undistorted_lens(lens) if lens.distorts else lens
    turned = (width, height) != head.size
    read = partial(_read_pixels, shot.path, lens, straight, size, turned=turned, with_alpha=head.has_alpha)
    mask = None if shot.mask is None else UnreadMask(partial(_read_mask, shot.mask, lens, straight, size))
    width, height = size or (width, height)
    seen = straight.scaled(width, height)
    K = np.array([[seen.fx, 0.0, seen.cx], [0.0, seen.fy, seen.cy], [0.0, 0.0, 1.0]])
    pixels = UnreadPixels(head.has_alpha, read)
    return PosedImage(Camera(K, shot.viewmat, width, height, near, shot.name), pixels, mask)


def shown_size(path: Path, size: tuple[int, int], lens: Lens) -> tuple[int, int]:
    """Return width and height of an image: as stored, or turned by EXIF if its lens fits the turned image.

    Args:
        path: the file.
        size: width and height as stored.
        lens: lens of the image.
    """
    if not _fits_sideways(size, lens):
        return size
    with open_image(path) as image:
        return (size[1], size[0]) if _is_turned(image, lens) else size


def _fits_sideways(size: tuple[int, int], lens: Lens) -> bool:
    """Return True if an image's aspect ratio fits its lens better with swapped sides."""
    width, height = size
    return abs(lens.width * width - lens.height * height) < abs(lens.width * height - lens.height * width)


def _is_turned(image: Image.Image, lens: Lens) -> bool:
    """Return True if EXIF turns an image on its side, and its lens fits the turned image.

    Programs that compute poses may use pixels as stored or as turned; the image size in their files shows which.
    """
    sideways = _fits_sideways(image.size, lens)
    return sideways and image.getexif().get(ExifTags.Base.Orientation) in _ON_ITS_SIDE


def _turn_upright(pixels: U8, image: Image.Image) -> U8:
    """Turn decoded pixels, [H, W, ...], as the file's EXIF specifies, which is an orientation in `_ON_ITS_SIDE`."""
    quarters, flips = _ON_ITS_SIDE[image.getexif()[ExifTags.Base.Orientation]]
    turned = np.rot90(pixels, quarters)
    return turned[::-1] if flips else turned


def _read_pixels(
    path: Path, lens: Lens, straight: Lens, size: tuple[int, int] | None, *, turned: bool, with_alpha: bool
) -> U8:
    """Read a file, undistort it, and scale it.

    Args:
        path: the file.
        lens, straight: lens of the image as read, and the undistorted lens of the same size.
        size: width and height of the result; `None`: those of the image.
        turned: turn the image as EXIF specifies.
        with_alpha: keep the alpha channel.

    Returns:
        [H, W, 3 or 4].
    """
    with open_image(path) as stored:
        pixels = rgb_pixels(stored, path)
        if not with_alpha:
            pixels = pixels[..., :3]
        if turned:
            pixels = _turn_upright(pixels, stored)
    if lens.distorts:
        pixels = _undistort(pixels, lens, straight)
    if size is not None and size != (pixels.shape[1], pixels.shape[0]):
        # Bicubic, like INRIA's loader; with alpha, its negative lobes would push colours beyond a clipped alpha.
        method = Image.Resampling.BICUBIC if pixels.shape[2] == 3 else Image.Resampling.HAMMING
        pixels = np.asarray(Image.fromarray(pixels).resize(size, method))
    return np.ascontiguousarray(pixels)


def _read_mask(path: Path, lens: Lens, straight: Lens, size: tuple[int, int] | None) -> Mask:
    """Return the pixels of an image that count, [H, W]: the mask, scaled to its image, is brighter than half there.

    Args:
        path: the mask, of any size.
        lens, straight: as for `_read_pixels`.
        size: width and height of the result; `None`: those of the image.
    """
    sides = int(lens.width), int(lens.height)
    with open_image(path, budget=False) as stored:  # compared with the size of its image before
        values = mask_values(stored, path).values
        if _is_turned(stored, lens):
            values = _turn_upright(values, stored)
    if values.shape[::-1] != sides:
        values = np.asarray(Image.fromarray(values).resize(sides, Image.Resampling.NEAREST))
    if lens.distorts:
        values = _undistort(values[..., None], lens, straight)[..., 0]
    if size is not None and size != sides:
        values = np.asarray(Image.fromarray(values).resize(size, Image.Resampling.BOX))
    return values >= MASK_THRESHOLD


def _undistort(pixels: U8, lens: Lens, straight: Lens) -> U8:
    """Undistort an image [H, W, C] by linear interpolation, RGBA with colours weighted by their alpha."""
    height, width = pixels.shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    x, y = distorted(u, v, lens, straight)
    planes = np.moveaxis(pixels, 2, 0).astype(np.float64)
    if len(planes) == 4:
        planes[:3] *= planes[3]
    rows = [slice(row, row + _ROWS) for row in range(0, height, _ROWS)]
    return np.concatenate([_interpolate(planes, x[some], y[some]) for some in rows])


def _interpolate(planes: F64, x: F64, y: F64) -> U8:
    """Interpolate between the pixels of [C, H, W] at positions [...], pixels, and return [..., C], rounded.

    If there are four planes, the fourth is alpha, by which the others were multiplied.
    """
    last = np.array(planes.shape[1:]) - 1
    column, row = np.clip(x - 0.5, 0, last[1]), np.clip(y - 0.5, 0, last[0])
    left, top = column.astype(np.int64), row.astype(np.int64)
    s, t = column - left, row - top
    values = np.zeros((len(planes), *x.shape))
    for j, by_row in ((top, 1.0 - t), (np.minimum(top + 1, last[0]), t)):
        for i, by_column in ((left, 1.0 - s), (np.minimum(left + 1, last[1]), s)):
            values += planes[:, j, i] * by_row * by_column
    if len(planes) == 4:
        values[:3] /= np.maximum(values[3], _ALPHA_MIN)
    result: U8 = np.moveaxis(np.minimum(np.rint(values), 255.0).astype(np.uint8), 0, -1)
    return result


_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_GREY = 127.5  # of 255; colour of points without colours


def finite_points(points: F64, colours: F64) -> tuple[F64, F32]:
    """Drop points that are not finite or overflow float32.

    Args:
        points: [P, 3].
        colours: [P, 3], clipped to 0..255.

    Returns:
        Points, [P, 3] float64, and their colours, [P, 3] float32 in 0..1.
    """
    good = (np.abs(points) <= np.finfo(np.float32).max).all(axis=1) & np.isfinite(colours).all(axis=1)
    return points[good], (np.clip(colours[good], 0.0, 255.0) / 255.0).astype(np.float32)


def read_point_cloud(path: Path) -> tuple[F64, F32]:
    """Read the points of a PLY; without colours, all are grey.

    Args:
        path: the file, with columns x, y, z; red, green, blue as bytes, 16-bit integers, or floats from 0 to 1.

    Returns:
        As `finite_points`.

    Raises:
        InputError: the file is not a complete PLY, or has no points.
    """
    findings: list[Finding] = []
    try:
        content = parse_ply(path, findings)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    if content is None:
        raise InputError(f"{path}: {next(finding.text for finding in findings if not finding.repairable)}")
    rows = content[0]
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path} has columns {', '.join(names) or 'none'}, expected x, y, z")
    points = np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
    columns = next((columns for columns in _COLOURS if set(columns) <= set(names)), None)
    if columns is None:
        return finite_points(points, np.full_like(points, _GREY))
    kind = rows.dtype[columns[0]]
    scale = 255.0 if kind.kind == "f" else 255.0 / np.iinfo(kind).max
    return finite_points(points, np.stack([rows[name].astype(np.float64) * scale for name in columns], axis=1))
