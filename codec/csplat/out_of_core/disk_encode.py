# SPDX-License-Identifier: Apache-2.0
"""Encode a scene in buckets on disk if it does not fit in memory, and estimate the cost of an encoding."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from csplat import __version__
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import atomic_writer
from csplat.encoder import EncodedTiles, EncodeOptions, EncodePlan, EncodeReport, Origin
from csplat.encoder.container import FileNode, order_nodes
from csplat.encoder.error_bounds import ErrorSums
from csplat.encoder.levels import LevelBuilder, LevelCoding
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

_MB = 1_000_000
_PROGRAM = 120 * _MB  # memory of a process that has loaded the encoder
_PER_ROW = 2.2  # memory for coding a bucket or sample, as a multiple of the size of its arrays
_WHOLE_ROW = 3.0  # memory for encoding a whole scene in memory, likewise
_CODED = 0.3  # maximum size of a file, as a multiple of the size of its arrays
#: By SH degree: seconds per million splats for one reading pass and for coding at `balanced`; seconds for a codebook.
#: With the compiled search, a codebook takes half of it, and coding a sixth less.
_SECONDS = ((0.2, 3.0, 0.0), (0.35, 4.4, 1.4), (0.45, 4.9, 2.0), (0.55, 5.8, 3.0), (0.65, 6.6, 3.6))
# Levels of detail. Memory of each process for building the levels of a bucket: renders, a multiple of the size of its
# arrays, and bytes per splat. Size of the file relative to a file without levels.
_LEVEL_RENDERS, _LEVEL_ROWS, _LEVEL_SPLAT = 200 * _MB, 2.0, 600
_LEVEL_SIZE = 1.35
_DISK_PASSES = 4  # time for surveying, sorting and reading buckets, in reading passes over the scene
_CODEBOOK_SPLATS = 500_000  # splats from which a codebook takes its full time; fewer take proportionally less
_NAME_BYTES_MAX = 250  # bytes of a file's name with which `.work` fits into the 255 of file systems
_NAME_PART = 60  # characters of a longer name that are kept: at most 240 bytes
#: Bytes per splat of a file, by preset and SH degree 0 to 4.
_FILE_BYTES = {
    "fast": (9.0, 9.5, 10.0, 11.0, 11.3),
    "balanced": (6.5, 8.0, 8.5, 9.0, 9.3),
    "small": (5.0, 6.5, 7.0, 7.5, 7.6),
}


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


def working_folder(context: Context, out: str | os.PathLike[str]) -> Path:
    """Return the working folder of an encoding: `context.folder`, or a folder next to `out` with its name and `.work`.

    A name of more than `_NAME_BYTES_MAX` bytes is cut to `_NAME_PART` characters.
    """
    if context.folder is not None:
        return Path(context.folder)
    path = Path(out)
    name = path.name if len(os.fsencode(path.name)) <= _NAME_BYTES_MAX else path.name[:_NAME_PART]
    return path.with_name(f"{name}.work")


def estimate_cost(
    scene: Scene,
    options: EncodeOptions,
    context: Context = DEFAULT_CONTEXT,
    levels: LevelBuilder | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
) -> EncodingCost:
    """Estimate the cost of an encoding, and decide where it takes place.

    Args:
        scene: the scene; its blocks are not read.
        options: options of the encoder.
        context: threads, workers and memory; whether to resume.
        levels: builds levels of detail; `None`: the file has none.
        out: path of the file, whose interrupted encoding is continued on disk; `None`: unknown.

    Raises:
        InputError: there is too little memory.
    """
    count, degree = scene.count, options.kept_degree(scene.sh_degree)
    bound = context.memory_limit
    resumes = context.resume and out is not None and working_folder(context, out).exists()
    row = splat_bytes(_with_written_columns(scene, options).empty())
    processes = context.workers if isinstance(context.workers, int) else context.thread_count
    workers = context.thread_count
    passes = 1
    disk = int(count * row * _CODED)
    per_bucket = min(count, options.bucket_splats)
    is_whole = count <= (options.bucket_splats if levels is None else levels.whole_splats)
    building = 0 if levels is None else _building_bytes(count if is_whole else per_bucket, row)
    memory = least = _PROGRAM + int(count * row * _WHOLE_ROW) + building
    # Building levels takes most of the time, and processes share it better than threads.
    in_memory = is_whole or (levels is None and memory <= bound and context.workers is None and not resumes)
    if not in_memory:
        if options.shape_codebook_size:
            raise InputError(f"a codebook of shapes requires the scene in memory, about {memory / _MB:,.0f} MB")
        worker = _PROGRAM + int(per_bucket * row * _PER_ROW) + building
        memory = least = worker + PENDING_BYTES
        workers = max(1, min(processes, (bound - _PROGRAM) // worker))
        passes = _DISK_PASSES
        disk += count * row
        if workers > 1:
            memory = max(memory, _PROGRAM + workers * worker)
    if least > bound and not (in_memory and context.memory is None):
        raise InputError(
            f"{bound / _MB:,.0f} MB of memory are too little for this scene, which requires {least / _MB:,.0f} MB"
        )
    read, code, book = _SECONDS[min(degree, 1) if options.preset == "fast" else degree]
    seconds = count / 1e6 * (read * passes + code / workers) + book * min(1.0, count / _CODEBOOK_SPLATS) / workers
    file_bytes = round(count * _FILE_BYTES[options.preset][degree])
    if levels is not None:
        seconds += levels.seconds(count, workers)
        file_bytes = round(file_bytes * _LEVEL_SIZE)
    return EncodingCost(count, degree, in_memory, workers, memory, disk, seconds, file_bytes)


def _building_bytes(count: int, row: int) -> int:
    """Return the memory, bytes, for building the levels of `count` splats together, in addition to encoding them.

    Args:
        count: number of splats.
        row: size of the arrays of a splat, bytes.
    """
    return _LEVEL_RENDERS + int(count * (row * _LEVEL_ROWS + _LEVEL_SPLAT))


def encode_on_disk(
    scene: Scene,
    out: str | os.PathLike[str],
    options: EncodeOptions,
    cost: EncodingCost,
    context: Context = DEFAULT_CONTEXT,
    levels: LevelBuilder | None = None,
) -> EncodeReport:
    """Encode a scene of several buckets that is read block by block, see `csplat.encode`.

    Args:
        scene: the scene.
        out: path of the file, which appears when complete.
        options: options of the encoder.
        cost: the estimate for these arguments, with the number of workers and the space on the disk.
        context: threads, workers, working folder, whether to resume, seed and progress.
        levels: builds levels of detail; `None`: the file has none.

    Returns:
        The chosen parameters and the error bounds that the file declares.

    Raises:
        CsplatError, OSError: as in `csplat.encode`.
    """
    settings = {} if levels is None else {"levels": levels.settings(scene.count)}
    key = {
        "source": {"name": PurePath(scene.name).name, "size": scene.size_bytes, "changed": scene.modified_ns},
        "options": {**options.chosen(), "seed": context.seed},
        "splats": scene.count,
        "csplat": __version__,
        "levels": settings.get("levels"),
    }
    store = DiskBuckets.of(
        _with_written_columns(scene, options), working_folder(context, out), key, bucket_splats=options.bucket_splats,
        resume=context.resume, disk_bytes=cost.disk_bytes, progress=context.progress,
    )  # fmt: skip
    workers = context.workers if isinstance(context.workers, str) else cost.workers
    encoded = _encode_buckets(store, options, replace(context, workers=workers), levels)
    with atomic_writer(out) as stream:
        report = encoded.write_to(stream, settings, context.progress)
    store.remove()
    return report


def _with_written_columns(scene: Scene, options: EncodeOptions) -> Scene:
    """Return the scene without extra columns unless they are written; its blocks may still have them."""
    return scene if options.keep_extra else scene.changed(extra={})


def _encode_buckets(
    store: DiskBuckets, options: EncodeOptions, context: Context, levels: LevelBuilder | None
) -> EncodedTiles:
    """Plan the encoding on the sample, encode the buckets that are not encoded yet, and the levels above them.

    Args:
        store: the sorted scene.
        options, levels: as in `encode_on_disk`.
        context: as in `encode_on_disk`; its `workers` are the number of processes, or the address of a scheduler.

    Returns:
        The tiles of the scene, whose payloads are read when the file is written; the nodes if there are levels. The
        spill files are removed as their buckets are coded, the files of coded buckets stay in the working folder.

    Raises:
        InputError, OSError: as in `code_buckets` and `read_coded`.
    """
    count, buckets = sum(store.counts), store.buckets
    origin = Origin(count, np.zeros(0, np.int64))
    plan = EncodePlan.of_buckets(store, options, origin, context)
    if levels is not None and plan.sample is not None:
        levels = levels.of_scene(plan.sample.model, count)
    plan, codebooks = plan.choose_sh_coding()
    uncoded = [bucket for bucket in buckets if not coded_path(store.folder, bucket).exists()]
    uncoded_by_section = Counter(bucket.section for bucket in uncoded)
    for section in set(range(len(store.counts))) - set(uncoded_by_section):
        store.remove_section(section)
    done = count - sum(bucket.stop - bucket.start for bucket in uncoded)  # splats
    # A context that worker processes receive has no progress callback.
    worker_context = Context(threads=context.threads if context.workers == 1 else 1, seed=context.seed)
    coding = BucketCoding(store.folder, replace(plan, context=worker_context), codebooks, levels)
    for bucket in code_buckets(coding, uncoded, context.workers or 1):
        uncoded_by_section[bucket.section] -= 1
        if not uncoded_by_section[bucket.section]:
            store.remove_section(bucket.section)
        done += bucket.stop - bucket.start
        context.progress("coding", done / count)
    tiles, nodes = list[EncodedTile](), list[FileNode]()
    roots = list[list[int]]()  # by bucket: indices in `nodes` of its coarsest nodes
    for bucket in buckets:
        leaves, bucket_nodes = read_coded(store.folder, bucket)
        tiles += leaves
        roots.append([len(nodes) + number for number, node in enumerate(bucket_nodes) if node.parent is None])
        nodes += [_renumbered(node, len(nodes)) for node in bucket_nodes]
    encoded = EncodedTiles(plan, codebooks, tiles, ErrorSums.total(tile.errors for tile in tiles))
    if levels is None:
        return encoded
    plain = replace(store.model, extra={}, means_double=None)
    parts = (
        read_splats(roots_path(store.folder, bucket), plain, sum(nodes[number].splat_count for number in numbers))
        for bucket, numbers in zip(buckets, roots, strict=True)
    )
    coding_of_levels = LevelCoding(plan, codebooks)
    parents, top = levels.build_top(parts, context, coding_of_levels)
    for numbers, parent in zip(roots, parents, strict=False):  # no parents if no level is above the buckets
        for number in numbers:
            nodes[number] = replace(nodes[number], parent=None if parent is None else parent + len(nodes))
    nodes += [
        _renumbered(FileNode(node.parent, coding_of_levels.encode(node)), len(nodes)) for node in top
    ]  # fmt: skip
    return levels.measure(replace(encoded, nodes=order_nodes(nodes)), context)


def _renumbered(node: FileNode, first: int) -> FileNode:
    """Return a node with `first` added to the index of its parent; a root is returned as it is."""
    return node if node.parent is None else replace(node, parent=node.parent + first)
