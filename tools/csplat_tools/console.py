# SPDX-License-Identifier: Apache-2.0
"""Print data on standard output, messages and progress on standard error; format and parse sizes and durations.

Progress is a bar on a terminal, otherwise a line every ten seconds. There is at most one display at a time.
"""

from __future__ import annotations

import json
import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TextIO, TypeVar

from csplat.errors import InputError
from csplat.file_source import named_errors
from csplat.types import Progress, null_progress

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


_BAR_DELAY = 2.0  # seconds before a terminal shows bars
_LINE_EVERY = 10.0  # seconds between lines if standard error is not a terminal
_TICK = 0.2  # seconds between updates of the display
_ESTIMATE_FROM = (0.03, 1.0)  # fraction done and seconds of a stage from which its remaining time is estimated
_TIMED_REPORTS = 2  # number of reports of a long run after which its time is estimated
_RUN_RANGE = (0.8, 1.5)  # range of the estimate of a run, as factors
_SURE_SECONDS = 20.0  # time of a run's own steps after which they overrule the estimate
_RENDER_RANGE = (0.6, 1.7)  # the same for estimates from the time of renders
_STAGES = 2  # stages shown at a time: the last that were reported
_WORKING = "working"  # shown if no stage is known
_MINUTES_FROM = 100.0  # seconds; longer durations are given in minutes
_HOURS_FROM = 100  # minutes; longer durations are given in hours

#: Regular expression of a number, with one group.
NUMBER = r"([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)"


_DURATION = re.compile(rf"(?:{NUMBER}\s*h)?\s*(?:{NUMBER}\s*min)?\s*(?:{NUMBER}\s*s)?")

STANDARD_OUTPUT = "standard output"  # its name in messages

#: Seconds. The expected time of longer work is announced.
LONG_WORK_SECONDS = 10.0


def print_data(text: str) -> None:
    """Print data.

    Raises:
        OSError: standard output, which the error names, cannot be written.
    """
    with named_errors(STANDARD_OUTPUT):
        _echo(text, sys.stdout)


def print_json(value: Any) -> None:
    """Print a value as JSON. NaN and infinities are refused, since JSON has none."""
    print_data(json.dumps(value, indent=2, allow_nan=False))


def note(text: str) -> None:
    """Print a message on standard error, if it can be written."""
    try:
        _echo(text, sys.stderr)
        sys.stderr.flush()
    except OSError:
        drop_stream(sys.stderr)


def drop_stream(stream: TextIO) -> None:
    """Redirect a standard stream to the null device, so that the interpreter's flush at exit cannot fail."""
    with suppress(OSError, ValueError):  # the stream is not a file here
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class RunProgress(Protocol):
    """The progress of a long run."""

    @property
    def iteration(self) -> int:
        """Return the current iteration."""

    @property
    def iterations(self) -> int:
        """Return the number of all iterations."""


S = TypeVar("S", bound=RunProgress)


@contextmanager
def progress_bar(*, quiet: bool = False) -> Iterator[Progress]:
    """Show progress, on the display that is shown already if there is one.

    Yields:
        The progress callback, `null_progress` if nothing is shown.
    """
    with _ticking_display(quiet=quiet) as display:
        yield null_progress if display is None else display.report


@contextmanager
def step_progress(
    name: str,
    describe: Callable[[S], str],
    *,
    expected: float | None = None,
    announced: bool = False,
    quiet: bool = False,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Callable[[S], None] | None]:
    """Show the progress of a long run with its own text, and announce its expected time, again if it turns out longer.

    Args:
        name: name of the run.
        describe: returns a line on the state of the run and the time left.
        expected: expected time of the run, seconds; `None`: it is estimated from the first reports.
        announced: the time has been announced, perhaps as a part of that of a longer run.
        quiet: show nothing.
        clock: returns seconds.

    Yields:
        A callback for each step; `None` if nothing is shown. Fewer steps than before begin another run.
    """
    reports: list[tuple[float, int]] = []
    unknown, subject = math.inf if announced else None, name
    most = unknown if expected is None else _announce(name, expected, quiet=quiet or announced)

    def show(now: S) -> None:
        nonlocal most, subject
        if reports and now.iteration < reports[-1][1]:
            reports.clear()
            most, subject = unknown, f"another {name}"
        reports.append((clock(), now.iteration))
        if len(reports) >= _TIMED_REPORTS:  # the first steps are slower, since they load and compile
            (begun, first), (seconds, last) = reports[0], reports[-1]
            left = (seconds - begun) / max(1, last - first) * (now.iterations - last)
            if most is None:
                most = seconds - begun + _announce(subject, left, " from here")
            elif left > LONG_WORK_SECONDS and seconds - begun > _SURE_SECONDS and seconds - begun + left > most:
                note(f"{name} takes longer than that here: about {format_seconds(left)} from now")
                most = _RUN_RANGE[1] * (seconds - begun + left)
        if display is not None:
            display.report(name, now.iteration / now.iterations, describe(now))

    with _ticking_display(quiet=quiet) as display:
        yield None if display is None else show


