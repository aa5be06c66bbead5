"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

__all__ = ["atomic_writer"]


@contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for writing that takes its name only when all of it is written.

    The bytes go to a temporary neighbour, renamed over `path` on success and removed on any
    error; a symbolic link keeps pointing where it points. Devices and pipes are written directly.

    Args:
        path: where the file shall be; an existing file is replaced.

    Yields:
        A binary file object, positioned at 0.

    Raises:
        OSError: the folder does not exist, is full or is not writable.
    """
    if Path(path).exists() and not Path(path).is_file():
        with Path(path).open("wb") as stream:  # not resolved: /dev/stdout leads to no name
            yield stream
        return
    target = Path(path).resolve()
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())  # the name must not reach the disk before the bytes
        temporary.replace(target)
    except BaseException:
        with suppress(FileNotFoundError):
            temporary.unlink()
        raise
