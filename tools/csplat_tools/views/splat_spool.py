# SPDX-License-Identifier: Apache-2.0
"""Store splats in a temporary file, sorted by integer keys: slices of depth."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import check_free_space, temporary_file, temporary_root
from csplat.system import read_into
from csplat.types import I64
from csplat_conformance.declared_bounds.measurement import Source

RecordArray = NDArray[Any]  # structured, a record per splat

_PENDING_BYTES_MAX = 1 << 25  # size of the write buffer; small parts of the file would be slow to read
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def record_type(source: Source) -> np.dtype[Any]:
    """Return the type of a record: the arrays of a source's splat, without extra columns."""
    columns = [(name, getattr(source, name)) for name in _ARRAYS]
    return np.dtype([(name, array.dtype, array.shape[1:]) for name, array in columns])


@dataclass(eq=False)
class SplatSpool:
    """Splats in an unnamed file, by key. Owns the write buffer.

    Attributes:
        stream: the file, which has no name.
        dtype: type of its records.
    """

    stream: IO[bytes]
    dtype: np.dtype[Any]
    _parts: dict[int, list[tuple[int, int]]] = field(default_factory=dict)  # by key: offset in the file, record count
    _pending: dict[int, list[RecordArray]] = field(default_factory=dict)
    _pending_bytes: int = 0
    _size: int = 0

    def add(self, source: Source, rows: NDArray[Any], keys: I64) -> None:
        """Add splats. Splats of one key keep the order of addition.

        Args:
            source: a source with arrays of these types.
            rows: [n] indices of splats of the source.
            keys: [n] keys of these splats.

        Raises:
            OSError: the file cannot be written.
        """
        if not len(rows):
            return
        order = np.argsort(keys, kind="stable")
        keys, records = keys[order], np.empty(len(rows), self.dtype)
        for name in _ARRAYS:
            records[name] = getattr(source, name)[rows[order]]
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(keys)], strict=True):
            self._pending.setdefault(int(keys[start]), []).append(records[start:end])
        self._pending_bytes += records.nbytes
        if self._pending_bytes > _PENDING_BYTES_MAX:
            self.flush()

    def flush(self) -> None:
        """Write the buffered splats.

        Raises:
            OSError: the file cannot be written.
        """
        self.stream.seek(self._size)
        for key, waiting in sorted(self._pending.items()):
            for records in waiting:
                self.stream.write(records.view(np.uint8).data)
            count = sum(map(len, waiting))
            self._parts.setdefault(key, []).append((self._size, count))
            self._size += count * self.dtype.itemsize
        self.stream.flush()
        self._pending, self._pending_bytes = {}, 0

    def counts(self) -> dict[int, int]:
        """Return the number of splats of each key."""
        return {key: sum(count for _, count in parts) for key, parts in sorted(self._parts.items())}

    def sources(self, key: int, most: int) -> Iterator[Source]:
        """Yield the splats of a key, `most` at a time.

        Raises:
            OSError: the file cannot be read.
        """
        splat_count, size = self.counts().get(key, 0), self.dtype.itemsize
        block, filled = np.empty(min(most, splat_count), self.dtype), 0  # the first `filled` records were read
        for offset, count in self._parts.get(key, ()):
            done = 0
            while done < count:
                step = min(count - done, len(block) - filled)
                _read_at(self.stream, offset + done * size, block[filled : filled + step].view(np.uint8).data)
                done, filled = done + step, filled + step
                if filled == len(block):
                    yield _unpack(block)
                    filled = 0
        if filled:
            yield _unpack(block[:filled])


def _unpack(records: RecordArray) -> Source:
    """Return a copy of records as splats to draw."""
    arrays: dict[str, Any] = {name: np.ascontiguousarray(records[name]) for name in _ARRAYS}
    return Source(**arrays)


def _read_at(stream: IO[bytes], offset: int, buffer: memoryview) -> None:
    """Fill a buffer from an offset of the file, without moving the file position.

    Raises:
        OSError: the file cannot be read, or ends before.
    """
    while buffer:
        count = read_into(stream.fileno(), buffer, offset)
        if not count:
            raise OSError(errno.EIO, "the file of sorted splats has become shorter")
        buffer, offset = buffer[count:], offset + count


def open_spool(dtype: np.dtype[Any], count: int) -> SplatSpool:
    """Open a spool in the folder for temporary files (TMPDIR).

    Args:
        dtype: type of the records.
        count: largest number of splats.

    Raises:
        InputError: the disk has too little free space.
        OSError: the file cannot be created.
    """
    check_free_space(temporary_root(), count * dtype.itemsize, "a scene is rendered: set TMPDIR to another folder")
    return SplatSpool(temporary_file(), dtype)
