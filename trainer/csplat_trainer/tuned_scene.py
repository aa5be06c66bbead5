"""The state of fine-tuning: float values, their quantised form in the file, and the rate term of the loss.

Straight-through estimator: images are rendered from the decoded values, and their gradients are applied to the values
before quantisation (Bengio et al. 2013, https://arxiv.org/abs/1308.3432). The gradient of a codebook entry is the sum
of the gradients of all splats that use it.

Rate: the size of a stream is close to its order-0 entropy, so an integer n of a column costs about −log2 of its
relative frequency in the column. The slope of this cost, from n − 1 to n + 1, moves values towards frequent integers,
mostly zero, unless the images oppose it. Frequencies are counted again every few steps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import DecodedValues, FixedQuantisation, FreeValues
from csplat.types import F32, I32, I64
from csplat_render.conventions import Gradients
from csplat_render.kernels import lane_range, parallel_kernel
from csplat_trainer.parameters import ParameterArrays, Parameters, adam_step, logits_of, sigmoid


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
        values, book, shapes = self.parameters.values, fixed.book, fixed.shapes
        self._users = None if book is None else _group_by_entry(book.index, book.size)
        self._escaped = np.zeros(0, np.int64) if book is None else book.escaped
        self._rows_gradient = np.zeros_like(values["shN"] if book else values["shN"][:0])
        self._shape_users = None if shapes is None else _group_by_entry(shapes.index, shapes.size)
        self._own_shape = np.zeros(0, np.int64) if shapes is None else np.flatnonzero(shapes.escaped)

    @property
    def free_values(self) -> FreeValues:
        """The values for the encoder; all arrays except the opacities are the parameters' own."""
        return self._free_values(sigmoid(self.parameters.values["logits"]))

    def _free_values(self, alphas: F32) -> FreeValues:
        """Return the parameters' own arrays, with these opacities [N] in place of the logits."""
        v = self.parameters.values
        return FreeValues(v["means"], v["quats"], v["scales"], alphas, v["sh0"], v["shN"], v["sizes"])

    def dequantise(self) -> tuple[DecodedValues, F32]:
        """Return the decoded values, and the opacities before quantisation."""
        values = self.free_values
        return self.fixed.dequantise(values), values.opacities

    def stream_values(self, seen: DecodedValues) -> StreamValues:
        """Return the decoded contents of the file's streams."""
        sh = self.fixed.dequantise_sh_rows(self.parameters.values["shN"]) if self.fixed.book is not None else seen.shN
        if self.fixed.shapes is None:
            return StreamValues(seen.quats, seen.scales, self.parameters.values["sizes"], seen.opacities, seen.sh0, sh)
        quats, scales, sizes = self.fixed.dequantise_shape_rows(self._free_values(seen.opacities), seen)
        return StreamValues(quats, scales, sizes, seen.opacities, seen.sh0, sh)

    def count(self, seen: DecodedValues, weight: float) -> RateTerm:
        """Count the bits of the file's integers; `weight` is lambda, loss per bit and splat."""
        return RateTerm.count(self.fixed, self.stream_values(seen), weight)

    def step(
        self, gradients: Gradients, seen: DecodedValues, alphas: F32, rates: dict[str, float], costs: RateTerm | None
    ) -> None:
        """Make a step against the gradients of the loss and the rate term.

        Args:
            gradients: gradients of the loss.
            seen, alphas: the result of `dequantise`.
            rates: learning rate of each group.
            costs: the rate term, if any.
        """
        quats, scales, sizes = self._by_shape(gradients)
        steps = {
            "means": gradients.means,
            "quats": quats,
            "scales": scales,
            "sizes": sizes,
            "logits": gradients.opacities * (alphas * (np.float32(1.0) - alphas)),
            "sh0": gradients.sh0,
            "shN": self._by_row(gradients.shN),
        }
        if costs is not None:
            costs.add_to(steps, self.stream_values(seen))
        adam_step(self.parameters, steps, rates)
        self.fixed.constrain(self._free_values(alphas))

    def _by_row(self, by_splat: F32) -> F32:
        """Return the gradients of the file's rows of SH, [R, K, 3], given the gradients of all splats [N, K, 3].

        With a codebook, rows are its entries, then the escaped splats, and the next call overwrites the result.
        Without, rows are splats.
        """
        book = self.fixed.book
        if book is None or self._users is None:
            return by_splat
        rows, (order, starts) = self._rows_gradient, self._users
        rows[: book.size] = _sum_by_entry(by_splat, order, starts, book.size)
        rows[book.size :] = by_splat[self._escaped]
        return rows

    def _by_shape(self, gradients: Gradients) -> tuple[F32, F32, F32]:
        """Return the gradients of the file's rotations [S, 4] and scales [S, 3], and of the sizes of splats.

        With a shape codebook, rows are its entries, then the escaped splats, and sizes are offsets [N] of all three
        log-scales. Without, S is N, and there are no sizes: [0].
        """
        shapes = self.fixed.shapes
        if shapes is None or self._shape_users is None:
            return gradients.quats, gradients.scales, np.zeros(0, np.float32)
        own, (order, starts) = self._own_shape, self._shape_users
        quats, scales = (
            np.concatenate([_sum_by_entry(part, order, starts, shapes.size), part[own]])
            for part in (gradients.quats, gradients.scales)
        )
        return quats, scales, gradients.scales.sum(axis=1)


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


