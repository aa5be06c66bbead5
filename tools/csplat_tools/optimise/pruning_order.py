"""Find the pruning order of splats, by the exact error of removing each, measured again in every round."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F64, I64, Progress
from csplat_render import Camera
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_tools.views import VIEW_SIZE, default_views
from csplat_tools.views.sufficient_views import pruning_keys

_DEFAULT_EFFORT = 3
_LEAST_FRACTION = 0.01  # fraction of the splats kept at the end of an order without a splat count
_ROUND_FRACTION = 0.72  # fraction kept by each round of such an order; pruned splats may have hidden others


@dataclass(frozen=True)
class SimplifyOptions:
    """Options of a simplification.

    Attributes:
        rounds: number of rounds of measuring errors and pruning, at least 1.
        refit: fit colours, opacities, scales and rotations of the kept splats to the source's renders.
        effort: amount of work, 1 to 9. Steps of descent halve with each level below 3, and double with every two above;
            below 3 a target tries fewer candidates.
        bands: set SH bands to zero that are not worth their bits.
        keep_unseen: keep splats that no view shows.
        view_size: width and height of training renders, pixels; `None`: chosen by the number of splats.
        views: largest number of virtual views if no views are given; `None`: chosen by the number of splats.
        background: red, green, blue behind virtual views; given views have their own.
        seed: seed of the virtual views, and of the order in which views are used.
        threads: number of threads; `None` for all. The result does not depend on it.

    Raises:
        InputError: a value is out of range.
    """

    rounds: int = 4
    refit: bool = True
    effort: int = _DEFAULT_EFFORT
    bands: bool = True
    keep_unseen: bool = True
    view_size: tuple[int, int] | None = None
    views: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.effort <= 9:
            raise InputError(f"effort is {self.effort}, expected 1 to 9")
        for name in ("rounds", "views"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} is {value}, expected at least 1")
        if self.view_size is not None and min(self.view_size) < 1:
            raise InputError(f"view_size is {self.view_size}, expected at least 1 pixel")

    def views_and_size(self, splats: int) -> tuple[int, tuple[int, int]]:
        """Return the largest number of training views, and the width and height of their renders, for N splats."""
        views, size = default_views(splats)
        return self.views or views, self.view_size or size

    def steps(self, usual: int) -> int:
        """Return the number of steps scaled by effort, and reduced for large renders."""
        larger = math.sqrt(math.prod(self.view_size or VIEW_SIZE) / math.prod(VIEW_SIZE))
        return max(1, round(usual * self.work / max(1.0, larger)))

    @property
    def work(self) -> float:
        """The amount of work relative to the default effort."""
        octaves = self.effort - _DEFAULT_EFFORT
        return 2.0 ** (octaves / 2 if octaves > 0 else octaves)

    @property
    def is_brief(self) -> bool:
        """True if a target tries fewer candidates."""
        return self.effort < _DEFAULT_EFFORT


@dataclass(frozen=True)
class PruningRound:
    """One round of pruning.

    Attributes:
        removed: number of pruned splats.
        largest: largest error of a pruned splat, summed over pixels, channels and views.
        predicted: sum of their errors.
    """

    removed: int
    largest: float
    predicted: float


@dataclass(frozen=True, eq=False)
class PruningOrder:
    """A pruning order.

    Attributes:
        rows: [G] int64, indices of splats in the order of pruning, without those that are never pruned.
        errors: [G], error of removing each, measured in its round.
        rounds: the rounds.
    """

    rows: I64
    errors: F64
    rounds: tuple[PruningRound, ...]

    def kept(self, splat_count: int, pruned_count: int) -> I64:
        """Return the indices of the kept splats if `pruned_count` are pruned, ascending."""
        is_kept = np.ones(splat_count, bool)
        is_kept[self.rows[:pruned_count]] = False
        return np.flatnonzero(is_kept)


@dataclass(frozen=True, eq=False)
class MeasuredViews:
    """Views in which pruning errors are measured together.

    Attributes:
        cameras: the views.
        pruning_error: errors of removing each kept splat, as last measured in these views.
    """

    cameras: Sequence[Camera]
    pruning_error: PruningError

    def of_rows(self, rows: NDArray[Any]) -> MeasuredViews:
        """Return the views with the errors of a subset."""
        return replace(self, pruning_error=self.pruning_error.of_rows(rows))


def find_pruning_order(
    model: SplatModel,
    view_groups: Sequence[MeasuredViews],
    options: SimplifyOptions,
    kept_count: int | None,
    progress: Progress | None = None,
    *,
    enough: float = math.inf,
    start: PruningOrder | None = None,
) -> PruningOrder:
    """Find the pruning order of splats.

    Args:
        model: the source.
        view_groups: views with the pruning errors of the source. Each round measures the next group, and adds the last
            measurements of the others: two groups give twice the views at the cost of one.
        options: rounds, background, threads, `keep_unseen`.
        kept_count: number of splats to keep; `None` for an order that may be cut anywhere.
        progress: progress callback.
        enough: sum of all errors at which an order without `kept_count` ends.
        start: an order to continue.
    """
    count = len(model)
    rows, groups = np.arange(count), list(view_groups)
    pruned, errors, rounds = list[I64](), list[F64](), list[PruningRound]()
    if start is not None:
        pruned, errors, rounds = [start.rows], [start.errors], list(start.rounds)
        rows = np.delete(rows, start.rows)
        groups = [group.of_rows(rows) for group in groups]
    for target in _targets(count, options, kept_count, len(rows)):
        if pruned:
            turn = (len(rounds) - 1) % len(groups)
            measured = measure_pruning_error(
                model.select(rows), groups[turn].cameras, background=options.background, bands=False,
                threads=options.threads, progress=progress,
            )  # fmt: skip
            groups[turn] = replace(groups[turn], pruning_error=measured)
        keys = pruning_keys(model.opacities[rows], total_error(groups), keep_unseen=options.keep_unseen)
        order = np.argsort(keys, kind="stable")[: len(rows) - target]
        order = order[np.isfinite(keys[order])]
        if not len(order):
            break
        pruned.append(rows[order])
        errors.append(np.maximum(keys[order], 0.0))
        rounds.append(PruningRound(len(order), float(errors[-1][-1]), float(errors[-1].sum())))
        rows = np.delete(rows, order)
        kept = np.delete(np.arange(len(keys)), order)
        groups = [group.of_rows(kept) for group in groups]
        if kept_count is None and sum(one.predicted for one in rounds) > enough:
            break
    if not pruned:
        return PruningOrder(np.zeros(0, np.int64), np.zeros(0), ())
    return PruningOrder(np.concatenate(pruned), np.concatenate(errors), tuple(rounds))


def total_error(view_groups: Sequence[MeasuredViews]) -> PruningError:
    """Return the sum of the pruning errors over all groups of views."""
    return functools.reduce(operator.add, [group.pruning_error for group in view_groups])


def _targets(count: int, options: SimplifyOptions, kept_count: int | None, now: int) -> list[int]:
    """Return the number of splats kept after each round, in decreasing order."""
    last = max(1, round(count * _LEAST_FRACTION)) if kept_count is None else kept_count
    if kept_count is not None:
        targets = [round(count + (last - count) * number / options.rounds) for number in range(1, options.rounds + 1)]
    else:
        targets = [now]
        while targets[-1] > last:
            targets.append(max(last, int(targets[-1] * _ROUND_FRACTION)))
    return sorted({target for target in targets if target < now}, reverse=True)
