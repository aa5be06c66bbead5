# SPDX-License-Identifier: Apache-2.0
"""Progress of a long run with several phases: the fraction of the whole, from the reports of its stages and a plan."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from csplat.types import Progress

#: Cost of a step of a refit, relative to a view of `view_cost`.
STEP_COST = 1.35

_SPLAT_PIXELS = 8.0  # pixels that take as long as a splat; fits of five scenes of 14,000 to 120,000 splats, one thread
_MOST = 0.99  # largest fraction before the end
_TRUST = 0.05  # fraction of the expected reports that count as much as those that came, in the time of a report


@dataclass(frozen=True)
class PlannedWork:
    """The expected work of a stage.

    Attributes:
        count: expected number of its reports with a fraction above 0, such as one for each view or step.
        cost: expected time for each, in any unit that all stages of the plan share.
    """

    count: float
    cost: float


#: Phases in their order, each with the work of its stages.
Plan = Sequence[Mapping[str, PlannedWork]]


def view_cost(pixels: float, splats: float) -> float:
    """Return the cost of measuring the pruning error of splats in a view, which is the usual unit of plans."""
    return pixels + _SPLAT_PIXELS * splats


def planned_cost(plan: Plan) -> float:
    """Return the expected time of a plan, in its unit."""
    return sum(work.count * work.cost for phase in plan for work in phase.values())


class PlannedProgress:
    """A progress callback for the stages of a run, which reports the run as a single stage.

    It reports `run: stage; note`, and the expected fraction of the time of the run. The fraction depends on the clock,
    and falls if the run turns out to be longer; nothing else depends on either.

    Args:
        run: name of the run.
        plan: its phases. A report of a stage ends the phases before, and 1 of the last stage of the plan ends the run.
            Stages that are not in the plan are not told from the last that is.
        report: called with the name and the fraction.
        clock: returns seconds.

    Attributes:
        note: returns a remark to report, such as the best result so far; called when a stage ends, and after that.
    """

    def __init__(self, run: str, plan: Plan, report: Progress, clock: Callable[[], float] = time.perf_counter) -> None:
        self.note: Callable[[], str] = str
        self._run, self._report, self._clock = run, report, clock
        self._phases = [{name: _Stage(name, work) for name, work in phase.items()} for phase in plan]
        self._phase, self._last, self._remark = 0, _Stage("", PlannedWork(0.0, 0.0)), ""
        self._open: _Stage | None = None
        self._is_over = False  # the last report was 1
        self._begun = self._at = clock()  # start, and time of the last report of a stage of the plan

    def __call__(self, stage: str, done: float) -> None:
        """Take the report of a stage.

        The time since the last report counts for the stage, if that was of the same; otherwise for the stage that has
        reported 0 and not yet 1, if any, such as a file whose refit has just begun, or for the stage before.
        """
        now, later = self._clock(), range(self._phase, len(self._phases))
        number = next((number for number in (*later, *range(self._phase)) if stage in self._phases[number]), None)
        if number is not None:
            reported = self._phases[number][stage]
            spent = reported if reported is self._last else self._open or self._last
            spent.seconds += now - self._at
            reported.count += done > 0.0
            if done == 0.0:
                self._open = reported
            elif done >= 1.0 and self._open is reported:
                self._open = None
            if done >= 1.0 or self._is_over:
                self._remark = self.note()
            self._phase, self._last, self._at, self._is_over = number, reported, now, done >= 1.0
        has_ended = self._is_over and self._last is [*self._phases[-1].values()][-1]
        words = "; ".join(filter(None, (self._last.name, self._remark)))
        self._report(f"{self._run}: {words}", 1.0 if has_ended else self._fraction(now))

    def _fraction(self, now: float) -> float:
        """Return the expected fraction of the run's time that is over: 0 before anything is known, `_MOST` at most."""
        known = [stage for phase in self._phases for stage in phase.values() if stage.count]
        cost, seconds = sum(stage.count * stage.work.cost for stage in known), sum(stage.seconds for stage in known)
        if not cost or not seconds:
            return 0.0
        speed, spent = seconds / cost, now - self._begun
        left = sum(stage.left * stage.each(speed) for phase in self._phases[self._phase :] for stage in phase.values())
        left -= min(now - self._at, self._last.each(speed))
        return min(spent / (spent + max(left, 0.0)), _MOST)


@dataclass
class _Stage:
    """The work of a stage, and the seconds and the number of its reports so far."""

    name: str
    work: PlannedWork
    seconds: float = field(default=0.0, init=False)
    count: int = field(default=0, init=False)

    @property
    def left(self) -> float:
        """The expected number of reports to come: all at first, few but some when the expected number is exceeded."""
        return self.work.count * math.exp(-self.count / self.work.count) if self.work.count else 0.0

    def each(self, speed: float) -> float:
        """Return the expected seconds for a report, given the seconds per unit of cost of all stages."""
        expected = max(_TRUST * self.work.count, 1.0)
        return (expected * self.work.cost * speed + self.seconds) / (expected + self.count)
