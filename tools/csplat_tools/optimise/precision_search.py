"""Find the precision at which candidates are near the goal, to compare kinds, or exactly on it, to be written."""

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
    """The accepted range of a value, from `low` to `high`; trials aim at `aim`."""

    low: float
    high: float
    aim: float


#: Least slope measured between two tries, as a fraction of the expected one; a smaller one may be noise.
FLATTEST = 0.15

_STEEPEST = 4.0  # largest slope measured between two tries, as a multiple of the expected one
_LONG_STEP = 0.03  # fraction of the range; a lack of growth over a shorter distance may be noise
_BRACKET_MARGIN = 0.08  # fraction of a bracket; least distance of a trial from its ends

#: Typical gain of a refit through the quantisers, dB; drafts count as better by this.
REFIT_GAIN = 1.1

_QUALITIES = (24.0, 110.0)  # range of the attribute PSNR, dB

_NEAR = SearchWindow(-0.8, 1.0, 0.1)  # dB above the goal: near enough to predict the cost on it
_CLOSE = SearchWindow(-0.35, 0.4, 0.05)  # dB above the goal: near enough to choose the best coding
_ON = SearchWindow(0.0, 0.15, 0.06)  # dB above the goal; PSNR jumps by about this from one precision to the next
_ON_REFITTED = SearchWindow(0.0, 0.25, 0.1)  # the same for the quantisation error of refitted splats
_WITHIN = SearchWindow(-0.35, 0.0, -0.12)  # range of a size target, in the dB that the bytes are worth
_FEW, _SOME, _MANY = 3, 4, 6  # largest numbers of tries
_JUMP = 0.25  # dB by which a file may be worse than one of less precision by chance
_ROUGH = 16  # levels of opacity; with fewer, the PSNR jumps from one precision to the next
_NEIGHBOURS = (-1.2, -0.8, -0.4, 0.4, 0.8, 1.2)  # differences of attribute PSNR to try if the PSNR jumps, dB
_APART = 0.5  # least difference in dB of two candidates between which the cost of a decibel is measured
_SLOPES = (0.02, 0.1)  # range of the fraction of the bytes that a decibel costs
_PLATEAU = 1.5  # dB below the goal; lower candidates are predicted with the steepest slope
_FORESEEN = 2.0  # dB; an excess of quantisation quality above this counts only as far as the whole file is better
_EVEN = 0.5  # least slope between two refitted candidates, as a fraction of the expected one
_STALLED = (2.0, 0.25)  # dB of precision, and the least gain per dB below which no precision reaches the goal
_GROWS = {"codebook": 0.6}  # typical dB of a file's PSNR per dB of its attribute PSNR; 1 for other codings


@dataclass(frozen=True)
class SearchGoal:
    """The goal of a search.

    Attributes:
        psnr: least PSNR of renders against the source's, dB; with `photo_psnr`, the value that is likely to meet it.
        size_bytes: largest size of the file.
        photo_psnr: least PSNR against validation images, dB.
        photo_slope: approximate growth of that per dB of `psnr`.
        max_error: largest errors of splats by measure; files that exceed one are rejected.
    """

    psnr: float | None = None
    size_bytes: int | None = None
    photo_psnr: float | None = None
    photo_slope: float = 1.0
    max_error: Mapping[str, float] = field(default_factory=dict)

    def above(self, candidate: Candidate, slope: float = BYTES_PER_DB) -> float:
        """Return by how many dB a candidate is above the goal; for a size, the dB that its excess bytes are worth.

        Args:
            candidate: the file.
            slope: fraction of the bytes that a decibel costs.
        """
        if self.size_bytes is not None:
            return math.log(candidate.size_bytes / self.size_bytes) / slope
        if self.photo_psnr is not None:
            return (candidate.photo_psnr - self.photo_psnr) / self.photo_slope
        return candidate.psnr - (self.psnr or 0.0)

    @property
    def uses_test_views(self) -> bool:
        """True if candidates are measured on the test views, since the goal is a PSNR."""
        return self.size_bytes is None and self.photo_psnr is None

    def is_met(self, candidate: Candidate) -> bool:
        """Return True if a candidate meets the goal."""
        errors = candidate.result.report.errors
        if any(errors[name][0] > most for name, most in self.max_error.items() if name in errors):
            return False
        above = self.above(candidate)
        return above <= 0.0 if self.size_bytes is not None else above >= 0.0

    def best(self, candidates: list[Candidate]) -> Candidate | None:
        """Return the smallest candidate that meets the goal; for a size, the one with the best validation PSNR."""
        good = [candidate for candidate in candidates if self.is_met(candidate)]
        if self.size_bytes is not None:
            return max(good, key=lambda candidate: candidate.validation_psnr, default=None)
        return min(good, key=lambda candidate: candidate.size_bytes, default=None)


