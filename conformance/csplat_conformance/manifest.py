# SPDX-License-Identifier: CC0-1.0
"""The manifest: the vectors and their expected results."""

from __future__ import annotations

import fnmatch
import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.errors import InputError
from csplat_conformance import SUITE_VERSION

#: The format that the vectors test.
FORMAT = f"csplat {_spec.VERSION_MAJOR}.{_spec.VERSION_MINOR}"

#: Folder of the vectors and of manifest.json.
VECTORS = Path(__file__).parent / "vectors"


@dataclass(frozen=True)
class Vector:
    """An entry of the manifest.

    Attributes:
        name: group and name, `valid/rich`.
        file: path below the folder of the vectors.
        sha256: SHA-256 of the file.
        why: its purpose, one line.
        clauses: clauses that the vector covers.
        since: version of the format in which the vector was added.
        expect: `header`, `integers`, `floats`, `extra` and, if the file has levels of detail, `cuts` (pairs of a cut,
            `level 1`, and its tiles or error code); empty for a refusal.
        error: `code`, `clause`, `offset`, `also` (other acceptable codes), `optional` (chunk type whose payload has the
            defect, if CHK-6 lets a decoder leave it unread and accept the file; otherwise empty).
        views: renders: `camera`, `picture` (path below the folder of the vectors), `sha256`, `psnr` (minimum, dB).
    """

    name: str
    file: str
    sha256: str
    why: str
    clauses: list[str]
    since: str
    expect: dict[str, Any]
    error: dict[str, Any]
    views: list[dict[str, Any]] = field(default_factory=list)

    @property
    def data(self) -> bytes:
        """The bytes of the file."""
        return (VECTORS / self.file).read_bytes()


def load(path: Path = VECTORS / "manifest.json") -> list[Vector]:
    """Read the manifest, once per process."""
    return list(_load_file(path))


@cache
def _load_file(path: Path) -> tuple[Vector, ...]:
    return tuple(Vector(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))["vectors"])


def picture_name(name: str, number: int) -> str:
    """Return the path of a vector's reference image below the folder of the vectors."""
    return f"{name}.{number}.png"


def summarise(arrays: Mapping[str, NDArray[Any]]) -> dict[str, list[Any]]:
    """Return [dtype, shape, SHA-256 of the little-endian bytes in C order] of each array."""
    return {name: _summary(array) for name, array in arrays.items()}


def _summary(array: NDArray[Any]) -> list[Any]:
    """Return one entry of `summarise`; the dtype as `f4`."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    name = f"{array.dtype.kind}{array.dtype.itemsize}"
    return [name, list(array.shape), hashlib.sha256(little.tobytes()).hexdigest()]


def to_json(vectors: Sequence[Vector]) -> str:
    """Return the text of manifest.json, with one line per vector."""
    entries = [{key: value for key, value in vars(vector).items() if key != "views" or value} for vector in vectors]
    lines = [json.dumps(entry, ensure_ascii=False, separators=(",", ":")) for entry in entries]
    head = json.dumps({"format": FORMAT, "suite": SUITE_VERSION, "licence": "CC0-1.0"})
    return head[:-1] + ', "vectors": [\n' + ",\n".join(lines) + "\n]}\n"


def select_names(patterns: str | None, names: Collection[str], what: str) -> set[str]:
    """Return the names that match any of some shell patterns; all names for None.

    Args:
        patterns: patterns separated by commas: `valid/sh*,valid/absent_*`. A pattern matches a whole name, or the part
            before a hyphen: `MOR` means `MOR-*`, a chapter of clauses.
        names: names to select from.
        what: noun for the names, for messages.

    Raises:
        InputError: a pattern matches no name.
    """
    chosen: set[str] = set()
    for pattern in () if patterns is None else patterns.split(","):
        matches = {*fnmatch.filter(names, pattern.strip()), *fnmatch.filter(names, f"{pattern.strip()}-*")}
        if not matches:
            raise InputError(f"no {what} matches {pattern.strip()!r}")
        chosen |= matches
    return set(names) if patterns is None else chosen
