"""Mutants of decoders: what is changed, and what becomes of it."""

import sys
from dataclasses import replace

import pytest
from chromium import absent

from csplat.errors import InputError
from csplat_conformance.manifest import load
from csplat_selftest.decoder_processes import missing_c, missing_javascript
from csplat_selftest.mutation import __main__ as command
from csplat_selftest.mutation import mutants
from csplat_selftest.mutation.decoders import JavaScriptDecoder, NativeDecoder, PythonDecoder
from csplat_selftest.mutation.mutants import Fate, Mutant, MutantResult, sample, score, table
from csplat_selftest.mutation.operators import c_mutants, python_mutants

pytestmark = pytest.mark.slow  # together: tests of the mutants

BY_NAME = {vector.name: vector for vector in load()}
needs_node = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")

#: Tests that take long: they run when the suite or a decoder changes.
in_depth = pytest.mark.area(name="suite")


@pytest.fixture
def few(monkeypatch):
    """Let these vectors be all there are."""

    def chosen(*names):
        monkeypatch.setattr(mutants, "vectors", lambda: [(BY_NAME[name], BY_NAME[name].data) for name in names])

    return chosen


def mutant(decoder, file, old, new):
    """The first mutant of a file that makes this change."""
    return next(one for one in decoder.mutants if (one.file, one.old, one.new) == (file, old, new))


# What is changed -----------------------------------------------------------------------------------
@pytest.mark.parametrize(("text", "changed"), [
    ("a < b", {"(a <= b)", "(a >= b)"}),
    ("é != b", {"(é == b)", "(é < b)", "(é > b)"}),
    ("a not in b", {"(a in b)"}),
    ("a is None", {"(a is not None)"}),
    ("a <= b <= c", {"(a < b <= c)", "(a > b <= c)", "(a <= b < c)", "(a <= b > c)"}),
    ("a and b and c", {"(a or b and c)", "(a and b or c)"}),
    ("not a", {"(a)"}),
    ("(a) - (b)", {"((a) + (b))"}),
    ("a //\\\nb", {"(a *\\\nb)"}),
    ("a << b", {"(a >> b)"}),
    ("a &= b", {"a |= b"}),
    ("x = True", {"x = False"}),
    ("x = 7", {"x = (7 + 1)", "x = (7 - 1)"}),
    ("a[b:]", {"a[(b) + 1:]", "a[(b) - 1:]"}),
    ("max(a)", {"min(a)", "pass"}),
    ("x = a.min()", {"x = a.max()"}),
    ("raise A(1 + 2)", {"pass"}),
    ("def f():\n  if a: return b\n  return c", {"def f():\n  if a: pass\n  return c"}),
    ("def f(a: A[1]) -> B[2]: g(f'{1}')", {"def f(a: A[1]) -> B[2]: pass"}),
    ("if TYPE_CHECKING: import a\nelse: b = 1 < 2", set()),
])  # fmt: skip
def test_each_operator_is_changed_alone(text, changed):
    assert changed == {one.apply(text) for one in python_mutants("a.py", text)}


def test_a_mutant_knows_its_line():
    (one, _) = python_mutants("a.py", "x = y\n\nz = (a\n     < b)\n")
    assert ("a.py", 3, "a\n     < b", "(a\n     <= b)") == (one.file, one.line, one.old, one.new)


@in_depth
def test_a_sample_is_repeatable_and_holds_programs_alone():
    decoder = PythonDecoder([])
    first, again, other = (sample(decoder, 40, seed) for seed in (0, 0, 1))
    assert first == again != other
    assert 40 == len({(one.file, one.start, one.new) for one in first})
    assert all(decoder.valid(one) for one in first)
    assert not decoder.valid(Mutant("blocks.py", 1, 0, "", "def"))


# What becomes of it --------------------------------------------------------------------------------
@in_depth
def test_a_mutant_that_fails_a_vector_is_caught(few):
    few("valid/one_splat", "valid/means_morton")
    decoder = PythonDecoder([])
    result = decoder.attempt(mutant(decoder, "blocks.py", "bits |= shifted", "bits &= shifted"))
    assert (Fate.CAUGHT, "valid/means_morton") == (result.fate, result.by)


@in_depth
def test_a_mutant_that_only_a_fuzzed_file_shows_is_missed(few):
    few("valid/one_splat")
    decoder = PythonDecoder([BY_NAME[name].data for name in ("valid/quats", "valid/means_morton")])
    result = decoder.attempt(mutant(decoder, "blocks.py", "bits |= shifted", "bits &= shifted"))
    assert Fate.MISSED is result.fate
    assert result.by.startswith("file 1: ")


