"""A tile's chunks into blocks, and blocks into arrays (spec 5.2)."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.blocks import Block, Codebook
from csplat.decoder.coded import TileContext
from csplat.decoder.codings import read_block, read_raw
from csplat.decoder.container import check_reserved, open_chunk
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.reconstruct import write_bands, write_colour, write_lattice, write_opacities, write_quats
from csplat.decoder.streams import Ints
from csplat.errors import FormatError
from csplat.types import F32

_TILE_FLAGS = sum(flag for flag, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[_spec.CHUNK_TILE])


@dataclass(frozen=True)
class Arrays:
    """The arrays of section 3, for a scene or a tile of it.

    Attributes:
        means: [N, 3].
        quats: [N, 4], w, x, y, z.
        scales: [N, 3], natural logarithms.
        opacities: [N].
        sh0: [N, 3].
        shN: [N, K, 3].
        extra: [N] each, by name.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    extra: dict[str, NDArray[Any]]

    @classmethod
    def empty(cls, count: int, sh_degree: int, header: SceneHeader) -> Arrays:
        """Allocate arrays for `count` splats, not filled."""
        return cls(
            means=np.empty((count, 3), np.float32),
            quats=np.empty((count, 4), np.float32),
            scales=np.empty((count, 3), np.float32),
            opacities=np.empty(count, np.float32),
            sh0=np.empty((count, 3), np.float32),
            shN=np.empty((count, (sh_degree + 1) ** 2 - 1, 3), np.float32),
            extra={column.name: np.empty(count, column.dtype) for column in header.extras if column.dtype},
        )

    def part(self, start: int, stop: int) -> Arrays:
        """Return views of some splats."""
        return Arrays(
            means=self.means[start:stop],
            quats=self.quats[start:stop],
            scales=self.scales[start:stop],
            opacities=self.opacities[start:stop],
            sh0=self.sh0[start:stop],
            shN=self.shN[start:stop],
            extra={name: column[start:stop] for name, column in self.extra.items()},
        )


@dataclass(frozen=True)
class TileBlocks:
    """The integers of a tile.

    Attributes:
        tile: its record.
        blocks: by attribute id, those the tile has.
        extra: the bits of the extra columns of known types, in the order of their records.
    """

    tile: Tile
    blocks: dict[int, Block] = field(default_factory=dict)
    extra: list[Ints] = field(default_factory=list)


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


def write_tile(source: TileBlocks, header: SceneHeader, degree: int, opacities: F32, out: Arrays) -> None:
    """Reconstruct a tile's values.

    Args:
        source: the tile's integers.
        header: the scene.
        degree: highest SH band wanted.
        opacities: alpha of each level, `opacity_table`.
        out: the tile's part of the arrays.
    """
    blocks = source.blocks
    write_opacities(blocks[_spec.ATTRIBUTE_OPACITIES], opacities, out.opacities)
    scales = header.attribute(_spec.ATTRIBUTE_SCALES)
    largest = write_lattice(blocks[_spec.ATTRIBUTE_SCALES], scales, out.scales)
    check_max_scale(source, scales, largest)
    write_quats(blocks[_spec.ATTRIBUTE_QUATS], header.attribute(_spec.ATTRIBUTE_QUATS), out.quats)
    write_lattice(blocks[_spec.ATTRIBUTE_MEANS], header.attribute(_spec.ATTRIBUTE_MEANS), out.means)
    write_colour(blocks[_spec.ATTRIBUTE_SH0], header.attribute(_spec.ATTRIBUTE_SH0), out.sh0[:, None])
    bands = {band: _spec.ATTRIBUTE_SH0 + band for band in range(1, degree + 1)}
    write_bands(
        {band: blocks[attribute] for band, attribute in bands.items() if attribute in blocks},
        {band: header.attribute(attribute) for band, attribute in bands.items()},
        out.shN,
    )
    for bits, column in zip(source.extra, out.extra.values(), strict=True):
        column.view(bits.dtype)[:] = bits


def check_max_scale(source: TileBlocks, record: _spec.AttributeRecord, largest: int) -> None:
    """TIL-11; values grow with their integers, so the largest integer's value is the largest."""
    step = np.ldexp(record.step, source.blocks[_spec.ATTRIBUTE_SCALES].exponent)
    value = np.float32(np.float64(largest) * step)
    # Bit for bit: NaN differs from everything, and +0 from −0.
    if struct.pack("<f", source.tile.max_scale) != value.tobytes():
        raise FormatError(
            _spec.ERROR_BOX,
            source.tile.offset + _spec.TILE_RECORD_OFFSETS["max_scale"],
            "TIL-11",
            "max_scale",
            found=source.tile.max_scale,
            wanted=float(value),
        )
