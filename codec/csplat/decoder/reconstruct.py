# SPDX-License-Identifier: Apache-2.0
"""Reconstruct float32 values from integers (spec 7): one product in binary64, rounded once.

Each `write_…` fills the output of one tile. `lattice_rows` and `quat_rows` yield checked integers, colours as red,
green and blue. `write_integers` copies the same integers (spec 9.2).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.blocks import (
    Block,
    CodebookBlock,
    ColumnBlock,
    SparseBlock,
    TileBlocks,
    cache_sized_ranges,
    work_dtype,
)
from csplat.decoder.container import SceneHeader, Tile, refuse_field
from csplat.decoder.entropy import Ints
from csplat.errors import FormatError
from csplat.types import F32, F64

_SQRT_2 = float.fromhex("0x1.6A09E667F3BCDp+0")  # 7.5
_INT32 = np.dtype(np.int32)

_BAND_NAMES = {band: _spec.ATTRIBUTE_NAMES[_spec.ATTRIBUTE_SH0 + band] for band in range(1, _spec.SH_DEGREE_MAX + 1)}


@dataclass(frozen=True)
class SplatArrays:
    """The arrays of spec 3, of a scene or a tile.

    Attributes:
        means: [N, 3].
        quats: [N, 4], w, x, y, z.
        scales: [N, 3], natural logarithms.
        opacities: [N].
        sh0: [N, 3].
        shN: [N, K, 3].
        extra: [N] or [N, components] each, by name.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    extra: dict[str, NDArray[Any]]

    @classmethod
    def empty(cls, count: int, sh_degree: int, header: SceneHeader) -> SplatArrays:
        """Allocate uninitialised arrays for `count` splats."""
        return cls(
            means=np.empty((count, 3), np.float32),
            quats=np.empty((count, 4), np.float32),
            scales=np.empty((count, 3), np.float32),
            opacities=np.empty(count, np.float32),
            sh0=np.empty((count, 3), np.float32),
            shN=np.empty((count, (sh_degree + 1) ** 2 - 1, 3), np.float32),
            extra={column.name: np.empty(count, column.splat_dtype) for column in header.extras if column.dtype},
        )

    def part(self, start: int, stop: int) -> SplatArrays:
        """Return views of some splats."""
        return SplatArrays(
            means=self.means[start:stop],
            quats=self.quats[start:stop],
            scales=self.scales[start:stop],
            opacities=self.opacities[start:stop],
            sh0=self.sh0[start:stop],
            shN=self.shN[start:stop],
            extra={name: column[start:stop] for name, column in self.extra.items()},
        )


def write_tile(source: TileBlocks, header: SceneHeader, degree: int, opacities: F32, out: SplatArrays) -> None:
    """Reconstruct the values of a tile.

    Args:
        source: the tile's integers.
        header: header and index.
        degree: highest SH band to decode.
        opacities: alpha of each level, from `opacity_table`.
        out: output, the tile's part of the arrays.
    """
    blocks = source.blocks
    write_opacities(blocks[_spec.ATTRIBUTE_OPACITIES], opacities, out.opacities)
    scales = header.attribute(_spec.ATTRIBUTE_SCALES)
    largest = write_lattice(blocks[_spec.ATTRIBUTE_SCALES], scales, out.scales)
    check_max_scale(source, scales, largest)
    write_quats(blocks[_spec.ATTRIBUTE_QUATS], header.attribute(_spec.ATTRIBUTE_QUATS), out.quats)
    write_lattice(blocks[_spec.ATTRIBUTE_MEANS], header.attribute(_spec.ATTRIBUTE_MEANS), out.means)
    write_colour(blocks[_spec.ATTRIBUTE_SH0], header.attribute(_spec.ATTRIBUTE_SH0), out.sh0[:, None])
    bands = {band: _spec.ATTRIBUTE_SH0 + band for band in range(1, degree + 1)}
    write_bands(
        {band: blocks[attribute] for band, attribute in bands.items() if attribute in blocks},
        {band: header.attribute(attribute) for band, attribute in bands.items()},
        out.shN,
    )
    if out.extra:  # a cut of coarser levels has no extra columns
        for bits, column in zip(source.extra, out.extra.values(), strict=True):
            column.view(bits.dtype)[:] = bits


