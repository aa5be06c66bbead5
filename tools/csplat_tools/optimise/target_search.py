"""Search for the smallest file at a PSNR or a loss, or the best one within a size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_render.metrics import PSNR_CAP, psnr_of_mse
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import scene_frame
from csplat_tools.optimise.candidates import Candidate, CandidatePool, CodingChoice, Weights, WholeScene
from csplat_tools.optimise.precision_search import TUNING_GAINS, PrecisionSearch, SearchGoal, clip_quality
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.rate_distortion import BYTES_PER_DB, error_of_psnr
from csplat_tools.optimise.scene_sensitivity import complete_importance
from csplat_tools.optimise.search_report import SearchReport, make_report
from csplat_tools.optimise.sh_codings import CodingSearch
from csplat_tools.optimise.subsets import Pruner
from csplat_tools.optimise.targets import Target
from csplat_tools.views import VIRTUAL, ViewSet, extra_test_cameras, with_validation_views
from csplat_tools.views.view_sets import render_seconds

#: Cost of a target in renders of 640x480: without pruning (measured 380 to 690 with plane3, donut, lego60k, fox120k),
#: and with it, a fixed part and one that grows with the effort (plane3 at 40 dB, effort 1, 3 and 7: as 0.6 to 1 to 4).
_RENDERS = 520.0
_RENDERS_WITH_PRUNING = (600.0, 2400.0)
_INSIDE_REMARK = (
    "virtual views decided which splats go: cameras inside of surroundings may see more of those than these do;"
    " --data, or --cameras with 40 of them, would decide by yours, --no-prune leaves all"
)


def search_target(
    source: SplatModel,
    target: Target,
    views: ViewSet,
    encoding: EncodeOptions,
    *,
    no_prune: bool,
    importance: Weights | None,
    simplifying: SimplifyOptions | None,
    progress: Progress | None,
) -> tuple[Candidate, SearchReport]:
    """Search for the file that meets a target, by rendering candidates. The report has no seconds yet.

    Args:
        source: the scene.
        target: the target, which must not be largest errors alone.
        views: training, validation and test views; they do not overlap.
        encoding, no_prune, importance, simplifying, progress: as for `encode_to`.

    Raises:
        InputError: the target is out of reach, no splat shows, or a loss is requested without photographs.
    """
    views = with_validation_views(views)
    judge = views.test_scorer(source, threads=encoding.threads)
    if views.name != VIRTUAL and _is_empty(judge):
        raise InputError("no splat shows in the views given: are these cameras of this scene?")
    inside = views.virtual and scene_frame(source).kind == "surrounding"
    removal = None
    if not _keeps_all(target, encoding, no_prune=no_prune):
        how = replace(simplifying or SimplifyOptions(), background=views.background, threads=encoding.threads)
        left = None if target.keep is None else target.count(len(source))
        removal = Pruner(
            source, views, how, grades=not inside, progress=progress, psnr=target.psnr, left=left
        )  # fmt: skip
    photographs = None
    if target.max_psnr_drop is not None:
        if not views.photographs:
            raise InputError("a largest loss wants photographs (--data): it is lost against them")
        photographs = views.photograph_validation_scorer(threads=encoding.threads)
    validation_scorer = views.validation_scorer(source, threads=encoding.threads)
    trials, sensitivity_views = CandidatePool(encoding, judge, validation_scorer, photographs, progress=progress), 0
    if removal is not None and removal.left is not None:
        found = TargetSearch.kept(trials, removal, removal.left)
    else:
        goal = find_goal(target, source, photographs)
        measured, sensitivity_views = complete_importance(
            source, views, encoding, importance, inside=inside, progress=progress
        )
        whole = WholeScene(source, importance, measured, progress)
        found = TargetSearch(
            PrecisionSearch(trials, goal), CodingSearch(source, encoding, measured is not None), whole, removal
        ).best()
    photo = _photograph_psnr(source, found, views, encoding.threads) if views.photographs else {}
    report = make_report(
        target, found, trials, splats_before=len(source), views_of=views.name,
        remarks=[_INSIDE_REMARK] * (inside and found.splats < len(source)), encodes=len(trials.made), seconds=0.0,
        photographs=photo, sensitivity_views=sensitivity_views,
        removal_views=0 if removal is None else removal.view_count,
        elsewhere=_psnr_elsewhere(source, found, views, encoding.threads),
        reached={name: found.result.report.errors.get(name, (0.0, 0.0))[0] for name in target.max_error},
    )  # fmt: skip
    return found, report


def expected_seconds(
    source: SplatModel,
    encoding: EncodeOptions,
    target: Target,
    views: ViewSet,
    *,
    no_prune: bool,
    simplifying: SimplifyOptions | None = None,
) -> float:
    """Estimate the seconds that a target takes on this machine.

    Renders some test views to measure their time: the search costs about a fixed number of such renders on any machine.
    """
    pictures = expected_renders(encoding, target, no_prune=no_prune, simplifying=simplifying)
    return pictures * render_seconds(source, views.test, threads=encoding.threads)


def expected_renders(
    encoding: EncodeOptions, target: Target, *, no_prune: bool, simplifying: SimplifyOptions | None = None
) -> float:
    """Return the approximate cost of a target as a number of renders of the test views."""
    if _keeps_all(target, encoding, no_prune=no_prune):
        return _RENDERS
    return _RENDERS_WITH_PRUNING[0] + _RENDERS_WITH_PRUNING[1] * (simplifying or SimplifyOptions()).work


def _keeps_all(target: Target, encoding: EncodeOptions, *, no_prune: bool) -> bool:
    """Return True if no splat may be pruned: by `no_prune`, bounded errors, extra columns, or the preset `fast`."""
    blocked = no_prune or bool(target.max_error) or encoding.preset == "fast" or encoding.keep_extra
    return target.keep is None and blocked


def check_target(source: SplatModel, target: Target, encoding: EncodeOptions, *, no_prune: bool) -> None:
    """Refuse targets that no search can meet.

    Raises:
        InputError: there are no splats, or the target contradicts an option.
    """
    if not len(source):
        raise InputError("a scene without splats has no size or quality to choose")
    if encoding.attribute_psnr is not None and target.is_rendered and target.keep is None:
        raise InputError("attribute_psnr is what a target chooses: give one of them")
    if target.keep is not None and no_prune:
        raise InputError("a share of the splats is to stay, and all of them: give one of the two")


def _is_empty(judge: Scorer) -> bool:
    """Return True if every test image has a single colour."""
    pictures = (judge.reference(number).rgb for number in range(len(judge.cameras)))
    return all(np.ptp(picture, axis=(0, 1)).max() == 0.0 for picture in pictures)


def _psnr_elsewhere(source: SplatModel, found: Candidate, views: ViewSet, threads: int | None) -> dict[str, float]:
    """Return the PSNR from views that had no part in the search, by kind."""
    model, judged = decode(found.result.data), extra_test_cameras(source).items()
    return {
        kind: round(Scorer.of_source(source, cameras, views.background, threads=threads).psnr(model), 3)
        for kind, cameras in judged
    }


def _photograph_psnr(source: SplatModel, found: Candidate, views: ViewSet, threads: int | None) -> dict[str, float]:
    """Return the PSNR of file and source against the test photographs, dB."""
    judge = views.photograph_test_scorer(threads=threads)
    return {"file": judge.psnr(decode(found.result.data)), "source": judge.psnr(source)}


def find_goal(target: Target, source: SplatModel, photographs: Scorer | None) -> SearchGoal:
    """Return the goal of the search for a target.

    Args:
        target: a PSNR, a size or a loss.
        source: the scene.
        photographs: the scorer by validation photographs, against which a loss is measured.
    """
    if target.max_psnr_drop is None or photographs is None:
        return SearchGoal(target.psnr, target.size_bytes, max_error=target.max_error)
    reached = photographs.psnr(source)
    # The source's error against photographs is far larger than the loss: a file's own error is a small part of the sum.
    slope = 1.0 - 10.0 ** (-target.max_psnr_drop / 10.0)
    return SearchGoal(
        min(loss_as_psnr(target.max_psnr_drop, reached), PSNR_CAP), None, reached - target.max_psnr_drop, slope
    )


def loss_as_psnr(loss: float, photo_psnr: float) -> float:
    """Return the PSNR against the source's renders at which the PSNR against photographs falls by a loss.

    The source has an error of its own against photographs; the error that a file adds is taken as independent of it,
    so that the two squared errors add up.

    Args:
        loss: dB, above 0.
        photo_psnr: PSNR of the source against photographs, dB.
    """
    return photo_psnr - 10.0 * math.log10(10.0 ** (loss / 10.0) - 1.0)


_ATTRIBUTE_GAIN = (5.0, 8.5)  # dB from the PSNR of all attributes to that of each alone, at 30 dB, without and with SH
_ATTRIBUTE_GAIN_GROWS = (0.0, 0.22)  # dB that this grows with every dB above 30, without and with SH
_USUAL = (7.0, 42.0)  # usual bytes per splat, and the PSNR of each attribute in such files
_COUNTS = 3  # numbers of splats for which a fit is made; up to twice as many until there is a file
_WORTH = 0.02  # fraction of the bytes: a number of splats that is predicted to save less is not worth a fit
_CLOSE = 0.04  # fraction of the splats: a number that differs less from one that was tried is not worth a fit
_SPARE = 0.7  # dB above the goal: a fit whose PSNR is lower leaves too little of the error to quantisation
_FEWER = 0.7  # factor from one number of splats to a smaller one if none of its files fits the size
_ALL_BUT = 0.02  # fraction of the splats: pruning fewer is not worth a fit
_LEAST_LEFT = 0.15  # fraction of the allowed error that is at least left to quantisation
_WITHIN_REACH = 0.1  # fraction of the bytes that another coding may save
_PAYS = 0.01  # fraction of the bytes: a file that is expected to take this much more may turn out smaller
_PAYS_DEARLY = 0.03  # fraction of the bytes that pruned splats have to promise: their files take a fit each
_COMMON = 0.1  # fraction of the bytes: largest excess of one refitted file that is expected of the others, too
_FAR = 0.03  # fraction of the bytes: presets are not tried if files of all splats cost this much more than the best
_BANDS_GROW = (34.0, 0.055)  # dB above which splats with SH are cheaper to keep, and by which fraction per dB
_PRESETS = (-1.0, 2.5)  # dB above the goal: presets whose own files are expected in this range are tried


@dataclass(eq=False)
class TargetSearch:
    """The search for the coding, the splats and the precision.

    Attributes:
        solver: brings files near the goal, and onto it.
        codings: the possible codings of SH.
        whole: all splats.
        removal: prunes splats; `None`: all are kept.
    """

    solver: PrecisionSearch
    codings: CodingSearch
    whole: WholeScene
    removal: Pruner | None

    @staticmethod
    def kept(trials: CandidatePool, removal: Pruner, left: int) -> Candidate:
        """Return the file of `left` splats at the precision of the options."""
        part = removal.fitted(left, None, trials.validation_scorer.psnr)
        return trials.make(part, CodingChoice(None), None, quick=False)

    def best(self) -> Candidate:
        """Return the smallest file that meets a PSNR or a loss, or the best one of a size.

        Raises:
            InputError: no file meets the goal.
        """
        tried = self.codings.best(self.solver, self.whole, self._start(), brief=self.removal is not None)
        if self.removal is not None:
            if self.solver.goal.is_judged:
                tried[0].let_judge()
            cost, fitted = self.solver.cost, self._removed(self.removal, tried[0])
            if cost(tried[0]) < min(map(cost, fitted), default=math.inf) + _WITHIN_REACH:
                tried = self.codings.best(self.solver, self.whole, tried[0].quality or 0.0)
            tried += fitted
        found = self._on_goal(tried)
        if found:
            self.solver.try_beside(min(found, key=lambda trial: trial.size_bytes))
        self._presets(tried)
        best = self.solver.goal.best([trial for trial in self.solver.trials.made if self._may_be_written(trial)])
        if best is None:
            raise InputError(self._out_of_reach())
        return best

    def _on_goal(self, tried: Sequence[Candidate]) -> list[Candidate]:
        """Return files that meet the goal, made from the most promising; with more splats if all tried were too few."""
        found, failed, dearer = list[Candidate](), list[Candidate](), 0.0
        for trial in sorted(tried, key=self.solver.cost):
            others = [one for one in tried if one.part.refits and one.splats > trial.splats]
            if any(one.part is trial.part for one in failed) and others:
                continue  # files of more splats come first
            if self._pays(trial, found, dearer):
                expected, on = self.solver.cost(trial), self.solver.on(trial.part, trial.coding)
                if on is not None and trial.part.refits:
                    dearer = max(dearer, min(math.log(on.size_bytes) - expected, _COMMON))
                (failed if on is None else found).append(on or trial)
        if failed and not any(one.part.refits for one in found):
            on = self._of_more(max(failed, key=lambda trial: trial.splats))
            found += [] if on is None else [on]
        return found

    def _may_be_written(self, trial: Candidate) -> bool:
        """Return True if a file is no draft and, if the goal is measured on the test views, has been scored on them."""
        return trial.is_packed and (trial.is_judged or not self.solver.goal.is_judged)

    def _start(self) -> float:
        """Return the PSNR of each attribute for the first file, dB."""
        goal, has_sh = self.solver.goal, self.codings.usual(self.whole) != [CodingChoice("none")]
        if goal.size_bytes is None:
            psnr = goal.psnr or 0.0
            return clip_quality(psnr + _ATTRIBUTE_GAIN[has_sh] + _ATTRIBUTE_GAIN_GROWS[has_sh] * (psnr - 30.0))
        per_splat = goal.size_bytes / len(self.whole.model)
        return clip_quality(_USUAL[1] + math.log(per_splat / _USUAL[0]) / BYTES_PER_DB)

    def _removed(self, removal: Pruner, whole: Candidate) -> list[Candidate]:
        """Return files near the goal for several numbers of splats, each predicted from the files before."""
        solver, goal, splats = self.solver, self.solver.goal, len(self.whole.model)
        slope, found, seen = self._slope_of_counts(whole), list[Candidate](), solver.trials.validation_scorer.psnr
        allowed = None if goal.psnr is None else solver.level(self.whole)
        left = self._first_left(removal, whole, slope)
        start = (whole.quality or 0.0) - solver.about(whole) - TUNING_GAINS
        for number in range(2 * _COUNTS):
            if number >= _COUNTS and found:
                break
            if left > (1.0 - _ALL_BUT) * splats:
                if found or removal.options.is_brief:
                    break
                left = splats  # all splats: they are still refitted through the quantisers of their files
            part = removal.fitted(left, allowed, seen)
            if allowed is not None and part.fitted_psnr < allowed + _SPARE:
                if found:
                    break
                left, _ = removal.next_at_psnr(len(part.rows), part.fitted_psnr, allowed, slope)
                continue
            if solver.is_hopeless(part):
                left = _next_larger(left)
                continue
            quality = start if goal.psnr is None else _raised_quality(start, goal.psnr, part.psnr)
            tries = self.codings.best(solver, part, quality, brief=removal.options.is_brief)
            trial = tries[0]
            found += tries
            if left == splats or removal.options.is_brief:
                break
            if math.isinf(solver.cost(trial)):
                # None of them is small enough for a size, or good enough for a PSNR.
                if goal.size_bytes is None:
                    left = _next_larger(left)
                elif len(part.rows) > left or left == 1:
                    break  # no more splats can be pruned: no view saw the others
                else:
                    left = int(left * _FEWER)
                continue
            if goal.psnr is not None:
                # The error of bands that are left out does not depend on the number of splats.
                allowed = solver.level(part)
                wanted = _subtracted(allowed, error_of_psnr(part.psnr) - error_of_psnr(part.fitted_psnr))
                left, saved = removal.next_at_psnr(len(part.rows), part.fitted_psnr, wanted, slope)
            else:
                left, saved = removal.next_at_size(len(part.rows), part.fitted_psnr, trial.decided_psnr, slope)
            saved -= solver.cost(trial) - min(map(solver.cost, found))
            if saved < _WORTH or any(abs(one.splats - left) < _CLOSE * left for one in found):
                break
        return found

    def _slope_of_counts(self, whole: Candidate) -> float:
        """Return the fraction of the bytes that a decibel costs, for the choice of the number of splats.

        The more SH a file needs, the fewer bytes the next splat takes compared with more important ones: it has fewer
        bands.
        """
        above = (self.solver.goal.psnr or whole.decided_psnr) - _BANDS_GROW[0]
        has_sh = whole.coding.sh != "none"
        return self.solver.slope(whole) * (1.0 + _BANDS_GROW[1] * max(above, 0.0) * has_sh)

    def _of_more(self, trial: Candidate) -> Candidate | None:
        """Return a file that meets the goal with more splats than a trial that cannot; `None` if there is none."""
        left = _next_larger(trial.splats)
        all_stay = trial.part is self.whole or left > (1.0 - _ALL_BUT) * len(self.whole.model)
        if self.removal is None or self.solver.goal.psnr is None or all_stay:
            return None
        part = self.removal.fitted(left, self.solver.level(self.whole), self.solver.trials.validation_scorer.psnr)
        best = self.codings.best(self.solver, part, trial.quality or 0.0)[0]
        return self.solver.on(best.part, best.coding)

    def _first_left(self, removal: Pruner, whole: Candidate, slope: float) -> int:
        """Return the number of splats to begin with."""
        goal, seen = self.solver.goal, self.solver.trials.validation_scorer.psnr
        if goal.psnr is not None:
            return removal.first_at_psnr(goal.psnr, slope, seen)
        near = None if math.isinf(self.solver.cost(whole)) else (whole.splats, whole.decided_psnr)
        return removal.first_at_size(goal.size_bytes or 0, near, slope, seen)

    def _pays(self, trial: Candidate, found: list[Candidate], dearer: float) -> bool:
        """Return True if a file near the goal is worth bringing onto it.

        Args:
            trial: the file.
            found: files that meet the goal already.
            dearer: logarithm by which a refitted file among them exceeded its expected cost.
        """
        best = self.solver.goal.best(found)
        if best is None:
            return True
        again = any(one.part is trial.part for one in found)
        # A file that meets a PSNR costs its bytes, even if fewer were predicted.
        known = math.log(best.size_bytes) if self.solver.goal.size_bytes is None else self.solver.cost(best)
        saved = known - self.solver.cost(trial) - dearer * trial.part.refits
        return saved > (_PAYS_DEARLY if trial.part.refits else _PAYS if again else -_PAYS)

    def _presets(self, tried: Sequence[Candidate]) -> None:
        """Make the presets' own files if they are expected near the goal: a search must not be worse than a preset."""
        goal, plain = self.solver.goal, [trial for trial in tried if trial.part is self.whole]
        if not goal.is_judged:
            return
        near = min(plain, key=lambda trial: (trial.coding.graded, self.solver.cost(trial)))
        if self.solver.cost(near) > min(map(self.solver.cost, tried)) + _FAR:
            return  # presets keep all splats in one class, too
        lost = (near.quality or 0.0) - self.solver.about(near)
        for name, preset in PRESETS.items():
            expected = preset.quality[near.coding.sh == "none"] - lost
            if _may_try_preset(name, self.codings.encoding.preset) and _PRESETS[0] <= expected <= _PRESETS[1]:
                encoding = replace(self.codings.encoding, preset=name)
                plainly = CodingChoice(None, graded=False)
                self.solver.trials.make(self.whole, plainly, None, quick=False, encoding=encoding).let_judge()

    def _out_of_reach(self) -> str:
        goal, made = self.solver.goal, self.solver.trials.made
        if goal.size_bytes is not None:
            kept = " with all splats" if self.removal is None else ""
            smallest = min(trial.size_bytes for trial in made)
            return f"no file{kept} has {goal.size_bytes} bytes or fewer: of those tried one has {smallest}"
        if goal.photo_psnr is not None:
            nearest = max(trial.photo_psnr for trial in made)
            return (
                f"no file reaches {goal.photo_psnr:.2f} dB by the photographs that decide; the best has {nearest:.2f}"
            )
        highest = max(trial.psnr for trial in made if trial.is_judged)
        return f"no file reaches {goal.psnr or 0.0:.2f} dB; the best of those tried has {highest:.2f} dB"


def _may_try_preset(name: str, preset: str) -> bool:
    """Return True if a search with a preset may use another preset's file: `fast` only if it is the one requested."""
    return name == preset if "fast" in (name, preset) else True


def _next_larger(splats: int) -> int:
    """Return the next larger number of splats to try."""
    return math.ceil(splats / _FEWER)


def _subtracted(psnr: float, error: float) -> float:
    """Return the PSNR of the error that remains of a PSNR's allowance after another error is subtracted."""
    allowed = error_of_psnr(psnr)
    return psnr_of_mse(max(allowed - max(error, 0.0), _LEAST_LEFT * allowed))


def _raised_quality(quality: float, psnr: float, fitted_psnr: float) -> float:
    """Return the PSNR of each attribute, raised because pruning has taken its part of the error already."""
    left = max(_LEAST_LEFT, 1.0 - error_of_psnr(fitted_psnr) / error_of_psnr(psnr))
    return clip_quality(quality + psnr_of_mse(left))
