# SPDX-License-Identifier: Apache-2.0
"""The state of fine-tuning: float values, their quantised form in the file, and the rate term of the loss.

Straight-through estimator: images are rendered from the decoded values, and their gradients are applied to the values
before quantisation (Bengio et al. 2013, https://arxiv.org/abs/1308.3432). The gradient of a codebook entry is the sum
of the gradients of all splats that use it.

Rate: the size of a stream is close to its order-0 entropy, so an integer n of a column costs about −log2 of its
relative frequency in the column. The slope of this cost, from n − 1 to n + 1, moves values towards frequent integers,
mostly zero, unless the images oppose it. Frequencies are counted again every few steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import DecodedValues, FixedQuantisation, FreeValues
from csplat.types import F32, I32, I64
from csplat_render.conventions import Gradients
from csplat_render.kernels import call, thread_count
from csplat_trainer.parameters import ParameterArrays, Parameters, adam_step, logits_of


class TunedScene:
    """Values of a fixed quantisation with Adam's moments, updated by gradients of renders.

    Args:
        fixed: the encoder's decisions.
        parameters: state to continue from; `None`: the values that the encoder found.

    Attributes:
        fixed: as given.
        parameters: named as in training, but `quats`, `scales`, `shN` hold the rows of `FreeValues`; and `sizes`.
    """

    def __init__(self, fixed: FixedQuantisation, parameters: Parameters | None = None) -> None:
        self.fixed = fixed
        self.parameters = parameters or initial_parameters(fixed)
        book, shapes, shN = fixed.book, fixed.shapes, self.parameters.values["shN"]
        self._tiles = _tile_table(fixed)
        self._sh_rows = None if book is None else CodebookRows.of(book.index, book.size)
        self._shape_rows = None if shapes is None else CodebookRows.of(shapes.index, shapes.size)
        own, self._coarse = fixed.sh_coarseness(), np.zeros(shN.shape[:2], np.int32)
        if own is not None:
            self._coarse[len(shN) - len(own) :] = own[:, None]
        self._kept_bits = None if fixed.zero is None else np.repeat(~fixed.zero[..., None], 3, axis=2) * ~np.uint32(0)

    @property
    def free_values(self) -> FreeValues:
        """The values for the encoder; all arrays except the opacities are the parameters' own."""
        return self._free_values(self.parameters.alphas)

    def _free_values(self, alphas: F32) -> FreeValues:
        """Return the parameters' own arrays, with these opacities [N] in place of the logits."""
        v = self.parameters.values
        return FreeValues(v["means"], v["quats"], v["scales"], alphas, v["sh0"], v["shN"], v["sizes"])

    def dequantise(self) -> tuple[DequantisedScene, F32]:
        """Return the decoded values, and the opacities before quantisation.

        Values are those of `FixedQuantisation.dequantise`, bit for bit.
        """
        values = self.free_values
        with thread_count(self.fixed.encode_plan.context.threads):
            seen = self._dequantise(values)
        return seen or self._dequantise_unusual(values), values.opacities

    def _dequantise(self, values: FreeValues) -> DequantisedScene | None:
        """Return decoded values; `None` if some are too large for the kernels, or not finite."""
        plan, tiles = self.fixed.parameters, self._tiles
        stored = StreamValues(*(np.empty_like(getattr(values, field.name)) for field in fields(StreamValues)))
        means = np.empty_like(values.means)
        unusual = call(
            "dequantise_splats", len(means), len(tiles), tiles, plan.opacity_levels, plan.chroma_shift,
            values.means, values.opacities, values.sh0, means, stored.opacities, stored.sh0,
        )  # fmt: skip
        shared, shape_tiles = (0, tiles) if self.fixed.shapes is None else (self.fixed.shapes.size, tiles[:1])
        unusual += call(
            "dequantise_shapes", len(values.quats), shared, len(shape_tiles), shape_tiles, plan.quat_levels,
            values.quats, values.scales, stored.quats, stored.scales,
        )  # fmt: skip
        steps = plan.sh_step, plan.chroma_shift, self._coarse
        if unusual + call("dequantise_sh", self._coarse.size, *steps, values.sh, stored.sh):
            return None
        quats, scales, shN = stored.quats, stored.scales, stored.sh
        if self._shape_rows is not None:
            quats, scales = self._shape_rows.take(quats), self._shape_rows.take(scales)
            step = np.float64(plan.scale_step)
            sizes = np.rint(values.sizes / np.float32(step)) + np.float32(0.0)
            stored.sizes[:] = sizes * step
            scales[:] = (np.rint(scales / step) + sizes[:, None]) * step
        if self._sh_rows is not None:
            shN = self._sh_rows.take(shN)
        return DequantisedScene(means, quats, scales, stored.opacities, stored.sh0, shN, stored)

    def _dequantise_unusual(self, values: FreeValues) -> DequantisedScene:
        """Return any decoded values, by the encoder."""
        fixed, seen = self.fixed, self.fixed.dequantise(values)
        sh = fixed.dequantise_sh_rows(values.sh) if fixed.book is not None else seen.shN
        stored = StreamValues(*fixed.dequantise_shape_rows(values, seen), seen.opacities, seen.sh0, sh)
        return DequantisedScene(**vars(seen), stored=stored)

    def count(self, seen: DequantisedScene, weight: float) -> RateTerm:
        """Count the bits of the file's integers; `weight` is lambda, loss per bit and splat."""
        return RateTerm.count(self.fixed, seen.stored, weight)

    def step(
        self, gradients: Gradients, seen: DequantisedScene, alphas: F32, rates: dict[str, float], costs: RateTerm | None
    ) -> None:
        """Make a step against the gradients of the loss and the rate term.

        Args:
            gradients: gradients of the loss.
            seen, alphas: the result of `dequantise`.
            rates: learning rate of each group.
            costs: the rate term, if any.
        """
        with thread_count(self.fixed.encode_plan.context.threads):
            quats, scales, sizes, shN = gradients.quats, gradients.scales, np.zeros(0, np.float32), gradients.shN
            if self._shape_rows is not None:
                sizes = scales[:, 0] + scales[:, 1] + scales[:, 2]  # offsets of all three log-scales
                quats, scales = self._shape_rows.sum(quats), self._shape_rows.sum(scales)
            if self._sh_rows is not None:
                shN = self._sh_rows.sum(shN)
            logits = gradients.opacities * (alphas * (np.float32(1.0) - alphas))
            steps = {"means": gradients.means, "quats": quats, "scales": scales, "logits": logits}
            steps |= {"sh0": gradients.sh0, "shN": shN, "sizes": sizes}
            if costs is not None:
                costs.add_to(steps, seen.stored)
            adam_step(self.parameters, steps, rates)
            self._constrain()

    def _constrain(self) -> None:
        """Restrict the values as `FixedQuantisation.constrain`."""
        means, quats, sh = (self.parameters.values[name] for name in ("means", "quats", "shN"))
        np.clip(means, self.fixed.low, self.fixed.high, out=means)
        quats[np.flatnonzero(quats[:, 0] < 0.0)] *= np.float32(-1.0)
        if self._kept_bits is not None:
            np.bitwise_and(sh.view(np.uint32), self._kept_bits, out=sh.view(np.uint32))  # faster than where=
        if self._shape_rows is not None:
            self.parameters.values["sizes"][self._shape_rows.escaped] = 0.0


