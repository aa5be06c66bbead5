# SPDX-License-Identifier: Apache-2.0
"""Represent blocks of integers, and read codings of a single stream: LEVELS, MORTON, AXIS, OFFSET, SIGNED (spec 6.4).

Every block has `rows(start, stop, dtype)`, which returns the integers of a run of splats, and `bound`, the largest
magnitude that can occur while they are computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.container import Cursor, SceneHeader, Tile, check_reserved, refuse_field
from csplat.decoder.entropy import Ints, read_stream
from csplat.decoder.index import SINGLE_MAX, SINGLE_MIN, scaled_step
from csplat.errors import FormatError, UnsupportedError

_RUN_ELEMENTS = 1 << 18  # integers per run, which fit the second-level cache
_RUN_SPLATS = 1 << 14  # splats per run

#: Every third bit is compacted in five steps, each of which halves the number of gaps: shift, and mask of the bits to
#: keep. Sufficient for 21 bits per axis; the format has 17.
_EVERY_THIRD_BIT = 0x1249249249249249
_MORTON_STEPS = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x001F0000FF0000FF),
    (16, 0x001F00000000FFFF),
    (32, 0x00000000001FFFFF),
)


@dataclass(frozen=True)
class ColumnBlock:
    """A block of integers offset + element.

    Attributes:
        elements: [C, n], in the type of the stream.
        offsets: offset of each column, [C].
        exponent: the block's lattice is coarser by 2^exponent.
        at: offset of the stream in the file.
        lows: smallest integer of each column.
        highs: largest integer of each column.
        bound: largest magnitude of an offset, an element or a sum.
    """

    elements: Ints
    offsets: tuple[int, ...]
    exponent: int
    at: int
    lows: tuple[int, ...] = field(init=False)
    highs: tuple[int, ...] = field(init=False)
    bound: int = field(init=False)

    def __post_init__(self) -> None:
        low = [int(value) for value in self.elements.min(axis=1)]
        high = [int(value) for value in self.elements.max(axis=1)]
        lows = tuple(a + b for a, b in zip(low, self.offsets, strict=True))
        highs = tuple(a + b for a, b in zip(high, self.offsets, strict=True))
        object.__setattr__(self, "lows", lows)
        object.__setattr__(self, "highs", highs)
        object.__setattr__(self, "bound", max(map(abs, (*low, *high, *lows, *highs, *self.offsets))))

    def rows(self, start: int, stop: int, dtype: np.dtype[np.signedinteger]) -> Ints:
        """Return the integers of the splats `start` to `stop` - 1, [C, stop - start], in a new array.

        `dtype` is signed and wide enough for `bound`.
        """
        out = self.elements[:, start:stop].astype(dtype)
        if any(self.offsets):
            out += np.array(self.offsets, dtype)[:, None]
        return out


@dataclass
class Codebook:
    """A codebook, as far as it was read.

    Attributes:
        record: record in the index.
        entries: integers [size, C] by layer (0, or an SH band).
        values: [size, K, 3] float32, the dequantised bands from `band_first` on; only for SH codebooks.
    """

    record: _spec.CodebookRecord
    entries: dict[int, Ints] = field(default_factory=dict)
    values: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Indices:
    """The assignment of a tile's splats to a codebook, stored in the codebook's first block.

    Attributes:
        book: the codebook.
        attribute: attribute id of the first block.
        entry_indices: [n], the entry of each splat; the codebook's size for escaped splats.
        escaped: indices of the escaped splats, ascending.
    """

    book: Codebook
    attribute: int
    entry_indices: Ints
    escaped: NDArray[np.intp]


@dataclass(frozen=True)
class CodebookBlock:
    """A block coded CODEBOOK: the integers are entries, plus a summand for scales (spec 6.4.5).

    Attributes:
        indices: the entry of each splat.
        entries: [size, C], the columns of the block's attribute.
        escapes: integers of the escaped splats.
        summand: for scales, a column that is added to all three columns.
        at: offset of the block in the file.
        exponent: 0: the block is on the file's lattice.
        bound: largest magnitude of an integer, or of a part of a sum.
    """

    indices: Indices
    entries: Ints
    escapes: ColumnBlock | None
    summand: ColumnBlock | None
    at: int
    exponent: int = 0
    bound: int = field(init=False)

    def __post_init__(self) -> None:
        total = max(abs(int(self.entries.min())), abs(int(self.entries.max())))
        total += self.summand.bound if self.summand else 0
        object.__setattr__(self, "bound", max(total, self.escapes.bound if self.escapes else 0))

    def rows(self, start: int, stop: int, dtype: np.dtype[np.signedinteger]) -> Ints:
        """Return the integers of some splats; see `ColumnBlock.rows`."""
        # The index of an escaped splat is the codebook's size: `clip` assigns the last entry for now.
        rows = np.take(self.entries, self.indices.entry_indices[start:stop], axis=0, mode="clip")
        out = np.ascontiguousarray(rows.T, dtype)
        if self.summand:
            out += self.summand.rows(start, stop, dtype)
        if self.escapes:
            first, last = np.searchsorted(self.indices.escaped, (start, stop))
            escaped = self.indices.escaped[first:last] - start
            out[:, escaped] = self.escapes.rows(int(first), int(last), dtype)
        return out


@dataclass(frozen=True)
class SparseBlock:
    """A block coded SPARSE: the integers of the masked splats; all other integers are 0 (spec 6.4.7).

    Attributes:
        values: integers of the masked splats.
        splat_indices: indices of these splats, ascending.
    """

    values: ColumnBlock
    splat_indices: NDArray[np.intp]

    @property
    def at(self) -> int:
        """Offset in the file of the stream of values."""
        return self.values.at

    @property
    def exponent(self) -> int:
        """The block's lattice is coarser by 2^exponent."""
        return self.values.exponent

    @property
    def bound(self) -> int:
        """Largest magnitude of an integer."""
        return self.values.bound

    def rows(self, start: int, stop: int, dtype: np.dtype[np.signedinteger]) -> Ints:
        """Return the integers of some splats; see `ColumnBlock.rows`."""
        out = np.zeros((len(self.values.elements), stop - start), dtype)
        first, last = np.searchsorted(self.splat_indices, (start, stop))
        out[:, self.splat_indices[first:last] - start] = self.values.rows(int(first), int(last), dtype)
        return out


