"""Which splats go, in which order: by the exact error of their removal, measured anew round after round."""

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
from csplat_render import Camera
from csplat_render.removal import Removal, measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.views.agreeing import removal_keys

__all__ = ["Order", "Round", "Side", "removal_order", "seen_by"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_LEAST_SHARE = 0.01  # of the splats that stay, at the end of an order that is made to be cut anywhere
_ROUND_SHARE = 0.72  # of what is left stays after each round of such an order: what hid a splat may have gone


@dataclass(frozen=True)
class Round:
    """One round.

    Attributes:
        removed: how many splats went.
        largest: the largest error of one of them, as a sum over pixels, channels and views.
        predicted: sum of their errors.
    """

    removed: int
    largest: float
    predicted: float


@dataclass(frozen=True, eq=False)
class Order:
    """In which order splats go.

    Attributes:
        rows: [G] int64, source splats, the first to go first; those that never go are not among them.
        errors: [G], error of each one's removal when its round came.
        rounds: what each round took.
    """

    rows: I64
    errors: F64
    rounds: tuple[Round, ...]

    def kept(self, splat_count: int, gone: int) -> I64:
        """Source splats that are left when `gone` are removed, ascending."""
        stays = np.ones(splat_count, bool)
        stays[self.rows[:gone]] = False
        return np.flatnonzero(stays)


@dataclass(frozen=True, eq=False)
class Side:
    """Views from which splats are measured together.

    Attributes:
        cameras: the views.
        removal: what they say of the splats that are left; the last time they were asked.
    """

    cameras: Sequence[Camera]
    removal: Removal

    def of_rows(self, rows: NDArray[Any]) -> Side:
        """The same of some of the splats."""
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
    """Find out in which order splats go.

    Args:
        model: the source.
        sides: views, and what they say of the source. Rounds ask one side after the other, and what the others said
            before still counts: twice the views, at the price of one side's.
        options: rounds.
        left: splats that are to stay; None for an order that may be cut anywhere.
        progress: is told how much is done.
        enough: such an order ends with the round in which the sum of all errors exceeds this.
        start: goes on from there.
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
            removal = measure_removal(
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


def seen_by(sides: Sequence[Side]) -> Removal:
    """What all of them say."""
    return functools.reduce(operator.add, [side.removal for side in sides])


def _targets(count: int, options: SimplifyOptions, left: int | None, now: int) -> list[int]:
    """How many splats are left after each round, each time fewer."""
    last = max(1, round(count * _LEAST_SHARE)) if left is None else left
    if left is not None:
        targets = [round(count + (last - count) * number / options.rounds) for number in range(1, options.rounds + 1)]
    else:
        targets = [now]
        while targets[-1] > last:
            targets.append(max(last, int(targets[-1] * _ROUND_SHARE)))
    return sorted({target for target in targets if target < now}, reverse=True)