def _tile_table(fixed: FixedQuantisation) -> NDArray[np.float64]:
    """Return the steps of each tile, [T, 7] float64, as `Tile` of native/quantisers.cpp.

    Columns: first row of the tile, steps of means and scales, multiples of quats and opacities, step of colours, 1 if
    the encoder quantises these in float64.
    """
    plan = fixed.parameters
    return np.array([
        (
            tile.rows[0],
            math.ldexp(plan.lattice.step, tile.exponent),
            math.ldexp(plan.scale_step, tile.factors.scales),
            tile.factors.quats,
            tile.factors.opacities,
            math.ldexp(plan.sh0_step, tile.factors.sh0),
            tile.factors.sh0 > 0,
        )
        for tile in fixed.encode_plan.tiles
    ], np.float64)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CodebookRows:
    """The rows of a codebook's values, which are its entries, then the escaped splats.

    Attributes:
        row: [N], row of each splat.
        starts: [R + 1], number of splats of the rows before each row.
        escaped: escaped splats.
    """

    row: I64
    starts: I64
    escaped: I64

    @classmethod
    def of(cls, index: NDArray[np.int32], size: int) -> CodebookRows:
        """Return the rows of splats with these entries, [N]; `size`, the number of entries, for escaped splats."""
        row, escaped = index.astype(np.int64), np.flatnonzero(index == size)
        row[escaped] += np.arange(len(escaped))
        starts = np.append(0, np.cumsum(np.bincount(row, minlength=size + len(escaped))))
        return cls(row, starts.astype(np.int64), escaped)

    def take(self, rows: F32) -> F32:
        """Return the values [N, ...] of all splats, given those of the rows [R, ...]."""
        return np.take(rows, self.row, axis=0)

    def sum(self, values: F32) -> F32:
        """Return the sums of values [N, ...] over the splats of each row, [R, ...], in their order."""
        out = np.empty((len(self.starts) - 1, *values.shape[1:]), np.float32)
        call("sum_by_row", len(values), values[0].size, self.row, values, len(out), self.starts, out)
        return out


