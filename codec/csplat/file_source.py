# SPDX-License-Identifier: Apache-2.0
"""Accept input files as paths, binary files or bytes; map files; recognise placeholders such as Git LFS pointers."""

from __future__ import annotations

import io
import mmap as mmaps
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from typing import Any, BinaryIO, Protocol, overload

_LFS = "Git LFS, not the file itself: run `git lfs pull`"
#: First bytes of pointer files in repositories, with program and remedy.
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
        """Return up to `size` bytes, or all remaining bytes."""
        ...


#: Bytes in memory (`collections.abc.Buffer` requires Python 3.12).
Buffer = bytes | bytearray | memoryview | mmap

#: A path, an open binary file, or the bytes themselves.
File = str | os.PathLike[str] | BinaryFile | Buffer


def map_file(path: str | os.PathLike[str]) -> bytes | mmap:
    """Return the bytes of a file, mapped if possible; the mapping is released with the last reference to it.

    Raises:
        OSError: the file cannot be read.
    """
    with open_binary(path) as stream:
        try:
            return mmap(stream.fileno(), 0, access=ACCESS_READ)
        except (ValueError, OSError):  # empty, or a pipe
            return stream.read()


@contextmanager
def named_errors(name: str | os.PathLike[str]) -> Iterator[None]:
    """Add the name of a file to errors of the operating system that lack it, in reading, writing and closing."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = os.fspath(name)
        raise


class _NamedFile(io.FileIO):
    """An unbuffered file whose errors all have its name, not only the errors of opening it."""

    def __init__(self, path: str, mode: str, name: str, opener: Callable[[str, int], int]) -> None:
        self._label = name
        super().__init__(path, mode, opener=opener)

    def read(self, size: int | None = -1, /) -> Any:
        with named_errors(self._label):
            return super().read(-1 if size is None else size)

    def readall(self) -> Any:
        with named_errors(self._label):
            return super().readall()

    def readinto(self, buffer: Any, /) -> Any:
        with named_errors(self._label):
            return super().readinto(buffer)

    def write(self, data: Any, /) -> Any:
        with named_errors(self._label):
            return super().write(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        with named_errors(self._label):
            return super().seek(offset, whence)

    def close(self) -> None:
        with named_errors(self._label):
            super().close()


@overload
def open_binary(path: str | os.PathLike[str]) -> io.BufferedReader: ...


@overload
def open_binary(
    path: str | os.PathLike[str],
    mode: str,
    *,
    name: str | os.PathLike[str] | None = None,
    permissions: int = 0o666,
    flags: int = 0,
) -> BinaryIO: ...


def open_binary(
    path: str | os.PathLike[str],
    mode: str = "r",
    *,
    name: str | os.PathLike[str] | None = None,
    permissions: int = 0o666,
    flags: int = 0,
) -> io.BufferedReader | BinaryIO:
    """Open a file on disk; errors of reading, writing and closing also have its name.

    Args:
        path: path of the file.
        mode: as for `open`, without "b".
        name: name of the file in messages, if it differs from `path`.
        permissions: permissions of a file that is created, reduced by the process's umask.
        flags: further flags of `os.open`.

    Raises:
        OSError: the file cannot be opened.
    """
    opener = lambda path, own: os.open(path, own | flags, permissions)  # noqa: E731  # short, used once
    file = _NamedFile(os.fspath(path), mode, os.fspath(path if name is None else name), opener)
    kind: Any = io.BufferedRandom if "+" in mode else io.BufferedReader if mode == "r" else io.BufferedWriter
    opened: BinaryIO = kind(file)
    return opened


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read a file.

    Raises:
        OSError: the file cannot be read; it has its name.
    """
    with open_binary(path) as stream:
        return stream.read()


def write_file(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file whose name need not be kept for complete content, as in a temporary folder.

    Raises:
        OSError: the file cannot be written; it has its name.
    """
    with open_binary(path, "w") as stream:
        stream.write(data)


def describe_substitute(head: bytes) -> str:
    """Describe a placeholder that was delivered instead of a file, such as an error page; return "" if there is none.

    Args:
        head: the first 64 bytes of the file or more, or all of a shorter file.

    Examples:
        >>> describe_substitute(b"version https://git-lfs.github.com/spec/v1")
        'a pointer of Git LFS, not the file itself: run `git lfs pull`'
    """
    text = head.decode("utf-16", "replace").encode() if head.startswith(_WIDE_MARKS) else head
    text = text.removeprefix(b"\xef\xbb\xbf")
    for begin, program in _POINTERS.items():
        if text.startswith(begin):
            return f"a pointer of {program}"
    text = text.lstrip()[:64].lower()
    if text.startswith(_HTML):
        return "a web page (HTML), not the file itself: download it again, and if that fails read the page"
    if text.startswith(_XML):
        return "XML, probably a server's error message, not the file itself: download it again"
    return ""


class PageReleaser:
    """Releases pages of a memory-mapped file during a sequential read.

    The system counts pages that were read as memory of the process. Released pages are read again on the next access.
    A view of bytes in memory is left alone.

    Args:
        view: the file.
        step_bytes: bytes read between two releases.
    """

    def __init__(self, view: memoryview, step_bytes: int = 1 << 25) -> None:
        known = hasattr(mmap, "madvise") and hasattr(mmaps, "MADV_DONTNEED")
        file = view.obj if known and isinstance(view.obj, mmap) else None
        # Pages of a writable mapping may hold changes that are not on disk.
        self._file = file if file is not None and memoryview(file).readonly else None
        self._read_bytes, self._step_bytes = 0, step_bytes

    def after(self, size_bytes: int) -> None:
        """Record bytes that were read; release all pages after every `step_bytes`."""
        self._read_bytes += size_bytes
        if sys.platform != "win32" and self._file is not None and self._read_bytes >= self._step_bytes:
            self._read_bytes = 0
            self._file.madvise(mmaps.MADV_DONTNEED)
