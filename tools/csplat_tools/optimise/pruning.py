"""`simplify`: prune splats that renders do not need, round after round, and refit the others."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, I64, Progress
from csplat_render import Camera
from csplat_render.conventions import ALPHA_MIN
from csplat_render.metrics import PSNR_CAP
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.scorer import Scorer, renderer
from csplat_tools.optimise.pruning_order import (
    MeasuredViews,
    PruningOrder,
    SimplifyOptions,
    find_pruning_order,
    total_removal,
)
from csplat_tools.optimise.splat_refit import RefitResult, refit_with_bands
from csplat_tools.optimise.targets import Target
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import SceneLike, load_model
from csplat_tools.views import ViewSet, camera_sequence, find_view_set
from csplat_tools.views.sufficient_views import SufficientViews, find_sufficient_views

_TRIES = 3  # largest number of fits on the way to a target PSNR
_AGREE_ON = 0.5  # least fraction of the splats on whose removal views have to agree: fits need the views in any case
_BANDS_WORTH = 1.0  # dB that leaving out SH bands may cost; a fit that loses more has failed


@dataclass(frozen=True, eq=False)
class Simplified:
    """A simplified scene.

    Attributes:
        model: the scene.
        source_index: [N] int64, the source splat that each splat was.
        threshold: the largest error of a pruned splat: what a splat's bits are worth.
        stays: [N, d], mask of the SH bands that are kept; None if bands were not chosen.
        report: pruned splats by reason, predicted and measured errors, views, seconds; JSON-compatible.
    """

    model: SplatModel
    source_index: I64
    threshold: float
    stays: NDArray[np.bool_] | None
    report: dict[str, Any]


@dataclass(frozen=True, eq=False)
class PruningSession:
    """A source, its views, and its pruning order, which several simplifications of one scene share.

    Attributes:
        source: the scene.
        options: options of the simplification.
        around: all views of the scene.
        views: the training views whose removal errors agree with those of held-out views, and the latter.
        taught: views that splats are fitted to: the training views and, if they are virtual, at least as many others,
            because a fit follows its views.
        sides: the same views with the source's removal errors: two parts if they are virtual, else one.
        wanted: [H, W, 3], the source's render of each view of `taught`.
        order: the pruning order.
        checked: scorer by held-out views.
        seconds: time by stage.
    """

    source: SplatModel
    options: SimplifyOptions
    around: ViewSet
    views: SufficientViews
    taught: list[Camera]
    sides: list[MeasuredViews]
    wanted: list[F32]
    order: PruningOrder
    checked: Scorer
    seconds: dict[str, float]

    @property
    def value_count(self) -> int:
        """Pixels times channels of all views of `taught`."""
        return sum(side.removal.value_count for side in self.sides)

    def pruned(self, gone: int) -> I64:
        """Return the source splats that are kept if the first `gone` of the order are pruned."""
        return self.order.kept(len(self.source), gone)

    def threshold(self, gone: int) -> float:
        """Return the largest removal error among the first `gone` splats."""
        return float(self.order.errors[:gone].max(initial=0.0))

    def fitted(self, rows: I64, progress: Progress | None = None) -> RefitResult:
        """Refit the given splats of the source."""
        left, deciding = self.source.select(rows), len(self.views.used)
        return refit_with_bands(left, self.taught, self.wanted, self.options, deciding=deciding, progress=progress)


def prepare_pruning(
    source: SplatModel,
    views: ViewSet | None,
    left: int | None,
    options: SimplifyOptions,
    progress: Progress | None = None,
    *,
    allowed: float = math.inf,
) -> PruningSession:
    """Render the source, and find the pruning order.

    Args:
        source: the scene.
        views: views of the scene; None for virtual views.
        left: number of splats to keep; None if it is not known yet.
        options: options of the simplification.
        progress: progress callback.
        allowed: approximate mean squared error of pruning at which the order may end.
    """
    seconds = {}
    start = time.perf_counter()
    count, size = options.pictures(len(source))
    around = views or find_view_set(source, background=options.background, count=count, size=size, seed=options.seed)
    options = replace(options, background=around.background, view_size=size)
    gone = max(_AGREE_ON, 0.0 if left is None else 1.0 - left / len(source))
    found = find_sufficient_views(source, around, gone, size=size, threads=options.threads, progress=progress)
    sides = [MeasuredViews(found.used, found.removal)]
    if around.virtual:
        more = round(len(found.used) * max(1.0, options.work))
        cameras = camera_sequence(source, more, size, seed=options.seed + 1)
        removal = measure_pruning_error(
            source, cameras, background=around.background, bands=False, threads=options.threads, progress=progress
        )
        sides.append(MeasuredViews(cameras, removal))
    taught = [camera for side in sides for camera in side.cameras]
    wanted = _render_all(source, taught, options)
    checked = Scorer.of_source(source, found.check, around.background, threads=options.threads)
    seconds["views"] = time.perf_counter() - start
    start = time.perf_counter()
    values = sum(side.removal.value_count for side in sides)
    order = find_pruning_order(source, sides, options, left, progress, enough=allowed * values)
    seconds["rounds"] = time.perf_counter() - start
    return PruningSession(source, options, around, found, taught, sides, wanted, order, checked, seconds)


def _render_all(source: SplatModel, cameras: Sequence[Camera], options: SimplifyOptions) -> list[F32]:
    """Render the source from all cameras; the renderer's memory is released at the end."""
    draw = renderer(source, options.background, threads=options.threads)
    return [draw(camera).rgb for camera in cameras]


