"""Tile and layer records, and what the chunks cover together (spec 4.3.5, 4.3.6)."""

from __future__ import annotations

import math
from typing import NoReturn

from csplat import _spec
from csplat.decoder.container import check_reserved
from csplat.decoder.header import Tile
from csplat.errors import FormatError, UnsupportedError

#: The smallest normal number of binary64; the smallest and the largest of binary32 (ATT-6, ATT-10, LAT-1).
STEP_MIN = 2.0**-1022
SINGLE_MIN, SINGLE_MAX = 2.0**-126, 2.0**128 - 2.0**104


def scaled_step(step: float, exponent: int, least: float = STEP_MIN) -> float | None:
    """Return step × 2^exponent (exact), or `None` where it is not finite or below `least` (TIL-9, LAT-1)."""
    try:
        scaled = math.ldexp(step, exponent)
    except OverflowError:
        return None
    # Just below 2^-1022 the product may round up to it: then it is not exact.
    return scaled if scaled >= least and math.ldexp(scaled, -exponent) == step else None


def read_tiles(
    view: memoryview,
    at: int,
    end: int,
    head: _spec.IndexHead,
    means_step: float,
    codebooks: tuple[_spec.CodebookRecord, ...],
) -> tuple[Tile, ...]:
    """Read `tile_count` tiles, which must fill the index up to its CRC.

    Args:
        view: the file's beginning.
        at: where the tiles begin.
        end: where the index's CRC begins.
        head: the index head.
        means_step: step of the means' attribute record.
        codebooks: the codebook records.
    """
    known = {book.codebook_id for book in codebooks}
    tiles = []
    start = 0
    for index in range(head.tile_count):
        tile, size = _read_tile(view, at, end, index, start, head)
        _check_tile(tile, means_step)
        _check_tables(tile, known, at + size - 2 * len(tile.tables))
        tiles.append(tile)
        start += tile.splat_count
        at += size
    if at != end:
        raise FormatError(
            _spec.ERROR_INDEX, at, "IDX-2", "bytes follow the last tile", found=f"{end - at} bytes", wanted="the CRC"
        )
    if start != head.splat_count:
        raise FormatError(
            _spec.ERROR_INDEX,
            _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"],
            "IDX-7",
            "splat_count",
            found=head.splat_count,
            wanted=start,
        )
    return tuple(tiles)


def check_coverage(
    directory: tuple[_spec.DirectoryRecord, ...],
    directory_at: range,
    tiles: tuple[Tile, ...],
    head: _spec.IndexHead,
    index_end: int,
    file_size: int,
) -> None:
    """COV-1: the chunks touch one another from the index to the end of the file.

    Args:
        directory: the directory records.
        directory_at: where each of them begins.
        tiles: the tiles.
        head: the index head.
        index_end: where the first chunk begins.
        file_size: where the last chunk ends.
    """
    place = _spec.DIRECTORY_RECORD_OFFSETS["offset"]
    chunks = [(record.offset, record.size, at + place) for at, record in zip(directory_at, directory, strict=True)]
    for tile in tiles:
        layer_at = tile.offset + head.tile_size + _spec.LAYER_RECORD_OFFSETS["offset"]
        for i, layer in enumerate(tile.layers.values()):
            chunks.append((layer.offset, layer.size, layer_at + i * head.layer_size))
    chunks.sort()
    expected = index_end
    for offset, size, named_at in chunks:
        if offset != expected:
            raise FormatError(
                _spec.ERROR_INDEX,
                named_at,
                "COV-1",
                "chunks leave a gap or overlap: offset",
                found=offset,
                wanted=expected,
            )
        expected += size
    if expected != file_size:
        raise FormatError(
            _spec.ERROR_INDEX,
            _spec.HEADER_OFFSETS["file_size"],
            "COV-1",
            "the last chunk does not end with the file",
            found=expected,
            wanted=file_size,
        )


def _read_tile(view: memoryview, at: int, end: int, index: int, start: int, head: _spec.IndexHead) -> tuple[Tile, int]:
    """Return a tile, its layers checked, and how many bytes of the index it takes."""
    if end - at < head.tile_size:
        _ends_early(at)
    record = _spec.unpack_tile_record(view, at)
    layers_at = at + head.tile_size
    tables_at = layers_at + record.layer_count * head.layer_size
    after = tables_at + 2 * record.table_count
    if after > end:
        _ends_early(at)
    check_reserved(record, at, _spec.TILE_RECORD_OFFSETS)
    if record.level != 0:
        raise FormatError(
            _spec.ERROR_RESERVED,
            at + _spec.TILE_RECORD_OFFSETS["level"],
            "RES-1",
            "level",
            found=record.level,
            wanted=0,
        )
    raw = bytes(view[tables_at:after])
    tile = Tile(
        index=index,
        offset=at,
        start=start,
        splat_count=record.splat_count,
        exponent=record.exponent,
        corner=record.corner,
        extent=record.extent,
        max_scale=record.max_scale,
        layers=_read_layers(view, layers_at, record.layer_count, head),
        tables=tuple(int.from_bytes(raw[i : i + 2], "little") for i in range(0, len(raw), 2)),
    )
    return tile, after - at


