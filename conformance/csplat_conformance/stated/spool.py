"""Splats of a source on the disk, under numbers of the caller's: by where they lie, or by what they became."""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from csplat.files import check_room
from csplat.system import read_into
from csplat.types import I64
from csplat_conformance.stated.source import Source

Records = NDArray[Any]  # structured, a splat each

_WAITING_BYTES = 1 << 25  # bytes of splats that wait to be written, so that parts of a file are large enough to read
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@dataclass(frozen=True)
class Rows:
    """Splats as records, and back.

    Attributes:
        dtype: type of a record: the arrays of a `Source`, its extra columns, and an integer `number`.
        origin: origin of the source.
        names: names of the extra columns.
    """

    dtype: np.dtype[Any]
    origin: tuple[float, float, float]
    names: tuple[str, ...]

    @classmethod
    def of(cls, source: Source, names: tuple[str, ...]) -> Rows:
        """The layout of a source's splats, with these extra columns."""
        columns = [(name, getattr(source, name)) for name in _ARRAYS]
        columns += [(f"extra {name}", source.extra[name]) for name in names]
        fields = [(name, array.dtype, array.shape[1:]) for name, array in columns]
        return cls(np.dtype([*fields, ("number", np.int64)]), source.origin, names)

    def packed(self, source: Source, rows: NDArray[Any], numbers: I64) -> Records:
        """Make records of some splats of a source of this layout."""
        records = np.empty(len(rows), self.dtype)
        for name in _ARRAYS:
            records[name] = getattr(source, name)[rows]
        for name in self.names:
            records[f"extra {name}"] = source.extra[name][rows]
        records["number"] = numbers
        return records

    def source(self, records: Records) -> Source:
        """The splats of some records."""
        arrays = {name: np.ascontiguousarray(records[name]) for name in _ARRAYS}
        extra = {name: np.ascontiguousarray(records[f"extra {name}"]) for name in self.names}
        return Source(**arrays, origin=self.origin, extra=extra)


@dataclass(eq=False)
class Spool:
    """Splats in a file that nobody else sees, under keys. Owns what waits for being written.

    Attributes:
        stream: a file of no name.
        rows: layout of the splats in it.
    """

    stream: IO[bytes]
    rows: Rows
    _parts: dict[int, list[tuple[int, int]]] = field(default_factory=dict)  # by key: byte of the file, and records
    _waiting: dict[int, list[Records]] = field(default_factory=dict)
    _waiting_bytes: int = 0
    _size: int = 0

    def add(self, source: Source, rows: NDArray[Any], keys: I64, numbers: I64) -> None:
        """Add some splats; splats of one key stay in the order in which they are added.

        Args:
            source: splats of that layout.
            rows: [n] indices of its splats.
            keys: [n] key of each.
            numbers: [n] number stored with each.

        Raises:
            OSError: they cannot be written.
        """
        if not len(rows):
            return
        order = np.argsort(keys, kind="stable")
        keys, records = keys[order], self.rows.packed(source, rows[order], numbers[order])
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(keys)], strict=True):
            self._waiting.setdefault(int(keys[start]), []).append(records[start:end])
        self._waiting_bytes += records.nbytes
        if self._waiting_bytes > _WAITING_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write what waits.

        Raises:
            OSError: it cannot be written.
        """
        self.stream.seek(self._size)
        for key, waiting in sorted(self._waiting.items()):
            for records in waiting:
                self.stream.write(records.view(np.uint8).data)
            count = sum(map(len, waiting))
            self._parts.setdefault(key, []).append((self._size, count))
            self._size += count * self.rows.dtype.itemsize
        self.stream.flush()
        self._waiting, self._waiting_bytes = {}, 0

    def counts(self) -> dict[int, int]:
        """Return the number of splats of each key."""
        return {key: sum(count for _, count in parts) for key, parts in sorted(self._parts.items())}

    def sources(self, key: int, most: int) -> Iterator[tuple[Source, I64]]:
        """Yield the splats of a key, at most `most` at a time, and their numbers. Several processes may read.

        Raises:
            OSError: they cannot be read.
        """
        left, size = self.counts().get(key, 0), self.rows.dtype.itemsize
        block, filled = np.empty(min(most, left), self.rows.dtype), 0
        for at, count in self._parts.get(key, ()):
            done = 0
            while done < count:
                step = min(count - done, len(block) - filled)
                _read_at(self.stream, at + done * size, block[filled : filled + step].view(np.uint8).data)
                done, filled = done + step, filled + step
                if filled == len(block):
                    yield self.rows.source(block), block["number"].copy()
                    filled = 0
        if filled:
            yield self.rows.source(block[:filled]), block["number"][:filled].copy()


def _read_at(stream: IO[bytes], at: int, buffer: memoryview) -> None:
    """Fill a buffer, without moving the place where the next one reads."""
    while buffer:
        count = read_into(stream.fileno(), buffer, at)
        if not count:
            raise OSError(errno.EIO, "the file of sorted splats has become shorter")
        buffer, at = buffer[count:], at + count


def opened_spool(rows: Rows, count: int) -> Spool:
    """Open a spool in the folder for temporary files (TMPDIR).

    Args:
        rows: layout of the splats in it.
        count: splats that will lie in it, at most.

    Raises:
        InputError: the disk has no room for them.
        OSError: it cannot be made.
    """
    folder = tempfile.gettempdir()
    check_room(folder, count * rows.dtype.itemsize, "the source is compared: TMPDIR names another folder")
    return Spool(tempfile.TemporaryFile(), rows)
