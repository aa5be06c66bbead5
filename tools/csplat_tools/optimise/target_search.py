"""Search for the smallest file at a PSNR or a loss, or the best one within a size.

The search chooses the precision, which determines all steps; the SH bands and their coding; quantisation classes; and
the number of splats, which are refitted to renders of the source after pruning. A few candidates of each kind are made
near the goal, and kinds are compared by their expected cost there. For the best kinds candidates exactly on the goal
are made, and compared with the presets' own files. Candidates that are not expected to pay are not made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions, SearchReport, Target
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import PSNR_CAP, Progress
from csplat_render.metrics import psnr_of_mse
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_tools.optimise.candidates import Candidate, CandidatePool, CodingChoice, Weights, WholeScene
from csplat_tools.optimise.precision_search import REFIT_GAIN, PrecisionSearch, SearchGoal, clip_quality
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.rate_distortion import BYTES_PER_DB, error_of_psnr
from csplat_tools.optimise.scene_sensitivity import complete_importance
from csplat_tools.optimise.search_report import make_report
from csplat_tools.optimise.sh_codings import CodingSearch
from csplat_tools.optimise.subsets import Pruner
from csplat_tools.views import VIRTUAL, ViewSet, extra_test_cameras, with_validation_views
from csplat_tools.views.view_sets import render_seconds

#: Cost of a target in renders of 640x480. Without pruning, measured 380 to 690 with plane3, donut, lego60k, fox120k.
#: With pruning, a fixed part, and one that grows with the effort (plane3 at 40 dB, effort 1, 3 and 7: 0.6 to 1 to 4).
_RENDERS = 520.0
_RENDERS_WITH_PRUNING = (600.0, 2400.0)
_ATTRIBUTE_GAIN = (5.0, 8.5)  # dB from the PSNR of all attributes to that of one alone, at 30 dB, without and with SH
_ATTRIBUTE_GAIN_GROWS = (0.0, 0.22)  # increase of this gain per dB above 30, without and with SH
_USUAL = (7.0, 42.0)  # usual bytes per splat, and the attribute PSNR of such files, dB
_COUNTS = 3  # splat counts to refit; twice this number if none has a file yet
_WORTH = 0.02  # fraction of file size; a splat count predicted to save less is not refitted
_CLOSE = 0.04  # fraction of the splats; a splat count closer to one that was tried is not refitted
_SPARE = 0.7  # dB above the goal; a refit of lower PSNR leaves too little of the error to quantisation
_FEWER = 0.7  # factor from one splat count to the next if none of its files fits the size
_ALL_BUT = 0.02  # fraction of the splats; pruning fewer does not pay
_LEAST_REST = 0.15  # least fraction of the allowed error that is left to quantisation
_WITHIN_REACH = 0.1  # fraction of file size that another coding may save
_PAYS = 0.01  # fraction of file size; a candidate expected to be larger by less may turn out smaller
_PAYS_FOR_REFIT = 0.03  # fraction of file size that pruned candidates must promise, since each takes a refit
_COMMON = 0.1  # fraction of file size; largest excess of one refitted file that is assumed for others
_FAR = 0.03  # fraction of file size; presets are not tried if candidates of all splats exceed the best by more
_BANDS_GROW = (34.0, 0.055)  # dB above which splats with SH become cheaper to keep, and the fraction per dB
_PRESETS = (-1.0, 2.5)  # dB above the goal; presets whose own files are expected in this range are tried
_INSIDE_REMARK = (
    "splats were pruned by virtual views, which may show less than cameras inside of the surroundings do:"
    " use --data, or --cameras with at least 40 cameras, or keep all splats with --no-prune"
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
    """Search for the file that meets a target, by rendering candidates.

    Args:
        source: the scene.
        target: the target, other than largest errors alone.
        views: training, validation and test views.
        encoding, no_prune, importance, simplifying, progress: as for `meet_target`.

    Returns:
        The file, and the report with 0 seconds.

    Raises:
        InputError: the target is out of reach, no splat is visible, or a drop of PSNR is requested without images.
    """
    views = with_validation_views(views)
    test_scorer = views.test_scorer(source, threads=encoding.threads)
    if views.name != VIRTUAL and _is_empty(test_scorer):
        raise InputError("no splat is visible in the given views: check that the cameras belong to the scene")
    inside = views.virtual and scene_frame(source).kind == "surrounding"
    pruner = None
    if not _keeps_all(target, encoding, no_prune=no_prune):
        how = replace(simplifying or SimplifyOptions(), background=views.background, threads=encoding.threads)
        kept_count = None if target.keep is None else target.count(len(source))
        pruner = Pruner(
            source, views, how, use_classes=not inside, progress=progress, psnr=target.psnr, kept_count=kept_count
        )  # fmt: skip
    image_scorer = None
    if target.max_psnr_drop is not None:
        if not views.images:
            raise InputError("a largest drop of PSNR requires images (--data), against which it is measured")
        image_scorer = views.image_validation_scorer(threads=encoding.threads)
    validation_scorer = views.validation_scorer(source, threads=encoding.threads)
    candidates = CandidatePool(encoding, test_scorer, validation_scorer, image_scorer, progress=progress)
    sensitivity_views = 0
    if pruner is not None and pruner.kept_count is not None:
        subset = pruner.refit(pruner.kept_count, None, validation_scorer.psnr)
        found = candidates.make(subset, CodingChoice(None), None, quick=False)
    else:
        goal = find_goal(target, source, image_scorer)
        measured, sensitivity_views = complete_importance(
            source, views, encoding, importance, inside=inside, progress=progress
        )
        whole = WholeScene(source, importance, measured, progress)
        found = TargetSearch(
            PrecisionSearch(candidates, goal), CodingSearch(source, encoding, measured is not None), whole, pruner
        ).best()
    photo = _image_psnr(source, found, views, encoding.threads) if views.images else {}
    report = make_report(
        target, found, candidates, splats_before=len(source), views_of=views.name,
        remarks=[_INSIDE_REMARK] * (inside and found.splats < len(source)), encodes=len(candidates.made), seconds=0.0,
        photographs=photo, sensitivity_views=sensitivity_views,
        removal_views=0 if pruner is None else pruner.view_count,
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
    """Estimate the seconds for a target on this machine, from the time of some renders of test views."""
    renders = expected_renders(encoding, target, no_prune=no_prune, simplifying=simplifying)
    return renders * render_seconds(source, views.test, threads=encoding.threads)


def expected_renders(
    encoding: EncodeOptions, target: Target, *, no_prune: bool, simplifying: SimplifyOptions | None = None
) -> float:
    """Return the approximate cost of a target in renders of the test views."""
    if _keeps_all(target, encoding, no_prune=no_prune):
        return _RENDERS
    return _RENDERS_WITH_PRUNING[0] + _RENDERS_WITH_PRUNING[1] * (simplifying or SimplifyOptions()).work


def _keeps_all(target: Target, encoding: EncodeOptions, *, no_prune: bool) -> bool:
    """Return True if no splat may be pruned, due to `no_prune`, error bounds, extra columns or the preset `fast`."""
    blocked = no_prune or bool(target.max_error) or encoding.preset == "fast" or encoding.keep_extra
    return target.keep is None and blocked


def check_target(source: SplatModel, target: Target, encoding: EncodeOptions, *, no_prune: bool) -> None:
    """Refuse targets that no search can meet.

    Raises:
        InputError: there are no splats, or the target contradicts an option.
    """
    if not len(source):
        raise InputError("a scene without splats cannot be encoded to a target")
    if encoding.attribute_psnr is not None and target.is_rendered and target.keep is None:
        raise InputError("attribute_psnr is chosen by the target: give only one of them")
    if target.keep is not None and no_prune:
        raise InputError("a kept fraction and no_prune exclude each other")


def _is_empty(scorer: Scorer) -> bool:
    """Return True if every test image has a single colour."""
    images = (scorer.reference(number).rgb for number in range(len(scorer.cameras)))
    return all(np.ptp(image, axis=(0, 1)).max() == 0.0 for image in images)


def _psnr_elsewhere(source: SplatModel, found: Candidate, views: ViewSet, threads: int | None) -> dict[str, float]:
    """Return the PSNR on views that were not used in the search, by kind."""
    model, groups = decode(found.result.data), extra_test_cameras(source).items()
    return {
        kind: round(Scorer.of_source(source, cameras, views.background, threads=threads).psnr(model), 3)
        for kind, cameras in groups
    }


def _image_psnr(source: SplatModel, found: Candidate, views: ViewSet, threads: int | None) -> dict[str, float]:
    """Return the PSNR of file and source against the test images, dB."""
    scorer = views.image_test_scorer(threads=threads)
    return {"file": scorer.psnr(decode(found.result.data)), "source": scorer.psnr(source)}


def find_goal(target: Target, source: SplatModel, image_scorer: Scorer | None) -> SearchGoal:
    """Return the goal of the search for a target.

    Args:
        target: a PSNR, a size or a drop of PSNR.
        source: the scene.
        image_scorer: the scorer on validation images, against which a drop is measured.
    """
    if target.max_psnr_drop is None or image_scorer is None:
        return SearchGoal(target.psnr, target.size_bytes, max_error=target.max_error)
    reached = image_scorer.psnr(source)
    # The source's error against images is far larger than the drop, so a file's own error is a small part of the sum.
    slope = 1.0 - 10.0 ** (-target.max_psnr_drop / 10.0)
    return SearchGoal(
        min(loss_as_psnr(target.max_psnr_drop, reached), PSNR_CAP), None, reached - target.max_psnr_drop, slope
    )


def loss_as_psnr(loss: float, photo_psnr: float) -> float:
    """Return the PSNR against the source's renders at which the PSNR against images drops by `loss` dB.

    The errors of the source and of the file are assumed to be independent, so that squared errors add up.

    Args:
        loss: dB, above 0.
        photo_psnr: PSNR of the source against images, dB.
    """
    return photo_psnr - 10.0 * math.log10(10.0 ** (loss / 10.0) - 1.0)


@dataclass(eq=False)
class TargetSearch:
    """The search for the coding, the splats and the precision.

    Attributes:
        search: finds the precision of candidates near the goal, and on it.
        codings: the possible codings of SH.
        whole: all splats.
        pruner: prunes splats; `None`: all are kept.
    """

    search: PrecisionSearch
    codings: CodingSearch
    whole: WholeScene
    pruner: Pruner | None

    def best(self) -> Candidate:
        """Return the smallest file that meets a PSNR or a drop of PSNR, or the best one of a size.

        Raises:
            InputError: no file meets the goal.
        """
        tried = self.codings.best(self.search, self.whole, self._start(), brief=self.pruner is not None)
        if self.pruner is not None:
            if self.search.goal.uses_test_views:
                tried[0].score_on_test_views()
            cost, fitted = self.search.cost, self._pruned_candidates(self.pruner, tried[0])
            if cost(tried[0]) < min(map(cost, fitted), default=math.inf) + _WITHIN_REACH:
                tried = self.codings.best(self.search, self.whole, tried[0].quality or 0.0)
            tried += fitted
        found = self._on_goal(tried)
        if found:
            self.search.try_neighbours(min(found, key=lambda candidate: candidate.size_bytes))
        self._try_presets(tried)
        best = self.search.goal.best([one for one in self.search.candidates.made if self._may_be_written(one)])
        if best is None:
            raise InputError(self._out_of_reach())
        return best

    def _on_goal(self, tried: Sequence[Candidate]) -> list[Candidate]:
        """Return candidates on the goal, of the most promising kinds; with more splats if all tried were too few."""
        found, failed, excess = list[Candidate](), list[Candidate](), 0.0
        for candidate in sorted(tried, key=self.search.cost):
            others = [one for one in tried if one.subset.refits and one.splats > candidate.splats]
            if any(one.subset is candidate.subset for one in failed) and others:
                continue  # candidates of more splats come first
            if self._pays(candidate, found, excess):
                expected, on = self.search.cost(candidate), self.search.find_on(candidate.subset, candidate.coding)
                if on is not None and candidate.subset.refits:
                    excess = max(excess, min(math.log(on.size_bytes) - expected, _COMMON))
                (failed if on is None else found).append(on or candidate)
        if failed and not any(one.subset.refits for one in found):
            on = self._of_more(max(failed, key=lambda candidate: candidate.splats))
            found += [] if on is None else [on]
        return found

    def _may_be_written(self, candidate: Candidate) -> bool:
        """Return True for a final file; if the goal refers to test views, it must have been scored on them."""
        return candidate.is_packed and (candidate.is_scored or not self.search.goal.uses_test_views)

    def _start(self) -> float:
        """Return the attribute PSNR of the first file, dB."""
        goal, has_sh = self.search.goal, self.codings.usual_codings(self.whole) != [CodingChoice("none")]
        if goal.size_bytes is None:
            psnr = goal.psnr or 0.0
            return clip_quality(psnr + _ATTRIBUTE_GAIN[has_sh] + _ATTRIBUTE_GAIN_GROWS[has_sh] * (psnr - 30.0))
        per_splat = goal.size_bytes / len(self.whole.model)
        return clip_quality(_USUAL[1] + math.log(per_splat / _USUAL[0]) / BYTES_PER_DB)

    def _pruned_candidates(self, pruner: Pruner, whole: Candidate) -> list[Candidate]:
        """Return candidates near the goal for several splat counts, each predicted from earlier ones."""
        search, goal, splats = self.search, self.search.goal, len(self.whole.model)
        slope, found = self._slope_of_counts(whole), list[Candidate]()
        psnr_of = search.candidates.validation_scorer.psnr
        allowed = None if goal.psnr is None else search.validation_goal(self.whole)
        kept_count = self._first_kept_count(pruner, whole, slope)
        start = (whole.quality or 0.0) - search.margin(whole) - REFIT_GAIN
        for number in range(2 * _COUNTS):
            if number >= _COUNTS and found:
                break
            if kept_count > (1.0 - _ALL_BUT) * splats:
                if found or pruner.options.is_brief:
                    break
                kept_count = splats  # all splats, which are still refitted through the quantisers
            subset = pruner.refit(kept_count, allowed, psnr_of)
            if allowed is not None and subset.fitted_psnr < allowed + _SPARE:
                if found:
                    break
                kept_count, _ = pruner.next_at_psnr(len(subset.rows), subset.fitted_psnr, allowed, slope)
                continue
            if search.is_hopeless(subset):
                kept_count = _next_larger(kept_count)
                continue
            quality = start if goal.psnr is None else _raised_quality(start, goal.psnr, subset.psnr)
            tries = self.codings.best(search, subset, quality, brief=pruner.options.is_brief)
            candidate = tries[0]
            found += tries
            if kept_count == splats or pruner.options.is_brief:
                break
            if math.isinf(search.cost(candidate)):
                # No candidate is small enough for a size, or good enough for a PSNR.
                if goal.size_bytes is None:
                    kept_count = _next_larger(kept_count)
                elif len(subset.rows) > kept_count or kept_count == 1:
                    break  # no more splats can be pruned, since no view saw the others
                else:
                    kept_count = int(kept_count * _FEWER)
                continue
            if goal.psnr is not None:
                # The error of dropped bands does not depend on the number of splats.
                allowed = search.validation_goal(subset)
                goal_psnr = _subtract(allowed, error_of_psnr(subset.psnr) - error_of_psnr(subset.fitted_psnr))
                kept_count, saved = pruner.next_at_psnr(len(subset.rows), subset.fitted_psnr, goal_psnr, slope)
            else:
                kept_count, saved = pruner.next_at_size(
                    len(subset.rows), subset.fitted_psnr, candidate.validation_psnr, slope
                )
            saved -= search.cost(candidate) - min(map(search.cost, found))
            if saved < _WORTH or any(abs(one.splats - kept_count) < _CLOSE * kept_count for one in found):
                break
        return found

    def _slope_of_counts(self, whole: Candidate) -> float:
        """Return the fraction of the bytes that a decibel costs, for the choice of the number of splats.

        The more SH a file needs, the cheaper are less important splats, since they have fewer bands.
        """
        above = (self.search.goal.psnr or whole.validation_psnr) - _BANDS_GROW[0]
        has_sh = whole.coding.sh != "none"
        return self.search.slope(whole) * (1.0 + _BANDS_GROW[1] * max(above, 0.0) * has_sh)

    def _of_more(self, candidate: Candidate) -> Candidate | None:
        """Return a file on the goal with more splats than a candidate that cannot meet it; `None` if there is none."""
        kept_count = _next_larger(candidate.splats)
        keeps_all = candidate.subset is self.whole or kept_count > (1.0 - _ALL_BUT) * len(self.whole.model)
        if self.pruner is None or self.search.goal.psnr is None or keeps_all:
            return None
        psnr_of = self.search.candidates.validation_scorer.psnr
        subset = self.pruner.refit(kept_count, self.search.validation_goal(self.whole), psnr_of)
        best = self.codings.best(self.search, subset, candidate.quality or 0.0)[0]
        return self.search.find_on(best.subset, best.coding)

    def _first_kept_count(self, pruner: Pruner, whole: Candidate, slope: float) -> int:
        """Return the number of splats to begin with."""
        goal, psnr_of = self.search.goal, self.search.candidates.validation_scorer.psnr
        if goal.psnr is not None:
            return pruner.first_at_psnr(goal.psnr, slope, psnr_of)
        near = None if math.isinf(self.search.cost(whole)) else (whole.splats, whole.validation_psnr)
        return pruner.first_at_size(goal.size_bytes or 0, near, slope, psnr_of)

    def _pays(self, candidate: Candidate, found: list[Candidate], excess: float) -> bool:
        """Return True if a candidate near the goal is worth the search for its precision on the goal.

        Args:
            candidate: the candidate.
            found: files that meet the goal already.
            excess: log bytes by which a refitted file among them exceeded its expected cost.
        """
        best = self.search.goal.best(found)
        if best is None:
            return True
        again = any(one.subset is candidate.subset for one in found)
        # The cost of a file that meets a PSNR is its actual size, even if less was predicted.
        known = math.log(best.size_bytes) if self.search.goal.size_bytes is None else self.search.cost(best)
        saved = known - self.search.cost(candidate) - excess * candidate.subset.refits
        return saved > (_PAYS_FOR_REFIT if candidate.subset.refits else _PAYS if again else -_PAYS)

    def _try_presets(self, tried: Sequence[Candidate]) -> None:
        """Make the presets' own files if they are expected near the goal, so that a search is not worse than these."""
        goal, plain = self.search.goal, [candidate for candidate in tried if candidate.subset is self.whole]
        if not goal.uses_test_views:
            return
        near = min(plain, key=lambda candidate: (candidate.coding.use_classes, self.search.cost(candidate)))
        if self.search.cost(near) > min(map(self.search.cost, tried)) + _FAR:
            return  # presets keep all splats, in one class
        lost = (near.quality or 0.0) - self.search.margin(near)
        for name, preset in PRESETS.items():
            expected = preset.quality[near.coding.sh == "none"] - lost
            if _may_try_preset(name, self.codings.encoding.preset) and _PRESETS[0] <= expected <= _PRESETS[1]:
                encoding = replace(self.codings.encoding, preset=name)
                coding = CodingChoice(None, use_classes=False)
                made = self.search.candidates.make(self.whole, coding, None, quick=False, encoding=encoding)
                made.score_on_test_views()

    def _out_of_reach(self) -> str:
        goal, made = self.search.goal, self.search.candidates.made
        if goal.size_bytes is not None:
            kept = " with all splats" if self.pruner is None else ""
            smallest = min(candidate.size_bytes for candidate in made)
            return f"no file{kept} has at most {goal.size_bytes} bytes; the smallest found has {smallest}"
        if goal.photo_psnr is not None:
            nearest = max(candidate.photo_psnr for candidate in made)
            return f"no file reaches {goal.photo_psnr:.2f} dB on the validation images; the best has {nearest:.2f} dB"
        highest = max(candidate.psnr for candidate in made if candidate.is_scored)
        return f"no file reaches {goal.psnr or 0.0:.2f} dB; the best found has {highest:.2f} dB"


def _may_try_preset(name: str, preset: str) -> bool:
    """Return True if a search with a preset may use another preset's file; `fast` only for itself."""
    return name == preset if "fast" in (name, preset) else True


def _next_larger(splats: int) -> int:
    """Return the next larger number of splats to try."""
    return math.ceil(splats / _FEWER)


def _subtract(psnr: float, error: float) -> float:
    """Return the PSNR of the error that remains after another error is subtracted from that of a PSNR."""
    allowed = error_of_psnr(psnr)
    return psnr_of_mse(max(allowed - max(error, 0.0), _LEAST_REST * allowed))


def _raised_quality(quality: float, psnr: float, fitted_psnr: float) -> float:
    """Return the attribute PSNR, raised to compensate for the error of pruning."""
    rest = max(_LEAST_REST, 1.0 - error_of_psnr(fitted_psnr) / error_of_psnr(psnr))
    return clip_quality(quality + psnr_of_mse(rest))
