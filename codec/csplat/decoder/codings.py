"""Blocks: each attribute coding's streams into a `Block` (spec 6.4), ranges checked."""

from __future__ import annotations

import numpy as np

from csplat import _spec
from csplat.decoder.blocks import Block, Columns, Sparse
from csplat.decoder.coded import TileContext, read_coded
from csplat.decoder.container import Cursor, check_reserved
from csplat.decoder.lattice import check_step, read_block_head, read_columns, read_signed
from csplat.decoder.morton import morton_axes
from csplat.decoder.streams import Ints, read_stream
from csplat.errors import FormatError


def read_block(cursor: Cursor, context: TileContext, attribute: int) -> Block:
    """Read the block of an attribute and step over it.

    Args:
        cursor: stands at the block head.
        context: the tile.
        attribute: which block TLE-2 wants here.
    """
    at = cursor.at
    coding = read_block_head(cursor, attribute)
    count = context.tile.splat_count
    if coding == _spec.CODING_CODEBOOK:
        return read_coded(cursor, context, attribute, at)
    if coding in (_spec.CODING_MORTON, _spec.CODING_AXIS):
        return read_means(cursor, context, coding)
    if coding == _spec.CODING_SPARSE:
        return read_sparse(cursor, context, attribute)
    return read_columns(cursor, context.header, attribute, coding, count)


def read_sparse(cursor: Cursor, context: TileContext, attribute: int) -> Sparse:
    """Read mask and values: SPA-1 to SPA-3, LAT-1, LAT-4."""
    at, places = cursor.take(_spec.SPARSE_PARAMS_SIZE), _spec.SPARSE_PARAMS_OFFSETS
    params = _spec.unpack_sparse_params(cursor.view, at)
    check_reserved(params, at, places)
    record, count = context.header.attribute(attribute), context.tile.splat_count
    check_step(record, params.exponent, at + places["exponent"])
    if not 1 <= params.present_count <= count:
        raise FormatError(
            _spec.ERROR_VALUE,
            at + places["present_count"],
            "SPA-1",
            "present_count",
            found=params.present_count,
            wanted=f"1 to {count}",
        )
    mask_at = cursor.at
    bits = np.unpackbits(read_stream(cursor, (count + 7) >> 3, 1), bitorder="little")
    if bits[count:].any():
        raise FormatError(_spec.ERROR_RANGE, mask_at, "SPA-3", "bits of the mask beyond the last splat", wanted=0)
    present = np.flatnonzero(bits)
    if len(present) != params.present_count:
        raise FormatError(
            _spec.ERROR_RANGE, mask_at, "SPA-2", "bits of the mask", found=len(present), wanted=params.present_count
        )
    return Sparse(read_signed(cursor, record, params.exponent, len(present)), present)


def read_raw(cursor: Cursor, context: TileContext, column: int) -> Ints:
    """Read the block of an extra column: [n] unsigned integers, the bits of its values."""
    coding = read_block_head(cursor, _spec.ATTRIBUTE_EXTRA)
    at = cursor.take(_spec.RAW_PARAMS_SIZE)
    params = _spec.unpack_raw_params(cursor.view, at)
    check_reserved(params, at, _spec.RAW_PARAMS_OFFSETS)
    if params.column != column:
        raise FormatError(_spec.ERROR_STREAM, at, "RAW-1", "column", found=params.column, wanted=column)
    width_at = cursor.at
    elements = read_stream(cursor, context.tile.splat_count, _spec.CODING_WIDTH_MAX[coding])
    width, dtype = cursor.view[width_at], context.header.extras[column].dtype
    if dtype and width != (wanted := np.dtype(dtype).itemsize):
        raise FormatError(_spec.ERROR_STREAM, width_at, "RAW-2", "width", found=width, wanted=wanted)
    return elements


def read_means(cursor: Cursor, context: TileContext, coding: int) -> Columns:
    """Read the means of a tile, as lattice integers."""
    tile = context.tile
    count, width_max = tile.splat_count, _spec.CODING_WIDTH_MAX[coding]
    if coding == _spec.CODING_MORTON:
        params_at = cursor.take(_spec.MORTON_PARAMS_SIZE)
        params = _spec.unpack_morton_params(cursor.view, params_at)
        check_reserved(params, params_at, _spec.MORTON_PARAMS_OFFSETS)
        if not 1 <= params.bits <= _spec.MORTON_BITS_MAX:
            raise FormatError(
                _spec.ERROR_VALUE, params_at, "MOR-1", "bits", found=params.bits, wanted=f"1 to {_spec.MORTON_BITS_MAX}"
            )
        at = cursor.at
        codes = read_stream(cursor, count, width_max)
        _check_bits(codes, 3 * params.bits, at, "MOR-2")
        q = morton_axes(codes)
    else:
        at = cursor.at
        q = read_stream(cursor, 3 * count, width_max).reshape(3, count)
        _check_bits(q, _spec.AXIS_BITS_MAX, at, "AXI-1")
    block = Columns(q, tile.corner, tile.exponent, at)
    far = tuple(corner + extent for corner, extent in zip(tile.corner, tile.extent, strict=True))
    if block.lows != tile.corner or block.highs != far:
        raise FormatError(
            _spec.ERROR_BOX,
            tile.offset + _spec.TILE_RECORD_OFFSETS["corner"],
            "TIL-10",
            "the tile's box",
            found=f"{tile.corner} to {far}",
            wanted=f"{block.lows} to {block.highs}, the box of its splats",
        )
    return block


def _check_bits(elements: Ints, bits: int, at: int, clause: str) -> None:
    largest = int(elements.max())
    if largest >> bits:
        raise FormatError(_spec.ERROR_RANGE, at, clause, "integer", found=largest, wanted=f"below 2^{bits}")
