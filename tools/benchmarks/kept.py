"""What was measured of a scene, on disk after each measurement: an interrupted run goes on where it ended."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from csplat.files import atomic_writer

__all__ = ["Kept"]


class Kept:
    """What is known of a scene, on disk after each measurement. Owns the file."""

    def __init__(self, path: Path, *, again: bool = False) -> None:
        self.path = path
        self.values: dict[str, Any] = json.loads(path.read_text()) if path.exists() and not again else {}

    def measure(self, kind: str, key: str, call: Callable[[], Any]) -> Any:
        """Return what is known, or find it out and keep it."""
        known = self.values.setdefault(kind, {})
        if key not in known:
            start = time.perf_counter()
            known[key] = call()
            self.write()
            print(f"{self.path.stem} {kind} {key}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
        return known[key]

    def write(self) -> None:
        """Replace the file."""
        with atomic_writer(self.path) as stream:
            stream.write((json.dumps(self.values, indent=1) + "\n").encode())
