"""Store the measurements of a scene on disk, one by one: an interrupted run continues where it stopped."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from csplat.errors import InputError
from csplat_bench.common.report import write_json
from csplat_tools.console import note

T = TypeVar("T")


class Kept:
    """Results of a scene by kind and name. Owns the file.

    Args:
        path: path of the file.
        settings: whatever results depend on, JSON-compatible.
        again: forget what is there.

    Raises:
        InputError: the results on disk were measured with other settings.
    """

    def __init__(self, path: Path, settings: Mapping[str, object] | None = None, *, again: bool = False) -> None:
        self.path = path
        self.values: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() and not again else {}
        if settings is None:
            return
        wanted = json.loads(json.dumps(settings))  # as it will be read again
        known = self.values.setdefault("settings", wanted)
        for name, value in wanted.items():
            if known.get(name) != value:
                raise InputError(
                    f"{path} was measured with {name} {known.get(name)}, wanted {value}: name another --out"
                )

    def knows(self, kind: str, key: str) -> bool:
        """Return True if this has been measured."""
        return key in self.values.get(kind, {})

    def measure(self, kind: str, key: str, call: Callable[[], T]) -> T:
        """Return what is known, or find it out, keep it, and say so."""
        known: dict[str, T] = self.values.setdefault(kind, {})
        if key not in known:
            start = time.perf_counter()
            known[key] = call()
            self.write()
            note(f"{self.path.stem} {kind} {key}: {time.perf_counter() - start:.0f} s")
        return known[key]

    def write(self) -> None:
        """Replace the file."""
        write_json(self.path, self.values)


def read_kept(folder: Path) -> dict[str, Any]:
    """Return all results in a folder, by scene, without the `.training.json` files."""
    files = [path for path in sorted(folder.glob("*.json")) if not path.name.endswith(".training.json")]
    return {path.stem: json.loads(path.read_text("utf-8")) for path in files}


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
