"""Prune splats of low importance in rounds, and refit the others: `simplify`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Target
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, I64, PSNR_CAP, Progress
from csplat_render import Camera
from csplat_render.conventions import ALPHA_MIN
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.scorer import Scorer, renderer
from csplat_tools.optimise.pruning_order import (
    MeasuredViews,
    PruningOrder,
    SimplifyOptions,
    find_pruning_order,
    total_error,
)
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import SceneLike, load_model
from csplat_tools.views import ViewSet, camera_sequence, find_view_set
from csplat_tools.views.sufficient_views import SufficientViews, find_sufficient_views
from csplat_trainer.splat_refit import BAND_STEPS, FIT_STEPS, RefitResult, refit_with_bands

_TRIES = 3  # largest number of refits in the search for a target PSNR
_AGREE_ON = 0.5  # least fraction of the splats on whose pruning views must agree, since refits need views in any case
_NOT_PRUNED = f"none of up to {_TRIES} pruned scenes reached the target: all splats are kept, unchanged"
_NEAR = 0.05  # dB; a result this close to the target PSNR is not improved
_BANDS_WORTH = 1.0  # dB that dropping SH bands may cost; a refit that loses more has failed


@dataclass(frozen=True, eq=False)
class Simplified:
    """A simplified scene.

    Attributes:
        model: the scene.
        source_index: [N] int64, the index of each splat in the source.
        threshold: the largest error of a pruned splat.
        kept_bands: [N, d], mask of the kept SH bands; `None` if bands were not chosen.
        report: pruned splats by reason, predicted and measured errors, views, seconds; JSON-compatible.
        notes: remarks for the user, a sentence each.
    """

    model: SplatModel
    source_index: I64
    threshold: float
    kept_bands: NDArray[np.bool_] | None
    report: dict[str, Any]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PruningSession:
    """A source with its views and pruning order, shared by several simplifications.

    Attributes:
        source: the scene.
        options: options of the simplification.
        view_set: all views of the scene.
        views: the training views whose pruning errors agree with those of held-out views, and the held-out views.
        training_cameras: views that splats are fitted to: the training views and, if they are virtual, at least the
            same number of others, against overfitting.
        view_groups: the same views with the source's pruning errors: two groups if they are virtual, else one.
        references: [H, W, 3], the source's render of each view of `training_cameras`.
        order: the pruning order.
        check_scorer: scorer on held-out views.
        seconds: time by stage.
    """

    source: SplatModel
    options: SimplifyOptions
    view_set: ViewSet
    views: SufficientViews
    training_cameras: list[Camera]
    view_groups: list[MeasuredViews]
    references: list[F32]
    order: PruningOrder
    check_scorer: Scorer
    seconds: dict[str, float]

    @property
    def value_count(self) -> int:
        """Number of pixels times channels of all `training_cameras`."""
        return sum(group.pruning_error.value_count for group in self.view_groups)

    def kept_rows(self, pruned_count: int) -> I64:
        """Return the indices of the kept splats if the first `pruned_count` of the order are pruned."""
        return self.order.kept(len(self.source), pruned_count)

    def threshold(self, pruned_count: int) -> float:
        """Return the largest pruning error among the first `pruned_count` splats."""
        return float(self.order.errors[:pruned_count].max(initial=0.0))

    def refit(self, rows: I64, progress: Progress | None = None) -> RefitResult:
        """Refit the given splats of the source, and choose their SH bands."""
        return refit_with_bands(
            self.source.select(rows),
            self.training_cameras,
            self.references,
            steps=self.options.steps(FIT_STEPS) if self.options.refit else 0,
            band_steps=self.options.steps(BAND_STEPS) if self.options.refit else 0,
            bands=self.options.bands,
            band_views=len(self.views.used),
            background=self.options.background,
            seed=self.options.seed,
            threads=self.options.threads,
            progress=progress,
        )


def prepare_pruning(
    source: SplatModel,
    views: ViewSet | None,
    kept_count: int | None,
    options: SimplifyOptions,
    progress: Progress | None = None,
    *,
    allowed: float = math.inf,
) -> PruningSession:
    """Render the source, and find the pruning order.

    Args:
        source: the scene.
        views: views of the scene; `None` for virtual views.
        kept_count: number of splats to keep; `None` if not known yet.
        options: options of the simplification.
        progress: progress callback.
        allowed: approximate mean squared error of pruning at which the order may end.
    """
    seconds = {}
    start = time.perf_counter()
    count, size = options.views_and_size(len(source))
    view_set = views or find_view_set(source, background=options.background, count=count, size=size, seed=options.seed)
    options = replace(options, background=view_set.background, view_size=size)
    pruned_fraction = max(_AGREE_ON, 0.0 if kept_count is None else 1.0 - kept_count / len(source))
    found = find_sufficient_views(
        source, view_set, pruned_fraction, size=size, threads=options.threads, progress=progress
    )
    view_groups = [MeasuredViews(found.used, found.pruning_error)]
    if view_set.virtual:
        more = round(len(found.used) * max(1.0, options.work))
        cameras = camera_sequence(source, more, size, seed=options.seed + 1)
        pruning_error = measure_pruning_error(
            source, cameras, background=view_set.background, bands=False, threads=options.threads, progress=progress
        )
        view_groups.append(MeasuredViews(cameras, pruning_error))
    training_cameras = [camera for group in view_groups for camera in group.cameras]
    references = _render_all(source, training_cameras, options)
    check_scorer = Scorer.of_source(source, found.check, view_set.background, threads=options.threads)
    seconds["views"] = time.perf_counter() - start
    start = time.perf_counter()
    values = sum(group.pruning_error.value_count for group in view_groups)
    order = find_pruning_order(source, view_groups, options, kept_count, progress, enough=allowed * values)
    seconds["rounds"] = time.perf_counter() - start
    return PruningSession(
        source, options, view_set, found, training_cameras, view_groups, references, order, check_scorer, seconds
    )


def _render_all(source: SplatModel, cameras: Sequence[Camera], options: SimplifyOptions) -> list[F32]:
    draw = renderer(source, options.background, threads=options.threads)
    return [draw(camera).rgb for camera in cameras]


def simplify(
    scene: SceneLike,
    target: Target,
    *,
    views: ViewSet | None = None,
    options: SimplifyOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Simplified:
    """Prune splats to a target, refit the others, and drop SH bands, as `csplat simplify` does.

    Requires the packages of the render extra.

    Args:
        scene: a model, or a file in any format.
        target: a fraction to keep, a PSNR, or a drop of PSNR; the fewest splats that meet it are kept.
        views: the kept splats are fitted to training views; validation views determine how many may be pruned. `None`:
            virtual views.
        options: number of views and rounds, instead of the target's effort.
        progress: progress callback.

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
    """
    require_renderer()
    target.require("simplify", "keep", "psnr", "max_psnr_drop")
    source = load_model(scene).model
    options = options or SimplifyOptions(effort=target.effort)
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    if target.max_psnr_drop is not None and (views is None or not views.images):
        raise InputError("a largest drop of PSNR requires images: name a data set")
    kept_count = None if target.keep is None else target.count(len(source))
    session = prepare_pruning(source, views, kept_count, options, progress)
    start = time.perf_counter()
    if kept_count is not None:
        result = _prune_and_refit(session, min(len(source) - kept_count, len(session.order.rows)), None, progress)
    else:
        result = _search_fewest(session, *_find_scorer(session, target), progress)
    session.seconds["fit"] = time.perf_counter() - start
    threshold = session.threshold(result.pruned_count)
    report = {**_report(session, result, target), **_test_scores(session, result.model)}
    notes = (_NOT_PRUNED,) if result.is_source else ()
    return Simplified(result.model, result.source_index, threshold, result.kept_bands, report, notes)


@dataclass(frozen=True, eq=False)
class _PrunedScene:
    """A pruned and refitted scene with its scores.

    Attributes:
        model, source_index, kept_bands: as in `Simplified`.
        pruned_count: number of pruned splats.
        check_psnr_before_refit, check_psnr: PSNR on held-out views, dB.
        refit_refused: the refit made held-out views worse, and was discarded.
        validation_psnr_before_refit, validation_psnr: PSNR on validation views, dB; `None` if not measured.
        is_source: the unchanged source, since no pruned scene reached the target.
    """

    model: SplatModel
    source_index: I64
    kept_bands: NDArray[np.bool_] | None
    pruned_count: int
    check_psnr_before_refit: float
    check_psnr: float
    refit_refused: bool = False
    validation_psnr_before_refit: float | None = None
    validation_psnr: float | None = None
    is_source: bool = False

    def scores(self) -> dict[str, Any]:
        """Return the scores for the report."""
        scores = {
            "check_psnr_pruned": self.check_psnr_before_refit,
            "check_psnr": self.check_psnr,
            "refit_refused": self.refit_refused or None,
            "validation_psnr_pruned": self.validation_psnr_before_refit,
            "validation_psnr": self.validation_psnr,
        }
        return {name: value for name, value in scores.items() if value is not None}


def _find_scorer(session: PruningSession, target: Target) -> tuple[Scorer, float]:
    """Return the scorer on validation views, and the PSNR to reach, dB; `PSNR_CAP` without a target."""
    views, threads = session.view_set, session.options.threads
    if target.max_psnr_drop is not None:
        scorer = views.image_validation_scorer(threads=threads)
        return scorer, scorer.psnr(session.source) - target.max_psnr_drop
    return views.validation_scorer(session.source, threads=threads), PSNR_CAP if target.psnr is None else target.psnr


def _test_scores(session: PruningSession, model: SplatModel) -> dict[str, Any]:
    """Return the scores on the test views, for the report; empty without test views."""
    views, threads = session.view_set, session.options.threads
    if not views.test:
        return {}
    scores: dict[str, Any] = {
        "psnr": views.test_scorer(session.source, threads=threads).psnr(model),
        "test_views": {"cameras": views.name, "views": len(views.test)},
    }
    if views.images:
        scorer = views.image_test_scorer(threads=threads)
        scores["photographs"] = {"source": scorer.psnr(session.source), "psnr": scorer.psnr(model)}
    return scores


def _prune_and_refit(
    session: PruningSession, pruned_count: int, scorer: Scorer | None, progress: Progress | None
) -> _PrunedScene:
    rows = session.kept_rows(pruned_count)
    pruned, refit = session.source.select(rows), session.refit(rows, progress)
    before_refit, after_refit = session.check_scorer.psnr(pruned), session.check_scorer.psnr(refit.model)
    model, kept_bands = refit.model, refit.kept_bands
    allowed = 0.0 if kept_bands is None else _BANDS_WORTH
    refit_refused = after_refit < before_refit - allowed and session.options.refit
    if refit_refused:  # overfitted: held-out views are worse than before
        model, kept_bands, after_refit = pruned, None, before_refit
    return _PrunedScene(
        model,
        source_index=rows,
        kept_bands=kept_bands,
        pruned_count=pruned_count,
        check_psnr_before_refit=before_refit,
        check_psnr=after_refit,
        refit_refused=refit_refused,
        validation_psnr_before_refit=None if scorer is None else scorer.psnr(pruned),
        validation_psnr=None if scorer is None else scorer.psnr(model),
    )


def _search_fewest(session: PruningSession, scorer: Scorer, goal: float, progress: Progress | None) -> _PrunedScene:
    """Find the fewest splats that reach a PSNR, by bisection without refits, corrected by the gain of a refit.

    Returns:
        The smallest of up to `_TRIES` scenes that reaches the PSNR; the unchanged source if none does.

    Raises:
        InputError: even the source misses the PSNR.
    """
    if scorer.psnr(session.source) < goal:
        raise InputError(f"the unpruned source is below the target of {goal:.2f} dB: lower the target")
    best, gain = None, 0.0
    lowest = 0
    for _ in range(_TRIES):
        pruned_count = _most_prunable(session, scorer, goal - gain, lowest)
        result = _prune_and_refit(session, pruned_count, scorer, progress)
        before, reached = result.validation_psnr_before_refit, result.validation_psnr
        assert before is not None
        assert reached is not None
        if reached >= goal:
            if best is None or len(result.model) < len(best.model):
                best = result
            lowest = pruned_count
        if pruned_count == 0 or abs(reached - goal) < _NEAR:
            break
        gain = reached - before - (0.0 if reached >= goal else goal - reached)
    if best is not None:
        return best
    source, check = session.source, session.check_scorer.psnr(session.source)
    return _PrunedScene(
        source,
        source_index=np.arange(len(source)),
        kept_bands=None,
        pruned_count=0,
        check_psnr_before_refit=check,
        check_psnr=check,
        validation_psnr=scorer.psnr(source),
        is_source=True,
    )


def _most_prunable(session: PruningSession, scorer: Scorer, goal: float, lowest: int) -> int:
    """Return the number of splats that may be pruned before the PSNR, without a refit, falls below a goal.

    Args:
        session: the scene and its pruning order.
        scorer: scorer on validation views.
        goal: least PSNR, dB.
        lowest: a number that is known to be possible.
    """
    low, high = lowest, len(session.order.rows)
    while high - low > max(1, len(session.source) // 200):
        middle = (low + high) // 2
        if scorer.psnr(session.source.select(session.kept_rows(middle))) >= goal:
            low = middle
        else:
            high = middle
    return low


def _report(session: PruningSession, result: _PrunedScene, target: Target) -> dict[str, Any]:
    source, views = session.source, session.views
    pruned = np.ones(len(source), bool)
    pruned[result.source_index] = False
    invisible = source.opacities < ALPHA_MIN
    unseen = ~total_error(session.view_groups).seen & ~invisible
    predicted = float(session.order.errors[: result.pruned_count].sum()) / session.value_count
    bands = {}
    if result.kept_bands is not None:
        bands = {str(band): int(np.count_nonzero(~kept)) for band, kept in enumerate(result.kept_bands.T, 1)}
    return {
        "target": target.as_json(),
        "splats_before": len(source),
        "splats": len(result.model),
        "removed": {
            "invisible": int(np.count_nonzero(pruned & invisible)),
            "unseen": int(np.count_nonzero(pruned & unseen)),
            "least_error": int(np.count_nonzero(pruned & ~invisible & ~unseen)),
        },
        "unseen_share": float(np.mean(unseen)),
        "views": {
            "used": len(views.used),
            "check": len(views.check),
            "gap_db": round(views.gap, 3),
            "size": [views.used[0].W, views.used[0].H],
        },
        "rounds": [vars(one) for one in session.order.rounds],
        "largest_error_removed": session.threshold(result.pruned_count),
        "predicted_psnr": -10.0 * math.log10(predicted) if predicted > 0.0 else None,
        "zero_bands": bands,
        "seconds": {stage: round(value, 2) for stage, value in session.seconds.items()},
        **result.scores(),
    }