@in_depth
def test_a_mutant_that_changes_nothing_is_the_same(few):
    few("valid/means_morton", "invalid/chunk_crc")
    decoder = PythonDecoder([BY_NAME["valid/rich"].data])
    result = decoder.attempt(mutant(decoder, "decode_api.py", "8", "(8 - 1)"))
    assert (Fate.SAME, "") == (result.fate, result.by)


@in_depth
@pytest.mark.slow
def test_a_mutant_that_hangs_is_caught(few):
    few("valid/means_morton")
    decoder = PythonDecoder([], processor_seconds=1)
    one = mutant(decoder, "blocks.py", "bits |= shifted", "bits &= shifted")
    result = decoder.attempt(replace(one, new="while True: pass"))
    assert (Fate.CAUGHT, "hangs, or ends the process") == (result.fate, result.by)


def test_damage_that_another_decoder_may_leave_unread_must_be_refused():
    mutants.vectors.cache_clear()
    assert any(vector.error["optional"] for vector in load() if vector.error)
    assert not any(vector.error["optional"] for vector, _ in mutants.vectors() if vector.error)


@in_depth
def test_the_command_prints_survivors_and_score(few, monkeypatch, capsys):
    few("valid/one_splat")
    monkeypatch.setattr(command, "fuzzed", lambda _count, _seed: [])
    monkeypatch.setattr(sys, "argv", ["mutation", "--count", "3", "--seed", "5"])
    assert 0 == command.main()
    out = capsys.readouterr()
    assert "python: 3 of " in out.out
    assert "3 of 3, " in out.err


def test_survivors_are_in_a_table_and_the_score_counts_visible_mutants():
    text = "x = a |\\\n b; y\nz\n"
    results = [
        MutantResult(Mutant("a.py", 1, 4, "a |\\\n b", "(a &\\\n b)"), Fate.SAME),
        MutantResult(Mutant("a.py", 3, 15, "z", "0"), Fate.MISSED, "file 7: refused"),
        *[MutantResult(Mutant("a.py", 3, 15, "z", "1"), Fate.CAUGHT, "valid/rich")] * 3,
    ]
    assert 75.0 == score(results)
    assert [
        "| missed | a.py:3 | `z` | `0` | file 7: refused |",
        "| same | a.py:1 | `x = a ¦\\ b; y` | `x = (a &\\ b); y` |  |",
    ] == table(results, {"a.py": text}).splitlines()[2:]


# JavaScript ----------------------------------------------------------------------------------------
@needs_node
@in_depth
@pytest.mark.slow
def test_javascript_is_changed_by_its_syntax(few):
    decoder = JavaScriptDecoder([])
    try:
        changes = {(one.file, one.old, one.new) for one in decoder.mutants}
    except InputError as error:
        pytest.skip(f"skipped: {error}")
    assert ("lattice.mjs", "co / 2", "(co * 2)") in changes
    assert not {file for file, _, _ in changes} & {"spec.mjs", "reader.mjs"}
    few("valid/one_splat", "invalid/tile_tail")
    (tail,) = (one for one in decoder.mutants if one.old.startswith("throw") and "bytes too many" in one.old)
    assert MutantResult(tail, Fate.CAUGHT, "invalid/tile_tail") == decoder.attempt(tail)
    few("valid/one_splat")
    assert Fate.SAME is decoder.attempt(tail).fate


# C -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("text", "changed"), [
    ("x = a < b;", {"x = a <= b;", "x = a >= b;"}),
    ("x = a * *p - -b;", {"x = a / *p - -b;", "x = a * *p + -b;"}),
    ('char *p = a ? !b : "1"; /* 1 < 2 */', {'char *p = a ? b : "1"; /* 1 < 2 */'}),
    ("x |= 0x1Fu;", {"x &= 0x1Fu;", "x |= (0x1Fu + 1);", "x |= (0x1Fu - 1);"}),
    ("{ f(g(a)); }", {"{ ; }"}),
    ("if (a)\n return fail(d, 1, b + c);\nx;", {"if (a)\n ;\nx;"}),
    ("return a || fail(d, 1);", {"return a && fail(d, 1);", "return a || 1;"}),
    ("#define A 1 + \\\n 2\n/* begin generated: */ 3 /* end generated */", set()),
])  # fmt: skip
def test_each_token_of_c_is_changed_alone(text, changed):
    assert changed == {one.apply(text) for one in c_mutants("a.c", text)}


@in_depth
@pytest.mark.slow
def test_c_is_compiled_and_changed(few):
    if missing_c():
        absent(missing_c())
    decoder = NativeDecoder([])
    few("valid/one_splat", "invalid/tile_tail")
    (tail,) = (one for one in decoder.mutants if "bytes follow the end" in one.old)
    assert decoder.valid(tail)
    assert not decoder.valid(replace(tail, new="("))
    assert MutantResult(tail, Fate.CAUGHT, "invalid/tile_tail") == decoder.attempt(tail)
