"""A tile's chunks into blocks, and blocks into arrays (spec 5.2)."""

from __future__ import annotations

from collections.abc import Mapping

from csplat import _spec
from csplat.decoder.blocks import Codebook, TileBlocks
from csplat.decoder.coded import TileContext
from csplat.decoder.codings import read_block, read_raw
from csplat.decoder.container import check_reserved, open_chunk
from csplat.decoder.header import SceneHeader, Tile
from csplat.errors import FormatError

_TILE_FLAGS = sum(flag for flag, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[_spec.CHUNK_TILE])


def wanted_layers(tile: Tile, degree: int) -> list[_spec.LayerRecord]:
    """Return what is read of a tile: all of its layers but the SH bands above `degree`."""
    return [layer for layer in tile.layers.values() if not degree < layer.layer <= _spec.SH_DEGREE_MAX]


def read_tile(
    view: memoryview, header: SceneHeader, tile: Tile, degree: int, books: Mapping[int, Codebook]
) -> TileBlocks:
    """Read layer 0, the SH layers up to `degree` and the extra layer of a tile; of others only the frame."""
    context = TileContext(header, tile, books)
    result = TileBlocks(tile)
    for layer in wanted_layers(tile, degree):
        cursor = open_chunk(view, layer, _spec.CHUNK_TILE, _TILE_FLAGS, "TLE-3")
        if layer.layer not in _spec.LAYER_NAMES:
            continue  # ANC-2
        if layer.layer == _spec.LAYER_EXTRA:
            wanted = [_spec.ATTRIBUTE_EXTRA] * len(header.extras)
        else:
            wanted = [
                record.attribute
                for record in header.attributes
                if _spec.ATTRIBUTE_LAYER[record.attribute] == layer.layer
            ]
        _read_tile_head(view, cursor.take(_spec.TILE_HEAD_SIZE), layer.layer, len(wanted))
        for place, attribute in enumerate(wanted):
            if attribute == _spec.ATTRIBUTE_EXTRA:
                bits = read_raw(cursor, context, place)
                if header.extras[place].dtype:
                    result.extra.append(bits)
            else:
                result.blocks[attribute] = read_block(cursor, context, attribute)
        cursor.finish()
    return result


def _read_tile_head(view: memoryview, at: int, layer: int, block_count: int) -> None:
    head = _spec.unpack_tile_head(view, at)
    places = _spec.TILE_HEAD_OFFSETS
    check_reserved(head, at, places)
    for name, found, wanted, code, clause in (
        ("layer", head.layer, layer, _spec.ERROR_INDEX, "TLE-1"),
        # A layer of more than 255 extra columns cannot be counted and is refused here.
        ("block_count", head.block_count, block_count, _spec.ERROR_STREAM, "TLE-2"),
    ):
        if found != wanted:
            raise FormatError(code, at + places[name], clause, name, found=found, wanted=wanted)
