"""Read codebook chunks (spec 5.3), and find the columns of an attribute in their entries."""

from __future__ import annotations

import numpy as np

from csplat import _spec
from csplat.types import I64
from csplat_conformance.validator.index import Chunk, CodebookAt, Index
from csplat_conformance.validator.streams import read_stream
from csplat_conformance.validator.values import Place, check_integers
from csplat_conformance.validator.violation_log import Payload, ViolationLog

#: The entries, [size, C], of chunks that are sound, by codebook id and layer.
CodebookEntries = dict[tuple[int, int], I64]

_ENTRY_WIDTH_MAX = 4  # STR-2: "4 for codebooks' entries"
_ATTRIBUTES = {name: value for value, name in _spec.ATTRIBUTE_NAMES.items()}


def codebook_attributes(book: CodebookAt) -> list[int]:
    """Return the attributes that a codebook holds, in its order."""
    if book.record.kind == _spec.CODEBOOK_KIND_SH:
        return [_spec.ATTRIBUTE_SH0 + band for band in range(book.record.band_first, book.record.band_last + 1)]
    return [_ATTRIBUTES[name] for name in _spec.CODEBOOK_KIND_ATTRIBUTES[book.record.kind]]


def first_attribute(book: CodebookAt) -> int:
    """Return the attribute whose block holds the indices."""
    return codebook_attributes(book)[0]


def attribute_columns(book: CodebookAt, attribute: int) -> slice | None:
    """Return the columns of an attribute in the entries of its layer, `None` if the codebook does not hold it."""
    first = 0
    for served in codebook_attributes(book):
        columns = _spec.ATTRIBUTE_COLUMNS[served]
        if book.record.kind == _spec.CODEBOOK_KIND_SH:
            first = 0  # each band has a chunk of its own
        if served == attribute:
            return slice(first, first + columns)
        first += columns
    return None


def read_codebook(payload: Payload, chunk: Chunk, index: Index, books: CodebookEntries) -> None:
    """Read the payload of a CODB chunk.

    Args:
        payload: payload of the chunk.
        chunk: the chunk.
        index: index of the file.
        books: receives the entries, if a sound codebook record requires the chunk.

    Raises:
        UnreadableError: the payload ends too early.
    """
    log = payload.log
    book = index.codebooks.get(chunk.identity)
    layers = () if book is None else range(book.record.band_first, book.record.band_last + 1)
    head = payload.structure(_spec.unpack_codebook_head, _spec.CODEBOOK_HEAD_SIZE, _spec.CODEBOOK_HEAD_OFFSETS, "head")
    for key, wanted in (("codebook_id", chunk.identity), ("layer", chunk.layer)):
        found = getattr(head.record, key)
        if found != wanted:
            log.add_field("CDB-1", head, key, f"{found}, its records say {wanted}")
    if book is None or chunk.layer not in layers:
        log.skip(f"{chunk.name} from byte {payload.at} on", "no sound codebook record asks for it")
        return
    of_layer = [a for a in codebook_attributes(book) if _spec.ATTRIBUTE_LAYER[a] == chunk.layer]
    columns = sum(_spec.ATTRIBUTE_COLUMNS[a] for a in of_layer)
    size = book.record.size
    stream = read_stream(payload, "entries", size * columns, _ENTRY_WIDTH_MAX, signed=True)
    if stream.elements is not None:
        table = stream.elements.astype(np.int64).reshape(columns, size).T
        where = (stream.head.offset, f"{payload.name}/entries")
        # Otherwise every tile would report the invalid entries again.
        if _check_entries(log, index, book, of_layer, table, where):
            books[chunk.identity, chunk.layer] = table
    payload.finish()


def _check_entries(
    log: ViolationLog, index: Index, book: CodebookAt, attributes: list[int], table: I64, where: Place
) -> bool:
    """Check CBK-7 for entries, used or not. Scales are checked in the tile, with their summand."""
    sound = True
    for attribute in attributes:
        columns = attribute_columns(book, attribute)
        if columns is None or attribute == _spec.ATTRIBUTE_SCALES:
            continue
        sound &= check_integers(log, index, attribute, table[:, columns].T, 0, where)
    return sound
