# SPDX-License-Identifier: CC0-1.0
"""Run an encoder on an input, and check its exit status, side effects and repeatability (L1)."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from csplat.disk_files import atomic_writer, temporary_folder
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders.encoder_inputs import EncoderInput
from csplat_conformance.fields import Field, read_fields
from csplat_conformance.protocol import ProcessEnd, run_program

#: The violated clause, or an empty string, and a line about the defect.
Defect = tuple[str, str]

_LINES_MAX = 2  # lines of a verdict to show
_LINE_MAX = 200  # characters of a program's line to show
_TRACEBACK = b"Traceback (most recent call last)"


@dataclass(frozen=True)
class Verdict:
    """The verdict of one level.

    Attributes:
        status: the result.
        message: the reason, or a remark.
        clauses: violated clauses.
        code: error code of the first violation.
        details: numbers for programs.
    """

    status: Status
    message: str = ""
    clauses: tuple[str, ...] = ()
    code: str = ""
    details: dict[str, Any] = field(default_factory=dict)


def failed_verdict(wrong: list[Defect], details: dict[str, Any]) -> Verdict:
    """Return the failure for some defects."""
    clauses = tuple(dict.fromkeys(clause for clause, _ in wrong if clause))
    return Verdict(Status.FAILED, "; ".join(text for _, text in wrong), clauses, details=details)


def join_lines(lines: tuple[str, ...]) -> str:
    """Join the first lines into a single line, and add the number of remaining lines."""
    remainder = f"; and {len(lines) - _LINES_MAX} more" if len(lines) > _LINES_MAX else ""
    return "; ".join(lines[:_LINES_MAX]) + remainder


#: Runs a command line in this process; called with the line, its values and the time limit, seconds.
CommandRunner = Callable[[str, Mapping[str, str], float], ProcessEnd]

#: Required and optional placeholders of a command line.
PLACEHOLDERS, OPTIONAL_PLACEHOLDERS = ("ply", "out"), ("index",)
REPEAT_SECONDS = 1.1  #: between a run and its repetition, so that time stamps in seconds differ

_NAMES = {"ply": "in.ply", "out": "out.csplat", "index": "out.npy"}


@dataclass(frozen=True)
class EncoderRun:
    """A run of an encoder on an input.

    Attributes:
        end: the end of the process.
        out: path of the output.
        index: path of the source index; `None` if the command line has no placeholder for it.
        traces: a line for each side effect of the run.
        started: start time by `time.monotonic`, seconds.
    """

    end: ProcessEnd
    out: Path
    index: Path | None
    traces: tuple[str, ...]
    started: float

    @property
    def wrote(self) -> bool:
        """True if the exit status reports success and there is a file."""
        return self.end.status is None and self.end.returncode == 0 and self.out.is_file()


def run_once(command: str, case: EncoderInput, folder: Path, seconds: float, run: CommandRunner | None) -> EncoderRun:
    """Run an encoder once.

    Args:
        command: its command line.
        case: the input.
        folder: folder for input and output; it is emptied first.
        seconds: time limit.
        run: runs the command line in this process; default: start a process in an empty working directory.

    Raises:
        InputError: there is no such program.
    """
    ply = case.make()
    if folder.is_dir():
        shutil.rmtree(folder)  # from an earlier run
    folder.mkdir(parents=True)
    paths = {
        name: folder / _NAMES[name]
        for name in (*PLACEHOLDERS, *OPTIONAL_PLACEHOLDERS)
        if name in PLACEHOLDERS or _has_placeholder(command, name)
    }
    with atomic_writer(paths["ply"]) as stream:
        stream.write(ply)
    named = {name: str(path) for name, path in paths.items()}
    traces: list[str] = []
    started = time.monotonic()
    if run is not None:
        end = run(command, named, seconds)
    else:
        with temporary_folder() as cwd:
            end = run_program(command, named, seconds, cwd=cwd)
            traces += [f"left {name} in its working directory" for name in _list_folder(cwd)]
    # A refusal that leaves an output is reported by `check_end`.
    outputs = {_NAMES["ply"], _NAMES["out"]} | ({_NAMES["index"]} if end.returncode == 0 else set())
    strays = [name for name in _list_folder(folder) if name not in outputs]
    traces = [*_find_input_changes(paths["ply"], ply), *(f"left {name} next to the output" for name in strays), *traces]
    return EncoderRun(end, paths["out"], paths.get("index"), tuple(traces), started)


def _has_placeholder(command: str, name: str) -> bool:
    return f"{{{name}}}" in command


def _list_folder(folder: Path) -> list[str]:
    """Return the sorted names of the entries of a folder; none if it does not exist."""
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def _find_input_changes(path: Path, content: bytes) -> list[str]:
    """Return a line if the file at `path` was removed or no longer has its `content`."""
    try:
        return [] if path.read_bytes() == content else ["the input was modified"]
    except OSError:
        return ["the input is gone"]


def check_end(case: EncoderInput, run: EncoderRun) -> Verdict | None:
    """Check how the program ended; return `None` if there is a file to check."""
    end = run.end
    if end.status is not None:
        return Verdict(end.status, _with_line(end.message, end))
    if end.returncode == 1:
        return _check_refusal(case, run)
    if not run.out.is_file():
        return Verdict(Status.NO_OUTPUT, "exit status 0, but no file was written")
    if case.must_refuse:
        return Verdict(Status.FAILED, "accepted an input without splats")
    return None


def _check_refusal(case: EncoderInput, run: EncoderRun) -> Verdict:
    """Judge exit status 1: it needs a reason in one line, no file, and an input that may be refused."""
    end = run.end
    if _TRACEBACK in end.stderr:
        return Verdict(Status.CRASHED, _with_line("a traceback", end))
    if run.out.exists():
        return Verdict(Status.PARTIAL_OUTPUT, "exit status 1, but a file was written")
    line = _last_line(end)
    if not line:
        return Verdict(Status.WRONG_ANSWER, "exit status 1 without a line with the reason")
    if not (case.must_refuse or case.may_refuse):
        return Verdict(Status.REFUSED, line)
    if run.traces:
        return failed_verdict([("", f"refused, but {trace}") for trace in run.traces], {})
    return Verdict(Status.PASSED if case.must_refuse else Status.DECLINED, f"refused: {line}")


def _last_line(end: ProcessEnd) -> str:
    """Return the last line of standard error or, if that is empty, of standard output; empty without output."""
    text = (end.stderr.strip() or end.stdout.strip()).decode("utf-8", "replace")
    return text.splitlines()[-1].strip()[:_LINE_MAX] if text else ""


def _with_line(message: str, end: ProcessEnd) -> str:
    """Append the program's last line to a message, if it printed any."""
    line = _last_line(end)
    return f"{message}; its last line: {line}" if line else message


