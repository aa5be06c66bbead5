"""Store splats of a source in a temporary file, sorted by integer keys: cells of space, or groups of tiles."""

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


@dataclass(frozen=True)
class RecordLayout:
    """The layout of splats as records.

    Attributes:
        dtype: type of a record: the arrays of a `Source`, its extra columns, and an integer `number`.
        origin: origin of the source.
        names: names of the extra columns.
    """

    dtype: np.dtype[Any]
    origin: tuple[float, float, float]
    names: tuple[str, ...]

    @classmethod
    def of(cls, source: Source, names: tuple[str, ...]) -> RecordLayout:
        """Return the layout of a source's splats with the given extra columns."""
        columns = [(name, getattr(source, name)) for name in _ARRAYS]
        columns += [(f"extra {name}", source.extra[name]) for name in names]
        fields = [(name, array.dtype, array.shape[1:]) for name, array in columns]
        return cls(np.dtype([*fields, ("number", np.int64)]), source.origin, names)

    def pack(self, source: Source, rows: NDArray[Any], numbers: I64) -> RecordArray:
        """Return records of the given splats of a source of this layout."""
        records = np.empty(len(rows), self.dtype)
        for name in _ARRAYS:
            records[name] = getattr(source, name)[rows]
        for name in self.names:
            records[f"extra {name}"] = source.extra[name][rows]
        records["number"] = numbers
        return records

    def unpack(self, records: RecordArray) -> Source:
        """Return the splats of records."""
        arrays = {name: np.ascontiguousarray(records[name]) for name in _ARRAYS}
        extra = {name: np.ascontiguousarray(records[f"extra {name}"]) for name in self.names}
        return Source(**arrays, origin=self.origin, extra=extra)


@dataclass(eq=False)
class SplatSpool:
    """Splats in an unnamed file, by key. Owns the write buffer.

    Attributes:
        stream: the file, which has no name.
        layout: layout of the splats.
    """

    stream: IO[bytes]
    layout: RecordLayout
    _parts: dict[int, list[tuple[int, int]]] = field(default_factory=dict)  # by key: offset in the file, record count
    _pending: dict[int, list[RecordArray]] = field(default_factory=dict)
    _pending_bytes: int = 0
    _size: int = 0

    def add(self, source: Source, rows: NDArray[Any], keys: I64, numbers: I64) -> None:
        """Add splats. Splats of one key keep the order of addition.

        Args:
            source: a source of this layout.
            rows: [n] indices of splats of the source.
            keys: [n] keys of these splats.
            numbers: [n] numbers to store with them.

        Raises:
            OSError: the file cannot be written.
        """
        if not len(rows):
            return
        order = np.argsort(keys, kind="stable")
        keys, records = keys[order], self.layout.pack(source, rows[order], numbers[order])
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
            self._size += count * self.layout.dtype.itemsize
        self.stream.flush()
        self._pending, self._pending_bytes = {}, 0

    def counts(self) -> dict[int, int]:
        """Return the number of splats of each key."""
        return {key: sum(count for _, count in parts) for key, parts in sorted(self._parts.items())}

    def sources(self, key: int, most: int) -> Iterator[tuple[Source, I64]]:
        """Yield the splats of a key and their numbers, `most` at a time; several processes may read at once.

        Raises:
            OSError: the file cannot be read.
        """
        left, size = self.counts().get(key, 0), self.layout.dtype.itemsize
        block, filled = np.empty(min(most, left), self.layout.dtype), 0
        for at, count in self._parts.get(key, ()):
            done = 0
            while done < count:
                step = min(count - done, len(block) - filled)
                _read_at(self.stream, at + done * size, block[filled : filled + step].view(np.uint8).data)
                done, filled = done + step, filled + step
                if filled == len(block):
                    yield self.layout.unpack(block), block["number"].copy()
                    filled = 0
        if filled:
            yield self.layout.unpack(block[:filled]), block["number"][:filled].copy()


def _read_at(stream: IO[bytes], at: int, buffer: memoryview) -> None:
    """Fill a buffer from an offset of the file, without moving the file position."""
    while buffer:
        count = read_into(stream.fileno(), buffer, at)
        if not count:
            raise OSError(errno.EIO, "the file of sorted splats has become shorter")
        buffer, at = buffer[count:], at + count


def open_spool(layout: RecordLayout, count: int) -> SplatSpool:
    """Open a spool in the folder for temporary files (TMPDIR).

    Args:
        layout: layout of the splats.
        count: largest number of splats.

    Raises:
        InputError: the disk has too little free space.
        OSError: the file cannot be created.
    """
    check_free_space(
        temporary_root(), count * layout.dtype.itemsize, "the source is compared: set TMPDIR to another folder"
    )
    return SplatSpool(temporary_file(), layout)
