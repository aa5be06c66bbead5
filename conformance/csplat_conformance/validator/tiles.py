# SPDX-License-Identifier: CC0-1.0
"""Check TILE and CODB chunks (spec 5.2, 5.3) and the codings of blocks (6.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from csplat import _spec
from csplat.types import I64
from csplat_conformance.validator.index import KNOWN_LAYERS, Chunk, CodebookAt, Index, Tile, scaled_step
from csplat_conformance.validator.streams import Elements, read_stream
from csplat_conformance.validator.values import Place, check_box, check_integers, check_max_scale
from csplat_conformance.validator.violation_log import Payload, PlacedRecord, UnreadableError, ViolationLog

BlockHead = PlacedRecord[_spec.BlockHead]

#: The entries, [size, C], of valid chunks, by codebook id and layer.
CodebookEntries = dict[tuple[int, int], I64]

_SPARSE_WIDTH_MAX = _spec.CODING_WIDTH_MAX[_spec.CODING_SPARSE]
_AXES = 3
_OFFSET_SIZE = 4  # bytes


@dataclass
class CodebookIndices:
    """The indices into a codebook, from the tile's first block that is coded with it.

    Attributes:
        indices: [n], `None` if they could not be read or are out of range.
        escaped: [n] bool, `None` for the same reasons.
        escape_count: number of escapes in the block.
    """

    indices: Elements | None
    escaped: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] | None
    escape_count: int


@dataclass
class TileChecker:
    """A check of one tile, whose layers are read from the lowest to the highest.

    Attributes:
        view: the file.
        index: index of the file.
        tile: the tile record.
        books: entries by codebook id and layer.
        log: receives the violations.
        first: indices by codebook id, from the tile's first block of each codebook.
        lost: layers with unreadable blocks.
    """

    view: memoryview
    index: Index
    tile: Tile
    books: CodebookEntries
    log: ViolationLog
    first: dict[int, CodebookIndices] = field(default_factory=dict)
    lost: set[int] = field(default_factory=set)

    def read_layer(self, payload: Payload, chunk: Chunk) -> None:
        """Read the payload of one of the tile's chunks.

        Raises:
            UnreadableError: the structure of the remaining bytes is unknown.
        """
        log = self.log
        column = self._extra_number(chunk.layer)
        if chunk.layer >= _spec.ANCILLARY_ID_MIN or (column is not None and self.index.extras[column] is None):
            return  # ANC-2, ANC-3
        head = payload.structure(_spec.TileHead, "head")
        if head.record.layer != chunk.layer:
            log.add_field("TLE-1", head, "layer", f"{head.record.layer}, expected {chunk.layer} by its record")
        if chunk.layer not in KNOWN_LAYERS or not 1 <= self.tile.count <= _spec.TILE_SPLATS_MAX:
            log.skip(f"{chunk.name} from byte {payload.at} on", "layer or splat_count of its record is wrong")
            return
        blocks = self._expected_blocks(chunk.layer)
        announced = head.record.block_count
        if announced != len(blocks):
            log.add_field("TLE-2", head, "block_count", f"{announced} blocks, expected {len(blocks)}")
        for number, attribute in enumerate(blocks):
            if number >= announced and not payload.left:
                return
            self._read_block(payload, attribute, number, column)
        if announced == len(blocks):
            payload.finish()

    def _extra_number(self, layer: int) -> int | None:
        """Return the number of the extra column to which a layer belongs; `None` if there is none."""
        number = layer - _spec.LAYER_EXTRA
        return number if 0 <= number < len(self.index.extras) else None

    def _expected_blocks(self, layer: int) -> list[int]:
        """Return the attribute of each block of a layer, in order (TLE-2)."""
        if layer >= _spec.LAYER_EXTRA:
            return [_spec.ATTRIBUTE_EXTRA]
        return [attribute for attribute, attribute_layer in _spec.ATTRIBUTE_LAYER.items() if attribute_layer == layer]

    def _read_block(self, payload: Payload, expected: int, number: int, column: int | None) -> None:
        """Read the next block of a layer.

        Args:
            payload: the payload, at the block head.
            expected: attribute of the block by the order of the layer.
            number: index of the block in the layer.
            column: number of the extra column to which the layer belongs.

        Raises:
            UnreadableError: attribute or coding are not known, so neither is the size of the block.
        """
        at = payload.at
        attribute = payload.view[at] if payload.left else expected
        name = f"extra[{column}]" if attribute == _spec.ATTRIBUTE_EXTRA else _spec.ATTRIBUTE_NAMES.get(attribute, "?")
        head = read_block_head(payload, name)
        if attribute != expected:
            message = f"{attribute}, expected {expected} ({_spec.ATTRIBUTE_NAMES[expected]}) at index {number}"
            self.log.add_field("TLE-2", head, "attribute", message)
            if attribute not in _spec.ATTRIBUTE_NAMES:
                raise UnreadableError
        coding = head.record.coding
        if _spec.CODING_NAMES.get(coding) not in _spec.ATTRIBUTE_CODINGS[attribute]:
            code = "" if coding in _spec.CODING_NAMES else _spec.ERROR_UNSUPPORTED
            message = f"{coding}, expected {' or '.join(_spec.ATTRIBUTE_CODINGS[attribute])}"
            self.log.add_field("BLK-1", head, "coding", message, code)
            raise UnreadableError
        if coding == _spec.CODING_CODEBOOK:
            _read_codebook_block(self, payload, name, attribute, at)
        elif coding == _spec.CODING_SPARSE:
            self._read_sparse(payload, name, attribute)
        elif coding == _spec.CODING_RAW:
            self._read_raw(payload, name, column)
        elif attribute == _spec.ATTRIBUTE_MEANS:
            self._read_means(payload, name, coding)
        else:
            self._read_plain(payload, name, attribute, coding)

    def _read_sparse(self, payload: Payload, name: str, attribute: int) -> None:
        """Read and check a block coded SPARSE: SPA-1 to SPA-3, LAT-1, and the ranges of the integers.

        Raises:
            UnreadableError: SPA-1 does not hold, so the size of the second stream is unknown.
        """
        params = payload.structure(_spec.SparseParams, f"{name}.params")
        exponent, announced, count = params.record.exponent, params.record.present_count, self.tile.count
        sound = self.check_step(params, exponent, attribute)
        if not 1 <= announced <= count:
            self.log.add_field("SPA-1", params, "present_count", f"{announced}, expected 1 to {count}")
        mask_size = (count + 7) // 8  # bytes
        mask = read_stream(payload, f"{name}.mask", mask_size, 1)
        where = (mask.head.offset, f"{payload.name}/{name}.mask")
        if mask.elements is not None:
            bits = int.from_bytes(bytes(mask.elements.astype(np.uint8)), "little")  # bit i belongs to splat i
            if bits >> count:
                self.log.add("SPA-3", *where, f"bits of the mask beyond the {count} splats are set")
            set_count = (bits & (1 << count) - 1).bit_count()
            if set_count != announced:
                self.log.add("SPA-2", *where, f"{set_count} bits are set, expected {announced} by present_count")
        if not 1 <= announced <= count:
            raise UnreadableError
        columns = _spec.ATTRIBUTE_COLUMNS[attribute]
        stream = read_stream(payload, f"{name}.stream", columns * announced, _SPARSE_WIDTH_MAX, signed=True)
        if stream.elements is not None and sound:
            rows = stream.elements.astype(np.int64).reshape(columns, announced)
            where = (stream.head.offset, f"{payload.name}/{name}.stream")
            check_integers(self.log, self.index, attribute, rows, exponent, where)

    def check_step(self, params: PlacedRecord[Any], exponent: int, attribute: int) -> bool:
        """Check LAT-1; return True if it holds, or if the step of the attribute is invalid anyway (ATT-6, ATT-10)."""
        step = self.index.steps.get(attribute)
        if step is None or scaled_step(step, exponent, single=True) is not None:
            return True
        self.log.add_field(
            "LAT-1", params, "exponent", f"{step} x 2^{exponent} is not finite in binary32 and at least 2^-126"
        )
        return False

    def _read_plain(self, payload: Payload, name: str, attribute: int, coding: int) -> None:
        """Read and check a block coded LEVELS, OFFSET or SIGNED, and TIL-11 for scales."""
        rows, exponent = read_columns(self, payload, name, attribute, coding, self.tile.count)
        if rows is not None and attribute == _spec.ATTRIBUTE_SCALES:
            self.check_scales(int(rows.max()), exponent)

    def check_scales(self, largest: int, exponent: int) -> None:
        """Check TIL-11, given the largest lattice integer of the scales."""
        record = self.tile.record
        at = record.at("max_scale")
        stored = bytes(self.view[at : at + 4])
        where = (at, record.path("max_scale"))
        check_max_scale(self.log, self.index, largest, exponent, stored, where)

    def _read_means(self, payload: Payload, name: str, coding: int) -> None:
        """Read and check a block of means: MOR-1 and MOR-2, or AXI-1, and TIL-10 if they hold."""
        count, width_max = self.tile.count, _spec.CODING_WIDTH_MAX[coding]
        rows: I64 | None
        if coding == _spec.CODING_MORTON:
            params = payload.structure(_spec.MortonParams, f"{name}.params")
            bits = params.record.bits
            if not 1 <= bits <= _spec.MORTON_BITS_MAX:
                self.log.add_field("MOR-1", params, "bits", f"{bits}, expected 1 to {_spec.MORTON_BITS_MAX}")
            stream = read_stream(payload, f"{name}.stream", count, width_max)
            rows = None if stream.elements is None else _split_morton_codes(stream.elements.astype(np.int64))
            largest = 0 if stream.elements is None else int(stream.elements.max())
            if 1 <= bits <= _spec.MORTON_BITS_MAX and largest >> _AXES * bits:
                message = f"a code of {largest}, expected less than 2^{_AXES * bits}"
                self.log.add("MOR-2", stream.head.offset, f"{payload.name}/{name}.stream", message)
                rows = None
        else:
            stream = read_stream(payload, f"{name}.stream", _AXES * count, width_max)
            rows = None if stream.elements is None else stream.elements.astype(np.int64).reshape(_AXES, count)
            if rows is not None and int(rows.max()) >> _spec.AXIS_BITS_MAX:
                message = f"an integer of {int(rows.max())}, expected less than 2^{_spec.AXIS_BITS_MAX}"
                self.log.add("AXI-1", stream.head.offset, f"{payload.name}/{name}.stream", message)
                rows = None
        if rows is not None:
            record = self.tile.record
            check_box(self.log, record.record, rows, (record.at("corner"), record.path("corner")))

    def _read_raw(self, payload: Payload, name: str, column: int | None) -> None:
        """Read and check the block of an extra column, RAW-2; the column is unknown if its record is missing.

        Raises:
            UnreadableError: the number of values is unknown.
        """
        known = None if column is None else self.index.extras[column]
        if known is None:
            raise UnreadableError
        size, components = known
        width_max = _spec.CODING_WIDTH_MAX[_spec.CODING_RAW]
        stream = read_stream(payload, f"{name}.stream", components * self.tile.count, width_max)
        if stream.head.record.width != size:
            self.log.add_field("RAW-2", stream.head, "width", f"{stream.head.record.width}, expected {size}")


def read_block_head(payload: Payload, name: str) -> BlockHead:
    """Read the head of a block or of an escape block."""
    return payload.structure(_spec.BlockHead, name)


def read_columns(
    reader: TileChecker, payload: Payload, name: str, attribute: int, coding: int, count: int, *, escape: bool = False
) -> tuple[I64 | None, int]:
    """Read and check a block coded LEVELS, OFFSET or SIGNED.

    Args:
        reader: the tile.
        payload: reader after the block head.
        name: name of the block.
        attribute: registry value.
        coding: registry value of one of the three codings.
        count: number of splats with values.
        escape: the block is the escape block of another, whose exponent is 0.

    Returns:
        [C, count] integers, `None` if a violation prevents decoding or they are out of range; and the exponent.
    """
    columns = _spec.ATTRIBUTE_COLUMNS[attribute]
    exponent, offsets, sound = 0, [0] * columns, True
    if coding != _spec.CODING_LEVELS:
        fixed = escape or attribute == _spec.ATTRIBUTE_QUATS
        exponent, sound = read_exponent(reader, payload, f"{name}.params", attribute, fixed=fixed)
    if coding == _spec.CODING_OFFSET:
        offsets, offsets_valid = read_offsets(payload, f"{name}.offsets", columns)
        sound &= offsets_valid
    width_max, signed = _spec.CODING_WIDTH_MAX[coding], coding == _spec.CODING_SIGNED
    stream = read_stream(payload, f"{name}.stream", columns * count, width_max, signed=signed)
    if stream.elements is None or not sound:
        return None, exponent
    rows = stream.elements.astype(np.int64).reshape(columns, count) + np.array(offsets, np.int64)[:, None]
    where = (stream.head.offset, f"{payload.name}/{name}.stream")
    in_range = check_integers(reader.log, reader.index, attribute, rows, exponent, where)
    return (rows if in_range else None), exponent


def read_exponent(reader: TileChecker, payload: Payload, name: str, attribute: int, *, fixed: bool) -> tuple[int, bool]:
    """Read lattice parameters. Return the exponent, and True if LAT-1 holds, or LAT-2 for a fixed exponent."""
    params = payload.structure(_spec.LatticeParams, name)
    exponent = params.record.exponent
    if fixed and exponent:
        reader.log.add_field("LAT-2", params, "exponent", f"{exponent}, expected 0")
        return exponent, False
    return exponent, fixed or reader.check_step(params, exponent, attribute)


def read_offsets(payload: Payload, name: str, columns: int) -> tuple[list[int], bool]:
    """Read an offset for each column. Return them, and True if LAT-3 holds."""
    at = payload.take(_OFFSET_SIZE * columns, name)
    offsets = [int(value) for value in np.frombuffer(payload.view, "<i4", columns, at)]
    sound = True
    for i, offset in enumerate(offsets):
        if abs(offset) > _spec.COLUMN_MAX:
            message = f"offset {i} is {offset}, expected at most {_spec.COLUMN_MAX} in magnitude"
            payload.log.add("LAT-3", at + _OFFSET_SIZE * i, f"{payload.name}/{name}", message)
            sound = False
    return offsets, sound


def _split_morton_codes(codes: I64) -> I64:
    """Split Morton codes, [n], into the integers of the axes, [3, n] (6.4.2).

    Bit 3·b + a of a code is bit b of axis a.
    """
    rows = np.zeros((_AXES, len(codes)), np.int64)
    for axis in range(_AXES):
        for bit in range(_spec.MORTON_BITS_MAX):
            rows[axis] |= (codes >> _AXES * bit + axis & 1) << bit
    return rows


_INDEX_WIDTH_MAX = _spec.CODING_WIDTH_MAX[_spec.CODING_CODEBOOK]
_ESCAPE_CODINGS = (_spec.CODING_OFFSET, _spec.CODING_SIGNED)

_CodebookParams = PlacedRecord[_spec.CodebookParams]


def _read_codebook_block(reader: TileChecker, payload: Payload, name: str, attribute: int, at: int) -> None:
    """Read a block coded CODEBOOK (6.4.5).

    Args:
        reader: the tile.
        payload: reader after the block head.
        name: name of the block.
        attribute: registry value.
        at: offset of the block head.

    Raises:
        UnreadableError: the number of remaining streams is unknown.
    """
    params = payload.structure(_spec.CodebookParams, f"{name}.params")
    identity = params.record.codebook_id
    book, columns = _find_codebook(reader, params, attribute)
    if first_attribute(book) == attribute:
        first = reader.first[identity] = _read_indices(reader, payload, name, book, params)
    else:
        first = _find_earlier_indices(reader, book, params)
    summands = None
    has_summand = attribute == _spec.ATTRIBUTE_SCALES
    if has_summand:
        summands = _read_summands(reader, payload, name, attribute)
    escapes = _read_escapes(reader, payload, name, attribute, params) if params.record.escape_count else None
    entries = reader.books.get((identity, _spec.ATTRIBUTE_LAYER[attribute]))
    rows = None if entries is None else _selected_entries(first, entries[:, columns])
    if rows is None or (has_summand and summands is None) or first.escaped is None:
        return
    if summands is not None:
        rows += summands[~first.escaped]
    sound = check_integers(reader.log, reader.index, attribute, rows, 0, (at, f"{payload.name}/{name}"))
    if sound and has_summand and (escapes is not None or not first.escaped.any()):
        parts = [part for part in (rows, escapes) if part is not None and part.size]
        reader.check_scales(max(int(part.max()) for part in parts), 0)


def _find_codebook(reader: TileChecker, params: _CodebookParams, attribute: int) -> tuple[CodebookAt, slice]:
    """Check CBK-1; return the record of the codebook and the columns of the attribute in its entries.

    Raises:
        UnreadableError: no valid codebook record has the attribute.
    """
    identity = params.record.codebook_id
    book = reader.index.codebooks.get(identity)
    columns = None if book is None else attribute_columns(book, attribute)
    name = _spec.ATTRIBUTE_NAMES[attribute]
    if identity not in reader.tile.codebook_ids:
        reader.log.add_field("CBK-1", params, "codebook_id", f"{identity} is not among the tile's table ids")
    elif identity not in reader.index.codebook_ids:
        reader.log.add_field("CBK-1", params, "codebook_id", f"there is no codebook {identity}")
    elif book is not None and columns is None:
        reader.log.add_field("CBK-1", params, "codebook_id", f"codebook {identity} does not contain {name}")
    if book is None or columns is None:
        raise UnreadableError
    return book, columns


def _read_indices(
    reader: TileChecker, payload: Payload, name: str, book: CodebookAt, params: _CodebookParams
) -> CodebookIndices:
    """Read the indices of a tile's first block of a codebook, and check CBK-2 and CBK-3."""
    log, size = reader.log, book.record.size
    stream = read_stream(payload, f"{name}.indices", reader.tile.count, _INDEX_WIDTH_MAX)
    indices = stream.elements
    if indices is not None and int(indices.max()) > size:
        message = f"an index of {int(indices.max())} into {size} entries, expected at most {size}"
        log.add("CBK-2", stream.head.offset, f"{payload.name}/{name}.indices", message)
        indices = None
    escaped = None if indices is None else np.asarray(indices == size)
    count = params.record.escape_count
    if escaped is not None and int(escaped.sum()) != count:
        log.add_field("CBK-3", params, "escape_count", f"{count}, expected {int(escaped.sum())} by the indices")
        escaped = None
    elif escaped is None and count > reader.tile.count:
        log.add_field("CBK-3", params, "escape_count", f"{count}, expected at most the tile's {reader.tile.count}")
    return CodebookIndices(indices, escaped, count)


