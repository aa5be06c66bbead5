"""Whole scenes and chosen parts of them: what callers use."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.blocks import Codebook
from csplat.decoder.codebooks import check_unnamed_codebooks, read_codebooks
from csplat.decoder.container import check_length, open_chunk, read_file_header, view_of
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.index import read_header
from csplat.decoder.integers import empty_integers, integer_part, write_integers
from csplat.decoder.jsontext import read_json
from csplat.decoder.limits import Limits, check_budget, float_bytes, integer_bytes
from csplat.decoder.reconstruct import opacity_table
from csplat.decoder.stated import StatedErrors, read_serr
from csplat.decoder.tiles import Arrays, read_tile, write_tile
from csplat.errors import InputError, LimitError
from csplat.model import SplatModel

if TYPE_CHECKING:
    from csplat.inputs import File

__all__ = [
    "DecodedTile",
    "Scene",
    "decode",
    "decode_integers",
    "decode_scene",
    "iter_tiles",
]

_T = TypeVar("_T", Arrays, dict[str, NDArray[Any]])
_THREADS_MAX = 8  # more do not help: memory is the limit


@dataclass(frozen=True)
class Scene:
    """A decoded file, and what is known about it.

    Attributes:
        header: header and index.
        model: the splats, or those of the chosen tiles.
        options: what the encoder was asked (`None`: not stated, or a part was decoded).
        stated_errors: errors that the file states (`None`: likewise).
        checks: which checks were made: `header_crc`, `index_crc`, `chunk_crc` (of all that was
            used), `all_chunk_crcs`.
    """

    header: SceneHeader
    model: SplatModel
    options: dict[str, Any] | None
    stated_errors: StatedErrors | None
    checks: tuple[str, ...]


@dataclass(frozen=True)
class DecodedTile:
    """One tile's splats, arrays of its own.

    Attributes:
        tile: its record.
        means: [n, 3] float32.
        quats: [n, 4] float32, w, x, y, z.
        scales: [n, 3] float32, natural logarithms.
        opacities: [n] float32.
        sh0: [n, 3] float32.
        shN: [n, K, 3] float32.
        extra: [n] each, by name.
    """

    tile: Tile
    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh0: NDArray[np.float32]
    shN: NDArray[np.float32]
    extra: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Job:
    """A file and what is wanted of it."""

    view: memoryview
    header: SceneHeader
    tiles: Sequence[Tile]
    degree: int
    limits: Limits
    whole: bool


def decode(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    threads: int | None = None,
) -> SplatModel:
    """Decode a file, or chosen tiles and SH bands of it.

    Args:
        data: the whole file: its path, which is mapped into memory; an open binary file; or its bytes.
        limits: what it may take; the registry's defaults if left out.
        tiles: places of the tiles wanted, in the order wanted; all if left out.
        sh_degree: highest SH band wanted; all if left out, or if the file has fewer.
        threads: how many threads decode; as many as there are processors if left out.

    Returns:
        The splats. What is returned of a part equals the same part of a whole decode.

    Examples:
        >>> import csplat
        >>> model = csplat.decode("scene.csplat")
        >>> model
        SplatModel(1000 splats, sh_degree=3)
        >>> csplat.decode("scene.csplat", sh_degree=1).shN.shape
        (1000, 3, 3)

    Raises:
        FormatError: the file breaks a clause. A whole decode checks all of them, every chunk's
            CRC included; a part checks what it reads.
        UnsupportedError: the file asks for what this version does not have.
        LimitError: the file asks for more than `limits`.
        InputError: an argument is at fault.
        OSError: the file cannot be read.
    """
    return decode_scene(data, limits=limits, tiles=tiles, sh_degree=sh_degree, threads=threads).model


def decode_scene(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    threads: int | None = None,
) -> Scene:
    """Decode as `decode` does, and say what else the file holds and which checks were made."""
    job = _prepare(data, limits, tiles, sh_degree)
    header = job.header
    check_budget(header, job.tiles, job.degree, float_bytes(header, job.degree), job.limits, whole=job.whole)
    count = sum(tile.splat_count for tile in job.tiles)
    arrays = _allocate(count, lambda: Arrays.empty(count, job.degree, header), job)
    table = opacity_table(header.attribute(_spec.ATTRIBUTE_OPACITIES))

    def work(_place: int, tile: Tile, start: int, books: dict[int, Codebook]) -> None:
        source = read_tile(job.view, header, tile, job.degree, books)
        write_tile(source, header, job.degree, table, arrays.part(start, start + tile.splat_count))

    options, stated = _read_side_chunks(job)
    metadata = read_json(job.view, header, _spec.CHUNK_METADATA, job.limits.json_bytes)
    cameras = read_json(job.view, header, _spec.CHUNK_CAMERAS, job.limits.json_bytes)
    _run(job, work, threads)
    model = _model(header, arrays, metadata or {}, cameras)
    checks = ("header_crc", "index_crc", "chunk_crc")
    return Scene(header, model, options, stated, (*checks, "all_chunk_crcs") if job.whole else checks)


def decode_integers(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    threads: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Decode the integer arrays of spec 9.2; arguments and errors as of `decode`."""
    job = _prepare(data, limits, tiles, sh_degree)
    header = job.header
    check_budget(header, job.tiles, job.degree, integer_bytes(job.degree), job.limits, whole=job.whole)
    count = sum(tile.splat_count for tile in job.tiles)
    out = _allocate(count, lambda: empty_integers(count, len(job.tiles), job.degree), job)
    out["tile_splats"][:] = [tile.splat_count for tile in job.tiles]

    def work(place: int, tile: Tile, start: int, books: dict[int, Codebook]) -> None:
        source = read_tile(job.view, header, tile, job.degree, books)
        part = integer_part(out, start, start + tile.splat_count)
        write_integers(source, header, part, out["exponents"][place])

    _read_side_chunks(job)
    _check_json(job)
    _run(job, work, threads)
    return out