def _ends_early(at: int) -> NoReturn:
    raise FormatError(_spec.ERROR_INDEX, at, "IDX-2", "the index ends within a tile")


def _read_layers(view: memoryview, at: int, count: int, head: _spec.IndexHead) -> dict[int, _spec.LayerRecord]:
    layers: dict[int, _spec.LayerRecord] = {}
    last = -1
    for i in range(count):
        place = at + i * head.layer_size
        record = _spec.unpack_layer_record(view, place)
        check_reserved(record, place, _spec.LAYER_RECORD_OFFSETS)
        if record.layer <= last or (i == 0 and record.layer != _spec.LAYER_GEOMETRY):
            raise FormatError(
                _spec.ERROR_INDEX, place, "TIL-2", "layer", found=record.layer, wanted="0, then ascending"
            )
        if record.layer < _spec.ANCILLARY_ID_MIN and record.layer not in _spec.LAYER_NAMES:
            raise UnsupportedError(f"layer {record.layer}", offset=place, clause="RES-2")
        if head.sh_degree < record.layer <= _spec.SH_DEGREE_MAX:
            raise FormatError(
                _spec.ERROR_INDEX, place, "TIL-3", "layer", found=record.layer, wanted=f"{head.sh_degree} at most"
            )
        if record.size < _spec.CHUNK_HEADER_SIZE:
            raise FormatError(
                _spec.ERROR_INDEX,
                place + _spec.LAYER_RECORD_OFFSETS["size"],
                "CHK-3",
                "size",
                found=record.size,
                wanted=f"{_spec.CHUNK_HEADER_SIZE} or more",
            )
        last = record.layer
        layers[last] = record
    if not layers:
        raise FormatError(_spec.ERROR_INDEX, at, "TIL-2", "a tile without layers", wanted="layer 0")
    if (_spec.LAYER_EXTRA in layers) != (head.extra_count > 0):
        raise FormatError(
            _spec.ERROR_INDEX, at, "TIL-5", f"layer EXTRA with {head.extra_count} extra columns", found=[*layers]
        )
    return layers


def _check_tile(tile: Tile, means_step: float) -> None:
    places = _spec.TILE_RECORD_OFFSETS
    if not 1 <= tile.splat_count <= _spec.TILE_SPLATS_MAX:
        raise FormatError(
            _spec.ERROR_VALUE,
            tile.offset,
            "TIL-1",
            "splat_count",
            found=tile.splat_count,
            wanted=f"1 to {_spec.TILE_SPLATS_MAX}",
        )
    for axis, (corner, extent) in enumerate(zip(tile.corner, tile.extent, strict=True)):
        if abs(corner) > _spec.INTEGER_MAX or abs(corner + extent) > _spec.INTEGER_MAX:
            raise FormatError(
                _spec.ERROR_VALUE,
                tile.offset + places["corner"] + 8 * axis,
                "TIL-7",
                "corner and corner + extent",
                found=(corner, corner + extent),
                wanted=f"{_spec.INTEGER_MAX} in magnitude at most",
            )
        if extent >> _spec.AXIS_BITS_MAX:
            raise FormatError(
                _spec.ERROR_VALUE,
                tile.offset + places["extent"] + 4 * axis,
                "TIL-8",
                "extent",
                found=extent,
                wanted=f"below 2^{_spec.AXIS_BITS_MAX}",
            )
    if scaled_step(means_step, tile.exponent) is None:
        raise FormatError(
            _spec.ERROR_VALUE,
            tile.offset + places["exponent"],
            "TIL-9",
            f"{means_step} x 2^{tile.exponent} is not positive, finite and at least 2^-1022",
        )


def _check_tables(tile: Tile, known: set[int], at: int) -> None:
    last = -1
    for i, table in enumerate(tile.tables):
        if table <= last or table not in known:
            raise FormatError(
                _spec.ERROR_INDEX, at + 2 * i, "TIL-6", "table id", found=table, wanted="ids of codebooks, ascending"
            )
        last = table
