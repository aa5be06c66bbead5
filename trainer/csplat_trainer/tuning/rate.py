"""The cost of bytes in the loss: what each integer of the file takes, by how often its like occurs.

A stream's bytes lie near its order-0 entropy: an integer n of a column takes about −log2 of its share of the column.
The slope of that, from n − 1 to n + 1, pushes a value towards what is common, which is mostly zero; pictures push
back where it shows. Shares are counted anew from time to time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Frozen
from csplat.types import F32, I32
from csplat_render.kernels import lane_range, parallel_kernel
from csplat_trainer.parameters import Splats

_REACH = 128  # integers beyond ± this cost as much as the last ones
_ROWS = 1 << 15  # rows of SH that are counted at a time: their integers take several times the memory of the values
_STEEPEST = 4.0  # bits per step; rare integers are counted too badly for more
_ROOT2 = np.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class Stored:
    """Contents of a file's streams, as a decoder will return them: arrays as in `Held`, all on their lattices."""

    quats: F32
    scales: F32
    sizes: F32
    opacities: F32
    sh0: F32
    sh: F32


@dataclass(eq=False)
class Costs:
    """Slopes of the costs of all attributes, and how they reach the gradients.

    Attributes:
        frozen: lattices.
        weight: loss per bit and splat.
        tables: by attribute, and quantisation class if there are several: slopes in bits per step,
            [columns, 2 · 128 + 1].
        bits: bits of all integers together, by their order-0 entropy; without centres and indices, which hardly change.
    """

    frozen: Frozen
    weight: float
    tables: dict[str, F32]
    bits: float = 0.0

    @classmethod
    def counted(cls, frozen: Frozen, stored: Stored, weight: float) -> Costs:
        """Count the integers of a scene.

        Args:
            frozen: the encoder's decisions.
            stored: contents of the streams.
            weight: loss per bit and splat.
        """
        costs = cls(frozen, weight, {})
        plan = frozen.plan
        for number, grade in enumerate(_grades(frozen)):
            rows = grade.rows
            columns = {
                "scales": _integers(stored.scales[rows], grade.scale_step),
                "quats": _integers(stored.quats[rows, 1:], grade.quat_step),
                "opacities": np.rint(np.sqrt(stored.opacities[rows]) * grade.levels).astype(np.int32)[:, None],
                "sh0": colour_integers_of(stored.sh0[rows, None], grade.sh0_step, plan.chroma_shift).reshape(-1, 3),
            }
            for name, values in columns.items():
                costs._count(_of_grade(name, number), [values])
        costs._count("sizes", [_integers(stored.sizes[:, None], plan.scale_step)])
        width = 3 * stored.sh.shape[1]
        if width:
            parts = (stored.sh[at : at + _ROWS] for at in range(0, max(1, len(stored.sh)), _ROWS))
            coloured = (colour_integers_of(part, plan.sh_step, plan.chroma_shift) for part in parts)
            costs._count("shN", (part.reshape(-1, width) for part in coloured))
        return costs

    def _count(self, name: str, parts: Iterable[NDArray[Any]]) -> None:
        self.tables[name], bits = cost_slopes(parts)
        self.bits += bits

    @property
    def loss(self) -> float:
        """Rate term of the loss: weight times bits per splat."""
        return self.weight * self.bits / len(self.frozen.source_index)

    def add_to(self, steps: Splats, stored: Stored) -> None:
        """Add the slopes to gradients.

        Args:
            steps: gradients of the loss by group; changed in place.
            stored: contents of the streams.
        """
        plan, tables = self.frozen.plan, self.tables
        per_bit = np.float32(self.weight / len(stored.opacities))
        shift = plan.chroma_shift
        for number, grade in enumerate(_grades(self.frozen)):
            rows = grade.rows
            scales, quats, opacities, sh0 = (
                tables[_of_grade(name, number)] for name in ("scales", "quats", "opacities", "sh0")
            )
            _add_plain(stored.scales[rows], grade.scale_step, 0, scales, per_bit, steps["scales"][rows])
            _add_plain(stored.quats[rows], grade.quat_step, 1, quats, per_bit, steps["quats"][rows])
            roots = np.sqrt(stored.opacities[rows])
            levels = np.minimum(np.rint(roots * np.float32(grade.levels)), _REACH).astype(np.int64)
            # The level is M √alpha, whose derivative by the logit is M √alpha (1 − alpha) / 2.
            chain = np.float32(0.5 * grade.levels) * roots * (np.float32(1.0) - stored.opacities[rows])
            steps["logits"][rows] += per_bit * chain * opacities[0][_REACH + levels]
            _add_colour(stored.sh0[rows, None], grade.sh0_step, shift, sh0, per_bit, steps["sh0"][rows, None])
        _add_plain(stored.sizes[:, None], plan.scale_step, 0, tables["sizes"], per_bit, steps["sizes"][:, None])
        if stored.sh.shape[1]:
            _add_colour(stored.sh, plan.sh_step, shift, tables["shN"], per_bit, steps["shN"])


