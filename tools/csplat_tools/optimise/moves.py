"""The steps of a search, in order: codings of the whole scene, fewer splats, files on the goal, the presets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from csplat.encoder import PRESETS
from csplat.errors import InputError
from csplat_render.metrics import psnr_of_mse
from csplat_tools.optimise.coding import Codings
from csplat_tools.optimise.exchange import BYTES_PER_DB, error_of_psnr
from csplat_tools.optimise.removal import Removal
from csplat_tools.optimise.solving import TUNING_GAINS, Solver, bounded
from csplat_tools.optimise.trials import Coding, Trial, Trials, Whole

_LOSS = (5.0, 8.5)  # dB from the PSNR of all attributes to that of each alone, at 30 dB, without and with SH
_LOSS_GROWS = (0.0, 0.22)  # dB that this grows with every dB above 30, without and with SH
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
class Moves:
    """The search for the coding, the splats and the precision.

    Attributes:
        solver: brings files near the goal, and onto it.
        codings: the possible codings of SH.
        whole: all splats.
        removal: prunes splats; `None`: all are kept.
    """

    solver: Solver
    codings: Codings
    whole: Whole
    removal: Removal | None

    @staticmethod
    def kept(trials: Trials, removal: Removal, left: int) -> Trial:
        """Return the file of `left` splats at the precision of the options."""
        part = removal.fitted(left, None, trials.decider.psnr)
        return trials.make(part, Coding(None), None, quick=False)

    def best(self) -> Trial:
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

    def _on_goal(self, tried: Sequence[Trial]) -> list[Trial]:
        """Return files that meet the goal, made from the most promising; with more splats if all tried were too few."""
        found, failed, dearer = list[Trial](), list[Trial](), 0.0
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

    def _may_be_written(self, trial: Trial) -> bool:
        """Return True if a file is no draft and, if the goal is measured on the test views, has been scored on them."""
        return trial.is_packed and (trial.is_judged or not self.solver.goal.is_judged)

    def _start(self) -> float:
        """Return the PSNR of each attribute for the first file, dB."""
        goal, has_sh = self.solver.goal, self.codings.usual(self.whole) != [Coding("none")]
        if goal.size_bytes is None:
            psnr = goal.psnr or 0.0
            return bounded(psnr + _LOSS[has_sh] + _LOSS_GROWS[has_sh] * (psnr - 30.0))
        per_splat = goal.size_bytes / len(self.whole.model)
        return bounded(_USUAL[1] + math.log(per_splat / _USUAL[0]) / BYTES_PER_DB)

    def _removed(self, removal: Removal, whole: Trial) -> list[Trial]:
        """Return files near the goal for several numbers of splats, each predicted from the files before."""
        solver, goal, splats = self.solver, self.solver.goal, len(self.whole.model)
        slope, found, seen = self._slope_of_counts(whole), list[Trial](), solver.trials.decider.psnr
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
                left = _more(left)
                continue
            quality = start if goal.psnr is None else _finer(start, goal.psnr, part.psnr)
            tries = self.codings.best(solver, part, quality, brief=removal.options.is_brief)
            trial = tries[0]
            found += tries
            if left == splats or removal.options.is_brief:
                break
            if math.isinf(solver.cost(trial)):
                # None of them is small enough for a size, or good enough for a PSNR.
                if goal.size_bytes is None:
                    left = _more(left)
                elif len(part.rows) > left or left == 1:
                    break  # no more splats can be pruned: no view saw the others
                else:
                    left = int(left * _FEWER)
                continue
            if goal.psnr is not None:
                # The error of bands that are left out does not depend on the number of splats.
                allowed = solver.level(part)
                wanted = _without(allowed, error_of_psnr(part.psnr) - error_of_psnr(part.fitted_psnr))
                left, saved = removal.next_at_psnr(len(part.rows), part.fitted_psnr, wanted, slope)
            else:
                left, saved = removal.next_at_size(len(part.rows), part.fitted_psnr, trial.decided_psnr, slope)
            saved -= solver.cost(trial) - min(map(solver.cost, found))
            if saved < _WORTH or any(abs(one.splats - left) < _CLOSE * left for one in found):
                break
        return found

    def _slope_of_counts(self, whole: Trial) -> float:
        """Return the fraction of the bytes that a decibel costs, for the choice of the number of splats.

        The more SH a file needs, the fewer bytes the next splat takes compared with more important ones: it has fewer
        bands.
        """
        above = (self.solver.goal.psnr or whole.decided_psnr) - _BANDS_GROW[0]
        has_sh = whole.coding.sh != "none"
        return self.solver.slope(whole) * (1.0 + _BANDS_GROW[1] * max(above, 0.0) * has_sh)

    def _of_more(self, trial: Trial) -> Trial | None:
        """Return a file that meets the goal with more splats than a trial that cannot; `None` if there is none."""
        left = _more(trial.splats)
        all_stay = trial.part is self.whole or left > (1.0 - _ALL_BUT) * len(self.whole.model)
        if self.removal is None or self.solver.goal.psnr is None or all_stay:
            return None
        part = self.removal.fitted(left, self.solver.level(self.whole), self.solver.trials.decider.psnr)
        best = self.codings.best(self.solver, part, trial.quality or 0.0)[0]
        return self.solver.on(best.part, best.coding)

    def _first_left(self, removal: Removal, whole: Trial, slope: float) -> int:
        """Return the number of splats to begin with."""
        goal, seen = self.solver.goal, self.solver.trials.decider.psnr
        if goal.psnr is not None:
            return removal.first_at_psnr(goal.psnr, slope, seen)
        near = None if math.isinf(self.solver.cost(whole)) else (whole.splats, whole.decided_psnr)
        return removal.first_at_size(goal.size_bytes or 0, near, slope, seen)

    def _pays(self, trial: Trial, found: list[Trial], dearer: float) -> bool:
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

    def _presets(self, tried: Sequence[Trial]) -> None:
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
            if _is_asked(name, self.codings.encoding.preset) and _PRESETS[0] <= expected <= _PRESETS[1]:
                encoding = replace(self.codings.encoding, preset=name)
                plainly = Coding(None, graded=False)
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


def _is_asked(name: str, preset: str) -> bool:
    """Return True if a search with a preset may use another preset's file: `fast` only if it is the one requested."""
    return name == preset if "fast" in (name, preset) else True


def _more(splats: int) -> int:
    """Return the next larger number of splats to try."""
    return math.ceil(splats / _FEWER)


def _without(psnr: float, error: float) -> float:
    """Return the PSNR of the error that remains of a PSNR's allowance after another error is subtracted."""
    allowed = error_of_psnr(psnr)
    return psnr_of_mse(max(allowed - max(error, 0.0), _LEAST_LEFT * allowed))


def _finer(quality: float, psnr: float, fitted_psnr: float) -> float:
    """Return the PSNR of each attribute, raised because pruning has taken its part of the error already."""
    left = max(_LEAST_LEFT, 1.0 - error_of_psnr(fitted_psnr) / error_of_psnr(psnr))
    return bounded(quality + psnr_of_mse(left))