def empty_integers(count: int, tile_count: int, degree: int) -> dict[str, NDArray[Any]]:
    """Allocate the arrays of spec 9.2; bands and exponents without a block stay 0."""
    arrays: dict[str, NDArray[Any]] = {
        "opacities": np.empty(count, np.uint32),
        "scales": np.empty((count, 3), np.int64),
        "quats": np.empty((count, 3), np.int32),
        "means": np.empty((count, 3), np.int64),
        "sh0": np.empty((count, 3), np.int64),
    }
    for band in range(1, degree + 1):
        arrays[_BAND_NAMES[band]] = np.zeros((count, 2 * band + 1, 3), np.int64)
    arrays["tile_splats"] = np.empty(tile_count, np.uint32)
    arrays["exponents"] = np.zeros((tile_count, _spec.ATTRIBUTE_SH0 + degree), np.int32)
    return arrays


def integer_part(arrays: dict[str, NDArray[Any]], start: int, stop: int) -> dict[str, NDArray[Any]]:
    """Return views of some splats, omitting the arrays with a row per tile."""
    return {name: a[start:stop] for name, a in arrays.items() if name not in ("tile_splats", "exponents")}


def write_integers(
    source: TileBlocks, header: SceneHeader, out: dict[str, NDArray[Any]], exponents: NDArray[Any]
) -> None:
    """Write the integers of a tile; check the same clauses as `write_tile`.

    Args:
        source: the tile's integers.
        header: header and index.
        out: output, the tile's part of the arrays.
        exponents: output, the tile's row of zeros.
    """
    count = source.tile.splat_count
    for attribute, block in source.blocks.items():
        record = header.attribute(attribute)
        name = _spec.ATTRIBUTE_NAMES[attribute]
        array = out[name]
        exponents[attribute - 1] = block.exponent
        if attribute == _spec.ATTRIBUTE_OPACITIES:
            for start, stop in cache_sized_ranges(count, 1):
                array[start:stop] = block.rows(start, stop, _INT32)[0]
        elif attribute == _spec.ATTRIBUTE_QUATS:
            for start, stop, q, _r in quat_rows(block, record, count):
                array[start:stop] = q.T
        else:
            by_channel = array.reshape(count, -1, 3)
            largest = []
            for start, stop, parts in lattice_rows(block, record, count):
                for i, part in enumerate(parts):
                    by_channel[start:stop, :, i] = part.T
                if not isinstance(block, ColumnBlock):
                    largest.append(max(int(part.max()) for part in parts))
            if attribute == _spec.ATTRIBUTE_SCALES:
                top = max(block.highs) if isinstance(block, ColumnBlock) else max(largest)
                check_max_scale(source, record, top)


def check_max_scale(source: TileBlocks, record: _spec.AttributeRecord, largest: int) -> None:
    """Check TIL-11 with the largest integer, which has the largest value."""
    step = np.ldexp(record.step, source.blocks[_spec.ATTRIBUTE_SCALES].exponent)
    value, tile = np.float32(np.float64(largest) * step), source.tile
    # Compare bits, so that NaN and −0 are refused.
    if struct.pack("<f", tile.max_scale) != value.tobytes():
        offsets = _spec.TILE_RECORD_OFFSETS
        refuse_field(_spec.ERROR_BOX, "TIL-11", tile, tile.offset, offsets, "max_scale", float(value))


# Lattices: means, scales, colours (7.1, 7.2, 7.4) --------------------------------------------------


def tile_boxes(header: SceneHeader, tiles: Sequence[Tile]) -> F64:
    """Return the boxes around the centres of the splats of some tiles (spec 4.3.5).

    Returns:
        [T, 2, 3] float64: smallest and largest corner in scene units, relative to the origin. The numbers are
        rounded to binary32, as the centres are. In float64 they are compared exactly with any query.
    """
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step
    return np.array([tile.corners(step) for tile in tiles], np.float64).reshape(len(tiles), 2, 3)


def boxes_touching(boxes: F64, box: F64) -> NDArray[np.bool_]:
    """Return a mask of the boxes [T, 2, 3] that share a point with `box`, [2, 3], smallest corner first (spec 5.7)."""
    touch: NDArray[np.bool_] = np.all((boxes[:, 0] <= box[1]) & (boxes[:, 1] >= box[0]), axis=1)
    return touch


