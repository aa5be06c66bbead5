# SPDX-License-Identifier: Apache-2.0
"""Read the blocks of tiles, in every attribute coding, and check the ranges of their integers (spec 5.2, 6.4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from csplat import _spec
from csplat.decoder.blocks import (
    Block,
    Codebook,
    CodebookBlock,
    ColumnBlock,
    Indices,
    SparseBlock,
    TileBlocks,
    cache_sized_ranges,
    check_integers,
    check_step,
    morton_axes,
    read_block_head,
    read_columns,
    read_exponent,
    read_offsets,
    read_signed,
)
from csplat.decoder.codebooks import attribute_columns
from csplat.decoder.container import (
    EXTRA_LAYERS,
    TILE_FLAGS,
    Cursor,
    ExtraColumn,
    SceneHeader,
    Tile,
    check_reserved,
    open_chunk,
    refuse_field,
)
from csplat.decoder.entropy import Ints, read_stream
from csplat.errors import FormatError

_ESCAPE_CODINGS = (_spec.CODING_OFFSET, _spec.CODING_SIGNED)

_WIDE = np.dtype(np.int64)

_OFFSET_SIZE = 4  # bytes of a column's offset, i32
#: For each coding except CODEBOOK and RAW: size of the parameters, True if offsets follow, number of streams.
_SHAPES = {
    _spec.CODING_LEVELS: (0, False, 1),
    _spec.CODING_MORTON: (_spec.MORTON_PARAMS_SIZE, False, 1),
    _spec.CODING_AXIS: (0, False, 1),
    _spec.CODING_OFFSET: (_spec.LATTICE_PARAMS_SIZE, True, 1),
    _spec.CODING_SIGNED: (_spec.LATTICE_PARAMS_SIZE, False, 1),
    _spec.CODING_SPARSE: (_spec.SPARSE_PARAMS_SIZE, False, 2),
}


@dataclass
class TileContext:
    """Data that the blocks of a tile may refer to.

    Attributes:
        header: header and index.
        tile: the tile.
        books: the codebooks by id.
        first: indices of the tile's first block of each codebook, by codebook id.
    """

    header: SceneHeader
    tile: Tile
    books: Mapping[int, Codebook]
    first: dict[int, Indices] = field(default_factory=dict)


def wanted_layers(tile: Tile, degree: int) -> list[_spec.LayerRecord]:
    """Return the layers of a tile to read: all but the SH bands above `degree`."""
    return [layer for layer in tile.layers.values() if not degree < layer.layer <= _spec.SH_DEGREE_MAX]


def read_tile(
    view: memoryview, header: SceneHeader, tile: Tile, degree: int, books: Mapping[int, Codebook]
) -> TileBlocks:
    """Read layer 0, the SH layers up to `degree` and the extra columns of a tile; check frames of unknown layers."""
    context = TileContext(header, tile, books)
    result = TileBlocks(tile)
    for layer in wanted_layers(tile, degree):
        cursor = open_chunk(view, layer, _spec.CHUNK_TILE, TILE_FLAGS, "TLE-3")
        if header.skips(layer.layer):
            continue
        is_extra = layer.layer in EXTRA_LAYERS
        wanted = [r.attribute for r in header.attributes if _spec.ATTRIBUTE_LAYER[r.attribute] == layer.layer]
        _read_tile_head(view, cursor.take(_spec.TILE_HEAD_SIZE), layer.layer, 1 if is_extra else len(wanted))
        if is_extra:
            column = header.extras[layer.layer - EXTRA_LAYERS.start]
            result.extra.append(read_raw(cursor, tile.splat_count, column))
        for attribute in wanted:
            result.blocks[attribute] = read_block(cursor, context, attribute)
        cursor.finish()
    return result


def codebook_references(view: memoryview, header: SceneHeader, layer: _spec.LayerRecord) -> Iterator[tuple[int, int]]:
    """Find the codebook ids in a tile's chunk of layer 0 or of an SH band, without decoding streams.

    Args:
        view: the file, at least up to the end of the chunk.
        header: header and index.
        layer: the chunk's record.

    Yields:
        Offset of each id in the file, and the id.

    Raises:
        FormatError: the chunk's frame or a structure breaks a clause.
    """
    cursor = open_chunk(view, layer, _spec.CHUNK_TILE, TILE_FLAGS, "TLE-3")
    cursor.take(_spec.TILE_HEAD_SIZE)
    for attribute in (record.attribute for record in header.attributes):
        if _spec.ATTRIBUTE_LAYER[attribute] != layer.layer:
            continue
        coding = read_block_head(cursor, attribute)
        if coding == _spec.CODING_CODEBOOK:
            yield _step_over_coded(cursor, header, attribute)
        else:
            _step_over(cursor, attribute, coding)
    cursor.finish()


def _read_tile_head(view: memoryview, at: int, layer: int, block_count: int) -> None:
    """Check the tile head at offset `at`: RES-1, TLE-1, TLE-2."""
    head = _spec.unpack_tile_head(view, at)
    offsets = _spec.TILE_HEAD_OFFSETS
    check_reserved(head, at, offsets)
    if head.layer != layer:
        refuse_field(_spec.ERROR_INDEX, "TLE-1", head, at, offsets, "layer", layer)
    if head.block_count != block_count:
        refuse_field(_spec.ERROR_STREAM, "TLE-2", head, at, offsets, "block_count", block_count)


def read_block(cursor: Cursor, context: TileContext, attribute: int) -> Block:
    """Read the block of an attribute and step over it."""
    at = cursor.at
    coding = read_block_head(cursor, attribute)
    count = context.tile.splat_count
    if coding == _spec.CODING_CODEBOOK:
        return read_codebook_block(cursor, context, attribute, at)
    if coding in (_spec.CODING_MORTON, _spec.CODING_AXIS):
        return read_means(cursor, context, coding)
    if coding == _spec.CODING_SPARSE:
        return read_sparse(cursor, context, attribute)
    return read_columns(cursor, context.header, attribute, coding, count)


def read_sparse(cursor: Cursor, context: TileContext, attribute: int) -> SparseBlock:
    """Read the rest of a SPARSE block; check SPA-1 to SPA-3, LAT-1 and LAT-4."""
    at, offsets = cursor.take(_spec.SPARSE_PARAMS_SIZE), _spec.SPARSE_PARAMS_OFFSETS
    params = _spec.unpack_sparse_params(cursor.view, at)
    check_reserved(params, at, offsets)
    record, count = context.header.attribute(attribute), context.tile.splat_count
    check_step(record, params.exponent, at + offsets["exponent"])
    if not 1 <= params.present_count <= count:
        refuse_field(_spec.ERROR_VALUE, "SPA-1", params, at, offsets, "present_count", f"1 to {count}")
    mask_at = cursor.at
    bits = np.unpackbits(read_stream(cursor, (count + 7) >> 3, 1), bitorder="little")
    if bits[count:].any():
        raise FormatError(_spec.ERROR_RANGE, mask_at, "SPA-3", "bits of the mask beyond the last splat", wanted=0)
    present = np.flatnonzero(bits)
    if len(present) != params.present_count:
        bit_count, wanted = len(present), params.present_count
        raise FormatError(_spec.ERROR_RANGE, mask_at, "SPA-2", "bits of the mask", found=bit_count, wanted=wanted)
    return SparseBlock(read_signed(cursor, record, params.exponent, len(present)), present)


def read_raw(cursor: Cursor, count: int, column: ExtraColumn) -> Ints:
    """Read the block of an extra column of `count` splats; return the bits of its values as unsigned integers.

    Returns:
        [count], or [count, components] if there are several.
    """
    coding = read_block_head(cursor, _spec.ATTRIBUTE_EXTRA)
    width_at = cursor.at
    elements = read_stream(cursor, count * column.components, _spec.CODING_WIDTH_MAX[coding])
    width, wanted = cursor.view[width_at], np.dtype(column.dtype).itemsize
    if width != wanted:
        raise FormatError(_spec.ERROR_STREAM, width_at, "RAW-2", "width", found=width, wanted=wanted)
    return elements if column.components == 1 else elements.reshape(column.components, count).T


def read_means(cursor: Cursor, context: TileContext, coding: int) -> ColumnBlock:
    """Read the rest of a MORTON or AXIS block, the lattice integers of the means."""
    tile = context.tile
    count, width_max = tile.splat_count, _spec.CODING_WIDTH_MAX[coding]
    if coding == _spec.CODING_MORTON:
        params_at, offsets = cursor.take(_spec.MORTON_PARAMS_SIZE), _spec.MORTON_PARAMS_OFFSETS
        params = _spec.unpack_morton_params(cursor.view, params_at)
        check_reserved(params, params_at, offsets)
        if not 1 <= params.bits <= _spec.MORTON_BITS_MAX:
            wanted = f"1 to {_spec.MORTON_BITS_MAX}"
            refuse_field(_spec.ERROR_VALUE, "MOR-1", params, params_at, offsets, "bits", wanted)
        at = cursor.at
        codes = read_stream(cursor, count, width_max)
        _check_bits(codes, 3 * params.bits, at, "MOR-2")
        q = morton_axes(codes)
    else:
        at = cursor.at
        q = read_stream(cursor, 3 * count, width_max).reshape(3, count)
        _check_bits(q, _spec.AXIS_BITS_MAX, at, "AXI-1")
    block = ColumnBlock(q, tile.corner, tile.exponent, at)
    far = tuple(corner + extent for corner, extent in zip(tile.corner, tile.extent, strict=True))
    if block.lows != tile.corner or block.highs != far:
        at, box = tile.offset + _spec.TILE_RECORD_OFFSETS["corner"], f"{tile.corner} to {far}"
        wanted = f"{block.lows} to {block.highs}, the box of its splats"
        raise FormatError(_spec.ERROR_BOX, at, "TIL-10", "the tile's box", found=box, wanted=wanted)
    return block


def _check_bits(elements: Ints, bits: int, at: int, clause: str) -> None:
    """Check that unsigned integers, in an array of any shape, are below 2^bits."""
    largest = int(elements.max())
    if largest >> bits:
        raise FormatError(_spec.ERROR_RANGE, at, clause, "integer", found=largest, wanted=f"below 2^{bits}")


def read_codebook_block(cursor: Cursor, context: TileContext, attribute: int, at: int) -> CodebookBlock:
    """Read the rest of a CODEBOOK block whose head is at `at`: indices, summand, escapes; check CBK-1 to CBK-6."""
    params_at = cursor.take(_spec.CODEBOOK_PARAMS_SIZE)
    params = _spec.unpack_codebook_params(cursor.view, params_at)
    check_reserved(params, params_at, _spec.CODEBOOK_PARAMS_OFFSETS)
    book = context.books.get(params.codebook_id)
    columns = attribute_columns(book.record, attribute) if book else None
    if book is None or columns is None or params.codebook_id not in context.tile.codebook_ids:
        detail = f"codebook {params.codebook_id} is not of the tile or not for {_spec.ATTRIBUTE_NAMES[attribute]}"
        raise FormatError(_spec.ERROR_CODEBOOK, params_at, "CBK-1", detail)
    indices = _indices(cursor, context, attribute, book, params, params_at)
    summand = None
    if attribute == _spec.ATTRIBUTE_SCALES:
        summand = _read_summand(cursor, context, attribute)
    escapes = None
    if params.escape_count:
        legal = (_spec.CODING_SIGNED,) if attribute == _spec.ATTRIBUTE_QUATS else _ESCAPE_CODINGS
        coding = read_block_head(cursor, attribute, legal)
        escapes = read_columns(cursor, context.header, attribute, coding, params.escape_count, escape=True)
    layer = _spec.ATTRIBUTE_LAYER[attribute]
    block = CodebookBlock(indices, book.entries[layer][:, columns], escapes, summand, at)
    if summand is not None:
        _check_sums(block, context)  # for other attributes, CBK-7 has bounded the entries
    return block


def holds_indices(book: _spec.CodebookRecord, attribute: int) -> bool:
    """Return True if blocks of this attribute store the indices of the codebook."""
    if book.kind == _spec.CODEBOOK_KIND_SH:
        return attribute == _spec.ATTRIBUTE_SH0 + book.band_first
    return _spec.ATTRIBUTE_NAMES[attribute] == _spec.CODEBOOK_KIND_ATTRIBUTES[book.kind][0]


def _indices(
    cursor: Cursor, context: TileContext, attribute: int, book: Codebook, params: _spec.CodebookParams, params_at: int
) -> Indices:
    """Read the indices, or return the indices of the codebook's first block in the tile (CBK-4)."""
    if holds_indices(book.record, attribute):
        indices = _read_indices(cursor, context, attribute, book, params.escape_count, params_at)
        context.first[params.codebook_id] = indices
        return indices
    known = context.first.get(params.codebook_id)
    if known is None or len(known.escaped) != params.escape_count:
        detail = f"{_spec.ATTRIBUTE_NAMES[attribute]} disagrees with the codebook's first block in the escape count"
        wanted = "a first block" if known is None else len(known.escaped)
        raise FormatError(_spec.ERROR_CODEBOOK, params_at, "CBK-4", detail, found=params.escape_count, wanted=wanted)
    return known


