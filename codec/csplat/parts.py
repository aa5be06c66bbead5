"""A part of a file as a file of its own: tiles are copied as they are, and no stream is decoded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from csplat import _spec
from csplat.decoder.container import check_length, open_chunk, view_of
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.index import read_header
from csplat.encoder.container import CodebookTable, FileChunk, FileTile, SceneFields, write
from csplat.errors import InputError
from csplat.inputs import File

__all__ = ["Part", "extract"]

#: Chunks of a whole file that are as true of a part: not what an encoder states of errors and of its work.
_KEPT = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS)


@dataclass(frozen=True)
class Part:
    """A file that was cut out of another one.

    Attributes:
        data: the file.
        tiles: which tiles of the other one it has.
        splat_count: its splats.
    """

    data: bytes
    tiles: tuple[int, ...]
    splat_count: int


def extract(file: File, box: Sequence[float]) -> Part:
    """Cut the tiles whose boxes touch a box out of a file.

    Tiles stay whole, so that splats around the box come along; values are those of the file, bit for bit. Stated errors
    and what the encoder says of its work are left out: they are about the whole. So are chunks of unknown types.

    Args:
        file: a `.csplat` file, as of `decode`.
        box: two corners, x, y, z each, in any order; scene units, as the means: relative to the origin.

    Examples:
        >>> import csplat
        >>> part = csplat.extract("scene.csplat", (-1, -1, -1, 1, 1, 1))
        >>> part.splat_count == len(csplat.decode(part.data))
        True

    Raises:
        InputError: six finite numbers are wanted; or no tile touches the box.
        FormatError: a clause on header, index, or the chunks that are copied is broken.
        UnsupportedError: as of `decode`.
    """
    low, high = _corners(box)
    view = view_of(file)
    header = read_header(view)
    check_length(view, header.file_size)
    step = header.attributes[_spec.ATTRIBUTE_MEANS - 1].step
    tiles = [tile for tile in header.tiles if _touches(tile, step, low, high)]
    if not tiles:
        raise InputError(f"no tile touches the box {_text(low)} to {_text(high)}: {_extent(header, step)}")
    copied = [_copied(view, tile) for tile in tiles]
    data = write(_fields(view, header, {table for tile in tiles for table in tile.tables}), copied)
    return Part(data, tuple(tile.index for tile in tiles), sum(tile.splat_count for tile in tiles))


def _corners(box: Sequence[float]) -> tuple[list[float], list[float]]:
    numbers = [float(value) for value in box]
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise InputError(f"a box is {tuple(box)!r}, wanted six finite numbers: two corners, x, y, z each")
    pairs = list(zip(numbers[:3], numbers[3:], strict=True))
    return [min(pair) for pair in pairs], [max(pair) for pair in pairs]


def _sides(tile: Tile, step: float) -> tuple[list[float], list[float]]:
    """Corners of the box around a tile's centres (spec 4.3.5), scene units."""
    scaled = math.ldexp(step, tile.exponent)
    low = [corner * scaled for corner in tile.corner]
    return low, [(corner + extent) * scaled for corner, extent in zip(tile.corner, tile.extent, strict=True)]


def _touches(tile: Tile, step: float, low: Sequence[float], high: Sequence[float]) -> bool:
    least, most = _sides(tile, step)
    return all(least[axis] <= high[axis] and most[axis] >= low[axis] for axis in range(3))


def _text(corner: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in corner)


def _extent(header: SceneHeader, step: float) -> str:
    """Say where the splats are."""
    if not header.tiles:
        return "the scene has no splats"
    sides = [_sides(tile, step) for tile in header.tiles]
    low, high = ([change(side[k][axis] for side in sides) for axis in range(3)] for k, change in ((0, min), (1, max)))
    return f"centres lie within {_text(low)} to {_text(high)}"


def _copied(view: memoryview, tile: Tile) -> FileTile:
    """Its chunks, their CRCs checked; layers of unknown ids are left out."""
    flags = sum(getattr(_spec, f"CHUNK_FLAG_{name.upper()}") for name in _spec.CHUNK_FLAGS[_spec.CHUNK_TILE])
    layers = {}
    for layer, record in tile.layers.items():
        if layer in _spec.LAYER_NAMES:
            cursor = open_chunk(view, record, _spec.CHUNK_TILE, flags, "TLE-1")
            layers[layer] = bytes(view[cursor.at : record.offset + record.size])
    return FileTile(
        tile.splat_count, tile.exponent, tile.corner, tile.extent, tile.max_scale, layers, tile.tables
    )  # fmt: skip


def _fields(view: memoryview, header: SceneHeader, tables: set[int]) -> SceneFields:
    """What header and index say of the scene, with the codebooks that are still used."""
    head = _spec.unpack_index_head(view, _spec.HEADER_SIZE)
    at = _spec.HEADER_SIZE + head.head_size + head.attribute_count * head.attribute_size
    at += head.codebook_count * head.codebook_size
    extras = [_spec.unpack_extra_record(view, at + i * head.extra_size) for i in range(head.extra_count)]
    books = [book for book in header.codebooks if book.codebook_id in tables]
    chunks = []
    for record in header.directory:
        if record.type in _KEPT or (record.type == _spec.CHUNK_CODEBOOK and record.id in tables):
            cursor = open_chunk(view, record, record.type, record.flags, "CHK-3")
            payload = bytes(view[cursor.at : record.offset + record.size])
            chunks.append(FileChunk(record.type, payload, record.id, record.layer))
    return SceneFields(
        sh_degree=header.sh_degree,
        scene_flags=header.antialiased * _spec.SCENE_FLAG_ANTIALIASED | header.flat * _spec.SCENE_FLAG_FLAT,
        axes=bytes(head.axes),
        unit_metres=head.unit_metres,
        origin=header.origin,
        attributes=header.attributes,
        extras=extras,
        codebooks=[
            CodebookTable(book.codebook_id, book.kind, (book.band_first, book.band_last), book.size) for book in books
        ],
        chunks=chunks,
    )
