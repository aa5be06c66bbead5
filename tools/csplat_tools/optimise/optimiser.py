"""`optimise`: the smallest file at a PSNR or a loss, or the best one within a size.

The search chooses the precision, from which all steps follow; the SH bands and their coding; quantisation classes; and
the number of splats, which are refitted to renders of the source after pruning. Every kind of file is brought near the
goal by a few tries, and compared by its expected cost there; the best are brought onto the goal, and compared with the
presets' own files. Nothing is tried that is not expected to pay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from csplat.decoder import decode
from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import scene_frame
from csplat_tools.optimise.bounds import Weights
from csplat_tools.optimise.coding import Codings
from csplat_tools.optimise.goals import goal_of
from csplat_tools.optimise.moves import Moves
from csplat_tools.optimise.removal import Removal
from csplat_tools.optimise.report import Report
from csplat_tools.optimise.reporting import reported
from csplat_tools.optimise.sensitivity import measured_for
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.optimise.solving import Solver
from csplat_tools.optimise.target import Target
from csplat_tools.optimise.trials import Trial, Trials, Whole
from csplat_tools.views import VIRTUAL, ViewSet, elsewhere, with_deciders
from csplat_tools.views.timing import picture_seconds

#: Cost of a target in renders of 640x480: without pruning (measured 380 to 690 with plane3, donut, lego60k, fox120k),
#: and with it, a fixed part and one that grows with the effort (plane3 at 40 dB, effort 1, 3 and 7: as 0.6 to 1 to 4).
_PICTURES = 520.0
_PICTURES_OF_FEWER = (600.0, 2400.0)
_INSIDE = (
    "virtual views decided which splats go: cameras inside of surroundings may see more of those than these do;"
    " --data, or --cameras with 40 of them, would decide by yours, --keep-all leaves all"
)


def optimise(
    source: SplatModel,
    target: Target,
    views: ViewSet,
    encoding: EncodeOptions,
    *,
    keep_all: bool,
    importance: Weights | None,
    simplifying: SimplifyOptions | None,
    progress: Progress | None,
) -> tuple[Trial, Report]:
    """Search for the file that meets a target, by rendering candidates. The report has no seconds yet.

    Args:
        source: the scene.
        target: the target, which must not be largest errors alone.
        views: training, validation and test views; they do not overlap.
        encoding, keep_all, importance, simplifying, progress: as for `encode_to`.

    Raises:
        InputError: the target is out of reach, no splat shows, or a loss is requested without photographs.
    """
    views = with_deciders(views)
    judge = views.judge(source, threads=encoding.threads)
    if views.name != VIRTUAL and _is_empty(judge):
        raise InputError("no splat shows in the views given: are these cameras of this scene?")
    inside = views.virtual and scene_frame(source).kind == "surrounding"
    removal = None
    if not _all_stay(target, encoding, keep_all=keep_all):
        how = replace(simplifying or SimplifyOptions(), background=views.background, threads=encoding.threads)
        left = None if target.keep is None else target.count(len(source))
        removal = Removal(
            source, views, how, grades=not inside, progress=progress, psnr=target.psnr, left=left
        )  # fmt: skip
    photographs = None
    if target.max_loss is not None:
        if not views.photographs:
            raise InputError("a largest loss wants photographs (--data): it is lost against them")
        photographs = views.photograph_decider(threads=encoding.threads)
    decider = views.decider(source, threads=encoding.threads)
    trials, sensitivity_views = Trials(encoding, judge, decider, photographs, progress=progress), 0
    if removal is not None and removal.left is not None:
        found = Moves.kept(trials, removal, removal.left)
    else:
        goal = goal_of(target, source, photographs)
        measured, sensitivity_views = measured_for(
            source, views, encoding, importance, inside=inside, progress=progress
        )
        whole = Whole(source, importance, measured, progress)
        found = Moves(Solver(trials, goal), Codings(source, encoding, measured is not None), whole, removal).best()
    photo = _photographed(source, found, views, encoding.threads) if views.photographs else {}
    report = reported(
        target, found, trials, splats_before=len(source), views_of=views.name,
        remarks=[_INSIDE] * (inside and found.splats < len(source)), encodes=len(trials.made), seconds=0.0,
        photographs=photo, sensitivity_views=sensitivity_views,
        removal_views=0 if removal is None else removal.view_count,
        elsewhere=_seen_elsewhere(source, found, views, encoding.threads),
        reached={name: found.result.report.errors.get(name, (0.0, 0.0))[0] for name in target.max_error},
    )  # fmt: skip
    return found, report


def expected_seconds(
    source: SplatModel,
    encoding: EncodeOptions,
    target: Target,
    views: ViewSet,
    *,
    keep_all: bool,
    simplifying: SimplifyOptions | None = None,
) -> float:
    """Estimate the seconds that a target takes on this machine.

    Renders some test views to measure their time: the search costs about a fixed number of such renders on any machine.
    """
    pictures = expected_pictures(encoding, target, keep_all=keep_all, simplifying=simplifying)
    return pictures * picture_seconds(source, views.judges, threads=encoding.threads)


def expected_pictures(
    encoding: EncodeOptions, target: Target, *, keep_all: bool, simplifying: SimplifyOptions | None = None
) -> float:
    """Return the approximate cost of a target as a number of renders of the test views."""
    if _all_stay(target, encoding, keep_all=keep_all):
        return _PICTURES
    return _PICTURES_OF_FEWER[0] + _PICTURES_OF_FEWER[1] * (simplifying or SimplifyOptions()).work


def _all_stay(target: Target, encoding: EncodeOptions, *, keep_all: bool) -> bool:
    """Return True if no splat may be pruned: by `keep_all`, bounded errors, extra columns, or the preset `fast`."""
    blocked = keep_all or bool(target.max_error) or encoding.preset == "fast" or encoding.keep_extra
    return target.keep is None and blocked


def check(source: SplatModel, target: Target, encoding: EncodeOptions, *, keep_all: bool) -> None:
    """Refuse targets that no search can meet.

    Raises:
        InputError: there are no splats, or the target contradicts an option.
    """
    if not len(source):
        raise InputError("a scene without splats has no size or quality to choose")
    if encoding.attribute_psnr is not None and target.is_rendered and target.keep is None:
        raise InputError("attribute_psnr is what a target chooses: give one of them")
    if target.keep is not None and keep_all:
        raise InputError("a share of the splats is to stay, and all of them: give one of the two")


def _is_empty(judge: Scorer) -> bool:
    """Return True if every test image has a single colour."""
    pictures = (judge.look(number).picture for number in range(len(judge.cameras)))
    return all(np.ptp(picture, axis=(0, 1)).max() == 0.0 for picture in pictures)


def _seen_elsewhere(source: SplatModel, found: Trial, views: ViewSet, threads: int | None) -> dict[str, float]:
    """Return the PSNR from views that had no part in the search, by kind."""
    model, judged = decode(found.result.data), elsewhere(source).items()
    return {
        kind: round(Scorer.of_source(source, cameras, views.background, threads=threads).psnr(model), 3)
        for kind, cameras in judged
    }


def _photographed(source: SplatModel, found: Trial, views: ViewSet, threads: int | None) -> dict[str, float]:
    """Return the PSNR of file and source against the test photographs, dB."""
    judge = views.photograph_judge(threads=threads)
    return {"file": judge.psnr(decode(found.result.data)), "source": judge.psnr(source)}