def initial_parameters(fixed: FixedQuantisation) -> Parameters:
    """Return the state of `TunedScene` before the first step."""
    start = fixed.start()
    return Parameters.starting_at(
        {
            "means": start.means,
            "quats": start.quats,
            "scales": start.scales,
            "logits": logits_of(start.opacities),
            "sh0": start.sh0,
            "shN": start.sh,
            "sizes": start.sizes,
        }
    )


MAX_INTEGER = 128  # integers beyond ± this cost the same as ± this; as in native/quantisers.cpp
_ROWS = 1 << 15  # rows of SH to count at a time; their integers take several times the memory of the values
_MAX_SLOPE = 4.0  # bits per step; frequencies of rare integers are too uncertain for larger slopes
_FRACTION_MIN = 1e-12  # fraction; avoids log(0), whose weight is 0
_INTEGER_LIMIT = 2.0**30  # fits int32
_ROOT2 = np.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class StreamValues:
    """Decoded contents of a file's streams: arrays as in `FreeValues`, on their lattices."""

    quats: F32
    scales: F32
    sizes: F32
    opacities: F32
    sh0: F32
    sh: F32


@dataclass(frozen=True, eq=False)
class DequantisedScene(DecodedValues):
    """Decoded values by splat, and the contents of the file's streams."""

    stored: StreamValues


