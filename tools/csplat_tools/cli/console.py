"""Exit statuses of the commands, and how what goes wrong on purpose is told."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from typing import ParamSpec

import typer

from csplat.errors import CsplatError
from csplat_tools.files.console import note

__all__ = ["FAILED", "INTERRUPTED", "guarded"]

FAILED = 1
INTERRUPTED = 130  # 128 + SIGINT, as shells have it

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


def _fail(message: str) -> None:
    note("error: " + " ".join(message.split()))
    raise typer.Exit(FAILED) from None


def _os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    return f"{error.filename}: {reason}" if error.filename is not None else reason


def _drop_stdout() -> None:
    """Let the interpreter flush into nothing when it ends: nobody reads it any more."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        return  # standard output is not a file here
