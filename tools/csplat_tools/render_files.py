# SPDX-License-Identifier: Apache-2.0
"""Write renders as PNG files or as a video."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import resolve_links, temporary_folder
from csplat.errors import InputError
from csplat.types import F32, U8
from csplat_tools.file_streams import write_bytes
from csplat_tools.optional_packages import require_film, require_images

_DIGITS = 4
_NAME_LENGTH_MAX = 200  # characters; file systems allow 255 bytes


def image_names(images: Sequence[str | None]) -> list[str]:
    """Return unique file names for renders, without ending.

    Args:
        images: names of the cameras' images, such as `images/0007.jpg`, or `None`.

    Returns:
        The stems of the image names; a number for a camera without an image; both if the names are not unique.
    """
    stems = [_stem(image) for image in images]
    numbers = [f"{number:0{_DIGITS}d}" for number in range(len(stems))]
    names = [stem or number for stem, number in zip(stems, numbers, strict=True)]
    if len({name.casefold() for name in names}) == len(names):
        return names
    return [f"{number}_{stem}" if stem else number for stem, number in zip(stems, numbers, strict=True)]


@contextmanager
def removed_if_unfinished(files: Sequence[Path], folder: Path | None) -> Iterator[None]:
    """Remove the files that were written before an error or an interrupt, and a new folder if it is empty then."""
    try:
        yield
    except BaseException:
        for file in files:
            file.unlink(missing_ok=True)
        if folder is not None:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
        raise


def make_output_folder(folder: str, names: Sequence[str], *, force: bool) -> Path:
    """Make a folder for files, and refuse to replace existing ones.

    Args:
        folder: the folder; it may exist already.
        names: names of the files to be written.
        force: existing files may be replaced.

    Raises:
        InputError: `folder` is not a folder; two names are equal; or one of the files exists, or is not a file.
        OSError: the folder cannot be made.
    """
    path = Path(folder)
    resolve_links(path)  # refuses a loop of links, which `exists` takes for nothing
    if path.exists() and not path.is_dir():
        raise InputError(f"{folder} is not a folder")
    if len(set(names)) < len(names):
        raise InputError("two renders have the same name: rename the cameras' images")
    for name in names:
        target = path / name
        if target.exists() and not (force and target.is_file()):
            raise InputError(f"{target} exists: --force replaces it" if target.is_file() else f"{target} is in the way")
    path.mkdir(parents=True, exist_ok=True)
    return path


def to_uint8(values: F32) -> U8:
    """Round 0..1 to 0..255. Values outside are clipped, and NaN becomes 0."""
    clipped = np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0)
    result: U8 = np.rint(clipped * 255.0).astype(np.uint8)
    return result


def side_by_side(a: F32, b: F32, amplification: float, image: F32 | None = None) -> U8:
    """Concatenate two images and the amplified magnitude of their difference.

    Args:
        a, b: [H, W, 3], 0..1.
        amplification: factor of the difference.
        image: [H, W, 3], placed first, if given.

    Returns:
        [H, 3 W, 3], or [H, 4 W, 3] with an image.
    """
    difference = np.abs(b.astype(np.float32) - a) * np.float32(amplification)
    shown = [a, b, difference] if image is None else [image, a, b, difference]
    return np.concatenate([to_uint8(panel) for panel in shown], axis=1)


def write_png(path: Path, pixels: NDArray[Any]) -> None:
    """Write [H, W] or [H, W, 3] uint8 as a PNG. The file appears when it is complete.

    Raises:
        InputError: pillow is not installed.
        OSError: the file cannot be written.
    """
    require_images()
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG")
    write_bytes(str(path), buffer.getvalue())


def _stem(image: str | None) -> str:
    """Return the last part of a path of any system, without its ending and characters that file names cannot have."""
    if image is None:
        return ""
    name = PureWindowsPath(PurePosixPath(image).name).name  # never leads out of the folder
    kept = "".join(c if c.isprintable() and c not in '<>:"|?*/\\' else "_" for c in name)
    return PurePosixPath(kept).stem.strip(". ")[:_NAME_LENGTH_MAX]


_MP4 = "MP4"

#: File name endings of videos, with pillow's names of the formats. Pillow does not write MP4.
FILM_ENDINGS = {".webp": "WEBP", ".gif": "GIF", ".png": "PNG", ".apng": "PNG", ".mp4": _MP4}

#: Frames per second.
DEFAULT_FPS, MAX_FPS = 25.0, 100.0

_TICKS = {"WEBP": 1000, "GIF": 100, "PNG": 1000, _MP4: 1000}  # ticks per second of the format's clock
_MAX_SIDE = {"WEBP": 16383, "GIF": 65535, "PNG": 1 << 15, _MP4: 16384}  # largest width or height, pixels
_MAX_BYTES = 1 << 31  # largest size of all frames, which are kept in memory
_WEBP = {"quality": 90, "method": 4}
_X264 = {
    "crf": "18",
    "preset": "medium",
    "threads": "1",  # with several threads, the bytes differ between machines
    "x264-params": "mbtree=0",  # with mbtree two of four runs gave different bytes, even on one thread
}
_BT709 = 1  # H.264's number for matrix, primaries and transfer function
_LIMITED_RANGE = 1  # black is 16, which players expect


def is_film(path: str) -> bool:
    """Return True if a path has the name of a video."""
    return Path(path).suffix.lower() in FILM_ENDINGS


def check_film(path: str, sizes: Sequence[tuple[int, int]], fps: float) -> None:
    """Refuse a video that cannot be written, before it is rendered.

    Args:
        path: a path for which `is_film` is true.
        sizes: width and height of its frames, at least one.
        fps: frames per second, above 0.

    Raises:
        InputError: the frames differ in size, are too large or too many; `fps` is too high; or the package for this
            format is not installed.
    """
    kind = FILM_ENDINGS[Path(path).suffix.lower()]
    if kind == _MP4:
        require_film()
    else:
        require_images()
    if len(set(sizes)) > 1:
        raise InputError(f"the cameras have {len(set(sizes))} sizes, expected one for a video: set --size")
    width, height = sizes[0]
    if kind == _MP4 and min(width, height) < 2:
        raise InputError(f"frames have {width}x{height} pixels, expected at least 2 per side for MP4")
    if max(width, height) > _MAX_SIDE[kind]:
        raise InputError(f"frames have {width}x{height} pixels, expected at most {_MAX_SIDE[kind]} per side for {kind}")
    if len(sizes) * width * height * 3 > _MAX_BYTES:
        raise InputError(
            f"{len(sizes)} frames of {width}x{height} need more than {_MAX_BYTES >> 30} GiB: render into a folder, "
            "and make the video with ffmpeg"
        )
    if fps > min(MAX_FPS, _TICKS[kind]):
        raise InputError(f"{fps:g} frames per second, expected at most {MAX_FPS:g}")


def write_film(path: str, frames: Sequence[U8], fps: float) -> None:
    """Write a video. The file appears when it is complete. An animation repeats for ever.

    Args:
        path: its ending determines the format. WebP loses a little, GIF has 256 colours a frame, PNG loses nothing.
            MP4 is H.264 with colours at half the resolution, which every player can show; its sides are even, which
            may cost a column and a row of pixels.
        frames: [H, W, 3] uint8 each, of one size, at least one.
        fps: frames per second; durations are rounded to the format's ticks without drift.

    Raises:
        InputError: pillow or PyAV is not installed, or was built without this format.
        OSError: the file cannot be written.
    """
    kind = FILM_ENDINGS[Path(path).suffix.lower()]
    write_bytes(path, _encode_mp4(frames, fps) if kind == _MP4 else _encode_animation(kind, frames, fps))


def _encode_animation(kind: str, frames: Sequence[U8], fps: float) -> bytes:
    """Encode frames as an animation that repeats for ever, or a single frame as an image; `kind` is pillow's name.

    Raises:
        InputError: pillow is not installed, or was built without this format.
    """
    require_images()
    from PIL import Image

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
    return buffer.getvalue()


def _encode_mp4(frames: Sequence[U8], fps: float) -> bytes:
    """Encode frames, [H, W, 3] uint8, as H.264 in MP4; odd sides lose a row or column.

    Raises:
        InputError: PyAV is not installed, or was built without H.264.
    """
    require_film()
    import av

    height, width = (side - side % 2 for side in frames[0].shape[:2])  # even, since chroma has half the resolution
    rate = Fraction(fps).limit_denominator(1001)
    with temporary_folder() as folder:
        path = folder / "video.mp4"  # a file, since PyAV rewrites it to put the index first
        options = {"movflags": "+faststart", "fflags": "+bitexact"}
        with av.open(path, "w", format="mp4", options=options) as container:
            try:
                stream = container.add_stream("libx264", rate, options=_X264)
            except ValueError:  # PyAV knows no such codec
                raise InputError("this PyAV cannot write H.264: name a .webp, .gif or .png") from None
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            context = stream.codec_context
            context.colorspace = context.color_primaries = context.color_trc = _BT709
            context.color_range = _LIMITED_RANGE
            for pixels in frames:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels[:height, :width]), format="rgb24")
                container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=_BT709)))
            container.mux(stream.encode())
        return path.read_bytes()


def _durations(count: int, fps: float, ticks: int) -> list[int]:
    """Return the milliseconds of each frame, rounded to ticks of the format without drift."""
    ends = np.rint(np.arange(count + 1) * (ticks / fps)).astype(np.int64)
    lasting = np.maximum(np.diff(ends), 1) * (1000 // ticks)
    return [int(value) for value in lasting]
