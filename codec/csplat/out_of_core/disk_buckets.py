# SPDX-License-Identifier: Apache-2.0
"""Sort the splats of a scene into buckets in a working folder, from which an interrupted encoding continues.

Each section of the bucket curve has a spill file; a large section is split into several buckets, which are ranges of
its splats. A spill file is a sequence of frames: number of splats, CRC, and a record of all values of each splat. Files
use the byte order of the machine, because the same machine reads them.
"""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import atomic_writer, check_free_space
from csplat.encoder.buckets import BucketCurve, SceneSurvey, bucket_slices, contrast_buckets, sample_rows
from csplat.encoder.coding_parameters import contrast_of, contrast_sums
from csplat.encoder.sh_codebook import largest_sh
from csplat.errors import InputError
from csplat.file_source import open_binary, read_bytes
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.types import Progress

Records = NDArray[np.void]

#: Bytes of splats in memory before they are written to their spill files.
PENDING_BYTES = 96_000_000

_FRAME = struct.Struct("<QI")  # splats, CRC-32 of the records
_FRAME_SPLATS = 1 << 12  # maximum number of splats in a frame; their records (1 MB) stay in the cache
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
_STATE, _SAMPLE = "state.json", "sample"
_STATE_FIELDS = ("counts", "largest_sh", "contrast")  # attributes of `DiskBuckets`, written once the scene is sorted


@dataclass(frozen=True)
class Bucket:
    """A bucket: splats that are coded together.

    Attributes:
        index: index among all buckets.
        section: index of the spill file with its splats.
        start, stop: range of its splats in that file.
    """

    index: int
    section: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class DiskBuckets:
    """A bucket store on disk.

    Attributes:
        folder: path of the working folder.
        model: the scene without splats.
        bucket_splats: maximum number of splats in a bucket.
        counts: number of splats in each section.
        largest_sh, contrast: see `SceneSurvey`.
    """

    folder: Path
    model: SplatModel
    bucket_splats: int
    counts: list[int]
    largest_sh: float
    contrast: float

    @classmethod
    def of(
        cls,
        scene: Scene,
        folder: Path,
        key: dict[str, Any],
        *,
        bucket_splats: int,
        resume: bool,
        disk_bytes: int,
        progress: Progress,
    ) -> DiskBuckets:
        """Sort a scene, or continue from a folder in which it is sorted.

        Args:
            scene: the scene; its extra columns are kept.
            folder: a new or empty folder.
            key: identity of scene and options, JSON-compatible.
            bucket_splats: see `EncodeOptions`.
            resume: continue from the content of the folder if it exists.
            disk_bytes: free space that the encoding needs.
            progress: called with the stage and the completed fraction of it.

        Raises:
            InputError: the folder exists and `resume` is False, it belongs to another scene or other options, or it has
                other content; the disk is too small; the scene has another number of splats than it declares.
            CsplatError: the scene cannot be read.
            OSError: a file cannot be read or written.
        """
        done = _read_state(folder, key, resume=resume)
        if done is not None:
            return cls(folder, scene.empty(), bucket_splats, **done)
        for path in folder.glob("section-*"):  # an interrupted sort starts again
            path.unlink()
        check_free_space(
            folder if folder.exists() else folder.parent,
            disk_bytes,
            "this scene is encoded: --work names another folder",
        )
        folder.mkdir(exist_ok=True)
        _write_json(folder / _STATE, {"key": key})
        store = _sort(scene, folder, bucket_splats, progress)
        _write_json(folder / _STATE, {"key": key, **{name: getattr(store, name) for name in _STATE_FIELDS}})
        return store

    @property
    def rows(self) -> tuple[()]:
        """No rows, see `BucketStore`."""
        return ()

    @property
    def buckets(self) -> list[Bucket]:
        """All buckets, in the order of the output file."""
        parts = [
            (section, part)
            for section, count in enumerate(self.counts) if count
            for part in bucket_slices(count, self.bucket_splats)
        ]  # fmt: skip
        return [Bucket(index, section, part.start, part.stop) for index, (section, part) in enumerate(parts)]

    def survey(self) -> SceneSurvey:
        """Survey the scene.

        Raises:
            InputError: the file with the sample is damaged.
            OSError: it cannot be read.
        """
        count = sum(self.counts)
        sample = _read_range(self.folder / _SAMPLE, self.model, 0, len(sample_rows(count, self.bucket_splats)))
        return SceneSurvey(sample, count, self.largest_sh, self.contrast)

    def remove_section(self, section: int) -> None:
        """Remove a spill file whose buckets are coded."""
        _section_path(self.folder, section).unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the folder after the output is complete."""
        with suppress(OSError):
            shutil.rmtree(self.folder)


def read_bucket(folder: Path, model: SplatModel, bucket: Bucket) -> SplatModel:
    """Read the splats of a bucket.

    Args:
        folder: the working folder.
        model: the scene without splats.
        bucket: the bucket.

    Raises:
        InputError: the file is damaged.
        OSError: the file cannot be read.
    """
    return _read_range(_section_path(folder, bucket.section), model, bucket.start, bucket.stop)


def write_splats(path: Path, model: SplatModel) -> None:
    """Write splats to a file of the working folder, which appears when complete.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_writer(path) as stream:
        _write_frames(stream, _records(model, np.arange(len(model)), _record_type(model)))


