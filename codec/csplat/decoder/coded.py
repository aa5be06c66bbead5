"""The coding CODEBOOK (spec 6.4.5), and what the blocks of a tile share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from csplat import _spec
from csplat.decoder.blocks import Codebook, Coded, Columns, Indices, runs
from csplat.decoder.codebooks import attribute_columns
from csplat.decoder.container import Cursor, check_reserved
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.lattice import (
    check_integers,
    read_block_head,
    read_columns,
    read_exponent,
    read_offsets,
)
from csplat.decoder.streams import read_stream
from csplat.errors import FormatError

_ESCAPE_CODINGS = (_spec.CODING_OFFSET, _spec.CODING_SIGNED)
_WIDE = np.dtype(np.int64)


@dataclass
class TileContext:
    """Everything that the blocks of one tile may refer to.

    Attributes:
        header: the scene.
        tile: the tile.
        books: the codebooks that were read.
        first: indices of the tile's first block of each codebook, by codebook id.
    """

    header: SceneHeader
    tile: Tile
    books: Mapping[int, Codebook]
    first: dict[int, Indices] = field(default_factory=dict)


def read_coded(cursor: Cursor, context: TileContext, attribute: int, at: int) -> Coded:
    """Read what follows the block head at `at`: indices, summand, escape block; CBK-1 to CBK-6."""
    params_at = cursor.take(_spec.CODEBOOK_PARAMS_SIZE)
    params = _spec.unpack_codebook_params(cursor.view, params_at)
    check_reserved(params, params_at, _spec.CODEBOOK_PARAMS_OFFSETS)
    book = context.books.get(params.codebook_id)
    columns = attribute_columns(book.record, attribute) if book else None
    if book is None or columns is None or params.codebook_id not in context.tile.tables:
        raise FormatError(
            _spec.ERROR_CODEBOOK,
            params_at,
            "CBK-1",
            f"codebook {params.codebook_id} is not of the tile or not for {_spec.ATTRIBUTE_NAMES[attribute]}",
        )
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
    block = Coded(indices, book.entries[layer][:, columns], escapes, summand, at)
    if summand is not None:
        _check_sums(block, context)  # in other blocks, CBK-7 has already checked the entries
    return block


def leads(book: _spec.CodebookRecord, attribute: int) -> bool:
    """Return True if the block of that attribute holds the indices of a codebook, which its other blocks use."""
    if book.kind == _spec.CODEBOOK_KIND_SH:
        return attribute == _spec.ATTRIBUTE_SH0 + book.band_first
    return _spec.ATTRIBUTE_NAMES[attribute] == _spec.CODEBOOK_KIND_ATTRIBUTES[book.kind][0]


def _indices(
    cursor: Cursor,
    context: TileContext,
    attribute: int,
    book: Codebook,
    params: _spec.CodebookParams,
    at: int,
) -> Indices:
    """Read the indices, or find those of the tile's first block of the codebook (CBK-4)."""
    name = _spec.ATTRIBUTE_NAMES[attribute]
    if leads(book.record, attribute):
        indices = _read_indices(cursor, context, attribute, book, params.escape_count, at)
        context.first[params.codebook_id] = indices
        return indices
    known = context.first.get(params.codebook_id)
    if known is None or len(known.escaped) != params.escape_count:
        raise FormatError(
            _spec.ERROR_CODEBOOK,
            at,
            "CBK-4",
            f"{name} follows no block of the codebook's first attribute with as many escapes",
            found=params.escape_count,
            wanted=None if known is None else len(known.escaped),
        )
    return known


def _read_indices(
    cursor: Cursor, context: TileContext, attribute: int, book: Codebook, escape_count: int, at: int
) -> Indices:
    count = context.tile.splat_count
    size, stream_at = book.record.size, cursor.at
    places = read_stream(cursor, count, _spec.CODING_WIDTH_MAX[_spec.CODING_CODEBOOK])
    largest = int(places.max())
    if largest > size:
        raise FormatError(
            _spec.ERROR_CODEBOOK, stream_at, "CBK-2", "index of an entry", found=largest, wanted=f"at most {size}"
        )
    escaped = np.flatnonzero(places == size)
    if len(escaped) != escape_count:
        raise FormatError(
            _spec.ERROR_CODEBOOK,
            at + _spec.CODEBOOK_PARAMS_OFFSETS["escape_count"],
            "CBK-3",
            "escape_count",
            found=escape_count,
            wanted=len(escaped),
        )
    return Indices(book, attribute, places, escaped)


def _read_summand(cursor: Cursor, context: TileContext, attribute: int) -> Columns:
    """The common summand of scales, on the file's lattice as their entries are."""
    read_exponent(cursor, context.header.attribute(attribute), fixed=True)
    offsets = read_offsets(cursor, 1)
    at = cursor.at
    count, width_max = context.tile.splat_count, _spec.CODING_WIDTH_MAX[_spec.CODING_OFFSET]
    elements = read_stream(cursor, count, width_max)
    return Columns(elements.reshape(1, count), offsets, 0, at)


def _check_sums(block: Coded, context: TileContext) -> None:
    """CBK-6: the sums of scales obey what LAT-4 requires of integers in a stream."""
    if block.bound <= _spec.COLUMN_MAX:
        return
    record = context.header.attribute(_spec.ATTRIBUTE_SCALES)
    for start, stop in runs(context.tile.splat_count, 3):
        rows = block.rows(start, stop, _WIDE)
        lows = tuple(int(value) for value in rows.min(axis=1))
        highs = tuple(int(value) for value in rows.max(axis=1))
        check_integers(lows, highs, record, block.at)
