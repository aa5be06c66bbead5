"""Encode buckets from splats on disk to chunks on disk: in this process, several processes or on a Dask cluster."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from csplat import _spec
from csplat.disk_files import atomic_writer
from csplat.encoder.coding_parameters import CodingParameters
from csplat.encoder.container import FileTile, LazyPayload, chunk_crc
from csplat.encoder.encode_plan import clip_scales
from csplat.encoder.error_bounds import ErrorSums
from csplat.encoder.pipeline import EncodedTile, encode_tile
from csplat.encoder.sh_codebook import FileCodebooks, assign_splats
from csplat.encoder.tiling import cut_scene
from csplat.errors import missing_package
from csplat.out_of_core.spill_files import Bucket, SplatLayout, damaged_file, read_splats, spill_path
from csplat.system import map_in_processes


@dataclass(frozen=True, eq=False)
class BucketCoding:
    """The parameters with which all buckets are coded.

    Attributes:
        layout: layout of the splats.
        plan: final parameters of the encoding.
        books: codebooks chosen on the sample, without the assignment of its splats.
    """

    layout: SplatLayout
    plan: CodingParameters
    books: FileCodebooks


def code_bucket(folder: Path, bucket: Bucket, coding: BucketCoding) -> None:
    """Code a bucket unless it is already coded.

    Args:
        folder: the working folder.
        bucket: the bucket to code.
        coding: parameters of all buckets.

    Raises:
        InputError: a value does not fit on the lattice, or a file is damaged.
        OSError: a file cannot be read or written.
    """
    if _record_path(folder, bucket).exists():
        return
    model = clip_scales(read_splats(spill_path(folder, bucket.file_index), coding.layout, bucket.rows))
    sh_plan = assign_splats(coding.books, model, coding.plan, threads=1)
    records, size = [], 0
    with atomic_writer(_chunks_path(folder, bucket)) as stream:
        for tile in cut_scene(model, coding.plan):
            coded = encode_tile(model, tile, coding.plan, sh_plan)
            records.append(_record(coded, size))
            for payload in coded.tile.layers.values():
                assert isinstance(payload, bytes)
                stream.write(payload)
                size += len(payload)
    text = json.dumps(records).encode()
    with atomic_writer(_record_path(folder, bucket)) as stream:  # written last: it marks the bucket as complete
        stream.write(zlib.crc32(text).to_bytes(4, "little") + text)


def read_coded_bucket(folder: Path, bucket: Bucket) -> list[EncodedTile] | None:
    """Return the tiles of a bucket; `None` if it is not coded yet.

    Raises:
        InputError: a file is damaged.
        OSError: it cannot be read.
    """
    path = _record_path(folder, bucket)
    if not path.exists():
        return None
    data = path.read_bytes()
    if zlib.crc32(data[4:]).to_bytes(4, "little") != data[:4]:
        raise damaged_file(path)
    return [_tile(record, _chunks_path(folder, bucket)) for record in json.loads(data[4:])]


def _chunks_path(folder: Path, bucket: Bucket) -> Path:
    return folder / f"chunks-{bucket.index:06}"


def _record_path(folder: Path, bucket: Bucket) -> Path:
    return folder / f"tiles-{bucket.index:06}"


def _record(coded: EncodedTile, start: int) -> dict[str, Any]:
    """Return a coded tile as JSON, with offset, size and CRC instead of each payload."""
    layers, at = {}, start
    for layer, payload in coded.tile.layers.items():
        assert isinstance(payload, bytes)
        layers[layer] = (at, len(payload), chunk_crc(_spec.CHUNK_TILE, payload))
        at += len(payload)
    tile = {**asdict(replace(coded.tile, layers={})), "layers": layers}
    tile["tables"] = tile.pop("codebook_ids")
    return {"tile": tile, "errors": asdict(coded.errors), "coarsened": sorted(coded.coarsened)}


def _tile(record: Mapping[str, Any], chunks: Path) -> EncodedTile:
    fields = dict(record["tile"])
    fields["codebook_ids"] = fields.pop("tables")
    fields["layers"] = {
        int(layer): LazyPayload(size, crc, partial(_read_payload, chunks, offset, size, crc))
        for layer, (offset, size, crc) in fields["layers"].items()
    }
    for name in ("corner", "extent", "codebook_ids"):
        fields[name] = tuple(fields[name])
    errors, coarsened = ErrorSums(**record["errors"]), frozenset(record["coarsened"])
    return EncodedTile(FileTile(**fields), np.zeros(0, np.intp), errors, coarsened)


def _read_payload(path: Path, offset: int, size: int, crc: int) -> bytes:
    with path.open("rb") as stream:
        stream.seek(offset)
        data = stream.read(size)
    if len(data) != size or chunk_crc(_spec.CHUNK_TILE, data) != crc:
        raise damaged_file(path)
    return data


def code_here(folder: Path, buckets: Sequence[Bucket], coding: BucketCoding, workers: int) -> Iterator[Bucket]:
    """Code buckets on this machine, and yield each when it is done.

    Args:
        folder: the working folder.
        buckets: the buckets to code.
        coding: parameters of all buckets.
        workers: number of processes; 1: only this one.

    Raises:
        CsplatError: as in `code_bucket`.
        OSError: as in `code_bucket`; or a process was killed.
    """
    for bucket, _ in map_in_processes(_code, (folder, coding), buckets, workers):
        yield bucket


def _code(shared: tuple[Path, BucketCoding], bucket: Bucket) -> None:
    folder, coding = shared
    code_bucket(folder, bucket, coding)


def code_on_cluster(folder: Path, buckets: Sequence[Bucket], coding: BucketCoding, address: str) -> Iterator[Bucket]:
    """Code buckets on a Dask cluster, whose workers access the working folder under the same path.

    Dask repeats the work of a lost worker.

    Args:
        folder, buckets, coding: as in `code_here`.
        address: address of the scheduler.

    Raises:
        InputError: `dask.distributed` is not installed.
        CsplatError: as in `code_bucket`.
        OSError: as in `code_bucket`; or the scheduler does not respond.
    """
    try:
        distributed: Any = import_module("distributed")  # has no type annotations
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="scale") from None
    with distributed.Client(address, set_as_default=False) as client, client.as_current():
        shared = client.scatter(coding, broadcast=True)
        futures = {client.submit(code_bucket, folder, bucket, shared, pure=False): bucket for bucket in buckets}
        for future in distributed.as_completed(list(futures)):
            future.result()
            yield futures[future]
