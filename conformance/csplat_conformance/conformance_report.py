# SPDX-License-Identifier: CC0-1.0
"""Report a run of the suite: as a table for people, as JSON for programs, as JUnit XML for CI.

    >>> report = ConformanceReport("decoder", "my-decoder {input} {outdir}", [
    ...     Outcome("valid/rich", "L2", Status.PASSED, seconds=0.25),
    ...     Outcome("invalid/index_crc", "L1", Status.FAILED, ("IDX-1",), "E_CRC", "accepted"),
    ... ])
    >>> report.passed
    False
    >>> print(to_table(report))
    L1  FAILED  invalid/index_crc  accepted (IDX-1, E_CRC)
    <BLANKLINE>
    level  checks  passed  failed  skipped
    L1          1       0       1        0
    L2          1       1       0        0
    all         2       1       1        0

A suite makes one `Outcome` for each check: one level of one vector or input. `failed` and the ways in which a process
can end without an answer (`crashed`, `hung` and so on) count as failures. Statuses that only some suites use are
columns only in their reports (`ConformanceReport.extra`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from html import escape
from typing import Any

from csplat.errors import counted
from csplat_conformance import SUITE_VERSION
from csplat_conformance.manifest import FORMAT

#: Characters that XML 1.0 does not allow, not even as references.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Status(StrEnum):
    """The result of a check. The statuses from `FAILED` to `REFUSED` are failures."""

    PASSED = "passed"
    WARNED = "warned"  #: passed, but much worse than necessary
    DECLINED = "declined"  #: refused an input that may be refused
    NOT_PROVED = "not_proved"  #: neither confirmed nor contradicted
    FAILED = "failed"  #: the answer is wrong
    CRASHED = "crashed"  #: ended by a signal
    HUNG = "hung"  #: did not end in time
    WRONG_STATUS = "wrong_status"  #: an exit status that the protocol does not define
    WRONG_ANSWER = "wrong_answer"  #: a valid exit status, without the line or the files that it requires
    NO_OUTPUT = "no_output"  #: exit status 0, but nothing was written
    PARTIAL_OUTPUT = "partial_output"  #: a truncated file, or a file left by a failed run
    REFUSED = "refused"  #: refused an input that must be accepted
    SKIPPED = "skipped"  #: not checked; the message gives the reason

    @property
    def text(self) -> str:
        """The status in words."""
        return self.replace("_", " ")


_GOOD = frozenset((Status.PASSED, Status.WARNED, Status.DECLINED, Status.NOT_PROVED, Status.SKIPPED))
#: Neither failures nor passes; JUnit reports them as skipped.
_OPEN = frozenset((Status.DECLINED, Status.NOT_PROVED, Status.SKIPPED))
#: Checks without an answer; JUnit reports them as errors.
_ERRORS = frozenset((Status.CRASHED, Status.HUNG, Status.WRONG_STATUS, Status.NO_OUTPUT, Status.WRONG_ANSWER))


@dataclass(frozen=True)
class Outcome:
    """One check.

    Attributes:
        name: the vector or input, with its group, `invalid/index_crc`.
        level: the level that was checked, `L1`.
        status: the result.
        clauses: violated clauses of the spec or, if unknown, the clauses that the check covers.
        code: error code that was reported or found, `E_CRC`.
        message: one line: the reason for a failure, or a remark.
        seconds: duration of the run.
        details: JSON-compatible values for programs, such as measured numbers.
    """

    name: str
    level: str
    status: Status
    clauses: tuple[str, ...] = ()
    code: str = ""
    message: str = ""
    seconds: float = 0.0
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """True if the check did not fail."""
        return self.status in _GOOD


@dataclass(frozen=True)
class ConformanceReport:
    """All checks of a run.

    Attributes:
        suite: `decoder` or `encoder`.
        subject: the tested program: a command line, or a description.
        outcomes: in the order of the run.
        notes: lines about the run as a whole.
        extra: statuses that this suite counts in addition to passed, failed and skipped.
        claim: what the subject may claim if the run was complete and everything passed: "decoder, exact".
    """

    suite: str
    subject: str
    outcomes: Sequence[Outcome]
    notes: Sequence[str] = ()
    extra: Sequence[Status] = ()
    claim: str = ""

    @property
    def failures(self) -> list[Outcome]:
        """The checks that did not pass."""
        return [outcome for outcome in self.outcomes if not outcome.good]

    @property
    def passed(self) -> bool:
        """True if something was checked and nothing failed."""
        return bool(self.outcomes) and not self.failures

    @property
    def badge(self) -> str:
        """The line by which the subject may claim conformance; "" if it may not."""
        if not (self.claim and self.passed):
            return ""
        return f"conforms to {FORMAT} as {self.claim} (suite {SUITE_VERSION}, {counted(len(self.outcomes), 'check')})"

    def levels(self) -> dict[str, dict[str, int]]:
        """Return the counts of each level."""
        return {level: self.counts(level) for level in _levels(self)}

    def counts(self, level: str | None = None) -> dict[str, int]:
        """Return the number of checks of a level, or of all levels, in total and by result."""
        return _counts((outcome for outcome in self.outcomes if level in (None, outcome.level)), self.extra)


def _levels(report: ConformanceReport) -> list[str]:
    """Return the levels that occur, in ascending order."""
    return sorted({outcome.level for outcome in report.outcomes})


def _counts(outcomes: Iterable[Outcome], extra: Sequence[Status]) -> dict[str, int]:
    """Count all checks, good checks by status (`extra` lists the suite's additional statuses), and failures."""
    counts = dict.fromkeys(("checks", "passed", *map(str, extra), "failed", "skipped"), 0)
    for outcome in outcomes:
        counts["checks"] += 1
        counts[str(outcome.status) if outcome.good else "failed"] += 1
    return counts


def to_table(report: ConformanceReport, *, verbose: bool = False) -> str:
    """Return one line for each failure, warning, skip and remark, followed by the counts by level.

    Args:
        report: the run.
        verbose: include a line for every check.
    """
    listed = [outcome for outcome in report.outcomes if verbose or outcome.message or not outcome.good]
    lines = _align_columns(
        [(outcome.level, _word(outcome.status), outcome.name, _remark(outcome)) for outcome in listed]
    )
    lines += [""] * bool(lines)
    lines += [*report.notes]
    counts = [*report.levels().items(), ("all", report.counts())]
    header = ("level", *(name.replace("_", " ") for name in counts[-1][1]))
    rows = [(level, *map(str, count.values())) for level, count in counts]
    badge = ["", report.badge] if report.badge else []
    return "\n".join([*lines, *_align_columns([header, *rows], right=True), *badge])


def _word(status: Status) -> str:
    """Return the word for a status, in capitals for failures."""
    return "ok" if status is Status.PASSED else status.text if status in _GOOD else status.text.upper()


def _remark(outcome: Outcome) -> str:
    """Return the message on one line, with clauses and code unless the outcome is good and has no message."""
    message = " ".join(outcome.message.split())  # may come from a foreign program: keep it on one line
    where = ", ".join([*outcome.clauses, *([outcome.code] if outcome.code else [])])
    if not where or (outcome.good and not message):
        return message
    return f"{message} ({where})" if message else f"({where})"


def _align_columns(rows: Sequence[Sequence[str]], *, right: bool = False) -> list[str]:
    """Return a line for each row, with columns aligned to the left or, except for the first, to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if right and i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines


def to_json(report: ConformanceReport) -> dict[str, Any]:
    """Return the fields of a report as JSON-compatible values, with `passed`, `badge` and the counts of `levels`."""
    return {
        "suite": report.suite,
        "subject": report.subject,
        "passed": report.passed,
        "badge": report.badge,
        "levels": report.levels(),
        "notes": list(report.notes),
        "outcomes": [_outcome_json(outcome) for outcome in report.outcomes],
    }


def _outcome_json(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome as JSON-compatible values."""
    return {
        "name": outcome.name,
        "level": outcome.level,
        "status": str(outcome.status),
        "clauses": list(outcome.clauses),
        "code": outcome.code,
        "message": outcome.message,
        "seconds": round(outcome.seconds, 4),
        "details": outcome.details,
    }


def to_junit(report: ConformanceReport) -> str:
    """Return the report as JUnit XML, with a test suite for each level and a test case for each check."""
    suites = [_junit_suite(report, level) for level in _levels(report)]
    head = f'<testsuites name="csplat {_xml(report.suite)}" {_junit_totals(report.outcomes)}>'
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', head, *suites, "</testsuites>", ""])


def _junit_suite(report: ConformanceReport, level: str) -> str:
    """Return the XML of a test suite with the outcomes of a level; subject and notes are its properties."""
    outcomes = [outcome for outcome in report.outcomes if outcome.level == level]
    name = f"csplat.{report.suite}.{level}"
    cases = [_junit_case(outcome, name) for outcome in outcomes]
    head = f'  <testsuite name="{_xml(name)}" {_junit_totals(outcomes)}>'
    facts = [("subject", report.subject), *(("note", note) for note in report.notes)]
    properties = "".join(f'<property name="{name}" value="{_xml(value)}"/>' for name, value in facts)
    return "\n".join([head, f"    <properties>{properties}</properties>", *cases, "  </testsuite>"])


def _junit_totals(outcomes: Sequence[Outcome]) -> str:
    """Return the XML attributes with numbers of tests, failures, errors and skipped tests, and the time in seconds."""
    errors = sum(outcome.status in _ERRORS for outcome in outcomes)
    failures = sum(not outcome.good for outcome in outcomes) - errors
    skipped = sum(outcome.status in _OPEN for outcome in outcomes)
    seconds = sum(outcome.seconds for outcome in outcomes)
    return f'tests="{len(outcomes)}" failures="{failures}" errors="{errors}" skipped="{skipped}" time="{seconds:.3f}"'


def _junit_case(outcome: Outcome, suite: str) -> str:
    """Return the XML of a test case: warnings as its output, unchecked cases as skipped."""
    head = f'    <testcase classname="{_xml(suite)}" name="{_xml(outcome.name)}" time="{outcome.seconds:.3f}"'
    if outcome.status is Status.PASSED:
        return head + "/>"
    if outcome.status is Status.WARNED:
        return f"{head}><system-out>{_xml(f'warning: {outcome.message}')}</system-out></testcase>"
    if outcome.status in _OPEN:
        message = outcome.message if outcome.status is Status.SKIPPED else f"{outcome.status.text}: {outcome.message}"
        return f'{head}><skipped message="{_xml(message)}"/></testcase>'
    kind = "error" if outcome.status in _ERRORS else "failure"
    message = f'message="{_xml(f"{outcome.status.text}: {_remark(outcome)}")}"'
    return f'{head}><{kind} type="{_xml(outcome.code or str(outcome.status))}" {message}/></testcase>'


def _xml(text: str) -> str:
    """Quote for an attribute, with question marks for characters that XML does not allow."""
    return (
        escape(_NOT_XML.sub("?", text), quote=True).replace("\n", "&#10;").replace("\t", "&#9;").replace("\r", "&#13;")
    )
