"""Keep the state of an encoding in a working folder: splats in spill files, and progress for resuming.

Each section of the bucket curve has a spill file. A large section is split into several buckets, which are ranges of
rows in its file. A spill file is a sequence of frames. A frame consists of the number of its splats, a CRC, and the
arrays of a model one after the other. Files use the byte order of the machine, which is also the one that reads them.
"""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import atomic_writer
from csplat.encoder.tiling import BucketCurve, bucket_slices
from csplat.errors import InputError
from csplat.model import SplatModel

_FRAME = struct.Struct("<QI")  # rows, CRC-32 of the arrays
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@dataclass(frozen=True, eq=False)
class SplatLayout:
    """Names and dtypes of a model's arrays.

    Attributes:
        metadata_model: a model without splats that has all other fields.
    """

    metadata_model: SplatModel

    def arrays(self, model: SplatModel) -> list[NDArray[Any]]:
        """Return the arrays of a model, in the order of a frame."""
        doubles = [] if model.means_double is None else [model.means_double]
        return [
            *(getattr(model, name) for name in _ARRAYS),
            *doubles,
            *(model.extra[name] for name in self.metadata_model.extra),
        ]

    @property
    def row_bytes(self) -> int:
        """Size of a splat in bytes."""
        return sum(array.dtype.itemsize * int(np.prod(array.shape[1:])) for array in self.arrays(self.metadata_model))

    def empty(self, count: int) -> list[NDArray[Any]]:
        """Allocate uninitialised arrays for `count` splats."""
        return [np.empty((count, *array.shape[1:]), array.dtype) for array in self.arrays(self.metadata_model)]

    def model(self, arrays: Sequence[NDArray[Any]]) -> SplatModel:
        """Build a model from arrays in the order of a frame."""
        named: dict[str, Any] = dict(zip(_ARRAYS, arrays, strict=False))
        rest = list(arrays[len(_ARRAYS) :])
        doubles = None if self.metadata_model.means_double is None else rest.pop(0)
        return replace(
            self.metadata_model,
            **named,
            means_double=doubles,
            extra=dict(zip(self.metadata_model.extra, rest, strict=True)),
        )


@dataclass(frozen=True)
class Bucket:
    """A bucket: splats that are coded together.

    Attributes:
        index: index among all buckets.
        file_index: index of the spill file with its splats.
        start, stop: range of its rows in that file.
    """

    index: int
    file_index: int
    start: int
    stop: int

    @property
    def rows(self) -> slice:
        """The bucket's rows in its spill file."""
        return slice(self.start, self.stop)


@dataclass(frozen=True, eq=False)
class Survey:
    """The results of one pass over all splats of a scene.

    Attributes:
        sample: a sample of the splats, in the scene's order.
        largest: largest magnitude of all SH coefficients.
        curve: the curve that assigns splats to buckets.
    """

    sample: SplatModel
    largest: float
    curve: BucketCurve


@dataclass(eq=False)
class SpillWriter:
    """A buffered writer that appends splats to spill files.

    Attributes:
        folder: an existing folder without spill files.
        layout: layout of the splats.
        curve: the curve that assigns splats to files.
        pending_bytes_max: maximum size of the buffer.
        counts: [files], number of splats added so far.
    """

    folder: Path
    layout: SplatLayout
    curve: BucketCurve
    pending_bytes_max: int
    counts: NDArray[np.int64] = field(init=False)
    _pending: list[list[list[NDArray[Any]]]] = field(init=False)
    _pending_bytes: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self.counts = np.zeros(self.curve.count, np.int64)
        self._pending = [[] for _ in range(self.curve.count)]

    def add(self, model: SplatModel) -> None:
        """Add splats; within a file they keep their order.

        Raises:
            OSError: the splats cannot be written.
        """
        file_indices = self.curve.bucket_of(model.means)
        order = np.argsort(file_indices, kind="stable")
        sizes = np.bincount(file_indices, minlength=self.curve.count)
        arrays = [array[order] for array in self.layout.arrays(model)]
        start = 0
        for file_index in np.flatnonzero(sizes):
            end = start + int(sizes[file_index])
            self._pending[file_index].append([array[start:end] for array in arrays])
            start = end
        self.counts += sizes
        self._pending_bytes += sum(array.nbytes for array in arrays)
        if self._pending_bytes > self.pending_bytes_max:
            self.flush()

    def flush(self) -> None:
        """Write all pending splats.

        Raises:
            OSError: the splats cannot be written.
        """
        for file_index, pending in enumerate(self._pending):
            if pending:
                with spill_path(self.folder, file_index).open("ab") as stream:
                    _append(stream, [np.concatenate(parts) for parts in zip(*pending, strict=True)])
                pending.clear()
        self._pending_bytes = 0


def spill_path(folder: Path, file_index: int) -> Path:
    """Return the path of a spill file."""
    return folder / f"bucket-{file_index:06}"


