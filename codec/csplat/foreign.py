"""Recognise splat files that are not an uncompressed PLY, and say what converts them.

A user who hands over a .spz wants to read "this is SPZ, convert it with ...", not where a PLY
parser stumbled. Only names and the first bytes are looked at; nothing is parsed.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path

from csplat.archives import zip_refusal
from csplat.errors import InputError

__all__ = [
    "HEAD_SIZE",
    "foreign_name",
    "refuse_folder",
    "refuse_foreign",
    "refuse_known",
    "refuse_packed_header",
    "unknown",
    "zip_holds_meta",
]

#: Bytes of the beginning of a file that `refuse_foreign` wants to see.
HEAD_SIZE = 512

_SPLAT_TRANSFORM = "splat-transform (npm package @playcanvas/splat-transform)"
_GSBOX = "gsbox"
_CONVERT = "`csplat convert`, or take csplat.read, which reads it"
_SPLAT_ROW_SIZE = 32

#: By file name, for formats without a magic, or where the magic is missing.
_BY_SUFFIX = {
    ".spz": ("SPZ", _CONVERT),
    ".sog": ("SOG", _CONVERT),
    ".splat": (".splat", _CONVERT),
    ".ksplat": (".ksplat", _CONVERT),
    ".spx": (".spx", _GSBOX),
    ".lcc": ("LCC", _SPLAT_TRANSFORM),
    ".glb": ("glTF", _CONVERT),
    ".gltf": ("glTF", _CONVERT),
    ".csplat": ("csplat", "`csplat decode`"),
}


def refuse_foreign(path: Path, head: bytes, size: int) -> None:
    """Refuse a file that is not a PLY, naming what it is and what converts it.

    Args:
        path: the file; its name decides where its first bytes do not.
        head: its first `HEAD_SIZE` bytes, or all of them.
        size: of the file, in bytes.

    Raises:
        InputError: the file does not begin as a PLY.
    """
    if head[:3] == b"ply" and head[3:4] in (b"\n", b"\r"):
        return
    refuse_known(path, head)
    if size == 0:
        raise InputError(f"{path.name} is empty, wanted a PLY")
    if size % _SPLAT_ROW_SIZE == 0 and not head[:_SPLAT_ROW_SIZE].isascii():
        raise InputError(
            f"{path.name} is not a PLY; its size, a multiple of {_SPLAT_ROW_SIZE} bytes, is that"
            f" of a .splat file: if it is one, convert it to PLY first, with `csplat convert --from splat`"
        )
    raise InputError(f"{path.name} is not a PLY: it begins with {head[:8]!r}; wanted one of Gaussian splats")


def unknown(path: Path, head: bytes) -> InputError:
    """The error for a file or folder in no format that is known here: what it may be, and what converts it.

    Args:
        path: of it.
        head: its first `HEAD_SIZE` bytes; none of a folder.
    """
    if path.is_dir():
        return InputError(f"{path} is a folder, and no scene")
    if not head:
        return InputError(f"{path.name} is empty")
    try:
        refuse_known(path, head)
    except InputError as error:
        return error
    return InputError(f"{path.name} is in no format that csplat knows: it begins with {head[:8]!r}")


def refuse_known(path: Path, head: bytes) -> None:
    """Refuse what is known to be another format, by its first bytes or its name.

    Raises:
        InputError: it is one.
    """
    found = _by_magic(path, head) or _BY_SUFFIX.get(path.suffix.lower())
    if found is not None:
        raise InputError(_refusal(path, *found))


def foreign_name(path: Path) -> str | None:
    """What a file of that name would be for other programs; `None`: nothing that is known."""
    suffix = path.suffix.lower()
    return _BY_SUFFIX[suffix][0] if suffix in _BY_SUFFIX and suffix != ".csplat" else None


def refuse_folder(path: Path) -> None:
    """Refuse a folder: the unbundled form of SOG, or no scene at all.

    Raises:
        InputError: always.
    """
    if (path / "meta.json").exists():
        raise InputError(_refusal(path, "SOG", _CONVERT))
    raise InputError(f"{path.name} is a folder, wanted a PLY")


def refuse_packed_header(path: Path, header: bytes) -> None:
    """Refuse a PLY whose columns are PlayCanvas' packed words.

    Args:
        path: the file, for the message.
        header: its PLY header, up to `end_header`.

    Raises:
        InputError: it has packed positions.
    """
    if any(line.split()[-1:] == [b"packed_position"] for line in header.splitlines()):
        raise InputError(_refusal(path, "compressed PLY", _CONVERT))


def _by_magic(path: Path, head: bytes) -> tuple[str, str] | None:
    if head[:4] == b"NGSP":
        return _BY_SUFFIX[".spz"]
    if head[:2] == b"\x1f\x8b":
        if _inflated_head(head)[:4] == b"NGSP":
            return _BY_SUFFIX[".spz"]
        return ("gzip", "gunzip")
    if head[:4] == b"PK\x03\x04":
        if not zip_holds_meta(path):
            raise InputError(zip_refusal(path))
        return _BY_SUFFIX[".sog"]
    if head[:4] == b"glTF":
        return _BY_SUFFIX[".glb"]
    if path.name == "meta.json":
        return _BY_SUFFIX[".sog"]
    return None


def _inflated_head(head: bytes) -> bytes:
    try:
        return zlib.decompressobj(wbits=31).decompress(head, 16)
    except zlib.error:
        return b""


def zip_holds_meta(path: Path) -> bool:
    """Whether a zip is SOG; of a broken one its name says it."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.rsplit("/", 1)[-1] == "meta.json" for name in archive.namelist())
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError, struct.error):  # of broken archives
        return path.suffix.lower() == ".sog"


def _refusal(path: Path, what: str, converter: str) -> str:
    why = "which csplat does not read" if converter in (_SPLAT_TRANSFORM, _GSBOX) else "not a plain PLY"
    return f"{path.name} is {what}, {why}: convert it to PLY first, with {converter}"
