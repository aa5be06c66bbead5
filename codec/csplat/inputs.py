"""What a file may be handed in as."""

from __future__ import annotations

import os
from mmap import mmap
from typing import Protocol

__all__ = ["BinaryFile", "Buffer", "File"]


class BinaryFile(Protocol):
    """What `open(path, "rb")`, `io.BytesIO` and `gzip.open` give: it is read from where it stands to its end."""

    def read(self, size: int = -1, /) -> bytes:
        """So many bytes, or all that are left."""
        ...


#: Bytes in memory (collections.abc.Buffer needs Python 3.12).
Buffer = bytes | bytearray | memoryview | mmap

#: A path, an open binary file, or the bytes themselves.
File = str | os.PathLike[str] | BinaryFile | Buffer
