# SPDX-License-Identifier: Apache-2.0
"""Errors of the command line: one line on standard error, and a status."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import typer

from csplat.disk_files import is_temporary, temporary_root
from csplat.errors import CsplatError, InputError, LimitError
from csplat.file_source import named_errors
from csplat_tools.console import STANDARD_OUTPUT, drop_stream, note

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells

#: Base class of the errors that typer raises for a command line. Typer exports only one of its subclasses.
UsageError: type[Exception] = typer.BadParameter.__bases__[0]

_AGAIN = "copy or download it again"
_NEWER = "a newer csplat may know it"
_INVALID = ("the file contradicts itself", f"{_AGAIN}; `csplat verify` lists all that is wrong")
_DAMAGED = ("the file is damaged", _AGAIN)
#: By error code of the format: the defect, and the remedy. The viewer has the same in `tools/viewer/messages.mjs`.
_DEFECTS = {
    "E_MAGIC": ("not a .csplat file", "`csplat encode` makes one of a PLY"),
    "E_VERSION": ("written in another version of the format", _NEWER),
    "E_TRUNCATED": ("the file ends too early", _AGAIN),
    "E_TRAILING": ("something follows the end of the file", _AGAIN),
    "E_CRC": _DAMAGED,
    "E_CODER": _DAMAGED,
    "E_UNSUPPORTED": ("", _NEWER),
    "E_STORE": ("", "nothing was kept; try again"),
    "E_LIMIT": (
        "the scene is larger than is allowed here",
        "without --limit-splats, `csplat decode` and `csplat verify` take scenes of any size",
    ),
}
_LONG_TEXT = (
    "its metadata or cameras take more memory than is allowed here",
    "in Python `csplat.decode(file, limits=csplat.Limits(json_bytes=...))` reads them",
)
_LOST_URL = re.compile(r"([a-z][a-z0-9+]+):/+(.+)")  # a URL read as a path, which loses a slash
_OS_ADVICE = {
    errno.ENOENT: "is the name right?",
    errno.EACCES: "check its permissions",
    errno.EISDIR: "name a file",
    errno.EIO: "the disk or the connection to it failed; try again, or use a copy elsewhere",
    errno.ELOOP: "the links lead back to themselves; name another file",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EROFS: "choose another location",
    errno.ENOSPC: "no partial file was left; free some space, or choose another location",
    errno.EFBIG: "no partial file was left; choose another location",
    errno.EDQUOT: "no partial file was left; free some space, or choose another location",
}
_EMPTY_PHRASES = re.compile(r"^Invalid value: |(?<=: )Value error, |\.$")  # in typer's messages


@contextmanager
def report_errors() -> Iterator[None]:
    """Turn expected errors into one line on standard error and status 1.

    Defects of csplat itself still end in a traceback: a bug report needs it.

    Raises:
        typer.Exit: an error was printed, the command was interrupted, or standard output was closed.
    """
    try:
        yield
        with named_errors(STANDARD_OUTPUT):
            sys.stdout.flush()  # a closed pipe shows here, not when the interpreter ends
    except CsplatError as error:
        _fail(_describe_csplat_error(error), error.code)
    except BrokenPipeError:
        drop_stream(sys.stdout)
        raise typer.Exit(EXIT_FAILED) from None
    except OSError as error:
        if error.filename == STANDARD_OUTPUT:
            drop_stream(sys.stdout)
        _fail(_describe_os_error(error), errno.errorcode.get(error.errno or 0, ""))
    except MemoryError:
        _fail("out of memory", "")
    except KeyboardInterrupt as interrupt:
        note(str(interrupt) or "interrupted")
        raise typer.Exit(EXIT_INTERRUPTED) from None


def usage_message(error: Any) -> str:
    """Return the message of an error in a command line, in one line."""
    return " ".join(_EMPTY_PHRASES.sub("", error.format_message()).split())


def refuse_command_line(error: Any) -> NoReturn:
    """Print an error in a command line, in the form of other errors, and exit with status 2."""
    message = usage_message(error)
    if message:  # empty for a command line without arguments: help is printed already
        command = error.ctx.command_path if error.ctx is not None else "csplat"
        helps = f"`{command} --help`" if error.ctx is not None else "`csplat COMMAND --help`"
        note(f"error: {command}: {message}; {helps} lists the options (E_USAGE)")
    sys.exit(EXIT_USAGE)


def _fail(message: str, code: str) -> NoReturn:
    """Print an error in one line, with its code unless the message has it or it is empty, and exit with status 1."""
    message = " ".join(message.split())
    note(f"error: {message}" + (f" ({code})" if code and not re.search(rf"\b{code}\b", message) else ""))
    raise typer.Exit(EXIT_FAILED) from None


def _describe_csplat_error(error: CsplatError) -> str:
    """Return the message of an error: the file, the defect in plain words, the details, and the remedy."""
    what, advice = _DEFECTS.get(error.code, ("", "") if isinstance(error, InputError) else _INVALID)
    if isinstance(error, LimitError) and error.limit == "json_bytes":
        what, advice = _LONG_TEXT
    message = str(error)
    parts = [error.path] if error.path is not None and Path(error.path).name not in message else []
    parts += [part for part in (what, message) if part]
    return ": ".join(parts) + (f"; {advice}" if advice else "")


def _describe_os_error(error: OSError) -> str:
    """Return the message of an error of the system: the file if it is known, the reason, and the remedy if any."""
    reason = error.strerror or str(error) or type(error).__name__
    number = error.errno or 0
    name = None if error.filename is None else os.fsdecode(error.filename)
    if name is None:
        return reason
    if name == STANDARD_OUTPUT:
        return f"{name}: {reason}; the output is incomplete"
    if is_temporary(name):
        return f"temporary files in {temporary_root()}: {reason}; TMPDIR names another folder"
    if number == errno.ENOENT and (url := _LOST_URL.match(name)):
        return f"{url[1]}://{url[2]} is a URL, expected a file: download it first; extract and batch read URLs"
    return f"{name}: {reason}" + (f"; {_OS_ADVICE[number]}" if number in _OS_ADVICE else "")
