"""Convert renders to 8 bits, lay them side by side, and write them as PNG files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.types import F32, U8
from csplat_tools.files.extras import need_pictures
from csplat_tools.files.streams import write_bytes

_DIGITS = 4
_NAME_LENGTH_MAX = 200  # file systems take 255 bytes


def picture_names(images: Sequence[str | None]) -> list[str]:
    """Name pictures, without an ending, no two alike.

    Args:
        images: names of the cameras' photographs, such as `images/0007.jpg`, or `None`.

    Returns:
        The photographs' own names; a number for a camera without one; both if the names are not unique.
    """
    stems = [_stem(image) for image in images]
    numbers = [f"{number:0{_DIGITS}d}" for number in range(len(stems))]
    names = [stem or number for stem, number in zip(stems, numbers, strict=True)]
    if len({name.casefold() for name in names}) == len(names):
        return names
    return [f"{number}_{stem}" if stem else number for stem, number in zip(stems, numbers, strict=True)]


def check_folder(folder: str, names: Sequence[str], *, force: bool) -> Path:
    """Make a folder for files; refuse if that would replace some.

    Args:
        folder: the folder; it may exist already.
        names: names of the files to be written.
        force: existing files may be replaced.

    Raises:
        InputError: `folder` is not a folder; two names are the same; or one of the files exists, or is not a file.
        OSError: the folder cannot be made.
    """
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise InputError(f"{folder} is not a folder")
    if len(set(names)) < len(names):
        raise InputError("two pictures would get the same name: give the cameras' images other ones")
    for name in names:
        target = path / name
        if target.exists() and not (force and target.is_file()):
            raise InputError(f"{target} exists: --force replaces it" if target.is_file() else f"{target} is in the way")
    path.mkdir(parents=True, exist_ok=True)
    return path


def to_bytes(values: F32) -> U8:
    """Round 0..1 to 0..255; values outside are clipped, NaN becomes 0."""
    clipped = np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0)
    result: U8 = np.rint(clipped * 255.0).astype(np.uint8)
    return result


def panels(a: F32, b: F32, amplification: float, photograph: F32 | None = None) -> U8:
    """Lay side by side two images and the amplified magnitude of their difference.

    Args:
        a, b: [H, W, 3], 0..1.
        amplification: factor by which the difference is multiplied.
        photograph: [H, W, 3], placed before the others, if there is one.

    Returns:
        [H, 3 W, 3], or [H, 4 W, 3] with a photograph.
    """
    difference = np.abs(b.astype(np.float32) - a) * np.float32(amplification)
    shown = [a, b, difference] if photograph is None else [photograph, a, b, difference]
    return np.concatenate([to_bytes(one) for one in shown], axis=1)


def write_png(path: Path, pixels: NDArray[Any]) -> None:
    """Write [H, W] or [H, W, 3] uint8 as a PNG; the file appears when it is complete.

    Raises:
        InputError: pillow is not installed.
        OSError: the file cannot be written.
    """
    need_pictures()
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG")
    write_bytes(str(path), buffer.getvalue())


def _stem(image: str | None) -> str:
    """Return the last part of a path of any system, without its ending and characters that file names may not hold."""
    if image is None:
        return ""
    name = PureWindowsPath(PurePosixPath(image).name).name  # never leads out of the folder
    kept = "".join(c if c.isprintable() and c not in '<>:"|?*/\\' else "_" for c in name)
    return PurePosixPath(kept).stem.strip(". ")[:_NAME_LENGTH_MAX]