@dataclass(eq=False)
class PrecisionSearch:
    """The search for the precision at which candidates of a subset and coding meet the goal.

    Attributes:
        candidates: makes the candidates.
        goal: the goal.
    """

    candidates: CandidatePool
    goal: SearchGoal

    def find_near(self, subset: Subset, coding: CodingChoice, start: float, tries: int = _FEW) -> Candidate:
        """Return a candidate near the goal, or the nearest of a few.

        Args:
            subset: its splats.
            coding: the coding of their colours.
            start: attribute PSNR of the first candidate, dB.
            tries: largest number of candidates.
        """
        self._approach(subset, coding, start, _NEAR, tries, self.margin)
        return self._nearest(subset, coding)

    def find_closer(self, candidate: Candidate) -> Candidate:
        """Return a candidate that is close to the goal; else make another one, and return the nearest of its kind."""
        if _CLOSE.low <= self.margin(candidate) <= _CLOSE.high:
            return candidate
        assert candidate.quality is not None
        tries = len(self.candidates.of(candidate.subset, candidate.coding)) + 1
        self._approach(candidate.subset, candidate.coding, candidate.quality, _CLOSE, tries, self.margin)
        return self._nearest(candidate.subset, candidate.coding)

    def find_on(self, subset: Subset, coding: CodingChoice) -> Candidate | None:
        """Return the best candidate on the goal, for a subset and coding with candidates near it; `None` if none is."""
        known = self._nearest(subset, coding)
        assert known.quality is not None
        if self.goal.size_bytes is not None:
            start = known.quality - self.goal.above(known, self.slope(known))
            self._approach(subset, coding, start, _WITHIN, _MANY, self.goal.above, final=True)
            return self.goal.best(self.candidates.of(subset, coding, final=True))
        if subset.refits:
            start = known.quality - _quantisation_margin(known, self.margin(known))
            self._approach(subset, coding, start, _ON_REFITTED, _SOME, self.goal.above, final=True)
            return self.goal.best(self.candidates.of(subset, coding, final=True))
        self._approach(subset, coding, known.quality, _ON, _MANY, self.goal.above)
        best = self.goal.best(self.candidates.of(subset, coding))
        if best is None:
            return None
        packed = self.candidates.make(subset, coding, best.quality, quick=False)
        return packed if self.goal.is_met(packed) else None

    def try_neighbours(self, best: Candidate) -> None:
        """Try neighbouring precisions of a candidate on the goal if the PSNR jumps, and finish the smallest on it."""
        made, levels = self.candidates.of(best.subset, best.coding), best.result.report.options["opacity_levels"]
        if self.goal.size_bytes is not None or best.subset.refits or not (levels < _ROUGH or _jumps(made)):
            return
        assert best.quality is not None
        quick = found = self.candidates.make(best.subset, best.coding, best.quality, quick=True)
        for step in _NEIGHBOURS:
            candidate = self.candidates.make(best.subset, best.coding, clip_quality(best.quality + step), quick=True)
            is_smaller = candidate.size_bytes < found.size_bytes
            if is_smaller and self.margin(candidate) > -_JUMP and self.goal.is_met(candidate):
                found = candidate
        if found is not quick:
            self.candidates.make(found.subset, found.coding, found.quality, quick=False).score_on_test_views()

    def cost(self, candidate: Candidate) -> float:
        """Return `expected_cost`; infinite if the candidate is not near the goal."""
        above = self.margin(candidate)
        far = above < _NEAR.low if self.goal.size_bytes is None else above > _NEAR.high
        return math.inf if far else self.expected_cost(candidate)

    def expected_cost(self, candidate: Candidate) -> float:
        """Return the expected log bytes of this kind of candidate on the goal; infinite if none reaches it."""
        if self.is_stalled(candidate):
            return math.inf
        by_psnr = self.goal.size_bytes is None
        goal = self.validation_goal(candidate.subset) if by_psnr else self._validation_goal_of_size()
        above = candidate.validation_psnr + self._refit_gain(candidate) - goal
        far = min(above + _PLATEAU, 0.0)  # finer steps alone do not gain this much
        above = min(_quantisation_margin(candidate, above), max(above, _FORESEEN))
        return math.log(candidate.size_bytes) - self.slope(candidate) * (above - far) - _SLOPES[1] * far

    def margin(self, candidate: Candidate) -> float:
        """Return by how many dB a candidate is above the goal, estimated from validation views.

        Drafts of refitted splats count as better by the expected gain of the refit through the quantisers.
        """
        if not self.goal.uses_test_views:
            return self.goal.above(candidate)
        return candidate.validation_psnr + self._refit_gain(candidate) - self.validation_goal(candidate.subset)

    def is_stalled(self, candidate: Candidate) -> bool:
        """Return True if more precision hardly helps a candidate below a PSNR, since its codebook is too small."""
        made = self.candidates.of(candidate.subset, candidate.coding)
        made = [one for one in made if one.is_final == candidate.is_final]
        if self.goal.size_bytes is not None or len(made) < 2:
            return False
        coarse, fine = sorted(made, key=lambda one: one.quality or 0.0)[-2:]
        apart, above = (fine.quality or 0.0) - (coarse.quality or 0.0), [self.margin(one) for one in (coarse, fine)]
        if apart < _STALLED[0] or max(above) >= 0.0:
            return False
        gained = _quantisation_margin(fine, above[1]) - _quantisation_margin(coarse, above[0])
        return gained < _STALLED[1] * apart

    def _refit_gain(self, candidate: Candidate) -> float:
        return 0.0 if candidate.is_final or not candidate.subset.refits else REFIT_GAIN

    def slope(self, candidate: Candidate) -> float:
        """Return the fraction of the bytes that a decibel of quantisation error costs for this kind of candidate."""
        for other in self.candidates.of(candidate.subset, candidate.coding):
            apart = _quantisation_margin(other, other.validation_psnr - candidate.validation_psnr)
            is_alike = other.is_final == candidate.is_final
            if abs(apart) > _APART and is_alike and other.options.deflate_level == candidate.options.deflate_level:
                return min(max(math.log(other.size_bytes / candidate.size_bytes) / apart, _SLOPES[0]), _SLOPES[1])
        return BYTES_PER_DB

    def validation_goal(self, subset: Subset) -> float:
        """Return the goal as a PSNR on the validation views, dB.

        Errors on validation and test views differ, most of all those of pruning, so the goal depends on the subset.
        """
        goal = self.goal.psnr or 0.0
        if not self.goal.uses_test_views:
            return goal
        made = [candidate for candidate in self.candidates.made if candidate.subset is subset]
        scored = [candidate for candidate in made if candidate.is_scored and (candidate.is_final or not subset.refits)]
        if subset.refits and not scored:
            return self._validation_goal_of_fit(subset, error_of_psnr(goal))
        nearest = min(scored or made[:1], key=lambda candidate: abs(candidate.psnr - goal))
        return goal + nearest.validation_psnr - nearest.psnr

    def _validation_goal_of_fit(self, subset: Subset, allowed: float) -> float:
        """Return the goal for refitted splats without a candidate yet: the pruning error, the rest for quantisation.

        Quantisation errors are similar in all views. Pruning errors are not: they are measured on both kinds of views,
        reduced by the expected gain of the refit through the quantisers.
        """
        validation, test = (
            error_of_psnr(psnr + REFIT_GAIN) for psnr in (subset.psnr, self.candidates.test_psnr(subset))
        )
        return psnr_of_mse(validation + max(allowed - test, LEAST_QUANTISED * allowed))

    def is_hopeless(self, subset: Subset) -> bool:
        """Return True if pruning takes nearly all of the allowed error on the test views."""
        if not (self.goal.uses_test_views and subset.refits):
            return False
        pruning = error_of_psnr(self.candidates.test_psnr(subset) + REFIT_GAIN)
        return pruning > (1.0 - LEAST_QUANTISED) * error_of_psnr(self.goal.psnr or 0.0)

    def _validation_goal_of_size(self) -> float:
        return min(self.candidates.made, key=lambda candidate: abs(self.goal.above(candidate))).validation_psnr

    def _approach(
        self,
        subset: Subset,
        coding: CodingChoice,
        start: float,
        window: SearchWindow,
        tries: int,
        above: Callable[[Candidate], float],
        *,
        final: bool = False,
    ) -> None:
        fewer = subset.refits and self.goal.size_bytes is None

        def measured(candidate: Candidate) -> float:
            value = above(candidate)
            if not fewer:
                return value
            # If pruning takes most of the error, a total error near the goal suffices.
            quantised = _quantisation_margin(candidate, value)
            return min(quantised, window.high) if 0.0 <= value <= _ON.high else quantised

        def measure(quality: float) -> float:
            return measured(self.candidates.make(subset, coding, quality, quick=not final))

        made = self.candidates.of(subset, coding, final=final)
        if subset.refits and not final:
            made = [candidate for candidate in made if not candidate.is_final]
        known = [(one.quality, measured(one)) for one in made if one.quality is not None]
        slope, tries_left = _GROWS.get(coding.sh or "", 1.0), max(0, tries - len(known))
        find_in_window(
            measure, window, start=start, slope=slope, bounds=_QUALITIES, tries=tries_left, known=known,
            flattest=_EVEN if fewer else FLATTEST, patience=1 if fewer and final else 2,
        )  # fmt: skip

    def _nearest(self, subset: Subset, coding: CodingChoice) -> Candidate:
        return min(self.candidates.of(subset, coding), key=lambda candidate: abs(self.margin(candidate)))


