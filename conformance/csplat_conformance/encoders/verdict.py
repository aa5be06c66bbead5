"""The verdict of one level on one file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from csplat_conformance.report import Status

#: A defect: the broken clause, empty if there is none, and a line about it.
Wrong = tuple[str, str]

_SHOWN = 2


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


def failed(wrong: list[Wrong], details: dict[str, Any]) -> Verdict:
    """Return a failure for what is wrong."""
    clauses = tuple(dict.fromkeys(clause for clause, _ in wrong if clause))
    return Verdict(Status.FAILED, "; ".join(text for _, text in wrong), clauses, details=details)


def in_short(lines: tuple[str, ...]) -> str:
    """Return the first of some lines as one, and how many more there are: a line stays readable."""
    rest = f"; and {len(lines) - _SHOWN} more" if len(lines) > _SHOWN else ""
    return "; ".join(lines[:_SHOWN]) + rest
