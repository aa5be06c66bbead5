# SPDX-License-Identifier: Apache-2.0
"""Results of a suite: a JSON file that grows row by row, with the command, the machine and the versions."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from csplat.disk_files import atomic_writer
from csplat.errors import InputError
from csplat_bench.published import PUBLISHED, read_published
from csplat_bench.suites import Case, Suite
from csplat_tools.optional_packages import describe_machine

_DIGITS = 6  # significant digits of numbers in results

Row = dict[str, Any]


class Results:
    """The results of a suite. Owns the file.

    Rows that were measured on another machine than the file's carry their own `machine`.

    Args:
        path: the JSON file; it need not exist.
        suite: the suite.
        command: the command line that measures it.

    Raises:
        InputError: the file holds results of another suite.
    """

    def __init__(self, path: Path, suite: Suite, command: str) -> None:
        self.path = path
        machine, versions = describe()
        self.machine = machine
        self.document: dict[str, Any] = {
            "suite": suite.name, "title": suite.title, "command": command, "machine": machine, "versions": versions,
            "rows": [],
        }  # fmt: skip
        self._options = suite.options
        if path.exists():
            known = read_results(path)
            if known.get("suite") != suite.name:
                raise InputError(f"{path} holds results of {known.get('suite')!r}, expected {suite.name!r}: use --out")
            self.document = known

    @property
    def rows(self) -> list[Row]:
        """The rows, which may be changed."""
        rows: list[Row] = self.document["rows"]
        return rows

    def forget(self, scene: str, cases: Sequence[Case]) -> None:
        """Drop the rows of these cases."""
        names = {case.name for case in cases}
        self.document["rows"] = [row for row in self.rows if row["scene"] != scene or row["case"] not in names]

    def is_known(self, scene: str, case: Case) -> bool:
        """Return True if a case has been measured on a scene, with the settings that it has now."""
        digest = self._digest(case)
        return any((row["scene"], row["case"], row.get("settings")) == (scene, case.name, digest) for row in self.rows)

    def add(self, scene: str, case: Case, values: Mapping[str, Any]) -> None:
        """Add or replace the row of a case, and write the file."""
        self.forget(scene, [case])
        row = {"scene": scene, "case": case.name, "settings": self._digest(case), **rounded(dict(values))}
        if self.machine != self.document["machine"]:
            row["machine"] = self.machine
        self.rows.append(row)
        self.write()

    def set_published(self, name: str) -> None:
        """Replace the published figures by those of the measured scenes and their sets, and write the file.

        Args:
            name: name of a TOML file in `published`, whose keys are scenes, or how they begin, and sets.
        """
        published = read_published(PUBLISHED / f"{name}.toml")
        rows = [row for row in self.rows if "published" not in row]
        scenes = list(dict.fromkeys(row["scene"] for row in rows))
        sets = dict.fromkeys(row["set"] for row in rows if "set" in row)
        rows += [
            *({**row, "scene": scene} for scene in scenes for row in published
              if row["scene"] not in sets and scene.startswith(row["scene"])),
            *({**row, "scene": f"all of {key}"} for key in sets for row in published if row["scene"] == key),
        ]  # fmt: skip
        self.document["rows"] = rows
        self.write()

    def write(self) -> None:
        """Replace the file."""
        write_json(self.path, self.document)

    def _digest(self, case: Case) -> str:
        """Return a digest of the settings that a row depends on."""
        text = json.dumps([self._options, case.settings], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:8]


def read_results(path: Path) -> dict[str, Any]:
    """Read a file of results.

    Raises:
        InputError: it is not one.
    """
    try:
        document = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    if not isinstance(document, dict) or not isinstance(document.get("rows"), list):
        raise InputError(f"{path} holds no rows, expected results of `python -m csplat_bench run`")
    return document


def describe() -> tuple[str, dict[str, str]]:
    """Return a description of the machine, and the versions of packages."""
    found = describe_machine()
    machine = f"{found['processor']}, {found['cores']} cores, {_memory()}, {found['system']}"
    packages = {name: version for name, version in found["packages"].items() if version != "absent"}
    return machine, {"csplat": found["csplat"], "python": found["python"], **packages}


def rounded(value: Any) -> Any:
    """Return a value with all floats rounded to six significant digits."""
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def write_json(path: Path, document: Any) -> None:
    """Replace a JSON file, atomically; NaN and infinities are refused."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(path) as stream:
        stream.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.0f} GiB"
    except (ValueError, OSError, AttributeError):
        return "memory unknown"
