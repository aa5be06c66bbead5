# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of image files, which several files share."""

import struct
import zlib

import numpy as np
from posed_sets import H, W

RAMP = np.linspace(0.0, 1.0, W * H).reshape(H, W)
GREY = np.rint(255.0 * RAMP).astype(np.uint8)
RGB = np.stack([GREY, GREY[::-1], GREY[:, ::-1]], axis=2)
UINT16 = np.rint(65535.0 * RAMP).astype(np.uint16)


def png_16(path, colours):
    """Write [H, W, 3] big-endian as a 16-bit RGB PNG, which Pillow does not."""
    rows = b"".join(b"\0" + row.tobytes() for row in colours)
    head = struct.pack(">IIBBBBB", colours.shape[1], colours.shape[0], 16, 2, 0, 0, 0)
    chunks = [b"IHDR" + head, b"IDAT" + zlib.compress(rows), b"IEND"]
    whole = [struct.pack(">I", len(one) - 4) + one + struct.pack(">I", zlib.crc32(one)) for one in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(whole))


SHAPE = RAMP > 0.4
LABELS = SHAPE.astype(np.uint8)
