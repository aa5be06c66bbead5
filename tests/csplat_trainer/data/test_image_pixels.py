# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.data.image_pixels."""

import struct

import numpy as np
import pytest
from image_files_cases import GREY, LABELS, RAMP, RGB, SHAPE, UINT16, png_16
from PIL import Image
from posed_sets import H, W

from csplat.errors import InputError
from csplat_trainer.data.image_pixels import mask_values, open_image, read_image_header, rgb_pixels

HALF_SEEN = np.where(RAMP < 0.5, 0, 200).astype(np.uint8)
RGBA = np.dstack([RGB, HALF_SEEN])
RGB_16 = RGB.astype(np.uint16) * 257
SWAPPED = UINT16.astype(">u2").tobytes()


def tiff(path, values, bits, kind, *, channels=1, photometric=1, planes=1):
    """Write a TIFF with one strip per plane, in kinds that Pillow does not write: 1 unsigned, 2 signed, 3 float."""
    data = np.ascontiguousarray(values).tobytes()
    strips = channels if planes == 2 else 1
    size, end, entries, tail = len(data) // strips, 8 + len(data), b"", b""
    tags = [
        (256, "I", [W]), (257, "I", [H]), (258, "H", [bits] * channels), (259, "H", [1]), (262, "H", [photometric]),
        (273, "I", [8 + size * i for i in range(strips)]), (277, "H", [channels]), (278, "I", [H]),
        (279, "I", [size] * strips), (284, "H", [planes]), (339, "H", [kind] * channels),
    ]  # fmt: skip
    for tag, form, row in tags:
        packed = struct.pack(f"<{len(row)}{form}", *row)
        place = packed.ljust(4, b"\0") if len(packed) <= 4 else struct.pack("<I", end + len(tail))
        entries += struct.pack("<HHI", tag, 3 if form == "H" else 4, len(row)) + place
        tail += packed if len(packed) > 4 else b""
    directory = struct.pack("<H", len(tags)) + entries + bytes(4)
    path.write_bytes(b"II*\0" + struct.pack("<I", end + len(tail)) + data + tail + directory)


def saved(pixels):
    return lambda path: Image.fromarray(pixels).save(path)


def palette(path):
    image = Image.fromarray((GREY > 127).astype(np.uint8), "P")
    image.putpalette([200, 10, 30, 40, 50, 60])
    image.save(path, transparency=0)


def transparent_grey(path):
    Image.fromarray(UINT16).save(path, transparency=int(UINT16[0, 0]))