def _announce(name: str, seconds: float, suffix: str = "", *, quiet: bool = False) -> float:
    """Announce the expected time of a run, unless it is short; return the upper end of the announced range, seconds."""
    if seconds > LONG_WORK_SECONDS and not quiet:
        note(f"{name} takes about {format_range(_RUN_RANGE[0] * seconds, _RUN_RANGE[1] * seconds)}{suffix}")
    return max(LONG_WORK_SECONDS, _RUN_RANGE[1] * seconds)


@dataclass
class _Stage:
    """A stage of the work: its start, and its last report."""

    begun: float
    done: float = 0.0
    detail: str = ""
    text: str | None = None


class Display:
    """A display of progress. Owns the stages and the bars.

    A terminal shows nothing for two seconds, then a bar for each unfinished stage. Otherwise a line is printed every
    ten seconds. `tick` is called often, even without reports, so that silent work is shown as well.

    Args:
        terminal: True if standard error is a terminal.
        clock: returns seconds.
    """

    def __init__(self, *, terminal: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._terminal, self._clock, self._lock = terminal, clock, threading.RLock()
        self._begun = self._printed = clock()
        self._stages: dict[str, _Stage] = {}
        self._bars: Bars | None = None
        self._tasks: dict[str, TaskID] = {}

    def report(self, stage: str, done: float, text: str | None = None) -> None:
        """Record the progress of a stage.

        Args:
            stage: its name, or `name: detail`, of which the detail may change from report to report.
            done: fraction done, 0 to 1; 0, or a smaller fraction than before without a detail, restarts the stage.
            text: text to show instead of percentage and time left.
        """
        name, _, detail = stage.partition(": ")
        with self._lock:
            known = self._stages.pop(name, None)
            if known is None or done == 0.0 or (done < known.done and not detail):
                known = _Stage(self._clock())
            known.done, known.detail, known.text = done, detail, text
            self._stages[name] = known  # moved to the end of the order

    def tick(self) -> None:
        """Update the bars, or print a line if one is due."""
        with self._lock:
            now = self._clock()
            unfinished = [(name, stage) for name, stage in self._stages.items() if stage.done < 1.0][-_STAGES:]
            if self._terminal:
                if now - self._begun >= _BAR_DELAY:
                    self._update_bars(unfinished or [(_WORKING, _Stage(now))], now)
            elif now - self._printed >= _LINE_EVERY:
                self._printed = now
                text = "; ".join(f"{name} {_stage_text(stage, now)}".rstrip() for name, stage in unfinished) or _WORKING
                minutes, seconds = divmod(int(now - self._begun), 60)
                note(f"{text}; {minutes}:{seconds:02d} so far")

    def hide_bars(self) -> None:
        """Remove the bars from the terminal, before other output or at the end; the next tick shows them again."""
        with self._lock:
            if self._bars is not None:
                self._bars.stop()
            self._bars, self._tasks = None, {}

    def _update_bars(self, unfinished: Sequence[tuple[str, _Stage]], now: float) -> None:
        """Show and update a bar for each unfinished stage, by name, and remove the others; `now` is in seconds."""
        if self._bars is None:
            self._bars = _new_bars()
            self._bars.start()
        for name in self._tasks.keys() - dict(unfinished).keys():
            self._bars.remove_task(self._tasks.pop(name))
        for name, stage in unfinished:
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(name, words="")
            total = 1.0 if stage.done > 0.0 else None  # None: an indeterminate bar
            self._bars.update(self._tasks[name], completed=stage.done, total=total, words=_stage_text(stage, now))
        self._bars.refresh()


def format_table(header: Sequence[str], rows: Sequence[Sequence[object]], *, left: int = 1) -> str:
    """Format a table, the first `left` columns flush left, the others flush right, also in a pipe."""
    cells = [list(header), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(header))]
    lines = []
    for row in cells:
        placed = (
            cell.rjust(width) if column >= left else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join(placed).rstrip())
    return "\n".join(lines)


