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
from csplat_render.metrics import PSNR_CAP
from csplat_render.virtual import scene_frame, virtual_cameras
from csplat_tools.simplify.colours import Fitted, fit
from csplat_tools.simplify.judge import Judge, loss_as_psnr, render_pictures
from csplat_tools.simplify.options import SimplifyOptions, Target
from csplat_tools.simplify.order import Order, removal_order
from csplat_tools.simplify.views import Views, find_views

__all__ = ["Session", "Simplified", "find_judge", "most_gone", "prepare", "simplify"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
Progress = Callable[[str, float], None]

_TRIES = 3  # fits on the way to a target PSNR
_BANDS_WORTH = 1.0  # dB that absent SH bands may cost; a fit that loses more has failed
_PSNR_VIEWS = (8, 640, 480)  # those of `psnr`


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
        views: cameras that decide, and others.
        wanted: what the source looks like from the cameras that decide.
        order: of removal.
        checked: judges by views that were not used.
        seconds: by stage.
        inside: virtual views of surroundings decide, which do not stand where cameras do: they may say what is left
            out, but not how precise the rest has to be.
    """

    source: SplatModel
    options: SimplifyOptions
    views: Views
    wanted: list[F32]
    order: Order
    checked: Judge
    seconds: dict[str, float]
    inside: bool

    def pruned(self, gone: int) -> I64:
        """Source splats that are left when the first `gone` of the order are removed."""
        return self.order.kept(len(self.source), gone)

    def threshold(self, gone: int) -> float:
        """The largest error among the first `gone`."""
        return float(self.order.errors[:gone].max(initial=0.0))

    def fitted(self, rows: I64, progress: Progress | None = None) -> Fitted:
        """Fit what is left."""
        return fit(self.source.select(rows), self.views.used, self.wanted, self.options, progress=progress)


def prepare(
    source: SplatModel,
    cameras: Sequence[Camera] | None,
    left: int | None,
    options: SimplifyOptions,
    progress: Progress | None = None,
) -> Session:
    """Choose views, render the source, find the order of removal.

    Args:
        source: the scene.
        cameras: the user's own, or None for virtual ones.
        left: splats that are to stay; None if it is not known yet.
        options: how to go about it.
        progress: is told how much is done.
    """
    seconds = {}
    start = time.perf_counter()
    views = find_views(
        source, cameras, 0.5 if left is None else 1.0 - left / len(source), size=options.view_size, most=options.views,
        seed=options.seed, background=options.background, threads=options.threads, progress=progress,
    )  # fmt: skip
    wanted = render_pictures(source, views.used, background=options.background, threads=options.threads)
    checked = Judge.of_source(source, views.check, options.background, options.threads)
    seconds["views"] = time.perf_counter() - start
    start = time.perf_counter()
    order = removal_order(source, views, options, left, progress)
    seconds["rounds"] = time.perf_counter() - start
    inside = cameras is None and scene_frame(source).kind == "surrounding"
    return Session(source, options, views, wanted, order, checked, seconds, inside)


def simplify(
    source: SplatModel,
    cameras: Sequence[Camera] | None = None,
    *,
    target: Target,
    options: SimplifyOptions | None = None,
    photographs: tuple[Sequence[Camera], Sequence[F32]] | None = None,
    progress: Progress | None = None,
) -> Simplified:
    """Remove splats until a target is met, fit the colours of the others, drop SH bands.

    Args:
        source: the scene.
        cameras: views that matter, relative to the scene's origin; every eighth is kept aside to check by. None for
            virtual ones, as many as it takes.
        target: how many splats stay, or how good the result is to be.
        options: how to go about it.
        photographs: cameras and what was photographed there, [H, W, 3] in 0..1, for a largest loss of PSNR.
        progress: is told the stages.

    Returns:
        The smaller scene; its splats are in the source's order.

    Raises:
        InputError: a scene without splats, fewer than two cameras, or a target that even the source misses.
    """
    options = options or SimplifyOptions()
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    left = None if target.keep is None else target.count(len(source))
    session = prepare(source, cameras, left, options, progress)
    start = time.perf_counter()
    if left is not None:
        gone = min(len(source) - left, len(session.order.rows))
        result = _finished(session, gone, None, progress)
    else:
        judge, goal = find_judge(source, cameras, target, options, session, photographs)
        result = _search(session, judge, goal, progress)
    session.seconds["fit"] = time.perf_counter() - start
    return replace(result, report=_report(session, result, target))


def find_judge(
    source: SplatModel,
    cameras: Sequence[Camera] | None,
    target: Target,
    options: SimplifyOptions,
    session: Session,
    photographs: tuple[Sequence[Camera], Sequence[F32]] | None,
) -> tuple[Judge, float]:
    """Who judges a simplified scene, and the PSNR that is to be reached, 99 where none is asked for.

    Args:
        source: the scene.
        cameras: the user's own, or None.
        target: what is asked for.
        options: background, what the source is taken to reach against photographs.
        session: views that were kept aside judge where the user's own cameras are used.
        photographs: as for `simplify`.
    """
    if target.max_loss is not None and photographs is not None:
        judge = Judge(*photographs, background=options.background, threads=options.threads)
        return judge, judge.psnr(source) - target.max_loss
    goal = PSNR_CAP if target.psnr is None else target.psnr
    if target.max_loss is not None:
        goal = loss_as_psnr(target.max_loss, options.photo_psnr)
    if cameras is not None:
        return session.checked, goal
    return Judge.of_source(source, virtual_cameras(source, *_PSNR_VIEWS), options.background, options.threads), goal


def _finished(session: Session, gone: int, judge: Judge | None, progress: Progress | None) -> Simplified:
    """Remove, fit, and say how good it is."""
    rows, threshold = session.pruned(gone), session.threshold(gone)
    pruned = session.source.select(rows)
    fitted = session.fitted(rows, progress)
    report: dict[str, Any] = {
        "gone": gone,
        "check_psnr_pruned": session.checked.psnr(pruned),
        "check_psnr": session.checked.psnr(fitted.model),
        "fit_errors": [list(errors) for errors in fitted.errors],
    }
    model, stays = fitted.model, fitted.stays
    worth = 0.0 if stays is None else _BANDS_WORTH
    if report["check_psnr"] < report["check_psnr_pruned"] - worth and session.options.refit:
        model, stays = pruned, None  # overfitted: what was not looked at is worse than before
        report["check_psnr"], report["refit_refused"] = report["check_psnr_pruned"], True
    if judge is not None:
        report["psnr_pruned"], report["psnr"] = judge.psnr(pruned), judge.psnr(model)
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
        reached = result.report["psnr"]
        if reached >= goal:
            if best is None or len(result.model) < len(best.model):
                best = result
            lowest = gone
        if gone == 0 or abs(reached - goal) < 0.05:
            break
        gain = reached - result.report["psnr_pruned"] - (0.0 if reached >= goal else goal - reached)
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
    report = {"gone": 0, "check_psnr_pruned": score, "check_psnr": score, "fit_errors": [], "psnr": judge.psnr(source)}
    return Simplified(source, np.arange(len(source)), 0.0, None, report)


def _report(session: Session, result: Simplified, target: Target) -> dict[str, Any]:
    """What was removed and why, what was predicted and what was found."""
    source, views, options = session.source, session.views, session.options
    stays = np.zeros(len(source), bool)
    stays[result.source_index] = True
    invisible = source.opacities < ALPHA_MIN
    unseen = ~views.removal.seen & ~invisible
    removed_error = float(session.order.errors[: result.report["gone"]].sum())
    predicted = removed_error / views.removal.value_count
    bands = {}
    if result.stays is not None:
        bands = {str(band + 1): int(np.count_nonzero(~result.stays[:, band])) for band in range(result.stays.shape[1])}
    return {
        "target": {name: value for name, value in vars(target).items() if value is not None},
        "method": options.method,
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