def iter_tiles(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
) -> Iterator[DecodedTile]:
    """Decode tile by tile, in memory for one tile and the codebooks.

    An iteration over all tiles checks every chunk but the tiles' own before it gives the first; damage of a tile
    shows when it is its turn. `limits.splats` does not apply, `limits.bytes` to one tile at a time.

    Args:
        data: as of `decode`; a path or an `mmap` need not fit the memory.
        limits: as of `decode`.
        tiles: as of `decode`.
        sh_degree: as of `decode`.
    """
    job = _prepare(data, limits, tiles, sh_degree)
    header = job.header
    check_budget(
        header, job.tiles, job.degree, float_bytes(header, job.degree), job.limits, whole=job.whole, at_once=False
    )
    return _iterate(job)


def _prepare(data: File, limits: Limits | None, tiles: Sequence[int] | None, sh_degree: int | None) -> _Job:
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
    return _Job(view, header, chosen, degree, limits or Limits(), whole)


def _allocate(count: int, make: Callable[[], _T], job: _Job) -> _T:
    try:
        return make()
    except MemoryError:
        wanted = count * float_bytes(job.header, job.degree)
        at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"]
        raise LimitError("memory of this machine", wanted, offset=at, clause="LIM-1") from None


def _read_side_chunks(job: _Job) -> tuple[dict[str, Any] | None, StatedErrors | None]:
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


def _check_json(job: _Job) -> None:
    """Read metadata and cameras where nobody asks what is in them."""
    for kind in (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS):
        read_json(job.view, job.header, kind, job.limits.json_bytes)


def _run(job: _Job, work: Callable[[int, Tile, int, dict[int, Codebook]], None], threads: int | None) -> None:
    """Decode the tiles, in threads: NumPy and zlib release the GIL on large data.

    The error of the first tile at fault is raised, whatever the threads.

    Args:
        job: what to decode.
        work: decodes one tile: its place in `job.tiles`, itself, its first splat, the codebooks.
        threads: as of `decode`.
    """
    with np.errstate(all="ignore"):
        books = read_codebooks(job.view, job.header, job.tiles, job.degree)
    starts = [0]
    for tile in job.tiles:
        starts.append(starts[-1] + tile.splat_count)

    def quiet(place: int) -> None:
        # Overflow to infinity is looked for where it can occur; NumPy need not warn of it.
        with np.errstate(all="ignore"):
            work(place, job.tiles[place], starts[place], books)

    places = range(len(job.tiles))
    count = _thread_count(threads, len(places))
    if count == 1:
        for place in places:
            quiet(place)
        return
    with ThreadPoolExecutor(count, "csplat") as pool:
        futures = [pool.submit(quiet, place) for place in places]
        try:
            for future in futures:
                future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _thread_count(threads: int | None, task_count: int) -> int:
    if threads is None:
        threads = min(os.cpu_count() or 1, _THREADS_MAX)
    if threads < 1:
        raise InputError(f"threads is {threads}, wanted 1 or more")
    return max(1, min(threads, task_count))


def _iterate(job: _Job) -> Iterator[DecodedTile]:
    header = job.header
    if job.whole:
        _read_side_chunks(job)
        _check_json(job)
    with np.errstate(all="ignore"):
        books = read_codebooks(job.view, header, job.tiles, job.degree)
    table = opacity_table(header.attribute(_spec.ATTRIBUTE_OPACITIES))
    for tile in job.tiles:
        arrays = Arrays.empty(tile.splat_count, job.degree, header)
        with np.errstate(all="ignore"):
            write_tile(read_tile(job.view, header, tile, job.degree, books), header, job.degree, table, arrays)
        yield DecodedTile(tile, **vars(arrays))


def _model(
    header: SceneHeader, arrays: Arrays, metadata: dict[str, Any], cameras: list[dict[str, Any]] | None
) -> SplatModel:
    """Build the model without its constructor's passes over all values.

    The clauses of section 7 have just been checked, and they say more than the constructor
    does: its look at each value would cost an eighth of the decode.
    """
    model: SplatModel = object.__new__(SplatModel)
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
