# SPDX-License-Identifier: CC0-1.0
"""L4: compare renders of a scene, for given cameras, with reference images.

Reference images are computed from the equations in binary64 (`csplat_render.reference_rasteriser`) over black, clipped
to 0..1, multiplied by 255 and rounded; IMPLEMENTERS.md lists the conventions. A renderer is a command

    my-renderer INPUT CAMERA OUT

INPUT is a `.csplat` file, CAMERA a JSON file with a list of one camera, and OUT the PNG to write. With `{outdir}`
instead of `{out}`, the renderer may write one PNG of any name to that folder. PNG files have 8 bits per channel; they
are read and written without an imaging library.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import temporary_folder
from csplat.errors import InputError
from csplat.types import U8
from csplat_conformance.conformance_report import Outcome, Status
from csplat_conformance.manifest import VECTORS, Vector
from csplat_conformance.protocol import last_words, run_program

_LEVEL = "L4"

#: PSNR of equal images, dB.
PSNR_CAP = 99.0

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SIDE_MAX = 4096  # pixels; bounds the memory for a foreign image
_NONE, _SUB, _UP, _AVERAGE, _PAETH = range(5)  # filters of a row (PNG, section 9)
_BIT_DEPTH = 8
_RGB = 2  # colour type
_CHANNELS = {0: 1, _RGB: 3, 4: 2, 6: 4}  # colour type: grey, RGB, grey and alpha, RGBA


def can_render() -> bool:
    """Return True if csplat's renderer is installed and supports this processor."""
    from csplat_render.kernels import require_library  # only this level requires the renderer

    try:
        require_library()
    except InputError:
        return False
    return True


def quantise_render(rgb: NDArray[Any]) -> U8:
    """Convert a render to 8 bits: clip to 0..1, multiply by 255, round."""
    image: U8 = np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
    return image


def reference_render(floats: Mapping[str, NDArray[Any]], camera: Mapping[str, Any], antialiased: bool) -> U8:
    """Render the expected arrays of a scene from the equations, in binary64."""
    from csplat_render.camera import Camera
    from csplat_render.reference_rasteriser import render_exact

    splats: Any = SimpleNamespace(**floats)
    return quantise_render(render_exact(splats, Camera.from_json(camera), antialiased=antialiased).rgb)


def score_own_renderer(vector: Vector) -> list[Outcome]:
    """Render a vector's views with csplat's decoder and rasteriser."""
    from csplat.decoder import decode
    from csplat_render import render
    from csplat_render.camera import Camera

    model = decode(vector.data)
    result = []
    for number, view in enumerate(vector.views):
        image = quantise_render(render(model, Camera.from_json(view["camera"])).rgb)
        result.append(_compare_render(vector, number, image, 0.0))
    return result


def score_renderer(vector: Vector, command: str, timeout: float) -> list[Outcome]:
    """Render a vector's views with the command of another renderer.

    Args:
        vector: a vector with views.
        command: command line with `{input}`, `{camera}` and `{out}` or `{outdir}`.
        timeout: time limit for each render, seconds.
    """
    return [_run_and_score(vector, number, command, timeout) for number in range(len(vector.views))]


def skip_views(vector: Vector, why: str) -> list[Outcome]:
    """Return a skipped outcome for each view, with the reason."""
    return [_view_outcome(vector, number, Status.SKIPPED, why) for number in range(len(vector.views))]


def _run_and_score(vector: Vector, number: int, command: str, timeout: float) -> Outcome:
    """Run the renderer on view `number` and compare its PNG; `timeout` in seconds. See `score_renderer`."""
    with temporary_folder() as folder:
        outdir, camera = folder / "out", folder / "camera.json"
        outdir.mkdir()
        camera.write_text(json.dumps([vector.views[number]["camera"]]), encoding="utf-8")
        out = {"outdir": outdir} if "{outdir}" in command else {"out": outdir / "0.png"}
        values = {"input": VECTORS / vector.file, "camera": camera, **out}
        end = run_program(command, {key: str(path) for key, path in values.items()}, timeout)
        seconds = end.seconds
        if end.status is not None:
            return _view_outcome(vector, number, end.status, end.message + last_words(end), seconds)
        if end.returncode:
            return _view_outcome(vector, number, Status.REFUSED, f"exit status 1{last_words(end)}", seconds)
        pngs = sorted(outdir.rglob("*.png"))
        if len(pngs) != 1:
            wrong = Status.WRONG_ANSWER if pngs else Status.NO_OUTPUT
            return _view_outcome(vector, number, wrong, f"{len(pngs)} PNG files were written, expected one", seconds)
        try:
            return _compare_render(vector, number, read_png(pngs[0].read_bytes()), seconds)
        except InputError as error:
            return _view_outcome(vector, number, Status.WRONG_ANSWER, str(error), seconds)


