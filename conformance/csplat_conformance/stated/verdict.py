"""The result of an attempt to prove the errors that a file states."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

_NOT_WITHOUT_INDEX = "rms and counts are not proved without a source index"


@dataclass(frozen=True)
class Worst:
    """The splat that is farthest off.

    Attributes:
        splat: splat of the file.
        tile: tile that holds it.
        source_splat: its source splat or, if that is not known, the nearest one.
        found: its error, in the measure's unit.
    """

    splat: int
    tile: int
    source_splat: int
    found: float


@dataclass(frozen=True)
class MeasureProof:
    """One measure: what is stated, what was found, and whether it holds.

    Attributes:
        name: name in the registry of stated errors.
        stated_max, stated_rms: errors in the file; `None` if it does not state the measure.
        measured_max, measured_rms: errors of the pairs; `None` without a source index.
        holds: nothing contradicts the statement; `None` if there is none.
        worst: the splat with the largest error. Without a source index it is there only if a splat has no partner
            because of this measure.
    """

    name: str
    stated_max: float | None
    stated_rms: float | None
    measured_max: float | None
    measured_rms: float | None
    holds: bool | None
    worst: Worst | None


@dataclass(frozen=True)
class Proof:
    """The result of an attempt to prove stated errors.

    Attributes:
        measures: in the order of the registry.
        failures: one line each; none if the file's statement holds.
        clauses: the clauses of the spec that the failures break.
        unproved: measures for which the file states no error: refitted ones, or all.
        rms_proved: whether rms and counts were proved, too.
    """

    measures: tuple[MeasureProof, ...] = ()
    failures: tuple[str, ...] = ()
    clauses: tuple[str, ...] = ()
    unproved: tuple[str, ...] = ()
    rms_proved: bool = False

    @property
    def holds(self) -> bool:
        """True if everything that could be checked holds."""
        return not self.failures

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about what was not proved."""
        notes = []
        if self.measures and not self.rms_proved:
            notes.append(_NOT_WITHOUT_INDEX)
        if self.unproved:
            notes.append(f"not proved: {', '.join(self.unproved)}: no error of them is stated, renders are their judge")
        return tuple(notes)

    def as_json(self) -> dict[str, Any]:
        """Everything, JSON-compatible; what overflowed is `null`."""
        return {
            "rms_and_counts_proved": self.rms_proved and self.holds,
            "failures": list(self.failures),
            "not_proved": list(self.unproved),
            "notes": list(self.notes),
            "measures": {
                one.name: {
                    "stated_max": one.stated_max,
                    "stated_rms": one.stated_rms,
                    "measured_max": _finite(one.measured_max),
                    "measured_rms": _finite(one.measured_rms),
                    "holds": one.holds,
                    "worst": None if one.worst is None else {**vars(one.worst), "found": _finite(one.worst.found)},
                }
                for one in self.measures
            },
        }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
