# SPDX-License-Identifier: Apache-2.0
"""`simplify`: prune splats to a target, and refit the others."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import Target
from csplat.errors import InputError, SearchInterrupted, counted
from csplat.goal_search import next_value
from csplat.model import SplatModel
from csplat.types import I64
from csplat_render.conventions import ALPHA_MIN
from csplat_render.metrics import psnr_of_mse
from csplat_render.scorer import Scorer
from csplat_tools.optimise.pruning import PrunedSubset, Pruner
from csplat_tools.optimise.rate_distortion import AIM, LOG_ERROR_PER_DB, NOTHING, error_of_psnr
from csplat_tools.optimise.search_plan import SCORES, simplify_plan
from csplat_tools.optional_packages import require_renderer
from csplat_tools.planned_progress import PlannedProgress
from csplat_tools.scene_files import SceneLike, load_scene
from csplat_tools.views import VIEW_SIZE, VIRTUAL, ViewSet, default_views, find_view_set, require_visible

_TRIES = 4  # largest number of refits that correct the number of splats for a PSNR
_NOT_PRUNED = "no pruned scene reached the target: all splats are kept, unchanged"


@dataclass(frozen=True)
class SimplifyOptions:
    """Options of pruning and refitting.

    Attributes:
        refit: fit colours, opacities, scales and rotations of the kept splats to the source's renders.
        effort: amount of work, 1 to 5; `None`: that of the target. Steps of refits halve with each level below 3, and
            double with every two above.
        view_size: width and height of training renders, pixels; `None`: chosen by the number of splats.
        views: largest number of virtual views if no views are given; `None`: chosen by the number of splats.
        background: red, green, blue behind virtual views; given views have their own.

    Raises:
        InputError: a value is out of range.
    """

    refit: bool = True
    effort: int | None = None
    view_size: tuple[int, int] | None = None
    views: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.effort is not None and not 1 <= self.effort <= 5:
            raise InputError(f"effort is {self.effort}, expected 1 to 5")
        if self.views is not None and self.views < 1:
            raise InputError(f"views is {self.views}, expected at least 1")
        if self.view_size is not None and min(self.view_size) < 1:
            raise InputError(f"view_size is {self.view_size}, expected at least 1 pixel")

    def views_and_size(self, splats: int) -> tuple[int, tuple[int, int]]:
        """Return the largest number of training views, and the width and height of their renders, for N splats."""
        views, size = default_views(splats)
        return self.views or views, self.view_size or size

    @property
    def work(self) -> float:
        """The amount of work relative to the default effort."""
        octaves = 0 if self.effort is None else self.effort - Target.effort
        return 2.0 ** (octaves / 2 if octaves > 0 else octaves)

    def pruner(
        self,
        source: SplatModel,
        views: ViewSet,
        *,
        use_classes: bool = True,
        context: Context = DEFAULT_CONTEXT,
    ) -> Pruner:
        """Return the pruner of a scene, with fewer steps if renders are larger than usual."""
        size = self.views_and_size(len(source))[1]
        larger = max(1.0, math.sqrt(math.prod(size) / math.prod(VIEW_SIZE)))
        return Pruner(source, views, size, self.work / larger, self.refit, use_classes, context)


@dataclass(frozen=True, eq=False)
class Simplified:
    """A simplified scene.

    Attributes:
        model: the scene.
        source_index: [N] int64, the index of each splat in the source.
        report: pruned splats by reason, predicted and measured errors, views, seconds; JSON-compatible.
        notes: remarks for the user, a sentence each.
    """

    model: SplatModel
    source_index: I64
    report: dict[str, Any]
    notes: tuple[str, ...] = ()


def simplify(
    scene: SceneLike,
    target: Target,
    *,
    views: ViewSet | None = None,
    options: SimplifyOptions | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> Simplified:
    """Prune splats to a target, and refit the others, as `csplat simplify` does.

    Args:
        scene: a model, or a file in any format.
        target: a fraction to keep, a PSNR, or a drop of PSNR; the fewest splats that meet it are kept.
        views: the kept splats are fitted to training views; validation views determine how many may be pruned. `None`:
            virtual views.
        options: number and size of views.
        context: threads and progress; seed of the virtual views, and of the order in which views are used.

    Returns:
        The simplified scene; its splats are in the source's order. If the search for a PSNR finds no pruned scene that
        reaches it, that is the unchanged source, with a remark in `notes`.

    Examples:
        >>> import csplat, csplat_tools
        >>> half = csplat_tools.simplify("scene.ply", csplat.Target(keep=0.5))  # doctest: +SKIP
        >>> len(half.model), half.report["psnr"]  # doctest: +SKIP
        (4464, 39.6)

    Raises:
        InputError: the target is of another kind, the scene has no splats, training or validation views are missing,
            or even the source misses the target.
        CsplatError: the scene is not valid.
        OSError: the file cannot be read.
        SearchInterrupted: Ctrl-C interrupted the search for a PSNR; `best` has the fewest splats so far that reach it,
            or is `None`.
    """
    require_renderer()
    target.require("simplify", "keep", "psnr", "max_psnr_drop")
    source, start = load_scene(scene).model(), time.perf_counter()
    options = options or SimplifyOptions()
    options = replace(options, effort=target.effort if options.effort is None else options.effort)
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    if target.max_psnr_drop is not None and (views is None or not views.images):
        raise InputError("a largest drop of PSNR requires images: name a data set")
    if views is None:
        count, size = options.views_and_size(len(source))
        views = find_view_set(source, background=options.background, count=count, size=size, seed=context.seed)
    views.require_fit()
    if views.name != VIRTUAL and views.test:
        require_visible(views, views.test_scorer(source, context=context))
    plan = simplify_plan(options.pruner(source, views), target)
    progress = PlannedProgress("search", plan, context.progress)
    context = replace(context, progress=progress)
    pruner, scores = options.pruner(source, views, context=context), dict[str, Any]()
    if target.keep is not None:
        subset = pruner.refit_in_rounds(target.count(len(source)))
    else:
        subset, scores = _prune_to_psnr(pruner, target, progress)
    progress(SCORES, 0.0)
    report = {**_pruning_report(pruner, subset, target), **scores, **_test_scores(pruner, subset.model)}
    progress(SCORES, 1.0)
    report["seconds"] = round(time.perf_counter() - start, 2)
    notes = (_NOT_PRUNED,) if target.keep is None and len(subset.rows) == len(source) else ()
    simplified = Simplified(subset.model, subset.rows, report, notes)
    if "interrupted" in report:
        splats, psnr = counted(len(subset.model), "splat"), report["validation_psnr"]
        raise SearchInterrupted(f"interrupted: the best so far was taken, {splats} with {psnr:.2f} dB", simplified)
    return simplified


def _prune_to_psnr(pruner: Pruner, target: Target, progress: PlannedProgress) -> tuple[PrunedSubset, dict[str, Any]]:
    """Return the fewest splats that reach a PSNR on validation views, and entries for the report: their PSNR, dB.

    For a drop, the PSNR is against images, otherwise against renders of the source. Each number is predicted from the
    pruning order and the last refit. All splats are kept, without a refit, if no refit reaches it.

    Raises:
        InputError: even the source misses the PSNR.
        SearchInterrupted: Ctrl-C, and no refit so far reaches the PSNR; else `interrupted` is among the entries.
    """
    source, views = pruner.source, pruner.views
    scorer = views.validation_scorer(source, context=pruner.context)
    if target.max_psnr_drop is not None:
        scorer = views.image_validation_scorer(context=pruner.context)
    source_error = scorer.pooled(scorer.errors(source))
    goal = target.psnr if target.max_psnr_drop is None else psnr_of_mse(source_error) - target.max_psnr_drop
    assert goal is not None
    if psnr_of_mse(source_error) < goal:
        raise InputError(f"the unpruned source is below the target of {goal:.2f} dB: lower the target")
    allowed, refits = error_of_psnr(goal), list[tuple[float, PrunedSubset]]()
    entries = dict[str, Any]()
    progress.note = lambda: _describe_fewest(refits, allowed)
    try:
        _add_refits(refits, pruner, scorer, source_error, allowed)
    except KeyboardInterrupt:
        if all(error > allowed for error, _ in refits):
            raise SearchInterrupted(_nearest_message(refits, goal)) from None
        entries["interrupted"] = True
    reached = [refit for refit in refits if refit[0] <= allowed] or [(source_error, pruner.refit(len(source)))]
    error, subset = min(reached, key=lambda refit: len(refit[1].rows))
    return subset, {"validation_psnr": psnr_of_mse(error), **entries}


def _add_refits(
    refits: list[tuple[float, PrunedSubset]], pruner: Pruner, scorer: Scorer, source_error: float, allowed: float
) -> None:
    """Add refits of the search for a mean squared error to a list, with their errors, until one is on the goal.

    Args:
        refits: the list, empty.
        pruner: prunes and refits the source.
        scorer: scorer on the validation views.
        source_error: mean squared error of the source; 0 against its own renders.
        allowed: mean squared error to reach.
    """
    splats, added_max = len(pruner.source), allowed - source_error  # largest mean squared error that pruning may add
    known: tuple[int, float] | None = None  # number of splats of the last refit, and the error that another would add
    for turn in itertools.count():
        counts, errors = (values[::-1] for values in pruner.errors(added_max, known))  # np.interp: ascending counts
        kept_count = next_value(
            math.log(added_max),
            [(len(subset.rows), math.log(max(error - source_error, NOTHING))) for error, subset in refits],
            partial(np.interp, xp=counts, fp=np.log(np.maximum(errors, NOTHING))), bounds=(counts[0], splats),
            margin=0.5 * AIM * LOG_ERROR_PER_DB, tolerance=AIM * LOG_ERROR_PER_DB * allowed / added_max, least_step=1.0,
            tries=_TRIES,
        )  # fmt: skip
        if kept_count is None or math.ceil(kept_count) == splats:
            return
        part, rest_gain, surplus = pruner.turn(turn)
        subset = pruner.refit(min(math.ceil(surplus * kept_count), splats), part)
        error = scorer.pooled(scorer.errors(subset.model))
        known = len(subset.rows), error_of_psnr(rest_gain) * max(error - source_error, 0.0)
        if not rest_gain:
            refits.append((error, subset))


def _describe_fewest(refits: Sequence[tuple[float, PrunedSubset]], allowed: float) -> str:
    """Describe the fewest splats so far of at most this mean squared error, for progress; empty if there are none."""
    reached = [(len(subset.rows), error) for error, subset in refits if error <= allowed]
    if not reached:
        return ""
    count, error = min(reached)
    return f"best so far {counted(count, 'splat')}, {psnr_of_mse(error):.1f} dB"


def _nearest_message(refits: Sequence[tuple[float, PrunedSubset]], goal: float) -> str:
    """Return the message if the search for a PSNR in dB is interrupted before a refit reaches it."""
    found = "nothing was refitted"
    if refits:
        error, subset = min(refits, key=lambda refit: refit[0])
        found = f"{counted(len(subset.rows), 'splat')} have {psnr_of_mse(error):.2f} dB"
    return f"interrupted: no pruned scene reaches {goal:.2f} dB so far; {found}; --effort 1 takes less time"


def _test_scores(pruner: Pruner, model: SplatModel) -> dict[str, Any]:
    """Return the PSNR on the test views, dB, and against test images if there are any; empty without test views."""
    views, context = pruner.views, pruner.context
    if not views.test:
        return {}
    scores: dict[str, Any] = {
        "psnr": views.test_scorer(pruner.source, context=context).psnr(model),
        "test_views": {"cameras": views.name, "views": len(views.test)},
    }
    if views.images:
        scorer = views.image_test_scorer(context=context)
        scores["images"] = {"source": scorer.psnr(pruner.source), "psnr": scorer.psnr(model)}
    return scores


def _pruning_report(pruner: Pruner, subset: PrunedSubset, target: Target) -> dict[str, Any]:
    """Return the JSON-compatible report without scores and seconds; each pruned splat has one reason."""
    source, views, order = pruner.source, pruner.sufficient, pruner.order
    pruned = np.ones(len(source), bool)
    pruned[subset.rows] = False
    pruned_count = int(np.count_nonzero(pruned))
    invisible = source.opacities < ALPHA_MIN
    unseen = ~order.seen & ~invisible
    predicted = float(order.mean_errors()[pruned_count])
    return {
        "target": target.as_json(),
        "splats_before": len(source),
        "splats": len(subset.model),
        "removed": {
            "invisible": int(np.count_nonzero(pruned & invisible)),
            "unseen": int(np.count_nonzero(pruned & unseen)),
            "least_error": int(np.count_nonzero(pruned & ~invisible & ~unseen)),
        },
        "unseen_share": float(np.mean(unseen)),
        "views": {
            "used": len(views.used),
            "check": len(views.check.cameras),
            "gap_db": round(views.gap, 3),
            "size": [views.used[0].W, views.used[0].H],
        },
        "rounds": len(order.rounds),
        "largest_error_removed": float(order.errors[:pruned_count].max(initial=0.0)),
        "predicted_psnr": psnr_of_mse(predicted) if predicted > 0.0 else None,
        "check_psnr_pruned": subset.check_psnr_pruned,
        "check_psnr": subset.check_psnr,
        **({"refit_refused": True} if subset.refit_refused else {}),
    }
