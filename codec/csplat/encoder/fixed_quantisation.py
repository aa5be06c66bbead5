# SPDX-License-Identifier: Apache-2.0
"""Fix the quantisation of a scene while its values change, so that fine-tuning works on decoded values.

`fix_quantisation` makes all discrete choices: steps, tiles, codebooks, the assignment of splats, escapes, and zero SH
bands. `FixedQuantisation.dequantise` then returns the decoded values for any values, by the functions that encode
tiles; `FixedQuantisation.encode` encodes these values.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.coding_parameters import CodingParameters, band_slice
from csplat.encoder.encode_plan import EncodePlan, Origin
from csplat.encoder.error_bounds import measured_sums
from csplat.encoder.pipeline import EncodedTiles, encode_tiles
from csplat.encoder.quantisation import (
    canonicalise_shape,
    colour_integers,
    lattice_values,
    lift_colour,
    quantise_colour,
    quantise_sh,
    quat_levels,
    quat_values,
)
from csplat.encoder.sh_codebook import (
    FileCodebooks,
    ShCodebook,
    ShCodingPlan,
    assign_splats,
    make_codebooks,
    sh_coarseness,
)
from csplat.encoder.shape_codebook import ShapeCodebook, dequantise_shapes
from csplat.encoder.tiling import dequantise_means, dequantise_opacities, quantise_and_sort
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, I32, I64

_THREADED_MIN = 50_000  # splats; with fewer, starting threads takes longer than they save


@dataclass(eq=False)
class FreeValues:
    """Values before quantisation, float32, which fine-tuning changes in place.

    With a codebook, its rows are the entries, followed by the escaped splats; otherwise there is a row per splat.

    Attributes:
        means: [N, 3].
        quats: [S, 4], in canonical axis order; S rows of the shape codebook.
        scales: [S, 3], log standard deviations.
        opacities: [N], alpha.
        sh0: [N, 3].
        sh: [R, K, 3], bands 1 to the degree kept; R rows of the SH codebook.
        sizes: [N], summand of the log scales of a splat's entry, 0 for escaped splats; [0] without a shape codebook.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    sh: F32
    sizes: F32

    def copy(self) -> FreeValues:
        """Return a deep copy."""
        return FreeValues(*(getattr(self, field.name).copy() for field in fields(self)))


@dataclass(frozen=True, eq=False)
class DecodedValues:
    """Decoded values: the arrays of a `SplatModel`, unchecked, with SH up to the degree kept."""

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32


