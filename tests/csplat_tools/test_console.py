# SPDX-License-Identifier: Apache-2.0
"""Progress display: when it is shown, how often, and its text. The tests control the clock."""

import io
import itertools
import sys
from types import SimpleNamespace

import pytest

from csplat.errors import InputError
from csplat.types import null_progress
from csplat_tools import console
from csplat_tools.console import Display, displayed, progress_bar, step_progress
from csplat_tools.training.tuning_report import describe_step
from csplat_trainer.fitter import FitStep


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def lines(display, clock, capsys, seconds):
    """Return the lines printed within some seconds, with ten ticks per second."""
    for _ in range(round(seconds * 10)):
        clock.now += 0.1
        display.tick()
    return capsys.readouterr().err.splitlines()


def test_without_a_terminal_a_line_is_printed_every_ten_seconds(clock, capsys):
    display = Display(terminal=False, clock=clock)
    display.report("reading", 1.0)
    display.report("encoding", 0.0)
    assert [] == lines(display, clock, capsys, 9)
    display.report("encoding", 0.4)
    (line,) = lines(display, clock, capsys, 2)
    assert "40 %, about 15 s left" in line
    display.report("encoding", 1.0)
    display.report("preparing the renderer", 0.0)  # without reports until it ends
    seen = lines(display, clock, capsys, 30)
    assert (3, False) == (len(seen), "%" in seen[-1])


def test_a_restarted_stage_estimates_its_own_time_left(clock, capsys):
    display = Display(terminal=False, clock=clock)
    for share, seconds in ((0.9, 1000.0), (0.1, 20.0), (0.5, 0.0)):
        display.report("tiles", share)
        clock.now += seconds
    display.tick()
    assert "50 %, about 20 s left" in capsys.readouterr().err


def test_a_stage_with_a_detail_keeps_its_start_until_it_begins_again(clock, capsys):
    display = Display(terminal=False, clock=clock)
    for detail, share, seconds in (("views", 0.0, 20.0), ("refit; best so far 9 kB", 0.5, 20.0), ("file", 0.4, 0.0)):
        display.report(f"search: {detail}", share)
        clock.now += seconds
    display.tick()
    assert "search 40 %, about 60 s left; file; 0:40 so far" in capsys.readouterr().err
    display.report("search: views", 0.0)
    clock.now += 10.0
    display.report("search: views", 0.5)
    display.tick()
    assert "search 50 %, about 10 s left; views" in capsys.readouterr().err


def test_a_stage_may_have_its_own_text_and_long_runs_announce_their_time(clock, capsys):
    display = Display(terminal=False, clock=clock)
    with displayed(display), step_progress("training", lambda now: f"step {now.iteration}, 3 s left") as show:
        show(SimpleNamespace(iteration=40, iterations=50))
    assert "step 40, 3 s left" in lines(display, clock, capsys, 11)[0]
    for iterations, announced in ((range(1000, 1300, 100), True), (range(4600, 5000, 200), False)):
        with step_progress("training", lambda _: "", clock=clock) as show:
            for iteration in iterations:  # a run that resumes
                show(SimpleNamespace(iteration=iteration, iterations=5000))
                clock.now += 4.0
        assert announced == ("2 to 4 minutes" in capsys.readouterr().err)


def test_an_expected_time_is_announced_before_the_first_step_and_again_if_the_run_takes_longer(clock, capsys):
    with step_progress("training", lambda _: "", expected=100.0, clock=clock) as show:
        assert "training takes about 1 to 2 minutes\n" == capsys.readouterr().err  # 80 to 150 s
        for iteration in range(0, 600, 100):
            show(SimpleNamespace(iteration=iteration, iterations=1000))
            clock.now += 13.0
        assert "" == capsys.readouterr().err
        for iteration in range(600, 1000, 100):
            show(SimpleNamespace(iteration=iteration, iterations=1000))
            clock.now += 60.0
    assert "training takes longer than that here: about 59 s from now\n" == capsys.readouterr().err
    with step_progress("training", lambda _: "", expected=100.0, quiet=True):
        assert "" == capsys.readouterr().err


