"""Decoders that are wrong on purpose, one mistake each: the suite has to notice every one of them.

Usage:
    python -m csplat_selftest.wrong             # the table: mistake, vectors failed, clauses
    python -m csplat_selftest.wrong --only python --vectors

The mistakes of the Python decoder replace a function, those of the JavaScript decoder a piece of its text.
Some have it decode in single precision, badly, and are judged by the class *renderer*.
The code of a refusal does not count, as for any decoder that is not ours.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack

from csplat.errors import InputError
from csplat_authoring.recipes import exact_floats
from csplat_conformance.adapter import answer
from csplat_conformance.answers import PARTS, Answer, check_payload_consistency, compare_answer
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import Vector, load
from csplat_conformance.tolerance import RENDERER
from csplat_selftest.mistakes import Caught, Mistake
from csplat_selftest.wrong_js import catch_all
from csplat_selftest.wrong_python import MISTAKES as WRONG_PYTHON
from csplat_selftest.wrong_single import MISTAKES as WRONG_SINGLE
from csplat_selftest.wrong_words import MISTAKES as WRONG_WORDS

MISTAKES = (*WRONG_PYTHON, *WRONG_WORDS, *WRONG_SINGLE)

_SHOWN_CLAUSES = 4


def catch(mistake: Mistake, vectors: Iterable[Vector] | None = None) -> Caught:
    """Run a wrong Python decoder over the vectors."""
    outcomes = []
    with ExitStack() as stack:
        mistake.apply(stack)
        for vector in load() if vectors is None else vectors:
            near = exact_floats if mistake.by == RENDERER else None
            outcomes += compare_answer(vector, _asked(vector.data), tuple(PARTS), near=near)
    return Caught("Python", mistake, [one for one in check_payload_consistency(outcomes)[0] if not one.good])


def _asked(data: bytes) -> Answer:
    try:
        return answer(data)
    except Exception as error:  # noqa: BLE001 - a wrong decoder may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


def table(caught: Sequence[Caught]) -> str:
    """Return the mistakes as a table in Markdown."""
    lines = [
        "| decoder | mistake | what it does | vectors failed | for example | clauses |",
        "|---|---|---|---|---|---|",
    ]
    for one in caught:
        clauses = one.clauses
        named = [one.mistake.clause, *(clause for clause in clauses if clause != one.mistake.clause)]
        more = f" and {len(named) - _SHOWN_CLAUSES} more" if len(named) > _SHOWN_CLAUSES else ""
        example = next((o.name for o in one.failed if one.mistake.clause in o.clauses), "none")
        cells = (one.language, one.mistake.name, one.mistake.what, str(len(one.vectors)), f"`{example}`")
        lines.append(f"| {' | '.join(cells)} | {', '.join(named[:_SHOWN_CLAUSES])}{more} |")
    return "\n".join(lines)


def main() -> int:
    """Print the table; the exit status is 1 when a mistake goes unnoticed."""
    parser = argparse.ArgumentParser(
        prog="csplat_selftest.wrong", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=("python", "javascript"), help="one of the two decoders")
    parser.add_argument("--vectors", action="store_true", help="list the vectors that each mistake fails")
    args = parser.parse_args()
    caught = [] if args.only == "javascript" else [catch(mistake) for mistake in MISTAKES]
    if args.only != "python":
        try:
            caught += catch_all()
        except InputError as error:
            sys.stderr.write(f"SKIPPED: the JavaScript decoder: {error}\n")
    sys.stdout.write(table(caught) + "\n")
    if args.vectors:
        for one in caught:
            sys.stdout.write(f"\n{one.language}, {one.mistake.name}: {', '.join(one.vectors)}\n")
    missed = [one for one in caught if one.mistake.clause not in one.clauses]
    for one in missed:
        sys.stderr.write(f"unnoticed: {one.language}, {one.mistake.name} ({one.mistake.clause})\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