def format_bytes(size_bytes: int) -> str:
    """Format a size: `12.3 MB`, MB = 10^6 bytes."""
    for unit, divisor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size_bytes >= divisor:
            return f"{size_bytes / divisor:.1f} {unit}"
    return f"{size_bytes} bytes"


def format_seconds(seconds: float) -> str:
    """Format a duration, rounded: `12 s`, `3 minutes`, `1 h 12 min`."""
    if seconds < _MINUTES_FROM:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} minutes" if minutes < _HOURS_FROM else f"{minutes // 60} h {minutes % 60} min"


def parse_seconds(text: str) -> float:
    """Parse a duration: `90s`, `30min`, `1.5h`, `1h30min`; return seconds.

    Raises:
        InputError: it is not a duration, or 0.
    """
    match = _DURATION.fullmatch(text.strip().lower())
    seconds = sum(
        float(number) * unit for number, unit in zip(match.groups(), (3600.0, 60.0, 1.0), strict=True) if number
    ) if match else 0.0  # fmt: skip
    if not 0.0 < seconds < math.inf:
        raise InputError(f"a time is {text!r}, expected hours, minutes or seconds, as 1h, 30min or 90s")
    return seconds


def format_estimate(seconds: float) -> str:
    """Format an estimated duration as a range: `20 to 50 s`."""
    return format_range(_RENDER_RANGE[0] * seconds, _RENDER_RANGE[1] * seconds)


def format_range(least: float, most: float) -> str:
    """Format a range of durations: `20 to 50 s`, `2 to 5 minutes`, `1.5 to 4.0 h`."""
    if most < _MINUTES_FROM:
        return f"{least:.0f} to {most:.0f} s"
    if most < 60.0 * _HOURS_FROM:
        return f"{max(1.0, least / 60.0):.0f} to {most / 60.0:.0f} minutes"
    return f"{least / 3600.0:.1f} to {most / 3600.0:.1f} h"


_displays: list[Display] = []  # the display that is shown; at most one


@contextmanager
def displayed(display: Display) -> Iterator[Display]:
    """Show progress on a display within the context. `print_data` and `note` remove its bars first."""
    _displays.append(display)
    try:
        yield display
    finally:
        _displays.remove(display)
        display.hide_bars()


@contextmanager
def _ticking_display(*, quiet: bool) -> Iterator[Display | None]:
    """Show a display that a thread updates every `_TICK` seconds, unless one is shown already, which is yielded then.

    Yields:
        The display; `None` if `quiet`.
    """
    if quiet:
        yield None
        return
    if _displays:
        yield _displays[0]
        return
    ended = threading.Event()

    with displayed(Display(terminal=sys.stderr.isatty())) as display:

        def tick() -> None:
            """Update the display until the context ends."""
            while not ended.wait(_TICK):
                display.tick()

        thread = threading.Thread(target=tick, name="csplat progress", daemon=True)
        thread.start()
        try:
            yield display
        finally:
            ended.set()
            thread.join()


def _stage_text(stage: _Stage, now: float) -> str:
    """Return the text of a stage: its own, or the percentage that is done, the estimated time left, and the detail.

    The estimate is left out early in a stage, and the percentage before any progress. `now` is in seconds, as `begun`.
    """
    if stage.text is not None:
        return stage.text
    words, seconds = [f"{100.0 * stage.done:.0f} %"] if stage.done > 0.0 else [], now - stage.begun
    if stage.done >= _ESTIMATE_FROM[0] and seconds >= _ESTIMATE_FROM[1]:
        words.append(f"about {format_seconds(seconds * (1.0 / stage.done - 1.0))} left")
    return "; ".join(filter(None, (", ".join(words), stage.detail)))


def _new_bars() -> Bars:
    """Return bars on standard error that vanish when stopped, and do not redirect standard output."""
    from rich.console import Console  # slow to import compared with most commands
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[words]}"))
    console = Console(stderr=True)
    return Bars(
        *columns, console=console, transient=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
    )  # fmt: skip


#: Control characters but tabs and line ends: in file names and metadata they would command the terminal.
_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\t\n"}


def _echo(text: str, stream: TextIO) -> None:
    """Write a line after hiding bars, with escapes for control characters and those that the encoding lacks.

    Raises:
        OSError: the stream cannot be written.
    """
    for display in _displays:
        display.hide_bars()  # bars and lines on one terminal do not mix
    text = text.translate(_CONTROLS)
    encoding = stream.encoding or "utf-8"  # may lack characters of file names and metadata
    stream.write(text.encode(encoding, "backslashreplace").decode(encoding) + "\n")