def lattice_rows(
    block: Block, record: _spec.AttributeRecord, count: int
) -> Iterator[tuple[int, int, tuple[Ints, Ints, Ints]]]:
    """Yield runs of lattice integers: start, stop and three arrays [C / 3, stop - start].

    The arrays are x, y, z of means and scales, or red, green, blue of colours.

    Args:
        block: a block of means, scales, sh0 or an SH band.
        record: record of the attribute.
        count: number of splats in the block.

    Raises:
        FormatError: E_RANGE by LAT-5: a value is not finite in binary32. Means are, by MEA-1 and TIL-10.
    """
    columns = _spec.ATTRIBUTE_COLUMNS[record.attribute]
    colour = record.mapping == _spec.MAPPING_YCOCG
    bound = _bound(block, record)
    dtype = work_dtype(bound)
    step = math.ldexp(record.step, block.exponent)
    check = record.attribute != _spec.ATTRIBUTE_MEANS and not _is_finite(bound, step)
    for start, stop in cache_sized_ranges(count, columns):
        rows = block.rows(start, stop, dtype)
        third = columns // 3
        parts = rows[:third], rows[third : 2 * third], rows[2 * third :]
        if colour:
            parts = lift(*parts, record.chroma_shift)
        if check:
            _check_finite(parts, step, record, block.at)
        yield start, stop, parts


def check_values(block: Block, record: _spec.AttributeRecord, count: int) -> None:
    """Check as `lattice_rows` does, without reading the integers if their bound is small enough."""
    if not _is_finite(_bound(block, record), math.ldexp(record.step, block.exponent)):
        for _ in lattice_rows(block, record, count):
            pass


def _bound(block: Block, record: _spec.AttributeRecord) -> int:
    """Return a bound of the magnitudes of the block's lattice integers and their intermediate values."""
    bound = max(1, block.bound)
    if record.mapping == _spec.MAPPING_YCOCG:  # |Y| + 2 (|Co| + |Cg|), shifted, covers R, G, B
        bound += bound << (record.chroma_shift + 2)
    return bound


def _is_finite(integer: int, step: float) -> bool:
    """Return True if the product of an integer and a positive step, rounded once to float32, is finite."""
    return bool(np.isfinite(np.float32(min(integer * step, math.inf))))


def lift(y: Ints, co: Ints, cg: Ints, chroma_shift: int) -> tuple[Ints, Ints, Ints]:
    """Convert Y, Co, Cg to R, G, B in place (7.1); the signed integers must be wide enough for the results."""
    if chroma_shift:
        scale = co.dtype.type(1 << chroma_shift)
        co *= scale
        cg *= scale
    half = cg >> 1
    y -= half  # t = y - (cg >> 1)
    cg += y  # g = cg + t
    np.right_shift(co, 1, out=half)
    y -= half  # b = t - (co >> 1)
    co += y  # r = b + co
    return co, cg, y


def write_lattice(block: Block, record: _spec.AttributeRecord, out: F32) -> int:
    """Write means or scales, [n, 3]; return the largest lattice integer."""
    step = math.ldexp(record.step, block.exponent)
    largest = []
    for start, stop, parts in lattice_rows(block, record, len(out)):
        for axis, part in enumerate(parts):
            _scale(part[0], step, out[start:stop, axis], wide=record.attribute == _spec.ATTRIBUTE_MEANS)
        if not isinstance(block, ColumnBlock):
            largest.append(max(int(part.max()) for part in parts))
    return max(block.highs) if isinstance(block, ColumnBlock) else max(largest)


def write_colour(block: Block, record: _spec.AttributeRecord, out: F32) -> None:
    """Write the coefficients of a band, [n, 2 l + 1, 3]."""
    step = math.ldexp(record.step, block.exponent)
    for start, stop, parts in lattice_rows(block, record, len(out)):
        for channel, part in enumerate(parts):
            for coefficient, row in enumerate(part):
                _scale(row, step, out[start:stop, coefficient, channel])


def write_bands(blocks: dict[int, Block], records: dict[int, _spec.AttributeRecord], out: F32) -> None:
    """Write the higher coefficients of a tile, [n, K, 3]; bands without a block become +0.

    Args:
        blocks: blocks of the tile by band.
        records: attribute records of all bands to write.
        out: output, the tile's part of shN.
    """
    copied = _copy_entries(blocks, records, out)
    for band, record in records.items():
        part = out[:, band * band - 1 : (band + 1) ** 2 - 1]
        block = blocks.get(band)
        if block is None:
            part[:] = 0.0
        elif isinstance(block, SparseBlock):
            part[:] = 0.0
            _write_some(block.splat_indices, block.values, record, part)
        elif not copied:
            write_colour(block, record, part)
        elif isinstance(block, CodebookBlock) and block.escapes:
            _write_some(block.indices.escaped, block.escapes, record, part)


