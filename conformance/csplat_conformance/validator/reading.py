"""Structures out of bytes, and payloads that must end with their last structure."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from csplat_conformance.validator.findings import Findings, Placed

T = TypeVar("T")
_Unpack = Callable[[memoryview, int], T]


class UnreadableError(Exception):
    """Raised when the place of what follows is unknown: a length or a kind is wrong. The violation has been noted."""


def place(view: memoryview, unpack: _Unpack[T], places: dict[str, int], at: int, name: str) -> Placed[T]:
    """Read a structure that is known to fit."""
    return Placed(unpack(view, at), at, name, places)


class Payload:
    """The payload of a chunk, read from its beginning to its end.

    Args:
        view: the whole file.
        at: offset of the payload.
        end: offset of its end.
        name: name of the chunk, `TILE.0.0`.
        clause: the clause that requires the payload to end with its last structure.
        findings: receives the violations.
    """

    def __init__(self, view: memoryview, at: int, end: int, name: str, clause: str, findings: Findings) -> None:
        self.view = view
        self.at = at
        self.end = end
        self.name = name
        self.clause = clause
        self.findings = findings

    @property
    def left(self) -> int:
        """Bytes that were not taken yet."""
        return self.end - self.at

    def take(self, size: int, what: str) -> int:
        """Step over `size` bytes and return where they begin.

        Raises:
            UnreadableError: fewer are left.
        """
        at = self.at
        if size > self.left:
            self.findings.add(
                self.clause, at, f"{self.name}/{what}", f"the payload ends here, {self.left} of {size} bytes are left"
            )
            raise UnreadableError
        self.at += size
        return at

    def structure(self, unpack: _Unpack[T], size: int, places: dict[str, int], what: str) -> Placed[T]:
        """Read the next structure and look at its reserved fields; its name is that of the chunk and `what`."""
        at = self.take(size, what)
        placed = place(self.view, unpack, places, at, f"{self.name}/{what}")
        self.findings.reserved(placed)
        return placed

    def finish(self) -> None:
        """Nothing follows the last structure."""
        if self.left:
            self.findings.add(self.clause, self.at, f"{self.name}/tail", f"{self.left} bytes follow the last structure")
