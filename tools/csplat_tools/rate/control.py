"""The smallest file at a PSNR, the best one within a size: quality, SH and splats are chosen, the file is judged.

All steps follow from one number, the encoder's quality. What is kept of SH is compared at one quality; then the quality
is found by false position; then splats go that are not worth their bits, and it is found again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, Importance
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.judge import Judge
from csplat_render.virtual import scene_frame
from csplat_tools.rate.bounds import meet_bounds
from csplat_tools.rate.choosing import Chooser, Goal
from csplat_tools.rate.exchange import BYTES_PER_DB
from csplat_tools.rate.grading import evenly, graded_by
from csplat_tools.rate.pruning import Pruner
from csplat_tools.rate.search import Window, meet
from csplat_tools.rate.summary import summary
from csplat_tools.rate.targets import RateResult, RateTarget
from csplat_tools.rate.trials import Choice, Part, Trial, Trials
from csplat_tools.simplify.options import SimplifyOptions
from csplat_tools.views import ViewSet, comparison_cameras, find_view_set, with_deciders

__all__ = ["encode_to_target"]

Progress = Callable[[str, float], None]
Colour = tuple[float, float, float]

_ALL_STAY = (
    "all splats stay: in surroundings virtual views do not show what cameras inside show; 40 cameras or more would say"
    " which may go"
)
_ONE_GRADE = (
    "all splats are of one grade: in surroundings virtual views do not say how precise splats have to be; 40 cameras or"
    " more, or --importance from cameras, would"
)
_QUALITIES = (24.0, 110.0)  # dB, between which the encoder's is looked for
_LOSS = (4.0, 9.0)  # dB between what each attribute keeps by itself and what all keep, without and with SH
_PSNR = (0.0, 0.25, 0.1)  # dB above the target: from, to, aimed at
_SIZE = (0.97, 1.0, 0.987)  # of the target: from, to, aimed at
_TRIES = 9
_MOST_CAMERAS = 24  # of the user's own judge
_ENOUGH_CAMERAS = 40  # of the user's own decide what is left out; fewer would only keep what they show
_STARVED = 40.0  # quality to begin with where a size is too small for all splats
_ROUNDS = 4  # of leaving out splats for a size, each by what the one before taught
_SAME = 0.03  # of the splats: fewer or more by less are not worth another round
_REMOVED = (0.6, 0.25)  # of the error that a PSNR allows, at most; the second where the first was too much
_USUAL = ((6.5, 43.0), (7.2, 43.0))  # bytes per splat at a quality, without and with SH
_APART = 0.3  # dB between two files that say what a decibel costs
_SLOPES = (0.02, 0.1)
_FEWER = 0.7  # of the splats, in steps, until a size holds them


def encode_to_target(
    source: SplatModel,
    target: RateTarget,
    encoding: EncodeOptions | None = None,
    *,
    cameras: Sequence[Camera] | None = None,
    background: Colour = (0.0, 0.0, 0.0),
    prune: bool | None = None,
    views: int = 160,
    importance: NDArray[Any] | Importance | None = None,
    progress: Progress | None = None,
) -> RateResult:
    """Encode a scene so that its file has a size, its renders a PSNR, its splats largest errors.

    Args:
        source: the scene.
        target: what is asked for.
        encoding: knobs that are set here are not chosen. The preset "fast" tries no codebooks and keeps all splats.
        cameras: from where renders of file and source are compared, relative to the source's origin; at most 24 of
            them, evenly chosen. None for the virtual ones of `psnr`. If they are 40 or more, they also decide which
            splats are left out; else virtual views do.
        background: red, green, blue behind everything.
        prune: splats may be left out that are not worth their bits; not where largest errors are bounded. None: where
            40 cameras or more are given, or virtual views show all that there is to see, as of an object. In
            surroundings cameras stand where virtual ones do not, and show what those hardly do.
        views: virtual views at most that decide which, and how precise splats have to be.
        importance: how much splats matter, as for the encoder.
        progress: is told the stages.

    Raises:
        InputError: there are no splats; or the target is out of reach; or a knob is set that the target has to choose.
    """
    start = time.perf_counter()
    encoding = encoding or EncodeOptions()
    if not len(source):
        raise InputError("a scene without splats has no size or quality to choose")
    if encoding.attribute_psnr is not None:
        raise InputError("quality is what a target chooses: give one of them")
    blocked = _blocked(target, encoding)
    if prune and blocked is not None:
        raise InputError(f"no splat can be left out {blocked}")
    files = 0
    if target.max_error:
        bounded = meet_bounds(source, encoding, target.max_error, importance=importance, progress=progress)
        if target.size_bytes is None and target.psnr is None:
            return bounded.as_result()
        encoding, files = bounded.encoding, bounded.encodes
    judging = comparison_cameras(source) if cameras is None else evenly(cameras, _MOST_CAMERAS)
    judge = Judge.of_source(source, judging, background, threads=encoding.threads)
    if cameras is not None and all(
        np.ptp(judge.look(number).picture, axis=(0, 1)).max() == 0.0 for number in range(len(judging))
    ):
        raise InputError("no splat shows in the views given: are these cameras of this scene?")
    deciding = None if cameras is None or len(cameras) < _ENOUGH_CAMERAS else list(cameras)
    inside = deciding is None and scene_frame(source).kind == "surrounding"
    unsure = prune is None and inside
    graded = graded_by(
        source, deciding, background, encoding, importance, views=views, inside=inside, progress=progress
    )
    pruner = None
    if blocked is None and prune is not False and not unsure:
        if deciding is None:
            around = find_view_set(source, background=background, count=views)
        else:
            around = with_deciders(ViewSet("cameras", background, deciding, (), ()))
        pruner = Pruner(source, around, SimplifyOptions(background=background, threads=encoding.threads), progress)
    trials = Trials(source, encoding, judge, importance, progress, graded.importance)
    search = _Search(source, encoding, trials, Chooser(trials, source, encoding), pruner)
    found = search.at_psnr(target.psnr) if target.psnr is not None else search.at_size(target.size_bytes or 0)
    removal_views = 0 if pruner is None else pruner.renders
    report = summary(
        target, found, trials, source, removal_views=removal_views, sensitivity_views=graded.views,
        virtual=cameras is None,
    )  # fmt: skip
    if inside and graded.importance is None and (encoding.grades or 0) > 1:
        report["why"].append(_ONE_GRADE)
    if unsure and blocked is None:
        report["why"].append(_ALL_STAY)
    seconds = round(time.perf_counter() - start, 3)
    return RateResult(found.result, {**report, "encodes": files + len(trials.made), "seconds": seconds})


def _blocked(target: RateTarget, encoding: EncodeOptions) -> str | None:
    """Why all splats have to stay, if they have to."""
    if target.max_error:
        return "where errors are bounded: what is gone has none"
    if encoding.preset == "fast":
        return "by the preset fast"
    return "where extra columns are carried" if encoding.keep_extra else None


@dataclass(frozen=True, eq=False)
class _Search:
    """Looks for the quality, the choice and the splats; every file goes through `trials`."""

    source: SplatModel
    encoding: EncodeOptions
    trials: Trials
    chooser: Chooser
    pruner: Pruner | None

    def at_psnr(self, goal: float) -> Trial:
        """The smallest file that reaches a PSNR."""
        whole = Part(self.source)
        quality = self._bounded(goal + _LOSS[self.source.sh_degree > 0])
        choice = self.chooser.best(whole, quality, Goal(psnr=goal))
        best = self._with_psnr(whole, choice, goal, quality)
        if best is None and choice != self.chooser.first():
            best = self._with_psnr(whole, self.chooser.first(), goal, quality)
        if best is None and self.source.sh_degree and self.encoding.sh_coding == "auto":
            best = self._with_psnr(whole, Choice("scalar"), goal, quality)
        if best is None:
            raise InputError(f"no file reaches {goal:.2f} dB; the best of those tried has {self._highest():.2f} dB")
        if self.pruner is None:
            return best
        floor, slope = self.chooser.floor(best), self._slope(best)
        for most in _REMOVED:
            part = self.pruner.at_psnr(goal, floor, slope, self.trials.seen, most)
            if part is None:
                break
            choice = self.chooser.best(part, best.quality, Goal(psnr=goal))
            pruned = self._with_psnr(part, choice, goal, best.quality - 10.0 * math.log10(1.0 - most))
            if pruned is not None:
                return min(best, pruned, key=lambda trial: trial.size_bytes)
        return best

    def at_size(self, goal: int) -> Trial:
        """The file within a size whose renders are best."""
        whole = Part(self.source)
        best = self._with_size(whole, self.chooser.first(), goal, self._guess(goal))
        if best is None and self.source.sh_degree and self.encoding.sh_coding == "auto":
            best = self._with_size(whole, Choice("none", degree=0), goal, _QUALITIES[0])
        if best is not None:
            choice = self.chooser.best(whole, best.quality, Goal(size_bytes=goal), best)
            best = self._better(self.trials.judged(best), self._with_size(whole, choice, goal, best.quality))
        if self.pruner is None:
            return self._found(best, goal)
        trial = best or self._starved(self.pruner, goal)
        best = trial = self.trials.judged(trial)
        for _ in range(_ROUNDS):
            count, floor = len(trial.part.model), self.chooser.floor(trial)
            part = self.pruner.at_size(trial.psnr, floor, count, self._slope(trial), self.trials.seen)
            if part is None or abs(len(part.model) - count) < _SAME * len(self.source):
                break
            finer = self._bounded(trial.quality + math.log(count / len(part.model)) / BYTES_PER_DB)
            after = self._with_size(part, self.chooser.best(part, finer, Goal(size_bytes=goal)), goal, finer)
            if after is None:
                break
            trial = self.trials.judged(after)
            if trial.psnr < best.psnr:
                break
            best = trial
        return best

    def _starved(self, pruner: Pruner, goal: int) -> Trial:
        """A file within a size that is too small for all splats, by the better of the choices that were tried."""
        best = None
        for choice in dict.fromkeys(trial.choice for trial in self.trials.made):
            trial = self._starved_by(choice, pruner, goal)
            if trial is not None:
                best = self._better(best, trial) if best is not None else self.trials.judged(trial)
        return self._found(best, goal)

    def _starved_by(self, choice: Choice, pruner: Pruner, goal: int) -> Trial | None:
        """A file of fewer and fewer splats, until a size holds them."""
        smallest = min(trial.size_bytes for trial in self.trials.made if trial.choice == choice)
        left, before = max(1, int(len(self.source) * _FEWER * goal / smallest)), len(self.source)
        while left >= 1:
            part = pruner.to_count(left)
            if len(part.model) >= before:
                break  # nobody saw the others
            trial = self._with_size(part, choice, goal, _STARVED)
            if trial is not None:
                return trial
            before, left = len(part.model), int(left * _FEWER)
        return None

    def _found(self, best: Trial | None, goal: int) -> Trial:
        if best is None:
            smallest = min(trial.size_bytes for trial in self.trials.made)
            kept = " with all splats" if self.pruner is None else ""
            raise InputError(f"no file{kept} has {goal} bytes or fewer: of those tried one has {smallest}")
        return best

    def _with_psnr(self, part: Part, choice: Choice, goal: float, quality: float) -> Trial | None:
        """The smallest of some files of a choice that reaches a PSNR."""
        found: list[Trial] = []

        def measure(place: float) -> float:
            found.append(self.trials.judged(self.trials.encode(part, choice, place)))
            return found[-1].psnr

        window = Window(goal + _PSNR[0], goal + _PSNR[1], goal + _PSNR[2])
        meet(measure, window, start=quality, slope=1.0, bounds=_QUALITIES, tries=_TRIES)
        good = [trial for trial in found if trial.psnr >= goal]
        return min(good, key=lambda trial: trial.size_bytes, default=None)

    def _with_size(self, part: Part, choice: Choice, goal: int, quality: float) -> Trial | None:
        """The finest of some files of a choice within a size."""
        found: list[Trial] = []

        def measure(place: float) -> float:
            found.append(self.trials.encode(part, choice, place))
            return found[-1].size_bytes / goal

        meet(measure, Window(*_SIZE), start=quality, slope=BYTES_PER_DB, bounds=_QUALITIES, tries=_TRIES)
        good = [trial for trial in found if trial.size_bytes <= goal]
        return max(good, key=lambda trial: trial.quality, default=None)

    def _better(self, best: Trial, other: Trial | None) -> Trial:
        """The one whose renders are nearer to the source's."""
        if other is None:
            return best
        other = self.trials.judged(other)
        return other if other.psnr > best.psnr else best

    def _guess(self, goal: int) -> float:
        """The quality that takes so many bytes, about."""
        has_sh = self.source.sh_degree > 0
        per_splat = goal / len(self.source)
        return self._bounded(_USUAL[has_sh][1] + math.log(per_splat / _USUAL[has_sh][0]) / BYTES_PER_DB)

    def _slope(self, best: Trial) -> float:
        """The share of the bytes that a decibel costs here."""
        for trial in self.trials.made:
            apart = trial.psnr - best.psnr
            if trial.part is best.part and trial.choice == best.choice and abs(apart) > _APART:
                return min(max(math.log(trial.size_bytes / best.size_bytes) / apart, _SLOPES[0]), _SLOPES[1])
        return BYTES_PER_DB

    def _highest(self) -> float:
        return max(trial.psnr for trial in self.trials.made if not math.isnan(trial.psnr))

    @staticmethod
    def _bounded(quality: float) -> float:
        return min(max(quality, _QUALITIES[0]), _QUALITIES[1])