@dataclass(eq=False)
class RateTerm:
    """The rate term of the loss: bits of the file's integers, and their slopes by attribute.

    Attributes:
        fixed: the encoder's decisions, among them the lattices.
        weight: lambda, loss per bit and splat.
        tables: slopes in bits per step, [columns, 2 · 128 + 1], by attribute and quantisation class.
        bits: bits of all integers, by their order-0 entropy, without centres and indices, which hardly change.
    """

    fixed: FixedQuantisation
    weight: float
    tables: dict[str, F32]
    bits: float = 0.0

    @classmethod
    def count(cls, fixed: FixedQuantisation, stored: StreamValues, weight: float) -> RateTerm:
        """Count the integers of a scene.

        Args:
            fixed: the encoder's decisions.
            stored: contents of the streams.
            weight: lambda, loss per bit and splat.
        """
        costs = cls(fixed, weight, {})
        plan = fixed.parameters
        for number, grade in enumerate(_class_steps(fixed)):
            rows = grade.rows
            columns = {
                "scales": _integers(stored.scales[rows], grade.scale_step),
                "quats": _integers(stored.quats[rows, 1:], grade.quat_step),
                "opacities": np.rint(np.sqrt(stored.opacities[rows]) * grade.levels).astype(np.int32)[:, None],
                "sh0": colour_integers_of(stored.sh0[rows, None], grade.sh0_step, plan.chroma_shift).reshape(-1, 3),
            }
            for name, values in columns.items():
                costs._count_table(_table_name(name, number), [values])
        costs._count_table("sizes", [_integers(stored.sizes[:, None], plan.scale_step)])
        width = 3 * stored.sh.shape[1]
        if width:
            parts = (stored.sh[first : first + _ROWS] for first in range(0, max(1, len(stored.sh)), _ROWS))
            coloured = (colour_integers_of(part, plan.sh_step, plan.chroma_shift) for part in parts)
            costs._count_table("shN", (part.reshape(-1, width) for part in coloured))
        return costs

    def _count_table(self, name: str, parts: Iterable[NDArray[Any]]) -> None:
        """Set the table `name` to the slopes of integers [n, C] in parts, and add their bits."""
        self.tables[name], bits = slopes_of(count_integers(parts))
        self.bits += bits

    @property
    def loss(self) -> float:
        """Weight times bits per splat."""
        return self.weight * self.bits / len(self.fixed.source_index)

    def add_to(self, steps: ParameterArrays, stored: StreamValues) -> None:
        """Add the slopes to gradients.

        Args:
            steps: gradients of the loss by group; changed in place.
            stored: contents of the streams.
        """
        plan, tables = self.fixed.parameters, self.tables
        per_bit, shift = self.weight / len(stored.opacities), plan.chroma_shift
        for number, grade in enumerate(_class_steps(self.fixed)):
            rows = grade.rows
            scales, quats, opacities, sh0 = (
                tables[_table_name(name, number)] for name in ("scales", "quats", "opacities", "sh0")
            )
            _add_slopes(stored.scales[rows], grade.scale_step, per_bit, scales, steps["scales"][rows])
            _add_slopes(stored.quats[rows], grade.quat_step, per_bit, quats, steps["quats"][rows])
            # The level is levels √alpha, whose derivative by the logit is levels √alpha (1 − alpha) / 2.
            alphas, root = stored.opacities[rows], np.sqrt(stored.opacities[rows])
            levels = np.minimum(np.rint(root * np.float32(grade.levels)), MAX_INTEGER).astype(np.intp)
            chain = np.float32(0.5 * grade.levels) * root * (np.float32(1.0) - alphas)
            steps["logits"][rows] += np.float32(per_bit) * chain * opacities[0, MAX_INTEGER + levels]
            colours = stored.sh0[rows], steps["sh0"][rows]
            call("add_colour_slopes", len(alphas), 1, grade.sh0_step, shift, per_bit, sh0, *colours)
        _add_slopes(stored.sizes[:, None], plan.scale_step, per_bit, tables["sizes"], steps["sizes"][:, None])
        rows, width, _ = stored.sh.shape
        if width:
            call("add_colour_slopes", rows, width, plan.sh_step, shift, per_bit, tables["shN"], stored.sh, steps["shN"])


def _add_slopes(seen: F32, step: float, per_bit: float, table: F32, gradients: F32) -> None:
    """Add the slopes of columns that are quantised one by one, the last of `seen` [n, C], to `gradients` [n, C]."""
    rows, width = seen.shape
    call("add_slopes", rows, width, width - len(table), step, per_bit, table, seen, gradients)