#: File, writer, expected pixels or the text of the error, and the tolerance.
KINDS = {
    "RGB": ("a.png", saved(RGB), RGB, 0), "RGBA": ("a.png", saved(RGBA), RGBA, 0),
    "grey": ("a.png", saved(GREY), GREY, 0),
    "grey and alpha": ("a.png", saved(np.dstack([GREY, HALF_SEEN])), np.dstack([GREY, GREY, GREY, HALF_SEEN]), 0),
    "1 bit": ("a.png", saved(RAMP > 0.5), 255 * (RAMP > 0.5), 0),
    "palette": ("a.png", palette, np.where((GREY > 127)[..., None], (40, 50, 60, 255), (200, 10, 30, 0)), 0),
    "CMYK": ("a.tif", lambda p: Image.fromarray(RGB).convert("CMYK").save(p), RGB, 1),
    "YCbCr": ("a.tif", lambda p: Image.fromarray(RGB).convert("YCbCr").save(p), RGB, 3),
    "LAB": ("a.tif", lambda p: Image.fromarray(RGB).convert("RGB").convert("LAB").save(p), RGB, 255),  # any values
    "16-bit grey PNG": ("a.png", saved(UINT16), GREY, 0),
    "transparent value": ("a.png", transparent_grey, np.dstack([GREY] * 3 + [255 * (UINT16 != UINT16[0, 0])]), 0),
    "16-bit grey TIFF": ("a.tif", saved(UINT16), GREY, 0),
    "16-bit grey, bytes swapped": ("a.tif", lambda p: Image.frombytes("I;16B", (W, H), SWAPPED).save(p), GREY, 0),
    "16-bit grey, white is 0": ("a.tif", lambda p: tiff(p, 65535 - UINT16, 16, 1, photometric=0), GREY, 0),
    "16-bit RGB": ("a.tif", lambda p: tiff(p, RGB_16, 16, 1, channels=3, photometric=2), RGB, 0),
    "16-bit RGB PNG": ("a.png", lambda p: png_16(p, RGB_16.astype(">u2")), RGB, 0),
    "float TIFF": ("a.tif", saved(RAMP.astype(np.float32)), GREY, 0),
    "float beyond 1": ("a.tif", saved((255 * RAMP).astype(np.float32)), "has floats from 0 to 255, expected 0 to 1", 0),
    "NaN": ("a.tif", saved(np.full((H, W), np.nan, np.float32)), "has floats from nan to nan", 0),
    "32-bit grey": ("a.tif", saved(UINT16.astype(np.int32)), "grey of 32 bits", 0),
    "signed 16 bits": ("a.tif", lambda p: tiff(p, (UINT16 // 2).astype(np.int16), 16, 2), "or with a sign", 0),
    "16-bit RGB in planes": ("a.tif", lambda p: tiff(
        p, np.moveaxis(RGB_16, 2, 0), 16, 1, channels=3, photometric=2, planes=2), "in planes", 0),
    "float RGB": ("a.tif", lambda p: tiff(
        p, RGB.astype(np.float32), 32, 3, channels=3, photometric=2), "not of 8 or 16 bits or", 0),
    "OpenEXR": ("a.exr", lambda p: p.write_bytes(b"\x76\x2f\x31\x01" + bytes(60)), "is an OpenEXR file", 0),
    "Radiance": ("a.hdr", lambda p: p.write_bytes(b"#?RADIANCE\n" + bytes(60)), "is a Radiance HDR file", 0),
    "HEIC": ("a.heic", lambda p: p.write_bytes(b"\0\0\0\x18ftypheic" + bytes(60)), "is a HEIC file", 0),
    "raw": ("a.dng", lambda p: Image.fromarray(RGB).save(p, "TIFF"), "a camera's raw file", 0),
    "a web page": ("a.jpg", lambda p: p.write_text("<html>"), "is a web page", 0),
}  # fmt: skip


@pytest.mark.parametrize(("name", "write", "expected", "tolerance"), KINDS.values(), ids=KINDS)
def test_pixels_of_every_kind_are_read_or_refused(tmp_path, name, write, expected, tolerance):
    path = tmp_path / name
    write(path)
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            pixels_of(path)
        return
    found = pixels_of(path)
    assert np.uint8 == found.dtype
    assert read_image_header(path).has_alpha == (found.shape[2] == 4)
    assert (W, H) == read_image_header(path).size
    expected = np.repeat(expected[..., None], 3, axis=2) if expected.ndim == 2 else expected
    assert expected.shape == found.shape
    assert np.abs(found.astype(int) - expected).max() <= tolerance


def pixels_of(path):
    with open_image(path) as image:
        return rgb_pixels(image, path)


#: Images of a mask, and whether its interpretation is reported.
MASKS = {
    "0 and 255": (255 * LABELS, False), "1 bit": (SHAPE, False), "0 and 1": (LABELS, True),
    "0 and 1 in 16 bits": (LABELS.astype(np.uint16), True), "0 and 1 in 32 bits": (LABELS.astype(np.int32), True),
    "0 and 255 in 16 bits": (LABELS.astype(np.uint16) * 255, False),
    "0 and 65535": (LABELS.astype(np.uint16) * 65535, False), "floats": (LABELS.astype(np.float32), False),
    "floats to 255": (LABELS.astype(np.float32) * 255, False), "RGB": (np.dstack([255 * LABELS] * 3), False),
    "alpha": (np.dstack([np.zeros((H, W, 3), np.uint8), 255 * LABELS]), True),
    "alpha of white": (np.dstack([np.full((H, W, 3), 255, np.uint8), 255 * LABELS]), True),
    "a palette of labels": (LABELS, True),
}  # fmt: skip


@pytest.mark.parametrize("name", MASKS)
def test_masks_of_every_kind_are_read_alike(tmp_path, name):
    (values, is_reported), path = MASKS[name], tmp_path / "mask.tif"
    image = Image.fromarray(values)
    if "palette" in name:
        image.putpalette([0, 0, 0, 128, 0, 0])
    image.save(path)
    with open_image(path) as opened:
        found = mask_values(opened, path)
    assert ((found.values >= 128) == SHAPE).all()
    assert is_reported == bool(found.taken_as)