@dataclass(frozen=True)
class _Grade:
    """Rows that have the same steps, one after the other; all of them if there are no quantisation classes."""

    rows: slice
    scale_step: float
    quat_step: float
    levels: float
    sh0_step: float


def _grades(frozen: Frozen) -> list[_Grade]:
    plan, tiles = frozen.plan, frozen.draft.tiles
    begins = [0] if frozen.draft.grades is None else [
        number for number, tile in enumerate(tiles) if not number or tile.coarse != tiles[number - 1].coarse
    ]  # fmt: skip
    found = []
    for begin, end in pairwise([*begins, len(tiles)]):
        coarse = tiles[begin].coarse
        rows = slice(None) if len(begins) == 1 else slice(tiles[begin].rows[0], tiles[end - 1].rows[-1] + 1)
        found.append(
            _Grade(
                rows,
                plan.scale_step * 2.0**coarse.scales,
                coarse.quats / (_ROOT2 * plan.quat_levels),
                plan.opacity_levels / coarse.opacities,
                plan.sh0_step * 2.0**coarse.sh0,
            )
        )
    return found


def _of_grade(name: str, number: int) -> str:
    return f"{name} {number}" if number else name


def cost_slopes(parts: Iterable[NDArray[Any]]) -> tuple[F32, float]:
    """Slope of the cost of integers in bits per step, and the cost of all of them.

    Args:
        parts: [n, C] integers each, one part at least: rows of the same C columns.

    Returns:
        [C, 257] float32, for the integers −128 to 128, and bits.
    """
    size = 2 * _REACH + 1
    counts: NDArray[Any] = np.zeros((0, size), np.int64)
    for columns in parts:
        width = columns.shape[1]
        places = np.clip(columns, -_REACH, _REACH) + (_REACH + size * np.arange(width))
        found = np.bincount(places.reshape(-1), minlength=width * size).reshape(width, size)
        counts = counts + found if len(counts) else found
    count = int(counts.sum(axis=1).max(initial=0))
    # One more of each and a narrow blur: an integer that happens not to occur is no more than rare.
    padded = np.pad(counts + 1.0, ((0, 0), (1, 1)), mode="edge")
    blurred = 0.25 * padded[:, :-2] + 0.5 * padded[:, 1:-1] + 0.25 * padded[:, 2:]
    bits = -np.log2(blurred / (count + size))
    slopes = np.gradient(bits, axis=1)
    shares = counts / max(1, count)
    entropy = -(counts * np.log2(np.maximum(shares, 1e-12))).sum()
    return np.clip(slopes, -_STEEPEST, _STEEPEST).astype(np.float32), float(entropy)


def colour_integers_of(seen: F32, step: float, shift: int) -> I32:
    """Y, Co, Cg [..., 3] int32 of colours on their lattice [..., 3], as they are coded."""
    rgb = _integers(seen, step)
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    co = red - blue
    t = blue + (co >> 1)
    cg = green - t
    return np.stack([t + (cg >> 1), co >> shift, cg >> shift], axis=-1)


def _integers(seen: F32, step: float) -> I32:
    return np.rint(np.clip(seen.astype(np.float64) / step, -(2.0**30), 2.0**30)).astype(np.int32)


@parallel_kernel()
def _add_plain(
    lane: int, lanes: int, seen: F32, step: float, first: int, tables: F32, per_bit: np.float32, out: F32
) -> None:
    """Add the slopes of plain columns, [n, C] from column `first` on; a thread takes a run of rows."""
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
    """Add the slopes of colours [n, K, 3] through the transform to luma and chroma; a thread takes a run of rows."""
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