@dataclass(frozen=True)
class _ClassSteps:
    """Consecutive rows with the same quantisation steps; all rows without quantisation classes.

    Attributes:
        rows: the rows of splats.
        scale_step, quat_step, sh0_step: difference of values whose integers differ by 1.
        levels: integer of the opacity 1, whose root is quantised.
    """

    rows: slice
    scale_step: float
    quat_step: float
    levels: float
    sh0_step: float


def _class_steps(fixed: FixedQuantisation) -> list[_ClassSteps]:
    """Return the steps of each quantisation class; classes are runs of tiles, and so of rows."""
    plan, tiles = fixed.parameters, fixed.encode_plan.tiles
    begins = [0] if fixed.encode_plan.classes is None else [
        number for number, tile in enumerate(tiles) if not number or tile.factors != tiles[number - 1].factors
    ]  # fmt: skip
    steps = []
    for begin, end in pairwise([*begins, len(tiles)]):
        factors = tiles[begin].factors
        rows = slice(None) if len(begins) == 1 else slice(tiles[begin].rows[0], tiles[end - 1].rows[-1] + 1)
        steps.append(
            _ClassSteps(
                rows,
                plan.scale_step * 2.0**factors.scales,
                factors.quats / (_ROOT2 * plan.quat_levels),
                plan.opacity_levels / factors.opacities,
                plan.sh0_step * 2.0**factors.sh0,
            )
        )
    return steps


def _table_name(name: str, number: int) -> str:
    """Return the name of an attribute's table for a quantisation class; the first has the attribute's own name."""
    return f"{name} {number}" if number else name


def count_integers(parts: Iterable[NDArray[Any]]) -> I64:
    """Count the integers −128 to 128 of each column, [C, 257]. Integers beyond count as −128 or 128.

    Args:
        parts: at least one part of [n, C] integers: rows of the same C columns.
    """
    size = 2 * MAX_INTEGER + 1
    counts: NDArray[Any] = np.zeros((0, size), np.int64)
    for columns in parts:
        width = columns.shape[1]
        places = np.clip(columns, -MAX_INTEGER, MAX_INTEGER) + (MAX_INTEGER + size * np.arange(width))
        column_counts = np.bincount(places.reshape(-1), minlength=width * size).reshape(width, size)
        counts = counts + column_counts if len(counts) else column_counts
    return counts


def slopes_of(counts: I64) -> tuple[F32, float]:
    """Return the slope of the cost of integers in bits per step, and the cost of all of them.

    Args:
        counts: result of `count_integers`.

    Returns:
        [C, 257] float32, and bits.
    """
    size = counts.shape[1]
    count = int(counts.sum(axis=1).max(initial=0))
    # Counts + 1, slightly blurred: an integer that happens not to occur counts as rare.
    padded = np.pad(counts + 1.0, ((0, 0), (1, 1)), mode="edge")
    blurred = 0.25 * padded[:, :-2] + 0.5 * padded[:, 1:-1] + 0.25 * padded[:, 2:]
    bits = -np.log2(blurred / (count + size))
    slopes = np.gradient(bits, axis=1)
    fractions = counts / max(1, count)
    entropy = -(counts * np.log2(np.maximum(fractions, _FRACTION_MIN))).sum()
    return np.clip(slopes, -_MAX_SLOPE, _MAX_SLOPE).astype(np.float32), float(entropy)


def colour_integers_of(seen: F32, step: float, shift: int) -> I32:
    """Return Y, Co, Cg [..., 3] int32, as coded, of colours on their lattice [..., 3]."""
    rgb = _integers(seen, step)
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    co = red - blue
    t = blue + (co >> 1)
    cg = green - t
    return np.stack([t + (cg >> 1), co >> shift, cg >> shift], axis=-1)


def _integers(seen: F32, step: float) -> I32:
    """Return the integers of decoded values of any shape, limited to ± `_INTEGER_LIMIT`."""
    return np.rint(np.clip(seen.astype(np.float64) / step, -_INTEGER_LIMIT, _INTEGER_LIMIT)).astype(np.int32)