def read_splats(path: Path, model: SplatModel, count: int) -> SplatModel:
    """Read splats that `write_splats` wrote.

    Args:
        path: the file.
        model: a scene of the same attributes, whose metadata is returned.
        count: number of splats.

    Raises:
        InputError: the file is damaged.
        OSError: it cannot be read.
    """
    return _read_range(path, model, 0, count)


def splat_bytes(model: SplatModel) -> int:
    """Return the size of a splat in a spill file."""
    return _record_type(model).itemsize


def damaged_file(path: Path) -> InputError:
    """Return the error for a damaged file of the working folder."""
    return InputError(f"{path} is damaged: remove {path.parent.name} and start again")


def _read_state(folder: Path, key: dict[str, Any], *, resume: bool) -> dict[str, Any] | None:
    """Read the state file of a working folder.

    Args:
        folder: the folder, which need not exist.
        key: identity of scene and options, with which the folder must have been started.
        resume: False refuses a folder that has a state file.

    Returns:
        `_STATE_FIELDS` by name; `None` if the scene is not sorted yet, or the folder is empty or does not exist.

    Raises:
        InputError: the folder has other content, may not be continued, has another key, or is damaged.
    """
    path = folder / _STATE
    if not path.exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} is not empty: the working folder is removed afterwards, choose a new one")
        return None
    if not resume:
        raise InputError(f"{folder} is left from an interrupted encoding: continue with `--resume`, or remove it")
    try:
        state = json.loads(read_bytes(path))
        previous = state.pop("key")
    except (ValueError, TypeError, KeyError):
        raise damaged_file(path) from None
    for name, value in key.items():
        if previous.get(name) != value:
            raise InputError(
                f"{folder} was started with {name} {previous.get(name)}, now {value}: continue with the former {name}, "
                "or remove the folder to start again"
            )
    if state and tuple(state) != _STATE_FIELDS:
        raise damaged_file(path)
    return state or None


def _write_json(path: Path, value: Any) -> None:
    """Write a value as JSON; an existing file is replaced when the new one is complete."""
    with atomic_writer(path) as stream:
        stream.write(json.dumps(value).encode())


def _sort(scene: Scene, folder: Path, bucket_splats: int, progress: Progress) -> DiskBuckets:
    """Read the scene twice: survey it, then sort its splats into spill files; write both to `folder`, which exists.

    The contrast is measured at the end, on a few of the sorted buckets, because it requires neighbouring splats.
    """
    curve, largest = _survey(scene.with_progress("looking", progress), folder, bucket_splats)
    counts = _spill(scene.with_progress("sorting", progress), folder, curve)
    store = DiskBuckets(folder, scene.empty(), bucket_splats, counts, largest, 0.0)
    chosen = contrast_buckets(store.buckets)
    parts = (contrast_sums(read_bucket(folder, store.model, bucket)) for bucket in chosen)
    return replace(store, contrast=contrast_of(parts))


def _survey(scene: Scene, folder: Path, bucket_splats: int) -> tuple[BucketCurve, float]:
    """Read the scene once, and write its sample to the file `_SAMPLE` of the folder.

    Returns:
        The bucket curve through the sample; the largest magnitude of all SH coefficients of the scene.
    """
    rows = sample_rows(scene.count, bucket_splats)
    largest = 0.0
    sample = np.empty(len(rows), _record_type(scene.empty()))
    for span, block in scene.numbered():
        first, last = np.searchsorted(rows, (span.start, span.stop))  # the part of the sample in this block
        sample[first:last] = _records(block, rows[first:last] - span.start, sample.dtype)
        largest = max(largest, largest_sh(block.shN))
    with open_binary(folder / _SAMPLE, "w") as stream:
        _write_frames(stream, sample)
    return BucketCurve.through(np.ascontiguousarray(sample["means"]), scene.count, bucket_splats), largest


