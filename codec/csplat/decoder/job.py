"""A file and what to decode of it: the first step of every way of decoding."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from csplat import _spec
from csplat.decoder.codebooks import check_unnamed_codebooks
from csplat.decoder.container import check_length, open_chunk, read_file_header, view_of
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.index import read_header
from csplat.decoder.jsontext import read_json
from csplat.decoder.limits import Limits
from csplat.decoder.reconstruct import Arrays
from csplat.decoder.stated import StatedErrors, read_serr
from csplat.errors import InputError
from csplat.model import SplatModel

if TYPE_CHECKING:
    from csplat.inputs import File


_THREADS_MAX = 8  # more do not help: memory is the limit

_Texts = tuple[Mapping[str, Any], Sequence[Mapping[str, Any]] | None]


@dataclass(frozen=True)
class Job:
    """A file and what to decode of it.

    Attributes:
        view: the whole file.
        header: header and index, checked.
        tiles: tiles to decode, in the order requested.
        degree: highest SH band to decode.
        limits: limits on what decoding may take.
        whole: True if all tiles and bands are decoded.
    """

    view: memoryview
    header: SceneHeader
    tiles: Sequence[Tile]
    degree: int
    limits: Limits
    whole: bool


def prepare(data: File, limits: Limits | None, tiles: Sequence[int] | None, sh_degree: int | None) -> Job:
    """Check header and index; arguments and errors as in `decode`."""
    view = view_of(data)
    check_length(view, read_file_header(view).file_size)
    header = read_header(view)
    degree = header.sh_degree
    if sh_degree is not None:
        if not 0 <= sh_degree <= _spec.SH_DEGREE_MAX:
            raise InputError(f"sh_degree is {sh_degree}, wanted 0 to {_spec.SH_DEGREE_MAX}")
        degree = min(degree, sh_degree)
    chosen: Sequence[Tile] = header.tiles
    if tiles is not None:
        for index in tiles:
            if not 0 <= index < len(header.tiles):
                raise InputError(f"tile {index} is wanted of a file that has {len(header.tiles)}")
        chosen = [header.tiles[index] for index in tiles]
    whole = tiles is None and degree == header.sh_degree
    return Job(view, header, chosen, degree, limits or Limits(), whole)


def read_side_chunks(job: Job) -> tuple[dict[str, Any] | None, StatedErrors | None]:
    """Read and check what only a whole decode needs: chunks that no tile refers to (CHK-2)."""
    if not job.whole:
        return None, None
    for record in job.header.directory:
        if record.type not in _spec.CHUNK_NAMES:
            open_chunk(job.view, record, record.type, record.flags, "CHK-2")
    with np.errstate(all="ignore"):
        check_unnamed_codebooks(job.view, job.header)
    options = read_json(job.view, job.header, _spec.CHUNK_OPTIONS, job.limits.json_bytes)
    return options, read_serr(job.view, job.header)


def read_texts(job: Job) -> _Texts:
    """Read metadata and cameras."""
    metadata = read_json(job.view, job.header, _spec.CHUNK_METADATA, job.limits.json_bytes)
    return metadata or {}, read_json(job.view, job.header, _spec.CHUNK_CAMERAS, job.limits.json_bytes)


def thread_count(threads: int | None, task_count: int) -> int:
    """Return the number of threads for `task_count` tiles; `None` allows one per processor, up to `_THREADS_MAX`."""
    if threads is None:
        threads = min(os.cpu_count() or 1, _THREADS_MAX)
    if threads < 1:
        raise InputError(f"threads is {threads}, wanted 1 or more")
    return max(1, min(threads, task_count))


def model_of(header: SceneHeader, arrays: Arrays, texts: _Texts) -> SplatModel:
    """Build the model without its constructor's passes over all values.

    The clauses of section 7 have just been checked, and they are stricter than the constructor,
    whose check of each value would cost an eighth of the decode.
    """
    model: SplatModel = object.__new__(SplatModel)
    metadata, cameras = texts
    fields = {
        **vars(arrays),
        "origin": header.origin,
        "coordinate_system": header.coordinate_system,
        "unit_metres": header.unit_metres,
        "antialiased": header.antialiased,
        "flat": header.flat,
        "cameras": cameras,
        "metadata": metadata,
    }
    for name, value in fields.items():
        object.__setattr__(model, name, value)
    return model
