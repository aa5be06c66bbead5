"""Writing files so that a reader never sees half of one, and reading arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError

__all__ = ["atomic_writer", "read_array"]


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


def read_array(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Read one array from a .npy file.

    Raises:
        InputError: it is not one.
        OSError: it cannot be read.
    """
    if Path(path).exists() and not Path(path).is_file():
        raise InputError(f"{path} is not a file")
    try:
        with Path(path).open("rb") as stream:
            array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    except (
        ValueError,
        EOFError,
        SyntaxError,
        TokenError,
        TypeError,
        MemoryError,
    ) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path} is not a NumPy array file (.npy): {reason}") from None
    return array