# Side effects and repetitions ---------------------------------------------------------------------


def find_side_effects(first: EncoderRun, again: EncoderRun | None) -> list[Defect]:
    """Return the side effects of a run that wrote its file, and its differences from a repetition (CNF-10).

    Args:
        first: the run to check.
        again: a later run in another folder; `None` if there was none.
    """
    wrong: list[Defect] = [("", trace) for trace in first.traces]
    if again is None:
        return wrong
    if not again.wrote:
        how = again.end.message or f"exit status {again.end.returncode}, {'a' if again.out.is_file() else 'no'} file"
        return [*wrong, ("CNF-10", _with_line(f"a second run ended differently: {how}", again.end))]
    data, repeated = first.out.read_bytes(), again.out.read_bytes()
    if data != repeated:
        at = _first_difference(data, repeated)
        sizes = "" if len(data) == len(repeated) else f" ({len(data):,} and {len(repeated):,} bytes)"
        where = _name_field_at(data, at)
        text = f"two runs gave different files{sizes}: first at byte {at}{f', in {where}' if where else ''}"
        wrong.append(("CNF-10", text))
    elif first.index is not None and again.index is not None and _index_bytes(first) != _index_bytes(again):
        wrong.append(("CNF-10", "two runs gave the same file but different source indices"))
    return wrong


def _index_bytes(run: EncoderRun) -> bytes | None:
    return run.index.read_bytes() if run.index is not None and run.index.is_file() else None


def _first_difference(first: bytes, second: bytes) -> int:
    """Return the offset of the first difference: the shorter size if one is the beginning of the other."""
    for at, (a, b) in enumerate(zip(first, second, strict=False)):
        if a != b:
            return at
    return min(len(first), len(second))


def _name_field_at(data: bytes, at: int) -> str:
    """Return the name of the field or the chunk at an offset; empty if the file cannot be read."""
    try:
        fields, spans = read_fields(data)
    except Exception:  # noqa: BLE001 - an invalid file may fail anywhere; `check_stream` reports it
        return ""
    for name, entry in fields.items():
        if entry.offset <= at < entry.offset + entry.size:
            return _name_with_type(data, fields, name)
    for name, (offset, size) in spans.items():
        if offset <= at < offset + size:
            return f"the chunk {_name_with_type(data, fields, f'directory[{name}]') if name.isdigit() else name}"
    return ""


def _name_with_type(data: bytes, fields: Mapping[str, Field], name: str) -> str:
    """Add the chunk type to the name of a directory record or of one of its fields."""
    record = name.partition(".")[0]
    if not record.startswith("directory["):
        return name
    at = fields[f"{record}.type"].offset
    return f"{data[at : at + 4].decode('ascii', 'replace')} ({name})"
