# SPDX-License-Identifier: Apache-2.0
"""Prune a scene, refit the kept splats to renders of the source, and encode them: `Pruner`."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import (
    EncodedTiles,
    EncodeOptions,
    EncodePlan,
    FixedQuantisation,
    FreeValues,
    Importance,
    Origin,
    encode_tiles,
    fix_quantisation,
    max_class_count,
    project_sh,
)
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F16, F32, F64, I64
from csplat_render import Camera
from csplat_render.scorer import ReferenceImage, Scorer
from csplat_tools.optimise.rate_distortion import NOTHING, error_of_psnr
from csplat_tools.scene_sensitivity import importance_views, measure_importance
from csplat_tools.views import ViewSet, camera_sequence
from csplat_tools.views.sufficient_views import SufficientViews, find_sufficient_views
from csplat_trainer.pruning import MeasuredViews, PruningOrder
from csplat_trainer.splat_refit import quantisation_aware_refit, refit_splats

_STEPS = 640  # usual steps of a refit from tuned values, and of the first refit through the quantisers
_BRIEF, _WHOLE = 0.25, 2.0  # multiples of `_STEPS`: the refits before splats are pruned further, and a whole refit
#: Refits that settle the number of splats: steps as a multiple of `_STEPS`, dB by which the refits that follow are
#: expected to reduce the error, and number of splats as a multiple of the expected number. Splats that are pruned in
#: between, by errors of refitted values, leave 0.5 to 1.2 dB more in three scenes than splats that are pruned at once.
REFITS = ((_BRIEF, 3.0, 1.6), (_BRIEF, 2.5, 1.25), (_WHOLE, 0.1, 1.0), (0.5, 0.0, 1.0))
# dB by which a refit at least reduces the sum of pruning errors, which is less than the error of pruning all at once.
REFIT_GAIN = 2.0


@dataclass(eq=False)
class Pruner:
    """Prunes a scene and refits the kept splats. Owns views, renders of the source and pruning order, made lazily.

    Attributes:
        source: the scene.
        views: the training and validation views; with their background.
        size: width and height of training renders, pixels.
        steps_factor: factor of the number of steps of a refit.
        refits: fit colours, opacities, scales and rotations of the kept splats to renders of the source.
        use_classes: kept splats may be sorted into quantisation classes, and later files start from tuned values; False
            for surroundings, of which virtual views show too little.
        context: threads and progress; seed of further virtual views, and of the order in which views are used.
    """

    source: SplatModel
    views: ViewSet
    size: tuple[int, int]
    steps_factor: float = 1.0
    refits: bool = True
    use_classes: bool = True
    context: Context = DEFAULT_CONTEXT
    _last: PrunedSubset | None = field(default=None, init=False)
    _to_order: SplatModel | None = field(default=None, init=False)

    @cached_property
    def sufficient(self) -> SufficientViews:
        """Training views whose pruning errors agree with the errors of held-out views, and the held-out views."""
        return find_sufficient_views(self.source, self.views, size=self.size, context=self.context)

    @cached_property
    def measured(self) -> list[MeasuredViews]:
        """Groups of views of the source; if views are virtual, twice as many as suffice, against overfitting."""
        batches = self.sufficient.batches
        groups = [functools.reduce(operator.add, batches[start::2]) for start in range(min(2, len(batches)))]
        if self.views.virtual:
            cameras = camera_sequence(self.source, len(self.sufficient.used), self.size, seed=self.context.seed + 1)
            for part in (cameras[::2], cameras[1::2]):
                group = MeasuredViews.of(
                    self.source, part, self.views.background, keep_renders=True, context=self.context
                )
                groups.append(group)
        return groups

    @cached_property
    def order(self) -> PruningOrder:
        """The pruning order; copies of splats are merged."""
        return self._new_order(merges=self.refits)

    def _new_order(self, *, merges: bool) -> PruningOrder:
        """Return the pruning order of the source."""
        return PruningOrder(self.source, [*self.measured], self.views.background, merges=merges, context=self.context)

    @cached_property
    def cameras(self) -> Sequence[Camera]:
        """The views that splats are fitted to; the pruning order uses the same."""
        return [camera for group in self.measured for camera in group.cameras]

    @cached_property
    def references(self) -> list[F16]:
        """[H, W, 3] float16, the source's render of each view."""
        return [render for group in self.measured for render in group.renders]

    @cached_property
    def check_scorer(self) -> Scorer:
        """Scorer on held-out views, against which refits are checked."""
        check = self.sufficient.check
        references = [ReferenceImage(render.astype(np.float32)) for render in check.renders]
        return Scorer(check.cameras, references, self.views.background, context=self.context)

    @property
    def view_count(self) -> int:
        """Number of small renders in which pruning errors were measured, over all rounds."""
        return len(self.cameras) + len(self.sufficient.check.cameras) + self.order.view_count

    def errors(self, allowed: float, known: tuple[int, float] | None = None) -> tuple[F64, F64]:
        """Predict the error of pruning after a refit, in proportion to the error before it.

        Args:
            allowed: mean squared error up to which errors are of interest.
            known: a number of splats and their mean squared error after a refit; `None`: the usual gain of a refit is
                assumed.

        Returns:
            Numbers of kept splats, in decreasing order, and the mean squared error of each.
        """
        gain = known[1] / self._error(known[0]) if known and known[1] > 0.0 else error_of_psnr(REFIT_GAIN)
        self.order.extend(error=max(allowed / max(gain, NOTHING), NOTHING))
        errors = self.order.mean_errors()[: len(self.source)]  # at least one splat is kept
        return len(self.source) - np.arange(len(errors), dtype=np.float64), gain * errors

    def _error(self, kept_count: int) -> float:
        """Return the mean squared error of pruning all but this number of splats, before a refit."""
        errors = self.order.mean_errors()
        return max(float(errors[min(len(self.source) - kept_count, len(errors) - 1)]), NOTHING)

    def turn(self, number: int, *, is_far: bool = False) -> tuple[float, float, float]:
        """Return the entry of `REFITS` for a refit after a number of others; the last one if there are no refits.

        Corrections have twice the steps if the number of splats `is_far` from that of the last refit.
        """
        last = len(REFITS) - 1
        part, rest_gain, surplus = REFITS[min(number, last) if self.refits else last]
        return (2.0 * part if is_far and number >= last else part), rest_gain, surplus

    def refit_in_rounds(self, kept_count: int) -> PrunedSubset:
        """Return the kept splats, refitted as by `refit`, after brief refits of more splats."""
        for part, _, surplus in REFITS:
            if part == _BRIEF and self.refits:
                self.refit(min(math.ceil(surplus * kept_count), len(self.source)), part)
        return self.refit(kept_count)

    def refit(self, kept_count: int, part: float = _WHOLE) -> PrunedSubset:
        """Return the kept splats, refitted to renders of the source, unless that makes held-out views worse.

        A refit starts from the values that the previous call returned, and the pruning order continues with them, so
        the result depends on earlier calls. Nothing is refitted if all splats are kept or `refits` is False.

        Args:
            kept_count: number of splats to keep.
            part: number of steps as a multiple of the usual number.
        """
        if self._to_order is not None and kept_count < len(self._to_order):
            self.order.continue_with(self._to_order)
        rows, pruned = self._kept(kept_count)
        psnr_pruned = self.check_scorer.psnr(pruned)
        is_first = self._last is None and self.order.merges
        if is_first and self.check_scorer.psnr(self.source.select(rows)) > psnr_pruned:  # in piles, errors add up
            self.order = self._new_order(merges=False)
            rows, pruned = self._kept(kept_count)
            psnr_pruned = self.check_scorer.psnr(pruned)
        if not self.refits or len(rows) == len(self.source):
            self._last = PrunedSubset(self, pruned, rows, psnr_pruned, psnr_pruned, refit_refused=False)
            return self._last
        start = pruned if self._last is None else self._with_last_values(self._last, pruned, rows)
        refitted = refit_splats(
            start, self.cameras, self.references, steps=self.scaled_steps(part * _STEPS),
            background=self.views.background, context=self.context,
        )  # fmt: skip
        psnr_refitted = self.check_scorer.psnr(refitted)
        is_refused = psnr_refitted < psnr_pruned
        model, psnr = (pruned, psnr_pruned) if is_refused else (refitted, psnr_refitted)
        self._last = PrunedSubset(self, model, rows, psnr_pruned, psnr, is_refused)
        # The errors of well-fitted splats predict those of fewer splats too low, so they only choose which to prune.
        self._to_order = model if part == _WHOLE else None
        if part == _BRIEF:
            self.order.continue_with(model)
        return self._last

    def _kept(self, kept_count: int) -> tuple[I64, SplatModel]:
        """Return the indices of the kept splats, ascending, and the splats, with others merged into them."""
        rows = self.order.kept(kept_count)
        everything = np.arange(len(self.source))
        return rows, self.order.merge(self.source, everything, 0, len(self.source) - len(rows)).select(rows)

    def _with_last_values(self, last: PrunedSubset, pruned: SplatModel, rows: I64) -> SplatModel:
        """Return splats with the values of an earlier refit, merged further, but for partners of splats that return.

        Args:
            last: the refitted splats.
            pruned: the splats.
            rows: their indices in the source.
        """
        done, pruned_count = len(self.source) - len(last.rows), len(self.source) - len(rows)
        model, earlier_rows = self.order.merge(last.model, last.rows, done, pruned_count), last.rows
        if pruned_count < done:
            is_same = ~np.isin(last.rows, self.order.partners[pruned_count:done])
            model, earlier_rows = model.select(np.flatnonzero(is_same)), last.rows[is_same]
        return _with_values_of(model, earlier_rows, pruned, rows)

    def planned_steps(self, files: float) -> tuple[float, float]:
        """Return the numbers of steps of the refits of a search, and those through the quantisers of some files."""
        later = _STEPS // (2 if self.use_classes and not self.source.sh_degree else 1)
        return (
            sum(self.scaled_steps(part * _STEPS) for part, *_ in REFITS),
            self.scaled_steps(_STEPS) + (files - 1.0) * self.scaled_steps(later),
        )

    def scaled_steps(self, usual: float) -> int:
        """Return a number of steps, times `steps_factor`, at least 1."""
        return max(1, round(usual * self.steps_factor))


