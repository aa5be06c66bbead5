# SPDX-License-Identifier: Apache-2.0
"""Load extensions of the codec from the entry points of installed packages.

| group | entry points |
|---|---|
| `csplat.formats` | a `csplat.formats.format.Format` under the name of each format |
| `csplat.display` | `html`: a function that converts a `SplatModel` to HTML for notebooks |
| `csplat.search` | `target`: a `csplat.encode_api.Search`, which meets a `Target` by rendering |
| `csplat.levels` | `builder`: a function of splat count, options and levels that returns a `LevelBuilder` or `None` |
| `csplat.functions` | functions of the other packages that `csplat` offers under their own names |
| `csplat.kernels` | `nearest_entries`: a function that returns an `encoder.entry_search.NearestEntries` or `None` |
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import TYPE_CHECKING, Any

from csplat.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints


def load_plugins(group: str) -> dict[str, Any]:
    """Load the entry points of a group by name.

    Entry points with missing dependencies are omitted. Other failing entry points are omitted with a `RuntimeWarning`.
    """
    plugins = {}
    for point in _entry_points(group):
        try:
            plugins[point.name] = point.load()
        except ModuleNotFoundError:
            continue  # its extra is not installed
        except Exception as error:  # noqa: BLE001  # someone else's broken package must not keep us from reading a PLY
            text = f"{point.value}, installed as {point.name!r} of {group}, cannot be loaded: {error}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
    return plugins


def __getattr__(name: str) -> Any:
    """Return a function of the group `csplat.functions`, for `csplat` to offer.

    Raises:
        InputError: the package that has it, or one that it requires, is not installed.
    """
    if name.startswith("_"):  # each import of this module asks for `__path__`
        raise AttributeError(name)
    for point in _entry_points("csplat.functions").select(name=name):
        return point.load()
    raise InputError(f"csplat.{name} is not installed: csplat has to be installed as a whole")


@cache
def _entry_points(group: str) -> EntryPoints:
    """Return the entry points of a group from the metadata of all installed packages."""
    from importlib.metadata import entry_points  # takes 20 ms, the look-up another 10 ms with 120 packages

    return entry_points(group=group)