def _read_indices(
    cursor: Cursor, context: TileContext, attribute: int, book: Codebook, escape_count: int, params_at: int
) -> Indices:
    """Read the entry index of each splat.

    Args:
        cursor: at the stream of indices.
        context: the tile.
        attribute: registry value.
        book: the codebook.
        escape_count: number of escapes by the parameters of the block.
        params_at: offset of these parameters.

    Raises:
        FormatError: E_CODEBOOK by CBK-2 or CBK-3; or the stream of indices is invalid.
    """
    count = context.tile.splat_count
    escape_index, stream_at = book.record.size, cursor.at  # the index after the last entry's marks an escape
    entry_indices = read_stream(cursor, count, _spec.CODING_WIDTH_MAX[_spec.CODING_CODEBOOK])
    largest = int(entry_indices.max())
    if largest > escape_index:
        wanted = f"at most {escape_index}"
        raise FormatError(_spec.ERROR_CODEBOOK, stream_at, "CBK-2", "index of an entry", found=largest, wanted=wanted)
    escaped = np.flatnonzero(entry_indices == escape_index)
    if len(escaped) != escape_count:
        field_at = params_at + _spec.CODEBOOK_PARAMS_OFFSETS["escape_count"]
        wanted_count = len(escaped)
        raise FormatError(
            _spec.ERROR_CODEBOOK, field_at, "CBK-3", "escape_count", found=escape_count, wanted=wanted_count
        )
    return Indices(book, attribute, entry_indices, escaped)