@dataclass(frozen=True, eq=False)
class FixedQuantisation:
    """Choices of the encoder that are fixed while values are tuned.

    Attributes:
        encode_plan: the plan, with splats in tile order and canonical axis order.
        sh_plan: the SH coding.
        source: the scene that declared errors refer to.
        low, high: [N, 3] float32, box of each splat's tile, which its mean must not leave.
        zero: [N, K] bool, SH coefficients that stay zero; `None` with an SH codebook.
    """

    encode_plan: EncodePlan
    sh_plan: ShCodingPlan
    source: SplatModel
    low: F32
    high: F32
    zero: NDArray[np.bool_] | None

    @property
    def parameters(self) -> CodingParameters:
        """Steps and codings."""
        return self.encode_plan.parameters

    @property
    def source_index(self) -> I64:
        """Index in the source of each splat, [N]."""
        return self.encode_plan.origin.source_index

    @property
    def book(self) -> ShCodebook | None:
        """The SH codebook; `None` without a codebook."""
        return self.sh_plan.book

    @property
    def shapes(self) -> ShapeCodebook | None:
        """The shape codebook; `None` without a codebook."""
        return self.encode_plan.shapes

    def start(self) -> FreeValues:
        """Return the values of the planned scene."""
        model, parameters = self.encode_plan.model, self.parameters
        sh = np.ascontiguousarray(model.shN[:, : parameters.sh_coefficients])
        if self.book is not None:
            sh = np.concatenate([_dequantise_entries(self.book.entries, parameters), sh[self.book.escaped]])
        quats, scales, sizes = model.quats, model.scales, np.zeros(0, np.float32)
        if self.shapes is not None:
            entries, escaped = self.shapes.entries, self.shapes.escaped
            quats = np.concatenate([quat_values(entries[3:], parameters.quat_levels).T, quats[escaped]])
            scales = np.concatenate([lattice_values(entries[:3], parameters.scale_step).T, scales[escaped]])
            sizes = lattice_values(self.shapes.summand, parameters.scale_step)
        values = FreeValues(model.means, quats, scales, model.opacities, model.sh0, sh, sizes).copy()
        self.constrain(values)
        return values

    def constrain(self, values: FreeValues) -> None:
        """Restrict values, in place, to what the file can represent: means in their tiles, w >= 0, zeros at zero."""
        np.clip(values.means, self.low, self.high, out=values.means)
        negative = values.quats[:, 0] < 0.0
        if negative.any():
            values.quats[negative] *= np.float32(-1.0)
        if self.zero is not None:
            np.copyto(values.sh, np.float32(0.0), where=self.zero[:, :, None])
        if self.shapes is not None:
            values.sizes[self.shapes.escaped] = 0.0

    def encode(self, values: FreeValues) -> EncodedTiles:
        """Encode values; a decoder returns `dequantise(values)`.

        Args:
            values: constrained values.

        Returns:
            Tiles that declare the errors against the source, except the errors of colours, which are refitted.
        """
        shapes, quats, scales = self._shape_values(values)
        model, kept = self.encode_plan.model, values.sh.shape[1]
        shN, codebooks = np.zeros_like(model.shN), FileCodebooks(self.sh_plan)
        if self.book is not None:
            shN[self.book.escaped, :kept] = values.sh[self.book.size :]
            codebooks = make_codebooks(self.sh_plan, self._requantise(self.book, values.sh), self.parameters)
        else:
            shN[:, :kept] = values.sh
        model = replace(model, means_double=None)
        decoded = replace(model, **vars(self.dequantise(values)))
        model = replace(
            model, means=values.means, quats=quats, scales=scales, opacities=values.opacities, sh0=values.sh0, shN=shN
        )
        errors = measured_sums(self.source, decoded, self.source_index)
        return encode_tiles(replace(self.encode_plan, model=model, shapes=shapes), codebooks, errors=errors)

    def dequantise(self, values: FreeValues) -> DecodedValues:
        """Return the values that a decoder of the file returns, bit for bit."""
        tiles, parameters = self.encode_plan.tiles, self.parameters
        if self.encode_plan.context.threads == 1 or len(self.encode_plan.model) < _THREADED_MIN:
            shN, (quats, scales) = self.dequantise_sh(values.sh), self._dequantise_shapes(values)
            means, sh0 = dequantise_means(values.means, tiles, parameters.lattice), self.dequantise_sh0(values.sh0)
        else:
            with ThreadPoolExecutor(2) as pool:  # NumPy releases the GIL; the three parts take about the same time
                later_sh = pool.submit(self.dequantise_sh, values.sh)
                later_shapes = pool.submit(self._dequantise_shapes, values)
                means, sh0 = dequantise_means(values.means, tiles, parameters.lattice), self.dequantise_sh0(values.sh0)
                shN, (quats, scales) = later_sh.result(), later_shapes.result()
        opacities = dequantise_opacities(values.opacities, tiles, parameters)
        return DecodedValues(means, quats, scales, opacities, sh0, shN)

    def dequantise_sh0(self, sh0: F32) -> F32:
        """Return decoded colours of degree 0, [N, 3]."""
        parameters, decoded = self.parameters, np.empty_like(sh0)
        for tile in self.encode_plan.tiles:
            columns = np.ascontiguousarray(sh0[tile.rows].T)
            colour = quantise_colour(columns, parameters.sh0_step, parameters.chroma_shift, tile.factors.sh0)
            decoded[tile.rows] = colour[2].T
        return decoded

    def dequantise_sh(self, sh: F32) -> F32:
        """Return decoded SH of all splats, [N, K, 3], of `FreeValues.sh`."""
        parameters = self.parameters
        if self.book is not None:
            decoded = self._requantise(self.book, sh).dequantise(parameters)
            decoded[self.book.escaped] = self._dequantise_escapes(self.book, sh)
            return decoded
        decoded = np.empty_like(sh)
        for tile in self.encode_plan.tiles:
            coarse = sh_coarseness(tile.rows, parameters, self.sh_plan)
            decoded[tile.rows] = quantise_sh(sh[tile.rows], parameters, coarse)[2]
        return decoded

    def dequantise_sh_rows(self, sh: F32) -> F32:
        """Return decoded SH of the rows of `FreeValues.sh`, [R, K, 3]."""
        if self.book is None:
            return self.dequantise_sh(sh)
        entries = _dequantise_entries(self._requantise(self.book, sh).entries, self.parameters)
        return np.concatenate([entries, self._dequantise_escapes(self.book, sh)])

    def dequantise_shape_rows(self, values: FreeValues, decoded: DecodedValues) -> tuple[F32, F32, F32]:
        """Return decoded rows of the quats, scales and sizes of `values`; `decoded` is `dequantise(values)`."""
        shapes = self._shape_values(values)[0]
        if shapes is None:
            return decoded.quats, decoded.scales, values.sizes
        escaped, parameters = shapes.escaped, self.parameters
        quats = np.concatenate([quat_values(shapes.entries[3:], parameters.quat_levels).T, decoded.quats[escaped]])
        scales = np.concatenate([lattice_values(shapes.entries[:3], parameters.scale_step).T, decoded.scales[escaped]])
        return quats, scales, lattice_values(shapes.summand, parameters.scale_step)

    def sh_coarseness(self) -> I32 | None:
        """Return the exponents of `colour_integers` of the rows of `FreeValues.sh` after the entries; `None`: all 0."""
        if self.book is not None:
            return np.full(len(self.book.escaped), self.parameters.escape_coarse, np.int32)
        return sh_coarseness(np.arange(len(self.encode_plan.model)), self.parameters, self.sh_plan)

    def _dequantise_shapes(self, values: FreeValues) -> tuple[F32, F32]:
        """Return quats [N, 4] and log scales [N, 3] as decoded."""
        shapes, quats, scales = self._shape_values(values)
        return dequantise_shapes(quats, scales, self.encode_plan.tiles, self.parameters, shapes)

    def _dequantise_escapes(self, book: ShCodebook, sh: F32) -> F32:
        """Return SH of the escaped splats as decoded, [n, K, 3]; they follow the entries in `sh`."""
        escaped = sh[book.size :]
        return quantise_sh(escaped, self.parameters, np.full(len(escaped), self.parameters.escape_coarse, np.int32))[2]

    def _shape_values(self, values: FreeValues) -> tuple[ShapeCodebook | None, F32, F32]:
        """Return the shape codebook of the values, and quats [N, 4] and log scales [N, 3].

        With a codebook, only the rows of escaped splats count: others have the identity and 0. Without one, it is
        `None`, and the rows are those of the values.
        """
        if self.shapes is None:
            return None, values.quats, values.scales
        parameters, size, escaped = self.parameters, self.shapes.size, self.shapes.escaped
        scales = np.rint(values.scales[:size].T / parameters.scale_step)
        entries = np.concatenate([scales.astype(np.int32), quat_levels(values.quats[:size].T, parameters.quat_levels)])
        summand = np.rint(values.sizes / parameters.scale_step).astype(np.int32)
        quats = np.zeros_like(self.encode_plan.model.quats)
        quats[:, 0] = 1.0
        quats[escaped] = values.quats[size:]
        own_scales = np.zeros_like(self.encode_plan.model.scales)
        own_scales[escaped] = values.scales[size:]
        return ShapeCodebook(entries, self.shapes.index, summand), quats, own_scales

    def _requantise(self, book: ShCodebook, sh: F32) -> ShCodebook:
        """Return the codebook with the first rows of `sh` as its entries, and the same assignment."""
        return ShCodebook(_quantise_entries(sh[: book.size], self.parameters), book.index)