def _find_earlier_indices(reader: TileChecker, book: CodebookAt, params: _CodebookParams) -> CodebookIndices:
    """Check CBK-4; return the indices of the tile's first block of the codebook.

    If there is none, they are unknown, which is no violation if its layer is unreadable. If the numbers of escapes
    differ, `escaped` is unknown.
    """
    identity, count = params.record.codebook_id, params.record.escape_count
    first = reader.first.get(identity)
    attribute = first_attribute(book)
    name = _spec.ATTRIBUTE_NAMES[attribute]
    if first is None:
        if _spec.ATTRIBUTE_LAYER[attribute] not in reader.lost:
            message = f"no preceding block of {name} uses codebook {identity}"
            reader.log.add_field("CBK-4", params, "codebook_id", message)
        return CodebookIndices(None, None, count)
    if first.escape_count != count:
        message = f"{count} escapes of codebook {identity}, expected {first.escape_count} as in the block of {name}"
        reader.log.add_field("CBK-4", params, "codebook_id", message)
        return CodebookIndices(first.indices, None, count)
    return first


def _read_summands(reader: TileChecker, payload: Payload, name: str, attribute: int) -> I64 | None:
    """Read the summands of scales, [n], one for all axes of a splat, and check LAT-2 and LAT-3; `None` if unknown."""
    _, sound = read_exponent(reader, payload, f"{name}.summand", attribute, fixed=True)
    offsets, offset_valid = read_offsets(payload, f"{name}.summand.offset", 1)
    width_max = _spec.CODING_WIDTH_MAX[_spec.CODING_OFFSET]
    stream = read_stream(payload, f"{name}.summand.stream", reader.tile.count, width_max)
    if stream.elements is None or not (sound and offset_valid):
        return None
    summands: I64 = stream.elements.astype(np.int64) + offsets[0]
    return summands