def read_splats(path: Path, layout: SplatLayout, part: slice | None = None) -> SplatModel:
    """Read the splats of a file, or a range of them.

    Raises:
        InputError: the file is damaged.
        OSError: the file cannot be read.
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


def _sizes(stream: Any, path: Path, layout: SplatLayout) -> Iterator[int]:
    """Yield the number of rows of each frame."""
    size, at = path.stat().st_size, 0
    while at < size:
        stream.seek(at)
        head = stream.read(_FRAME.size)
        if len(head) < _FRAME.size:
            raise damaged_file(path)
        rows, _ = _FRAME.unpack(head)
        at += _FRAME.size + rows * layout.row_bytes
        if at > size:
            raise damaged_file(path)
        yield rows


def _read_frame(stream: Any, path: Path, frame: Sequence[NDArray[Any]]) -> None:
    """Read the next frame into arrays."""
    found, crc = _FRAME.unpack(stream.read(_FRAME.size)), 0
    for array in frame:
        view = array.reshape(-1).view(np.uint8)
        stream.readinto(view)
        crc = zlib.crc32(view.data, crc)
    if found != (len(frame[0]), crc):
        raise damaged_file(path)


def damaged_file(path: Path) -> InputError:
    """Return the error for a damaged file of the working folder."""
    return InputError(f"{path} is damaged: remove {path.parent.name} and start again")


_STATE = "state.json"
_SAMPLE = "sample"


@dataclass(frozen=True, eq=False)
class EncodingState:
    """The progress of an encoding. Fields of later stages are `None` until their stage is complete.

    Attributes:
        key: identifies scene and options, JSON-compatible.
        curve: the curve of the survey; known after the first pass.
        largest: largest magnitude of all SH coefficients; known after the first pass.
        counts: number of splats in each spill file; known after the second pass.
        contrast: contrast of the scene; measured after the second pass.
    """

    key: dict[str, Any]
    curve: BucketCurve | None = None
    largest: float | None = None
    counts: list[int] | None = None
    contrast: float | None = None

    def to_json(self) -> bytes:
        """Format the known fields as JSON."""
        stored: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        if (curve := self.curve) is not None:
            bounds = curve.bounds.tolist()
            stored["curve"] = {"corner": curve.corner.tolist(), "scale": curve.scale, "bounds": bounds}
        return json.dumps(stored).encode()

    @classmethod
    def from_json(cls, data: bytes) -> EncodingState:
        """Parse the JSON of `to_json`.

        Raises:
            ValueError, TypeError, KeyError: the data is damaged.
        """
        state = cls(**json.loads(data))
        if state.curve is None:
            return state
        stored: Any = state.curve
        curve = BucketCurve(np.array(stored["corner"]), stored["scale"], np.array(stored["bounds"], np.int64))
        return replace(state, curve=curve)


@dataclass(eq=False)
class WorkingFolder:
    """A working folder: the state of an encoding that can be resumed.

    Attributes:
        folder: path of the folder.
        layout: layout of the splats in it.
        state: progress so far, as in the folder's state file.
    """

    folder: Path
    layout: SplatLayout
    state: EncodingState

    @classmethod
    def create(cls, folder: Path, layout: SplatLayout, key: dict[str, Any], *, resume: bool) -> WorkingFolder:
        """Create a folder, or open an existing one to resume.

        Raises:
            InputError: the folder exists and `resume` is False, it belongs to another scene or other options, or it
                has other content.
            OSError: the folder cannot be created or read.
        """
        if (folder / _STATE).exists():
            if not resume:
                raise InputError(
                    f"{folder} is left from an interrupted encoding: continue with `--resume`, or remove it"
                )
            try:
                state = EncodingState.from_json((folder / _STATE).read_bytes())
            except (ValueError, TypeError, KeyError):
                raise damaged_file(folder / _STATE) from None
            for name, value in key.items():
                if (found := state.key.get(name)) != value:
                    raise InputError(
                        f"{folder} was started with {name} {found}, now {value}: continue with the former {name}, "
                        "or remove the folder to start again"
                    )
            return cls(folder, layout, state)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} is not empty: the working folder is removed afterwards, choose a new one")
        folder.mkdir(exist_ok=True)
        work = cls(folder, layout, EncodingState(key))
        work.record_progress()
        return work

    def record_progress(self, **done: Any) -> None:
        """Set fields of the state and write the state file.

        Raises:
            OSError: the state cannot be written.
        """
        self.state = replace(self.state, **done)
        with atomic_writer(self.folder / _STATE) as stream:
            stream.write(self.state.to_json())

    def read_survey(self) -> Survey | None:
        """Read the results of the first pass; return `None` if it is not complete.

        Raises:
            InputError: the sample file is damaged.
            OSError: the sample file cannot be read.
        """
        if self.state.curve is None or self.state.largest is None:
            return None
        return Survey(read_splats(self.folder / _SAMPLE, self.layout), self.state.largest, self.state.curve)

    def write_survey(self, survey: Survey) -> None:
        """Record the results of the first pass.

        Raises:
            OSError: they cannot be written.
        """
        with (self.folder / _SAMPLE).open("wb") as stream:
            _append(stream, self.layout.arrays(survey.sample))
        self.record_progress(curve=survey.curve, largest=survey.largest)

    @property
    def buckets(self) -> list[Bucket]:
        """All buckets in the order of the output file; known after the second pass."""
        assert self.state.counts is not None
        parts = [
            (file_index, part)
            for file_index, count in enumerate(self.state.counts)
            if count
            for part in bucket_slices(count)
        ]
        return [Bucket(index, file_index, part.start, part.stop) for index, (file_index, part) in enumerate(parts)]

    def clear_spill_files(self) -> None:
        """Remove the spill files of an interrupted second pass."""
        for path in self.folder.glob("bucket-*"):
            path.unlink()

    def remove_spill_file(self, bucket: Bucket, left: Sequence[Bucket]) -> None:
        """Remove the spill file of a coded bucket unless buckets in `left`, which are not coded, share it."""
        if all(other.file_index != bucket.file_index for other in left):
            spill_path(self.folder, bucket.file_index).unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the folder after the output is complete."""
        with suppress(OSError):
            shutil.rmtree(self.folder)
