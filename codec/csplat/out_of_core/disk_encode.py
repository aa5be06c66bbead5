"""Encode a scene of any size to a file: in memory if it fits, otherwise in buckets on disk."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat import __version__
from csplat.disk_files import atomic_writer
from csplat.encoder import EncodedTiles, EncodeOptions, EncodePlan, EncodeReport, Origin, encode_tiles
from csplat.encoder.container import FileNode, order_nodes
from csplat.encoder.error_bounds import ErrorSums
from csplat.encoder.levels import LevelBuilder, encode_coarse
from csplat.encoder.pipeline import EncodedTile
from csplat.errors import InputError
from csplat.out_of_core.bucket_workers import (
    BucketCoding,
    code_buckets,
    coded_path,
    read_coded,
    roots_path,
)
from csplat.out_of_core.disk_buckets import PENDING_BYTES, DiskBuckets, read_splats, splat_bytes
from csplat.scene import Scene
from csplat.system import default_memory_bytes
from csplat.types import Progress, null_progress

_MB = 1_000_000
_PROGRAM = 120 * _MB  # memory of a process that has loaded the encoder
_PER_ROW = 2.2  # memory for coding a bucket or sample, as a multiple of the size of its arrays
_WHOLE_ROW = 3.0  # memory for encoding a whole scene in memory, likewise
_CODED = 0.3  # maximum size of a file, as a multiple of the size of its arrays
#: By SH degree: seconds per million splats for one reading pass and for coding; seconds for a codebook. Within 10 % of
#: times measured with copies of fox120k at `balanced`: 10 M and 100 M splats of degree 0, 3 M of degrees 1, 2 and 3,
#: 30 M of degree 3. Degree 4 takes 1.13 times the CPU time of degree 3 (300,000 splats in memory).
_SECONDS = ((0.2, 3.1, 0.0), (0.35, 7.0, 8.0), (0.45, 7.3, 12.0), (0.55, 8.0, 20.0), (0.65, 9.0, 22.5))
# Levels of detail. Memory of each process for building the levels of a bucket: renders, a multiple of the size of its
# arrays, and bytes per splat. Size of the file relative to a file without levels.
_LEVEL_RENDERS, _LEVEL_ROWS, _LEVEL_SPLAT = 200 * _MB, 2.0, 600
_LEVEL_SIZE = 1.35
_NAME_BYTES_MAX = 250  # bytes of a file's name with which `.work` fits into the 255 of file systems
_NAME_PART = 60  # characters of a longer name that are kept: at most 240 bytes
#: Bytes per splat of a file, by preset and SH degree 0 to 4.
_FILE_BYTES = {
    "fast": (9.0, 9.5, 10.0, 11.0, 11.3),
    "balanced": (6.5, 8.0, 8.5, 9.0, 9.3),
    "small": (5.0, 6.5, 7.0, 7.5, 7.6),
}


@dataclass(frozen=True)
class OutOfCoreOptions:
    """Options for encoding scenes that may be larger than memory.

    Attributes:
        memory_bytes: limit of the memory of all processes together; `None`: half of the free memory. The file does not
            depend on it.
        folder: working folder; `None`: the path of the file with the suffix `.work`.
        resume: continue an interrupted encoding if the working folder exists.
        scheduler: address of a Dask scheduler whose workers code the buckets; they access the working folder under the
            same path.
        always: encode scenes of several buckets on disk, even if they fit in memory.
    """

    memory_bytes: int | None = None
    folder: str | os.PathLike[str] | None = None
    resume: bool = False
    scheduler: str | None = None
    always: bool = False

    def working_folder(self, target: str | os.PathLike[str]) -> Path:
        """Return the path of the working folder of a file; the name of a file of 251 to 255 bytes is shortened."""
        path = Path(target)
        name = path.name if len(os.fsencode(path.name)) <= _NAME_BYTES_MAX else path.name[:_NAME_PART]
        return path.with_name(f"{name}.work") if self.folder is None else Path(self.folder)


@dataclass(frozen=True)
class EncodingCost:
    """The expected cost of an encoding.

    Attributes:
        splats, sh_degree: number of splats and SH degree that will be encoded.
        in_memory: True if the scene stays in memory.
        workers: number of processes that code buckets, or of threads in memory.
        memory_bytes: approximate memory of all processes together.
        disk_bytes: maximum size of the working folder and the file.
        seconds: approximate time (`_SECONDS`).
        file_bytes: approximate size of the file at the preset's precision.
    """

    splats: int
    sh_degree: int
    in_memory: bool
    workers: int
    memory_bytes: int
    disk_bytes: int
    seconds: float
    file_bytes: int

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {**asdict(self), "seconds": round(self.seconds, 1)}


def estimate_cost(
    scene: Scene,
    options: EncodeOptions,
    limits: OutOfCoreOptions | None = None,
    levels: LevelBuilder | None = None,
) -> EncodingCost:
    """Estimate the cost of an encoding, and decide where it takes place.

    Args:
        scene: the scene; its blocks are not read.
        options: options of the encoder.
        limits: memory and disk.
        levels: builds levels of detail; `None`: the file has none.

    Raises:
        InputError: there is too little memory.
    """
    limits = limits or OutOfCoreOptions()
    count, degree = scene.count, options.kept_degree(scene.sh_degree)
    bound = default_memory_bytes() if limits.memory_bytes is None else limits.memory_bytes
    row = splat_bytes(_with_written_columns(scene, options).empty())
    workers, passes, disk = options.thread_count, 1, int(count * row * _CODED)
    per_bucket = min(count, options.bucket_splats)
    is_one = count <= (options.bucket_splats if levels is None else levels.whole_splats)
    building = 0 if levels is None else _building_bytes(count if is_one else per_bucket, row)
    memory = least = _PROGRAM + int(count * row * _WHOLE_ROW) + building
    # Building levels takes most of the time, and processes share it better than threads.
    in_memory = is_one or (levels is None and memory <= bound and not limits.always and limits.scheduler is None)
    if not in_memory:
        if options.shape_codebook_size:
            raise InputError(f"a codebook of shapes requires the scene in memory, about {memory / _MB:,.0f} MB")
        worker = _PROGRAM + int(per_bucket * row * _PER_ROW) + building
        memory = least = worker + PENDING_BYTES
        workers, passes, disk = max(1, min(workers, (bound - _PROGRAM) // worker)), 4, disk + count * row
        if workers > 1:
            memory = max(memory, _PROGRAM + workers * worker)
    if least > bound and not (in_memory and limits.memory_bytes is None):
        raise InputError(
            f"{bound / _MB:,.0f} MB of memory are too little for this scene, which requires {least / _MB:,.0f} MB"
        )
    read, code, book = _SECONDS[min(degree, 1) if options.preset == "fast" else degree]
    seconds = count / 1e6 * (read * passes + code / workers) + book * min(1.0, count / 5e5) / workers
    file_bytes = round(count * _FILE_BYTES[options.preset][degree])
    if levels is not None:
        seconds += levels.seconds(count) / (1 if is_one else workers)
        file_bytes = round(file_bytes * _LEVEL_SIZE)
    return EncodingCost(count, degree, in_memory, workers, memory, disk, seconds, file_bytes)


def _building_bytes(count: int, row: int) -> int:
    """Return the memory for building the levels of some splats together, in addition to encoding them."""
    return _LEVEL_RENDERS + int(count * (row * _LEVEL_ROWS + _LEVEL_SPLAT))


def encode_scene(
    scene: Scene,
    target: str | os.PathLike[str],
    options: EncodeOptions | None = None,
    limits: OutOfCoreOptions | None = None,
    *,
    levels: LevelBuilder | None = None,
    source: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> EncodeReport:
    """Encode a scene that is read block by block; the bytes are the same as with `encode`.

    A scene that does not fit in memory is sorted into buckets of neighbours in a working folder on disk. The buckets
    are coded one by one, by `options.threads` processes. If the encoding is interrupted, finished work stays in the
    folder. Scripts must guard their own code by `if __name__ == "__main__":`, because worker processes import it.

    Args:
        scene: the scene, for example from `csplat.open`.
        target: path of the file, which appears when complete.
        options: options of the encoder.
        limits: memory, disk and workers.
        levels: builds levels of detail (`csplat_tools.level_builder`); `None`: the file has none.
        source: identity of the scene, JSON-compatible; checked when resuming.
        progress: called with the stage and the completed fraction of it, 0 to 1.

    Returns:
        The chosen parameters and the error bounds that the file declares.

    Raises:
        InputError: as `encode`; the memory limit is too low; the disk is too small; the folder already exists,
            belongs to another scene or is damaged.
        CsplatError: the scene cannot be read.
        OSError: a file cannot be read or written; or a worker was killed.
    """
    options, limits, progress = options or EncodeOptions(), limits or OutOfCoreOptions(), progress or null_progress
    folder = limits.working_folder(target)
    if limits.resume and folder.exists():
        limits = replace(limits, always=True)
    cost = estimate_cost(scene, options, limits, levels)
    settings = {} if levels is None else {"levels": levels.settings(scene.count)}
    if cost.in_memory:
        if levels is None:
            encoded = encode_tiles(EncodePlan.of(scene.model(), options, progress=progress), progress=progress)
        else:
            plan = EncodePlan.of(scene.model(), options, progress=progress)
            encoded = levels.encode_plan(plan, progress=progress)
        with atomic_writer(target) as stream:
            return encoded.write_to(stream, settings, progress=progress)
    scene = _with_written_columns(scene, options)
    key = {
        "source": dict(source or {}),
        "options": options.chosen(),
        "splats": scene.count,
        "csplat": __version__,
        "levels": settings.get("levels"),
    }
    store = DiskBuckets.of(
        scene, folder, key, bucket_splats=options.bucket_splats, resume=limits.resume, disk_bytes=cost.disk_bytes,
        progress=progress,
    )  # fmt: skip
    encoded = _encode_buckets(store, options, cost.workers, limits.scheduler, levels, progress)
    with atomic_writer(target) as stream:
        report = encoded.write_to(stream, settings, progress=progress)
    store.remove()
    return report


def _with_written_columns(scene: Scene, options: EncodeOptions) -> Scene:
    """Return the scene without extra columns unless they are written; its blocks may still have them."""
    return scene if options.keep_extra else scene.changed(extra={})


def _encode_buckets(
    store: DiskBuckets,
    options: EncodeOptions,
    workers: int,
    scheduler: str | None,
    levels: LevelBuilder | None,
    progress: Progress,
) -> EncodedTiles:
    """Plan the encoding on the sample, encode the buckets that are not encoded yet, and the levels above them."""
    count, buckets = sum(store.counts), store.buckets
    origin = Origin(count, np.zeros(0, np.int64))
    plan, codebooks = EncodePlan.of_buckets(store, options, origin, progress).choose_sh_coding(progress)
    left = [bucket for bucket in buckets if not coded_path(store.folder, bucket).exists()]
    uncoded = Counter(bucket.section for bucket in left)
    for section in set(range(len(store.counts))) - set(uncoded):
        store.remove_section(section)
    done = count - sum(bucket.stop - bucket.start for bucket in left)
    threads = options.threads if workers == 1 and scheduler is None else 1
    coding = BucketCoding(store.folder, replace(plan, options=replace(options, threads=threads)), codebooks, levels)
    for bucket in code_buckets(coding, left, workers, scheduler):
        uncoded[bucket.section] -= 1
        if not uncoded[bucket.section]:
            store.remove_section(bucket.section)
        done += bucket.stop - bucket.start
        progress("coding", done / count)
    tiles, nodes, roots = list[EncodedTile](), list[FileNode](), list[list[int]]()
    for bucket in buckets:
        leaves, part = read_coded(store.folder, bucket)
        tiles += leaves
        roots.append([len(nodes) + number for number, node in enumerate(part) if node.parent is None])
        nodes += [_renumbered(node, len(nodes)) for node in part]
    encoded = EncodedTiles(plan, codebooks, tiles, ErrorSums.total(tile.errors for tile in tiles))
    if levels is None:
        return encoded
    plain = replace(store.model, extra={}, means_double=None)
    parts = (
        read_splats(roots_path(store.folder, bucket), plain, sum(nodes[number].splat_count for number in numbers))
        for bucket, numbers in zip(buckets, roots, strict=True)
    )
    parents, top = levels.build_top(parts, options.threads, progress)
    for numbers, parent in zip(roots, parents, strict=False):
        for number in numbers:
            nodes[number] = replace(nodes[number], parent=None if parent is None else parent + len(nodes))
    nodes += [
        _renumbered(FileNode(node.parent, encode_coarse(node, plan, codebooks)), len(nodes)) for node in top
    ]  # fmt: skip
    return levels.measure(replace(encoded, nodes=order_nodes(nodes)), options.threads, progress)


def _renumbered(node: FileNode, first: int) -> FileNode:
    """Return a node whose parent is counted from `first`."""
    return node if node.parent is None else replace(node, parent=node.parent + first)