def _read_escapes(
    reader: TileChecker, payload: Payload, name: str, attribute: int, params: _CodebookParams
) -> I64 | None:
    """Read the escapes and check BLK-1, CBK-5 and the clauses of their coding.

    Returns:
        [C, escape_count], `None` if a violation prevents decoding or they are out of range.

    Raises:
        UnreadableError: the coding is unknown or not allowed for escapes.
    """
    escape_name = f"{name}.escape"
    head = read_block_head(payload, escape_name)
    if head.record.attribute != attribute:
        message = f"{head.record.attribute}, expected that of its block, {attribute}"
        reader.log.add_field("CBK-5", head, "attribute", message)
    coding = head.record.coding
    legal = (_spec.CODING_SIGNED,) if attribute == _spec.ATTRIBUTE_QUATS else _ESCAPE_CODINGS
    if coding not in _spec.CODING_NAMES:
        message = f"{coding} is not a coding of this version"
        reader.log.add_field("BLK-1", head, "coding", message, _spec.ERROR_UNSUPPORTED)
        raise UnreadableError
    if coding not in legal:
        names = " or ".join(_spec.CODING_NAMES[value] for value in legal)
        reader.log.add_field("CBK-5", head, "coding", f"{_spec.CODING_NAMES[coding]}, expected {names}")
        raise UnreadableError
    rows, _ = read_columns(reader, payload, escape_name, attribute, coding, params.record.escape_count, escape=True)
    return rows


