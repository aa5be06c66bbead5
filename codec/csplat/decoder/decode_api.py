# SPDX-License-Identifier: Apache-2.0
"""Decode whole scenes, or some tiles and SH bands, at once or tile by tile."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder.budget import check_budget, integer_bytes
from csplat.decoder.codebooks import check_unnamed_codebooks, read_codebooks
from csplat.decoder.container import TILE_FLAGS, SceneHeader, Tile, open_chunk, view_of
from csplat.decoder.index import parse_header
from csplat.decoder.limits import Limits
from csplat.decoder.metadata import DeclaredBounds, bounds_chunk, json_chunk, scene_metadata
from csplat.decoder.packed import pack_tables, pack_tile
from csplat.decoder.reconstruct import (
    SplatArrays,
    empty_integers,
    integer_part,
    opacity_table,
    write_integers,
    write_tile,
)
from csplat.decoder.resource_level import float_bytes
from csplat.decoder.tiles import read_tile
from csplat.decoder.tree import read_nodes
from csplat.errors import InputError, LimitError, counted
from csplat.file_source import PageReleaser
from csplat.model import SplatModel, trusted_model
from csplat.packed import PackedTile
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32

if TYPE_CHECKING:
    from csplat.decoder.blocks import Codebook, TileBlocks
    from csplat.file_source import File

_THREADS_MAX = 8  # maximum by default; more threads are limited by memory bandwidth

#: The default of functions that decode tile by tile.
ONE_THREAD = Context(threads=1)

_T = TypeVar("_T")


@dataclass(frozen=True)
class DecodedScene:
    """A decoded file.

    Attributes:
        header: header and index.
        model: the splats of the file or of the chosen tiles.
        options: the encoder's record of its options; `None` if it is absent, or only a part was decoded.
        declared_bounds: declared error bounds; `None` likewise.
        checks: checks made: `header_crc`, `index_crc`, `chunk_crc` (of every chunk read), `all_chunk_crcs`.
    """

    header: SceneHeader
    model: SplatModel
    options: dict[str, Any] | None
    declared_bounds: DeclaredBounds | None
    checks: tuple[str, ...]


@dataclass(frozen=True)
class DecodedTile:
    """The decoded splats of one tile.

    Attributes:
        tile: the tile's record.
        means: [n, 3] float32.
        quats: [n, 4] float32, w, x, y, z.
        scales: [n, 3] float32, natural logarithms.
        opacities: [n] float32.
        sh0: [n, 3] float32.
        shN: [n, K, 3] float32.
        extra: [n] or [n, components] each, by name.
    """

    tile: Tile
    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    extra: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class DecodeRequest:
    """A file and the part of it to decode.

    Attributes:
        view: the whole file.
        header: header and index, checked.
        tiles: tiles to decode, in the order requested.
        degree: highest SH band to decode.
        limits: limits on the size of the result.
        whole: True if level 0 or all levels are decoded with all bands.
    """

    view: memoryview
    header: SceneHeader
    tiles: Sequence[Tile]
    degree: int
    limits: Limits
    whole: bool

    @property
    def output_header(self) -> SceneHeader:
        """The header, without extra columns if a tile of a coarser level, which has none, is decoded."""
        return replace(self.header, extras=()) if any(tile.level for tile in self.tiles) else self.header


def decode(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> SplatModel:
    """Decode a file, or some tiles and SH bands of it.

    Args:
        data: the whole file: a path, which is mapped into memory; an open binary file; or bytes.
        limits: limits on size and memory; default: the registry's.
        tiles: indices of the tiles to decode, in the order requested, of any level; default: all of level 0.
            `csplat.open(data).cut(...)` selects the tiles of a coarser version of the scene.
        sh_degree: highest SH band to decode; default: all.
        context: threads; default: one per core, up to 8.

    Returns:
        The splats. A part is bit for bit the same part of a whole decode. Coarser levels have no extra columns.

    Examples:
        >>> import csplat
        >>> model = csplat.decode("scene.csplat")
        >>> model
        SplatModel(1000 splats, sh_degree=3)
        >>> csplat.decode("scene.csplat", sh_degree=1).shN.shape
        (1000, 3, 3)

    Raises:
        FormatError: the file breaks a clause. A whole decode checks all clauses, including the CRC of every chunk, but
            does not read the payloads of coarser levels; a partial decode checks what it reads.
        UnsupportedError: the file needs a feature that this version does not have.
        LimitError: the file exceeds `limits`.
        InputError: an argument is invalid.
        OSError: the file cannot be read.
    """
    return decode_scene(data, limits=limits, tiles=tiles, sh_degree=sh_degree, context=context).model


def decode_scene(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> DecodedScene:
    """Decode a file, and return its other content and the checks made as well; arguments and errors as in `decode`."""
    return decode_request(_request_of(data, limits, tiles, sh_degree), context)


def decode_request(request: DecodeRequest, context: Context = DEFAULT_CONTEXT) -> DecodedScene:
    """Decode what was requested, as `decode_scene` does."""
    header, degree = request.output_header, request.degree
    check_budget(header, request.tiles, degree, float_bytes(header, degree), request.limits, whole=request.whole)
    count = sum(tile.splat_count for tile in request.tiles)
    arrays = _allocate(count, lambda: SplatArrays.empty(count, degree, header), request)
    table = opacity_table(header.attribute(_spec.ATTRIBUTE_OPACITIES))

    def write(_index: int, start: int, source: TileBlocks) -> None:
        part = arrays.part(start, start + source.tile.splat_count)
        write_tile(source, header, degree, table, part)

    options, bounds = read_side_chunks(request)
    metadata = scene_metadata(request.view, request.header, request.limits)
    _write_all(request, write, context)
    model = _model_of(header, arrays, metadata)
    checks = ("header_crc", "index_crc", "chunk_crc")
    return DecodedScene(
        request.header, model, options, bounds, (*checks, "all_chunk_crcs") if request.whole else checks
    )


def decode_integers(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> dict[str, NDArray[Any]]:
    """Decode the integer arrays of spec 9.2, by default of all levels; arguments and errors as in `decode`."""
    request = _request_of(data, limits, tiles, sh_degree, every_level=True)
    header, degree = request.header, request.degree
    check_budget(header, request.tiles, degree, integer_bytes(degree), request.limits, whole=request.whole)
    count = sum(tile.splat_count for tile in request.tiles)
    out = _allocate(count, lambda: empty_integers(count, len(request.tiles), degree), request)
    out["tile_splats"][:] = [tile.splat_count for tile in request.tiles]

    def write(index: int, start: int, source: TileBlocks) -> None:
        part = integer_part(out, start, start + source.tile.splat_count)
        write_integers(source, header, part, out["exponents"][index])

    read_side_chunks(request)
    scene_metadata(request.view, request.header, request.limits)
    _write_all(request, write, context)
    return out


def iter_tiles(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    context: Context = ONE_THREAD,
) -> Iterator[DecodedTile]:
    """Decode tile by tile; memory holds the codebooks and one tile per thread.

    An iteration over all tiles checks every other chunk before the first tile. A damaged tile raises at its turn.

    Args:
        data: as in `decode`; a path or an `mmap` may be larger than memory.
        limits: as in `decode`; `limits.bytes` applies to each tile.
        tiles: as in `decode`.
        sh_degree: as in `decode`.
        context: number of threads; each decodes one tile at a time.
    """
    return request_tiles(_request_of(data, limits, tiles, sh_degree), context)


def request_tiles(request: DecodeRequest, context: Context = ONE_THREAD) -> Iterator[DecodedTile]:
    """Decode what was requested tile by tile, as `iter_tiles` does."""
    _check_tile_budget(request)

    def iterate() -> Iterator[DecodedTile]:
        read_side_chunks(request)
        if request.whole:
            scene_metadata(request.view, request.header, request.limits)
        for tile, arrays in _iterate(request, context):
            yield DecodedTile(tile, **vars(arrays))

    return iterate()


def iter_packed(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    context: Context = ONE_THREAD,
) -> Iterator[PackedTile]:
    """Decode to integers and tables tile by tile, see `csplat.packed`; extra columns are left out.

    Arguments and errors as in `iter_tiles`.
    """
    return request_packed(_request_of(data, limits, tiles, sh_degree), context)


def request_packed(request: DecodeRequest, context: Context = ONE_THREAD) -> Iterator[PackedTile]:
    """Decode what was requested to integers and tables, as `iter_packed` does."""
    _check_tile_budget(request)
    header = request.header

    def iterate() -> Iterator[PackedTile]:
        read_side_chunks(request)
        if request.whole:
            scene_metadata(request.view, request.header, request.limits)
        with np.errstate(all="ignore"):
            books = read_codebooks(request.view, header, request.tiles, request.degree)
        tables = pack_tables(books, header)
        yield from _each_tile(
            request, lambda _index, source: pack_tile(source, header, tables), context, ahead=1, books=books
        )

    return iterate()


def check_chunks(data: File, *, limits: Limits | None = None) -> SceneHeader:
    """Check header, index, metadata and the CRC of every chunk, without decoding the tiles.

    Args:
        data, limits: as in `iter_tiles`.

    Raises:
        CsplatError: as in `decode`.
    """
    request = _request_of(data, limits, None, None)
    read_side_chunks(request)
    scene_metadata(request.view, request.header, request.limits)
    for tile in request.header.tiles:
        for layer in tile.layers.values():
            open_chunk(request.view, layer, _spec.CHUNK_TILE, TILE_FLAGS, "CHK-8")
    return request.header


def prepare_decode(
    view: memoryview,
    header: SceneHeader,
    limits: Limits | None,
    tiles: Sequence[int] | None,
    sh_degree: int | None,
    *,
    every_level: bool = False,
) -> DecodeRequest:
    """Return what is to be decoded of a file whose header and index have been checked.

    Args:
        view: the whole file.
        header: header and index.
        limits, tiles, sh_degree: as in `decode`.
        every_level: decode all levels by default.

    Raises:
        InputError: an argument is invalid.
    """
    degree = header.sh_degree
    if sh_degree is not None:
        if not 0 <= sh_degree <= _spec.SH_DEGREE_MAX:
            raise InputError(f"sh_degree is {sh_degree}, expected 0 to {_spec.SH_DEGREE_MAX}")
        degree = min(degree, sh_degree)
    chosen: Sequence[Tile] = header.all_tiles if every_level else header.tiles
    if tiles is not None:
        known = header.all_tiles
        for index in tiles:
            if not 0 <= index < len(known):
                raise InputError(f"tile {index} does not exist, the file has {counted(len(known), 'tile')}")
        chosen = [known[index] for index in tiles]
    whole = tiles is None and degree == header.sh_degree
    return DecodeRequest(view, header, chosen, degree, limits or Limits(), whole)


def _request_of(
    data: File, limits: Limits | None, tiles: Sequence[int] | None, sh_degree: int | None, *, every_level: bool = False
) -> DecodeRequest:
    """Parse the header of a whole file, and check what is to be decoded (`prepare_decode`)."""
    view = view_of(data)
    header = parse_header(view, whole=True, limits=limits)
    return prepare_decode(view, header, limits, tiles, sh_degree, every_level=every_level)


def _check_tile_budget(request: DecodeRequest) -> None:
    """Check a decode that holds one tile in memory at a time."""
    header, degree = request.output_header, request.degree
    splat_bytes = float_bytes(header, degree)
    check_budget(header, request.tiles, degree, splat_bytes, request.limits, whole=request.whole, at_once=False)


def _allocate(count: int, make: Callable[[], _T], request: DecodeRequest) -> _T:
    """Return the result of `make`; raise a `LimitError` if the machine lacks memory for `count` splats."""
    try:
        return make()
    except MemoryError:
        size_bytes = count * float_bytes(request.header, request.degree)
        at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"]
        raise LimitError("memory of this machine", size_bytes, offset=at, clause="LIM-1") from None


def read_side_chunks(request: DecodeRequest) -> tuple[dict[str, Any] | None, DeclaredBounds | None]:
    """For a whole decode, read and check the chunks that no decoded tile refers to; return options and bounds."""
    if not request.whole:
        return None, None
    view, header = request.view, request.header
    for record in header.directory:
        if record.type not in _spec.CHUNK_NAMES:
            open_chunk(view, record, record.type, record.flags, "CHK-2")
    read_nodes(view, header)
    for tile in header.all_tiles[len(request.tiles) :]:  # CHK-8: of all levels or of level 0
        for layer in tile.layers.values():
            open_chunk(view, layer, _spec.CHUNK_TILE, TILE_FLAGS, "CHK-8")
    with np.errstate(all="ignore"):
        check_unnamed_codebooks(view, header)
    options = json_chunk(view, header, _spec.CHUNK_OPTIONS, request.limits.json_bytes)
    return options, bounds_chunk(view, header)


def _write_all(request: DecodeRequest, write: Callable[[int, int, TileBlocks], None], context: Context) -> None:
    """Decode all tiles by calling `write` with each tile's position in `request.tiles`, first splat and blocks."""
    starts = [0]
    for tile in request.tiles:
        starts.append(starts[-1] + tile.splat_count)

    def convert(index: int, source: TileBlocks) -> None:
        write(index, starts[index], source)

    for _ in _each_tile(request, convert, context, ahead=len(request.tiles)):
        pass


