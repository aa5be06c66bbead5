"""Blocks coded CODEBOOK (spec 6.4.5)."""

from __future__ import annotations

import numpy as np

from csplat import _spec
from csplat.types import I64
from csplat_conformance.validator.codebooks import attribute_columns, first_attribute
from csplat_conformance.validator.findings import Placed
from csplat_conformance.validator.index import CodebookAt
from csplat_conformance.validator.reading import Payload, UnreadableError
from csplat_conformance.validator.streams import read_stream
from csplat_conformance.validator.tiles import (
    First,
    TileReader,
    read_block_head,
    read_columns,
    read_exponent,
    read_offsets,
)
from csplat_conformance.validator.values import check_integers

_WIDTH_MAX = _spec.CODING_WIDTH_MAX[_spec.CODING_CODEBOOK]
_ESCAPES = (_spec.CODING_OFFSET, _spec.CODING_SIGNED)

Params = Placed[_spec.CodebookParams]


def read_coded(reader: TileReader, payload: Payload, name: str, attribute: int, at: int) -> None:
    """Read what follows a block head.

    Args:
        reader: the tile.
        payload: stands behind the block head.
        name: name of the block.
        attribute: registry value.
        at: offset of the block head.

    Raises:
        UnreadableError: the number of streams that follow is not known.
    """
    params = payload.structure(
        _spec.unpack_codebook_params, _spec.CODEBOOK_PARAMS_SIZE, _spec.CODEBOOK_PARAMS_OFFSETS, f"{name}.params"
    )
    identity = params.record.codebook_id
    book, columns = _find_book(reader, params, attribute)
    if first_attribute(book) == attribute:
        first = reader.first[identity] = _read_indices(reader, payload, name, book, params)
    else:
        first = _find_first(reader, book, params)
    summands = None
    has_summand = attribute == _spec.ATTRIBUTE_SCALES
    if has_summand:
        summands = _read_summands(reader, payload, name, attribute)
    escapes = _read_escapes(reader, payload, name, attribute, params) if params.record.escape_count else None
    entries = reader.books.get((identity, _spec.ATTRIBUTE_LAYER[attribute]))
    rows = None if entries is None else _served(first, entries[:, columns])
    if rows is None or (has_summand and summands is None) or first.escaped is None:
        return
    if summands is not None:
        rows += summands[~first.escaped]
    sound = check_integers(reader.findings, reader.index, attribute, rows, 0, (at, f"{payload.name}/{name}"))
    if sound and has_summand and (escapes is not None or not first.escaped.any()):
        parts = [part for part in (rows, escapes) if part is not None and part.size]
        reader.check_scales(max(int(part.max()) for part in parts), 0)


def _find_book(reader: TileReader, params: Params, attribute: int) -> tuple[CodebookAt, slice]:
    """CBK-1."""
    identity = params.record.codebook_id
    book = reader.index.codebooks.get(identity)
    columns = None if book is None else attribute_columns(book, attribute)
    name = _spec.ATTRIBUTE_NAMES[attribute]
    if identity not in reader.tile.tables:
        reader.findings.of("CBK-1", params, "codebook_id", f"{identity} is not among the tile's table ids")
    elif identity not in reader.index.codebook_ids:
        reader.findings.of("CBK-1", params, "codebook_id", f"{identity} is the id of no codebook")
    elif book is not None and columns is None:
        reader.findings.of("CBK-1", params, "codebook_id", f"codebook {identity} does not serve {name}")
    if book is None or columns is None:
        raise UnreadableError
    return book, columns


def _read_indices(reader: TileReader, payload: Payload, name: str, book: CodebookAt, params: Params) -> First:
    """CBK-2, CBK-3."""
    findings, size = reader.findings, book.record.size
    stream = read_stream(payload, f"{name}.indices", reader.tile.count, _WIDTH_MAX)
    indices = stream.elements
    if indices is not None and int(indices.max()) > size:
        message = f"an index of {int(indices.max())} into {size} entries, wanted {size} at most"
        findings.add("CBK-2", stream.head.offset, f"{payload.name}/{name}.indices", message)
        indices = None
    escaped = None if indices is None else np.asarray(indices == size)
    count = params.record.escape_count
    if escaped is not None and int(escaped.sum()) != count:
        findings.of("CBK-3", params, "escape_count", f"{count}, the indices escape {int(escaped.sum())} splats")
        escaped = None
    elif escaped is None and count > reader.tile.count:
        findings.of("CBK-3", params, "escape_count", f"{count} of a tile of {reader.tile.count} splats")
    return First(indices, escaped, count)


def _find_first(reader: TileReader, book: CodebookAt, params: Params) -> First:
    """CBK-4. An unknown one is returned if there is none, or if its block could not be read."""
    identity, count = params.record.codebook_id, params.record.escape_count
    first = reader.first.get(identity)
    opener = first_attribute(book)
    name = _spec.ATTRIBUTE_NAMES[opener]
    if first is None:
        if _spec.ATTRIBUTE_LAYER[opener] not in reader.lost:
            message = f"codebook {identity}, and no block of {name} before it is coded with it"
            reader.findings.of("CBK-4", params, "codebook_id", message)
        return First(None, None, count)
    if first.escape_count != count:
        message = f"codebook {identity} with {count} escapes, the block of {name} has {first.escape_count}"
        reader.findings.of("CBK-4", params, "codebook_id", message)
        return First(first.indices, None, count)
    return first


def _read_summands(reader: TileReader, payload: Payload, name: str, attribute: int) -> I64 | None:
    """The common summand of scales: LAT-2, LAT-3; [n]."""
    _, sound = read_exponent(reader, payload, f"{name}.summand", attribute, fixed=True)
    offsets, sane = read_offsets(payload, f"{name}.summand.offset", 1)
    width_max = _spec.CODING_WIDTH_MAX[_spec.CODING_OFFSET]
    stream = read_stream(payload, f"{name}.summand.stream", reader.tile.count, width_max)
    if stream.elements is None or not (sound and sane):
        return None
    summands: I64 = stream.elements.astype(np.int64) + offsets[0]
    return summands


def _read_escapes(reader: TileReader, payload: Payload, name: str, attribute: int, params: Params) -> I64 | None:
    """CBK-5, and what the block's coding asks for; [C, escape_count]."""
    what = f"{name}.escape"
    head = read_block_head(payload, what)
    if head.record.attribute != attribute:
        message = f"{head.record.attribute}, wanted that of its block, {attribute}"
        reader.findings.of("CBK-5", head, "attribute", message)
    coding = head.record.coding
    legal = (_spec.CODING_SIGNED,) if attribute == _spec.ATTRIBUTE_QUATS else _ESCAPES
    if coding not in _spec.CODING_NAMES:
        message = f"{coding} is no coding that this version uses"
        reader.findings.of("BLK-1", head, "coding", message, _spec.ERROR_UNSUPPORTED)
        raise UnreadableError
    if coding not in legal:
        names = " or ".join(_spec.CODING_NAMES[one] for one in legal)
        reader.findings.of("CBK-5", head, "coding", f"{_spec.CODING_NAMES[coding]}, wanted {names}")
        raise UnreadableError
    rows, _ = read_columns(reader, payload, what, attribute, coding, params.record.escape_count, escape=True)
    return rows


def _served(first: First, entries: I64) -> I64 | None:
    """The entries of the splats that are not escaped, [C, n]; `None` if something is not known."""
    if first.indices is None or first.escaped is None:
        return None
    rows: I64 = entries[first.indices[~first.escaped].astype(np.intp)].T
    return rows
