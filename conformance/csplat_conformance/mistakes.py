"""What a wrong decoder does wrong, and what the suite says of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from csplat_conformance.report import Outcome

__all__ = ["Caught", "Mistake"]


@dataclass(frozen=True)
class Mistake:
    """One thing that a decoder does wrong.

    Attributes:
        name: short.
        what: what a hurried implementer might do.
        clause: of the spec, that it breaks.
        apply: makes the decoder wrong until the stack is closed.
    """

    name: str
    what: str
    clause: str
    apply: Callable[[ExitStack], None]


@dataclass(frozen=True)
class Caught:
    """What the suite says of a wrong decoder.

    Attributes:
        language: of the decoder.
        mistake: what is wrong with it.
        failed: the checks that failed.
    """

    language: str
    mistake: Mistake
    failed: Sequence[Outcome]

    @property
    def vectors(self) -> list[str]:
        """Names of the vectors that failed."""
        return list(dict.fromkeys(outcome.name for outcome in self.failed))

    @property
    def clauses(self) -> list[str]:
        """Clauses that the failed vectors name, the most frequent first."""
        by_vector = {outcome.name: outcome.clauses for outcome in self.failed}
        counts = Counter(clause for clauses in by_vector.values() for clause in clauses)
        return [clause for clause, _ in counts.most_common()]
