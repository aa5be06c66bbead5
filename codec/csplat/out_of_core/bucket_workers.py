# SPDX-License-Identifier: Apache-2.0
"""Encode buckets from splats on disk to tiles on disk: in this process, several processes or on a Dask cluster.

The file of a coded bucket has a head (size and CRC of the records), records of its tiles and nodes as JSON, and the
payloads. With levels of detail, another file has the splats of its coarsest node.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from csplat import _spec
from csplat.disk_files import atomic_writer
from csplat.encoder.container import FileNode, FileTile, LazyPayload, chunk_crc
from csplat.encoder.encode_plan import EncodePlan, Origin, clip_scales
from csplat.encoder.error_bounds import ErrorSums
from csplat.encoder.levels import LevelBuilder, LevelCoding, encode_levels
from csplat.encoder.pipeline import EncodedTile, EncodedTiles, encode_tiles
from csplat.encoder.sh_codebook import FileCodebooks
from csplat.encoder.tiling import cut_scene
from csplat.errors import missing_package
from csplat.file_source import open_binary
from csplat.out_of_core.disk_buckets import Bucket, damaged_file, read_bucket, write_splats
from csplat.scene import join_blocks
from csplat.system import map_in_processes

_HEAD = struct.Struct("<QI")  # size and CRC-32 of the records


@dataclass(frozen=True, eq=False)
class BucketCoding:
    """The parameters with which all buckets are coded.

    Attributes:
        folder: the working folder.
        plan: the complete plan, without splats.
        codebooks: codebooks trained on the sample.
        levels: builds levels of detail; `None`: there are none.
    """

    folder: Path
    plan: EncodePlan
    codebooks: FileCodebooks
    levels: LevelBuilder | None = None


def coded_path(folder: Path, bucket: Bucket) -> Path:
    """Return the path of the file of a coded bucket."""
    return folder / f"tiles-{bucket.index:06}"


def roots_path(folder: Path, bucket: Bucket) -> Path:
    """Return the path of the splats of the coarsest nodes of a coded bucket."""
    return folder / f"roots-{bucket.index:06}"


def code_buckets(coding: BucketCoding, buckets: Sequence[Bucket], workers: int | str) -> Iterator[Bucket]:
    """Code buckets, and yield each when it is done.

    Args:
        coding: parameters of all buckets.
        buckets: the buckets to code.
        workers: number of processes; 1: only this process. Or the address of a Dask scheduler, whose workers code
            instead, and access the working folder under the same path; Dask repeats the work of a lost worker.

    Raises:
        InputError: a value does not fit on the lattice, a file is damaged, or `dask.distributed` is not installed.
        OSError: a file cannot be read or written; a process was killed; the scheduler does not respond.
    """
    if isinstance(workers, int):
        for bucket, _ in map_in_processes(_code_bucket, coding, buckets, workers):
            yield bucket
        return
    with open_client(workers) as client, client.as_current():
        shared = client.scatter(coding, broadcast=True)
        futures = {client.submit(_code_bucket, shared, bucket, pure=False): bucket for bucket in buckets}
        for future in import_module("distributed").as_completed(list(futures)):
            future.result()
            yield futures[future]


def open_client(scheduler: str) -> Any:
    """Open the client of a Dask cluster, a context manager.

    Args:
        scheduler: the address of its scheduler, such as `tcp://host:8786`.

    Raises:
        InputError: `dask.distributed` is not installed.
        OSError: the scheduler does not respond.
    """
    try:
        distributed: Any = import_module("distributed")  # has no type annotations
    except ModuleNotFoundError as error:
        raise missing_package(error, "dask[distributed]", extra="scale") from None
    return distributed.Client(scheduler, set_as_default=False)


def _code_bucket(coding: BucketCoding, bucket: Bucket) -> None:
    """Encode a bucket, and write the file of the coded bucket (see the module), unless that file exists.

    With levels of detail, also writes the file at `roots_path`.

    Raises:
        InputError: a value does not fit on the lattice, or the spill file is damaged.
        OSError: a file cannot be read or written.
    """
    path = coded_path(coding.folder, bucket)
    if path.exists():  # by a worker that Dask lost
        return
    encoded = _encode_bucket(coding, bucket)
    nodes = encoded.nodes or [FileNode(None, [leaf.tile for leaf in encoded.tiles])]
    leaves = iter(encoded.tiles)  # the tiles of level 0, in the order in which `nodes` has them
    records = list[dict[str, Any]]()
    payloads = list[bytes]()
    size = 0  # bytes of the payloads so far, the offset of the next
    for tile in [tile for node in nodes for tile in node.tiles]:
        layers = {}
        for layer, payload in tile.layers.items():
            assert isinstance(payload, bytes)
            layers[layer] = size, len(payload), chunk_crc(_spec.CHUNK_TILE, payload)
            payloads.append(payload)
            size += len(payload)
        record: dict[str, Any] = {"tile": {**asdict(replace(tile, layers={})), "layers": layers}}
        if tile.level == 0:
            leaf = next(leaves)
            record |= {"errors": asdict(leaf.errors), "coarsened": sorted(leaf.coarsened)}
        records.append(record)
    tree = [[node.parent, len(node.tiles), node.error, node.squares] for node in nodes]
    text = json.dumps({"tiles": records, "nodes": tree}).encode()
    with atomic_writer(path) as stream:
        stream.write(_HEAD.pack(len(text), zlib.crc32(text)) + text)
        stream.writelines(payloads)


def _encode_bucket(coding: BucketCoding, bucket: Bucket) -> EncodedTiles:
    """Read a bucket from its spill file, and encode it with the parameters and codebooks of the scene.

    With levels of detail, builds and measures the levels of the bucket, and writes the splats of its coarsest nodes to
    the file at `roots_path`.

    Returns:
        The tiles, whose errors are of this bucket alone, and the nodes, none without levels of detail.
    """
    model = clip_scales(read_bucket(coding.folder, coding.plan.model, bucket))
    context = coding.plan.context
    plan = replace(coding.plan, model=model, origin=Origin(len(model), np.arange(len(model))))
    if coding.levels is None:
        return encode_tiles(replace(plan, tiles=cut_scene(model, plan.parameters)), coding.codebooks)
    levels = LevelCoding(plan, coding.codebooks)
    nodes = coding.levels.build_part(levels.scene, context, levels)
    roots = [node.splats for node in nodes if node.parent is None and node.splats is not None]
    write_splats(roots_path(coding.folder, bucket), join_blocks(roots[0], roots))
    return coding.levels.measure(encode_levels(plan, nodes, coding.codebooks), context)


def read_coded(folder: Path, bucket: Bucket) -> tuple[list[EncodedTile], list[FileNode]]:
    """Return the tiles of level 0 and the nodes of a coded bucket, whose payloads are read when the file is written.

    Raises:
        InputError: the file is damaged.
        OSError: it cannot be read.
    """
    path = coded_path(folder, bucket)
    with open_binary(path) as stream:
        size, crc = _HEAD.unpack(stream.read(_HEAD.size).ljust(_HEAD.size, b"\0"))
        text = stream.read(min(size, path.stat().st_size))
    if len(text) != size or zlib.crc32(text) != crc:
        raise damaged_file(path)
    content = json.loads(text)
    leaves, tiles = list[EncodedTile](), list[FileTile]()
    for record in content["tiles"]:
        fields = record["tile"]
        layers = {
            int(layer): LazyPayload(
                length, payload_crc, partial(_read_payload, path, _HEAD.size + size + offset, length, payload_crc)
            )
            for layer, (offset, length, payload_crc) in fields.pop("layers").items()
        }
        fields |= {name: tuple(fields[name]) for name in ("corner", "extent", "codebook_ids")}
        tiles.append(FileTile(layers=layers, **fields))
        if "errors" in record:
            errors, coarsened = ErrorSums(**record["errors"]), frozenset(record["coarsened"])
            leaves.append(EncodedTile(tiles[-1], np.zeros(0, np.intp), errors, coarsened))
    remaining_tiles = iter(tiles)
    nodes = [
        FileNode(parent, [next(remaining_tiles) for _ in range(count)], error, tuple(squares))
        for parent, count, error, squares in content["nodes"]
    ]
    return leaves, nodes


def _read_payload(path: Path, offset: int, size: int, crc: int) -> bytes:
    """Read `size` bytes at `offset`; raise an `InputError` if some are missing or the CRC of their chunk differs."""
    with open_binary(path) as stream:
        stream.seek(offset)
        data = stream.read(size)
    if len(data) != size or chunk_crc(_spec.CHUNK_TILE, data) != crc:
        raise damaged_file(path)
    return data
