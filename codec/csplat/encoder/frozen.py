"""A scene whose coding is decided and whose values may still move: what fine-tuning tunes is what is written.

`Draft.frozen` lets the encoder decide everything that is decided once: lattices, tiles, codebooks, which splats use
which entry, which bypass the codebooks, which lack an SH band. `Frozen.seen` then returns, for any values, what a
decoder of the file will return, by the functions that code the tiles; `Frozen.coded` codes these values.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.codebook import Books, books_of
from csplat.encoder.coded import Coded
from csplat.encoder.colour import ShBook, ShTables, quantise_colour, quantise_rows
from csplat.encoder.geometry import seen_means, seen_opacities, seen_shapes
from csplat.encoder.measure import measured_sums
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import colour_integers, colour_lifted, lattice_values, quat_levels, quat_values
from csplat.encoder.shape_tables import ShapeTables
from csplat.encoder.tile import coarseness
from csplat.model import SplatModel
from csplat.types import F32, I32, I64, Progress

if TYPE_CHECKING:
    from csplat.encoder.draft import Draft


_MANY = 50_000  # splats; with fewer, threads take longer to start than they save


@dataclass(eq=False)
class FreeValues:
    """Values of a frozen scene before they are quantised, float32; fine-tuning changes them in place.

    Attributes:
        means: [N, 3].
        quats: [S, 4] and
        scales: [S, 3], log, the shapes that the file holds, in their gauge: one per splat; or, with a codebook, its
            entries and then one for each escaped splat.
        opacities: [N], alpha.
        sh0: [N, 3].
        sh: [R, K, 3], the rows of SH that the file holds: one per splat; or, with a codebook, its entries and then one
            for each escaped splat. K is that of the degree that is kept.
        sizes: [N], what a splat adds to the log scales of its entry, 0 if it is escaped; [0] without a codebook.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    sh: F32
    sizes: F32

    def copy(self) -> FreeValues:
        """The same values in arrays of their own."""
        return FreeValues(*(getattr(self, one.name).copy() for one in fields(self)))


@dataclass(frozen=True, eq=False)
class DecodedValues:
    """Values as a decoder will return them: the arrays of a `SplatModel`, unchecked, SH up to the degree kept."""

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32


