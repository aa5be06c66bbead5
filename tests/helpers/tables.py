"""Tables of cases with one verdict per case: a single test checks them all, and names the cases that fail."""

from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import pytest

T = TypeVar("T")

_SHOWN = 200  # characters of a reason


def failures(cases: Mapping[str, T] | Iterable[T], check: Callable[[T], None]) -> list[str]:
    """Return a line for each case that fails, its name and the reason: `assert [] == failures(cases, check)`.

    Args:
        cases: by name, or objects with a `name`.
        check: raises an error if a case is wrong, as `assert` and `pytest.raises` do.

    Raises:
        ValueError: there are no cases, or two of one name.
    """
    pairs = [*cases.items()] if isinstance(cases, Mapping) else [(case.name, case) for case in cases]
    if not pairs or len(dict(pairs)) < len(pairs):
        raise ValueError(
            f"{len(dict(pairs))} names of {len(pairs)} cases, expected one or more, each with its own name"
        )
    failing = []
    for name, case in pairs:
        try:
            check(case)
        except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001 - every case is checked, whatever fails
            reason = " ".join(f"{type(error).__name__}: {error}".removeprefix("AssertionError: ").split())
            failing.append(f"{name}: {reason}"[: len(name) + _SHOWN])
    return failing


def differing(wanted: Mapping[str, object], found: Mapping[str, object]) -> list[str]:
    """Return the names whose values differ, or that only one has: `assert [] == differing(wanted, found)`."""
    return sorted(name for name in {*wanted, *found} if wanted.get(name) != found.get(name))
