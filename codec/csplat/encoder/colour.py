"""SH colour of a tile: on the lattice, or by codebook with escapes (spec 6.4.4, 6.4.5, 7.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder import blocks
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import (
    check_finite,
    colour_integers,
    colour_lifted,
    lattice_exponent,
    lattice_step,
    lattice_values,
)
from csplat.errors import InputError
from csplat.types import F32, I32

Integers = NDArray[Any]

_SLACK = 1.0 + 2.0**-18  # differences of float32 values are taken in float32; bounds must hold all the same
_ROWS = 2048  # splats at a time: rows of 45 floats and their columns stay in the second-level cache


@dataclass(frozen=True)
class Colour:
    """Colours on a lattice: Y, Co, Cg columns, the tile's exponent, and what the decoder will see."""

    columns: Integers
    exponent: int
    decoded: F32


@dataclass(frozen=True, eq=False)
class ShBook:
    """SH by codebook.

    Attributes:
        entries: [3, K, size] Y, Co, Cg integers on the file's lattice.
        index: [N] int32, entry of each splat; `size` means "escaped".
    """

    entries: I32
    index: I32

    @property
    def size(self) -> int:
        """Entries of the codebook."""
        return int(self.entries.shape[2])

    @property
    def escaped(self) -> NDArray[np.intp]:
        """Splats that bypass the codebook, ascending."""
        return np.flatnonzero(self.index == self.size)

    def select(self, order: NDArray[Any]) -> ShBook:
        """The same for the splats `order`."""
        return ShBook(self.entries, self.index[order])

    def served(self, plan: Plan) -> F32:
        """[N, K, 3] float32, what the entries decode to; nonsense for escaped splats."""
        rgb = np.ascontiguousarray(colour_lifted(self.entries, plan.chroma_shift).transpose(2, 1, 0))
        return np.take(lattice_values(rgb, plan.sh_step), self.index, axis=0, mode="clip")


@dataclass(frozen=True)
class ShTables:
    """Decisions of the SH stage for the whole file.

    Attributes:
        weights: [N] importance, or None if all splats are treated alike.
        reference: weight above which a splat is quantised on the full lattice.
        book: the codebook, if there is one.
        ids: codebook ids. layers: layers that use them.
        extras: names of the extra columns that are carried.
    """

    weights: F32 | None = None
    reference: float = 1.0
    book: ShBook | None = None
    ids: Sequence[int] = ()
    layers: Sequence[int] = ()
    extras: Sequence[str] = ()

    def select(self, order: NDArray[Any]) -> ShTables:
        """The same for the splats `order`."""
        weights = None if self.weights is None else self.weights[order]
        return replace(self, weights=weights, book=None if self.book is None else self.book.select(order))


@dataclass(frozen=True)
class CodedSh:
    """Blocks by layer (a band that is zero throughout has none), errors by measure, the tile's exponent, codebooks."""

    blocks: Mapping[int, bytes]
    errors: Mapping[str, tuple[float, float]]
    exponent: int
    tables: tuple[int, ...] = ()


def quantise_colour(rgb: F32, step: float, shift: int, coarse: int = 0) -> Colour:
    """Quantise colours [3, ..., n] on the lattice of `step` times 2**coarse, or a coarser one that holds them."""
    exponent = max(coarse, lattice_exponent(2.0 * float(np.abs(rgb).max(initial=0.0)), step))
    tile_step = lattice_step(step, exponent)
    real = np.float32 if exponent == 0 else np.float64
    columns = colour_integers(rgb * real(1.0 / tile_step), shift)
    return Colour(columns, exponent, lattice_values(colour_lifted(columns, shift), tile_step))


def code_sh(shN: F32, rows: NDArray[np.intp], plan: Plan, tables: ShTables, coarse: I32 | None) -> CodedSh:
    """Code the bands 1 to `plan.sh_degree` of a tile.

    Args:
        shN: [N, K, 3], of the whole model, whose degree may be above the plan's.
        rows: [n], the tile's splats in decoded order.
        plan: lattices and codings.
        tables: the codebook, if there is one.
        coarse: [n], as in `colour_integers`, or None.
    """
    source = np.take(shN, rows, axis=0)
    kept = (plan.sh_degree + 1) ** 2 - 1
    sums = _BandSums(source.shape[1])
    sums.add(source[:, kept:], np.float32(0), kept)
    layers: dict[int, bytes] = {}
    exponent = 0
    if tables.book is not None:
        layers = _code_by_codebook(source[:, :kept], tables.book.select(rows), plan, tables.ids[0], sums)
    elif kept:
        columns, exponent, decoded = quantise_rows(source[:, :kept], plan, coarse)
        sums.add(source[:, :kept], decoded, 0)
        for band in range(1, plan.sh_degree + 1):
            part = columns[:, _span(band)]
            if part.any():
                flat = part.reshape(-1, len(rows))
                layers[band] = blocks.signed_or_sparse_block(_spec.ATTRIBUTE_SH0 + band, flat, exponent, plan.coding)
    return CodedSh(layers, sums.by_band(), exponent, tuple(tables.ids))


