# SPDX-License-Identifier: Apache-2.0
"""Suites: TOML files that declare scenes, cases, and the table and plot of the results.

title = "Presets"
subject = "files"                       # a name of `subjects.SUBJECTS`
scenes = ["sample", "lego60k"]
repeats = 3                             # turns; results are medians. Default: 1
warmups = 1                             # turns before them that do not count. Default: 0
warmup_splats = 1000000                 # more such turns for small scenes: one per scene size in this number
ratio = "decode_seconds"                # times_as_fast: the `reference` case's value over a case's own

[options]                               # arguments that the subject reads
metrics = ["psnr"]

[[cases]]
name = "{preset}"
each.preset = ["fast", "small"]         # one case for each value, which replaces {preset} in all settings
scenes = ["lego60k"]                    # only on these. Default: all
command = "encode --preset {preset}"    # this and all other keys are the subject's

[table]
columns = [["scene", "{scene}"], ["MB", "{size_bytes / 1e6:.2f}"]]

[plot]                                  # see `tables.draw_plot`
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from csplat.errors import InputError

FOLDER = Path(__file__).resolve().parent.parent / "suites"

_KEYS: dict[str, type] = {
    "title": str, "subject": str, "scenes": list, "repeats": int, "warmups": int, "warmup_splats": int, "ratio": str,
    "options": dict, "cases": list, "table": dict, "plot": dict,
}  # fmt: skip
_REQUIRED = ("title", "subject", "scenes", "cases")
_WARMUPS_MAX = 10  # turns


@dataclass(frozen=True)
class Case:
    """One way to do the work that a suite measures: a command line, a program, a decoder.

    Attributes:
        name: unique in the suite.
        settings: all other keys of the TOML table, for the subject.
    """

    name: str
    settings: Mapping[str, Any]

    def __getitem__(self, key: str) -> Any:
        """Return a setting.

        Raises:
            InputError: the suite does not have it.
        """
        if key not in self.settings:
            raise InputError(f"case {self.name!r} has no {key!r}, which its subject requires")
        return self.settings[key]

    def get(self, key: str, default: Any = None) -> Any:
        """Return a setting, or the default."""
        return self.settings.get(key, default)


@dataclass(frozen=True)
class Suite:
    """A parsed suite; see the module's documentation for its keys."""

    name: str
    title: str
    subject: str
    scenes: Sequence[str]
    cases: Sequence[Case]
    repeats: int = 1
    warmups: int = 0
    warmup_splats: int = 0
    ratio: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    columns: Sequence[Sequence[str]] = ()
    plot: Mapping[str, Any] | None = None

    def cases_on(self, scene: str, only: Sequence[str] = ()) -> list[Case]:
        """Return the cases of a scene, with `only` those whose names match one of its patterns."""
        return [
            case
            for case in self.cases
            if scene in case.get("scenes", [scene]) and (not only or _matches(case.name, only))
        ]

    def warmups_of(self, splats: int) -> int:
        """Return the number of turns that do not count, for a scene of `splats` splats; 0: not known."""
        return self.warmups + (min(_WARMUPS_MAX, self.warmup_splats // splats) if splats else 0)


def suite_names() -> list[str]:
    """Return the names of all suites in the repository."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_suite(name: str, subjects: Sequence[str]) -> Suite:
    """Read a suite.

    Args:
        name: a name in the repository, or the path of a TOML file.
        subjects: the registered subjects.

    Raises:
        InputError: there is no such suite, or it is not valid.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.exists():
        raise InputError(f"{name!r} is not a suite, expected a TOML file or one of {', '.join(suite_names())}")
    try:
        table = tomllib.loads(path.read_text("utf-8"))
        return _parse(path.stem, table, subjects)
    except (tomllib.TOMLDecodeError, InputError) as error:
        raise InputError(f"{path}: {error}") from None


def _parse(name: str, table: Mapping[str, Any], subjects: Sequence[str]) -> Suite:
    for key, value in table.items():
        if key not in _KEYS:
            raise InputError(f"{key!r} is not a key of a suite, expected one of {', '.join(_KEYS)}")
        if not isinstance(value, _KEYS[key]):
            raise InputError(f"{key!r} is a {type(value).__name__}, expected a {_KEYS[key].__name__}")
    for key in _REQUIRED:
        if not table.get(key):
            raise InputError(f"{key!r} is missing or empty")
    if table["subject"] not in subjects:
        raise InputError(f"subject is {table['subject']!r}, expected one of {', '.join(subjects)}")
    if table.get("repeats", 1) < 1:
        raise InputError(f"repeats is {table['repeats']}, expected 1 or more")
    cases = [case for one in table["cases"] for case in _expand(one)]
    names = [case.name for case in cases]
    for case in cases:
        if names.count(case.name) > 1 and all("scenes" not in one.settings for one in cases if one.name == case.name):
            raise InputError(f"two cases have the name {case.name!r}")
        if case.get("reference", case.name) not in names:
            raise InputError(f"case {case.name!r} has the reference {case['reference']!r}, which is not a case")
    plain = {key: value for key, value in table.items() if key not in ("cases", "table")}
    return Suite(name=name, cases=cases, columns=table.get("table", {}).get("columns", ()), **plain)


def _expand(table: Mapping[str, Any]) -> Iterator[Case]:
    """Yield a case for every combination of the values of `each`."""
    if not isinstance(table, Mapping) or not isinstance(table.get("name"), str):
        raise InputError("a case has no name")
    each = table.get("each", {})
    for values in itertools.product(*each.values()):
        chosen = dict(zip(each, values, strict=True))
        settings = {key: _fill(value, chosen) for key, value in table.items() if key != "each"}
        name = str(settings.pop("name"))
        yield Case(name, {**settings, **chosen})


def _fill(value: Any, chosen: Mapping[str, Any]) -> Any:
    """Replace {KEY} in all strings; a string that is nothing but {KEY} becomes the value itself."""
    if isinstance(value, list):
        return [_fill(one, chosen) for one in value]
    if isinstance(value, dict):
        return {key: _fill(one, chosen) for key, one in value.items()}
    if isinstance(value, str):
        if value[1:-1] in chosen and value == f"{{{value[1:-1]}}}":
            return chosen[value[1:-1]]
        for key, one in chosen.items():
            value = value.replace(f"{{{key}}}", str(one))
    return value


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)
