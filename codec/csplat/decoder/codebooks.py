# SPDX-License-Identifier: Apache-2.0
"""Read codebooks, tables of integer vectors that tiles refer to (spec 5.3)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from csplat import _spec
from csplat.decoder.blocks import Codebook, ColumnBlock, check_integers
from csplat.decoder.container import SceneHeader, Tile, check_reserved, open_chunk, refuse_field
from csplat.decoder.entropy import Ints, read_stream
from csplat.decoder.reconstruct import check_values, quat_rows, write_colour

_ENTRY_WIDTH_MAX = 4  # STR-2: "4 for codebooks' entries"
_ATTRIBUTE_OF = {name: attribute for attribute, name in _spec.ATTRIBUTE_NAMES.items()}


def layer_columns(record: _spec.CodebookRecord, layer: int) -> int:
    """Return the number of columns of a CODB chunk: of its band, or of all attributes of its kind."""
    if record.kind == _spec.CODEBOOK_KIND_SH:
        return _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH0 + layer]
    names = _spec.CODEBOOK_KIND_ATTRIBUTES[record.kind]
    return sum(_spec.ATTRIBUTE_COLUMNS[_ATTRIBUTE_OF[name]] for name in names)


def attribute_columns(record: _spec.CodebookRecord, attribute: int) -> slice | None:
    """Return the columns of an attribute in the entries of its layer, `None` if CBK-1 forbids it."""
    if record.kind == _spec.CODEBOOK_KIND_SH:
        band = attribute - _spec.ATTRIBUTE_SH0
        legal = 1 <= band <= _spec.SH_DEGREE_MAX and record.band_first <= band <= record.band_last
        return slice(0, _spec.ATTRIBUTE_COLUMNS[attribute]) if legal else None
    first = 0
    for name in _spec.CODEBOOK_KIND_ATTRIBUTES[record.kind]:
        columns = _spec.ATTRIBUTE_COLUMNS[_ATTRIBUTE_OF[name]]
        if _ATTRIBUTE_OF[name] == attribute:
            return slice(first, first + columns)
        first += columns
    return None


def table_bytes(header: SceneHeader, tiles: Iterable[Tile], degree: int, *, whole: bool) -> int:
    """Return the size of the codebooks by LIM-1: four bytes per entry and column.

    Args:
        header: header and index.
        tiles: tiles to decode.
        degree: highest SH band to decode.
        whole: include codebooks that no tile refers to, which a whole decode checks.
    """
    books = {book.codebook_id: book for book in header.codebooks}
    elements = 0
    for record in _codebook_chunks(header) if whole else wanted_codebooks(header, tiles, degree):
        book = books[record.id]
        elements += book.size * layer_columns(book, record.layer)
    return 4 * elements


def read_codebooks(view: memoryview, header: SceneHeader, tiles: Iterable[Tile], degree: int) -> dict[int, Codebook]:
    """Read the codebooks that some tiles refer to, bands up to `degree`."""
    records = {book.codebook_id: book for book in header.codebooks}
    books: dict[int, Codebook] = {}
    for record in wanted_codebooks(header, tiles, degree):
        book = books.setdefault(record.id, Codebook(records[record.id]))
        book.entries[record.layer] = _read_chunk(view, header, record, book.record)
    for book in books.values():
        if book.record.kind == _spec.CODEBOOK_KIND_SH:
            _fill_values(book, header)
    return books


def check_unnamed_codebooks(view: memoryview, header: SceneHeader) -> None:
    """Read the codebooks that no tile refers to, to check them."""
    records = {book.codebook_id: book for book in header.codebooks}
    named = {identity for tile in header.tiles for identity in tile.codebook_ids}
    for record in _codebook_chunks(header):
        if record.id not in named:
            _read_chunk(view, header, record, records[record.id])


def _codebook_chunks(header: SceneHeader) -> list[_spec.DirectoryRecord]:
    """Return the directory records of the codebook chunks, in the order of the directory."""
    return [record for record in header.directory if record.type == _spec.CHUNK_CODEBOOK]


def wanted_codebooks(header: SceneHeader, tiles: Iterable[Tile], degree: int) -> list[_spec.DirectoryRecord]:
    """Return the records of the codebook chunks that some tiles refer to, bands up to `degree`."""
    ids = {identity for tile in tiles for identity in tile.codebook_ids}
    chunks = [record for record in _codebook_chunks(header) if record.id in ids and record.layer <= degree]
    return sorted(chunks, key=lambda record: (record.id, record.layer))


def _read_chunk(
    view: memoryview, header: SceneHeader, record: _spec.DirectoryRecord, book: _spec.CodebookRecord
) -> Ints:
    """Read and check a codebook chunk (CDB-1, CDB-2, and the clauses of streams and entries).

    Args:
        view: the file.
        header: its header.
        record: directory record of the chunk.
        book: record of its codebook.

    Returns:
        [size, columns], integers of the entries.
    """
    cursor = open_chunk(view, record, record.type, record.flags, "CDB-2")
    at = cursor.take(_spec.CODEBOOK_HEAD_SIZE)
    head = _spec.unpack_codebook_head(view, at)
    check_reserved(head, at, _spec.CODEBOOK_HEAD_OFFSETS)
    for name, wanted in (("codebook_id", book.codebook_id), ("layer", record.layer)):
        if getattr(head, name) != wanted:
            refuse_field(_spec.ERROR_INDEX, "CDB-1", head, at, _spec.CODEBOOK_HEAD_OFFSETS, name, wanted)
    columns, stream_at = layer_columns(book, record.layer), cursor.at
    elements = read_stream(cursor, book.size * columns, _ENTRY_WIDTH_MAX, signed=True).reshape(columns, book.size)
    _check_entries(elements, header, book, record.layer, stream_at)
    cursor.finish()
    # One row per entry, so that a gather copies whole rows; a copy, so that it does not keep the file alive.
    return np.array(elements.T, order="C")


def _check_entries(entries: Ints, header: SceneHeader, book: _spec.CodebookRecord, layer: int, at: int) -> None:
    """Check CBK-7 for the entries [C, size] of a layer, whose stream is at `at`."""
    for attribute, record in enumerate(header.attributes, _spec.ATTRIBUTE_OPACITIES):
        columns = attribute_columns(book, attribute)
        if columns is None or _spec.ATTRIBUTE_LAYER[attribute] != layer:
            continue
        if attribute == _spec.ATTRIBUTE_SCALES:
            continue  # CBK-6 bounds the sums of entry and summand instead
        block = ColumnBlock(entries[columns], (0,) * _spec.ATTRIBUTE_COLUMNS[attribute], 0, at)
        check_integers(block.lows, block.highs, record, at)
        if attribute == _spec.ATTRIBUTE_QUATS:
            for _ in quat_rows(block, record, entries.shape[1]):
                pass  # QUA-2
        else:
            check_values(block, record, entries.shape[1])


def _fill_values(book: Codebook, header: SceneHeader) -> None:
    """Dequantise the entries of an SH codebook once, so that splats copy float32 rows."""
    count = sum(2 * band + 1 for band in book.entries)
    book.values = np.empty((book.record.size, count, 3), np.float32)
    row = 0
    for band in sorted(book.entries):
        columns = ColumnBlock(book.entries[band].T, (0,) * (3 * (2 * band + 1)), 0, 0)
        record = header.attribute(_spec.ATTRIBUTE_SH0 + band)
        write_colour(columns, record, book.values[:, row : row + 2 * band + 1])
        row += 2 * band + 1
