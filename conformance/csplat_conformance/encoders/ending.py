"""Judge how a run ended, what it left behind, and whether a second run gives the same bytes."""

from __future__ import annotations

from csplat import _spec
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.trial import Trial
from csplat_conformance.encoders.verdict import Verdict, Wrong, failed
from csplat_conformance.fields import read_fields
from csplat_conformance.process import Ended
from csplat_conformance.report import Status

_TRACEBACK = b"Traceback (most recent call last)"
_LINE_MAX = 200  # characters of a program's line that are shown


def judge_end(one: Input, trial: Trial) -> Verdict | None:
    """Judge how the program ended; `None` if there is a file to look at."""
    ended = trial.ended
    if ended.status is not None:
        return Verdict(ended.status, _with_line(ended.message, ended))
    if ended.returncode == 1:
        return _judge_refusal(one, trial)
    if not trial.out.is_file():
        return Verdict(Status.NO_OUTPUT, "exit status 0, and there is no file")
    if one.must_refuse:
        return Verdict(Status.FAILED, "accepted, though there are no splats in it")
    return None


def _judge_refusal(one: Input, trial: Trial) -> Verdict:
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
        return failed([("", f"refused, but {trace}") for trace in trial.traces], {})
    return Verdict(Status.PASSED if one.must_refuse else Status.DECLINED, f"refused: {line}")


def _last_line(ended: Ended) -> str:
    text = (ended.stderr.strip() or ended.stdout.strip()).decode("utf-8", "replace")
    return text.splitlines()[-1].strip()[:_LINE_MAX] if text else ""


def _with_line(message: str, ended: Ended) -> str:
    line = _last_line(ended)
    return f"{message}; its last line: {line}" if line else message


# Habits --------------------------------------------------------------------------------------------


def wrong_habits(first: Trial, again: Trial | None) -> list[Wrong]:
    """Say what a program that wrote its file did in addition, and how a second run differs from the first (CNF-10).

    Args:
        first: the run that is judged.
        again: the same from another folder, later; `None` if there was none.
    """
    wrong: list[Wrong] = [("", trace) for trace in first.traces]
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
    elif first.index is not None and again.index is not None and _content(first) != _content(again):
        wrong.append(("CNF-10", "two runs gave the same file and different source indices"))
    return wrong


def _content(trial: Trial) -> bytes | None:
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
            return _named(data, name)
    for name, (offset, size) in spans.items():
        if offset <= at < offset + size:
            return f"the chunk {_named(data, f'directory[{name}]') if name.isdigit() else name}"
    return ""


def _named(data: bytes, name: str) -> str:
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
