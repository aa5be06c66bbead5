"""Start somebody else's program, once, with a limit of time, and say how it ended.

    >>> places = {"input": "a b.ply", "out": "x"}
    >>> ended = run_program("my-tool {input} {out}", places, timeout_seconds=60)  # doctest: +SKIP
    >>> ended.status, ended.returncode                                            # doctest: +SKIP
    (None, 0)

The command line is split as a shell would, without a shell: no pipes, no variables. Names in braces are put in after
the split, so that file names may hold spaces. In a working directory of its own the program still finds files that
the caller's command line names: see `run_program`.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from csplat.errors import InputError
from csplat.system import kill_group, split_words
from csplat_conformance.report import Status

_OUTPUT_MAX = 1 << 20  # bytes of each stream that are kept: a program may print for ever
_KILLED = 9  # SIGKILL, which Windows has no name for
_WINDOWS_EXCEPTION = 0xC0000000  # least exit status of a Windows program that crashed; of others it is at most 255


@dataclass(frozen=True)
class Ended:
    """The end of a process.

    Attributes:
        status: `CRASHED` by a signal, `HUNG`, `WRONG_STATUS` for anything but 0 and 1; `None` for 0 and 1.
        returncode: exit status, minus the signal's number after a crash.
        stdout: the end of standard output, a mebibyte at most.
        stderr: the end of standard error, likewise.
        seconds: time it ran.
        message: the meaning of `status` here, in words; empty for `None`.
    """

    status: Status | None
    returncode: int
    stdout: bytes
    stderr: bytes
    seconds: float
    message: str = ""


def split_command(command: str, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> list[str]:
    """Split a command line and see to it that it names what it must.

    Args:
        command: the line.
        names: names that must occur in it, in braces.
        optional: names that may occur.

    Raises:
        InputError: quotes without an end, no program, a name in braces that is missing or unknown.
    """
    try:
        words = split_words(command)
        missing = [name for name in names if not any(f"{{{name}}}" in word for word in words)]
        for word in words:
            word.format(**dict.fromkeys((*names, *optional), ""))
    except (ValueError, LookupError, AttributeError) as error:
        raise InputError(f"the command {command!r} cannot be used: {error}") from None
    if missing or not words:
        raise InputError(f"the command {command!r} lacks {', '.join(f'{{{name}}}' for name in missing) or 'a program'}")
    return words


def run_program(command: str, places: Mapping[str, str], timeout_seconds: float, *, cwd: Path | None = None) -> Ended:
    """Run a command line in a process group of its own; what is left of the group after the time is killed.

    Args:
        command: with the keys of `places` in braces.
        places: values to insert, by name.
        timeout_seconds: wall-clock limit.
        cwd: working directory. A program with a slash is then still one of this process's own directory, and so are
            words, or what follows the `=` of an option, that look like a path (a slash, or a suffix) and name
            something there.

    Raises:
        InputError: the command line is not one, or there is no such program.
    """
    words = split_command(command, tuple(places))
    if cwd is not None:
        words = [_absolute(words[0]) if _has_folder(words[0]) else words[0], *map(_found_from_anywhere, words[1:])]
    words = [word.format(**places) for word in words]
    start = time.perf_counter()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        try:
            process = subprocess.Popen(  # noqa: S603 - to run the caller's command is what this is for
                words, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True, cwd=cwd
            )
        except OSError as error:
            raise InputError(f"{words[0]}: {error.strerror or error}; is it installed, and its name right?") from None
        status: Status | None = None
        try:
            returncode = process.wait(timeout_seconds)
        except subprocess.TimeoutExpired:
            status = Status.HUNG
            returncode = -_KILLED
        finally:
            kill_group(process)
        seconds = time.perf_counter() - start
        message = ""
        if status is Status.HUNG:
            message = f"still running after {timeout_seconds:g} s"
        elif returncode < 0:
            status, message = Status.CRASHED, f"ended by signal {-returncode}"
        elif returncode >= _WINDOWS_EXCEPTION:
            status, message = Status.CRASHED, f"ended by exception {returncode:#x}"
        elif returncode > 1:
            status, message = Status.WRONG_STATUS, f"exit status {returncode}"
        return Ended(status, returncode, _tail(out), _tail(err), seconds, message)


def _found_from_anywhere(word: str) -> str:
    """Make a word absolute that names something in the working directory."""
    option, equals, path = word.partition("=") if word.startswith("-") else ("", "", word)
    like_a_path = _has_folder(path) or bool(Path(path).suffix)
    # Path.exists() raises for words that are too long to be one.
    found = like_a_path and os.path.exists(path)  # noqa: PTH110 - see above
    return option + equals + _absolute(path) if found else word


def _absolute(path: str) -> str:
    # A link stays one: the program of a virtual environment is known by where it lies.
    return str(Path(path).absolute()).replace("{", "{{").replace("}", "}}")


def _has_folder(path: str) -> bool:
    return any(separator in path for separator in (os.sep, os.altsep) if separator)


def _tail(stream: IO[bytes]) -> bytes:
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - _OUTPUT_MAX))
    return stream.read()