def quantise_rows(source: F32, plan: Plan, coarse: I32 | None) -> tuple[Integers, int, F32]:
    """Quantise SH on the plan's lattice, splat by splat.

    Args:
        source: [n, K, 3] float32.
        plan: step and chroma shift.
        coarse: [n], as in `colour_integers`, or None.

    Returns:
        Columns [3, K, n], as narrow as they may be; the tile's exponent; [n, K, 3] float32 as decoded.
    """
    n, coefficients, _ = source.shape
    largest = max(abs(float(source.max(initial=0.0))), abs(float(source.min(initial=0.0))))
    exponent = lattice_exponent(2.0 * largest, plan.sh_step)
    step = lattice_step(plan.sh_step, exponent)
    coarsest = 0 if coarse is None else int(coarse.max(initial=0))
    columns = np.empty((3, coefficients, n), _narrowest(2.0 * largest / step + 1.0 + 2.0**coarsest))
    decoded = np.empty(source.shape, np.float32)
    real = np.float32 if exponent == 0 else np.float64
    for at in range(0, n, _ROWS):
        part = slice(at, at + _ROWS)
        rgb = np.ascontiguousarray(source[part].transpose(2, 1, 0))
        some = None if coarse is None else coarse[part]
        quantised = colour_integers(rgb * real(1.0 / step), plan.chroma_shift, some)
        columns[:, :, part] = quantised
        decoded[part] = lattice_values(colour_lifted(quantised, plan.chroma_shift), step).transpose(2, 1, 0)
    check_finite("shN", decoded)
    return columns, exponent, decoded


def _code_by_codebook(source: F32, book: ShBook, plan: Plan, id_: int, sums: _BandSums) -> dict[int, bytes]:
    """Write the indices in band 1, and the escaped splats' own values in every band."""
    decoded, escaped = book.served(plan), book.escaped
    coarse = np.full(len(escaped), plan.escape_coarse, np.int32)
    columns, exponent, own = quantise_rows(source[escaped], plan, coarse)
    if exponent:
        raise InputError("SH coefficients too large to be escapes of a codebook: use scalar SH coding")
    decoded[escaped] = own
    sums.add(source, decoded, 0)
    layers = {}
    for band in range(1, plan.sh_degree + 1):
        attribute = _spec.ATTRIBUTE_SH0 + band
        escape = b""
        if len(escaped):
            flat = columns[:, _span(band)].reshape(-1, len(escaped))
            escape = blocks.signed_block(attribute, flat, 0, plan.coding)
        index = book.index if band == 1 else None
        layers[band] = blocks.codebook_block(attribute, id_, index, len(escaped), escape, plan.coding)
    return layers


class _BandSums:
    """Largest error and sum of squares by band, of a tile. Owns two small arrays."""

    def __init__(self, coefficients: int) -> None:
        self._largest = np.zeros(coefficients)
        self._squares = np.zeros(coefficients)

    def add(self, source: F32, decoded: F32 | np.float32, first: int) -> None:
        """Add [n, k, 3] values of the coefficients `first` to `first` + k - 1."""
        difference = source - decoded
        if not difference.size:
            return
        flat = difference.reshape(len(difference), -1)  # reductions over whole rows are ten times faster
        span = slice(first, first + difference.shape[1])
        squares = np.einsum("ij,ij->j", flat, flat, dtype=np.float64)
        self._squares[span] += squares.reshape(-1, 3).sum(axis=1)
        np.abs(flat, out=flat)
        np.maximum(self._largest[span], flat.max(axis=0).reshape(-1, 3).max(axis=1), out=self._largest[span])

    def by_band(self) -> dict[str, tuple[float, float]]:
        """Return (largest, sum of squares) by measure; float32 differences are made up for."""
        result = {}
        for band in range(1, round((len(self._largest) + 1) ** 0.5)):
            largest = float(self._largest[_span(band)].max()) * _SLACK
            squares = float(self._squares[_span(band)].sum()) * _SLACK
            result[_spec.MEASURE_NAMES[_spec.MEASURE_SH0 + band]] = (largest, squares)
        return result


def _span(band: int) -> slice:
    return slice(band * band - 1, (band + 1) ** 2 - 1)


def _narrowest(largest: float) -> type[np.signedinteger[Any]]:
    return np.int8 if largest < 127 else np.int16 if largest < 32767 else np.int32