def _spill(scene: Scene, folder: Path, curve: BucketCurve) -> list[int]:
    """Read the scene once, and append each splat to the spill file of its section, in the scene's order.

    At most `PENDING_BYTES` of splats, or one block, wait in memory; each flush appends to every section that has some.

    Returns:
        The number of splats in each section, 0 for a section without a file.
    """
    dtype = _record_type(scene.empty())
    counts = np.zeros(curve.count, np.int64)
    pending: list[list[Records]] = [[] for _ in range(curve.count)]  # by section
    pending_bytes = 0

    def flush() -> None:
        """Append the pending records to their files, and empty `pending`."""
        for section, parts in enumerate(pending):
            if parts:
                _append(_section_path(folder, section), np.concatenate(parts))
                parts.clear()

    for block in scene.blocks():
        pending_bytes += len(block) * dtype.itemsize
        if pending_bytes > PENDING_BYTES:
            flush()
            pending_bytes = len(block) * dtype.itemsize
        sections = curve.bucket_of(block.means)
        sizes = np.bincount(sections, minlength=curve.count)
        records = _records(block, np.argsort(sections, kind="stable"), dtype)
        for section, part in enumerate(np.split(records, np.cumsum(sizes)[:-1])):
            if len(part):
                pending[section].append(part)
        counts += sizes
    flush()
    section_sizes: list[int] = counts.tolist()
    return section_sizes


def _section_path(folder: Path, section: int) -> Path:
    """Return the path of the spill file of a section."""
    return folder / f"section-{section:06}"


def _arrays(model: SplatModel) -> dict[str, NDArray[Any]]:
    """Return the arrays of a model, [N, ...], by the name of their field in a record; extra columns have a prefix."""
    doubles = {} if model.means_double is None else {"means_double": model.means_double}
    return {
        **{name: getattr(model, name) for name in _ARRAYS},
        **doubles,
        **{f"extra {name}": array for name, array in model.extra.items()},
    }


def _record_type(model: SplatModel) -> np.dtype[np.void]:
    """Return the type of a record: all values of one splat of a model, which may be without splats."""
    return np.dtype([(name, array.dtype, array.shape[1:]) for name, array in _arrays(model).items()])


def _records(model: SplatModel, rows: NDArray[Any], dtype: np.dtype[Any]) -> Records:
    """Return records, [n], of the splats `rows` [n], without extra columns that the type does not have."""
    records = np.empty(len(rows), dtype)
    arrays = _arrays(model)
    for start in range(0, len(rows), _FRAME_SPLATS):
        part = slice(start, start + _FRAME_SPLATS)
        for name in dtype.names or ():
            records[part][name] = np.take(arrays[name], rows[part], axis=0)
    return records


def _append(path: Path, records: Records) -> None:
    """Append records to a spill file as frames; the file is made if it does not exist."""
    with open_binary(path, "a") as stream:
        _write_frames(stream, records)


def _write_frames(stream: BinaryIO, records: Records) -> None:
    """Write records as frames of at most `_FRAME_SPLATS` splats; none for no records."""
    for start in range(0, len(records), _FRAME_SPLATS):
        data = records[start : start + _FRAME_SPLATS].view(np.uint8).data
        stream.write(_FRAME.pack(len(data) // records.itemsize, zlib.crc32(data)))
        stream.write(data)


def _frames(path: Path, dtype: np.dtype[Any]) -> Iterator[Records]:
    """Yield the records of each frame of a file, in their order.

    Raises:
        InputError: a frame is cut off, or its CRC differs.
        OSError: the file cannot be read.
    """
    remaining_bytes = path.stat().st_size
    with open_binary(path) as stream:
        while remaining_bytes:
            head = stream.read(_FRAME.size)
            if len(head) < _FRAME.size:
                raise damaged_file(path)
            count, crc = _FRAME.unpack(head)
            remaining_bytes -= _FRAME.size + count * dtype.itemsize
            if remaining_bytes < 0:  # before `count` is used to allocate
                raise damaged_file(path)
            records = np.empty(count, dtype)
            data = records.view(np.uint8).data
            if stream.readinto(data) != len(data) or zlib.crc32(data) != crc:
                raise damaged_file(path)
            yield records


def _read_range(path: Path, model: SplatModel, start: int, stop: int) -> SplatModel:
    """Read the splats `start` to `stop` - 1 of a file.

    Args:
        path: the file, a sequence of frames, which are read and checked up to `stop`.
        model: a scene with the arrays of the file, whose metadata is returned.
        start, stop: the range, splats.

    Raises:
        InputError: the file is damaged or has fewer than `stop` splats.
        OSError: it cannot be read.
    """
    frame_start = 0  # index in the file of the frame's first splat
    filled = 0  # splats read so far
    arrays: dict[str, Any] = {
        name: np.empty((stop - start, *array.shape[1:]), array.dtype) for name, array in _arrays(model).items()
    }
    for frame in _frames(path, _record_type(model)):
        records = frame[max(0, start - frame_start) : max(0, stop - frame_start)]
        for name, array in arrays.items():
            array[filled : filled + len(records)] = records[name]
        frame_start += len(frame)
        filled += len(records)
        if frame_start >= stop:
            break
    if filled < stop - start:
        raise damaged_file(path)
    return replace(model, extra={name: arrays.pop(f"extra {name}") for name in model.extra}, **arrays)
