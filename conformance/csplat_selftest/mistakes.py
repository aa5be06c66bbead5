"""Mistakes of wrong decoders, ways to plant them in the Python decoder, and the suite's findings."""

from __future__ import annotations

import inspect
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from unittest import mock

from csplat import decoder
from csplat_conformance.conformance_report import Outcome
from csplat_conformance.tolerance import EXACT

#: Takes the right function, then its arguments.
Wrong = Callable[..., Any]


@dataclass(frozen=True)
class Mistake:
    """One thing that a decoder does wrong.

    Attributes:
        name: short name.
        what: the mistake that a hurried implementer might make.
        clause: the clause of the spec that it breaks.
        apply: makes the decoder wrong until the stack is closed.
        by: class of decoders (spec 9.2) that it is judged as.
    """

    name: str
    what: str
    clause: str
    apply: Callable[[ExitStack], None]
    by: str = EXACT


@dataclass(frozen=True)
class Caught:
    """The suite's findings about a wrong decoder.

    Attributes:
        language: language of the decoder.
        mistake: its mistake.
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


def replaced(name: str, wrong: Wrong) -> Callable[[ExitStack], None]:
    """Return what replaces a function of the decoder wherever it was imported; `wrong` gets the right one first."""

    def apply(stack: ExitStack) -> None:
        prefix = decoder.__name__ + "."
        modules = [module for key, module in list(sys.modules.items()) if key.startswith(prefix)]
        owners = [module for module in modules if hasattr(module, name)]
        assert owners, f"the decoder has no {name}"
        for owner in owners:
            right = getattr(owner, name)
            stack.enter_context(mock.patch.object(owner, name, _bound(wrong, right)))

    return apply


def reworded(name: str, words: Mapping[str, str]) -> Callable[[ExitStack], None]:
    """Return what replaces pieces of the text of a function, each of which it has to hold once."""

    def apply(stack: ExitStack) -> None:
        prefix = decoder.__name__ + "."
        modules = [module for key, module in list(sys.modules.items()) if key.startswith(prefix)]
        (right,) = {getattr(module, name) for module in modules if hasattr(module, name)}
        text = inspect.getsource(right)
        for old, new in words.items():
            if text.count(old) != 1:
                raise ValueError(f"{name} has {old!r} {text.count(old)} times, wanted once: mend the mistake")
            text = text.replace(old, new)
        made: dict[str, Any] = {}
        exec(text, right.__globals__, made)  # noqa: S102 - the text is the decoder's own
        replaced(name, lambda _right, *args, **options: made[name](*args, **options))(stack)

    return apply


def method(owner: type, name: str, wrong: Wrong) -> Callable[[ExitStack], None]:
    """Return what replaces a method."""

    def apply(stack: ExitStack) -> None:
        right = getattr(owner, name)
        stack.enter_context(mock.patch.object(owner, name, _bound(wrong, right)))

    return apply


def _bound(wrong: Wrong, right: Wrong) -> Wrong:
    def replacement(*args: Any, **options: Any) -> Any:
        return wrong(right, *args, **options)

    return replacement


def nothing(_right: Wrong, *_args: Any, **_options: Any) -> None:
    """Do nothing in the place of a function."""
