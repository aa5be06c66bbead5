"""Accept input files as paths, binary files or bytes; map files; recognise content that came in their place."""

from __future__ import annotations

import mmap as mmaps
import os
import sys
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Protocol

_LFS = "Git LFS, not the file itself: run `git lfs pull`"
#: Pointer files of repositories by their first bytes: program and remedy.
_POINTERS = {
    b"version https://git-lfs.github.com/spec/": _LFS,
    b"version https://hawser.github.com/spec/": _LFS,
    b"/annex/objects/": "git-annex, not the file itself: run `git annex get`",
}
_HTML = (b"<!doctype", b"<!--", b"<html", b"<head", b"<title", b"<meta", b"<body", b"<script")
_XML = (b"<?xml", b"<error", b"<svg")
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16


class BinaryFile(Protocol):
    """A binary file such as `open(path, "rb")`, `io.BytesIO` or `gzip.open`, read from its position to its end."""

    def read(self, size: int = -1, /) -> bytes:
        """Return up to `size` bytes, or all that are left."""
        ...


#: Bytes in memory (collections.abc.Buffer needs Python 3.12).
Buffer = bytes | bytearray | memoryview | mmap

#: A path, an open binary file, or the bytes themselves.
File = str | os.PathLike[str] | BinaryFile | Buffer


def map_file(path: str | os.PathLike[str]) -> bytes | mmap:
    """Return the bytes of a file, mapped if that is possible; the mapping is released with the last reference to it.

    Raises:
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        try:
            return mmap(stream.fileno(), 0, access=ACCESS_READ)
        except (ValueError, OSError):  # empty, or a pipe
            return stream.read()


def describe_substitute(head: bytes) -> str:
    """Return a description of content that came in place of a file, for any kind of file; "" if there is no sign of it.

    Args:
        head: the first bytes of the file, 64 or more if it has them.

    Examples:
        >>> stand_in(b"version https://git-lfs.github.com/spec/v1")
        'a pointer of Git LFS, not the file itself: run `git lfs pull`'
    """
    text = head.decode("utf-16", "replace").encode() if head.startswith(_WIDE_MARKS) else head
    text = text.removeprefix(b"\xef\xbb\xbf")
    for begin, program in _POINTERS.items():
        if text.startswith(begin):
            return f"a pointer of {program}"
    text = text.lstrip()[:64].lower()
    if text.startswith(_HTML):
        return "a web page (HTML), not the file itself: download it again, and look at the page where that fails"
    if text.startswith(_XML):
        return "XML, as servers answer when something is wrong, not the file itself: download it again"
    return ""


class PageReleaser:
    """Releases pages of a memory-mapped file during a sequential read.

    Pages that were read count as memory of the process until the machine is short of it; released pages are read again
    when they are needed again. Bytes in memory stay as they are.

    Args:
        view: the file.
        step_bytes: bytes that are read between two releases of the mapping.
    """

    def __init__(self, view: memoryview, step_bytes: int = 1 << 25) -> None:
        known = hasattr(mmap, "madvise") and hasattr(mmaps, "MADV_DONTNEED")
        file = view.obj if known and isinstance(view.obj, mmap) else None
        # A writable mapping may hold changes that are nowhere else.
        self._file = file if file is not None and memoryview(file).readonly else None
        self._read_bytes, self._step_bytes = 0, step_bytes

    def after(self, size_bytes: int) -> None:
        """Count bytes that were read, and release all pages after every `step_bytes`."""
        self._read_bytes += size_bytes
        if sys.platform != "win32" and self._file is not None and self._read_bytes >= self._step_bytes:
            self._read_bytes = 0
            self._file.madvise(mmaps.MADV_DONTNEED)