def _group_by_entry(index: NDArray[np.int32], size: int) -> tuple[I64, I64]:
    """Group splats by their entry of a codebook.

    Args:
        index: [N], entry of each splat; `size` for escaped splats.
        size: number of entries.

    Returns:
        [N], splats sorted by entry, escaped splats last; and [size + 1], position there of the first splat of each
        entry, and of the first escaped splat.
    """
    order = np.argsort(index, kind="stable")
    starts = np.searchsorted(index[order], np.arange(size + 1))
    return order.astype(np.int64), starts.astype(np.int64)


def _sum_by_entry(values: F32, order: I64, starts: I64, size: int) -> F32:
    """Return the sums of values [N, ...] over the splats of each entry, [size, ...]; see `sum_by_entry`."""
    flat = np.empty((size, values[0].size), np.float32)
    sum_by_entry(values.reshape(len(values), -1), order, starts, flat)
    return flat.reshape(size, *values.shape[1:])


@parallel_kernel()
def sum_by_entry(lane: int, lanes: int, values: F32, order: I64, starts: I64, out: F32) -> None:
    """Sum the rows of the splats of each entry, in float32 and in their order; vectorises over a row.

    Args:
        values: [N, C].
        order: [N], rows of `values` by entry.
        starts: [size + 1], index in `order` of an entry's first splat.
        out: [size, C], overwritten.
    """
    for entry in range(lane, out.shape[0], lanes):
        total = out[entry]
        total[:] = np.float32(0.0)
        for position in range(starts[entry], starts[entry + 1]):
            row = values[order[position]]
            for c in range(out.shape[1]):
                total[c] += row[c]


def sum_by_entry_twin(values: F32, order: I64, starts: I64, out: F32) -> None:
    """Compute `sum_by_entry` in NumPy, for tests."""
    for entry in range(len(out)):
        out[entry] = values[order[starts[entry] : starts[entry + 1]]].sum(axis=0)


