"""Splats that lack an SH band: a codebook whose one entry is zero, and the values of the others as its escapes.

The index stream says, at a bit or less per splat, who has the band; only those have values. It is chosen tile by tile
and band by band, where it is smaller than values for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder import blocks
from csplat.encoder.container import CodebookTable, FileChunk
from csplat.encoder.plan import Plan
from csplat.encoder.streams import signed_stream

__all__ = ["zero_book", "zero_book_id", "zero_or_value_block"]

Integers = NDArray[Any]

_WORTH_TRYING = 0.1  # share of a tile's splats that lack the band


def zero_book_id(band: int) -> int:
    """Id of the codebook of a band."""
    return band


def zero_book(band: int, plan: Plan) -> tuple[CodebookTable, FileChunk]:
    """What index and chunks say of the codebook of a band: one entry, zero."""
    id = zero_book_id(band)
    head = _spec.pack_codebook_head(_spec.CodebookHead(id, band, 1))
    entry = signed_stream(np.zeros(3 * (2 * band + 1), np.int8), plan.coding)
    record = CodebookTable(id, _spec.CODEBOOK_KIND_SH, (band, band), (1,))
    return record, FileChunk(_spec.CHUNK_CODEBOOK, head + entry, id, band)


def zero_or_value_block(band: int, columns: Integers, exponent: int, plan: Plan) -> tuple[bytes, Sequence[int]]:
    """Code a band of a tile: values for all, or an index for all and values for some.

    Args:
        band: 1 to 3.
        columns: [C, n] lattice integers, not all zero.
        exponent: of the tile.
        plan: how streams are coded.

    Returns:
        The block, and the ids of the codebooks that it wants.
    """
    attribute = _spec.ATTRIBUTE_SH0 + band
    plain = blocks.signed_block(attribute, columns, exponent, plan.coding)
    has: NDArray[np.bool_] = np.asarray(columns.any(axis=0), np.bool_)
    if exponent or has.mean() > 1.0 - _WORTH_TRYING:
        return plain, ()
    values = np.ascontiguousarray(columns[:, has])
    own = blocks.signed_block(attribute, values, 0, plan.coding)
    id = zero_book_id(band)
    index = has.astype(np.uint8)
    sparse = blocks.codebook_block(attribute, id, [index], values.shape[1], own, plan.coding)
    return (sparse, (id,)) if len(sparse) < len(plain) else (plain, ())
