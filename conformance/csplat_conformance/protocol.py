"""The protocol by which any decoder can be tested: one process for each vector."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote

from csplat.errors import InputError
from csplat.system import kill_group, split_words
from csplat_conformance.answers import Answer, whole_number
from csplat_conformance.conformance_report import Status

_MESSAGE_MAX = 200  # characters of a program's own message
_PARTS = ("integers", "floats", "extra")


def ask_decoder(command: str, path: Path, timeout: float, *, keep_floats: bool = False) -> Answer:
    """Let a decoder have one file.

    Args:
        command: command line with `{input}` and `{outdir}`.
        path: the file.
        timeout: seconds after which the process and its children are killed.
        keep_floats: the answer holds the values of the float arrays too, not their hashes alone.
    """
    with tempfile.TemporaryDirectory(prefix="csplat-conformance-") as folder:
        outdir = Path(folder) / "out"
        outdir.mkdir()
        ended = run_program(command, {"input": str(path), "outdir": str(outdir)}, timeout)
        return read_answer(ended, outdir, keep_floats=keep_floats)


def read_answer(ended: ProcessEnd, outdir: Path, *, keep_floats: bool = False) -> Answer:
    """Read what a decoder left.

    Args:
        ended: how the process ended.
        outdir: the folder it was given.
        keep_floats: as for `ask_decoder`.
    """
    if ended.status is not None:
        return Answer(ended.status, ended.message + last_words(ended), seconds=ended.seconds)
    left = sorted(entry.name for entry in outdir.iterdir())
    if ended.returncode == 1:
        return _read_refusal(ended, left)
    return _read_arrays(outdir, left, ended.seconds, keep_floats=keep_floats)


def _read_refusal(ended: ProcessEnd, left: list[str]) -> Answer:
    try:
        facts: dict[str, Any] = dict(json.loads((ended.stdout.splitlines() or [b""])[-1]))
        code, clause, offset = facts["code"], facts.get("clause"), facts.get("offset")
        if not isinstance(code, str):
            raise TypeError
    except (ValueError, LookupError, TypeError, RecursionError):
        text = f"exit status 1 without a line of JSON that has a code{last_words(ended)}"
        return Answer(Status.WRONG_ANSWER, text, seconds=ended.seconds)
    if left:
        return Answer(Status.PARTIAL_OUTPUT, f"refused, but left {', '.join(left)}", code=code, seconds=ended.seconds)
    return Answer(Status.REFUSED, "refused", code=code, clause=clause, offset=offset, seconds=ended.seconds)


def last_words(ended: ProcessEnd) -> str:
    """Return the last line of standard error as the end of a sentence, or nothing."""
    lines = ended.stderr.decode("utf-8", "replace").split("\n")
    words = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f": {words[:_MESSAGE_MAX]}" if words else ""


def _read_arrays(outdir: Path, left: list[str], seconds: float, *, keep_floats: bool) -> Answer:
    header: dict[str, Any] = {}
    arrays, floats = {}, {}
    for name in left:
        path = outdir / name
        part, _, rest = name.partition(".")
        if name == "header.json":
            try:
                header = json.loads(path.read_bytes(), parse_int=whole_number)
            except (ValueError, RecursionError, OSError):
                header = {}
            if not isinstance(header, dict) or not header:
                return Answer(Status.WRONG_ANSWER, "header.json is not a JSON object", seconds=seconds)
        elif part in _PARTS and rest.endswith(".bin") and path.is_file():
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            array = unquote(rest.removesuffix(".bin"))
            arrays[f"{part}.{array}"] = (path.stat().st_size, digest)
            if keep_floats and part == "floats":
                floats[array] = path.read_bytes()
        else:
            return Answer(Status.WRONG_ANSWER, f"{name} is no file of the protocol", seconds=seconds)
    return Answer(Status.PASSED, header=header, arrays=arrays, floats=floats, seconds=seconds)


_OUTPUT_MAX = 1 << 20  # bytes of each stream that are kept: a program may print for ever
_SIGKILL = 9  # SIGKILL, which Windows has no name for
_WINDOWS_EXCEPTION = 0xC0000000  # least exit status of a Windows program that crashed; of others it is at most 255


@dataclass(frozen=True)
class ProcessEnd:
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


def run_program(
    command: str, places: Mapping[str, str], timeout_seconds: float, *, cwd: Path | None = None
) -> ProcessEnd:
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
        words = [_absolute_path(words[0]) if _has_separator(words[0]) else words[0], *map(_make_absolute, words[1:])]
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
            returncode = -_SIGKILL
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
        return ProcessEnd(status, returncode, _tail(out), _tail(err), seconds, message)


def _make_absolute(word: str) -> str:
    """Make a word absolute that names something in the working directory."""
    option, equals, path = word.partition("=") if word.startswith("-") else ("", "", word)
    like_a_path = _has_separator(path) or bool(Path(path).suffix)
    # Path.exists() raises for words that are too long to be one.
    found = like_a_path and os.path.exists(path)  # noqa: PTH110 - see above
    return option + equals + _absolute_path(path) if found else word


def _absolute_path(path: str) -> str:
    # A link stays one: the program of a virtual environment is known by where it lies.
    return str(Path(path).absolute()).replace("{", "{{").replace("}", "}}")


def _has_separator(path: str) -> bool:
    return any(separator in path for separator in (os.sep, os.altsep) if separator)


def _tail(stream: IO[bytes]) -> bytes:
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - _OUTPUT_MAX))
    return stream.read()
