"""Findings of the validator: one `Violation` for each clause that is broken at a place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from csplat_conformance.validator.rules import CODES

T = TypeVar("T")

#: A file of garbage with sound sizes breaks a clause every few bytes: nobody reads more.
VIOLATIONS_MAX = 10_000


@dataclass(frozen=True)
class Violation:
    """A clause that is broken.

    Attributes:
        clause: id of the spec.
        code: error code with which a decoder refuses the file; empty for SER-5, which no decoder can judge.
        offset: byte of the file where the offending field, or else its structure, begins.
        field: its name: structure and field, `tile[0].layer[1].offset`, `TILE.0.1/sh1.stream.count`.
        message: what was found and what was expected, one line.
    """

    clause: str
    code: str
    offset: int
    field: str
    message: str

    def __str__(self) -> str:
        code = f"{self.code} " if self.code else ""
        return f"{self.clause} {code}at byte {self.offset}, {self.field}: {self.message}"


@dataclass(frozen=True)
class Unread:
    """A part of the file that could not be looked at, because of a violation before it.

    Attributes:
        field: name of the part.
        reason: why, a few words.
    """

    field: str
    reason: str

    def __str__(self) -> str:
        return f"not looked at: {self.field} ({self.reason})"


@dataclass(frozen=True)
class Validation:
    """The result of validating a file.

    Attributes:
        violations: ordered by offset. If there are none, the file conforms (CNF-1).
        remarks: what no clause forbids although the spec asks otherwise: unused values that are not written as
            stated, recommendations not followed. A line each.
        unread: parts that were not checked; without violations there are none.
        splat_count: N in the index, 0 if it could not be read.
        tile_count: number of tile records that were read.
        checks: names of the checks that were made.
    """

    violations: tuple[Violation, ...]
    remarks: tuple[str, ...] = ()
    unread: tuple[Unread, ...] = ()
    splat_count: int = 0
    tile_count: int = 0
    checks: tuple[str, ...] = ()

    @property
    def conforms(self) -> bool:
        """True if no clause is broken."""
        return not self.violations


class TooManyError(Exception):
    """Raised when there are too many violations for the rest to be worth checking."""


@dataclass(frozen=True)
class Placed(Generic[T]):
    """A structure of the registry, and where it lies.

    Attributes:
        record: its fields.
        offset: byte of the file where it begins.
        name: prefix of its fields' names, `tile[0]`.
        places: offset of each field in it.
    """

    record: T
    offset: int
    name: str
    places: dict[str, int]

    def at(self, key: str, within: int = 0) -> int:
        """Byte of the file where a field begins, or a byte within it."""
        return self.offset + self.places[key] + within

    def path(self, key: str) -> str:
        """Full name of a field."""
        return f"{self.name}.{key}"


@dataclass
class Findings:
    """Collects what is found, in any order."""

    violations: list[Violation] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    unread: list[Unread] = field(default_factory=list)
    checks: list[str] = field(default_factory=list)

    def add(self, clause: str, offset: int, name: str, message: str, code: str = "") -> None:
        """Note a violation.

        Args:
            clause: id of the spec.
            offset: byte of the file.
            name: name of the field.
            message: what was found and what was expected.
            code: error code, if it is not the clause's usual one.

        Raises:
            TooManyError: the list is full.
        """
        self.violations.append(Violation(clause, code or CODES[clause], offset, name, message))
        if len(self.violations) >= VIOLATIONS_MAX:
            self.remarks.append(f"more than {VIOLATIONS_MAX} violations: the rest of the file was not looked at")
            raise TooManyError

    def of(self, clause: str, placed: Placed[Any], key: str, message: str, code: str = "", within: int = 0) -> None:
        """Note a violation by a field of a structure; the message gets the field's name."""
        self.add(clause, placed.at(key, within), placed.path(key), message, code)

    def reserved(self, placed: Placed[Any]) -> None:
        """RES-1: "A reserved field or bit MUST be 0"."""
        for key in placed.places:
            value = getattr(placed.record, key)
            if key.startswith("reserved_") and value != 0:
                self.of("RES-1", placed, key, f"reserved, holds {value}, wanted 0")

    def skip(self, name: str, reason: str) -> None:
        """Note that a part is not looked at."""
        self.unread.append(Unread(name, reason))