MAX_INTEGER = 128  # integers beyond ± this cost the same as ± this
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
        per_bit = np.float32(self.weight / len(stored.opacities))
        shift = plan.chroma_shift
        for number, grade in enumerate(_class_steps(self.fixed)):
            rows = grade.rows
            scales, quats, opacities, sh0 = (
                tables[_table_name(name, number)] for name in ("scales", "quats", "opacities", "sh0")
            )
            _add_plain(stored.scales[rows], grade.scale_step, 0, scales, per_bit, steps["scales"][rows])
            _add_plain(stored.quats[rows], grade.quat_step, 1, quats, per_bit, steps["quats"][rows])
            roots = np.sqrt(stored.opacities[rows])
            levels = np.minimum(np.rint(roots * np.float32(grade.levels)), MAX_INTEGER).astype(np.int64)
            # The level is M √alpha, whose derivative by the logit is M √alpha (1 − alpha) / 2.
            chain = np.float32(0.5 * grade.levels) * roots * (np.float32(1.0) - stored.opacities[rows])
            steps["logits"][rows] += per_bit * chain * opacities[0][MAX_INTEGER + levels]
            _add_colour(stored.sh0[rows, None], grade.sh0_step, shift, sh0, per_bit, steps["sh0"][rows, None])
        _add_plain(stored.sizes[:, None], plan.scale_step, 0, tables["sizes"], per_bit, steps["sizes"][:, None])
        if stored.sh.shape[1]:
            _add_colour(stored.sh, plan.sh_step, shift, tables["shN"], per_bit, steps["shN"])


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


@parallel_kernel()
def _add_plain(
    lane: int, lanes: int, seen: F32, step: float, first: int, tables: F32, per_bit: np.float32, out: F32
) -> None:
    """Add the slopes of columns that are quantised one by one; parallel over runs of rows.

    Args:
        seen: [n, C], decoded values.
        step: their quantisation step.
        first: number of columns to skip, which have no table.
        tables: [C - first, 2 · MAX_INTEGER + 1], slopes in bits per step.
        per_bit: loss per bit.
        out: [n, C], gradients of the loss; incremented.
    """
    reach = tables.shape[1] // 2
    over = np.float32(1.0 / step)
    begin, end = lane_range(lane, lanes, seen.shape[0])
    seen, out = seen[begin:end], out[begin:end]
    for i in range(end - begin):
        for c in range(first, seen.shape[1]):
            n = min(max(int(np.rint(seen[i, c] * over)), -reach), reach)
            out[i, c] += per_bit * over * tables[c - first, reach + n]


@parallel_kernel()
def _add_colour(
    lane: int, lanes: int, seen: F32, step: float, shift: int, tables: F32, per_bit: np.float32, out: F32
) -> None:
    """Add the slopes of colours through the transform to luma and chroma; parallel over runs of rows.

    Args:
        seen: [n, K, 3], decoded red, green, blue.
        step: quantisation step of the luma.
        shift: the chroma's step is coarser by 2**shift.
        tables: [3 K, 2 · MAX_INTEGER + 1], slopes of Y, Co, Cg in bits per step.
        per_bit: loss per bit.
        out: [n, K, 3], gradients of the loss; incremented.
    """
    reach = tables.shape[1] // 2
    over = np.float32(1.0 / step)
    chroma = np.float32(0.5**shift)
    begin, end = lane_range(lane, lanes, seen.shape[0])
    seen, out = seen[begin:end], out[begin:end]
    for i in range(end - begin):
        for k in range(seen.shape[1]):
            red = int(np.rint(seen[i, k, 0] * over))
            green = int(np.rint(seen[i, k, 1] * over))
            blue = int(np.rint(seen[i, k, 2] * over))
            co = red - blue
            t = blue + (co >> 1)
            cg = green - t
            y = t + (cg >> 1)
            by_y = tables[3 * k, reach + min(max(y, -reach), reach)]
            by_co = chroma * tables[3 * k + 1, reach + min(max(co >> shift, -reach), reach)]
            by_cg = chroma * tables[3 * k + 2, reach + min(max(cg >> shift, -reach), reach)]
            # Y = (R + 2 G + B) / 4, Co = R - B, Cg = G - (R + B) / 2, up to rounding.
            quarter, half = np.float32(0.25), np.float32(0.5)
            out[i, k, 0] += per_bit * over * (quarter * by_y + by_co - half * by_cg)
            out[i, k, 1] += per_bit * over * (half * by_y + by_cg)
            out[i, k, 2] += per_bit * over * (quarter * by_y - by_co - half * by_cg)