def fix_quantisation(plan: EncodePlan, source: SplatModel | None = None) -> FixedQuantisation:
    """Complete a plan, and fix its quantisation.

    Args:
        plan: the plan.
        source: the scene that the plan's `Origin` refers to; `None`: the plan's scene.

    Raises:
        InputError: there are no splats, or the source does not have the origin's number of splats.
    """
    if not len(plan.model):
        raise InputError("a scene without splats has nothing to tune")
    source, source_count = plan.model if source is None else source, plan.origin.source_count
    if len(source) != source_count:
        raise InputError(f"the source has {len(source)} splats, expected {source_count} by the origin")
    plan, codebooks = plan.choose_sh_coding()
    sh_plan = codebooks.sh_plan
    if sh_plan.of_sample:
        sh_plan = assign_splats(sh_plan, plan.model, plan.parameters, plan.context)
    parameters = replace(plan.parameters, canonical=True, square_opacities=True)
    rows = [quantise_and_sort(plan.model, tile, parameters).rows for tile in plan.tiles]
    order = np.concatenate(rows).astype(np.int64)
    plan = replace(_reorder(plan, order, [len(part) for part in rows]), parameters=parameters)
    sh_plan, means = sh_plan.select(order), plan.model.means
    low, high = np.empty_like(means), np.empty_like(means)
    for tile in plan.tiles:
        low[tile.rows], high[tile.rows] = means[tile.rows].min(axis=0), means[tile.rows].max(axis=0)
    return FixedQuantisation(plan, sh_plan, source, low, high, _zero_coefficients(plan, sh_plan))


