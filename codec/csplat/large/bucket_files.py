"""Splats on disk: a file for each bucket, to which rows are appended, and which is read as a whole.

A file is a row of frames. A frame has the number of its splats, a CRC, and then each array of a model one after the
other, so that nothing has to be taken apart. The files are read by the machine that wrote them, in its own byte order.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.tiling import BucketCurve
from csplat.errors import InputError
from csplat.model import SplatModel

_FRAME = struct.Struct("<QI")  # rows, CRC-32 of the arrays
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@dataclass(frozen=True, eq=False)
class Layout:
    """Names and dtypes of a model's arrays.

    Attributes:
        facts: a model without splats that holds everything else.
    """

    facts: SplatModel

    def arrays(self, model: SplatModel) -> list[NDArray[Any]]:
        """The arrays of a model, in the order of a frame."""
        doubles = [] if model.means_double is None else [model.means_double]
        return [
            *(getattr(model, name) for name in _ARRAYS),
            *doubles,
            *(model.extra[name] for name in self.facts.extra),
        ]

    @property
    def row_bytes(self) -> int:
        """Bytes of a splat."""
        return sum(array.dtype.itemsize * int(np.prod(array.shape[1:])) for array in self.arrays(self.facts))

    def empty(self, count: int) -> list[NDArray[Any]]:
        """Arrays of that many splats, to be filled."""
        return [np.empty((count, *array.shape[1:]), array.dtype) for array in self.arrays(self.facts)]

    def model(self, arrays: Sequence[NDArray[Any]]) -> SplatModel:
        """A model of these arrays."""
        named: dict[str, Any] = dict(zip(_ARRAYS, arrays, strict=False))
        rest = list(arrays[len(_ARRAYS) :])
        doubles = None if self.facts.means_double is None else rest.pop(0)
        return replace(self.facts, **named, means_double=doubles, extra=dict(zip(self.facts.extra, rest, strict=True)))


@dataclass(eq=False)
class BucketWriter:
    """Appends splats to the files of their buckets.

    Attributes:
        folder: folder of the files; it exists, and holds none of them.
        layout: layout of the splats.
        curve: the curve that determines a splat's bucket.
        room_bytes: bytes of splats that wait for being written, at most.
    """

    folder: Path
    layout: Layout
    curve: BucketCurve
    room_bytes: int
    counts: NDArray[np.int64] = field(init=False)
    _waiting: list[list[list[NDArray[Any]]]] = field(init=False)
    _waiting_bytes: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self.counts = np.zeros(self.curve.count, np.int64)
        self._waiting = [[] for _ in range(self.curve.count)]

    def add(self, model: SplatModel) -> None:
        """Take some splats, those of a bucket in the order in which they come.

        Raises:
            OSError: they cannot be written.
        """
        bucket = self.curve.bucket_of(model.means)
        order = np.argsort(bucket, kind="stable")
        sizes = np.bincount(bucket, minlength=self.curve.count)
        arrays = [array[order] for array in self.layout.arrays(model)]
        start = 0
        for place in np.flatnonzero(sizes):
            end = start + int(sizes[place])
            self._waiting[place].append([array[start:end] for array in arrays])
            start = end
        self.counts += sizes
        self._waiting_bytes += sum(array.nbytes for array in arrays)
        if self._waiting_bytes > self.room_bytes:
            self.flush()

    def flush(self) -> None:
        """Write what waits.

        Raises:
            OSError: it cannot be written.
        """
        for place, waiting in enumerate(self._waiting):
            if waiting:
                with bucket_path(self.folder, place).open("ab") as stream:
                    _append(stream, [np.concatenate(parts) for parts in zip(*waiting, strict=True)])
                waiting.clear()
        self._waiting_bytes = 0


def bucket_path(folder: Path, place: int) -> Path:
    """The file of a bucket."""
    return folder / f"bucket-{place:06}"


def write_splats(path: Path, layout: Layout, model: SplatModel) -> None:
    """Write splats to a file of their own.

    Raises:
        OSError: they cannot be written.
    """
    with path.open("wb") as stream:
        _append(stream, layout.arrays(model))


def read_splats(path: Path, layout: Layout, part: slice | None = None) -> SplatModel:
    """Read the splats of a file, or a part of them.

    Raises:
        InputError: the file is damaged.
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        sizes = list(_sizes(stream, path, layout))
        chosen = part or slice(0, sum(sizes))
        out, start = layout.empty(chosen.stop - chosen.start), 0
        stream.seek(0)
        for rows in sizes:
            low, high = max(chosen.start, start), min(chosen.stop, start + rows)
            wanted = [array[low - chosen.start : high - chosen.start] for array in out] if low < high else []
            frame = wanted if high - low == rows else layout.empty(rows)
            _read_frame(stream, path, frame)
            if frame is not wanted:
                for array, values in zip(wanted, frame, strict=False):
                    array[:] = values[low - start : high - start]
            start += rows
    return layout.model(out)


def _append(stream: Any, arrays: Sequence[NDArray[Any]]) -> None:
    arrays = [np.ascontiguousarray(array) for array in arrays]
    crc = 0
    for array in arrays:
        crc = zlib.crc32(array.reshape(-1).view(np.uint8).data, crc)
    stream.write(_FRAME.pack(len(arrays[0]), crc))
    for array in arrays:
        stream.write(array.reshape(-1).view(np.uint8).data)


def _sizes(stream: Any, path: Path, layout: Layout) -> Iterator[int]:
    """Rows of each frame."""
    size, at = path.stat().st_size, 0
    while at < size:
        stream.seek(at)
        head = stream.read(_FRAME.size)
        if len(head) < _FRAME.size:
            raise damaged(path)
        rows, _ = _FRAME.unpack(head)
        at += _FRAME.size + rows * layout.row_bytes
        if at > size:
            raise damaged(path)
        yield rows


def _read_frame(stream: Any, path: Path, frame: Sequence[NDArray[Any]]) -> None:
    """Fill arrays with the next frame."""
    found, crc = _FRAME.unpack(stream.read(_FRAME.size)), 0
    for array in frame:
        view = array.reshape(-1).view(np.uint8)
        stream.readinto(view)
        crc = zlib.crc32(view.data, crc)
    if found != (len(frame[0]), crc):
        raise damaged(path)


def damaged(path: Path) -> InputError:
    """Return the error for a file of the working folder that is not as it was written."""
    return InputError(f"{path} is damaged: remove {path.parent.name} and begin again")