def _selected_entries(first: CodebookIndices, entries: I64) -> I64 | None:
    """Return the entries of the splats that are not escaped, [C, n], `None` if they are unknown."""
    if first.indices is None or first.escaped is None:
        return None
    rows: I64 = entries[first.indices[~first.escaped].astype(np.intp)].T
    return rows


# Codebooks -----------------------------------------------------------------------------------------

_ENTRY_WIDTH_MAX = 4  # STR-2: "4 for codebooks' entries"
_ATTRIBUTES = {name: value for value, name in _spec.ATTRIBUTE_NAMES.items()}


def codebook_attributes(book: CodebookAt) -> list[int]:
    """Return the attributes of a codebook in the order of its columns."""
    if book.record.kind == _spec.CODEBOOK_KIND_SH:
        return [_spec.ATTRIBUTE_SH0 + band for band in range(book.record.band_first, book.record.band_last + 1)]
    return [_ATTRIBUTES[name] for name in _spec.CODEBOOK_KIND_ATTRIBUTES[book.record.kind]]


def first_attribute(book: CodebookAt) -> int:
    """Return the attribute whose block contains the indices."""
    return codebook_attributes(book)[0]


def attribute_columns(book: CodebookAt, attribute: int) -> slice | None:
    """Return the columns of an attribute in the entries of its layer, `None` if the codebook does not contain it."""
    first = 0
    for member in codebook_attributes(book):
        columns = _spec.ATTRIBUTE_COLUMNS[member]
        if book.record.kind == _spec.CODEBOOK_KIND_SH:
            first = 0  # each band has a separate chunk
        if member == attribute:
            return slice(first, first + columns)
        first += columns
    return None