Block = ColumnBlock | CodebookBlock | SparseBlock


@dataclass(frozen=True)
class TileBlocks:
    """The integers of a tile.

    Attributes:
        tile: the tile's record.
        blocks: blocks by attribute id.
        extra: bits of the known extra columns, [n] or [n, components], in the order of their records.
    """

    tile: Tile
    blocks: dict[int, Block] = field(default_factory=dict)
    extra: list[Ints] = field(default_factory=list)


def work_dtype(bound: int) -> np.dtype[np.signedinteger]:
    """Return the narrowest signed type of at least two bytes that holds ±bound."""
    if bound < 1 << 15:
        return np.dtype(np.int16)
    return np.dtype(np.int32) if bound < 1 << 31 else np.dtype(np.int64)


def cache_sized_ranges(count: int, columns: int) -> Iterator[tuple[int, int]]:
    """Yield (start, stop) of consecutive ranges of splats whose integers fit the second-level cache.

    Args:
        count: number of splats.
        columns: number of integers per splat.
    """
    step = min(_RUN_SPLATS, max(1, _RUN_ELEMENTS // columns))
    for start in range(0, count, step):
        yield start, min(count, start + step)


def read_block_head(cursor: Cursor, attribute: int, legal: tuple[int, ...] | None = None) -> int:
    """Read a block head and return the coding; for an escape block, `legal` codings are given."""
    at, offsets = cursor.take(_spec.BLOCK_HEAD_SIZE), _spec.BLOCK_HEAD_OFFSETS
    head = _spec.unpack_block_head(cursor.view, at)
    check_reserved(head, at, offsets)
    coding_at = at + offsets["coding"]
    if head.attribute != attribute:
        clause = "CBK-5" if legal else "TLE-2"
        refuse_field(_spec.ERROR_STREAM, clause, head, at, offsets, "attribute", attribute)
    if head.coding not in _spec.CODING_NAMES:
        raise UnsupportedError(f"attribute coding {head.coding}", offset=coding_at, clause="BLK-1")
    if legal is not None and head.coding not in legal:
        detail = "coding of an escape block"
        raise FormatError(_spec.ERROR_STREAM, coding_at, "CBK-5", detail, found=head.coding, wanted=legal)
    coding, allowed = _spec.CODING_NAMES[head.coding], _spec.ATTRIBUTE_CODINGS[attribute]
    if coding not in allowed:
        detail = f"coding of {_spec.ATTRIBUTE_NAMES[attribute]}"
        raise FormatError(_spec.ERROR_VALUE, coding_at, "BLK-1", detail, found=coding, wanted=" or ".join(allowed))
    return head.coding


def read_columns(
    cursor: Cursor, header: SceneHeader, attribute: int, coding: int, count: int, escape: bool = False
) -> ColumnBlock:
    """Read the parameters and the stream of a block, and check the range of its integers.

    Args:
        cursor: after the block head.
        header: header and index.
        attribute: attribute id of the block.
        coding: LEVELS, OFFSET or SIGNED.
        count: number of splats in the block.
        escape: True for an escape block.
    """
    columns = _spec.ATTRIBUTE_COLUMNS[attribute]
    record = header.attribute(attribute)
    exponent, offsets = 0, (0,) * columns
    if coding != _spec.CODING_LEVELS:
        exponent = read_exponent(cursor, record, fixed=escape or attribute == _spec.ATTRIBUTE_QUATS)
    if coding == _spec.CODING_OFFSET:
        offsets = read_offsets(cursor, columns)
    if coding == _spec.CODING_SIGNED:
        return read_signed(cursor, record, exponent, count)
    at = cursor.at
    elements = read_stream(cursor, columns * count, _spec.CODING_WIDTH_MAX[coding])
    block = ColumnBlock(elements.reshape(columns, count), offsets, exponent, at)
    check_integers(block.lows, block.highs, record, at)
    return block


def read_exponent(cursor: Cursor, record: _spec.AttributeRecord, *, fixed: bool) -> int:
    """Read lattice parameters and check LAT-1, or LAT-2 if the exponent is fixed at 0."""
    at = cursor.take(_spec.LATTICE_PARAMS_SIZE)
    params = _spec.unpack_lattice_params(cursor.view, at)
    check_reserved(params, at, _spec.LATTICE_PARAMS_OFFSETS)
    if fixed and params.exponent != 0:
        refuse_field(_spec.ERROR_VALUE, "LAT-2", params, at, _spec.LATTICE_PARAMS_OFFSETS, "exponent", 0)
    if not fixed:
        check_step(record, params.exponent, at)
    return params.exponent


def check_step(record: _spec.AttributeRecord, exponent: int, at: int) -> None:
    """Check LAT-1: step × 2^exponent is normal and finite in binary32. Levels have no step."""
    scaled = scaled_step(record.step, exponent, SINGLE_MIN)
    if record.step and (scaled is None or scaled > SINGLE_MAX):
        detail = f"{record.step} x 2^{exponent} is not finite in binary32 and at least 2^-126"
        raise FormatError(_spec.ERROR_VALUE, at, "LAT-1", detail)


def read_signed(cursor: Cursor, record: _spec.AttributeRecord, exponent: int, count: int) -> ColumnBlock:
    """Read a stream of signed integers in columns, [C, count], and check LAT-4."""
    at, columns = cursor.at, _spec.ATTRIBUTE_COLUMNS[record.attribute]
    elements = read_stream(cursor, columns * count, _spec.CODING_WIDTH_MAX[_spec.CODING_SIGNED], signed=True)
    block = ColumnBlock(elements.reshape(columns, count), (0,) * columns, exponent, at)
    check_integers(block.lows, block.highs, record, at)
    return block


def read_offsets(cursor: Cursor, columns: int) -> tuple[int, ...]:
    """Read the offsets, i32[columns], and check LAT-3."""
    at, wanted = cursor.take(4 * columns), f"at most {_spec.COLUMN_MAX} in magnitude"
    offsets = tuple(int(value) for value in np.frombuffer(cursor.view, "<i4", columns, at))
    for i, offset in enumerate(offsets):
        if abs(offset) > _spec.COLUMN_MAX:
            raise FormatError(_spec.ERROR_VALUE, at + 4 * i, "LAT-3", "offset", found=offset, wanted=wanted)
    return offsets


def check_integers(lows: tuple[int, ...], highs: tuple[int, ...], record: _spec.AttributeRecord, at: int) -> None:
    """Check the smallest and largest integers of columns by LEV-1, QUA-1 or LAT-4, depending on the attribute.

    Raises:
        FormatError: E_RANGE at the offset `at`.
    """
    if record.attribute == _spec.ATTRIBUTE_OPACITIES:
        _check_level(highs[0], 0, record.levels, at, "LEV-1")
    elif record.attribute == _spec.ATTRIBUTE_QUATS:
        for level in (min(lows), max(highs)):
            _check_level(level, -record.levels, record.levels, at, "QUA-1")
    else:
        _check_columns(lows, highs, record, at)


def _check_level(level: int, low: int, high: int, at: int, clause: str) -> None:
    """Raise E_RANGE with the clause unless a quantisation level is in `low`..`high`."""
    if not low <= level <= high:
        raise FormatError(_spec.ERROR_RANGE, at, clause, "level", found=level, wanted=f"{low} to {high}")


def _check_columns(lows: tuple[int, ...], highs: tuple[int, ...], record: _spec.AttributeRecord, at: int) -> None:
    """Check LAT-4: each integer, after its chroma shift, is at most COLUMN_MAX in magnitude."""
    for column, (low, high) in enumerate(zip(lows, highs, strict=True)):
        shift = record.chroma_shift if 3 * column >= len(lows) else 0
        largest = max(-low, high) << shift
        if largest > _spec.COLUMN_MAX:
            detail, wanted = f"integer of column {column}", f"at most {_spec.COLUMN_MAX} in magnitude"
            raise FormatError(_spec.ERROR_RANGE, at, "LAT-4", detail, found=largest, wanted=wanted)


def morton_axes(codes: Ints) -> Ints:
    """Return [3, n] uint32 of codes [n]: "Bit 3·b + a of a code is bit b of the integer q of axis a"."""
    out = np.empty((3, len(codes)), np.uint32)
    for start, stop in cache_sized_ranges(len(codes), 3):
        wide = codes[start:stop].astype(np.uint64)
        shifted = np.empty_like(wide)
        for axis in range(3):
            bits = (wide >> np.uint64(axis)) & np.uint64(_EVERY_THIRD_BIT)
            for shift, mask in _MORTON_STEPS:
                np.right_shift(bits, np.uint64(shift), out=shifted)
                bits |= shifted
                bits &= np.uint64(mask)
            out[axis, start:stop] = bits
    return out