def test_another_run_has_its_own_time_and_an_announced_time_is_not_announced_again(clock, capsys):
    for options, announced in (
        ({}, ["tuning takes about 23 to 44 s from here", "another tuning takes about 23 to 44 s from here"]),
        ({"announced": True}, []), ({"announced": True, "expected": 40.0}, []),
    ):  # fmt: skip
        with step_progress("tuning", lambda _: "", clock=clock, **options) as show:
            for _ in range(2):
                clock.now += 60.0  # choosing splats
                for before, iteration in itertools.pairwise((0, 2, 10, 30, 200, 375)):
                    clock.now += 0.08 * (iteration - before)
                    show(SimpleNamespace(iteration=iteration, iterations=375))
        assert announced == capsys.readouterr().err.splitlines()
    with step_progress("training", lambda _: "", expected=40.0, announced=True, clock=clock) as show:
        for iteration in range(0, 100, 10):
            show(SimpleNamespace(iteration=iteration, iterations=100))
            clock.now += 30.0
    assert "training takes longer than that here: about 4 minutes from now\n" == capsys.readouterr().err


@pytest.mark.parametrize("size_bytes", [None, 149_700])
def test_a_terminal_of_eighty_columns_shows_the_time_left_of_a_training(clock, monkeypatch, size_bytes):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    now = FitStep(12_300, 30_000, 0.0243, 31.17, 1_500_000, 3, 3600.0, 7200.0, size_bytes)
    with displayed(Display(terminal=True, clock=clock)) as display:
        display.report("training", 0.4, describe_step(now))
        clock.now += 3.0
        display.tick()
        assert "2 h 0 min left" in sys.stderr.getvalue()
        assert "1,500,000 splats" in sys.stderr.getvalue()


def test_a_terminal_shows_bars_after_two_seconds_and_removes_them_before_other_output(clock, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    with displayed(Display(terminal=True, clock=clock)) as display:
        display.report("tiles", 0.25)
        for seconds, shown in ((1.9, False), (1.1, True)):
            clock.now += seconds
            display.tick()
            assert shown == ("25 %, about 9 s left" in sys.stderr.getvalue())
        assert display._bars is not None
        console.print_data("data")
        assert display._bars is None
        display.tick()
        console.note("a remark")
        assert sys.stderr.getvalue().endswith("a remark\n")
    assert "data\n" == capsys.readouterr().out  # not on standard error, which has the bars


def test_quiet_and_nested_displays_show_nothing_and_durations_are_short():
    with progress_bar(quiet=True) as progress:
        assert null_progress is progress
    with progress_bar() as outer, progress_bar() as inner, progress_bar(quiet=True) as silent:
        assert (outer, null_progress) == (inner, silent)
    with progress_bar() as later:
        assert later not in (null_progress, outer)  # the first display went with its work
    times = {"30min": 1800.0, "1h": 3600.0, " 1 h 30 min": 5400.0, "0.5H": 1800.0, "90s": 90.0, "1h1s": 3601.0}
    assert times == {text: console.parse_seconds(text) for text in times}
    for text in ("", "0min", "30", "1min1h", "-1h", "1e400h"):
        with pytest.raises(InputError, match="expected hours, minutes or seconds"):
            console.parse_seconds(text)
    durations = {0.2: "0 s", 99.4: "99 s", 110.0: "2 minutes", 24116.0: "6 h 42 min"}
    assert durations == {seconds: console.format_seconds(seconds) for seconds in durations}
    ranges = {(20.0, 50.0): "20 to 50 s", (30.0, 110.0): "1 to 2 minutes", (120.0, 290.0): "2 to 5 minutes"}
    ranges |= {(5400.0, 14000.0): "1.5 to 3.9 h"}
    assert ranges == {between: console.format_range(*between) for between in ranges}