def _compare_render(vector: Vector, number: int, image: U8, seconds: float) -> Outcome:
    """Compare a render, [H, W, 3], with the reference image of view `number`; `seconds` is the renderer's time.

    Raises:
        InputError: the images differ in size.
    """
    view = vector.views[number]
    score = psnr(read_png((VECTORS / view["picture"]).read_bytes()), image)
    passed = score >= view["psnr"]
    message = "" if passed else f"PSNR of {view['picture']} is {score:.1f} dB, expected {view['psnr']:g}"
    status = Status.PASSED if passed else Status.FAILED
    return _view_outcome(vector, number, status, message, seconds, psnr=round(score, 2))


def _view_outcome(
    vector: Vector, number: int, status: Status, message: str, seconds: float = 0.0, **details: Any
) -> Outcome:
    """Return the outcome of view `number`, named `vector#number`."""
    name = f"{vector.name}#{number}"
    return Outcome(name, _LEVEL, status, tuple(vector.clauses), "", message, seconds, details)


def psnr(reference: U8, image: U8) -> float:
    """Return the peak signal-to-noise ratio over pixels and channels, in dB, at most `PSNR_CAP`.

    Raises:
        InputError: the images differ in size.
    """
    if reference.shape != image.shape:
        sizes = [f"{shape[1]}x{shape[0]}" for shape in (image.shape, reference.shape)]
        raise InputError(f"the picture has {sizes[0]} pixels, expected {sizes[1]}")
    error = float(np.mean((reference.astype(np.float64) - image.astype(np.float64)) ** 2))
    return min(PSNR_CAP, 10.0 * math.log10(255.0**2 / error)) if error else PSNR_CAP


def write_png(image: U8) -> bytes:
    """Return a PNG of [H, W, 3] values."""
    height, width, _ = image.shape
    left = np.zeros_like(image)
    left[:, 1:] = image[:, :-1]
    # The difference from the pixel to the left, modulo 256.
    rows = np.concatenate([np.full((height, 1), _SUB, np.uint8), (image - left).reshape(height, -1)], axis=1)
    head = struct.pack(">IIBBBBB", width, height, _BIT_DEPTH, _RGB, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return _SIGNATURE + b"".join(_png_chunk(kind, data) for kind, data in chunks)


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk with its size and CRC."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def read_png(data: bytes) -> U8:
    """Read an image, [H, W, 3], from a PNG of 8 bits per channel that is not interlaced; alpha is dropped.

    Raises:
        InputError: the data is not such a PNG.
    """
    try:
        return _decode_png(data)
    except (struct.error, zlib.error, ValueError) as error:
        raise InputError(f"the PNG cannot be read: {error}") from None


def _decode_png(data: bytes) -> U8:
    """Decode a PNG as `read_png` does, without a check of CRCs; errors of truncated data are not translated."""
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
    if depth != _BIT_DEPTH or colour not in _CHANNELS or interlace:
        raise InputError(f"the PNG has {depth} bits, colour type {colour}, expected 8 bits, RGB, not interlaced")
    if not (1 <= width <= _SIDE_MAX and 1 <= height <= _SIDE_MAX):
        raise InputError(f"the PNG has {width}x{height} pixels, expected at most {_SIDE_MAX}x{_SIDE_MAX}")
    channels = _CHANNELS[colour]
    raw = zlib.decompressobj().decompress(coded, height * (width * channels + 1))
    rows = np.frombuffer(raw, np.uint8).reshape(height, width * channels + 1)
    image = _undo_filters(rows, channels).reshape(height, width, channels)
    return np.ascontiguousarray(image[..., :3] if channels > 2 else np.repeat(image[..., :1], 3, axis=2))


def _undo_filters(rows: U8, channels: int) -> U8:
    """Undo the filter of each row, [H, 1 + W * channels], and return [H, W * channels] (PNG, section 9).

    Raises:
        InputError: a filter is unknown.
    """
    out = np.zeros((len(rows), rows.shape[1] - 1), np.uint8)
    above = np.zeros(rows.shape[1] - 1, np.uint8)
    for y, (kind, *_) in enumerate(rows[:, :1].tolist()):
        line = rows[y, 1:]
        if kind == _UP:
            out[y] = line + above
        elif kind == _SUB:
            out[y] = np.cumsum(line.reshape(-1, channels), axis=0, dtype=np.uint8).reshape(-1)
        elif kind in (_AVERAGE, _PAETH):
            out[y] = _undo_row(line.tolist(), above.tolist(), channels, kind == _PAETH)
        elif kind == _NONE:
            out[y] = line
        else:
            raise InputError(f"row {y} of the PNG has filter {kind}, expected 0 to 4")
        above = out[y]
    return out


def _undo_row(line: list[int], above: list[int], channels: int, paeth: bool) -> list[int]:
    """Undo the filter Paeth, or else Average, of a row, given the bytes of the row above; W * channels bytes each."""
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
