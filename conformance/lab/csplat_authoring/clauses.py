# SPDX-License-Identifier: CC0-1.0
"""The clauses of the specification, and the map from clauses to vectors: `conformance/CLAUSES.md`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from csplat_conformance.manifest import Vector

_SPEC = Path(__file__).parents[3] / "spec"
#: The documents with clauses.
DOCUMENTS: Final = (_SPEC / "format.md", _SPEC / "encoders.md")

#: Clauses that no vector covers, with the reason or the tests that cover them instead.
UNCOVERED: Final = {
    "CHK-5": "applies to editors",
    "LIM-2": "applies to a decoder's interface: `test_resource_level.py`",
    "CHK-7": "the vectors that are marked optional, for decoders that read the payload",
    "SER-5": "checking declared errors requires the source: `test_bounds_verification.py`, `test_validation.py`",
    "SER-6": "applies to encoders: `test_bounds_verification.py`",
    "SER-7": "applies to checkers of declared errors: `test_spec_pseudocode.py`",
    "SRC-1": "applies to encoders: `test_error_bounds.py`",
    "SRC-2": "applies to encoders: `test_error_bounds.py`",
    "SRC-3": "applies to encoders: `test_encoder_suite.py`",
    "SRC-4": "applies to encoders: `test_encode_api.py`",
    "CNF-2": "all vectors together",
    "CNF-3": "no file can prove the absence of crashes: `conformance/lab/fuzz.py`, `test_decode_api.py`",
    "CNF-4": "applies to a decoder's interface: `test_decode_api.py`",
    "CNF-5": "applies to encoders: `test_encode_api.py`, `test_encoder_suite.py`",
    "CNF-6": "applies to encoders: `test_encode_api.py`, `test_encoder_suite.py`",
    "CNF-10": "applies to encoders: `test_encode_api.py`",
    "CNF-9": "applies to a decoder's documentation",
}

_INTRO = """\
# Clauses and their vectors

<!-- Written by csplat_authoring: do not edit. -->
Each requirement of [format.md](../spec/format.md), then of [encoders.md](../spec/encoders.md), with the vector that is
most specific to it and the number of others. `csplat conformance decoder --filter CLAUSE` runs all of them.
"""


def specification() -> str:
    """Return the text of the documents with clauses, one after the other."""
    return "\n".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)


def clause_ids(text: str) -> list[str]:
    """Return the ids of the clauses in the text of the spec, in order and with repetitions."""
    return re.findall(r"\[([A-Z]{3}-[0-9]+)\]", text)


def clause_map(text: str, vectors: Sequence[Vector]) -> str:
    """Return the page, with a line for each clause that has vectors, and the reasons for those without."""
    covering: dict[str, list[str]] = {}
    for vector in vectors:
        for clause in vector.clauses:
            covering.setdefault(clause, []).append(vector.name)
    lines = []
    for clause in clause_ids(text):
        # Invalid vectors come first: they are the most specific to a clause.
        names = sorted(covering.get(clause, []), key=lambda name: not name.startswith("invalid/"))
        if names:
            lines.append(f"{clause:7} {names[0]}{f' +{len(names) - 1}' * (len(names) > 1)}")
    reasons: dict[str, list[str]] = {}
    for clause in clause_ids(text):
        if clause not in covering:
            reasons.setdefault(UNCOVERED.get(clause, "missing"), []).append(clause)
    without = [f"- {', '.join(clauses)}: {reason}" for reason, clauses in reasons.items()]
    return "\n".join([_INTRO, "```text", *lines, "```", "", "Without vectors:", "", *without]) + "\n"
