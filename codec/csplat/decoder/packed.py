# SPDX-License-Identifier: Apache-2.0
"""Convert the blocks of a tile to integers of splats and tables of codebooks (`csplat.packed`)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from csplat import _spec
from csplat.decoder.blocks import Block, Codebook, CodebookBlock, ColumnBlock, TileBlocks
from csplat.decoder.container import SceneHeader
from csplat.decoder.entropy import Ints
from csplat.decoder.reconstruct import lattice_rows, quat_rows
from csplat.packed import PackedBand, PackedColumns, PackedTile


def pack_tables(books: Mapping[int, Codebook], header: SceneHeader) -> dict[tuple[int, int], PackedColumns]:
    """Return the rows of SH codebooks by codebook and band."""
    return {
        (identity, band): _pack_rows(ColumnBlock(entries.T, (0,) * entries.shape[1], 0, 0), header, band, len(entries))
        for identity, book in books.items()
        if book.record.kind == _spec.CODEBOOK_KIND_SH
        for band, entries in book.entries.items()
    }


def pack_tile(source: TileBlocks, header: SceneHeader, tables: Mapping[tuple[int, int], PackedColumns]) -> PackedTile:
    """Return the integers of a tile.

    Args:
        source: the tile's blocks.
        header: header and index.
        tables: from `pack_tables`.
    """
    count, blocks = source.tile.splat_count, source.blocks
    opacities = header.attribute(_spec.ATTRIBUTE_OPACITIES)
    quats = header.attribute(_spec.ATTRIBUTE_QUATS)
    bands: dict[int, PackedBand] = {}
    indices: dict[int, Ints] = {}  # by codebook: bands share them (CBK-4)
    for attribute, block in blocks.items():
        band = attribute - _spec.ATTRIBUTE_SH0
        if not 1 <= band <= _spec.SH_DEGREE_MAX:
            continue
        if isinstance(block, CodebookBlock):
            bands[band] = _pack_indices(block, header, band, tables, indices)
        else:
            bands[band] = PackedBand(_pack_rows(block, header, band, count))
    return PackedTile(
        means=_pack_columns(blocks[_spec.ATTRIBUTE_MEANS], header, _spec.ATTRIBUTE_MEANS, count),
        opacities=blocks[_spec.ATTRIBUTE_OPACITIES].rows(0, count, np.dtype(np.int32))[0],
        opacity_levels=opacities.levels,
        opacities_squared=opacities.mapping == _spec.MAPPING_SQUARE,
        scales=_pack_columns(blocks[_spec.ATTRIBUTE_SCALES], header, _spec.ATTRIBUTE_SCALES, count),
        quats=np.concatenate(
            [q.T.astype(np.int32) for _, _, q, _ in quat_rows(blocks[_spec.ATTRIBUTE_QUATS], quats, count)]
        ),
        quat_levels=quats.levels,
        sh0=_pack_columns(blocks[_spec.ATTRIBUTE_SH0], header, _spec.ATTRIBUTE_SH0, count),
        bands=bands,
    )


def _pack_indices(
    block: CodebookBlock,
    header: SceneHeader,
    band: int,
    tables: Mapping[tuple[int, int], PackedColumns],
    indices: dict[int, Ints],
) -> PackedBand:
    """Return a band coded by a codebook; its index [n] is added to `indices`, which the tile's bands share."""
    codebook, escaped = block.indices.book.record.codebook_id, block.indices.escaped
    table = tables[codebook, band]
    if codebook not in indices:
        index = indices[codebook] = block.indices.entry_indices.astype(np.int64)
        index[escaped] = len(table.integers) + np.arange(len(escaped))
    if block.escapes is None:
        rows = PackedColumns(np.empty((0, *table.integers.shape[1:]), table.integers.dtype), table.step)
    else:
        rows = _pack_rows(block.escapes, header, band, len(escaped))
    return PackedBand(rows, table, indices[codebook])


def _pack_rows(block: Block, header: SceneHeader, band: int, count: int) -> PackedColumns:
    """Return the integers of a band, [n, 2 l + 1, 3]."""
    packed = _pack_columns(block, header, _spec.ATTRIBUTE_SH0 + band, count)
    return PackedColumns(packed.integers.reshape(count, 2 * band + 1, 3), packed.step)


def _pack_columns(block: Block, header: SceneHeader, attribute: int, count: int) -> PackedColumns:
    """Return the integers of means, scales or colours, [n, C], the three of a coefficient side by side."""
    record = header.attribute(attribute)
    columns = _spec.ATTRIBUTE_COLUMNS[attribute]
    integers = np.empty((count, columns // 3, 3), np.int64)
    for start, stop, parts in lattice_rows(block, record, count):
        for channel, part in enumerate(parts):
            integers[start:stop, :, channel] = part.T
    return PackedColumns(integers.reshape(count, columns), math.ldexp(record.step, block.exponent))
