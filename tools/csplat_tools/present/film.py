"""Pictures one after the other as one file: animated WebP, GIF or PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat_tools.files.extras import need_pictures
from csplat_tools.files.streams import write_bytes

__all__ = ["DEFAULT_FPS", "FILM_ENDINGS", "MAX_FPS", "check_film", "is_film", "write_film"]

U8 = NDArray[np.uint8]

#: Names that end so are films, others are folders; with what pillow calls the format.
FILM_ENDINGS = {".webp": "WEBP", ".gif": "GIF", ".png": "PNG", ".apng": "PNG"}

#: Pictures per second.
DEFAULT_FPS, MAX_FPS = 25.0, 100.0

_TICKS = {"WEBP": 1000, "GIF": 100, "PNG": 1000}  # per second: how finely the format tells time
_MAX_SIDE = {"WEBP": 16383, "GIF": 65535, "PNG": 1 << 15}
_MAX_BYTES = 1 << 31  # of all pictures, which are in memory together
_WEBP = {"quality": 90, "method": 4}


def is_film(path: str) -> bool:
    """Whether a name is that of a film."""
    return Path(path).suffix.lower() in FILM_ENDINGS


def check_film(path: str, sizes: Sequence[tuple[int, int]], fps: float) -> None:
    """Refuse a film that cannot be written, before it is rendered.

    Args:
        path: a name for which `is_film` holds.
        sizes: width and height of its pictures, at least one.
        fps: pictures per second, above 0.

    Raises:
        InputError: the pictures differ in size, are too large or too many, or come too fast.
    """
    kind = FILM_ENDINGS[Path(path).suffix.lower()]
    if len(set(sizes)) > 1:
        raise InputError(f"a film wants pictures of one size, the cameras have {len(set(sizes))}: give --size")
    width, height = sizes[0]
    if max(width, height) > _MAX_SIDE[kind]:
        raise InputError(f"{kind} pictures have at most {_MAX_SIDE[kind]} pixels a side, wanted {width}x{height}")
    if len(sizes) * width * height * 3 > _MAX_BYTES:
        raise InputError(
            f"{len(sizes)} pictures of {width}x{height} are more than {_MAX_BYTES >> 30} GiB: render into a folder, "
            "and let ffmpeg make a film of it"
        )
    if fps > min(MAX_FPS, _TICKS[kind]):
        raise InputError(f"{fps:g} pictures per second, wanted {MAX_FPS:g} at most")


def write_film(path: str, frames: Sequence[U8], fps: float) -> None:
    """Write an animation that repeats for ever; the file appears when it is complete.

    Args:
        path: its ending tells the format. WebP loses a little, GIF has 256 colours a picture, PNG loses nothing.
        frames: [H, W, 3] uint8 each, of one size, at least one.
        fps: pictures per second; each lasts as near to that as the format can say, and all together exactly.

    Raises:
        InputError: pillow is not installed, or was built without WebP.
        OSError: it cannot be written.
    """
    need_pictures()
    from PIL import Image

    kind = FILM_ENDINGS[Path(path).suffix.lower()]
    first, *others = [Image.fromarray(np.ascontiguousarray(frame)) for frame in frames]
    options: dict[str, Any] = {"duration": _durations(len(frames), fps, _TICKS[kind]), "loop": 0}
    if kind == "WEBP":
        options |= _WEBP
    if not others:
        options = dict(_WEBP) if kind == "WEBP" else {}
    buffer = io.BytesIO()
    try:
        first.save(buffer, kind, save_all=bool(others), append_images=others, **options)
    except KeyError:  # pillow knows no such format
        raise InputError(f"this pillow cannot write {kind}: name a .gif or .png") from None
    write_bytes(path, buffer.getvalue())


def _durations(count: int, fps: float, ticks: int) -> list[int]:
    """Milliseconds that each picture stays, whole ticks of the format, without drifting."""
    ends = np.rint(np.arange(count + 1) * (ticks / fps)).astype(np.int64)
    lasting = np.maximum(np.diff(ends), 1) * (1000 // ticks)
    return [int(value) for value in lasting]
