"""Turn a shot into an image: read its pixels on demand, undo the lens, change the size."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from scipy.ndimage import map_coordinates

from csplat.types import U8, Mask
from csplat_render.camera import Camera
from csplat_trainer.data.dataset import Shot
from csplat_trainer.data.image_pixels import COUNTS, ImageHead, mask_values, opened_image, rgb_pixels
from csplat_trainer.data.lens import Lens, distorted, undistorted_lens
from csplat_trainer.pictures import Picture, UnreadMask, UnreadPixels

# Orientations of EXIF that swap width and height, and what undoes them: quarter turns, anticlockwise, then a flip.
_ON_ITS_SIDE = {5: (1, True), 6: (-1, False), 7: (-1, True), 8: (1, False)}


def picture_of(shot: Shot, head: ImageHead, size: tuple[int, int] | None, near: float) -> Picture:
    """The image of a shot, undistorted, RGBA if the file has transparency; pixels and mask are not read yet.

    Args:
        shot: the shot to convert.
        head: header of its file.
        size: width and height of the image; `None`: the file's.
        near: the camera's near plane, scene units.

    Raises:
        InputError: its lens cannot be undone.
    """
    width, height = shown_size(shot.path, head.size, shot.lens)
    lens = shot.lens.scaled(width, height)
    straight = undistorted_lens(lens) if lens.distorts else lens
    turned = (width, height) != head.size
    read = partial(_read, shot.path, lens, straight, size, turned=turned, with_alpha=head.has_alpha)
    mask = None if shot.mask is None else UnreadMask(partial(_read_mask, shot.mask, lens, straight, size))
    width, height = size or (width, height)
    seen = straight.scaled(width, height)
    K = np.array([[seen.fx, 0.0, seen.cx], [0.0, seen.fy, seen.cy], [0.0, 0.0, 1.0]])
    pixels = UnreadPixels(head.has_alpha, read)
    return Picture(Camera(K, shot.viewmat, width, height, near, shot.name), pixels, mask)


def shown_size(path: Path, size: tuple[int, int], lens: Lens) -> tuple[int, int]:
    """Width and height of an image: as stored, or turned by EXIF where its lens is that of the image as shown.

    Args:
        path: the file.
        size: width and height as stored.
        lens: lens of the image.
    """
    if not _fits_sideways(size, lens):
        return size
    with opened_image(path) as image:
        return (size[1], size[0]) if _turned(image, lens) else size


def _fits_sideways(size: tuple[int, int], lens: Lens) -> bool:
    """Return True if an image's sides agree better with its lens when they are swapped."""
    width, height = size
    return abs(lens.width * width - lens.height * height) < abs(lens.width * height - lens.height * width)


def _turned(image: Image.Image, lens: Lens) -> bool:
    """Return True if EXIF lays an image on its side, and its lens is that of the image as it is shown.

    Programs that find poses read pixels as they are stored, or as they are shown: the size that they give tells which.
    """
    sideways = _fits_sideways(image.size, lens)
    return sideways and image.getexif().get(ExifTags.Base.Orientation) in _ON_ITS_SIDE


def _upright(pixels: U8, image: Image.Image) -> U8:
    """Turn decoded pixels as the file's EXIF specifies."""
    quarters, flips = _ON_ITS_SIDE[image.getexif()[ExifTags.Base.Orientation]]
    turned = np.rot90(pixels, quarters)
    return turned[::-1] if flips else turned


def _read(
    path: Path, lens: Lens, straight: Lens, size: tuple[int, int] | None, *, turned: bool, with_alpha: bool
) -> U8:
    """Return the pixels of a file, straight, in the requested size; turned as EXIF specifies, or as they are stored."""
    with opened_image(path) as stored:
        pixels = rgb_pixels(stored, path)
        if not with_alpha:
            pixels = pixels[..., :3]
        if turned:
            pixels = _upright(pixels, stored)
    if lens.distorts:
        pixels = _undistort(pixels, lens, straight)
    if size is not None and size != (pixels.shape[1], pixels.shape[0]):
        # Bicubic, as INRIA's loader; its negative lobes would push colours beyond a clipped alpha.
        method = Image.Resampling.BICUBIC if pixels.shape[2] == 3 else Image.Resampling.HAMMING
        pixels = np.asarray(Image.fromarray(pixels).resize(size, method))
    return np.ascontiguousarray(pixels)


def _read_mask(path: Path, lens: Lens, straight: Lens, size: tuple[int, int] | None) -> Mask:
    """Return which pixels of an image count: its mask, which may be larger or smaller, is brighter than half there."""
    sides = int(lens.width), int(lens.height)
    with opened_image(path) as stored:
        values = mask_values(stored, path).values
        if _turned(stored, lens):
            values = _upright(values, stored)
    if values.shape[::-1] != sides:
        values = np.asarray(Image.fromarray(values).resize(sides, Image.Resampling.NEAREST))
    if lens.distorts:
        values = _undistort(values[..., None], lens, straight)[..., 0]
    if size is not None and size != sides:
        values = np.asarray(Image.fromarray(values).resize(size, Image.Resampling.BOX))
    return values >= COUNTS


def _undistort(pixels: U8, lens: Lens, straight: Lens) -> U8:
    """Straighten a picture, linear between pixels, colours weighted by their alpha."""
    height, width = pixels.shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    x, y = distorted(u, v, lens, straight)
    channels = [pixels[..., i].astype(np.float64) for i in range(pixels.shape[2])]
    if len(channels) == 4:
        channels[:3] = [channel * channels[3] for channel in channels[:3]]
    at = np.stack([y - 0.5, x - 0.5])
    moved = [map_coordinates(channel, at, order=1, mode="nearest") for channel in channels]
    if len(moved) == 4:
        moved[:3] = [channel / np.maximum(moved[3], 1e-3) for channel in moved[:3]]
    result: U8 = np.clip(np.rint(np.stack(moved, axis=2)), 0, 255).astype(np.uint8)
    return result
