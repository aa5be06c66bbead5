"""What a file may be handed in as, what may come in its place, and a file of the disk as bytes."""

from __future__ import annotations

import mmap as mmaps
import os
import sys
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Protocol

__all__ = ["BinaryFile", "Buffer", "File", "LetGo", "mapped", "stand_in"]

_LFS_POINTERS = (b"version https://git-lfs.github.com/spec/", b"version https://hawser.github.com/spec/")
_HTML = (b"<!doctype", b"<html", b"<head", b"<body", b"<script")
_XML = (b"<?xml", b"<error")


class BinaryFile(Protocol):
    """What `open(path, "rb")`, `io.BytesIO` and `gzip.open` give: it is read from where it stands to its end."""

    def read(self, size: int = -1, /) -> bytes:
        """So many bytes, or all that are left."""
        ...


#: Bytes in memory (collections.abc.Buffer needs Python 3.12).
Buffer = bytes | bytearray | memoryview | mmap

#: A path, an open binary file, or the bytes themselves.
File = str | os.PathLike[str] | BinaryFile | Buffer


def mapped(path: str | os.PathLike[str]) -> bytes | mmap:
    """The bytes of a file, without reading it where that is possible; let go of when nobody looks at them any more.

    Raises:
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        try:
            return mmap(stream.fileno(), 0, access=ACCESS_READ)
        except (ValueError, OSError):  # empty, or a pipe
            return stream.read()


def stand_in(head: bytes) -> str:
    """Name what came in place of a file, whatever file was wanted; "" where the content gives no sign of that.

    Args:
        head: the first bytes of the file, 64 or more where it has them.

    Examples:
        >>> stand_in(b"version https://git-lfs.github.com/spec/v1")
        'a pointer of Git LFS, not the file itself: run `git lfs pull`'
    """
    if head.startswith(_LFS_POINTERS):
        return "a pointer of Git LFS, not the file itself: run `git lfs pull`"
    text = head[:64].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith(_HTML):
        return "a web page (HTML), not the file itself: download it again, and look at the page where that fails"
    if text.startswith(_XML):
        return "XML, as servers answer when something is wrong, not the file itself: download it again"
    return ""


class LetGo:
    """Keeps a mapped file from filling the memory of who goes through it. Owns how much was read since the last time.

    What was read counts as memory of the process until the machine is short of it; let go of, it is read again when it
    is wanted again. Bytes in memory stay as they are.

    Args:
        view: the file.
        step_bytes: bytes that are read between two releases of the mapping.
    """

    def __init__(self, view: memoryview, step_bytes: int = 1 << 25) -> None:
        known = hasattr(mmap, "madvise") and hasattr(mmaps, "MADV_DONTNEED")
        file = view.obj if known and isinstance(view.obj, mmap) else None
        # What somebody may have written there is nowhere else.
        self._file = file if file is not None and memoryview(file).readonly else None
        self._read_bytes, self._step_bytes = 0, step_bytes

    def after(self, size_bytes: int) -> None:
        """Note that so much has been read, and let go of everything now and then."""
        self._read_bytes += size_bytes
        if sys.platform != "win32" and self._file is not None and self._read_bytes >= self._step_bytes:
            self._read_bytes = 0
            self._file.madvise(mmaps.MADV_DONTNEED)