def _reorder(plan: EncodePlan, order: I64, counts: Sequence[int]) -> EncodePlan:
    """Put splats into tile order and canonical axis order, and drop the data that only an open SH coding needs.

    Args:
        plan: the complete plan.
        order: [N], rows of its splats, tile after tile.
        counts: number of splats of each tile.

    Returns:
        A plan whose tiles are consecutive rows, and whose origin is marked as refitted.
    """
    model = plan.model.select(order)
    rotation, scales = canonicalise_shape(model.quats, model.scales)
    ends = np.cumsum(counts)
    return replace(
        plan,
        model=replace(model, quats=np.ascontiguousarray(rotation.T), scales=np.ascontiguousarray(scales.T)),
        origin=Origin(plan.origin.source_count, plan.origin.source_index[order], refitted=True),
        importance=None,
        tiles=[
            replace(tile, rows=np.arange(end - count, end))
            for tile, count, end in zip(plan.tiles, counts, ends, strict=True)
        ],
        shapes=None if plan.shapes is None else plan.shapes.select(order),
        buckets=(),
    )


def _zero_coefficients(plan: EncodePlan, sh_plan: ShCodingPlan) -> NDArray[np.bool_] | None:
    """Return a mask [N, K] of the coefficients in bands that quantise to 0 as a whole.

    Returns:
        The mask; `None` if SH has a codebook or only band 0.
    """
    parameters = plan.parameters
    kept = parameters.sh_coefficients
    if sh_plan.book is not None or not kept:
        return None
    zero = np.empty((len(plan.model), kept), np.bool_)
    for tile in plan.tiles:
        coarse = sh_coarseness(tile.rows, parameters, sh_plan)
        columns, _, _ = quantise_sh(plan.model.shN[tile.rows, :kept], parameters, coarse)
        for band in range(1, parameters.sh_degree + 1):
            span = band_slice(band)
            zero[tile.rows, span] = (columns[:, span] == 0).all(axis=(0, 1))[:, None]
    return zero


def _dequantise_entries(entries: I32, parameters: CodingParameters) -> F32:
    """Dequantise the entries [3, K, size] of an SH codebook to float32 [size, K, 3]."""
    rgb = lift_colour(entries, parameters.chroma_shift).transpose(2, 1, 0)
    return np.ascontiguousarray(rgb * parameters.sh_step, np.float32)


def _quantise_entries(values: F32, parameters: CodingParameters) -> I32:
    """Quantise values [size, K, 3] to the entries [3, K, size] of an SH codebook."""
    rgb = np.ascontiguousarray(values.transpose(2, 1, 0)) * np.float32(1.0 / parameters.sh_step)
    return colour_integers(rgb, parameters.chroma_shift).astype(np.int32, copy=False)
