# SPDX-License-Identifier: Apache-2.0
"""Pack splats into the words that the shaders read (`codec/wgsl/layout.wgsl`).

A tile is a run of at most 65,536 splats with constants of its own: bits per field, offsets, steps. A splat is a string
of bits: means x y z, opacity, scales, quats, sh0, in this order, so that culling reads only the beginning. The strings
of a block of 256 splats are stored word by word: 256 first words, 256 second words, and so on. A field of 32 bits is a
binary32 pattern; all others are unsigned integers. Quats of 32 bits have four fields, w x y z; others have three (spec
7.5).

An SH band is one row of coefficients per splat, or an index per splat: of a row in a table that tiles share, or, from
the length of the table on, of a row of the tile. Rows and indices are fields of equal width that do not cross words; a
row begins with a word of its own. A coefficient is (field + offset) · step, or a pattern.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import LimitError
from csplat.packed import PackedBand, PackedColumns, PackedTile
from csplat.types import F64
from csplat_render.conventions import UncheckedSplats

Words = NDArray[np.uint32]

#: Splats per workgroup, all of one tile.
BLOCK = 256

#: Rows of four words per tile in the table of constants.
TILE_ROWS = 12

#: Splats per tile of a model in memory.
MODEL_TILE = 1 << 14

_INTEGER_BITS = 23  # integers up to this, and their sums with offsets of the same size, are exact in binary32
_MEAN_BITS = 24  # exact in binary32; more are rounded to it
_PATTERN = 32  # bits
_WORD_BITS, _WORD_MASK = 32, 0xFFFFFFFF
_BAND_ROWS, _BAND_CODEBOOK = 1, 2
_SQUARED, _ANTIALIASED = 1 << 24, 1 << 25  # flags above the number of splats
_BELOW_DEGREE = 0xFFFFFF  # bits of the word of widths below the SH degree


@dataclass(eq=False)
class SharedTables:
    """The codebooks of all tiles as one run of words.

    Attributes:
        words_max: maximum number of words.
        runs: the words of each table.
        count: number of words so far.
    """

    words_max: int
    runs: list[Words] = field(default_factory=list)
    count: int = 0
    _known: dict[int, tuple[int, _Rows, PackedColumns]] = field(default_factory=dict)

    def place_of(self, table: PackedColumns) -> tuple[int, _Rows]:
        """Return the first word of a table, which is appended when it is new, and its rows.

        Raises:
            LimitError: the tables exceed `words_max`.
        """
        known = self._known.get(id(table))  # the entry keeps the table, so that its id stays its own
        if known is None:
            rows = _pack_rows(table)
            if self.count + len(rows.words) > self.words_max:
                raise LimitError(
                    "bytes of codebooks on the GPU", 4 * (self.count + len(rows.words)), 4 * self.words_max
                )
            known = self._known[id(table)] = self.count, rows, table
            self.runs.append(rows.words)
            self.count += len(rows.words)
        return known[:2]


@dataclass(frozen=True, eq=False)
class TileWords:
    """A tile for the GPU.

    Attributes:
        words: the words of the splats and of their SH bands.
        constants: [TILE_ROWS, 4]; offsets of words are relative to the tile's first word, the first block is 0.
        corner: [3], scene units; means are relative to it.
        step: scene units per integer of the means.
        splats: number of splats.
        ignored: number of splats with NaN or infinity.
    """

    words: Words
    constants: Words
    corner: F64
    step: float
    splats: int
    ignored: int = 0

    @property
    def blocks(self) -> int:
        """Number of blocks of `BLOCK` splats; the last block is filled up."""
        return -(-self.splats // BLOCK)

    def placed(self, first_word: int, first_block: int) -> Words:
        """Return the constants of the tile at a place of its page."""
        constants = self.constants.copy()
        constants[0, 0] += np.uint32(first_word)
        constants[0, 2] = first_block
        constants[4::2, 1] += np.uint32(first_word)
        constants[4::2, 3] += np.uint32(first_word)
        return constants


def pack_tile(tile: PackedTile, tables: SharedTables, shift: F64, *, antialiased: bool) -> TileWords:
    """Pack a tile of a file.

    Args:
        tile: the tile's integers.
        tables: the codebooks so far; the tile's codebooks are added.
        shift: [3], added to the means, scene units.
        antialiased: True if the scene needs the mip-splatting filter.
    """
    corner = tile.means.integers.min(axis=0)
    means, mean_bits = _mean_fields(tile.means.integers - corner)
    scales, scale_bits, scale_lattice = _fields_of(tile.scales)
    sh0, sh0_bits, sh0_lattice = _fields_of(tile.sh0)
    opacity_bits, quat_bits = _bits_for(tile.opacity_levels), _bits_for(2 * tile.quat_levels)
    quats = (tile.quats + tile.quat_levels).T
    flags = (_SQUARED if tile.opacities_squared else 0) | (_ANTIALIASED if antialiased else 0)
    writer = _TileWriter(len(tile.opacities))
    writer.put_fields(means, mean_bits)
    writer.put_fields(tile.opacities[None], [opacity_bits])
    writer.put_fields(scales, [scale_bits] * 3)
    writer.put_fields(quats, [quat_bits] * 3)
    writer.put_fields(sh0, [sh0_bits] * 3)
    writer.set_constants(
        flags, mean_bits, opacity_bits, scale_bits, quat_bits, sh0_bits, tile.opacity_levels, tile.quat_levels
    )
    writer.set_lattices(scale_lattice, sh0_lattice)
    for band, packed in sorted(tile.bands.items()):
        writer.put_band(band, packed, tables)
    return writer.finish(corner * tile.means.step + shift, tile.means.step)


def pack_splats(splats: UncheckedSplats, part: slice, shift: F64, *, antialiased: bool, sh_degree: int) -> TileWords:
    """Pack some splats of a model as binary32 patterns; splats with NaN or infinity get an opacity of 0.

    Args:
        splats: the model, float32.
        part: the splats, at most 65,536.
        shift, antialiased: as in `pack_tile`.
        sh_degree: highest SH degree, at most the model's.
    """
    means, quats, scales = splats.means[part], splats.quats[part].astype(np.float64), splats.scales[part]
    opacities, sh0 = splats.opacities[part], splats.sh0[part]
    shN = splats.shN[part, : (sh_degree + 1) ** 2 - 1].reshape(len(means), -1)
    columns = np.concatenate([means, splats.quats[part], scales, opacities[:, None], sh0, shN], axis=1)
    valid = np.isfinite(columns).all(axis=1)
    # The median, as outliers would cost all others their precision.
    corner = np.median(means[valid].astype(np.float64), axis=0) if valid.any() else np.zeros(3)
    offsets = np.where(valid[:, None], means - corner, 0.0)
    quats = np.where(valid[:, None], quats, 0.0)
    lengths = np.sqrt((quats * quats).sum(axis=1, keepdims=True))
    quats = np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1.0), (1.0, 0.0, 0.0, 0.0))
    writer = _TileWriter(len(means))
    for fields in (offsets, np.where(valid, opacities, 0.0)[:, None], scales, quats, sh0):
        writer.put_fields(_patterns(fields).T, [_PATTERN] * fields.shape[1])
    writer.set_constants(
        _ANTIALIASED if antialiased else 0, [_PATTERN] * 3, _PATTERN, _PATTERN, _PATTERN, _PATTERN, 1, 1
    )
    for band in range(1, sh_degree + 1):
        coefficients = shN[:, 3 * (band * band - 1) : 3 * ((band + 1) ** 2 - 1)]
        writer.put_rows(band, _Rows(_patterns(coefficients).reshape(-1), _PATTERN, 0.0, 1.0))
    return writer.finish(corner + shift, 1.0, int(np.count_nonzero(~valid)))


@dataclass(frozen=True, eq=False)
class _Rows:
    """Packed rows of SH coefficients. A coefficient is (field + offset) · step, or for 32 bits the field's pattern."""

    words: Words
    bits: int
    offset: float
    step: float


