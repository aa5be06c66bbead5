# SPDX-License-Identifier: Apache-2.0
"""`open_image`: open a PNG, JPEG, TIFF, WebP or BMP with Pillow. Nothing else in the project opens an image.

Pillow's own `open` tries every plugin that it has, and some of them start other programs: a PostScript file under the
name `3.png` starts Ghostscript. Here the first bytes determine the format, and only the class of that format is called.
Pillow is imported on first use, because it is an optional dependency.
"""

from __future__ import annotations

import io
import logging
import os
import struct
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

from csplat.errors import CsplatError, InputError, missing_package
from csplat.file_source import describe_substitute
from csplat.system import open_regular

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

ImageFormat = Literal["PNG", "JPEG", "TIFF", "WebP", "BMP"]

#: Plugin and class of Pillow by format. The first image of a phone's JPEG with several images (MPO) is opened.
_PLUGINS: dict[ImageFormat, tuple[str, str]] = {
    "PNG": ("PIL.PngImagePlugin", "PngImageFile"),
    "JPEG": ("PIL.JpegImagePlugin", "JpegImageFile"),
    "TIFF": ("PIL.TiffImagePlugin", "TiffImageFile"),
    "WebP": ("PIL.WebPImagePlugin", "WebPImageFile"),
    "BMP": ("PIL.BmpImagePlugin", "BmpImageFile"),
}
_MAGICS: tuple[tuple[bytes, ImageFormat], ...] = (
    (b"\x89PNG\r\n\x1a\n", "PNG"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"II*\0", "TIFF"),
    (b"MM\0*", "TIFF"),
    (b"II+\0", "TIFF"),
    (b"MM\0+", "TIFF"),
    (b"BM", "BMP"),
)

_RAW = "a camera's raw file"
_RAW_SUFFIXES = (".3fr", ".arw", ".cr2", ".cr3", ".dng", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".srw")
_DNG_VERSION, _SUBFILE = 50706, 254  # tags of a TIFF; bit 0 of the second marks the preview of a raw file
#: Other formats: offset and value of their first bytes, and their names.
_OTHERS = (
    (0, b"%!PS", "PostScript (EPS)"),
    (0, b"\x04%!PS", "PostScript (EPS)"),
    (0, b"\xc5\xd0\xd3\xc6", "PostScript (EPS)"),
    (0, b"%PDF", "a PDF"),
    (0, b"GIF8", "a GIF"),
    (4, b"ftypavi", "an AVIF file"),
    (4, b"ftyphe", "a HEIC file"),
    (4, b"ftypm", "a HEIC file"),
    (4, b"ftypcrx", _RAW),
    (4, b"ftyp", "a video"),
    (0, b"\xff\x0a", "a JPEG XL file"),
    (4, b"JXL ", "a JPEG XL file"),
    (4, b"jP  ", "a JPEG 2000 file"),
    (0, b"\xff\x4f\xff\x51", "a JPEG 2000 file"),
    (0, b"8BPS", "a Photoshop file (PSD)"),
    (0, b"\x76\x2f\x31\x01", "an OpenEXR file"),
    (0, b"#?", "a Radiance HDR file"),
    (0, b"DDS ", "a DDS texture"),
    (1, b"KTX ", "a KTX texture"),
    (0, b"\0\0\1\0", "an icon (ICO)"),
    (0, b"\0\0\2\0\0\0", "a TGA"),
    (0, b"\0\0\n\0\0\0", "a TGA"),
    (0, b"\0\0\2\0", "a cursor (CUR)"),
    (0, b"icns", "an icon (ICNS)"),
    (0, b"\xd0\xcf\x11\xe0", "an OLE file (FlashPix, MIC or a document)"),
    (0, b"\xd7\xcd\xc6\x9a", "a Windows metafile (WMF)"),
    (40, b" EMF", "a Windows metafile (EMF)"),
    (0, b"qoif", "a QOI file"),
    (0, b"SIMPLE  =", "a FITS file"),
    (0, b"gimp xcf", "a GIMP file (XCF)"),
    (0, b"FUJIFILMCCD-RAW", _RAW),
    (0, b"IIRO", _RAW),
    (0, b"IIRS", _RAW),
    (0, b"MMOR", _RAW),
    (0, b"IIU\0", _RAW),
    (0, b"PK\x03\x04", "a zip"),
    (0, b"\x1f\x8b", "a gzip"),
    *((0, b"P%d" % kind, "a Netpbm file (PBM, PGM, PPM)") for kind in range(1, 8)),
)
_HEAD_SIZE = 1024  # bytes that identify a format; an SVG may begin with comments
_STDERR = 2  # descriptor of standard error
_FILE_MAX = 1 << 32  # bytes; Pillow reads some formats whole, and no camera writes larger files
_REASON_MAX = 120  # characters of Pillow's reason in a message

