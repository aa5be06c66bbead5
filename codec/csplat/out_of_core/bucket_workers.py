"""Encode buckets from splats on disk to tiles on disk: in this process, several processes or on a Dask cluster.

The file of a coded bucket has a head (size and CRC of the records), records of its tiles as JSON, and their payloads.
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
from csplat.encoder.container import FileTile, LazyPayload, chunk_crc
from csplat.encoder.encode_plan import EncodePlan, clip_scales
from csplat.encoder.error_bounds import ErrorSums
from csplat.encoder.pipeline import EncodedTile, encode_tile
from csplat.encoder.sh_codebook import FileCodebooks, assign_splats
from csplat.encoder.tiling import cut_scene
from csplat.errors import missing_package
from csplat.out_of_core.disk_buckets import Bucket, damaged_file, read_bucket
from csplat.system import map_in_processes

_HEAD = struct.Struct("<QI")  # size and CRC-32 of the records


@dataclass(frozen=True, eq=False)
class BucketCoding:
    """The parameters with which all buckets are coded.

    Attributes:
        folder: the working folder.
        plan: the complete plan, without splats.
        codebooks: codebooks trained on the sample, without the assignment of its splats.
    """

    folder: Path
    plan: EncodePlan
    codebooks: FileCodebooks


def coded_path(folder: Path, bucket: Bucket) -> Path:
    """Return the path of the file of a coded bucket."""
    return folder / f"tiles-{bucket.index:06}"


def code_buckets(
    coding: BucketCoding, buckets: Sequence[Bucket], workers: int, cluster: str | None
) -> Iterator[Bucket]:
    """Code buckets, and yield each when it is done.

    Args:
        coding: parameters of all buckets.
        buckets: the buckets to code.
        workers: number of processes; 1: only this one.
        cluster: address of a Dask scheduler, whose workers code instead, and access the working folder under the same
            path; Dask repeats the work of a lost worker.

    Raises:
        InputError: a value does not fit on the lattice, a file is damaged, or `dask.distributed` is not installed.
        OSError: a file cannot be read or written; a process was killed; the scheduler does not respond.
    """
    if cluster is None:
        for bucket, _ in map_in_processes(_code_bucket, coding, buckets, workers):
            yield bucket
        return
    try:
        distributed: Any = import_module("distributed")  # has no type annotations
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="scale") from None
    with distributed.Client(cluster, set_as_default=False) as client, client.as_current():
        shared = client.scatter(coding, broadcast=True)
        futures = {client.submit(_code_bucket, shared, bucket, pure=False): bucket for bucket in buckets}
        for future in distributed.as_completed(list(futures)):
            future.result()
            yield futures[future]


def _code_bucket(coding: BucketCoding, bucket: Bucket) -> None:
    """Code a bucket unless it is already coded."""
    plan, path = coding.plan, coded_path(coding.folder, bucket)
    if path.exists():  # by a worker that Dask lost
        return
    model = clip_scales(read_bucket(coding.folder, plan.model, bucket))
    sh_plan = assign_splats(coding.codebooks, model, plan.parameters, threads=1)
    records, payloads, size = list[dict[str, Any]](), list[bytes](), 0
    for tile in cut_scene(model, plan.parameters):
        coded, layers = encode_tile(model, tile, plan.parameters, sh_plan), {}
        for layer, payload in coded.tile.layers.items():
            assert isinstance(payload, bytes)
            layers[layer] = size, len(payload), chunk_crc(_spec.CHUNK_TILE, payload)
            payloads.append(payload)
            size += len(payload)
        fields = {**asdict(replace(coded.tile, layers={})), "layers": layers}
        records.append({"tile": fields, "errors": asdict(coded.errors), "coarsened": sorted(coded.coarsened)})
    text = json.dumps(records).encode()
    with atomic_writer(path) as stream:
        stream.write(_HEAD.pack(len(text), zlib.crc32(text)) + text)
        stream.writelines(payloads)


def read_tiles(folder: Path, bucket: Bucket) -> Iterator[EncodedTile]:
    """Yield the tiles of a coded bucket, whose payloads are read when the file is written.

    Raises:
        InputError: the file is damaged.
        OSError: it cannot be read.
    """
    path = coded_path(folder, bucket)
    with path.open("rb") as stream:
        size, crc = _HEAD.unpack(stream.read(_HEAD.size).ljust(_HEAD.size, b"\0"))
        text = stream.read(min(size, path.stat().st_size))
    if len(text) != size or zlib.crc32(text) != crc:
        raise damaged_file(path)
    for record in json.loads(text):
        fields = record["tile"]
        layers = {
            int(layer): LazyPayload(length, check, partial(_read_payload, path, _HEAD.size + size + at, length, check))
            for layer, (at, length, check) in fields.pop("layers").items()
        }
        fields |= {name: tuple(fields[name]) for name in ("corner", "extent", "codebook_ids")}
        errors, coarsened = ErrorSums(**record["errors"]), frozenset(record["coarsened"])
        yield EncodedTile(FileTile(layers=layers, **fields), np.zeros(0, np.intp), errors, coarsened)


def _read_payload(path: Path, offset: int, size: int, crc: int) -> bytes:
    with path.open("rb") as stream:
        stream.seek(offset)
        data = stream.read(size)
    if len(data) != size or chunk_crc(_spec.CHUNK_TILE, data) != crc:
        raise damaged_file(path)
    return data
