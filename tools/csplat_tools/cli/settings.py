"""`--set NAME=VALUE`: options of the library that have no option of their own on the command line."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Literal, get_args, get_origin, get_type_hints

import typer

from csplat.errors import InputError, missing

_READERS: dict[type, tuple[Callable[[str], Any], str]] = {
    bool: ({"yes": True, "no": False}.__getitem__, "yes or no"),
    int: (int, "an integer"),
    float: (float, "a number"),
    str: (str, "a word"),
}


@dataclass(frozen=True)
class Settings:
    """The values of `--set`.

    Attributes:
        values: values by dataclass of the library and by field.
    """

    values: dict[type, dict[str, Any]]

    def of(self, kind: type) -> dict[str, Any]:
        """Return the values that were set for a dataclass, by field."""
        return self.values.get(kind, {})


def read_settings(texts: Sequence[str], kinds: Sequence[str], taken: Collection[str]) -> Settings:
    """Parse settings such as `position-bits=12,scale-step=0.1`.

    Args:
        texts: values of `--set`, each with settings separated by commas.
        kinds: dataclasses whose fields may be set, as `module:name`; imported only if anything is set.
        taken: names of fields that have an option of their own.

    Raises:
        typer.BadParameter: there is no such setting, one is given twice, or its value is of another type.
        InputError: an extra is not installed.
    """
    known = {name: (kind, type_) for kind in _imported(kinds if texts else ()) for name, type_ in _names(kind, taken)}
    found = dict[type, dict[str, Any]]()
    for word in (word.strip() for text in texts for word in text.split(",") if word.strip()):
        shown, equals, value = (part.strip() for part in word.partition("="))
        name = shown.replace("-", "_")
        if name not in known or not equals:
            near = get_close_matches(name, known, 1)
            meant = f", perhaps {near[0].replace('_', '-')}=...?" if near else ": --help-all lists them"
            raise typer.BadParameter(f"--set {word}: no such setting{meant}")
        kind, type_ = known[name]
        values = found.setdefault(kind, {})
        if name in values:
            raise typer.BadParameter(f"--set {shown} is given twice")
        read, wanted = _READERS[type_]
        try:
            values[name] = read(value)
        except (ValueError, KeyError):
            raise typer.BadParameter(f"--set {shown} is {value!r}, wanted {wanted}") from None
    return Settings(found)


def describe_settings(kinds: Sequence[str], taken: Collection[str]) -> str:
    """Return the names of the settings, with their descriptions from the dataclasses' docstrings, for `--help-all`."""
    lines = []
    try:
        found = _imported(kinds)
    except InputError as error:
        return f"Settings of --set: {error}"
    for kind in found:
        told = dict(re.findall(r"^    (\w+): (.*(?:\n        .*)*)", inspect.getdoc(kind) or "", re.MULTILINE))
        for name, _ in _names(kind, taken):
            lines.append(f"  {name.replace('_', '-')}: {' '.join(told.get(name, '').split())}")
    return "Settings of --set NAME=VALUE,...:\n" + "\n".join(lines)


def _imported(kinds: Sequence[str]) -> list[type]:
    try:
        return [getattr(import_module(module), name) for module, _, name in (kind.partition(":") for kind in kinds)]
    except ModuleNotFoundError as error:
        raise missing(error) from None


def _names(kind: type, taken: Collection[str]) -> list[tuple[str, type]]:
    """Return the fields of plain types, including Literal words, that have no option of their own, with their types."""
    hints = get_type_hints(kind)
    found = []
    for one in fields(kind):
        hint = hints[one.name]
        each_of = (hint,) if get_origin(hint) is Literal else get_args(hint) or (hint,)
        # The dataclass checks the words of a Literal when it is created.
        types = [str if get_origin(each) is Literal else each for each in each_of if each is not type(None)]
        if one.name not in taken and len(types) == 1 and types[0] in _READERS:
            found.append((one.name, types[0]))
    return found
