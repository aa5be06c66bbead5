# SPDX-License-Identifier: Apache-2.0
"""Read byte ranges of files in memory and on disk; base class of the store for URLs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path

import numpy as np

from csplat.decoder.container import view_of
from csplat.errors import CsplatError, FormatError, LimitError, StoreError
from csplat.file_source import File, map_file, named_errors, open_binary
from csplat.system import Pages, read_at


@dataclass(frozen=True)
class RequestSizes:
    """Sizes and concurrency of the requests for a file.

    Attributes:
        first: size of the first request, bytes: holds the index of a scene of about twenty million splats.
        batch: total size of the tiles fetched together during a sequential read, bytes.
        gap: largest gap between two ranges that a request reads through, bytes; a second request takes longer.
        request: maximum size of a request, bytes.
        at_once: maximum number of concurrent requests.
        waits: break before each repetition of a failed request to a web server, seconds.
    """

    first: int = 1 << 16
    batch: int = 1 << 23
    gap: int = 1 << 16
    request: int = 1 << 23
    at_once: int = 8
    waits: tuple[float, ...] = (0.25, 1.0, 4.0)


class Store:
    """A file that is read by byte ranges.

    Attributes:
        name: name for messages, without the passwords and signatures of a URL; "" if the file has no name.
        size: size of the file, bytes.
        requests: number of requests so far, including requests for the size.
        bytes_read: number of bytes read so far.
        sizes: sizes of requests; may be replaced before the first request.
    """

    sizes = RequestSizes()

    def __init__(self, name: str, size: int, requests: int = 0) -> None:
        self.name = name
        self.size = size
        self.requests = requests
        self.bytes_read = 0

    def read(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Read byte ranges of the file.

        Args:
            ranges: (start, stop) of each range.

        Raises:
            StoreError: the store returned something else, or the connection broke.
            OSError: the file no longer exists or may not be read.
        """
        self.requests += len(ranges)
        try:
            parts = self._parts(ranges)
        except StoreError as error:
            raise self._fault(str(error)) from None
        for (start, stop), part in zip(ranges, parts, strict=True):
            self.bytes_read += len(part)
            if len(part) != stop - start:
                raise self._fault(f"{self.name} returned {len(part)} bytes from byte {start}, expected {stop - start}")
        return parts

    def changed(self) -> str:
        """Return an error message if the file has changed since it was opened, otherwise ""."""
        return f"{self.name} has changed while it was read: open it again" if self._is_other() else ""

    def _fault(self, message: str) -> StoreError:
        """Return the error for unexpected data, which says that the file has changed if it has."""
        try:
            return StoreError(self.changed() or message)
        except (StoreError, OSError):
            return StoreError(message)

    @contextmanager
    def named_errors(self) -> Iterator[None]:
        """Add the file's name to errors, and report a changed file as such."""
        try:
            yield
        except CsplatError as error:
            if isinstance(error, FormatError) and (changed := self.changed()):
                raise StoreError(changed) from None
            error.path = error.path or self.name or None
            raise

    def whole(self) -> bytes | memoryview | mmap | None:
        """Return all bytes if they are in memory or can be mapped, otherwise `None`."""
        return None

    def close(self) -> None:
        """Release the file."""

    def _parts(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Read the bytes of each range (start, stop); a part that is too short is reported by `read`."""
        raise NotImplementedError

    def _is_other(self) -> bool:
        """Return True if the file has changed since it was opened."""
        return False


class MemoryStore(Store):
    """A file in memory: bytes, or an open file, which is read to its end."""

    def __init__(self, file: File) -> None:
        self._view = view_of(file)
        name = file if isinstance(file, (str, os.PathLike)) else getattr(file, "name", None)
        super().__init__(os.fspath(name) if isinstance(name, (str, os.PathLike)) else "", len(self._view))

    def whole(self) -> memoryview:
        """Return the bytes."""
        return self._view

    def _parts(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        return [bytes(self._view[start:stop]) for start, stop in ranges]


class DiskStore(Store):
    """A file on disk. Parts are not read from a mapping: truncating a mapped file would kill the process."""

    def __init__(self, path: Path) -> None:
        self._file = open_binary(path)
        self._stat = os.fstat(self._file.fileno())
        super().__init__(str(path), self._stat.st_size)

    def whole(self) -> bytes | mmap:
        """Map the file."""
        return map_file(self.name)

    def _parts(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        with named_errors(self.name):
            return [read_at(self._file.fileno(), stop - start, start) for start, stop in ranges]

    def _is_other(self) -> bool:
        now = os.fstat(self._file.fileno())
        return (now.st_size, now.st_mtime_ns) != (self._stat.st_size, self._stat.st_mtime_ns)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class FileWindow:
    """A sparse view of a file: bytes that were not fetched are 0 and take no memory.

    Attributes:
        view: the file's bytes, at their offsets in the file.
        store: the file.

    Args:
        store: the file.
        head: beginning of the file, if it was read before.
    """

    def __init__(self, store: Store, head: bytes = b"") -> None:
        self.store = store
        self._head = head
        self._here = [(0, len(head))]
        try:
            self._pages = Pages(store.size) if store.size else None
        except (OSError, OverflowError):
            raise LimitError("address space of this machine", store.size) from None
        # Wrapped in an array, so that `PageReleaser` does not mistake it for a mapped file and drop its pages.
        self.view = np.frombuffer(self._pages.buffer if self._pages else bytearray(), np.uint8).data
        self.view[: len(head)] = head

    def fetch(self, parts: Iterable[tuple[int, int]]) -> None:
        """Read the parts that are not present yet, adjacent parts in one request.

        Args:
            parts: (offset, size) of each part.

        Raises:
            StoreError, OSError: as in `Store.read`.
        """
        sizes = self.store.sizes
        missing = _find_missing(((at, at + size) for at, size in parts), self._here)
        waiting: list[tuple[int, int]] = []
        for start, stop in _find_missing(_join_ranges(missing, sizes.gap), self._here):
            for at in range(start, stop, sizes.request):
                waiting.append((at, min(at + sizes.request, stop)))
                if len(waiting) == sizes.at_once:
                    self._read_ranges(waiting)
                    waiting = []
        self._read_ranges(waiting)

    def forget(self) -> None:
        """Discard all fetched parts except the head."""
        if self._pages is not None:
            self._pages.discard()
        self.view[: len(self._head)] = self._head
        self._here = [(0, len(self._head))]

    def _read_ranges(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Read ranges (start, stop) into the view, and mark them as present."""
        if not ranges:
            return
        for (start, stop), data in zip(ranges, self.store.read(ranges), strict=True):
            self.view[start:stop] = data
        self._here = _join_ranges([*self._here, *ranges])


def _join_ranges(ranges: Iterable[tuple[int, int]], gap: int = 0) -> list[tuple[int, int]]:
    """Sort ranges, and join ranges that are at most `gap` bytes apart."""
    runs: list[tuple[int, int]] = []
    for start, stop in sorted(ranges):
        if runs and start - runs[-1][1] <= gap:
            runs[-1] = runs[-1][0], max(runs[-1][1], stop)
        else:
            runs.append((start, stop))
    return runs


def _find_missing(ranges: Iterable[tuple[int, int]], present: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Yield the parts of `ranges` that no range of `present` covers; `present` is sorted."""
    for start, stop in ranges:
        for first, end in present:
            if start < end and first < stop:
                if start < first:
                    yield start, first
                start = end  # noqa: PLW2901  # the rest
        if start < stop:
            yield start, stop