@dataclass(frozen=True, eq=False)
class Frozen:
    """Decisions of the encoder, fixed while the values are tuned.

    Attributes:
        draft: the scene in tile order and canonical axis order, and everything else that does not change.
        tables: how SH is coded.
        source: the scene that declared errors are measured against.
        low, high: [N, 3] float32, the box of each splat's tile: centres stay within, for the lattice holds no more.
        zero: [N, K] bool, SH coefficients that are zero and stay so, if every splat has its own; else None.
    """

    draft: Draft
    tables: ShTables
    source: SplatModel
    low: F32
    high: F32
    zero: NDArray[np.bool_] | None

    @classmethod
    def of(cls, draft: Draft, tables: ShTables, source: SplatModel) -> Frozen:
        """Build what `Draft.frozen` returns from a draft that is already in that order."""
        means = draft.model.means
        low, high = np.empty_like(means), np.empty_like(means)
        for tile in draft.tiles:
            low[tile.rows], high[tile.rows] = means[tile.rows].min(axis=0), means[tile.rows].max(axis=0)
        return cls(draft, tables, source, low, high, _zeros(draft, tables))

    @property
    def plan(self) -> Plan:
        """Lattices and codings."""
        return self.draft.plan

    @property
    def source_index(self) -> I64:
        """Index in the source of each splat, [N]."""
        return self.draft.origin.source_index

    @property
    def book(self) -> ShBook | None:
        """The codebook of SH, if there is one."""
        return self.tables.book

    @property
    def shapes(self) -> ShapeTables | None:
        """The codebook of shapes, if there is one."""
        return self.draft.shapes

    def start(self) -> FreeValues:
        """Values as the encoder found them."""
        model, plan = self.draft.model, self.plan
        kept = (plan.sh_degree + 1) ** 2 - 1
        sh = np.ascontiguousarray(model.shN[:, :kept])
        if self.book is not None:
            sh = np.concatenate([_as_values(self.book.entries, plan), sh[self.book.escaped]])
        quats, scales, sizes = model.quats, model.scales, np.zeros(0, np.float32)
        if self.shapes is not None:
            shared, own = self.shapes.entries, self.shapes.escaped
            quats = np.concatenate([quat_values(shared[3:], plan.quat_levels).T, quats[own]])
            scales = np.concatenate([lattice_values(shared[:3], plan.scale_step).T, scales[own]])
            sizes = lattice_values(self.shapes.summand, plan.scale_step)
        held = FreeValues(model.means, quats, scales, model.opacities, model.sh0, sh, sizes).copy()
        self.constrain(held)
        return held

    def constrain(self, held: FreeValues) -> None:
        """Bring values that moved back to where the file can hold them: into their tiles, w >= 0, zeros to zero."""
        np.clip(held.means, self.low, self.high, out=held.means)
        turned = held.quats[:, 0] < 0.0
        if turned.any():
            held.quats[turned] *= np.float32(-1.0)
        if self.zero is not None:
            np.copyto(held.sh, np.float32(0.0), where=self.zero[:, :, None])
        if self.shapes is not None:
            held.sizes[self.shapes.escaped] = 0.0

    def coded(self, held: FreeValues, progress: Progress | None = None) -> Coded:
        """Code these values; `decode` gives `seen(held)` back, in the order of the file's source index.

        Args:
            held: values, constrained.
            progress: as in `Draft.of`.

        Returns:
            A file that states errors against the source, but none of colours: they were fitted anew.
        """
        shapes, quats, scales = self._shapes(held)
        model, kept = self.draft.model, held.sh.shape[1]
        shN, books = np.zeros_like(model.shN), Books(self.tables)
        if self.book is not None:
            shN[self.book.escaped, :kept] = held.sh[self.book.size :]
            books = books_of(self.tables, self._moved(self.book, held.sh), self.plan)
        else:
            shN[:, :kept] = held.sh
        model = replace(model, means_double=None)
        decoded = replace(model, **vars(self.seen(held)))
        model = replace(
            model, means=held.means, quats=quats, scales=scales, opacities=held.opacities, sh0=held.sh0, shN=shN
        )
        errors = measured_sums(self.source, decoded, self.source_index)
        return Coded.of(replace(self.draft, model=model, shapes=shapes), books, errors=errors, progress=progress)

    def seen(self, held: FreeValues) -> DecodedValues:
        """Return the values that a decoder of the file will return for `held`, bit for bit, in the order of `held`."""
        tiles, plan = self.draft.tiles, self.plan
        if self.draft.options.threads == 1 or len(self.draft.model) < _MANY:
            shN, (quats, scales) = self.seen_sh(held.sh), self._seen_shapes(held)
            means, sh0 = seen_means(held.means, tiles, plan), self.seen_sh0(held.sh0)
        else:
            with ThreadPoolExecutor(2) as pool:  # NumPy lets go of the interpreter; the three take about as long
                later_sh, later_shapes = pool.submit(self.seen_sh, held.sh), pool.submit(self._seen_shapes, held)
                means, sh0 = seen_means(held.means, tiles, plan), self.seen_sh0(held.sh0)
                shN, (quats, scales) = later_sh.result(), later_shapes.result()
        return DecodedValues(means, quats, scales, seen_opacities(held.opacities, tiles, plan), sh0, shN)

    def seen_sh0(self, sh0: F32) -> F32:
        """Degree-0 colours [N, 3] as a decoder will see them."""
        plan, seen = self.plan, np.empty_like(sh0)
        for tile in self.draft.tiles:
            columns = np.ascontiguousarray(sh0[tile.rows].T)
            seen[tile.rows] = quantise_colour(columns, plan.sh0_step, plan.chroma_shift, tile.coarse.sh0).decoded.T
        return seen

    def seen_sh(self, sh: F32) -> F32:
        """SH of all splats [N, K, 3] as a decoder will see it, from the rows that the file holds."""
        plan = self.plan
        if self.book is not None:
            seen = self._moved(self.book, sh).served(plan)
            seen[self.book.escaped] = self._seen_escapes(self.book, sh)
            return seen
        seen = np.empty_like(sh)
        for tile in self.draft.tiles:
            seen[tile.rows] = quantise_rows(sh[tile.rows], plan, coarseness(tile.rows, plan, self.tables))[2]
        return seen

    def seen_rows(self, sh: F32) -> F32:
        """The rows of SH that the file holds [R, K, 3] as a decoder will see them: entries by themselves."""
        if self.book is None:
            return self.seen_sh(sh)
        entries = _as_values(self._moved(self.book, sh).entries, self.plan)
        return np.concatenate([entries, self._seen_escapes(self.book, sh)])

    def seen_shape_rows(self, held: FreeValues, seen: DecodedValues) -> tuple[F32, F32, F32]:
        """Rotations, scales and sizes of `held` as their streams hold them; `seen` is what a decoder makes of them."""
        shapes = self._shapes(held)[0]
        if shapes is None:
            return seen.quats, seen.scales, held.sizes
        own = shapes.escaped
        quats = np.concatenate([quat_values(shapes.entries[3:], self.plan.quat_levels).T, seen.quats[own]])
        scales = np.concatenate([lattice_values(shapes.entries[:3], self.plan.scale_step).T, seen.scales[own]])
        return quats, scales, lattice_values(shapes.summand, self.plan.scale_step)

    def _seen_shapes(self, held: FreeValues) -> tuple[F32, F32]:
        shapes, quats, scales = self._shapes(held)
        return seen_shapes(quats, scales, self.draft.tiles, self.plan, shapes)

    def _seen_escapes(self, book: ShBook, sh: F32) -> F32:
        own = sh[book.size :]
        return quantise_rows(own, self.plan, np.full(len(own), self.plan.escape_coarse, np.int32))[2]

    def _shapes(self, held: FreeValues) -> tuple[ShapeTables | None, F32, F32]:
        """Return the codebook of shapes with these values, and the rotations and scales that it replaces, by splat."""
        if self.shapes is None:
            return None, held.quats, held.scales
        plan, size, own = self.plan, self.shapes.size, self.shapes.escaped
        scales = np.rint(held.scales[:size].T / plan.scale_step)
        entries = np.concatenate([scales.astype(np.int32), quat_levels(held.quats[:size].T, plan.quat_levels)])
        summand = np.rint(held.sizes / plan.scale_step).astype(np.int32)
        by_splat = np.zeros_like(self.draft.model.quats), np.zeros_like(self.draft.model.scales)
        by_splat[0][:, 0] = 1.0
        by_splat[0][own], by_splat[1][own] = held.quats[size:], held.scales[size:]
        return ShapeTables(entries, self.shapes.index, summand), *by_splat

    def _moved(self, book: ShBook, sh: F32) -> ShBook:
        return ShBook(_as_integers(sh[: book.size], self.plan), book.index)


