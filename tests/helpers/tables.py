# SPDX-License-Identifier: Apache-2.0
"""Tables of cases with one verdict per case: a single test checks them all, and names the cases that fail."""

import pytest

_SHOWN = 200  # characters of a reason


def failures(cases, check):
    """Return a line for each case for which `check` raises, its name and the reason: `assert [] == failures(...)`.

    Cases are a dictionary by name, or objects with a `name`; there is one at least, and names differ.
    """
    pairs = [*cases.items()] if isinstance(cases, dict) else [(case.name, case) for case in cases]
    if not pairs or len(dict(pairs)) < len(pairs):
        raise ValueError(f"{len(dict(pairs))} names of {len(pairs)} cases, expected as many, and one or more")
    failing = []
    for name, case in pairs:
        try:
            check(case)
        except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001 - every case is checked, whatever fails
            reason = " ".join(f"{type(error).__name__}: {error}".removeprefix("AssertionError: ").split())
            failing.append(f"{name}: {reason}"[: len(name) + _SHOWN])
    return failing


def differing(wanted, found):
    """Return the names whose values differ, or that only one has: `assert [] == differing(wanted, found)`."""
    return sorted(name for name in {*wanted, *found} if wanted.get(name) != found.get(name))