def _copy_entries(blocks: dict[int, Block], records: dict[int, _spec.AttributeRecord], out: F32) -> bool:
    """Copy float32 rows to `out` [n, K, 3] if all bands use the same codebook and indices; return False otherwise."""
    first = blocks.get(1)
    if not isinstance(first, CodebookBlock) or len(blocks) != len(records):
        return False
    indices = first.indices
    values = indices.book.values
    if values is None or values.shape[1:] != out.shape[1:]:
        return False
    if not all(isinstance(block, CodebookBlock) and block.indices is indices for block in blocks.values()):
        return False
    np.take(values, indices.entry_indices, axis=0, out=out, mode="clip")
    return True


def _write_some(splat_indices: NDArray[np.intp], columns: ColumnBlock, record: _spec.AttributeRecord, out: F32) -> None:
    """Write the coefficients of k splats, of indices [k], to `out` [n, 2 l + 1, 3]."""
    values = np.empty((len(splat_indices), *out.shape[1:]), np.float32)
    write_colour(columns, record, values)
    out[splat_indices] = values


def _scale(integers: Ints, step: float, out: F32, *, wide: bool = False) -> None:
    """Compute float32(float64(n) × step), rounded once; except for means, a product in binary32 is the same (7.2)."""
    if wide:
        np.multiply(integers, step, out=out, dtype=np.float64, casting="same_kind")
    else:
        np.multiply(integers, np.float32(step), out=out, dtype=np.float32, casting="same_kind")


def _check_finite(parts: tuple[Ints, Ints, Ints], step: float, record: _spec.AttributeRecord, at: int) -> None:
    """Check LAT-5 for the R, G and B integers of a block at offset `at`."""
    largest = max(max(-int(part.min()), int(part.max())) for part in parts)  # has the largest value
    if not np.isfinite(np.float32(float(largest) * step)):
        detail = f"{_spec.ATTRIBUTE_NAMES[record.attribute]}: {largest} x {step} is not finite in binary32"
        raise FormatError(_spec.ERROR_RANGE, at, "LAT-5", detail)


# Levels: opacities, quats (7.3, 7.5) ---------------------------------------------------------------


def opacity_table(record: _spec.AttributeRecord) -> F32:
    """Return alpha for q = 0, ..., levels (7.3)."""
    q = np.arange(record.levels + 1, dtype=np.float64)
    if record.mapping == _spec.MAPPING_SQUARE:  # q² and M² stay below 2^32: exact in binary64
        return (q * q / float(record.levels * record.levels)).astype(np.float32)
    return (q / float(record.levels)).astype(np.float32)


def write_opacities(block: Block, table: F32, out: F32) -> None:
    """Write opacities, [n], by a table of all levels, which LEV-1 has bounded."""
    for start, stop in cache_sized_ranges(len(out), 1):
        levels = block.rows(start, stop, _INT32)[0]
        np.take(table, levels, out=out[start:stop], mode="clip")


def quat_rows(
    block: Block, record: _spec.AttributeRecord, count: int
) -> Iterator[tuple[int, int, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield start, stop, q = (q1, q2, q3) [3, stop - start] and R = 2 M² - |q|² (7.5), both exact in binary64.

    Raises:
        FormatError: E_RANGE by QUA-2: R is negative.
    """
    for start, stop in cache_sized_ranges(count, 3):
        q = block.rows(start, stop, _INT32).astype(np.float64)
        square = q[0] * q[0]
        r = 2.0 * record.levels * record.levels - square
        for i in (1, 2):
            np.multiply(q[i], q[i], out=square)
            r -= square
        lowest = r.min()
        if lowest < 0:
            detail = f"R of splat {start + int(r.argmin())} of the block"
            raise FormatError(_spec.ERROR_RANGE, block.at, "QUA-2", detail, found=int(lowest), wanted="at least 0")
        yield start, stop, q, r


def write_quats(block: Block, record: _spec.AttributeRecord, out: F32) -> None:
    """Write rotations w, x, y, z, [n, 4]."""
    c = 1.0 / (float(record.levels) * _SQRT_2)
    for start, stop, q, r in quat_rows(block, record, len(out)):
        np.sqrt(r, out=r)
        np.multiply(r, c, out=out[start:stop, 0], dtype=np.float64, casting="same_kind")
        for axis in range(3):
            np.multiply(q[axis], c, out=out[start:stop, axis + 1], dtype=np.float64, casting="same_kind")
