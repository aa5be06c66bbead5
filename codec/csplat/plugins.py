"""Entry points of installed packages, which extend the codec without it knowing them.

| group | entry points |
|---|---|
| `csplat.formats` | a `csplat.formats.format.Format` each, under its name |
| `csplat.display` | `html`: a function from a `SplatModel` to HTML, for notebooks |
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints


def load_plugins(group: str) -> dict[str, Any]:
    """Load the entry points of a group, by name, without those whose dependencies are absent.

    One that cannot be loaded for another reason is left out with a `RuntimeWarning`.
    """
    found = {}
    for point in _entry_points(group):
        try:
            found[point.name] = point.load()
        except ModuleNotFoundError:
            continue  # of an extra that is not installed
        except Exception as error:  # noqa: BLE001  # a broken package of others must not stop the reading of a PLY
            text = f"{point.value}, installed as {point.name!r} of {group}, cannot be loaded: {error}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
    return found


@cache
def _entry_points(group: str) -> EntryPoints:
    from importlib.metadata import entry_points  # about 20 ms, and the look-up 10 ms with 120 packages

    return entry_points(group=group)