def read_codebook(payload: Payload, chunk: Chunk, index: Index, books: CodebookEntries) -> None:
    """Read the payload of a CODB chunk.

    Args:
        payload: payload of the chunk.
        chunk: the chunk.
        index: index of the file.
        books: receives the entries, if a valid codebook record requires the chunk.

    Raises:
        UnreadableError: the payload ends too early.
    """
    log = payload.log
    book = index.codebooks.get(chunk.identity)
    layers = () if book is None else range(book.record.band_first, book.record.band_last + 1)
    head = payload.structure(_spec.CodebookHead, "head")
    for key, expected in (("codebook_id", chunk.identity), ("layer", chunk.layer)):
        value = getattr(head.record, key)
        if value != expected:
            log.add_field("CDB-1", head, key, f"{value}, expected {expected} by its record")
    if book is None or chunk.layer not in layers:
        log.skip(f"{chunk.name} from byte {payload.at} on", "no valid codebook record requires it")
        return
    of_layer = [a for a in codebook_attributes(book) if _spec.ATTRIBUTE_LAYER[a] == chunk.layer]
    columns = sum(_spec.ATTRIBUTE_COLUMNS[a] for a in of_layer)
    size = book.record.size
    stream = read_stream(payload, "entries", size * columns, _ENTRY_WIDTH_MAX, signed=True)
    if stream.elements is not None:
        table = stream.elements.astype(np.int64).reshape(columns, size).T
        where = (stream.head.offset, f"{payload.name}/entries")
        # Keep invalid entries out of `books`, so that tiles do not report them again.
        if _check_entries(log, index, book, of_layer, table, where):
            books[chunk.identity, chunk.layer] = table
    payload.finish()


def _check_entries(
    log: ViolationLog, index: Index, book: CodebookAt, attributes: list[int], table: I64, where: Place
) -> bool:
    """Check the entries of one layer, [size, columns], by CBK-7, and return True if they are valid.

    Scales are skipped: the tile checks them with their summand (CBK-6).
    """
    sound = True
    for attribute in attributes:
        if attribute == _spec.ATTRIBUTE_SCALES:
            continue
        columns = attribute_columns(book, attribute)
        assert columns is not None, "the codebook contains its own attributes"
        sound &= check_integers(log, index, attribute, table[:, columns].T, exponent=0, where=where)
    return sound
