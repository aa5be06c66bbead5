"""Map the clauses of the spec to the vectors that cover them, with a reason for each clause without one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from csplat_conformance.manifest import Vector

#: Clauses that no vector covers: the reason, or the test that covers them.
UNCOVERED: Final = {
    "CHK-5": "about editors, which change files rather than read them",
    "CHK-6": "a permission; vectors whose only defect lies in such a payload are marked optional",
    "CHK-7": "the vectors that are marked optional, for decoders that read the payload",
    "SER-5": "about what an encoder states, which needs the source: `tests/test_proof.py`, `tests/test_validator.py`",
    "SER-6": "likewise: `tests/test_proof.py`",
    "SER-7": "about who checks what is stated: `tests/test_spec_pseudocode.py`, `tests/test_stated.py`",
    "SRC-1": "about encoders: `tests/test_stated.py`",
    "SRC-2": "about encoders: `tests/test_stated.py`",
    "SRC-3": "about encoders: `tests/test_conformance_encoder.py`",
    "SRC-4": "about encoders: `tests/test_encode.py`",
    "CNF-2": "the sum of all vectors",
    "CNF-3": "no file shows the absence of crashes: `tests/fuzz.py`, `tests/test_damage.py`",
    "CNF-4": "about a decoder's interface: `tests/test_decoder_scene.py`",
    "CNF-5": "about encoders: `tests/test_encode.py`, `tests/test_conformance_encoder.py`",
    "CNF-6": "about encoders: `tests/test_encode.py`, `tests/test_conformance_encoder.py`",
    "CNF-10": "about encoders: `tests/test_encode.py`",
    "CNF-9": "about what a decoder says of itself",
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
    lines = ["| clause | vectors, or why there are none |", "|---|---|"]
    for clause in clause_ids(text):
        # Invalid vectors come first, since they show most about a clause.
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
