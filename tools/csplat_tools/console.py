"""What all commands share: messages, exit statuses, progress bars, tables.

Data goes to standard output, everything else to standard error.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ParamSpec, Protocol, TextIO, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from csplat.errors import CsplatError

__all__ = [
    "FAILED",
    "INTERRUPTED",
    "Report",
    "format_bytes",
    "format_table",
    "guarded",
    "note",
    "progress_bar",
    "say",
    "say_json",
    "step_progress",
]

FAILED = 1
INTERRUPTED = 130  # 128 + SIGINT, as shells have it

_LINES = 10  # of progress where there is no terminal

#: What the encoder calls: the name of the stage, and how much of it is done, 0 to 1.
Report = Callable[[str, float], None]

P = ParamSpec("P")


def guarded(command: Callable[P, None]) -> Callable[P, None]:
    """Turn what goes wrong on purpose into one line on standard error and status 1.

    Defects of csplat itself still end in a traceback: that is what a report of them needs.
    """

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
            sys.stdout.flush()  # a closed pipe shows here, not when the interpreter ends
        except CsplatError as error:
            _fail(str(error))
        except BrokenPipeError:
            _drop_stdout()
            raise typer.Exit(FAILED) from None
        except OSError as error:
            _fail(_os_error(error))
        except MemoryError:
            _fail("out of memory")
        except KeyboardInterrupt:
            note("interrupted")
            raise typer.Exit(INTERRUPTED) from None

    return run


def say(text: str) -> None:
    """Print data."""
    _echo(text, sys.stdout)


def say_json(value: Any) -> None:
    """Print data for machines. NaN and infinities do not occur in it: JSON has none."""
    say(json.dumps(value, indent=2, allow_nan=False))


def note(text: str) -> None:
    """Print what is not data."""
    _echo(text, sys.stderr)


@contextmanager
def progress_bar(*, quiet: bool = False) -> Iterator[Report | None]:
    """Show a bar for each stage on standard error, if that is a terminal.

    Yields:
        The callback that moves the bars; `None` where none are shown.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn("{task.description:<24}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: float) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=1.0)
            progress.update(tasks[stage], completed=done)

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
    with Progress(BarColumn(), TextColumn("{task.description}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=iterations)

        def show(now: S) -> None:
            bar.update(task, completed=now.iteration, description=tell(now))

        yield show


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


def _fail(message: str) -> None:
    note("error: " + " ".join(message.split()))
    raise typer.Exit(FAILED) from None


def _os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    return f"{error.filename}: {reason}" if error.filename is not None else reason


def _echo(text: str, stream: TextIO) -> None:
    encoding = stream.encoding or "utf-8"  # file names and metadata may hold what it cannot
    stream.write(text.encode(encoding, "backslashreplace").decode(encoding) + "\n")


def _drop_stdout() -> None:
    """Let the interpreter flush into nothing when it ends: nobody reads it any more."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        return  # standard output is not a file here