def _quantisation_margin(candidate: Candidate, above: float) -> float:
    """Return by how many dB the quantisation of a candidate is better than needed, if it is `above` the goal.

    Precision does not change the error of pruning; bytes depend on the error of quantisation only.
    """
    total, goal = error_of_psnr(candidate.validation_psnr), error_of_psnr(candidate.validation_psnr - above)
    pruning = min(error_of_psnr(candidate.subset.psnr), (1.0 - LEAST_QUANTISED) * min(total, goal))
    return 10.0 * math.log10((goal - pruning) / (total - pruning))


def _jumps(candidates: Sequence[Candidate]) -> bool:
    """Return True if a candidate is worse than another of less precision, by more than chance."""
    ordered = [one.validation_psnr for one in sorted(candidates, key=lambda candidate: candidate.quality or 0.0)]
    return any(after < before - _JUMP for before, after in pairwise(ordered))


def clip_quality(quality: float) -> float:
    """Clip a PSNR of attributes to the range of the search, dB."""
    return min(max(quality, _QUALITIES[0]), _QUALITIES[1])


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
    """Try arguments until the value of an increasing function is in a window.

    Args:
        measure: the function; expensive.
        window: the accepted range of the value.
        start: the first argument to try.
        slope: approximate slope of the function, above 0.
        bounds: the least and the largest argument.
        tries: largest number of trials.
        known: known arguments and values; if there are any, `start` is ignored.
        flattest: least slope measured between two trials, as a fraction of `slope`.
        patience: number of consecutive long steps without a gain that end the search.

    Returns:
        Arguments and values, known ones first, then in the order of trials; the last one is in the window if any is.
        The search ends early if a bound is the best possible argument, or the values stop growing.
    """
    points = sorted(known, key=lambda point: -abs(point[1] - window.aim))  # the nearest to the aim last
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
    """Return the next argument to try; `None` if a bound was tried already, or the values stopped growing."""
    below = max((point for point in points if point[1] < window.low), default=None)
    above = min((point for point in points if point[1] > window.high), default=None)
    if below is not None and above is not None and above[0] > below[0]:
        fraction = (window.aim - below[1]) / (above[1] - below[1])
        fraction = min(max(fraction, _BRACKET_MARGIN), 1.0 - _BRACKET_MARGIN)
        return below[0] + fraction * (above[0] - below[0])
    place, value = points[-1]
    if len(points) > 1 and points[-2][0] != place:
        seen = (value - points[-2][1]) / (place - points[-2][0])
        if value < window.low and all(
            _has_stalled(points[: len(points) - back], slope, bounds) for back in range(patience)
        ):
            return None  # the values stopped growing
        slope = min(max(seen, least), _STEEPEST * slope)
    wanted = min(max(place + (window.aim - value) / slope, bounds[0]), bounds[1])
    return None if any(wanted == tried for tried, _ in points) else wanted


def _has_stalled(points: list[tuple[float, float]], slope: float, bounds: tuple[float, float]) -> bool:
    """Return True if the last step was long and hardly gained anything; a single one may have crossed a plateau."""
    if len(points) < 2:
        return False
    (before, low), (place, high) = points[-2:]
    far = place - before >= _LONG_STEP * (bounds[1] - bounds[0])
    return far and high - low < FLATTEST * slope * (place - before)
