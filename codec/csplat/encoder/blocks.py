"""Integers of one attribute in one tile to the bytes of its block (spec 6.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder.streams import Coding, signed_stream, smooth_stream, unsigned_stream
from csplat.types import I64

Integers = NDArray[Any]

_MOSTLY = 0.9  # share of the splats from which on a mask is not worth the time that it takes decoders


def levels_block(q: Integers, coding: Coding) -> bytes:
    """Opacities, LEVELS: q [n], 0 to M."""
    return _head(_spec.ATTRIBUTE_OPACITIES, _spec.CODING_LEVELS) + unsigned_stream(q, coding)


def morton_block(codes: I64, bits: int, coding: Coding) -> bytes:
    """Means, MORTON: codes [n], ascending, below 2**(3·bits)."""
    params = _spec.pack_morton_params(_spec.MortonParams(bits, 0, 0))
    head = _head(_spec.ATTRIBUTE_MEANS, _spec.CODING_MORTON)
    return head + params + unsigned_stream(codes, coding, delta=True)


def axis_block(q: Integers, coding: Coding) -> bytes:
    """Means, AXIS: q [3, n], 0 to 2**24 - 1, any order."""
    stream = unsigned_stream(q.reshape(-1), coding, signed_delta=True)
    return _head(_spec.ATTRIBUTE_MEANS, _spec.CODING_AXIS) + stream


def offset_block(attribute: int, integers: Integers, exponent: int, coding: Coding) -> bytes:
    """OFFSET: integers [C, n], any sign, at most 2**32 - 1 apart in each column."""
    return _head(attribute, _spec.CODING_OFFSET) + _offset_columns(integers, exponent, coding)


def signed_block(attribute: int, integers: Integers, exponent: int, coding: Coding) -> bytes:
    """SIGNED: integers [C, n] of at most 32 bits."""
    head = _head(attribute, _spec.CODING_SIGNED) + _spec.pack_lattice_params(_spec.LatticeParams(exponent, 0))
    return head + signed_stream(np.ascontiguousarray(integers).reshape(-1), coding)


def sparse_block(attribute: int, integers: Integers, exponent: int, coding: Coding) -> bytes:
    """SPARSE: integers [C, n] of at most 32 bits, not all of them 0."""
    has = integers.any(axis=0)
    params = _spec.SparseParams(exponent, 0, int(np.count_nonzero(has)))
    mask = unsigned_stream(np.packbits(has, bitorder="little"), coding, fixed_width=1)
    head = _head(attribute, _spec.CODING_SPARSE) + _spec.pack_sparse_params(params)
    return head + mask + signed_stream(np.ascontiguousarray(integers[:, has]).reshape(-1), coding)


def signed_or_sparse_block(attribute: int, integers: Integers, exponent: int, coding: Coding) -> bytes:
    """SIGNED or SPARSE, whichever is smaller: integers [C, n] of at most 32 bits, not all of them 0."""
    plain = signed_block(attribute, integers, exponent, coding)
    if np.count_nonzero(integers.any(axis=0)) > _MOSTLY * integers.shape[1]:
        return plain
    sparse = sparse_block(attribute, integers, exponent, coding)
    return sparse if len(sparse) < len(plain) else plain


def codebook_block(
    attribute: int,
    codebook_id: int,
    index: Integers | None,
    escape_count: int,
    escape: bytes,
    coding: Coding,
    summand: Integers | None = None,
) -> bytes:
    """CODEBOOK.

    Args:
        attribute: registry id.
        codebook_id: which codebook.
        index: [n]; none for blocks that use that of the codebook's first block.
        escape_count: splats with the index "escaped".
        escape: their block, empty where there are none.
        coding: how to code the index.
        summand: [n], for scales of the kind SHAPE: what is added to all three.
    """
    params = _spec.pack_codebook_params(_spec.CodebookParams(codebook_id, 0, escape_count))
    streams = b"" if index is None else unsigned_stream(index, coding)
    if summand is not None:
        streams += _offset_columns(summand[None], 0, coding)
    return _head(attribute, _spec.CODING_CODEBOOK) + params + streams + escape


def raw_block(column: int, values: NDArray[Any], coding: Coding) -> bytes:
    """RAW: the bits of an extra column's values [n]."""
    bits = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).view(f"<u{values.itemsize}")
    params = _spec.pack_raw_params(_spec.RawParams(column, 0))
    stream = unsigned_stream(bits, coding, fixed_width=values.itemsize)
    return _head(_spec.ATTRIBUTE_EXTRA, _spec.CODING_RAW) + params + stream


def _offset_columns(integers: Integers, exponent: int, coding: Coding) -> bytes:
    offsets = integers.min(axis=1).astype("<i4")
    elements = integers - offsets.astype(integers.dtype)[:, None]
    stored: bytes = _spec.pack_lattice_params(_spec.LatticeParams(exponent, 0)) + offsets.tobytes()
    return stored + smooth_stream(elements.reshape(-1), coding)


def _head(attribute: int, coding: int) -> bytes:
    return _spec.pack_block_head(_spec.BlockHead(attribute, coding, 0))
