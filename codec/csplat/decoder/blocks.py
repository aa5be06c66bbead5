"""Blocks of a tile once their streams are read: integers, not yet values.

Two kinds of block, one interface: `rows(start, stop, dtype)` gives the lattice integers or
levels of a run of splats, `bound` the largest magnitude that can occur on the way to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.header import Tile
from csplat.decoder.streams import Ints

_RUN_ELEMENTS = 1 << 18  # integers that are worked on at a time: they stay in the second-level cache
_RUN_SPLATS = 1 << 14


@dataclass(frozen=True)
class Columns:
    """A block whose integers are in the stream: offset plus element.

    Attributes:
        elements: [C, n], as narrow as they came.
        offsets: C summands, one per column.
        exponent: the block's lattice is coarser by 2^exponent.
        at: offset in the file where the stream begins.
        lows: smallest integer of each column, offset included.
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
        """Return the integers of splats `start` to `stop`, [C, stop − start], a new array.

        Args:
            start: first splat.
            stop: the splat after the last.
            dtype: signed, wide enough for `bound`.
        """
        out = self.elements[:, start:stop].astype(dtype)
        if any(self.offsets):
            out += np.array(self.offsets, dtype)[:, None]
        return out


@dataclass
class Codebook:
    """One codebook, as far as it was asked for.

    Attributes:
        record: its record in the index.
        entries: for each layer (0, or an SH band) [size, C] integers.
        values: [size, K, 3] float32: the coefficients of the loaded bands, from `band_first`
            on, for SH codebooks.
    """

    record: _spec.CodebookRecord
    entries: dict[int, Ints] = field(default_factory=dict)
    values: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Indices:
    """The indices of a tile's first block of a codebook, which its other blocks use too.

    Attributes:
        book: the codebook.
        attribute: attribute id of the first block.
        places: [n], the entry of each splat; the size of the codebook if it is escaped.
        escaped: places of the splats that no entry serves, ascending.
    """

    book: Codebook
    attribute: int
    places: Ints
    escaped: NDArray[np.intp]


@dataclass(frozen=True)
class Coded:
    """A block coded CODEBOOK: the integers are entries, in scales plus a summand (spec 6.4.5).

    Attributes:
        indices: the entry of each splat.
        entries: [size, C], the columns of this block's attribute.
        escapes: the integers of the escaped splats.
        summand: for scales, one column that is added to all three.
        at: offset in the file where the block begins.
        exponent: 0; blocks coded CODEBOOK are on the file's lattice.
        bound: largest magnitude of an integer, or of a part of a sum.
    """

    indices: Indices
    entries: Ints
    escapes: Columns | None
    summand: Columns | None
    at: int
    exponent: int = 0
    bound: int = field(init=False)

    def __post_init__(self) -> None:
        total = max(abs(int(self.entries.min())), abs(int(self.entries.max())))
        total += self.summand.bound if self.summand else 0
        object.__setattr__(self, "bound", max(total, self.escapes.bound if self.escapes else 0))

    def rows(self, start: int, stop: int, dtype: np.dtype[np.signedinteger]) -> Ints:
        """Return the integers of splats `start` to `stop`, as `Columns.rows` does."""
        # An escaped splat's index is the codebook's size: `clip` gives it the last entry for now.
        rows = np.take(self.entries, self.indices.places[start:stop], axis=0, mode="clip")
        out = np.ascontiguousarray(rows.T, dtype)
        if self.summand:
            out += self.summand.rows(start, stop, dtype)
        if self.escapes:
            first, last = np.searchsorted(self.indices.escaped, (start, stop))
            places = self.indices.escaped[first:last] - start
            out[:, places] = self.escapes.rows(int(first), int(last), dtype)
        return out


@dataclass(frozen=True)
class Sparse:
    """A block coded SPARSE: the integers of some splats, those of the others are 0 (spec 6.4.7).

    Attributes:
        values: integers of the splats that the mask names.
        places: indices of these splats, ascending.
    """

    values: Columns
    places: NDArray[np.intp]

    @property
    def at(self) -> int:
        """Offset in the file where the stream of the values begins."""
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
        """Return the integers of splats `start` to `stop`, as `Columns.rows` does."""
        out = np.zeros((len(self.values.elements), stop - start), dtype)
        first, last = np.searchsorted(self.places, (start, stop))
        out[:, self.places[first:last] - start] = self.values.rows(int(first), int(last), dtype)
        return out


Block = Columns | Coded | Sparse


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


def work_dtype(bound: int) -> np.dtype[np.signedinteger]:
    """Return the narrowest signed type, of two bytes at least, that holds ±bound."""
    if bound < 1 << 15:
        return np.dtype(np.int16)
    return np.dtype(np.int32) if bound < 1 << 31 else np.dtype(np.int64)


def runs(count: int, columns: int) -> Iterator[tuple[int, int]]:
    """Cut `count` splats into runs whose integers fit the cache."""
    step = min(_RUN_SPLATS, max(1, _RUN_ELEMENTS // columns))
    for start in range(0, count, step):
        yield start, min(count, start + step)
