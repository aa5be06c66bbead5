"""Sizes on disk, in bytes, that a compression would reach if the pipeline ended after each of its steps.

Before anything is quantised values are floats. A codebook takes its entries, an index per splat, and the values of
those that escape from it. Integers take whole bytes, each column as many as its range needs; only a file has an order
and an entropy coder.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import FixedQuantisation, FreeValues
from csplat_tools.scene_files import ply_splat_bytes
from csplat_trainer.tuning.tuned_scene import colour_integers_of

_FLOAT = 4
_SHAPE = 7  # floats of rotation and scales
_REST = 7  # floats of centre, opacity and base colour; normals, which are all 0, go when the PLY goes
_ROOT2 = np.sqrt(2.0)


@dataclass(frozen=True)
class Book:
    """A codebook: how many entries, and how many splats have values of their own."""

    entries: int
    escaped: int


def books_of(fixed: FixedQuantisation) -> tuple[Book | None, Book | None]:
    """The codebooks of a fixed quantisation, of SH and of shapes; `None` if the encoder made none."""
    colours, shapes = fixed.book, fixed.shapes
    return (
        None if colours is None else Book(colours.size, len(colours.escaped)),
        None if shapes is None else Book(shapes.size, int(np.count_nonzero(shapes.escaped))),
    )


def ply_bytes(splats: int) -> int:
    """A PLY with the 62 float columns of the INRIA trainer."""
    return splats * ply_splat_bytes(3)


def float_bytes(splats: int, coefficients: int, colours: Book | None, shapes: Book | None) -> int:
    """Floats, and codebooks of floats.

    Args:
        splats: number of splats.
        coefficients: floats of the SH bands above 0, per splat.
        colours: their codebook, if there is one.
        shapes: codebook of rotations and scales, whose common factor stays each splat's own.
    """
    size = splats * _REST * _FLOAT
    size += _in_book(splats, coefficients, colours, 0) + _in_book(splats, _SHAPE, shapes, 1)
    return size


def _in_book(splats: int, floats: int, book: Book | None, own: int) -> int:
    if book is None:
        return splats * floats * _FLOAT
    rows = book.entries + book.escaped
    return splats * (_index_bytes(book.entries) + own * _FLOAT) + rows * floats * _FLOAT


def _index_bytes(entries: int) -> int:
    """Return the bytes of an index whose largest value means "escaped"."""
    return _whole_bytes(0, entries)


def integer_bytes(columns: Iterable[NDArray[Any]]) -> int:
    """Integers [n, C] in whole bytes: a column takes what its range needs, nothing if it is constant."""
    total = 0
    for array in columns:
        if array.size:
            widths = map(_whole_bytes, array.min(axis=0).tolist(), array.max(axis=0).tolist())
            total += len(array) * sum(widths)
    return total


def _whole_bytes(low: int, high: int) -> int:
    return (int(high - low).bit_length() + 7) // 8


def integer_columns(fixed: FixedQuantisation, values: FreeValues) -> Sequence[NDArray[np.int64]]:
    """Every integer that the file of some values holds, as arrays [n, C], in no order of meaning.

    Args:
        fixed: the encoder's decisions.
        values: values, constrained.
    """
    plan, seen = fixed.parameters, fixed.dequantise(values)
    quats, scales, sizes = fixed.dequantise_shape_rows(values, seen)
    sh = fixed.dequantise_sh_rows(values.sh)
    columns = [
        _lattice(seen.means[tile.rows], plan.lattice.step * 2.0**tile.exponent) for tile in fixed.encode_plan.tiles
    ]
    columns += [
        _lattice(scales, plan.scale_step),
        _lattice(sizes[:, None], plan.scale_step),
        _lattice(quats[:, 1:], 1.0 / (_ROOT2 * plan.quat_levels)),
        np.rint(np.sqrt(seen.opacities[:, None].astype(np.float64)) * plan.opacity_levels).astype(np.int64),
        colour_integers_of(seen.sh0[:, None], plan.sh0_step, plan.chroma_shift).reshape(-1, 3).astype(np.int64),
        colour_integers_of(sh, plan.sh_step, plan.chroma_shift).reshape(len(sh), -1).astype(np.int64),
    ]
    books = (fixed.book, fixed.shapes)
    return columns + [book.index[:, None].astype(np.int64) for book in books if book is not None]


def _lattice(values: NDArray[np.float32], step: float) -> NDArray[np.int64]:
    return np.rint(values.astype(np.float64) / step).astype(np.int64)
