# SPDX-License-Identifier: Apache-2.0
"""Progress by a plan: the fraction of the whole run, whatever its stages report."""

import pytest

from csplat_tools.planned_progress import PlannedProgress, PlannedWork, planned_cost

PLAN = [
    {"looking": PlannedWork(10, 1.0)},
    {"fitting": PlannedWork(20, 2.0), "draft": PlannedWork(2, 5.0)},
    {"file": PlannedWork(1, 10.0)},
]


class Run:
    """A run whose stages take a given time, and its reports."""

    def __init__(self, plan=PLAN):
        self.now, self.reports = 100.0, []
        self.progress = PlannedProgress("search", plan, self.take, lambda: self.now)

    def take(self, stage, done):
        self.reports.append((stage, done))

    def make(self, stage, count, seconds):
        """Report a stage of some steps, each of which takes some seconds."""
        for step in range(count):
            self.now += seconds
            self.progress(stage, (step + 1) / count)

    @property
    def fractions(self):
        return [done for _, done in self.reports]

    @property
    def seconds_left(self):
        spent = self.now - 100.0
        return spent / self.fractions[-1] - spent


def test_the_time_of_a_run_that_follows_its_plan_is_known_from_its_first_stage_on():
    assert 70.0 == planned_cost(PLAN)
    for seconds in (0.1, 3.0):  # per unit of cost, on a fast and on a slow machine
        run = Run()
        run.progress("looking", 0.0)
        assert [0.0] == run.fractions
        run.make("looking", 10, seconds)
        assert run.seconds_left == pytest.approx(64.0 * seconds, rel=0.1)  # some looks may follow
        run.make("fitting", 20, 2.0 * seconds)
        assert run.seconds_left == pytest.approx(35.0 * seconds, rel=0.15)
        run.progress("file", 0.0)
        assert run.seconds_left == pytest.approx(10.0 * seconds)
        assert run.fractions == sorted(run.fractions)


def test_measured_times_replace_expected_ones():
    run = Run()
    run.make("looking", 10, 1.0)
    expected = run.seconds_left
    run.make("fitting", 10, 8.0)  # four times as long as expected
    assert run.seconds_left > 1.5 * expected


def test_other_stages_and_pauses_count_for_the_stage_that_has_begun():
    run = Run()
    run.make("looking", 10, 1.0)
    run.progress("file", 0.0)
    before = run.fractions[-1]
    run.make("tiles", 5, 1.0)  # is in no phase
    assert run.fractions[-1] > before
    assert {"search: file"} == {stage for stage, _ in run.reports[-5:]}
    run.make("fitting", 4, 0.1)  # back to an earlier phase
    assert "search: fitting" == run.reports[-1][0]
    assert 0.0 < run.fractions[-1] < 1.0


def test_a_remark_is_renewed_when_a_stage_has_ended():
    run, remarks = Run(), iter(["", "9 kB", "8 kB"])
    run.progress.note = lambda: next(remarks)
    for done in (0.0, 0.5, 1.0, 0.5, 0.6, 1.0):
        run.progress("draft", done)
    assert ["", "", "", "9 kB", "9 kB", "8 kB"] == [stage.partition("; ")[2] for stage, _ in run.reports]


def test_a_run_without_work_in_a_phase_ends():
    run = Run([{"looking": PlannedWork(3, 1.0)}, {"fitting": PlannedWork(0, 1.0)}, {"file": PlannedWork(1, 1.0)}])
    run.make("looking", 3, 1.0)
    run.progress("file", 0.0)
    run.make("file", 1, 1.0)
    assert 0.0 < run.fractions[-2] < run.fractions[-1] == 1.0
