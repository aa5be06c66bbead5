"""Progress display: when it is shown, how often, and its text. The tests control the clock."""

import io
import sys

import pytest

from csplat_tools.console import (
    Display,
    displayed,
    format_range,
    format_seconds,
    note,
    print_data,
    progress_bar,
    step_progress,
)


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


class Terminal(io.StringIO):
    def isatty(self):
        return True


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
    assert ["encoding 40 %, about 15 s left; 0:10 so far"] == lines(display, clock, capsys, 2)
    assert 3 == len(lines(display, clock, capsys, 30))


def test_work_without_reports_is_shown_as_working(clock, capsys):
    display = Display(terminal=False, clock=clock)
    assert ["working; 0:10 so far"] == lines(display, clock, capsys, 11)
    display.report("matching", 0.0)
    display.report("matching", 1.0)
    display.report("preparing the renderer", 0.0)
    assert ["preparing the renderer; 1:00 so far"] == lines(display, clock, capsys, 50)[-1:]


def test_a_restarted_stage_estimates_its_own_time_left(clock, capsys):
    display = Display(terminal=False, clock=clock)
    display.report("tiles", 0.9)
    clock.now += 1000.0
    display.report("tiles", 0.1)
    clock.now += 20.0
    display.report("tiles", 0.5)
    display.tick()
    assert "tiles 50 %, about 20 s left; 17:00 so far\n" == capsys.readouterr().err


def test_a_stage_may_have_its_own_text(clock, capsys):
    display = Display(terminal=False, clock=clock)
    with displayed(display), step_progress("training", lambda now: f"step {now.iteration}, 3 s left") as show:
        show(type("Step", (), {"iteration": 40, "iterations": 50})())
    assert ["training step 40, 3 s left; 0:10 so far"] == lines(display, clock, capsys, 11)


def test_long_runs_announce_their_time(clock, capsys):
    def step(iteration):
        return type("Step", (), {"iteration": iteration, "iterations": 5000})()

    with step_progress("training", lambda _: "", clock=clock) as show:
        for iteration in (1000, 1100, 1200):  # a resumed run
            show(step(iteration))
            clock.now += 4.0
    assert "training takes about 2 to 5 minutes from here\n" == capsys.readouterr().err
    with step_progress("training", lambda _: "", clock=clock) as show:
        for iteration in (4600, 4800):
            show(step(iteration))
            clock.now += 4.0
    assert "" == capsys.readouterr().err


def test_a_terminal_shows_bars_after_two_seconds(clock, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    display = Display(terminal=True, clock=clock)
    display.report("tiles", 0.25)
    clock.now += 1.9
    display.tick()
    assert "" == sys.stderr.getvalue()
    clock.now += 1.1
    display.tick()
    display.close()
    assert "tiles" in sys.stderr.getvalue()
    assert "25 %, about 9 s left" in sys.stderr.getvalue()


def test_bars_are_removed_before_other_output(clock, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    with displayed(Display(terminal=True, clock=clock)) as display:
        clock.now += 5.0
        display.tick()
        assert display._bars is not None
        print_data("data")
        assert display._bars is None
        display.tick()
        note("a remark")
        assert sys.stderr.getvalue().endswith("a remark\n")
    assert "data\n" == capsys.readouterr().out  # not on standard error, which has the bars


def test_quiet_and_nested_displays_show_nothing():
    with progress_bar(quiet=True) as progress:
        assert progress is None
    with progress_bar() as outer, progress_bar() as inner, progress_bar(quiet=True) as silent:
        assert outer == inner
        assert silent is None
    with progress_bar() as later:
        assert later not in (None, outer)  # the first display went with its work


def test_durations_are_short():
    assert ["0 s", "99 s", "2 minutes"] == [format_seconds(seconds) for seconds in (0.2, 99.4, 110.0)]
    assert ["20 to 50 s", "1 to 2 minutes", "2 to 5 minutes"] == [
        format_range(*between) for between in ((20.0, 50.0), (30.0, 110.0), (120.0, 290.0))
    ]
