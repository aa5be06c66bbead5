# SPDX-License-Identifier: Apache-2.0
"""The pruning order of splats: by the exact error of removing each from renders, measured again in rounds.

Pruned splats may have hidden others, so that errors change. Splats that are alike may be merged instead, in the order
of both errors. Targets, `simplify`, fine-tuning and training use this order.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.model import SplatModel
from csplat.types import F16, F32, F64, I64, Mask, null_progress
from csplat_render import Camera
from csplat_render.conventions import ALPHA_MIN
from csplat_render.kernels import call
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_trainer.merging import find_alike, merge_alike

#: Fraction of the splats that a round keeps; with more rounds PSNR rises by less than 0.1 dB.
ROUND_FRACTION = 0.72

_UNDRAWN_KEY, _UNSEEN_KEY = -1.0, -0.5  # keys of splats to prune before all others, in this order
_F16_MAX = float(np.finfo(np.float16).max)
# Views in which refitted splats are measured, if there are more; with twice as many, lego60k's file is no smaller.
_VIEWS_AGAIN = 100
# Fraction of the splats in pairs that are alike below which later rounds of large scenes search for none; in a million
# splats, a search takes 6 CPU seconds.
_FEW_ALIKE, _LARGE = 0.005, 100_000
_LEAST_FRACTION = 0.01  # fraction of the splats at which an order ends unless fewer are requested


@dataclass(frozen=True, eq=False)
class MeasuredViews:
    """Views in which pruning errors are measured together.

    Attributes:
        cameras: the views.
        pruning_error: errors of removing each splat that is left, as last measured in these views.
        renders: [H, W, 3] float16, the render of each view; empty if they were not kept. The rounding is at 77 dB.
    """

    cameras: Sequence[Camera]
    pruning_error: PruningError
    renders: Sequence[F16] = ()

    @classmethod
    def of(
        cls,
        model: SplatModel,
        cameras: Sequence[Camera],
        background: ArrayLike,
        *,
        keep_renders: bool = False,
        context: Context = DEFAULT_CONTEXT,
    ) -> MeasuredViews:
        """Measure the pruning errors of a scene; other arguments as for `measure_pruning_error`."""
        renders = list[F16]()

        def keep(render: F32) -> None:
            """Keep a render."""
            renders.append(np.clip(render, -_F16_MAX, _F16_MAX).astype(np.float16))

        pruning_error = measure_pruning_error(
            model, cameras, background=background, context=context, on_render=keep if keep_renders else None
        )
        return cls(cameras, pruning_error, renders)

    def __add__(self, other: MeasuredViews) -> MeasuredViews:
        return MeasuredViews(
            [*self.cameras, *other.cameras], self.pruning_error + other.pruning_error, [*self.renders, *other.renders]
        )


@dataclass(eq=False)
class PruningOrder:
    """The splats of a scene in the order of pruning, without splats that no view shows. The order grows on demand.

    Splats that are left may be refitted in between; `continue_with` measures them again, with their new values.

    Attributes:
        model: the scene.
        groups: views with the pruning errors of the scene. Each round measures the next group, and adds the last
            measurements of the others: two groups give twice the views at the cost of a single group.
        background: background colour of the views.
        merges: merge splats into others that are alike if that has a smaller error than pruning them; False from the
            first round on that finds few in a large scene.
        context: threads and progress.
        rows: [G] int64, indices of splats in the order of pruning.
        partners: [G] int64, index of the splat into which each is merged, or −1.
        errors: [G], mean squared error of removing each from the renders, measured in its round; estimated for merges.
        rounds: number of pruned splats by round.
        view_count: number of renders in which errors were measured again.
        seen: [N] bool, True for splats that are visible in a view.
    """

    model: SplatModel
    groups: list[MeasuredViews]
    background: ArrayLike = (0.0, 0.0, 0.0)
    merges: bool = False
    context: Context = DEFAULT_CONTEXT
    rows: I64 = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    partners: I64 = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    errors: F64 = field(default_factory=lambda: np.zeros(0), init=False)
    rounds: list[int] = field(default_factory=list, init=False)
    view_count: int = field(default=0, init=False)
    seen: Mask = field(init=False)
    _left: I64 = field(init=False)
    _values: SplatModel = field(init=False)  # values of the splats in the ascending rows `_value_rows`
    _value_rows: I64 = field(init=False)
    _is_measured: bool = field(default=True, init=False)  # all groups were measured with the splats that are left

    def __post_init__(self) -> None:
        self._left = self._value_rows = np.arange(len(self.model))
        self._values = self.model
        self.seen = total_error(self.groups).seen

    def mean_errors(self) -> F64:
        """Return [G + 1], the sum of the errors of the first 0, 1, … G splats."""
        sums: F64 = np.concatenate([[0.0], np.cumsum(self.errors)])
        return sums

    def kept(self, count: int) -> I64:
        """Return the ascending indices of `count` kept splats; of more if not enough can be pruned."""
        self.extend(kept_count=count)
        is_kept = np.ones(len(self.model), bool)
        is_kept[self.rows[: len(self.model) - count]] = False
        return np.flatnonzero(is_kept)

    def merge(self, splats: SplatModel, rows: I64, done: int, pruned_count: int) -> SplatModel:
        """Return splats with the values that they have once others were merged into them.

        Args:
            splats: splats of which the first `done` of the order were pruned or merged.
            rows: ascending indices of these splats in the scene.
            pruned_count: number of splats of the order that are to be pruned or merged.
        """
        begin = 0
        for count in self.rounds:  # the pairs of a round have no splat in common
            part = slice(max(done, begin), min(pruned_count, begin + count))
            begin += count
            pairs = np.stack([self.partners[part], self.rows[part]])
            pairs = pairs[:, pairs[0] >= 0]
            if pairs.size:
                splats = merge_alike(splats, np.searchsorted(rows, pairs))
        return splats

    def extend(self, *, kept_count: int | None = None, error: float = math.inf) -> None:
        """Prune until `kept_count` splats are left, or the mean squared error exceeds `error`."""
        least = max(1, round(len(self.model) * _LEAST_FRACTION)) if kept_count is None else kept_count
        done = 1.0
        while len(self._left) > least and float(self.errors.sum()) <= error:
            if not self._prune_round(max(least, int(len(self._left) * ROUND_FRACTION))):
                break
            done = len(self.rows) / len(self.model)
            self.context.progress("ordering splats", done)
        if done < 1.0:
            self.context.progress("ordering splats", 1.0)

    def continue_with(self, refitted: SplatModel) -> None:
        """Order all but the first splats anew, by errors that are measured with refitted values in some of the views.

        Args:
            refitted: the splats `kept(len(refitted))`, with other values.
        """
        pruned_count = len(self.model) - len(refitted)
        self._value_rows, self._values = self.kept(len(refitted)), refitted
        assert len(self._value_rows) == len(refitted)
        self._left = self._value_rows
        self.rows, self.partners = self.rows[:pruned_count], self.partners[:pruned_count]
        self.errors = self.errors[:pruned_count]
        ends = np.minimum(np.cumsum(self.rounds), pruned_count)
        self.rounds = [int(count) for count in np.diff(ends, prepend=0) if count]
        before = np.cumsum([0, *(len(group.cameras) for group in self.groups[:-1])])
        needed = [group for group, views in zip(self.groups, before, strict=True) if views < _VIEWS_AGAIN]
        self.groups = [self._measured(refitted, group.cameras) for group in needed]
        self._is_measured = True

    def _measured(self, left: SplatModel, cameras: Sequence[Camera]) -> MeasuredViews:
        """Measure the pruning errors of the splats that are left."""
        self.view_count += len(cameras)
        quiet = replace(self.context, progress=null_progress)
        return MeasuredViews.of(left, cameras, self.background, context=quiet)

    def _prune_round(self, count: int) -> bool:
        """Prune until `count` splats are left, after measuring the next group of views again unless all are measured.

        Unseen splats are kept, so more may be left.

        Returns:
            False if no splat can be pruned.
        """
        places = np.searchsorted(self._value_rows, self._left)
        if not self._is_measured:
            turn = (len(self.rounds) - 1) % len(self.groups)  # the groups take turns
            self.groups[turn] = self._measured(self._values.select(places), self.groups[turn].cameras)
        self._is_measured = False
        pruning_error = total_error(self.groups)
        keys = pruning_keys(self._values.opacities[places], pruning_error)
        pairs = self._choose_merges(places, keys) if self.merges else np.zeros((2, 0), np.int64)
        order = np.argsort(keys, kind="stable")[: len(self._left) - count]
        order = order[np.isfinite(keys[order])]
        if not len(order):
            return False
        partners = np.full(len(keys), -1)
        partners[pairs[1]] = self._left[pairs[0]]
        self.rows = np.concatenate([self.rows, self._left[order]])
        self.partners = np.concatenate([self.partners, partners[order]])
        pairs = pairs[:, np.isin(pairs[1], order)]
        if pairs.size:
            self._values = merge_alike(self._values, places[pairs])
            self.groups = [
                replace(group, pruning_error=_merged_error(group.pruning_error, pairs)) for group in self.groups
            ]
        self.errors = np.concatenate([self.errors, np.maximum(keys[order], 0.0) / pruning_error.value_count])
        self.rounds.append(len(order))
        kept = np.delete(np.arange(len(keys)), order)
        self._left = self._left[kept]
        self.groups = [replace(group, pruning_error=group.pruning_error.of_rows(kept)) for group in self.groups]
        return True

    def _choose_merges(self, places: I64, keys: F64) -> I64:
        """Choose splats to merge, and set the keys of both: that of the merge, and infinity for the splat that stays.

        Args:
            places: [L], places of the splats that are left among the values.
            keys: [L], keys by which they are pruned, changed in place.

        Returns:
            [2, P], of each pair the splat that stays, and the splat that is merged into it; no splat is in two pairs.
        """
        pairs, mismatch = find_alike(self._values.select(places))
        self.merges = len(places) < _LARGE or pairs.shape[1] >= _FEW_ALIKE * len(places)
        smaller = keys[pairs].min(axis=0)
        is_possible = (smaller > 0.0) & np.isfinite(keys[pairs].max(axis=0))  # without an error, pruning is better
        pairs = np.ascontiguousarray(pairs[:, is_possible])
        errors = (mismatch * smaller)[is_possible]
        chosen = np.full(len(keys), -1)
        call("pair_up", pairs, np.argsort(errors, kind="stable"), len(errors), len(keys), chosen)
        is_chosen = chosen[pairs[0]] == pairs[1]
        pairs = pairs[:, is_chosen]
        keys[pairs[0]], keys[pairs[1]] = np.inf, errors[is_chosen]
        return pairs


def _merged_error(pruning_error: PruningError, pairs: I64) -> PruningError:
    """Return the errors after merges, until they are measured again: images of two splats that are alike add up."""
    error = pruning_error.error.copy()
    error[pairs[0]] = np.square(np.sqrt(np.maximum(error[pairs], 0.0)).sum(axis=0))
    return replace(pruning_error, error=error)


def total_error(groups: Sequence[MeasuredViews]) -> PruningError:
    """Return the sum of the pruning errors over all groups of views."""
    return functools.reduce(operator.add, [group.pruning_error for group in groups])


def pruning_keys(opacities: NDArray[np.float32], pruning_error: PruningError, *, keep_unseen: bool = True) -> F64:
    """Return the keys by which splats are pruned, the smallest first.

    Args:
        opacities: [N], opacities of a scene.
        pruning_error: its pruning errors.
        keep_unseen: prune splats that no view saw never instead of first.

    Returns:
        [N] float64: −1 for a splat whose alpha is too small to be drawn; infinity, or −0.5 without `keep_unseen`, for
        a splat that no view saw; else the pruning error.
    """
    keys = np.where(pruning_error.seen, pruning_error.error, np.inf if keep_unseen else _UNSEEN_KEY)
    keys[opacities < ALPHA_MIN] = _UNDRAWN_KEY
    return keys


def kept_in_round(opacities: NDArray[np.float32], pruning_error: PruningError, count: int) -> I64:
    """Return the ascending indices of the splats that a round keeps, at least `count`. Unseen splats are pruned first.

    Args:
        opacities, pruning_error: as for `pruning_keys`.
        count: number of splats to keep in the last round.
    """
    keys = pruning_keys(opacities, pruning_error, keep_unseen=False)
    kept_count = max(count, int(len(keys) * ROUND_FRACTION))
    return np.sort(np.argsort(keys, kind="stable")[len(keys) - kept_count :])