def _read_summand(cursor: Cursor, context: TileContext, attribute: int) -> ColumnBlock:
    """Read the common summand of the scales, which is on the file's lattice."""
    read_exponent(cursor, context.header.attribute(attribute), fixed=True)
    offsets = read_offsets(cursor, 1)
    at = cursor.at
    count, width_max = context.tile.splat_count, _spec.CODING_WIDTH_MAX[_spec.CODING_OFFSET]
    elements = read_stream(cursor, count, width_max)
    return ColumnBlock(elements.reshape(1, count), offsets, 0, at)


def _check_sums(block: CodebookBlock, context: TileContext) -> None:
    """Check CBK-6: the sums of the scales obey LAT-4."""
    if block.bound <= _spec.COLUMN_MAX:
        return
    record = context.header.attribute(_spec.ATTRIBUTE_SCALES)
    for start, stop in cache_sized_ranges(context.tile.splat_count, 3):
        rows = block.rows(start, stop, _WIDE)
        lows = tuple(int(value) for value in rows.min(axis=1))
        highs = tuple(int(value) for value in rows.max(axis=1))
        check_integers(lows, highs, record, block.at)


def _step_over_coded(cursor: Cursor, header: SceneHeader, attribute: int) -> tuple[int, int]:
    """Step over the rest of a CODEBOOK block after its head; return the offset of its codebook id, and the id.

    Raises:
        FormatError: E_CODEBOOK for an unknown codebook (CBK-1), or the payload ends within the block.
    """
    at = cursor.take(_spec.CODEBOOK_PARAMS_SIZE)
    params = _spec.unpack_codebook_params(cursor.view, at)
    book = next((record for record in header.codebooks if record.codebook_id == params.codebook_id), None)
    if book is None:
        raise FormatError(_spec.ERROR_CODEBOOK, at, "CBK-1", f"there is no codebook {params.codebook_id}")
    if holds_indices(book, attribute):
        _step_over_stream(cursor)
    if attribute == _spec.ATTRIBUTE_SCALES:  # the summand: lattice parameters and an offset
        cursor.take(_spec.LATTICE_PARAMS_SIZE + _OFFSET_SIZE)
        _step_over_stream(cursor)
    if params.escape_count:
        _step_over(cursor, attribute, read_block_head(cursor, attribute, (_spec.CODING_OFFSET, _spec.CODING_SIGNED)))
    return at + _spec.CODEBOOK_PARAMS_OFFSETS["codebook_id"], params.codebook_id


def _step_over(cursor: Cursor, attribute: int, coding: int) -> None:
    """Step over the rest of a block of another coding after its head."""
    size, offsets, streams = _SHAPES[coding]
    cursor.take(size + _OFFSET_SIZE * offsets * _spec.ATTRIBUTE_COLUMNS[attribute])
    for _ in range(streams):
        _step_over_stream(cursor)


def _step_over_stream(cursor: Cursor) -> None:
    """Advance the cursor over a stream: its head and its coded bytes."""
    at = cursor.take(_spec.STREAM_HEAD_SIZE)
    cursor.take(_spec.unpack_stream_head(cursor.view, at).coded_size)
