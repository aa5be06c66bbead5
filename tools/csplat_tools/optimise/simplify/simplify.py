"""`simplify`: remove what no picture needs, round after round, and fit the colours of the rest."""

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
from csplat_render import Camera
from csplat_render.conventions import ALPHA_MIN
from csplat_render.judge import Judge, renderer
from csplat_render.metrics import PSNR_CAP
from csplat_render.removal import measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.files.extras import need_renderer
from csplat_tools.files.scenes import SceneLike, load_model
from csplat_tools.optimise.simplify.fitting import Fit, fit
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.optimise.simplify.order import Order, Side, removal_order, seen_by
from csplat_tools.optimise.target import Target
from csplat_tools.views import ViewSet, camera_sequence, find_view_set
from csplat_tools.views.agreeing import AgreedViews, find_views

__all__ = ["Session", "Simplified", "find_decider", "most_gone", "prepare", "simplify"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
_TRIES = 3  # fits on the way to a target PSNR
_AGREE_ON = 0.5  # of the splats, at least, where views have to agree: where little goes, fits want as many of them
_BANDS_WORTH = 1.0  # dB that absent SH bands may cost; a fit that loses more has failed


@dataclass(frozen=True, eq=False)
class Simplified:
    """A smaller scene.

    Attributes:
        model: the scene.
        source_index: [N] int64, which splat of the source each one is.
        threshold: the largest error that a removed splat had: what a splat's bits are worth.
        stays: [N, d], which SH bands are not zero; None where bands were not looked at.
        report: what was removed and why, predicted and measured errors, views, seconds; JSON-compatible.
    """

    model: SplatModel
    source_index: I64
    threshold: float
    stays: NDArray[np.bool_] | None
    report: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Session:
    """A source, its views, and in which order its splats go: what several simplifications of one scene share.

    Attributes:
        source: the scene.
        options: how to go about it.
        around: from where it is looked at.
        views: those that teach, and others.
        taught: those that the others are fitted to; virtual ones are as many again at least: a fit follows its views.
        sides: the same in two parts, and what each says of the source; that of views that are given is one.
        wanted: what the source looks like from these.
        order: of removal.
        checked: judges by views that were not used.
        seconds: by stage.
    """

    source: SplatModel
    options: SimplifyOptions
    around: ViewSet
    views: AgreedViews
    taught: list[Camera]
    sides: list[Side]
    wanted: list[F32]
    order: Order
    checked: Judge
    seconds: dict[str, float]

    @property
    def value_count(self) -> int:
        """Pixels times channels of what is taught."""
        return sum(side.removal.value_count for side in self.sides)

    def pruned(self, gone: int) -> I64:
        """Source splats that are left when the first `gone` of the order are removed."""
        return self.order.kept(len(self.source), gone)

    def threshold(self, gone: int) -> float:
        """The largest error among the first `gone`."""
        return float(self.order.errors[:gone].max(initial=0.0))

    def fitted(self, rows: I64, progress: Progress | None = None) -> Fit:
        """Fit what is left."""
        left, deciding = self.source.select(rows), len(self.views.used)
        return fit(left, self.taught, self.wanted, self.options, deciding=deciding, progress=progress)


def prepare(
    source: SplatModel,
    views: ViewSet | None,
    left: int | None,
    options: SimplifyOptions,
    progress: Progress | None = None,
    *,
    allowed: float = math.inf,
) -> Session:
    """Render the source, find the order of removal.

    Args:
        source: the scene.
        views: from where it is looked at; None for virtual views.
        left: splats that are to stay; None if it is not known yet.
        options: how to go about it.
        progress: is told how much is done.
        allowed: mean squared error of the removal of all that may be asked to go, about; the order ends there.
    """
    seconds = {}
    start = time.perf_counter()
    count, size = options.pictures(len(source))
    around = views or find_view_set(source, background=options.background, count=count, size=size, seed=options.seed)
    options = replace(options, background=around.background, view_size=size)
    gone = max(_AGREE_ON, 0.0 if left is None else 1.0 - left / len(source))
    found = find_views(source, around, gone, size=size, threads=options.threads, progress=progress)
    sides = [Side(found.used, found.removal)]
    if around.virtual:
        more = round(len(found.used) * max(1.0, options.work))
        cameras = camera_sequence(source, more, size, seed=options.seed + 1)
        removal = measure_removal(
            source, cameras, background=around.background, bands=False, threads=options.threads, progress=progress
        )
        sides.append(Side(cameras, removal))
    taught = [camera for side in sides for camera in side.cameras]
    wanted = _pictures(source, taught, options)
    checked = Judge.of_source(source, found.check, around.background, threads=options.threads)
    seconds["views"] = time.perf_counter() - start
    start = time.perf_counter()
    values = sum(side.removal.value_count for side in sides)
    order = removal_order(source, sides, options, left, progress, enough=allowed * values)
    seconds["rounds"] = time.perf_counter() - start
    return Session(source, options, around, found, taught, sides, wanted, order, checked, seconds)


def _pictures(source: SplatModel, cameras: Sequence[Camera], options: SimplifyOptions) -> list[F32]:
    """What the source looks like; the renderer's memory ends with it."""
    draw = renderer(source, options.background, threads=options.threads)
    return [draw(camera).rgb for camera in cameras]


def simplify(
    scene: SceneLike,
    *,
    keep: float | None = None,
    psnr: float | None = None,
    loss: float | None = None,
    views: ViewSet | None = None,
    options: SimplifyOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Simplified:
    """Remove splats until a target is met, fit the others, drop SH bands: what `csplat simplify` calls.

    One of `keep`, `psnr` and `loss` is wanted. Wants the packages of the render extra.

    Args:
        scene: a model, or a file of either kind.
        keep: share of the splats that stay, above 0, at most 1.
        psnr: dB against the source's renders by the views that decide, at least; as few splats as that allows stay.
        loss: dB that the PSNR against the photographs of `views` may fall.
        views: what stays is fitted in those that teach; those that decide say how much may go. `None`: virtual ones,
            as many as it takes.
        options: how to go about it.
        progress: is told the stage and the share of it that is done, 0 to 1.

    Returns:
        The smaller scene; its splats are in the source's order.

    Examples:
        >>> import csplat_tools
        >>> half = csplat_tools.simplify("scene.ply", keep=0.5)  # doctest: +SKIP
        >>> len(half.model), half.report["psnr"]  # doctest: +SKIP
        (4464, 39.6)

    Raises:
        InputError: a scene without splats, views that do not teach or decide, or a target that even the source misses.
        CsplatError: the file is none.
        OSError: it cannot be read.
    """
    need_renderer()
    target = Target(psnr, None, loss, keep)
    source = load_model(scene).model
    options = options or SimplifyOptions()
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    if target.max_loss is not None and (views is None or not views.photographs):
        raise InputError("a loss against photographs wants photographs: name a data set")
    left = None if target.keep is None else target.count(len(source))
    session = prepare(source, views, left, options, progress)
    start = time.perf_counter()
    if left is not None:
        gone = min(len(source) - left, len(session.order.rows))
        result = _finished(session, gone, None, progress)
    else:
        result = _search(session, *find_decider(session, target), progress)
    session.seconds["fit"] = time.perf_counter() - start
    return replace(result, report={**_report(session, result, target), **_judged(session, result.model)})


def find_decider(session: Session, target: Target) -> tuple[Judge, float]:
    """Who decides how much may go, and the PSNR that is to be reached, 99 where none is asked for.

    Args:
        session: the views that decide are none of those that judge.
        target: what is asked for.
    """
    around, threads = session.around, session.options.threads
    if target.max_loss is not None:
        decider = around.photograph_decider(threads=threads)
        return decider, decider.psnr(session.source) - target.max_loss
    return around.decider(session.source, threads=threads), PSNR_CAP if target.psnr is None else target.psnr


def _judged(session: Session, model: SplatModel) -> dict[str, Any]:
    """What the views that judge say of the result; nothing where none do."""
    around, threads = session.around, session.options.threads
    if not around.judges:
        return {}
    said: dict[str, Any] = {
        "psnr": around.judge(session.source, threads=threads).psnr(model),
        "judged_by": {"cameras": around.name, "views": len(around.judges)},
    }
    if around.photographs:
        judge = around.photograph_judge(threads=threads)
        said["photographs"] = {"source": judge.psnr(session.source), "psnr": judge.psnr(model)}
    return said


def _finished(session: Session, gone: int, judge: Judge | None, progress: Progress | None) -> Simplified:
    """Remove, fit, and say how good it is."""
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
        model, stays = pruned, None  # overfitted: what was not looked at is worse than before
        report["check_psnr"], report["refit_refused"] = report["check_psnr_pruned"], True
    if judge is not None:
        report["decided_psnr_pruned"], report["decided_psnr"] = judge.psnr(pruned), judge.psnr(model)
    return Simplified(model, rows, threshold, stays, report)


def _search(session: Session, judge: Judge, goal: float, progress: Progress | None) -> Simplified:
    """The fewest splats that reach a PSNR: bisect along the order without a fit, then allow for what a fit gains."""
    if judge.psnr(session.source) < goal:
        raise InputError(f"even the source is below the target of {goal:.2f} dB: its renders are not its pictures")
    best, gain = None, 0.0
    lowest = 0
    for _ in range(_TRIES):
        gone = most_gone(session, judge, goal - gain, lowest)
        result = _finished(session, gone, judge, progress)
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


def most_gone(session: Session, judge: Judge, goal: float, lowest: int = 0) -> int:
    """How many splats may go before the PSNR, without a fit, falls below a goal."""
    low, high = lowest, len(session.order.rows)
    while high - low > max(1, len(session.source) // 200):
        middle = (low + high) // 2
        if judge.psnr(session.source.select(session.pruned(middle))) >= goal:
            low = middle
        else:
            high = middle
    return low


def _unchanged(session: Session, judge: Judge) -> Simplified:
    source = session.source
    score = session.checked.psnr(source)
    report = {"gone": 0, "check_psnr_pruned": score, "check_psnr": score}
    report["decided_psnr"] = judge.psnr(source)
    return Simplified(source, np.arange(len(source)), 0.0, None, report)


def _report(session: Session, result: Simplified, target: Target) -> dict[str, Any]:
    """What was removed and why, what was predicted and what was found."""
    source, views = session.source, session.views
    stays = np.zeros(len(source), bool)
    stays[result.source_index] = True
    invisible = source.opacities < ALPHA_MIN
    unseen = ~seen_by(session.sides).seen & ~invisible
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