def _zeros(draft: Draft, tables: ShTables) -> NDArray[np.bool_] | None:
    plan = draft.plan
    kept = (plan.sh_degree + 1) ** 2 - 1
    if tables.book is not None or not kept:
        return None
    zero = np.empty((len(draft.model), kept), np.bool_)
    for tile in draft.tiles:
        columns, _, _ = quantise_rows(draft.model.shN[tile.rows, :kept], plan, coarseness(tile.rows, plan, tables))
        for band in range(1, plan.sh_degree + 1):
            span = slice(band * band - 1, (band + 1) ** 2 - 1)
            largest = np.abs(columns[:, span]).max(axis=(0, 1))
            zero[tile.rows, span] = (largest == 0)[:, None]
    return zero


def _as_values(entries: I32, plan: Plan) -> F32:
    """[size, K, 3] float32 of Y, Co, Cg integers [3, K, size] on the SH lattice."""
    rgb = colour_lifted(entries, plan.chroma_shift).transpose(2, 1, 0)
    return np.ascontiguousarray(rgb * plan.sh_step, np.float32)


def _as_integers(values: F32, plan: Plan) -> I32:
    """Y, Co, Cg integers [3, K, size] on the SH lattice of values [size, K, 3]."""
    rgb = np.ascontiguousarray(values.transpose(2, 1, 0)) * np.float32(1.0 / plan.sh_step)
    return colour_integers(rgb, plan.chroma_shift).astype(np.int32, copy=False)
