# SPDX-License-Identifier: CC0-1.0
"""The protocol to test any decoder: one process for each vector.

    my-decoder INPUT OUTDIR

The decoder exits with status 0 and writes to OUTDIR `header.json` and a file of raw values for each array,
little-endian, in C order: `integers.NAME.bin`, `floats.NAME.bin`, `extra.NAME.bin` (names of columns percent-encoded).
Or it exits with status 1, its last line on standard output is JSON, `{"code": "E_CRC"}`, and OUTDIR stays empty.

    my-cuts INPUT CUTS

CUTS is a text file with a cut per line, `level 1`, `pixel_size 0.5` or `splats 100`, perhaps in a box, `level 0 box 0
0 0 1 1 1`. The program exits with status 0 and prints a line for each: the numbers of its tiles, or an error code. If
it refuses the file, it exits with status 1 and a line of JSON as above.

`run_program` runs any program with a time limit:

    >>> values = {"input": "a b.ply", "out": "x"}
    >>> end = run_program("my-tool {input} {out}", values, timeout_seconds=60)    # doctest: +SKIP
    >>> end.status, end.returncode                                                # doctest: +SKIP
    (None, 0)

A command line is split as by a shell, but runs without one: no pipes, no variables. Names in braces are replaced after
the split, so that file names may contain spaces. `run_program` describes the treatment of file names if the program
runs in another working directory.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote

from csplat.disk_files import temporary_file, temporary_folder
from csplat.errors import InputError
from csplat.system import kill_group, split_words
from csplat_conformance.answers import Answer, whole_number
from csplat_conformance.conformance_report import Status

_MESSAGE_MAX = 200  # characters of a program's message to keep
_PARTS = ("integers", "floats", "extra")
_NUMBER = re.compile("[0-9]{1,10}")  # a u32


def ask_decoder(command: str, path: Path, timeout: float, *, keep_floats: bool = False) -> Answer:
    """Run a decoder on one file.

    Args:
        command: command line with `{input}` and `{outdir}`.
        path: the file.
        timeout: time limit in seconds, after which the process and its children are killed.
        keep_floats: keep the values of float arrays in the answer, not only their hashes.
    """
    with temporary_folder() as folder:
        outdir = folder / "out"
        outdir.mkdir()
        end = run_program(command, {"input": str(path), "outdir": str(outdir)}, timeout)
        return read_answer(end, outdir, keep_floats=keep_floats)


def read_answer(end: ProcessEnd, outdir: Path, *, keep_floats: bool = False) -> Answer:
    """Read a decoder's answer.

    Args:
        end: the end of its process.
        outdir: its output folder.
        keep_floats: see `ask_decoder`.
    """
    if end.status is not None:
        return Answer(end.status, end.message + last_words(end), seconds=end.seconds)
    names = sorted(entry.name for entry in outdir.iterdir())
    if end.returncode == 1:
        return _read_refusal(end, names)
    return _read_arrays(outdir, names, end.seconds, keep_floats=keep_floats)


def ask_cuts(command: str, path: Path, cuts: Sequence[str], timeout: float) -> Answer:
    """Run a program that cuts through levels of detail on one file.

    Args:
        command: command line with `{input}` and `{cuts}`.
        path: the file.
        cuts: the cuts to request.
        timeout: as in `ask_decoder`.
    """
    with temporary_folder() as folder:
        text = folder / "cuts.txt"
        text.write_text("".join(f"{cut}\n" for cut in cuts), encoding="utf-8", newline="\n")
        end = run_program(command, {"input": str(path), "cuts": str(text)}, timeout)
    if end.status is not None:
        return Answer(end.status, end.message + last_words(end), seconds=end.seconds)
    return _read_refusal(end, []) if end.returncode == 1 else _read_cuts(end)


def _read_cuts(end: ProcessEnd) -> Answer:
    """Parse standard output: tiles or an error code in each line; an empty line is a cut without tiles."""
    cuts: list[list[int] | str] = []
    for line in end.stdout.decode("utf-8", "replace").splitlines():
        words = line.split()
        if all(_NUMBER.fullmatch(word) for word in words):
            cuts.append([int(word) for word in words])
        elif len(words) == 1 and words[0].startswith("E_"):
            cuts.append(words[0])
        else:
            message = f"line {len(cuts) + 1} is {line[:_MESSAGE_MAX]!r}, expected numbers of tiles, or an error code"
            return Answer(Status.WRONG_ANSWER, message, seconds=end.seconds)
    return Answer(Status.PASSED, cuts=cuts, seconds=end.seconds)


def _read_refusal(end: ProcessEnd, outputs: list[str]) -> Answer:
    """Parse the last line of standard output as a refusal; `outputs`, names of files left behind, make it a failure."""
    try:
        facts: dict[str, Any] = dict(json.loads((end.stdout.splitlines() or [b""])[-1]))
        code, clause, offset = facts["code"], facts.get("clause"), facts.get("offset")
        if not isinstance(code, str):
            raise TypeError
    except (ValueError, LookupError, TypeError, RecursionError):
        text = f"exit status 1 without a line of JSON that has a code{last_words(end)}"
        return Answer(Status.WRONG_ANSWER, text, seconds=end.seconds)
    if outputs:
        return Answer(Status.PARTIAL_OUTPUT, f"refused, but left {', '.join(outputs)}", code=code, seconds=end.seconds)
    return Answer(Status.REFUSED, "refused", code=code, clause=clause, offset=offset, seconds=end.seconds)


def last_words(end: ProcessEnd) -> str:
    """Return a colon and the last line of standard error, or an empty string."""
    lines = end.stderr.decode("utf-8", "replace").split("\n")
    words = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f": {words[:_MESSAGE_MAX]}" if words else ""


def _read_arrays(outdir: Path, names: list[str], seconds: float, *, keep_floats: bool) -> Answer:
    """Read the files `names` of an output folder: the header, and size and SHA-256 of each array.

    A file of another name, or an unreadable header, is a wrong answer.
    """
    header: dict[str, Any] = {}
    arrays, floats = {}, {}
    for name in names:
        path = outdir / name
        part, _, file_name = name.partition(".")
        if name == "header.json":
            try:
                header = json.loads(path.read_bytes(), parse_int=whole_number)
            except (ValueError, RecursionError, OSError):
                header = {}
            if not isinstance(header, dict) or not header:
                return Answer(Status.WRONG_ANSWER, "header.json is not a JSON object", seconds=seconds)
        elif part in _PARTS and file_name.endswith(".bin") and path.is_file():
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            array = unquote(file_name.removesuffix(".bin"))
            arrays[f"{part}.{array}"] = (path.stat().st_size, digest)
            if keep_floats and part == "floats":
                floats[array] = path.read_bytes()
        else:
            return Answer(Status.WRONG_ANSWER, f"{name} is not a file of the protocol", seconds=seconds)
    return Answer(Status.PASSED, header=header, arrays=arrays, floats=floats, seconds=seconds)


_OUTPUT_MAX = 1 << 20  # bytes of each stream to keep; the rest is dropped
_SIGKILL = 9  # number of SIGKILL, which Windows does not name
_WINDOWS_EXCEPTION = 0xC0000000  # smallest exit status of a Windows program that crashed


@dataclass(frozen=True)
class ProcessEnd:
    """The end of a process.

    Attributes:
        status: `CRASHED` by a signal, `HUNG`, `WRONG_STATUS` for an exit status above 1; `None` for 0 and 1.
        returncode: exit status, or minus the signal's number after a crash.
        stdout: end of standard output, at most a mebibyte.
        stderr: end of standard error, at most a mebibyte.
        seconds: running time.
        message: explanation of `status`; empty for `None`.
    """

    status: Status | None
    returncode: int
    stdout: bytes
    stderr: bytes
    seconds: float
    message: str = ""


def split_command(command: str, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> list[str]:
    """Split a command line and check its names in braces.

    Args:
        command: the command line.
        names: required names.
        optional: allowed names.

    Raises:
        InputError: a quote is not closed, there is no program, or a name is missing or unknown.
    """
    try:
        arguments = split_words(command)
        missing = [name for name in names if not any(f"{{{name}}}" in argument for argument in arguments)]
        for argument in arguments:
            argument.format(**dict.fromkeys((*names, *optional), ""))
    except (ValueError, LookupError, AttributeError) as error:
        raise InputError(f"the command {command!r} cannot be used: {error}") from None
    if missing or not arguments:
        raise InputError(f"the command {command!r} lacks {', '.join(f'{{{name}}}' for name in missing) or 'a program'}")
    return arguments


def run_program(
    command: str, values: Mapping[str, str], timeout_seconds: float, *, cwd: Path | None = None
) -> ProcessEnd:
    """Run a command line in a process group of its own, which is killed at the end or after the time limit.

    Args:
        command: with the keys of `values` in braces.
        values: text to insert, by name.
        timeout_seconds: wall-clock limit.
        cwd: working directory. Paths are still relative to this process's directory: the program if it contains a
            slash, and arguments, or values of options after `=`, that look like a path (with a slash or a suffix) and
            exist.

    Raises:
        InputError: the command line cannot be used, or there is no such program.
    """
    arguments = split_command(command, tuple(values))
    if cwd is not None:
        arguments = [
            _absolute_path(arguments[0]) if _has_separator(arguments[0]) else arguments[0],
            *map(_make_absolute, arguments[1:]),
        ]
    arguments = [argument.format(**values) for argument in arguments]
    start = time.perf_counter()
    with temporary_file() as out, temporary_file() as err:
        try:
            process = subprocess.Popen(  # noqa: S603 - runs the caller's command on purpose
                arguments, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True, cwd=cwd
            )
        except OSError as error:
            raise InputError(
                f"{arguments[0]}: {error.strerror or error}; is it installed and spelled correctly?"
            ) from None
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


def _make_absolute(argument: str) -> str:
    """Make an argument absolute if it is an existing path."""
    option, equals, path = argument.partition("=") if argument.startswith("-") else ("", "", argument)
    like_a_path = _has_separator(path) or bool(Path(path).suffix)
    # Path.exists() raises an error for arguments that are too long for a path.
    is_path = like_a_path and os.path.exists(path)  # noqa: PTH110 - see above
    return option + equals + _absolute_path(path) if is_path else argument


def _absolute_path(path: str) -> str:
    """Return the absolute path, with braces doubled for `str.format`."""
    # Do not resolve links: Python locates a virtual environment by the path of its executable.
    return str(Path(path).absolute()).replace("{", "{{").replace("}", "}}")


def _has_separator(path: str) -> bool:
    """Return True if a path contains a slash, or a backslash on Windows."""
    return any(separator in path for separator in (os.sep, os.altsep) if separator)


def _tail(stream: IO[bytes]) -> bytes:
    """Return the last `_OUTPUT_MAX` bytes of a file."""
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - _OUTPUT_MAX))
    return stream.read()
