"""Exit statuses of the commands, and one-line messages for expected errors."""

from __future__ import annotations

import errno
import functools
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, ParamSpec, TypeVar

import typer

from csplat.errors import CsplatError, InputError
from csplat_tools.files.console import note

FAILED = 1
INTERRUPTED = 130  # 128 + SIGINT, as shells have it
_WRONG_USE = 2

_AGAIN = "copy or download it again"
_NEWER = "a newer csplat may know it"
_BROKEN = ("the file contradicts itself", f"{_AGAIN}; `csplat verify` lists all that is wrong")
_DAMAGED = ("the file is damaged", _AGAIN)
#: By error code of the format: the defect, and the remedy. The viewer has the same in `tools/viewer/messages.mjs`.
_WORDS = {
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
        "`csplat decode` and `csplat verify` take scenes of any size",
    ),
}
_LOST_URL = re.compile(r"([a-z][a-z0-9+]+):/+(.+)")  # a URL read as a path, which loses a slash
_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO)
_OS_ADVICE = {
    errno.ENOENT: "is the name right?",
    errno.EACCES: "you are not allowed to",
    errno.EISDIR: "name a file",
    errno.ENOSPC: "no half of a file was left; make room, or name another place",
    errno.EFBIG: "no half of a file was left; name another place",
    errno.EDQUOT: "no half of a file was left; make room, or name another place",
}

#: Base class of the errors that typer raises for a command line; typer exports only one of its subclasses.
WrongCommandLine: type[Exception] = typer.BadParameter.__bases__[0]
_SAYS_NOTHING = re.compile(r"^Invalid value: |(?<=: )Value error, |\.$")  # empty phrases of typer's messages

P = ParamSpec("P")
T = TypeVar("T")


def guarded(command: Callable[P, T]) -> Callable[P, T]:
    """Turn expected errors into one line on standard error and status 1.

    Defects of csplat itself still end in a traceback: a bug report needs it.
    """

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            result = command(*args, **kwargs)
            sys.stdout.flush()  # a closed pipe shows here, not when the interpreter ends
        except CsplatError as error:
            _fail(_csplat_error(error))
        except BrokenPipeError:
            _drop_stdout()
            raise typer.Exit(FAILED) from None
        except OSError as error:
            if error.filename is None and error.errno in _FULL:
                _drop_stdout()  # all other writers name their file
            _fail(_os_error(error))
        except MemoryError:
            _fail("out of memory")
        except KeyboardInterrupt:
            note("interrupted")
            raise typer.Exit(INTERRUPTED) from None
        return result

    return run


def refuse_command_line(error: Any) -> NoReturn:
    """Print in one line what is wrong with a command line, in the form of other errors, and exit with status 2."""
    message = " ".join(_SAYS_NOTHING.sub("", error.format_message()).split())
    if message:  # empty for a command line without arguments: help is printed already
        of = error.ctx.command_path if error.ctx is not None else "csplat"
        helps = f"`{of} --help`" if error.ctx is not None else "`csplat COMMAND --help`"
        note(f"error: {of}: {message}; {helps} says what is possible (E_USAGE)")
    sys.exit(_WRONG_USE)


def _fail(message: str) -> NoReturn:
    note("error: " + " ".join(message.split()))
    raise typer.Exit(FAILED) from None


def _csplat_error(error: CsplatError) -> str:
    """Return the message of an error: the file, the defect in plain words, the details, the remedy, and the code."""
    what, advice = _WORDS.get(error.code, ("", "") if isinstance(error, InputError) else _BROKEN)
    message = str(error)
    parts = [error.path] if error.path is not None and Path(error.path).name not in message else []
    parts += [part for part in (what, message) if part]
    code = "" if error.code in message else f" ({error.code})"
    return ": ".join(parts) + (f"; {advice}" if advice else "") + code


def _os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    number = error.errno or 0
    code = f" ({errno.errorcode[number]})" if number in errno.errorcode else ""
    if error.filename is None:
        return (f"standard output: {reason}; what it holds is not whole" if number in _FULL else reason) + code
    if number == errno.ENOENT and (url := _LOST_URL.match(str(error.filename))):
        return f"{url[1]}://{url[2]} is a URL, expected a file: download it first; extract and batch read URLs" + code
    return f"{error.filename}: {reason}" + (f"; {_OS_ADVICE[number]}" if number in _OS_ADVICE else "") + code


def _drop_stdout() -> None:
    """Redirect standard output to the null device, so that the interpreter's flush at exit cannot fail."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        return  # standard output is not a file here