#: Images of at most this many pixels are read whatever the size of their files.
FREE_PIXELS = 1 << 26
#: Larger images have at most this many pixels per byte of their files; photographs have fewer than 20.
PIXELS_PER_BYTE = 64

_pillow = threading.RLock()  # filters of warnings belong to the process


@contextmanager
def open_image(
    source: str | os.PathLike[str] | bytes,
    name: str = "",
    *,
    formats: Sequence[ImageFormat] = tuple(_PLUGINS),
    budget: bool = True,
) -> Iterator[ImageFile]:
    """Open an image and read its header; its pixels are decoded on access.

    Within the context, Pillow's warnings are silent and its errors are converted. Contexts of several threads wait for
    each other.

    Args:
        source: a path, or the bytes of the file.
        name: name of the image, for messages; by default the path.
        formats: formats to accept.
        budget: refuse images that are larger than `FREE_PIXELS` and have more than `PIXELS_PER_BYTE`; False if the
            caller compares the size with what it expects before it decodes.

    Raises:
        InputError: the file cannot be read, is not a regular file, not of these formats, damaged or too large; or
            Pillow is not installed.
    """
    name = name or ("image" if isinstance(source, bytes) else os.fspath(source))
    with _open_stream(source, name) as stream:
        head, size_bytes = stream.read(_HEAD_SIZE), stream.seek(0, os.SEEK_END)
        stream.seek(0)
        kind = _identify_format(head, name, formats)
        if size_bytes > _FILE_MAX:
            raise InputError(f"{name} has {size_bytes:,} bytes, expected at most {_FILE_MAX:,}")
        with _pillow, warnings.catch_warnings(), _silent_libtiff(kind):
            warnings.simplefilter("ignore")
            logging.getLogger("PIL").addHandler(_SILENT)
            image = _open(stream, kind, name)
            with _reported_errors(kind, name), image:
                if budget:
                    _check_budget(image.size, size_bytes, name)
                yield image


def _open_stream(source: str | os.PathLike[str] | bytes, name: str) -> BinaryIO:
    """Open a path or bytes for reading; raise an `InputError` with `name` if that fails."""
    if isinstance(source, bytes):
        return io.BytesIO(source)
    try:
        return open_regular(source)
    except (OSError, ValueError) as error:  # ValueError: the name contains a null character
        raise InputError(f"{name}: {getattr(error, 'strerror', None) or error}") from error


_SILENT = logging.NullHandler()  # Pillow's log is the application's business; without a handler it is printed


@contextmanager
def _silent_libtiff(kind: ImageFormat) -> Iterator[None]:
    """Discard the output of libtiff to standard error, which bypasses Python; Pillow reports the same error."""
    try:
        saved = os.dup(_STDERR) if kind == "TIFF" else -1
    except OSError:  # it is closed
        saved = -1
    if saved < 0:
        yield
        return
    try:
        with Path(os.devnull).open("wb") as nothing:
            os.dup2(nothing.fileno(), _STDERR)
        yield
    finally:
        os.dup2(saved, _STDERR)
        os.close(saved)


