"""Whole scenes and chosen parts of them: what callers use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.blocks import Codebook
from csplat.decoder.codebooks import read_codebooks
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.integers import empty_integers, integer_part, write_integers
from csplat.decoder.job import Job, model_of, prepare, read_side_chunks, read_texts, thread_count
from csplat.decoder.limits import Limits, check_budget, float_bytes, integer_bytes
from csplat.decoder.reconstruct import Arrays, opacity_table, write_tile
from csplat.decoder.stated import StatedErrors
from csplat.decoder.tiles import read_tile
from csplat.errors import LimitError
from csplat.model import SplatModel

if TYPE_CHECKING:
    from csplat.inputs import File


_T = TypeVar("_T", Arrays, dict[str, NDArray[Any]])


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
    job = prepare(data, limits, tiles, sh_degree)
    header = job.header
    check_budget(header, job.tiles, job.degree, float_bytes(header, job.degree), job.limits, whole=job.whole)
    count = sum(tile.splat_count for tile in job.tiles)
    arrays = _allocate(count, lambda: Arrays.empty(count, job.degree, header), job)
    table = opacity_table(header.attribute(_spec.ATTRIBUTE_OPACITIES))

    def work(_place: int, tile: Tile, start: int, books: dict[int, Codebook]) -> None:
        source = read_tile(job.view, header, tile, job.degree, books)
        write_tile(source, header, job.degree, table, arrays.part(start, start + tile.splat_count))

    options, stated = read_side_chunks(job)
    texts = read_texts(job)
    _run(job, work, threads)
    model = model_of(header, arrays, texts)
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
    job = prepare(data, limits, tiles, sh_degree)
    header = job.header
    check_budget(header, job.tiles, job.degree, integer_bytes(job.degree), job.limits, whole=job.whole)
    count = sum(tile.splat_count for tile in job.tiles)
    out = _allocate(count, lambda: empty_integers(count, len(job.tiles), job.degree), job)
    out["tile_splats"][:] = [tile.splat_count for tile in job.tiles]

    def work(place: int, tile: Tile, start: int, books: dict[int, Codebook]) -> None:
        source = read_tile(job.view, header, tile, job.degree, books)
        part = integer_part(out, start, start + tile.splat_count)
        write_integers(source, header, part, out["exponents"][place])

    read_side_chunks(job)
    read_texts(job)
    _run(job, work, threads)
    return out


def _allocate(count: int, make: Callable[[], _T], job: Job) -> _T:
    try:
        return make()
    except MemoryError:
        wanted = count * float_bytes(job.header, job.degree)
        at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"]
        raise LimitError("memory of this machine", wanted, offset=at, clause="LIM-1") from None


def _run(job: Job, work: Callable[[int, Tile, int, dict[int, Codebook]], None], threads: int | None) -> None:
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
    count = thread_count(threads, len(places))
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