def _iterate(request: DecodeRequest, context: Context) -> Iterator[tuple[Tile, SplatArrays]]:
    """Decode tiles in order, each to arrays of its own."""
    header = request.output_header
    table = opacity_table(header.attribute(_spec.ATTRIBUTE_OPACITIES))
    pages = PageReleaser(request.view)

    def convert(_index: int, source: TileBlocks) -> tuple[Tile, SplatArrays]:
        arrays = SplatArrays.empty(source.tile.splat_count, request.degree, header)
        write_tile(source, header, request.degree, table, arrays)
        return source.tile, arrays

    # With one tile more than threads, no thread waits for the caller.
    for done in _each_tile(request, convert, context, ahead=1):
        pages.after(sum(layer.size for layer in done[0].layers.values()))
        yield done


def _each_tile(
    request: DecodeRequest,
    convert: Callable[[int, TileBlocks], _T],
    context: Context,
    *,
    ahead: int,
    books: Mapping[int, Codebook] | None = None,
) -> Iterator[_T]:
    """Read and convert tiles in threads; NumPy and zlib release the GIL on large data.

    Yields results in the order of the tiles and raises the error of the first damaged tile, for any number of threads.

    Args:
        request: the tiles.
        convert: returns the result for a tile's position in `request.tiles` and its blocks.
        context: as in `decode`.
        ahead: number of tiles, finished or waiting, in addition to the tiles being decoded.
        books: the codebooks of these tiles; `None`: they are read here.
    """
    view, header, degree, tiles = request.view, request.header, request.degree, request.tiles
    if books is None:
        with np.errstate(all="ignore"):
            books = read_codebooks(view, header, tiles, degree)

    def decode_tile(index: int) -> _T:
        # No warnings: the reconstruction checks for overflow itself.
        with np.errstate(all="ignore"):
            return convert(index, read_tile(view, header, tiles[index], degree, books))

    indices = range(len(tiles))
    threads = min(context.thread_count, _THREADS_MAX) if context.threads is None else context.threads
    count = max(1, min(threads, len(tiles)))
    if count == 1:
        yield from map(decode_tile, indices)
        return
    waiting: deque[Future[_T]] = deque()
    with ThreadPoolExecutor(count, "csplat") as pool:
        try:
            for index in indices:
                waiting.append(pool.submit(decode_tile, index))
                if len(waiting) >= count + ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _model_of(header: SceneHeader, arrays: SplatArrays, metadata: SceneMetadata) -> SplatModel:
    """Make the model without its constructor's checks: the clauses of spec 7 are stricter."""
    return trusted_model(**vars(arrays), origin=header.origin, metadata=metadata)
