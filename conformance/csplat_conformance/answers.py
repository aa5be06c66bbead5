# SPDX-License-Identifier: CC0-1.0
"""Compare a decoder's answer for a vector with the manifest.

| level | compares |
|---|---|
| L1 | `header.json`; for invalid files the refusal |
| L2 | the integer arrays of spec 9.2 |
| L3 | the float arrays of spec section 3 and the extra columns, bit for bit, or by `tolerance` for the class renderer |
| L5 | the tiles of cuts through the levels of detail and of boxes (spec 5.7), by `compare_cuts` |

L4, renders, is in `reference_renders`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from numpy.typing import NDArray

from csplat import _spec
from csplat_conformance.conformance_report import Outcome, Status
from csplat_conformance.manifest import Vector
from csplat_conformance.tolerance import describe_deviation

#: The levels of `compare_answer`, and the parts of the expected result that each compares.
PARTS = {1: ("header",), 2: ("integers",), 3: ("floats", "extra")}
RENDERS, CUTS = 4, 5
LEVELS = (*PARTS, RENDERS, CUTS)

#: Tiles of a cut, or an error code.
Cut = Sequence[int] | str
_EXACT_MAX = 2**53  # integers up to this magnitude are exact in binary64
_SHOWN_MAX = 60  # characters of a cut in a message

#: Returns the float arrays of a vector by its name.
FloatsByVector = Callable[[str], Mapping[str, NDArray[Any]]]


@dataclass(frozen=True)
class Answer:
    """A decoder's answer for one vector.

    Attributes:
        status: PASSED if the file was decoded, REFUSED if it was refused, otherwise the kind of failure.
        message: one line about the failure.
        header: fields of header and index.
        arrays: size in bytes and SHA-256 of the raw little-endian values, by `part.name`, such as `floats.means`.
        floats: raw values by name, such as `means`, if they were kept for the class renderer.
        cuts: tiles or error codes of the requested cuts, in their order.
        code: error code of a refusal.
        clause: clause of a refusal, if reported.
        offset: offset in the file of a refusal, if reported.
        seconds: time the decoder took.
    """

    status: Status
    message: str = ""
    header: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    floats: Mapping[str, bytes] = field(default_factory=dict)
    cuts: Sequence[Cut] = ()
    code: str = ""
    clause: str | None = None
    offset: int | None = None
    seconds: float = 0.0


def level_name(level: int) -> str:
    """Return `L3` for 3."""
    return f"L{level}"


def compare_answer(
    vector: Vector, answer: Answer, levels: tuple[int, ...], *, exact: bool = False, near: FloatsByVector | None = None
) -> list[Outcome]:
    """Compare an answer with the manifest: one outcome for each level that applies to the vector.

    Args:
        vector: entry of the manifest.
        answer: the decoder's answer.
        levels: numbers of the levels to check.
        exact: require refusals to match in code, clause and offset, even optional ones: for csplat's own decoders.
        near: returns the exact floats of a vector, for decoders of the class renderer.
    """
    if vector.error:
        return [_check_invalid(vector, answer, exact)] if 1 in levels else []
    result = []
    for level, parts in PARTS.items():
        if level not in levels or not any(vector.expect[part] for part in parts):
            continue
        status, message = answer.status, answer.message
        if status is Status.PASSED:
            status, message = _compare_parts(vector, answer, parts, near)
        elif status is Status.REFUSED:
            message = message or "refused a valid file"
        passed = status is Status.PASSED
        result.append(
            Outcome(
                vector.name,
                level_name(level),
                status,
                tuple(vector.clauses),
                "" if passed else answer.code,
                message,
                answer.seconds if level == min(levels) else 0.0,
            )
        )
    return result


# Refusals ------------------------------------------------------------------------------------------


def _check_invalid(vector: Vector, answer: Answer, exact: bool) -> Outcome:
    """Compare the answer for an invalid vector (L1).

    An optional error may be accepted unless `exact`; its outcome has details for `check_payload_consistency`.
    """
    expected = vector.error
    status, message = answer.status, answer.message
    details = {}
    # Budgets do not count: another decoder may have a larger budget.
    if expected["optional"] and expected["code"] != _spec.ERROR_LIMIT and status in (Status.PASSED, Status.REFUSED):
        details = {"payload": expected["optional"], "accepted": status is Status.PASSED}
    if status is Status.PASSED:
        optional = expected["optional"] and not exact
        status, message = (Status.PASSED, "") if optional else (Status.FAILED, "accepted")
    elif status is Status.REFUSED:
        status, message = _match_refusal(answer, expected, exact)
    clauses = tuple(vector.clauses)
    if status not in (Status.PASSED, Status.SKIPPED):
        clauses = (expected["clause"], *(clause for clause in clauses if clause != expected["clause"]))
    return Outcome(vector.name, level_name(1), status, clauses, answer.code, message, answer.seconds, details)


def _match_refusal(answer: Answer, expected: Mapping[str, Any], exact: bool) -> tuple[Status, str]:
    """Return the status and a message about a refusal that differs from the planted error.

    Only `exact` compares clause and offset, and makes another code a failure, because the order of checks is free.
    """
    actual = _describe_error(answer.code, answer.clause, answer.offset)
    planted = f"planted {_describe_error(expected['code'], expected['clause'], expected['offset'])}, reported {actual}"
    if exact:
        same = (answer.code, answer.clause, answer.offset) == (expected["code"], expected["clause"], expected["offset"])
        return (Status.PASSED, "") if same else (Status.FAILED, planted)
    return Status.PASSED, "" if answer.code in (expected["code"], *expected["also"]) else planted


def _describe_error(code: str, clause: str | None, offset: int | None) -> str:
    """Return `E_CRC at byte 64 by CHK-1`, without the parts that are `None`."""
    where = "" if offset is None else f" at byte {offset}"
    return f"{code}{where}" + (f" by {clause}" if clause else "")


def check_payload_consistency(outcomes: Iterable[Outcome]) -> tuple[list[Outcome], list[str]]:
    """Check CHK-7: a decoder enforces all clauses on every payload of a chunk type, or leaves all unread (CHK-6).

    Args:
        outcomes: the results of `compare_answer` for all vectors.

    Returns:
        The outcomes, with failures for invalid payloads that were accepted while others of their type were refused;
        and a line for each type with accepted payloads.
    """
    result, notes = list(outcomes), []
    for kind in sorted({outcome.details["payload"] for outcome in result if "payload" in outcome.details}):
        chosen = [i for i, outcome in enumerate(result) if outcome.details.get("payload") == kind]
        accepted = [i for i in chosen if result[i].details["accepted"]]
        if len(accepted) == len(chosen):
            notes.append(f"leaves {kind} unread (CHK-6)")
        elif accepted:
            names = ", ".join(result[i].name for i in accepted)
            counts = f"{len(chosen) - len(accepted)} refused, {len(accepted)} accepted"
            notes.append(
                f"reads {kind}: {counts}: each accepted one is an error if your decoder reads {kind} (CHK-7): {names}"
            )
            message = f"accepted, while others of {kind} were refused (CHK-7)"
            for i in accepted:
                result[i] = replace(result[i], status=Status.FAILED, message=message)
    return result, notes


# Arrays --------------------------------------------------------------------------------------------


def _compare_parts(
    vector: Vector, answer: Answer, parts: tuple[str, ...], near: FloatsByVector | None
) -> tuple[Status, str]:
    """Compare parts of an answer with the manifest; return the worst status and all messages.

    Arrays that the manifest does not list are failures. Without `near`, floats must be equal bit for bit.
    """
    if not answer.header and not answer.arrays:
        return Status.NO_OUTPUT, "nothing was written"
    if "header" in parts:
        return _compare_header(vector.expect["header"], answer.header)
    wrong: list[tuple[Status, str]] = []
    for part in parts:
        for name, summary in vector.expect[part].items():
            key = f"{part}.{name}"
            wrong += _compare_size(key, summary, answer.arrays.get(key)) or _compare_values(vector, answer, key, near)
        part_keys = [key for key in answer.arrays if key.split(".", 1)[0] == part]
        unexpected = [key for key in part_keys if key.split(".", 1)[1] not in vector.expect[part]]
        wrong += [(Status.FAILED, f"{key}: unexpected array") for key in unexpected]
    if not wrong:
        return Status.PASSED, ""
    return max((status for status, _ in wrong), key=_rank_failure), "; ".join(text for _, text in wrong)


def _rank_failure(status: Status) -> int:
    """Rank the failure of an array: FAILED below PARTIAL_OUTPUT below WRONG_ANSWER, the largest decides."""
    return -[Status.WRONG_ANSWER, Status.PARTIAL_OUTPUT, Status.FAILED].index(status)


def whole_number(text: str) -> float:
    """Convert a JSON integer. Numbers beyond 2^53 become floats, because JavaScript writes 2^65 as an integer."""
    value = float(text)
    return int(text) if abs(value) <= _EXACT_MAX else value


def _compare_header(expect: Mapping[str, Any], header: Mapping[str, Any]) -> tuple[Status, str]:
    """Compare the fields of `expect` with a header, which may have more fields; flags may be in any order."""
    if not header:
        return Status.WRONG_ANSWER, "no header.json"
    wrong = []
    for key, value in expect.items():
        reported = header.get(key)
        if key == "scene_flags" and isinstance(reported, list):
            reported, value = sorted(map(str, reported)), sorted(value)  # noqa: PLW2901 - an unordered set
        if reported != value:
            wrong.append(f"header.{key} is {reported!r}, expected {value!r}")
    return (Status.FAILED, "; ".join(wrong)) if wrong else (Status.PASSED, "")


def _compare_size(key: str, summary: list[Any], array: tuple[int, str] | None) -> list[tuple[Status, str]]:
    """Return a failure if an array is missing or does not have the size of its `summary`: dtype, shape, SHA-256."""
    dtype, shape, _ = summary
    if array is None:
        return [(Status.WRONG_ANSWER, f"{key} is missing")]
    size = math.prod(shape) * int(dtype[1:])
    if array[0] != size:
        status = Status.PARTIAL_OUTPUT if array[0] < size else Status.FAILED
        return [(status, f"{key} has {array[0]} bytes, expected {size}, {dtype} {shape}")]
    return []


def _compare_values(vector: Vector, answer: Answer, key: str, near: FloatsByVector | None) -> list[tuple[Status, str]]:
    """Return a failure if an array of the right size differs; floats may differ by a tolerance if `near` is given."""
    part, name = key.split(".", 1)
    if answer.arrays[key][1] == vector.expect[part][name][2]:
        return []
    if near and part == "floats" and name in answer.floats:
        far = describe_deviation(name, answer.floats[name], near(vector.name)[name])
        return [(Status.FAILED, f"{key}: {far}")] if far else []
    return [(Status.FAILED, f"{key} differs")]


# Cuts ----------------------------------------------------------------------------------------------


def cuts_of_vector(vector: Vector) -> list[str]:
    """Return the cuts to request, such as `level 1`; none if the file is invalid or has a single tile."""
    return [text for text, _ in vector.expect.get("cuts", ())]


def compare_cuts(vector: Vector, answer: Answer) -> Outcome:
    """Compare the cuts of an answer with the cuts in the manifest (L5)."""
    status, message = answer.status, answer.message
    if status is Status.PASSED:
        status, message = _compare_cuts(vector.expect["cuts"], answer.cuts)
    code = "" if status is Status.PASSED else answer.code
    return Outcome(vector.name, level_name(CUTS), status, tuple(vector.clauses), code, message, answer.seconds)


def skip_cuts(vector: Vector, why: str) -> Outcome:
    """Return a skipped outcome for the cuts of a vector, with the reason."""
    return Outcome(vector.name, level_name(CUTS), Status.SKIPPED, tuple(vector.clauses), "", why)


def _compare_cuts(expect: Sequence[tuple[str, Cut]], cuts: Sequence[Cut]) -> tuple[Status, str]:
    """Compare the answers to cuts, (text, expected) each.

    A cut is not compared if it needs a feature that the decoder supports in no cut. Without any, the result is SKIPPED.
    """
    if len(cuts) != len(expect):
        status = Status.PARTIAL_OUTPUT if len(cuts) < len(expect) else Status.FAILED
        return (status if cuts else Status.NO_OUTPUT), f"{len(cuts)} cuts, expected {len(expect)}, a line for each"
    supported = (text for (text, _), cut in zip(expect, cuts, strict=True) if cut != _spec.ERROR_UNSUPPORTED)
    offered = {kind for text in supported for kind in _required_features(text)}
    wrong = [
        f"the cut {_shorten(text)!r} is {_shorten(_cut_text(cut))}, expected {_shorten(_cut_text(expected))}"
        for (text, expected), cut in zip(expect, cuts, strict=True)
        if cut != expected and _required_features(text) <= offered
    ]
    if wrong:
        more = f"; {len(wrong) - 1} of the other {len(expect) - 1} cuts are wrong, too" if len(wrong) > 1 else ""
        return Status.FAILED, wrong[0] + more
    missing = sorted({kind for text, _ in expect for kind in _required_features(text)} - offered)
    if missing:
        return (Status.PASSED if offered else Status.SKIPPED), f"the decoder offers no cut by {', '.join(missing)}"
    return Status.PASSED, ""


def _required_features(text: str) -> set[str]:
    """Return what a decoder needs to offer for a cut: `level`, `pixel_size` or `splats`, and perhaps `box`."""
    words = text.split()
    return {words[0], "box"} & {*words}


def _cut_text(cut: Cut) -> str:
    """Return the tiles of a cut separated by blanks, `empty` for none, or the error code."""
    return cut if isinstance(cut, str) else " ".join(map(str, cut)) or "empty"


def _shorten(text: str) -> str:
    """Cut a text to `_SHOWN_MAX` characters, with an ellipsis."""
    return text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}…"
