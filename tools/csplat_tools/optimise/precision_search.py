"""Find the precision at which a kind of file is near the goal, to compare kinds, or exactly on it, to be written."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from csplat_render.metrics import psnr_of_mse
from csplat_tools.optimise.candidates import Candidate, CandidatePool, CodingChoice, Subset
from csplat_tools.optimise.rate_distortion import BYTES_PER_DB, LEAST_QUANTISED, error_of_psnr


@dataclass(frozen=True)
class SearchWindow:
    """The range in which a value is to lie.

    Attributes:
        low, high: values between these are good enough.
        aim: the value that a trial aims at.
    """

    low: float
    high: float
    aim: float


#: dB that a refit through the quantisers of a file gains, about: quick files count as better by this.
TUNING_GAINS = 1.1

_QUALITIES = (24.0, 110.0)  # range in which the PSNR of each attribute is searched, dB

_NEAR = SearchWindow(-0.8, 1.0, 0.1)  # dB above the goal: near enough to predict the cost of a file on it
_CLOSE = SearchWindow(-0.35, 0.4, 0.05)  # dB above the goal: near enough to choose the best coding
_ON = SearchWindow(0.0, 0.15, 0.06)  # dB above the goal; PSNR jumps by about as much from one precision to the next
_ON_REFITTED = SearchWindow(0.0, 0.25, 0.1)  # the same for the error of quantisation of refitted splats
_WITHIN = SearchWindow(-0.35, 0.0, -0.12)  # range of a size target, in the dB that the bytes are worth
_FEW, _SOME, _MANY = 3, 4, 6  # largest numbers of tries
_JUMP = 0.25  # dB by which a file may be worse than one of less precision by chance
_ROUGH = 16  # levels of opacity: with fewer, the PSNR of files jumps from one precision to the next
_BESIDE = (-1.2, -0.8, -0.4, 0.4, 0.8, 1.2)  # dB of precision next to the one found that are tried if the PSNR jumps
_APART = 0.5  # least difference of two files from which the cost of a decibel is taken, dB
_SLOPES = (0.02, 0.1)  # range of the fraction of the bytes that a decibel costs
_PLATEAU = 1.5  # dB below the goal: files that are lower are predicted with the steepest slope
_FORESEEN = 2.0  # dB: quantisation that is better than it has to be by more counts only as the whole file is better
_EVEN = 0.5  # least slope from two refitted files, as a fraction of the expected: quantisation is hardly less steep
_STALLED = (2.0, 0.25)  # dB of precision, and the gain per dB that they must bring, or no precision reaches the goal
_GROWS = {"codebook": 0.6}  # dB of a file's PSNR per dB of its attributes' PSNR, about; 1 for other codings


@dataclass(frozen=True)
class SearchGoal:
    """The goal of a search.

    Attributes:
        psnr: least PSNR of renders against the source's, dB; with `photo_psnr`, the value that is likely to meet it.
        size_bytes: largest size of the file.
        photo_psnr: least PSNR against photographs, dB.
        photo_slope: growth of that with every dB of `psnr`, about: little if a file's own error is little.
        max_error: largest errors of splats by measure; a file that exceeds one is no result.
    """

    psnr: float | None = None
    size_bytes: int | None = None
    photo_psnr: float | None = None
    photo_slope: float = 1.0
    max_error: Mapping[str, float] = field(default_factory=dict)

    def above(self, trial: Candidate, slope: float = BYTES_PER_DB) -> float:
        """Return by how many dB a file is above the goal; for a size, the dB that its excess bytes are worth.

        Args:
            trial: the file.
            slope: fraction of the bytes that a decibel costs.
        """
        if self.size_bytes is not None:
            return math.log(trial.size_bytes / self.size_bytes) / slope
        if self.photo_psnr is not None:
            return (trial.photo_psnr - self.photo_psnr) / self.photo_slope
        return trial.psnr - (self.psnr or 0.0)

    @property
    def is_judged(self) -> bool:
        """True if files are measured on the test views: the goal is a PSNR."""
        return self.size_bytes is None and self.photo_psnr is None

    def is_met(self, trial: Candidate) -> bool:
        """Return True if a file meets the goal."""
        errors = trial.result.report.errors
        if any(errors[name][0] > most for name, most in self.max_error.items() if name in errors):
            return False
        above = self.above(trial)
        return above <= 0.0 if self.size_bytes is not None else above >= 0.0

    def best(self, trials: list[Candidate]) -> Candidate | None:
        """Return the smallest file that meets the goal; for a size, the one with the best validation PSNR."""
        good = [trial for trial in trials if self.is_met(trial)]
        if self.size_bytes is not None:
            return max(good, key=lambda trial: trial.decided_psnr, default=None)
        return min(good, key=lambda trial: trial.size_bytes, default=None)


@dataclass(eq=False)
class PrecisionSearch:
    """The search for the precision at which files of given splats and coding meet the goal.

    Attributes:
        trials: makes the files.
        goal: the goal.
    """

    trials: CandidatePool
    goal: SearchGoal

    def near(self, part: Subset, coding: CodingChoice, start: float, tries: int = _FEW) -> Candidate:
        """Return a file near the goal, or the nearest of a few.

        Args:
            part: its splats.
            coding: the coding of their colours.
            start: PSNR of each attribute for the first file, dB.
            tries: largest number of files.
        """
        self._approach(part, coding, start, _NEAR, tries, self.about)
        return self._nearest(part, coding)

    def closer(self, trial: Candidate) -> Candidate:
        """Return a file if it is close to the goal; else make one more of its kind, and return the nearest of all."""
        if _CLOSE.low <= self.about(trial) <= _CLOSE.high:
            return trial
        assert trial.quality is not None
        tries = len(self.trials.of(trial.part, trial.coding)) + 1
        self._approach(trial.part, trial.coding, trial.quality, _CLOSE, tries, self.about)
        return self._nearest(trial.part, trial.coding)

    def on(self, part: Subset, coding: CodingChoice) -> Candidate | None:
        """Return the best file that meets the goal, for splats and a coding with files near it; `None` if none does."""
        known = self._nearest(part, coding)
        assert known.quality is not None
        if self.goal.size_bytes is not None:
            start = known.quality - self.goal.above(known, self.slope(known))
            self._approach(part, coding, start, _WITHIN, _MANY, self.goal.above, careful=True)
            return self.goal.best(self.trials.of(part, coding, careful=True))
        if part.refits:
            start = known.quality - _quantisation_margin(known, self.about(known))
            self._approach(part, coding, start, _ON_REFITTED, _SOME, self.goal.above, careful=True)
            return self.goal.best(self.trials.of(part, coding, careful=True))
        self._approach(part, coding, known.quality, _ON, _MANY, self.goal.above)
        best = self.goal.best(self.trials.of(part, coding))
        if best is None:
            return None
        packed = self.trials.make(part, coding, best.quality, quick=False)
        return packed if self.goal.is_met(packed) else None

    def try_beside(self, best: Candidate) -> None:
        """Try precisions next to that of a file on the goal if the PSNR jumps, and pack the smallest that meets it."""
        made, levels = self.trials.of(best.part, best.coding), best.result.report.options["opacity_levels"]
        if self.goal.size_bytes is not None or best.part.refits or not (levels < _ROUGH or _jumps(made)):
            return
        assert best.quality is not None
        draft = found = self.trials.make(best.part, best.coding, best.quality, quick=True)
        for step in _BESIDE:
            trial = self.trials.make(best.part, best.coding, clip_quality(best.quality + step), quick=True)
            if trial.size_bytes < found.size_bytes and self.about(trial) > -_JUMP and self.goal.is_met(trial):
                found = trial
        if found is not draft:
            self.trials.make(found.part, found.coding, found.quality, quick=False).let_judge()

    def cost(self, trial: Candidate) -> float:
        """Return the expected cost of a file like this one on the goal, see `expected`; infinite if it is not near."""
        above = self.about(trial)
        far = above < _NEAR.low if self.goal.size_bytes is None else above > _NEAR.high
        return math.inf if far else self.expected(trial)

    def expected(self, trial: Candidate) -> float:
        """Return the expected cost of a file like this one on the goal: a logarithm of bytes.

        The cost is infinite if no precision of its kind reaches the goal.
        """
        if self.is_stalled(trial):
            return math.inf
        level = self.level(trial.part) if self.goal.size_bytes is None else self._level_of_size()
        above = trial.decided_psnr + self._gained(trial) - level
        far = min(above + _PLATEAU, 0.0)  # finer steps alone bring nothing so far up
        above = min(_quantisation_margin(trial, above), max(above, _FORESEEN))
        return math.log(trial.size_bytes) - self.slope(trial) * (above - far) - _SLOPES[1] * far

    def about(self, trial: Candidate) -> float:
        """Return by how many dB a file is above the goal, as far as validation views tell.

        A quick file of refitted splats counts as better by the expected gain of the refit through its quantisers.
        """
        if not self.goal.is_judged:
            return self.goal.above(trial)
        return trial.decided_psnr + self._gained(trial) - self.level(trial.part)

    def is_stalled(self, trial: Candidate) -> bool:
        """Return True if its kind of file is below a PSNR and more precision hardly helps: a codebook is too small."""
        made = [one for one in self.trials.of(trial.part, trial.coding) if one.is_careful == trial.is_careful]
        if self.goal.size_bytes is not None or len(made) < 2:
            return False
        coarse, fine = sorted(made, key=lambda one: one.quality or 0.0)[-2:]
        apart, above = (fine.quality or 0.0) - (coarse.quality or 0.0), [self.about(one) for one in (coarse, fine)]
        if apart < _STALLED[0] or max(above) >= 0.0:
            return False
        gained = _quantisation_margin(fine, above[1]) - _quantisation_margin(coarse, above[0])
        return gained < _STALLED[1] * apart

    def _gained(self, trial: Candidate) -> float:
        return 0.0 if trial.is_careful or not trial.part.refits else TUNING_GAINS

    def slope(self, trial: Candidate) -> float:
        """Return the fraction of the bytes that a decibel of quantisation error costs for files of this kind."""
        for other in self.trials.of(trial.part, trial.coding):
            apart = _quantisation_margin(other, other.decided_psnr - trial.decided_psnr)
            alike = (other.is_careful, other.options.deflate_level) == (trial.is_careful, trial.options.deflate_level)
            if abs(apart) > _APART and alike:
                return min(max(math.log(other.size_bytes / trial.size_bytes) / apart, _SLOPES[0]), _SLOPES[1])
        return BYTES_PER_DB

    def level(self, part: Subset) -> float:
        """Return the goal as a PSNR on the validation views, dB; their errors differ from those of the test views.

        They differ most for errors of pruning, so the level depends on the splats.
        """
        goal = self.goal.psnr or 0.0
        if not self.goal.is_judged:
            return goal
        made = [trial for trial in self.trials.made if trial.part is part]
        judged = [trial for trial in made if trial.is_judged and (trial.is_careful or not part.refits)]
        if part.refits and not judged:
            return self._level_of_fit(part, error_of_psnr(goal))
        nearest = min(judged or made[:1], key=lambda trial: abs(trial.psnr - goal))
        return goal + nearest.decided_psnr - nearest.psnr

    def _level_of_fit(self, part: Subset, allowed: float) -> float:
        """Return the level for refitted splats without a file yet: the pruning error plus the rest for quantisation.

        Errors of quantisation are alike in all views, and errors of pruning are not: these are measured on both kinds
        of views, reduced by the expected gain of the refit through the quantisers.
        """
        decided, judged = (error_of_psnr(psnr + TUNING_GAINS) for psnr in (part.psnr, self.trials.judged_psnr(part)))
        return psnr_of_mse(decided + max(allowed - judged, LEAST_QUANTISED * allowed))

    def is_hopeless(self, part: Subset) -> bool:
        """Return True if pruning takes nearly all of the error that a PSNR allows, measured on the test views."""
        if not (self.goal.is_judged and part.refits):
            return False
        judged = error_of_psnr(self.trials.judged_psnr(part) + TUNING_GAINS)
        return judged > (1.0 - LEAST_QUANTISED) * error_of_psnr(self.goal.psnr or 0.0)

    def _level_of_size(self) -> float:
        return min(self.trials.made, key=lambda trial: abs(self.goal.above(trial))).decided_psnr

    def _approach(
        self,
        part: Subset,
        coding: CodingChoice,
        start: float,
        window: SearchWindow,
        tries: int,
        above: Callable[[Candidate], float],
        *,
        careful: bool = False,
    ) -> None:
        fewer = part.refits and self.goal.size_bytes is None

        def measured(trial: Candidate) -> float:
            value = above(trial)
            if not fewer:
                return value
            # If pruning takes most of the error, a file whose total error is near enough is near enough.
            quantised = _quantisation_margin(trial, value)
            return min(quantised, window.high) if 0.0 <= value <= _ON.high else quantised

        def measure(quality: float) -> float:
            return measured(self.trials.make(part, coding, quality, quick=not careful))

        made = self.trials.of(part, coding, careful=careful)
        if part.refits and not careful:
            made = [trial for trial in made if not trial.is_careful]
        known = [(one.quality, measured(one)) for one in made if one.quality is not None]
        slope, left = _GROWS.get(coding.sh or "", 1.0), max(0, tries - len(known))
        find_in_window(
            measure, window, start=start, slope=slope, bounds=_QUALITIES, tries=left, known=known,
            flattest=_EVEN if fewer else FLATTEST, patience=1 if fewer and careful else 2,
        )  # fmt: skip

    def _nearest(self, part: Subset, coding: CodingChoice) -> Candidate:
        return min(self.trials.of(part, coding), key=lambda trial: abs(self.about(trial)))


def _quantisation_margin(trial: Candidate, above: float) -> float:
    """Return by how many dB the quantisation of a file is better than needed, if the whole file is `above` the goal.

    The error of pruning is the same at any precision; only the rest falls evenly with it, and the bytes follow that.
    """
    total, goal = error_of_psnr(trial.decided_psnr), error_of_psnr(trial.decided_psnr - above)
    removed = min(error_of_psnr(trial.part.psnr), (1.0 - LEAST_QUANTISED) * min(total, goal))
    return 10.0 * math.log10((goal - removed) / (total - removed))


def _jumps(trials: Sequence[Candidate]) -> bool:
    """Return True if a file is worse than another of less precision, by more than chance."""
    ordered = [one.decided_psnr for one in sorted(trials, key=lambda trial: trial.quality or 0.0)]
    return any(after < before - _JUMP for before, after in pairwise(ordered))


def clip_quality(quality: float) -> float:
    """Clip a PSNR of attributes to the range of the search, dB."""
    return min(max(quality, _QUALITIES[0]), _QUALITIES[1])


#: Least slope that is taken from two trials, as a fraction of the expected one: a smaller one may be noise.
FLATTEST = 0.15

_STEEPEST = 4.0  # largest slope that is taken from two trials, as a multiple of the expected one
_LONG_STEP = 0.03  # fraction of the range: over a shorter distance, values that do not grow may be noise
_BRACKET_MARGIN = 0.08  # fraction of a bracket: a trial is never nearer to its ends


def find_in_window(
    measure: Callable[[float], float],
    window: SearchWindow,
    *,
    start: float,
    slope: float,
    bounds: tuple[float, float],
    tries: int,
    known: Sequence[tuple[float, float]] = (),
    flattest: float = FLATTEST,
    patience: int = 2,
) -> list[tuple[float, float]]:
    """Try places until the value of an increasing function lies in a window.

    Args:
        measure: returns the value at a place; expensive.
        window: the range in which the value is to lie.
        start: the first place to try.
        slope: approximate slope of the value, above 0.
        bounds: the least and the largest place.
        tries: largest number of trials.
        known: places and values from before; if there are any, `start` is not used.
        flattest: least slope that is taken from two trials, as a fraction of `slope`.
        patience: number of consecutive long steps without a gain after which the search ends.

    Returns:
        Places and values in the order in which they were tried, those known first; the last one lies in the window if
        any does. Fewer than `tries` if a bound is the best possible place, or the values do not grow any more.
    """
    points = sorted(known, key=lambda point: -abs(point[1] - window.aim))  # the nearest to the aim comes last
    if points and window.low <= points[-1][1] <= window.high:
        return points
    for _ in range(tries):
        place: float | None = min(max(start, bounds[0]), bounds[1])
        if points:
            place = _next_place(points, window, slope, flattest * slope, bounds, patience)
        if place is None:
            break
        value = measure(place)
        points.append((place, value))
        if window.low <= value <= window.high:
            break
    return points


def _next_place(
    points: list[tuple[float, float]],
    window: SearchWindow,
    slope: float,
    least: float,
    bounds: tuple[float, float],
    patience: int,
) -> float | None:
    """Return the next place to try; None if a bound was tried already, or the values do not grow any more."""
    below = max((point for point in points if point[1] < window.low), default=None)
    above = min((point for point in points if point[1] > window.high), default=None)
    if below is not None and above is not None and above[0] > below[0]:
        share = (window.aim - below[1]) / (above[1] - below[1])
        share = min(max(share, _BRACKET_MARGIN), 1.0 - _BRACKET_MARGIN)
        return below[0] + share * (above[0] - below[0])
    place, value = points[-1]
    if len(points) > 1 and points[-2][0] != place:
        seen = (value - points[-2][1]) / (place - points[-2][0])
        if value < window.low and all(
            _has_stalled(points[: len(points) - back], slope, bounds) for back in range(patience)
        ):
            return None  # the values do not grow any more
        slope = min(max(seen, least), _STEEPEST * slope)
    wanted = min(max(place + (window.aim - value) / slope, bounds[0]), bounds[1])
    return None if any(wanted == tried for tried, _ in points) else wanted


def _has_stalled(points: list[tuple[float, float]], slope: float, bounds: tuple[float, float]) -> bool:
    """Return True if the last step was long and gained next to nothing; a single one may have crossed a plateau."""
    if len(points) < 2:
        return False
    (before, low), (place, high) = points[-2:]
    far = place - before >= _LONG_STEP * (bounds[1] - bounds[0])
    return far and high - low < FLATTEST * slope * (place - before)
