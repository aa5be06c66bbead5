"""Find the pruning order of splats, by the exact error of removing each, measured anew in every round."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.types import F64, I64, Progress
from csplat_render import Camera
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.views.agreeing import removal_keys

_LEAST_SHARE = 0.01  # fraction of the splats that is left at the end of an order without a given target
_ROUND_SHARE = 0.72  # fraction left after each round of such an order: splats that hid another may have been pruned


@dataclass(frozen=True)
class Round:
    """One round of pruning.

    Attributes:
        removed: number of pruned splats.
        largest: the largest error of one of them, as a sum over pixels, channels and views.
        predicted: sum of their errors.
    """

    removed: int
    largest: float
    predicted: float


@dataclass(frozen=True, eq=False)
class Order:
    """A pruning order.

    Attributes:
        rows: [G] int64, source splats in the order of pruning, without those that are never pruned.
        errors: [G], error of removing each, as measured in its round.
        rounds: the rounds.
    """

    rows: I64
    errors: F64
    rounds: tuple[Round, ...]

    def kept(self, splat_count: int, gone: int) -> I64:
        """Return the source splats that are kept if `gone` are pruned, ascending."""
        stays = np.ones(splat_count, bool)
        stays[self.rows[:gone]] = False
        return np.flatnonzero(stays)


@dataclass(frozen=True, eq=False)
class Side:
    """Views from which splats are measured together.

    Attributes:
        cameras: the views.
        removal: the removal errors of the splats that are left, as last measured in these views.
    """

    cameras: Sequence[Camera]
    removal: PruningError

    def of_rows(self, rows: NDArray[Any]) -> Side:
        """Return the views with the errors of some of the splats."""
        return replace(self, removal=self.removal.of_rows(rows))


def removal_order(
    model: SplatModel,
    sides: Sequence[Side],
    options: SimplifyOptions,
    left: int | None,
    progress: Progress | None = None,
    *,
    enough: float = math.inf,
    start: Order | None = None,
) -> Order:
    """Find the pruning order of splats.

    Args:
        model: the source.
        sides: views with the removal errors of the source. Rounds measure one side after the other, and the last
            measurements of the others still count: with two sides, twice the views at the cost of one.
        options: rounds, background, threads, `keep_unseen`.
        left: number of splats to keep; None for an order that may be cut anywhere.
        progress: progress callback.
        enough: an order without `left` ends with the round in which the sum of all errors exceeds this.
        start: an order to continue.
    """
    count = len(model)
    rows, sides = np.arange(count), list(sides)
    gone, errors, rounds = list[I64](), list[F64](), list[Round]()
    if start is not None:
        gone, errors, rounds = [start.rows], [start.errors], list(start.rounds)
        rows = np.delete(rows, start.rows)
        sides = [side.of_rows(rows) for side in sides]
    for target in _targets(count, options, left, len(rows)):
        if gone:
            turn = (len(rounds) - 1) % len(sides)
            removal = measure_pruning_error(
                model.select(rows), sides[turn].cameras, background=options.background, bands=False,
                threads=options.threads, progress=progress,
            )  # fmt: skip
            sides[turn] = replace(sides[turn], removal=removal)
        keys = removal_keys(model.opacities[rows], seen_by(sides), keep_unseen=options.keep_unseen)
        order = np.argsort(keys, kind="stable")[: len(rows) - target]
        order = order[np.isfinite(keys[order])]
        if not len(order):
            break
        gone.append(rows[order])
        errors.append(np.maximum(keys[order], 0.0))
        rounds.append(Round(len(order), float(errors[-1][-1]), float(errors[-1].sum())))
        rows = np.delete(rows, order)
        stays = np.delete(np.arange(len(keys)), order)
        sides = [side.of_rows(stays) for side in sides]
        if left is None and sum(one.predicted for one in rounds) > enough:
            break
    if not gone:
        return Order(np.zeros(0, np.int64), np.zeros(0), ())
    return Order(np.concatenate(gone), np.concatenate(errors), tuple(rounds))


def seen_by(sides: Sequence[Side]) -> PruningError:
    """Return the sum of the removal errors over all sides."""
    return functools.reduce(operator.add, [side.removal for side in sides])


def _targets(count: int, options: SimplifyOptions, left: int | None, now: int) -> list[int]:
    """Return the number of splats left after each round, in decreasing order."""
    last = max(1, round(count * _LEAST_SHARE)) if left is None else left
    if left is not None:
        targets = [round(count + (last - count) * number / options.rounds) for number in range(1, options.rounds + 1)]
    else:
        targets = [now]
        while targets[-1] > last:
            targets.append(max(last, int(targets[-1] * _ROUND_SHARE)))
    return sorted({target for target in targets if target < now}, reverse=True)
