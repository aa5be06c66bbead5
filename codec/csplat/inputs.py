"""What a file may be handed in as, and a file of the disk as bytes."""

from __future__ import annotations

import os
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Protocol

__all__ = ["BinaryFile", "Buffer", "File", "mapped"]


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
