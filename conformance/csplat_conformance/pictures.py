"""Pictures of the rendering vectors: PNG of 8 bits per channel, read and written without a library for pictures."""

from __future__ import annotations

import math
import struct
import zlib

import numpy as np

from csplat.errors import InputError
from csplat.types import U8

#: Score of equal pictures, dB.
PSNR_CAP = 99.0

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SIDE_MAX = 4096
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # colour type: grey, RGB, grey and alpha, RGBA


def psnr(reference: U8, picture: U8) -> float:
    """Return the peak signal-to-noise ratio over pixels and channels, in dB, at most `PSNR_CAP`.

    Raises:
        InputError: the pictures differ in size.
    """
    if reference.shape != picture.shape:
        sizes = [f"{shape[1]}x{shape[0]}" for shape in (picture.shape, reference.shape)]
        raise InputError(f"the picture has {sizes[0]} pixels, wanted {sizes[1]}")
    error = float(np.mean((reference.astype(np.float64) - picture.astype(np.float64)) ** 2))
    return min(PSNR_CAP, 10.0 * math.log10(255.0**2 / error)) if error else PSNR_CAP


def write_png(picture: U8) -> bytes:
    """Return a PNG of [H, W, 3] values."""
    height, width, _ = picture.shape
    before = np.zeros_like(picture)
    before[:, 1:] = picture[:, :-1]
    # Filter 1, "sub": the difference from the pixel to the left.
    rows = np.concatenate([np.ones((height, 1), np.uint8), (picture - before).reshape(height, -1)], axis=1)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def read_png(data: bytes) -> U8:
    """Return the [H, W, 3] values of a PNG of 8 bits per channel, not interlaced; alpha is dropped, grey spread.

    Raises:
        InputError: not such a PNG.
    """
    try:
        return _read(data)
    except (struct.error, zlib.error, ValueError) as error:
        raise InputError(f"not a PNG that can be read: {error}") from None


def _read(data: bytes) -> U8:
    if not data.startswith(_SIGNATURE):
        raise InputError("not a PNG")
    head, coded, at = b"", b"", len(_SIGNATURE)
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + size]
        head = body if kind == b"IHDR" else head
        coded += body if kind == b"IDAT" else b""
        at += 12 + size
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", head)
    if depth != 8 or colour not in _CHANNELS or interlace:
        raise InputError(f"a PNG of {depth} bits, colour type {colour}: wanted 8 bits, RGB, not interlaced")
    if not (1 <= width <= _SIDE_MAX and 1 <= height <= _SIDE_MAX):
        raise InputError(f"a PNG of {width}x{height} pixels")
    channels = _CHANNELS[colour]
    raw = zlib.decompressobj().decompress(coded, height * (width * channels + 1))
    rows = np.frombuffer(raw, np.uint8).reshape(height, width * channels + 1)
    picture = _unfiltered(rows, channels).reshape(height, width, channels)
    return np.ascontiguousarray(picture[..., :3] if channels > 2 else np.repeat(picture[..., :1], 3, axis=2))


def _unfiltered(rows: U8, channels: int) -> U8:
    """Undo the filter of each row (PNG, section 9)."""
    out = np.zeros((len(rows), rows.shape[1] - 1), np.uint8)
    above = np.zeros(rows.shape[1] - 1, np.uint8)
    for y, (kind, *_) in enumerate(rows[:, :1].tolist()):
        line = rows[y, 1:]
        if kind == 2:
            out[y] = line + above
        elif kind == 1:
            out[y] = np.cumsum(line.reshape(-1, channels), axis=0, dtype=np.uint8).reshape(-1)
        elif kind in (3, 4):
            out[y] = _slow_row(line.tolist(), above.tolist(), channels, kind == 4)
        elif kind == 0:
            out[y] = line
        else:
            raise InputError(f"a PNG whose row {y} has the filter {kind}")
        above = out[y]
    return out


def _slow_row(line: list[int], above: list[int], channels: int, paeth: bool) -> list[int]:
    out: list[int] = []
    for i, value in enumerate(line):
        left = out[i - channels] if i >= channels else 0
        corner = above[i - channels] if i >= channels else 0
        guess = (left + above[i]) // 2
        if paeth:
            estimate = left + above[i] - corner
            guess = min((left, above[i], corner), key=lambda value: abs(estimate - value))
        out.append((value + guess) % 256)
    return out