def _identify_format(head: bytes, name: str, formats: Sequence[ImageFormat]) -> ImageFormat:
    """Return the format of a file by its first bytes.

    Raises:
        InputError: the format is not among `formats`, which the message names if it is a known one.
    """
    expected = ", ".join(formats[:-1]) + (" or " if len(formats) > 1 else "") + formats[-1]
    kind: ImageFormat | None = next((kind for magic, kind in _MAGICS if head.startswith(magic)), None)
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":  # between them, the size of the file
        kind = "WebP"
    suffix = Path(name).suffix.lower()
    if suffix in _RAW_SUFFIXES or (kind == "TIFF" and head[8:10] == b"CR"):  # CR2 of Canon
        raise _raw_refusal(name)
    if kind is not None and kind in formats:
        return kind
    if kind is not None:
        raise InputError(f"{name} is a {kind}, expected {expected}")
    if not head:
        raise InputError(f"{name} is empty")
    refused = next((description for at, magic, description in _OTHERS if head[at:].startswith(magic)), "")
    if not refused and b"<svg" in head.lower():
        refused = "an SVG"
    if refused == _RAW:
        raise _raw_refusal(name)
    if refused:
        raise InputError(f"{name} is {refused}, which is not read, expected {expected}: convert it to PNG or JPEG")
    if instead := describe_substitute(head):
        raise InputError(f"{name} is {instead}")
    raise InputError(f"{name} is not an image: it begins with {head[:8]!r}, expected {expected}")


def _open(stream: BinaryIO, kind: ImageFormat, name: str) -> ImageFile:
    """Open an image with Pillow's class for its format; only its header is read.

    Raises:
        InputError: Pillow is not installed, or the file is damaged or a camera's raw file.
    """
    module, title = _PLUGINS[kind]
    try:
        opener = getattr(import_module(module), title)
    except ModuleNotFoundError as error:
        raise missing_package(error, "Pillow") from None
    with _reported_errors(kind, name):
        image: ImageFile = opener(stream, name)
        tags = getattr(image, "tag_v2", {})
        if _DNG_VERSION in tags or tags.get(_SUBFILE, 0) & 1:
            raise _raw_refusal(name)
    return image


def _raw_refusal(name: str) -> InputError:
    """Return the error for a camera's raw file."""
    return InputError(f"{name} is {_RAW}, expected an image: develop it to PNG or JPEG")


@contextmanager
def _reported_errors(kind: ImageFormat, name: str) -> Iterator[None]:
    """Raise any error of Pillow as an `InputError` of one line: its plugins raise almost any error on damaged files."""
    try:
        yield
    except CsplatError:
        raise
    except Exception as error:
        hint = "a TIFF that is damaged, or not of 8 or 16 bits or of floats in one channel: convert it to PNG or JPEG"
        if kind == "TIFF" and isinstance(error, SyntaxError):
            raise InputError(f"{name} is {hint}") from error
        if isinstance(error, MemoryError):
            raise InputError(f"{name} does not fit into the memory: scale it") from error
        reason = " ".join(str(error).split())[:_REASON_MAX]
        if "MAX_TEXT" in reason:
            raise InputError(f"{name} has texts or a colour profile of too many bytes: save it without them") from error
        if "truncated" in reason.lower() or isinstance(error, EOFError):
            raise InputError(f"{name} is a {kind} that is truncated: copy or export it again") from error
        if isinstance(error, struct.error | LookupError | TypeError | AttributeError) or not reason:
            reason = "its parts contradict each other"
        raise InputError(f"{name} is a {kind} that is damaged ({reason}): copy or export it again") from error


def _check_budget(size: tuple[int, int], size_bytes: int, name: str) -> None:
    """Raise an `InputError` if an image of `size` (width, height) has too many pixels for its file size in bytes."""
    most = max(FREE_PIXELS, PIXELS_PER_BYTE * size_bytes)
    if size[0] * size[1] > most:
        raise InputError(
            f"{name} has {size[0]}×{size[1]} pixels in {size_bytes:,} bytes, expected at most {most:,} pixels: scale it"
        )