@dataclass(eq=False)
class PrunedSubset:
    """The splats of a scene that are kept after pruning, refitted; a `Subset` of candidates.

    Attributes:
        pruner: the source, its views and their renders.
        model: the splats.
        rows: [N] int64, their indices in the source, ascending.
        check_psnr_pruned, check_psnr: PSNR on held-out views before and after the refit, dB.
        refit_refused: the refit made held-out views worse, and was discarded.
    """

    pruner: Pruner
    model: SplatModel
    rows: I64
    check_psnr_pruned: float
    check_psnr: float
    refit_refused: bool
    _tuned: dict[tuple[EncodeOptions, bool], SplatModel] = field(default_factory=dict, init=False)

    @property
    def refits(self) -> bool:
        """True if encoding refits the splats through the quantisers."""
        return self.pruner.refits

    @property
    def classifiable(self) -> bool:
        """True if the splats may be sorted into quantisation classes."""
        return self.pruner.use_classes

    def encode(self, options: EncodeOptions, *, use_classes: bool, draft: bool) -> EncodedTiles:
        """Quantise and code the splats, after a refit through the quantisers unless `draft`."""
        pruner, refits = self.pruner, self.refits
        kind = replace(options, attribute_psnr=None), use_classes
        tuned = None if draft else self._tuned.get(kind)
        plan = EncodePlan.of(
            self.model if tuned is None else tuned, options, importance=self._weights(options, use_classes=use_classes),
            origin=Origin(len(pruner.source), self.rows, refitted=refits, adjusted=refits), context=pruner.context,
        )  # fmt: skip
        if draft or not refits:
            return encode_tiles(plan)
        fixed = fix_quantisation(plan, pruner.source)
        values = quantisation_aware_refit(
            fixed, pruner.cameras, pruner.references, steps=pruner.scaled_steps(_STEPS // (1 if tuned is None else 2)),
            before=self.model, background=pruner.views.background, context=pruner.context,
        )  # fmt: skip
        start = fixed.start()
        errors_start, errors = (pruner.check_scorer.errors(self._decoded(fixed, tried)) for tried in (start, values))
        if np.mean(errors > errors_start) > 0.5:  # refits of few splats may overfit; single views say little
            values = start
        # Longer chains overfit. In surroundings the rate term moves what few views show (fox120k: 1 to 3 dB less), and
        # from values with entries of another codebook, later files gain a third as much.
        if tuned is None and pruner.use_classes and fixed.book is None:
            self._tuned[kind] = self._with_values(fixed, values)
        return fixed.encode(values)

    def _with_values(self, fixed: FixedQuantisation, values: FreeValues) -> SplatModel:
        """Return the splats with tuned values before rounding, or decoded shapes if splats share them."""
        here = np.argsort(fixed.source_index)
        shape = fixed.dequantise(values) if fixed.shapes is not None else values
        shN = np.zeros_like(self.model.shN)
        shN[:, : values.sh.shape[1]] = values.sh[here]
        return replace(
            self.model, opacities=values.opacities[here], quats=shape.quats[here], scales=shape.scales[here],
            sh0=values.sh0[here], shN=shN,
        )  # fmt: skip

    def _decoded(self, fixed: FixedQuantisation, values: FreeValues) -> SplatModel:
        """Return the splats as they decode from these values, in the order of the file."""
        return replace(self.model, **vars(fixed.dequantise(values)), means_double=None)

    def lowered(self, degree: int) -> SplatModel:
        """Return the splats with fewer SH bands, as they are encoded."""
        return self.model if degree >= self.model.sh_degree else project_sh(self.model, degree, self._importance)

    def metadata(self, validation_psnr: float) -> Mapping[str, Any]:
        """Return the entries for the file's options: splats of the source, number of views, PSNR of the file."""
        entry = {"splats": len(self.pruner.source), "views": len(self.pruner.cameras)}
        return {"simplified": {**entry, "validation_psnr": round(validation_psnr, 3)}}

    def _weights(self, options: EncodeOptions, *, use_classes: bool) -> NDArray[Any] | Importance | None:
        """Return the importance for an encoding, without blocks unless it has classes; `None` if no view shows any."""
        if self._importance is None:
            return None
        has_classes = use_classes and max_class_count(len(self.rows), options) > 1
        if has_classes and (self.classifiable or options.max_classes is not None):
            return self._importance
        return replace(self._importance, blocks=None)

    @cached_property
    def _importance(self) -> Importance | None:
        """The importance of the splats; `None` if no view shows any."""
        pruner = self.pruner
        cameras = importance_views(replace(pruner.views, training=pruner.sufficient.used), len(self.model))
        try:
            return measure_importance(
                self.model, cameras, pruner.views.background, matrices=True, context=pruner.context
            )
        except InputError:
            return None


def _with_values_of(earlier: SplatModel, earlier_rows: I64, start: SplatModel, rows: I64) -> SplatModel:
    """Return splats with the values of an earlier refit, except means, where that had the splat.

    Args:
        earlier: the [M] splats of the earlier refit.
        earlier_rows: [M], their indices in the source, ascending.
        start: the [N] splats; those that the earlier refit lacks keep their values.
        rows: [N], their indices in the source, ascending.
    """
    _, there, here = np.intersect1d(earlier_rows, rows, assume_unique=True, return_indices=True)

    def carry_over(values: F32, earlier_values: F32) -> F32:
        values = values.copy()
        values[here] = earlier_values[there]
        return values

    return replace(
        start,
        quats=carry_over(start.quats, earlier.quats),
        scales=carry_over(start.scales, earlier.scales),
        opacities=carry_over(start.opacities, earlier.opacities),
        sh0=carry_over(start.sh0, earlier.sh0),
        shN=carry_over(start.shN, earlier.shN),
    )
