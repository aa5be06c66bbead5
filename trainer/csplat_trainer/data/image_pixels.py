# SPDX-License-Identifier: Apache-2.0
"""Image files: headers, pixels as RGB or RGBA in 8 bits, and values of masks.

Every pixel format of the files that `open_image` opens is converted, or refused by name:

| stored as | read as |
|---|---|
| 8 bits, grey or RGB, with alpha or without; palettes; CMYK, YCbCr, LAB | pillow's conversion |
| 1 bit | 0 and 1 |
| 16 bits RGB | the upper 8 bits |
| 16 bits grey | 0 to 65535 are 0 to 1 |
| floats, one channel | 0 to 1; refused if values are outside |
| 32 bits grey, signed integers, several channels of more than 8 bits in planes | refused |
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageFile, TiffImagePlugin

from csplat.errors import InputError
from csplat.image_opener import open_image
from csplat.types import F64, U8

#: Least value of a mask for pixels that count.
MASK_THRESHOLD = 128

_WITH_ALPHA = ("RGBA", "LA", "PA", "RGBa", "La")
_CONVERTED = (*_WITH_ALPHA, "1", "L", "P", "RGB", "RGBX", "CMYK", "YCbCr", "LAB", "HSV")
_GREY_16 = ("I;16", "I;16L", "I;16B", "I;16N")
_GREY_16_IN_32 = "PNG"  # the format whose 16-bit grey pillow stores in 32 bits
_FLOAT = "F"
_DEEP = ";16"  # in pillow's names of raw data, of which it keeps the upper 8 bits
_FLOAT_TOLERANCE = 1e-3  # excess over the range of 0 to 1, for resampled files
_WHITE_IS_ZERO, _IN_PLANES = 0, 2  # TIFF 6.0: PhotometricInterpretation, PlanarConfiguration
_OPAQUE = 250  # least alpha that counts as 1


@dataclass(frozen=True)
class ImageHeader:
    """The header of an image file.

    Attributes:
        path: the file.
        size: width and height as stored.
        stored_as: pixel format if its meaning is ambiguous: `16-bit grey`, `16-bit colours`, `floats`; else "".
        has_alpha: True if there is transparency.
        orientation: EXIF orientation, 1 to 8; 1 is upright. Always 1 for a TIFF, which pillow turns.
        has_others: True if the file has several images, of which the first is read; False for a JPEG, to which phones
            append images of depth or brightness.
    """

    path: Path
    size: tuple[int, int]
    stored_as: str
    has_alpha: bool
    orientation: int
    has_others: bool


@dataclass(frozen=True, eq=False)
class MaskValues:
    """The values of a mask, 0..255.

    Attributes:
        values: [H, W] uint8; pixels of at least `MASK_THRESHOLD` count.
        taken_as: interpretation of the file if it is not black and white; else "".
    """

    values: U8
    taken_as: str = ""


def read_image_header(path: Path) -> ImageHeader:
    """Read the header of an image file; pixels are not decoded.

    Raises:
        InputError: the file is not an image, or its pixel format is refused.
    """
    with open_image(path) as image:
        stored_as, has_alpha = _stored_as(image, path), _has_alpha(image)
        # For a PNG, image.getexif would decode all pixels to find EXIF after them. A TIFF is turned by pillow.
        orientation = 1
        if image.format != "TIFF":
            orientation = Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1)
        return ImageHeader(path, image.size, stored_as, has_alpha, orientation, _has_others(image))


def opaque_images(heads: Iterable[ImageHeader]) -> list[ImageHeader]:
    """Find images with a redundant alpha channel, as written by some exporters.

    Images are decoded until an image has some transparency.

    Args:
        heads: headers of the files of a set.

    Returns:
        All images with an alpha channel if it is 1 everywhere in all of them; else none.

    Raises:
        InputError: a file is damaged.
    """
    with_alpha = [head for head in heads if head.has_alpha]
    for head in with_alpha:
        with open_image(head.path) as image:
            if (rgb_pixels(image, head.path)[..., 3:] < _OPAQUE).any():
                return []
    return with_alpha


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image file."""
    with open_image(path) as image:
        return image.size


def rgb_pixels(image: Image.Image, path: Path) -> U8:
    """Decode an image.

    Args:
        image: the opened image.
        path: its file, for messages.

    Returns:
        [H, W, 3], or [H, W, 4] if the file has transparency.

    Raises:
        InputError: the pixel format is refused, or floats are outside 0 to 1.
    """
    _stored_as(image, path)
    if image.mode in _CONVERTED:
        return np.asarray(image.convert("RGBA" if _has_alpha(image) else "RGB"))
    stored = np.asarray(image)
    grey = np.rint(255.0 * _unit_grey(image, path)).astype(np.uint8)
    channels = [grey, grey, grey]
    if "transparency" in image.info:  # a grey value that is transparent
        channels.append(np.where(stored == image.info["transparency"], 0, 255).astype(np.uint8))
    return np.stack(channels, axis=2)


