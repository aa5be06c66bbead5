"""Run an encoder on one input and check how it ended (L1)."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from csplat import _spec
from csplat.files import atomic_writer
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders.encoder_inputs import EncoderInput
from csplat_conformance.fields import read_fields
from csplat_conformance.protocol import ProcessEnd, run_program

#: A defect: the broken clause, empty if there is none, and a line about it.
Defect = tuple[str, str]

_LINES_MAX = 2


@dataclass(frozen=True)
class Verdict:
    """The verdict of one level.

    Attributes:
        status: whether it passed.
        message: the reason, or a remark.
        clauses: the broken clauses.
        code: error code of the first violation.
        details: numbers, for programs.
    """

    status: Status
    message: str = ""
    clauses: tuple[str, ...] = ()
    code: str = ""
    details: dict[str, Any] = field(default_factory=dict)


def failed_verdict(wrong: list[Defect], details: dict[str, Any]) -> Verdict:
    """Return a failure for what is wrong."""
    clauses = tuple(dict.fromkeys(clause for clause, _ in wrong if clause))
    return Verdict(Status.FAILED, "; ".join(text for _, text in wrong), clauses, details=details)


def join_lines(lines: tuple[str, ...]) -> str:
    """Return the first of some lines as one, and how many more there are: a line stays readable."""
    rest = f"; and {len(lines) - _LINES_MAX} more" if len(lines) > _LINES_MAX else ""
    return "; ".join(lines[:_LINES_MAX]) + rest


#: Runs a command line with some places put in, within some seconds, without a process of its own.
CommandRunner = Callable[[str, Mapping[str, str], float], ProcessEnd]

#: Places that a command line must have, and may have.
PLACES, OPTIONAL_PLACES = ("ply", "out"), ("index",)
#: From the start of a run to that of its repetition: a time stamp in seconds is another one by then.
REPEAT_SECONDS = 1.1

_NAMES = {"ply": "in.ply", "out": "out.csplat", "index": "out.npy"}


@dataclass(frozen=True)
class EncoderRun:
    """One run.

    Attributes:
        ended: how the process ended.
        out: path where the file was to be written.
        index: path of the source index; `None` if the command line has no place for it.
        traces: what the run did in addition to writing its output, a line each.
        started: time of the start, in seconds of `time.monotonic`.
    """

    ended: ProcessEnd
    out: Path
    index: Path | None
    traces: tuple[str, ...]
    started: float

    @property
    def wrote(self) -> bool:
        """True if there is a file, and the exit status reports success."""
        return self.ended.status is None and self.ended.returncode == 0 and self.out.is_file()


def run_once(command: str, one: EncoderInput, folder: Path, seconds: float, run: CommandRunner | None) -> EncoderRun:
    """Run an encoder once.

    Args:
        command: its command line.
        one: the input.
        folder: folder for input and output; existing files are replaced.
        seconds: it may take.
        run: runs it in this process; without it a process is started, in an empty working directory of its own.

    Raises:
        InputError: there is no such program.
    """
    ply = one.make()
    if folder.is_dir():
        shutil.rmtree(folder)  # kept from an earlier run
    folder.mkdir(parents=True)
    places = {
        name: folder / _NAMES[name]
        for name in (*PLACES, *OPTIONAL_PLACES)
        if name in PLACES or _has_place(command, name)
    }
    with atomic_writer(places["ply"]) as stream:
        stream.write(ply)
    named = {name: str(path) for name, path in places.items()}
    traces: list[str] = []
    started = time.monotonic()
    if run is not None:
        ended = run(command, named, seconds)
    else:
        with tempfile.TemporaryDirectory(prefix="csplat-cwd-") as cwd:
            ended = run_program(command, named, seconds, cwd=Path(cwd))
            traces += [f"left {name} in its working directory" for name in _names(Path(cwd))]
    # A refusal that leaves its output is a status of its own.
    outputs = {_NAMES["ply"], _NAMES["out"]} | ({_NAMES["index"]} if ended.returncode == 0 else set())
    left = [name for name in _names(folder) if name not in outputs]
    traces = [*_input_changes(places["ply"], ply), *(f"left {name} beside the output" for name in left), *traces]
    return EncoderRun(ended, places["out"], places.get("index"), tuple(traces), started)


def _has_place(command: str, name: str) -> bool:
    return f"{{{name}}}" in command


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def _input_changes(path: Path, content: bytes) -> list[str]:
    """Say what became of the input."""
    try:
        return [] if path.read_bytes() == content else ["the input was modified"]
    except OSError:
        return ["the input is gone"]


_TRACEBACK = b"Traceback (most recent call last)"
_LINE_MAX = 200  # characters of a program's line that are shown


def check_end(one: EncoderInput, trial: EncoderRun) -> Verdict | None:
    """Judge how the program ended; `None` if there is a file to look at."""
    ended = trial.ended
    if ended.status is not None:
        return Verdict(ended.status, _with_line(ended.message, ended))
    if ended.returncode == 1:
        return _check_refusal(one, trial)
    if not trial.out.is_file():
        return Verdict(Status.NO_OUTPUT, "exit status 0, and there is no file")
    if one.must_refuse:
        return Verdict(Status.FAILED, "accepted, though there are no splats in it")
    return None


def _check_refusal(one: EncoderInput, trial: EncoderRun) -> Verdict:
    ended = trial.ended
    if _TRACEBACK in ended.stderr:
        return Verdict(Status.CRASHED, _with_line("a traceback", ended))
    if trial.out.exists():
        return Verdict(Status.PARTIAL_OUTPUT, "exit status 1, and there is a file")
    line = _last_line(ended)
    if not line:
        return Verdict(Status.WRONG_ANSWER, "exit status 1 without a line that says why")
    if not (one.must_refuse or one.may_refuse):
        return Verdict(Status.REFUSED, line)
    if trial.traces:
        return failed_verdict([("", f"refused, but {trace}") for trace in trial.traces], {})
    return Verdict(Status.PASSED if one.must_refuse else Status.DECLINED, f"refused: {line}")


def _last_line(ended: ProcessEnd) -> str:
    text = (ended.stderr.strip() or ended.stdout.strip()).decode("utf-8", "replace")
    return text.splitlines()[-1].strip()[:_LINE_MAX] if text else ""


def _with_line(message: str, ended: ProcessEnd) -> str:
    line = _last_line(ended)
    return f"{message}; its last line: {line}" if line else message


# Habits --------------------------------------------------------------------------------------------


def find_side_effects(first: EncoderRun, again: EncoderRun | None) -> list[Defect]:
    """Say what a program that wrote its file did in addition, and how a second run differs from the first (CNF-10).

    Args:
        first: the run that is judged.
        again: the same from another folder, later; `None` if there was none.
    """
    wrong: list[Defect] = [("", trace) for trace in first.traces]
    if again is None:
        return wrong
    if not again.wrote:
        how = (
            again.ended.message or f"exit status {again.ended.returncode}, {'a' if again.out.is_file() else 'no'} file"
        )
        return [*wrong, ("CNF-10", _with_line(f"a second run ended otherwise: {how}", again.ended))]
    one, other = first.out.read_bytes(), again.out.read_bytes()
    if one != other:
        at = _first_difference(one, other)
        sizes = "" if len(one) == len(other) else f" ({len(one):,} and {len(other):,} bytes)"
        where = _field_at(one, at)
        text = f"two runs gave different files{sizes}: first at byte {at}{f', in {where}' if where else ''}"
        wrong.append(("CNF-10", text))
    elif first.index is not None and again.index is not None and _index_bytes(first) != _index_bytes(again):
        wrong.append(("CNF-10", "two runs gave the same file and different source indices"))
    return wrong


def _index_bytes(trial: EncoderRun) -> bytes | None:
    return trial.index.read_bytes() if trial.index is not None and trial.index.is_file() else None


def _first_difference(one: bytes, other: bytes) -> int:
    for at, (a, b) in enumerate(zip(one, other, strict=False)):
        if a != b:
            return at
    return min(len(one), len(other))


def _field_at(data: bytes, at: int) -> str:
    """Name what lies at a byte: a field, or the chunk; nothing if the file is not one."""
    try:
        fields, spans = read_fields(data)
    except Exception:  # noqa: BLE001 - a file that breaks clauses may end the walk anywhere, and is reported elsewhere
        return ""
    for name, entry in fields.items():
        if entry.offset <= at < entry.offset + entry.size:
            return _name_with_type(data, name)
    for name, (offset, size) in spans.items():
        if offset <= at < offset + size:
            return f"the chunk {_name_with_type(data, f'directory[{name}]') if name.isdigit() else name}"
    return ""


def _name_with_type(data: bytes, name: str) -> str:
    """Add the type of a chunk that has only a number."""
    if not name.startswith("directory["):
        return name
    head = _spec.unpack_index_head(data, _spec.HEADER_SIZE)
    before = head.head_size + head.attribute_count * head.attribute_size
    before += head.codebook_count * head.codebook_size + head.extra_count * head.extra_size
    number = int(name.removeprefix("directory[").partition("]")[0])
    place = _spec.HEADER_SIZE + before + number * head.directory_size
    kind = _spec.unpack_directory_record(data, place).type.decode("ascii", "replace")
    return f"{kind} ({name})"
