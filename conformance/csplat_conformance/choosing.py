"""Names chosen by shell patterns."""

from __future__ import annotations

import fnmatch
from collections.abc import Collection

from csplat.errors import InputError


def matching(patterns: str | None, names: Collection[str], what: str) -> set[str]:
    """Return the names that one of some patterns matches; all of them for None.

    Args:
        patterns: as in a shell, with commas between them: `valid/sh*,valid/absent_*`. One matches whole names, or the
            part before a hyphen: `MOR` is `MOR-*`, and so a chapter of clauses.
        names: to choose from.
        what: the thing that has the names, for messages.

    Raises:
        InputError: a pattern matches none of them.
    """
    chosen: set[str] = set()
    for pattern in () if patterns is None else patterns.split(","):
        found = {*fnmatch.filter(names, pattern.strip()), *fnmatch.filter(names, f"{pattern.strip()}-*")}
        if not found:
            raise InputError(f"no {what} matches {pattern.strip()!r}")
        chosen |= found
    return set(names) if patterns is None else chosen
