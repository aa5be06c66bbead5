"""The spec's clauses: each has an id of its own and is covered; its worked example is the vector."""

import re
from pathlib import Path

import pytest

from csplat_authoring.clauses import UNCOVERED, clause_ids, clause_map, replace_generated
from csplat_authoring.example import annex, example_scene
from csplat_authoring.reference import expected
from csplat_conformance.manifest import VECTORS, load

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "spec" / "format.md").read_text(encoding="utf-8")
CLAUSES = clause_ids(TEXT)
COVERED = {clause for vector in load() for clause in vector.clauses}


def worked_example_rows():
    part = TEXT.split("<!-- begin generated: worked example -->")[1].split("<!-- end generated -->")[0]
    return re.findall(r"^\| (\d+) \| ((?:[0-9A-F]{2} ?)+) \|", part, re.MULTILINE)


def test_clause_ids_are_unique():
    assert len(set(CLAUSES)) == len(CLAUSES)


def test_every_must_ends_in_a_clause_id():
    # A paragraph that demands something without an id could not be cited by an error.
    body = TEXT.split("## 3 Terms")[1].split("## 10 Versioning")[0]
    body = re.sub(r"```.*?```", "", body, flags=re.DOTALL)
    sentences = re.findall(r"[^.\n|][^|]*?MUST(?: NOT)?\b[^|]*?(?:\[[A-Z]{3}-\d+\]|\n\n)", body)

    assert [] == [sentence for sentence in sentences if not sentence.endswith("]")]


def test_every_clause_is_covered_or_excused():
    assert [] == [clause for clause in CLAUSES if clause not in COVERED and clause not in UNCOVERED]


def test_vectors_name_clauses_that_exist():
    assert set() == COVERED - set(CLAUSES)


def test_excuses_are_needed_and_name_clauses_that_exist():
    assert [] == [clause for clause in UNCOVERED if clause in COVERED or clause not in CLAUSES]


@pytest.mark.parametrize("clause", UNCOVERED)
def test_an_excuse_that_points_at_a_test_finds_the_clause_there(clause):
    for path in re.findall(r"`(tests/\w+\.py)`", UNCOVERED[clause]):
        assert clause in (ROOT / path).read_text(encoding="utf-8")


def test_the_worked_example_is_its_file_byte_for_byte():
    rows = worked_example_rows()
    data = b"".join(bytes.fromhex(digits) for _, digits in rows)

    assert (VECTORS / "valid" / "worked_example.csplat").read_bytes() == data


def test_the_worked_example_states_the_right_offsets():
    at = 0
    for offset, digits in worked_example_rows():
        assert at == int(offset)
        at += len(bytes.fromhex(digits))


def test_the_worked_example_explains_the_right_values():
    floats = {name: array.tolist() for name, array in expected(example_scene()).floats.items()}
    half = 0.7071067690849304  # the binary32 that the text writes as 0.70710677

    assert [1.0, 0.25] == floats["opacities"]
    assert [[-3.0, -3.0, -3.0], [-2.0, -3.0, -4.0]] == floats["scales"]
    assert [[1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half]] == floats["quats"]
    assert [[-0.5, 0.5, 4.0], [0.75, 0.0, 4.25]] == floats["means"]
    assert [[2.0, 1.0, 1.5], [-0.5, -0.5, -0.5]] == floats["sh0"]
    zero, red, blue = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -0.25]
    assert [[red, zero, zero], [red, zero, blue]] == floats["shN"]


def test_annexes_are_what_the_recipes_make():
    assert TEXT == replace_generated(
        replace_generated(TEXT, "worked example", annex()), "clause map", clause_map(TEXT, load())
    )