class _TileWriter:
    """The words and constants of a tile.

    All fields of the geometry come first (`put_fields`), then `set_constants` and, for integers, `set_lattices`, then
    the bands, whose offsets depend on the number of words of the geometry.
    """

    def __init__(self, splats: int) -> None:
        self._splats = splats
        self._blocks = -(-splats // BLOCK)
        self._planes: list[Words] = []  # each array holds one word per splat, padded to whole blocks
        self._bit = 0  # number of bits of a splat so far
        self._band_words: list[Words] = []  # what follows the geometry
        self._indices: dict[int, int] = {}  # first word, by id of the array
        self._constants = np.zeros((TILE_ROWS, 4), np.uint32)

    def put_fields(self, columns: NDArray[Any], bits: list[int]) -> None:
        """Append fields to the bits of every splat; a field may continue in the next word.

        Args:
            columns: [C, n] unsigned integers, one field of each splat per row.
            bits: [C], their widths, at most 32.
        """
        for column, width in zip(columns, bits, strict=True):
            values = np.zeros(self._blocks * BLOCK, np.uint64)
            values[: self._splats] = column
            word, shift = divmod(self._bit, _WORD_BITS)
            self._bit += width
            while len(self._planes) < -(-self._bit // _WORD_BITS):
                self._planes.append(np.zeros(self._blocks * BLOCK, np.uint32))
            values <<= np.uint64(shift)
            self._planes[word] |= (values & np.uint64(_WORD_MASK)).astype(np.uint32)
            if shift + width > _WORD_BITS:
                self._planes[word + 1] |= (values >> np.uint64(_WORD_BITS)).astype(np.uint32)

    def set_constants(
        self,
        flags: int,
        mean_bits: list[int],
        opacity_bits: int,
        scale_bits: int,
        quat_bits: int,
        sh0_bits: int,
        opacity_levels: int,
        quat_levels: int,
    ) -> None:
        """Set numbers of splats and words, flags, bits per field (of means: of x, y, z) and numbers of levels."""
        x, y, z = mean_bits
        self._constants[0] = 0, len(self._planes), 0, self._splats | flags
        self._constants[1] = (
            x | y << 8 | z << 16 | opacity_bits << 24,
            scale_bits | quat_bits << 8 | sh0_bits << 16,
            opacity_levels,
            quat_levels,
        )

    def set_lattices(self, scales: F64, sh0: F64) -> None:
        """Set the lattices of scales and sh0, [4] each: the offsets of the three columns, and the step."""
        self._constants[2] = np.asarray(scales, np.float32).view(np.uint32)
        self._constants[3] = np.asarray(sh0, np.float32).view(np.uint32)

    def put_band(self, band: int, packed: PackedBand, tables: SharedTables) -> None:
        """Append a band: rows of coefficients, or an index per splat into a shared table followed by such rows."""
        rows = _pack_rows(packed.rows)
        if packed.table is None or packed.index is None:
            self.put_rows(band, rows)
            return
        place, table = tables.place_of(packed.table)
        size = len(packed.table.integers)
        bits = _bits_for(max(1, size + len(packed.rows.integers) - 1))
        index = self._indices.get(id(packed.index))
        if index is None:
            index = self._indices[id(packed.index)] = self._append(_pack_fields(packed.index, bits))
        kinds = _BAND_CODEBOOK | bits << 2 | table.bits << 8 | rows.bits << 16
        self._set_band(band, (kinds, index, place, self._append(rows.words)), (table.offset, rows.offset, rows.step))
        self._constants[3 + 2 * band, 3] = size

    def put_rows(self, band: int, rows: _Rows) -> None:
        """Append a band that has a row of coefficients for each splat, in their order."""
        head = (_BAND_ROWS | rows.bits << 16, 0, 0, self._append(rows.words))
        self._set_band(band, head, (0.0, rows.offset, rows.step))

    def _set_band(self, band: int, head: tuple[int, ...], floats: tuple[float, ...]) -> None:
        """Set the constants of a band, and the tile's SH degree to it; bands come in ascending order.

        Args:
            band: 1 to 4.
            head: kind and bits per field, first word of the indices, of the table and of the rows.
            floats: offset of the table, offset of the rows, step.
        """
        self._constants[2 + 2 * band] = head
        self._constants[3 + 2 * band, :3] = np.array(floats, np.float32).view(np.uint32)
        self._constants[1, 1] = (int(self._constants[1, 1]) & _BELOW_DEGREE) | band << 24

    def _append(self, words: Words) -> int:
        """Append words after the geometry, and return the offset of the first from the tile's first word."""
        offset = len(self._planes) * self._blocks * BLOCK + sum(len(run) for run in self._band_words)
        self._band_words.append(words)
        return offset

    def finish(self, corner: F64, step: float, ignored: int = 0) -> TileWords:
        """Return the tile, with the words of the geometry block by block; for the arguments see `TileWords`."""
        planes = np.stack(self._planes).reshape(len(self._planes), self._blocks, BLOCK)
        words = np.concatenate([planes.transpose(1, 0, 2).reshape(-1), *self._band_words])
        return TileWords(words, self._constants, np.asarray(corner, np.float64), step, self._splats, ignored)


def _mean_fields(integers: NDArray[np.int64]) -> tuple[NDArray[np.uint32], list[int]]:
    """Return fields [3, n] of integers [n, 3] from 0 on, and their bits; patterns if an axis exceeds `_MEAN_BITS`."""
    bits = [_bits_for(int(largest)) for largest in integers.max(axis=0)]
    if max(bits) <= _MEAN_BITS:
        return integers.T.astype(np.uint32), bits
    return _patterns(integers).T, [_PATTERN] * 3


def _fields_of(packed: PackedColumns) -> tuple[NDArray[np.uint32], int, F64]:
    """Convert three columns to fields with common bits; to patterns if they exceed `_INTEGER_BITS`.

    Returns:
        [3, n], fields; bits; [4], offset of each column and the step, in the unit of the values, 0 for patterns.
    """
    low = packed.integers.min(axis=0)
    fields = packed.integers - low
    bits = _bits_for(int(fields.max()))
    if bits > _INTEGER_BITS:
        return _patterns(packed.integers * packed.step).T, _PATTERN, np.zeros(4)
    return fields.T.astype(np.uint32), bits, np.array([*(low * packed.step), packed.step])


def _pack_rows(packed: PackedColumns) -> _Rows:
    """Pack rows of SH coefficients [n, 2 l + 1, 3], as patterns if they exceed `_INTEGER_BITS`; no words for n = 0."""
    if not len(packed.integers):
        return _Rows(np.zeros(0, np.uint32), 1, 0.0, packed.step)
    rows = packed.integers.reshape(len(packed.integers), -1)
    low, high = int(rows.min()), int(rows.max())
    bits = _bits_for(high - low)
    if bits > _INTEGER_BITS or max(-low, high) >> _INTEGER_BITS:
        return _Rows(_patterns(rows * packed.step).reshape(-1), _PATTERN, 0.0, packed.step)
    return _Rows(_pack_fields((rows - low), bits), bits, float(low), packed.step)


def _pack_fields(values: NDArray[Any], bits: int) -> Words:
    """Pack the fields of each row [n, C], or a single row [n], as many per word as fit, the first in the lowest bits.

    `bits` is the width of a field, 1 to 32; each row begins with a new word.
    """
    per_word = _WORD_BITS // bits
    rows = values[None] if values.ndim == 1 else values
    padded = np.zeros((len(rows), -(-rows.shape[1] // per_word) * per_word), np.uint32)
    padded[:, : rows.shape[1]] = rows
    shifts = (np.arange(per_word) * bits).astype(np.uint32)
    words: Words = np.bitwise_or.reduce(padded.reshape(len(rows), -1, per_word) << shifts, axis=2).reshape(-1)
    return words


def _patterns(values: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the binary32 patterns of values, in their shape; values beyond binary32 become infinite."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, np.float32).view(np.uint32)


def _bits_for(largest: int) -> int:
    """Return the number of bits of integers from 0 to `largest`, at least 1."""
    return max(1, largest.bit_length())
