"""Data on standard output, everything else on standard error: messages, progress, tables."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol, TextIO, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

__all__ = [
    "Progress",
    "finite",
    "format_bytes",
    "format_table",
    "note",
    "progress_bar",
    "say",
    "say_json",
    "step_progress",
]

_LINES = 10  # of progress where there is no terminal

#: What is told how far long work has come: the name of the stage, and how much of it is done, 0 to 1.
Progress = Callable[[str, float], None]


def say(text: str) -> None:
    """Print data."""
    _echo(text, sys.stdout)


def say_json(value: Any) -> None:
    """Print data for machines. NaN and infinities do not occur in it: JSON has none."""
    say(json.dumps(value, indent=2, allow_nan=False))


def finite(value: float | None) -> float | None:
    """The same; `None`, as JSON has neither, for NaN and infinities."""
    return value if value is not None and math.isfinite(value) else None


def note(text: str) -> None:
    """Print what is not data."""
    _echo(text, sys.stderr)


@contextmanager
def progress_bar(*, quiet: bool = False) -> Iterator[Progress | None]:
    """Show a bar for each stage on standard error, if that is a terminal.

    Yields:
        The callback that moves the bars; `None` where none are shown.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    with _bars("{task.description:<24}", timed=True) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: float) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0)
            bars.update(tasks[stage], completed=done)

        yield report


class Step(Protocol):
    """How far a long run has come."""

    @property
    def iteration(self) -> int: ...

    @property
    def iterations(self) -> int: ...


S = TypeVar("S", bound=Step)


@contextmanager
def step_progress(
    name: str, tell: Callable[[S], str], *, iterations: int, log_every: int, quiet: bool = False
) -> Iterator[Callable[[S], None] | None]:
    """Show the steps of a long run: a bar on a terminal, some lines elsewhere, nothing where nothing is wanted.

    Args:
        name: of what is done.
        tell: says in a line where a run stands.
        iterations: steps in all.
        log_every: steps from one report to the next.
        quiet: show nothing.
    """
    if quiet:
        yield None
        return
    if not sys.stderr.isatty():
        every = max(1, iterations // _LINES)

        def line(now: S) -> None:
            if now.iteration // every > (now.iteration - log_every) // every or now.iteration == now.iterations:
                note(tell(now))

        yield line
        return
    with _bars("{task.description}", timed=False) as bar:
        task = bar.add_task(name, total=iterations)

        def show(now: S) -> None:
            bar.update(task, completed=now.iteration, description=tell(now))

        yield show


def _bars(text: str, *, timed: bool) -> Bars:
    """Bars on standard error that vanish in the end."""
    from rich.console import Console  # takes longer to import than most commands to run
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn(text), BarColumn(), TimeElapsedColumn()) if timed else (BarColumn(), TextColumn(text))
    return Bars(*columns, console=Console(stderr=True), transient=True)


def format_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out a table as text: the first column to the left, the others to the right.

    The same on a terminal and in a pipe, so that it can be searched, cut and compared.
    """
    cells = [list(header), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(header))]
    lines = []
    for row in cells:
        first, *others = (
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join((first, *others)).rstrip())
    return "\n".join(lines)


def format_bytes(size_bytes: int) -> str:
    """Format a size for people: `12.3 MB`, MB = 10^6 bytes."""
    for unit, divisor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size_bytes >= divisor:
            return f"{size_bytes / divisor:.1f} {unit}"
    return f"{size_bytes} bytes"


def _echo(text: str, stream: TextIO) -> None:
    encoding = stream.encoding or "utf-8"  # file names and metadata may hold what it cannot
    stream.write(text.encode(encoding, "backslashreplace").decode(encoding) + "\n")
