"""Shapes by codebook: what the shape stage decided, and the blocks that it becomes (spec 6.4.5, kind SHAPE)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder import blocks
from csplat.encoder.container import CodebookTable, FileChunk
from csplat.encoder.streams import Coding, signed_stream
from csplat.types import I32

Integers = NDArray[Any]

#: Id of the codebook: above those of the SH stage.
SHAPE_BOOK = _spec.SH_DEGREE_MAX + 1


@dataclass(frozen=True, eq=False)
class ShapePart:
    """Codebook entries of the splats of a tile.

    Attributes:
        index: [n] int32, entry of each splat; `size` means "escaped".
        size: entries of the codebook.
        served: [n] bool, True for splats that are not escaped.
        scales: [3, served] int32, their log scales on the file's lattice. quats: [3, served], their rotations.
        summand: [n] int32, the part of the scales that is each splat's own; 0 for the escaped.
    """

    index: I32
    size: int
    served: NDArray[np.bool_]
    scales: I32
    quats: I32
    summand: I32


@dataclass(frozen=True, eq=False)
class ShapeTables:
    """Decisions of the shape stage for the whole file.

    Attributes:
        entries: [6, K] int32, log scales up to a summand on the file's lattice, x, y, z of the rotation.
        index: [N] int32, entry of each splat; K means "escaped". In a tile that is smaller without, all are.
        summand: [N] int32, in steps of the scales' lattice; 0 for the escaped.
    """

    entries: I32
    index: I32
    summand: I32

    @property
    def size(self) -> int:
        """Entries of the codebook."""
        return int(self.entries.shape[1])

    @property
    def escaped(self) -> NDArray[np.bool_]:
        """[N], which splats have a shape of their own."""
        return np.asarray(self.index == self.size, np.bool_)

    def part(self, rows: NDArray[np.intp]) -> ShapePart | None:
        """Return what is said of some splats; None if all are escaped."""
        index, summand = self.index[rows], self.summand[rows]
        served = np.asarray(index < self.size, np.bool_)
        if not served.any():
            return None
        entries = np.take(self.entries, index[served], axis=1)
        return ShapePart(index, self.size, served, entries[:3] + summand[served], entries[3:], summand)

    def select(self, order: NDArray[Any]) -> ShapeTables:
        """The same for the splats `order`."""
        return ShapeTables(self.entries, self.index[order], self.summand[order])


def shape_book(tables: ShapeTables, coding: Coding) -> tuple[CodebookTable, FileChunk]:
    """Return the index record and the chunk of the codebook."""
    head = _spec.pack_codebook_head(_spec.CodebookHead(SHAPE_BOOK, 0, 0))
    stream = signed_stream(np.ascontiguousarray(tables.entries).reshape(-1), coding)
    record = CodebookTable(SHAPE_BOOK, _spec.CODEBOOK_KIND_SHAPE, (0, 0), tables.size)
    return record, FileChunk(_spec.CHUNK_CODEBOOK, head + stream, SHAPE_BOOK)


def shape_blocks(
    scales: Integers, exponent: int, quats: Integers, part: ShapePart | None, coding: Coding
) -> list[bytes]:
    """Code scales [3, n] and quats [3, n] of a tile: directly, or by codebook if there is a part."""
    if part is None:
        return [
            blocks.offset_block(_spec.ATTRIBUTE_SCALES, scales, exponent, coding),
            blocks.signed_block(_spec.ATTRIBUTE_QUATS, quats, 0, coding),
        ]
    assert exponent == 0, "a codebook lies on the file's lattice"
    escaped = ~part.served
    count = int(np.count_nonzero(escaped))
    own_scales = own_quats = b""
    if count:
        own_scales = blocks.offset_block(_spec.ATTRIBUTE_SCALES, scales[:, escaped], 0, coding)
        own_quats = blocks.signed_block(_spec.ATTRIBUTE_QUATS, quats[:, escaped], 0, coding)
    return [
        blocks.codebook_block(
            _spec.ATTRIBUTE_SCALES, SHAPE_BOOK, part.index, count, own_scales, coding, summand=part.summand
        ),
        blocks.codebook_block(_spec.ATTRIBUTE_QUATS, SHAPE_BOOK, None, count, own_quats, coding),
    ]
