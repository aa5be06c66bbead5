"""Map the clauses of the spec to the vectors that cover them, with a reason for each clause without one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from csplat_conformance.manifest import Vector

#: Clauses that no vector covers, with the reason or the tests that cover them instead.
UNCOVERED: Final = {
    "CHK-5": "applies to editors",
    "CHK-6": "a permission; vectors whose only defect is in such a payload are marked optional",
    "CHK-7": "the vectors that are marked optional, for decoders that read the payload",
    "SER-5": "checking stated errors requires the source: `tests/test_proof.py`, `tests/test_validator.py`",
    "SER-6": "applies to encoders: `tests/test_proof.py`",
    "SER-7": "applies to checkers of stated errors: `tests/test_spec_pseudocode.py`, `tests/test_error_bounds.py`",
    "SRC-1": "applies to encoders: `tests/test_error_bounds.py`",
    "SRC-2": "applies to encoders: `tests/test_error_bounds.py`",
    "SRC-3": "applies to encoders: `tests/test_conformance_encoder.py`",
    "SRC-4": "applies to encoders: `tests/test_encode.py`",
    "CNF-2": "all vectors together",
    "CNF-3": "no file can prove the absence of crashes: `tests/fuzz.py`, `tests/test_damage.py`",
    "CNF-4": "applies to a decoder's interface: `tests/test_decoder_scene.py`",
    "CNF-5": "applies to encoders: `tests/test_encode.py`, `tests/test_conformance_encoder.py`",
    "CNF-6": "applies to encoders: `tests/test_encode.py`, `tests/test_conformance_encoder.py`",
    "CNF-10": "applies to encoders: `tests/test_encode.py`",
    "CNF-9": "applies to a decoder's documentation",
}

_NAMES_MAX = 4


def clause_ids(text: str) -> list[str]:
    """Return the ids of the clauses in the text of the spec, in order and with repetitions."""
    return re.findall(r"\[([A-Z]{3}-[0-9]+)\]", text)


def clause_map(text: str, vectors: Sequence[Vector]) -> str:
    """Return annex C, with a row for each clause."""
    covering: dict[str, list[str]] = {}
    for vector in vectors:
        for clause in vector.clauses:
            covering.setdefault(clause, []).append(vector.name)
    lines = ["| clause | vectors, or the reason for having none |", "|---|---|"]
    for clause in clause_ids(text):
        # Invalid vectors come first: they are the most specific to a clause.
        names = sorted(covering.get(clause, []), key=lambda name: not name.startswith("invalid/"))
        cell = ", ".join(f"`{name}`" for name in names[:_NAMES_MAX])
        if len(names) > _NAMES_MAX:
            cell += f" and {len(names) - _NAMES_MAX} more"
        lines.append(f"| {clause} | {cell or UNCOVERED.get(clause, 'missing')} |")
    return "\n".join(lines) + "\n"


def replace_generated(text: str, name: str, body: str) -> str:
    """Return the spec's text with the part between two marks replaced."""
    begin, end = f"<!-- begin generated: {name} -->\n", "<!-- end generated -->"
    before, rest = text.split(begin, 1)
    return before + begin + body + rest[rest.index(end) :]
