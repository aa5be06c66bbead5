"""Entry points of installed packages, which extend the codec without it knowing them.

| group | entry points |
|---|---|
| `csplat.formats` | a `csplat.formats.format.Format` each, under its name |
| `csplat.display` | `html`: a function from a `SplatModel` to HTML, for notebooks |
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints


def load_plugins(group: str) -> dict[str, Any]:
    """Load all entry points of a group, by name.

    Raises:
        ImportError: a package that is installed cannot be imported.
    """
    return {point.name: point.load() for point in _entry_points(group)}


@cache
def _entry_points(group: str) -> EntryPoints:
    from importlib.metadata import entry_points  # takes 20 ms, and the look-up 5 ms for a hundred packages

    return entry_points(group=group)