def simplify(
    scene: SceneLike,
    *,
    keep: float | None = None,
    psnr: float | None = None,
    max_psnr_drop: float | None = None,
    views: ViewSet | None = None,
    options: SimplifyOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Simplified:
    """Prune splats to a target, refit the others, and leave out SH bands, as `csplat simplify` does.

    Give one of `keep`, `psnr` and `max_psnr_drop`. Requires the packages of the render extra.

    Args:
        scene: a model, or a file in any format.
        keep: fraction of the splats to keep, above 0, at most 1.
        psnr: least PSNR against the source's renders on the validation views, dB; as few splats as possible are kept.
        max_psnr_drop: dB that the PSNR against the photographs of `views` may fall.
        views: the kept splats are fitted to training views, and validation views determine how many may be pruned.
            `None`: virtual views, as many as it takes.
        options: options of the simplification.
        progress: called with the stage and the fraction of it that is done, 0 to 1.

    Returns:
        The simplified scene; its splats are in the source's order.

    Examples:
        >>> import csplat_tools
        >>> half = csplat_tools.simplify("scene.ply", keep=0.5)  # doctest: +SKIP
        >>> len(half.model), half.report["psnr"]  # doctest: +SKIP
        (4464, 39.6)

    Raises:
        InputError: the scene has no splats, training or validation views are missing, or even the source misses the
            target.
        CsplatError: the scene is not valid.
        OSError: the file cannot be read.
    """
    require_renderer()
    target = Target(psnr, None, max_psnr_drop, keep)
    source = load_model(scene).model
    options = options or SimplifyOptions()
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    if target.max_psnr_drop is not None and (views is None or not views.photographs):
        raise InputError("a loss against photographs wants photographs: name a data set")
    left = None if target.keep is None else target.count(len(source))
    session = prepare_pruning(source, views, left, options, progress)
    start = time.perf_counter()
    if left is not None:
        gone = min(len(source) - left, len(session.order.rows))
        result = _prune_and_refit(session, gone, None, progress)
    else:
        result = _search_fewest(session, *find_scorer(session, target), progress)
    session.seconds["fit"] = time.perf_counter() - start
    return replace(result, report={**_report(session, result, target), **_test_scores(session, result.model)})


def find_scorer(session: PruningSession, target: Target) -> tuple[Scorer, float]:
    """Return the validation scorer and the PSNR that is to be reached, dB; 99 if the target has none.

    Args:
        session: the views; validation views are not among the test views.
        target: the target.
    """
    around, threads = session.around, session.options.threads
    if target.max_psnr_drop is not None:
        validation_scorer = around.photograph_validation_scorer(threads=threads)
        return validation_scorer, validation_scorer.psnr(session.source) - target.max_psnr_drop
    return around.validation_scorer(session.source, threads=threads), PSNR_CAP if target.psnr is None else target.psnr


def _test_scores(session: PruningSession, model: SplatModel) -> dict[str, Any]:
    """Return the scores of the result on the test views, for the report; empty if there are none."""
    around, threads = session.around, session.options.threads
    if not around.test:
        return {}
    said: dict[str, Any] = {
        "psnr": around.test_scorer(session.source, threads=threads).psnr(model),
        "judged_by": {"cameras": around.name, "views": len(around.test)},
    }
    if around.photographs:
        judge = around.photograph_test_scorer(threads=threads)
        said["photographs"] = {"source": judge.psnr(session.source), "psnr": judge.psnr(model)}
    return said


def _prune_and_refit(session: PruningSession, gone: int, judge: Scorer | None, progress: Progress | None) -> Simplified:
    """Prune and refit, and measure the result."""
    rows, threshold = session.pruned(gone), session.threshold(gone)
    pruned = session.source.select(rows)
    fitted = session.fitted(rows, progress)
    report: dict[str, Any] = {
        "gone": gone,
        "check_psnr_pruned": session.checked.psnr(pruned),
        "check_psnr": session.checked.psnr(fitted.model),
    }
    model, stays = fitted.model, fitted.stays
    worth = 0.0 if stays is None else _BANDS_WORTH
    if report["check_psnr"] < report["check_psnr_pruned"] - worth and session.options.refit:
        model, stays = pruned, None  # overfitted: held-out views are worse than before
        report["check_psnr"], report["refit_refused"] = report["check_psnr_pruned"], True
    if judge is not None:
        report["decided_psnr_pruned"], report["decided_psnr"] = judge.psnr(pruned), judge.psnr(model)
    return Simplified(model, rows, threshold, stays, report)


def _search_fewest(session: PruningSession, judge: Scorer, goal: float, progress: Progress | None) -> Simplified:
    """Find the fewest splats that reach a PSNR: bisect along the order without a fit, then allow for the fit's gain."""
    if judge.psnr(session.source) < goal:
        raise InputError(f"even the source is below the target of {goal:.2f} dB: its renders are not its pictures")
    best, gain = None, 0.0
    lowest = 0
    for _ in range(_TRIES):
        gone = most_pruned(session, judge, goal - gain, lowest)
        result = _prune_and_refit(session, gone, judge, progress)
        reached = result.report["decided_psnr"]
        if reached >= goal:
            if best is None or len(result.model) < len(best.model):
                best = result
            lowest = gone
        if gone == 0 or abs(reached - goal) < 0.05:
            break
        gain = reached - result.report["decided_psnr_pruned"] - (0.0 if reached >= goal else goal - reached)
    if best is not None:
        return best
    return _unchanged(session, judge)


def most_pruned(session: PruningSession, judge: Scorer, goal: float, lowest: int = 0) -> int:
    """Return the number of splats that may be pruned before the PSNR, without a fit, falls below a goal.

    Args:
        session: the scene and its pruning order.
        judge: the scorer.
        goal: least PSNR, dB.
        lowest: a number of splats that is known to be possible.
    """
    low, high = lowest, len(session.order.rows)
    while high - low > max(1, len(session.source) // 200):
        middle = (low + high) // 2
        if judge.psnr(session.source.select(session.pruned(middle))) >= goal:
            low = middle
        else:
            high = middle
    return low


def _unchanged(session: PruningSession, judge: Scorer) -> Simplified:
    source = session.source
    score = session.checked.psnr(source)
    report = {"gone": 0, "check_psnr_pruned": score, "check_psnr": score}
    report["decided_psnr"] = judge.psnr(source)
    return Simplified(source, np.arange(len(source)), 0.0, None, report)


def _report(session: PruningSession, result: Simplified, target: Target) -> dict[str, Any]:
    """Return the report: pruned splats by reason, views, rounds, predicted and measured errors."""
    source, views = session.source, session.views
    stays = np.zeros(len(source), bool)
    stays[result.source_index] = True
    invisible = source.opacities < ALPHA_MIN
    unseen = ~total_removal(session.sides).seen & ~invisible
    removed_error = float(session.order.errors[: result.report["gone"]].sum())
    predicted = removed_error / session.value_count
    bands = {}
    if result.stays is not None:
        bands = {str(band + 1): int(np.count_nonzero(~result.stays[:, band])) for band in range(result.stays.shape[1])}
    return {
        "target": target.as_json(),
        "splats_before": len(source),
        "splats": len(result.model),
        "removed": {
            "invisible": int(np.count_nonzero(~stays & invisible)),
            "unseen": int(np.count_nonzero(~stays & unseen)),
            "least_error": int(np.count_nonzero(~stays & ~invisible & ~unseen)),
        },
        "unseen_share": float(np.mean(unseen)),
        "views": {
            "used": len(views.used),
            "check": len(views.check),
            "gap_db": round(views.gap, 3),
            "size": [views.used[0].W, views.used[0].H],
        },
        "rounds": [vars(one) for one in session.order.rounds],
        "largest_error_removed": result.threshold,
        "predicted_psnr": -10.0 * math.log10(predicted) if predicted > 0.0 else None,
        "zero_bands": bands,
        "seconds": {stage: round(value, 2) for stage, value in session.seconds.items()},
        **{name: value for name, value in result.report.items() if name != "gone"},
    }
