"""From a shot to a picture: its pixels are read when they are wanted; undo the lens, change the size."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps
from scipy.ndimage import map_coordinates

from csplat.errors import InputError
from csplat_render.camera import Camera
from csplat_trainer.data.dataset import Lens, Shot
from csplat_trainer.pictures import Picture, UnreadMask, UnreadPixels

__all__ = ["image_size", "picture_of", "undistorted_lens"]

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_ZOOM_STEP = 0.005
_MAX_ZOOM = 1.5
_BORDER_POINTS = 65
_COUNTS = 128  # of a mask's grey values, and more
_ON_ITS_SIDE = (5, 6, 7, 8)  # orientations of EXIF that swap width and height


def picture_of(shot: Shot, size: tuple[int, int] | None, near: float) -> Picture:
    """The picture of a shot, undistorted, RGBA where the file has transparency; pixels and mask are not read yet.

    Args:
        shot: which.
        size: width and height of the picture; `None`: the file's.
        near: the camera's near plane, scene units.

    Raises:
        InputError: the file does not begin as an image, or its lens cannot be undone.
    """
    with _opened(shot.path) as image:
        (width, height), has_alpha, turned = image.size, _has_alpha(image), _turned(image, shot.lens)
    if turned:
        width, height = height, width
    lens = shot.lens.scaled(width, height)
    straight = undistorted_lens(lens) if lens.distorts else lens
    read = partial(_read, shot.path, lens, straight, size, turned=turned)
    mask = None if shot.mask is None else UnreadMask(partial(_read_mask, shot.mask, lens, straight, size))
    width, height = size or (width, height)
    seen = straight.scaled(width, height)
    K = np.array([[seen.fx, 0.0, seen.cx], [0.0, seen.fy, seen.cy], [0.0, 0.0, 1.0]])
    return Picture(Camera(K, shot.viewmat, width, height, near, shot.name), UnreadPixels(has_alpha, read), mask)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file; its pixels are not read."""
    with _opened(path) as image:
        return image.size


def undistorted_lens(lens: Lens) -> Lens:
    """The pinhole that a lens's pictures are straightened to.

    The focal lengths grow, in steps of half a per cent, until every pixel of the straight picture
    lies within the distorted one: nothing has to be invented at the border.

    Raises:
        InputError: no reasonable zoom achieves that: the numbers describe no such lens.
    """
    zoom = 1.0
    while zoom <= _MAX_ZOOM:
        straight = Lens(lens.width, lens.height, lens.fx * zoom, lens.fy * zoom, lens.cx, lens.cy)
        if _border_is_inside(lens, straight):
            return straight
        zoom += _ZOOM_STEP
    raise InputError(f"the distortion {lens.distortion} cannot be undone over the whole picture")


def _turned(image: Image.Image, lens: Lens) -> bool:
    """Whether EXIF lays a picture on its side, and its lens is that of the picture as it is shown.

    Programs that find poses read pixels as they are stored, or as they are shown: the size that they state tells which.
    """
    width, height = image.size
    stored, shown = abs(lens.width * height - lens.height * width), abs(lens.width * width - lens.height * height)
    return shown < stored and image.getexif().get(ExifTags.Base.Orientation) in _ON_ITS_SIDE


def _read(path: Path, lens: Lens, straight: Lens, size: tuple[int, int] | None, *, turned: bool) -> U8:
    """Pixels of a file, straight, in the size that is wanted; turned as EXIF says, or as they are stored."""
    with _opened(path) as stored:
        image = ImageOps.exif_transpose(stored) if turned else stored
        pixels: U8 = np.asarray(image.convert("RGBA" if _has_alpha(image) else "RGB"))
    if lens.distorts:
        pixels = _undistort(pixels, lens, straight)
    if size is not None and size != (pixels.shape[1], pixels.shape[0]):
        # Bicubic, as INRIA's loader; its negative lobes would push colours beyond a clipped alpha.
        method = Image.Resampling.BICUBIC if pixels.shape[2] == 3 else Image.Resampling.HAMMING
        pixels = np.asarray(Image.fromarray(pixels).resize(size, method))
    return np.ascontiguousarray(pixels)


def _read_mask(path: Path, lens: Lens, straight: Lens, size: tuple[int, int] | None) -> Mask:
    """Which pixels of a picture count: where its mask, which may be larger or smaller, is brighter than half."""
    sides = int(lens.width), int(lens.height)
    with _opened(path) as stored:
        image = (ImageOps.exif_transpose(stored) if _turned(stored, lens) else stored).convert("L")
        values: U8 = np.asarray(image if image.size == sides else image.resize(sides, Image.Resampling.NEAREST))
    if lens.distorts:
        values = _undistort(values[..., None], lens, straight)[..., 0]
    if size is not None and size != sides:
        values = np.asarray(Image.fromarray(values).resize(size, Image.Resampling.BOX))
    return values >= _COUNTS


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image of which the head is read. What is wrong with the rest is said in the same way."""
    try:
        with Image.open(path) as image:
            yield image
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} is not an image that can be read: {error}") from error


def _has_alpha(image: Image.Image) -> bool:
    return "A" in image.getbands() or "transparency" in image.info


def _border_is_inside(lens: Lens, straight: Lens) -> bool:
    u = np.linspace(0.5, lens.width - 0.5, _BORDER_POINTS)
    v = np.linspace(0.5, lens.height - 0.5, _BORDER_POINTS)
    ends_u, ends_v = np.repeat(u[[0, -1]], _BORDER_POINTS), np.repeat(v[[0, -1]], _BORDER_POINTS)
    x, y = _distort(np.concatenate([ends_u, u, u]), np.concatenate([np.tile(v, 2), ends_v]), lens, straight)
    margin = 0.5 - 1e-6  # half a pixel beyond the centres the border's colour still holds
    inside = (x >= 0.5 - margin) & (x <= lens.width - 0.5 + margin)
    inside &= (y >= 0.5 - margin) & (y <= lens.height - 0.5 + margin)
    return bool(inside.all())


def _distort(u: F64, v: F64, lens: Lens, straight: Lens) -> tuple[F64, F64]:
    """Where pixels of the straight picture lie in the distorted one (OpenCV's model)."""
    x, y = (u - straight.cx) / straight.fx, (v - straight.cy) / straight.fy
    k1, k2, p1, p2 = lens.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * k2)
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return lens.fx * xd + lens.cx, lens.fy * yd + lens.cy


def _undistort(pixels: U8, lens: Lens, straight: Lens) -> U8:
    """Straighten a picture, linear between pixels, colours weighted by their alpha."""
    height, width = pixels.shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    x, y = _distort(u, v, lens, straight)
    channels = [pixels[..., i].astype(np.float64) for i in range(pixels.shape[2])]
    if len(channels) == 4:
        channels[:3] = [channel * channels[3] for channel in channels[:3]]
    at = np.stack([y - 0.5, x - 0.5])
    moved = [map_coordinates(channel, at, order=1, mode="nearest") for channel in channels]
    if len(moved) == 4:
        moved[:3] = [channel / np.maximum(moved[3], 1e-3) for channel in moved[:3]]
    result: U8 = np.clip(np.rint(np.stack(moved, axis=2)), 0, 255).astype(np.uint8)
    return result