def mask_values(image: Image.Image, path: Path) -> MaskValues:
    """Decode a mask: white for pixels that count.

    If all colours are equal and alpha varies, alpha is the mask. If no pixel is brighter than half, and the values are
    0 and one other, as in masks of 0 and 1 and in label images, pixels other than 0 count.

    Raises:
        InputError: as for `rgb_pixels`; or no pixel is brighter than half, and there are more than two values.
    """
    taken_as = ""
    if image.mode not in _CONVERTED:
        values = _grey_mask(image, path)
    else:
        values = np.asarray(image.convert("L"))
        if _has_alpha(image) and values.min() == values.max():
            alpha = np.asarray(image.convert("RGBA"))[..., 3]
            if alpha.min() < alpha.max():
                values, taken_as = alpha, "all colours are equal: alpha is the mask"
    top = int(values.max())
    if 0 < top < MASK_THRESHOLD:
        levels = np.unique(values)
        if len(levels) > 2 or (len(levels) == 2 and levels[0] > 0):
            raise InputError(
                f"{path} is a mask of values from {levels[0]} to {top}, expected at least {MASK_THRESHOLD} for pixels"
                " that count"
            )
        taken_as = f"values are {' and '.join(str(value) for value in levels)}: {top} counts as white"
        values = np.where(values > 0, 255, 0).astype(np.uint8)
    return MaskValues(values, taken_as)


def value_range(path: Path) -> tuple[float, float, float]:
    """Return the least and the largest value of an image as stored, and the value of white."""
    with open_image(path) as image:
        white = 1.0 if image.mode == _FLOAT else 255.0 if image.mode in _CONVERTED else 65535.0
        stored = np.asarray(image)
        return float(stored.min()), float(stored.max()), white


def _has_others(image: ImageFile.ImageFile) -> bool:
    """Return True if a file has more than one image; a TIFF is left at its second image."""
    if image.format != "TIFF":
        return int(getattr(image, "n_frames", 1)) > 1
    try:
        image.seek(1)  # to count the images of a TIFF takes a time that is quadratic in their number
    except EOFError:
        return False
    return True


def _has_alpha(image: Image.Image) -> bool:
    """Return True if an image has an alpha channel, or a transparent colour."""
    return image.mode in _WITH_ALPHA or "transparency" in image.info


def _stored_as(image: Image.Image, path: Path) -> str:
    """Return the pixel format if its meaning is ambiguous; else "".

    Raises:
        InputError: the pixel format is refused.
    """
    if isinstance(image, TiffImagePlugin.TiffImageFile):
        bits = image.tag_v2.get(TiffImagePlugin.BITSPERSAMPLE, (1,))
        if image.tag_v2.get(TiffImagePlugin.PLANAR_CONFIGURATION) == _IN_PLANES and len(bits) > 1 and max(bits) > 8:
            raise InputError(f"{path} has {max(bits)} bits in planes of one colour each, expected interleaved RGB")
    if image.mode in _CONVERTED:
        tiles = image.tile if isinstance(image, ImageFile.ImageFile) else []
        return "16-bit colours" if any(_DEEP in str(tile[3]) for tile in tiles) else ""
    if image.mode in _GREY_16 or (image.mode == "I" and image.format == _GREY_16_IN_32):
        return "16-bit grey"
    if image.mode == _FLOAT:
        return "floats"
    kind = "grey of 32 bits or with a sign" if image.mode == "I" else f"pixels of format {image.mode}"
    raise InputError(f"{path} has {kind}, expected unsigned 8 or 16 bits: convert it to PNG")


def _unit_grey(image: Image.Image, path: Path) -> F64:
    """Scale grey values [H, W] to 0..1."""
    stored = np.asarray(image)
    if image.mode != _FLOAT:
        values: F64 = stored / 65535.0
        inverted = isinstance(image, TiffImagePlugin.TiffImageFile) and (
            image.tag_v2.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == _WHITE_IS_ZERO
        )
        return 1.0 - values if inverted else values
    low, high = float(stored.min()), float(stored.max())
    if not (low >= -_FLOAT_TOLERANCE and high <= 1.0 + _FLOAT_TOLERANCE):
        raise InputError(f"{path} has floats from {low:g} to {high:g}, expected 0 to 1: scale them, or save as PNG")
    return np.clip(stored.astype(np.float64), 0.0, 1.0)


def _grey_mask(image: Image.Image, path: Path) -> U8:
    """Convert a mask [H, W] of more than 8 bits to 8; labels and values up to 255 are kept, others are scaled."""
    stored = np.asarray(image)
    low, high = float(stored.min()), float(stored.max())
    if low >= 0.0 and high <= 255.0 and (image.mode != _FLOAT or high > 1.0):
        values: U8 = np.rint(stored).astype(np.uint8)
        return values
    _stored_as(image, path)
    return np.rint(255.0 * _unit_grey(image, path)).astype(np.uint8)
