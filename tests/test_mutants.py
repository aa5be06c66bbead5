"""Mutants of decoders and packages: the changes, their fates, and the map of the tests that reach them."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mutate
import pytest
from chromium import absent
from mutate import Package, State, Verdict
from reach import Importers, Place, Project, Tree, place_of

from csplat.errors import InputError
from csplat_conformance.manifest import load
from csplat_selftest.decoder_processes import missing_c, missing_javascript
from csplat_selftest.mutation import __main__ as command
from csplat_selftest.mutation import mutants
from csplat_selftest.mutation.decoders import JavaScriptDecoder, NativeDecoder, PythonDecoder
from csplat_selftest.mutation.mutants import Fate, Mutant, MutantResult, sample, score, table
from csplat_selftest.mutation.operators import c_mutants, python_mutants

BY_NAME = {vector.name: vector for vector in load()}
needs_node = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")

#: They take long, and run when the suite or a decoder changes.
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
@pytest.mark.slow
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


@pytest.mark.slow
def test_a_mutant_knows_its_line():
    (one, _) = python_mutants("a.py", "x = y\n\nz = (a\n     < b)\n")
    assert ("a.py", 3, "a\n     < b", "(a\n     <= b)") == (one.file, one.line, one.old, one.new)


@pytest.mark.slow
@in_depth
def test_a_sample_is_repeatable_and_holds_programs_alone():
    decoder = PythonDecoder([])
    first, again, other = (sample(decoder, 40, seed) for seed in (0, 0, 1))
    assert first == again != other
    assert 40 == len({(one.file, one.start, one.new) for one in first})
    assert all(decoder.valid(one) for one in first)
    assert not decoder.valid(Mutant("blocks.py", 1, 0, "", "def"))


# What becomes of it --------------------------------------------------------------------------------
@pytest.mark.slow
@in_depth
def test_a_mutant_that_fails_a_vector_is_caught(few):
    few("valid/one_splat", "valid/means_morton")
    decoder = PythonDecoder([])
    result = decoder.attempt(mutant(decoder, "blocks.py", "bits |= shifted", "bits &= shifted"))
    assert (Fate.CAUGHT, "valid/means_morton") == (result.fate, result.by)


@pytest.mark.slow
@in_depth
def test_a_mutant_that_only_a_fuzzed_file_shows_is_missed(few):
    few("valid/one_splat")
    decoder = PythonDecoder([BY_NAME[name].data for name in ("valid/quats", "valid/means_morton")])
    result = decoder.attempt(mutant(decoder, "blocks.py", "bits |= shifted", "bits &= shifted"))
    assert Fate.MISSED is result.fate
    assert result.by.startswith("file 1: ")


@pytest.mark.slow
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


@pytest.mark.slow
def test_damage_that_another_decoder_may_leave_unread_must_be_refused():
    mutants.vectors.cache_clear()
    assert any(vector.error["optional"] for vector in load() if vector.error)
    assert not any(vector.error["optional"] for vector, _ in mutants.vectors() if vector.error)


@pytest.mark.slow
@in_depth
def test_the_command_prints_survivors_and_score(few, monkeypatch, capsys):
    few("valid/one_splat")
    monkeypatch.setattr(command, "fuzzed", lambda _count, _seed: [])
    monkeypatch.setattr(sys, "argv", ["mutation", "--count", "3", "--seed", "5"])
    assert 0 == command.main()
    out = capsys.readouterr()
    assert "python: 3 of " in out.out
    assert "3 of 3, " in out.err


@pytest.mark.slow
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
@pytest.mark.slow
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


FILES = {
    "pyproject.toml": """
[tool.hatch.build]
dev-mode-dirs = ["src"]
[tool.pytest.ini_options]
addopts = ["-p", "no:hypothesispytest"]  # imports all of Hypothesis
""",
    "src/shop/__init__.py": "",
    "src/shop/jit.py": '''
def kernel(function):
    """Hide a function's lines from coverage, as a compiler does."""
    return type(function)(function.__code__.replace(co_filename="<compiled>"), function.__globals__)
''',
    "src/shop/kernels.py": """
from shop.jit import kernel

@kernel
def double(x):
    return x + x
""",
    "src/shop/prices.py": """
from shop.kernels import double

TAX = 19

def is_free(price, gift):
    return price <= gift

def total(price, count):
    return price * count

def taxed(price):
    return double(price) + TAX

def unused(a, b):
    return a / b
""",
    "tests/conftest.py": """
import pytest

@pytest.fixture(scope="session")
def once():
    made = {}
    return lambda name, make: made[name] if name in made else made.setdefault(name, make())
""",
    "tests/test_prices.py": """
import pytest
from shop import prices

@pytest.fixture(scope="module")
def basket(once):
    return once("basket", lambda: prices.total(2, 3))

@pytest.fixture
def same_basket(once):
    return once("basket", lambda: prices.total(2, 3))

def test_a_basket_is_made(basket):
    pass

def test_the_basket_costs_6(same_basket):
    assert same_basket == 6

def test_a_present_is_free():
    assert prices.is_free(1, 2)

def test_that_fails_anyway():
    assert not prices.is_free(1, 2)

def test_taxes_are_added():
    assert prices.taxed(3) == 25
""",
}
OLDER = """
from shop.prices import is_free

def test_free():
    assert is_free(1, 1)
"""
CHANGED = ("--select", "prices.py", "--select", "kern*.py")
SETTINGS = {"seed": 0, "select": ["prices.py", "kern*.py"]}


def made(root):
    """Write the project into a folder."""
    for name, text in FILES.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return Project.load(root)


@pytest.fixture(scope="module")
def shop(tmp_path_factory):
    """The project after a run on all mutants of two modules, one of which had a verdict before."""
    root = tmp_path_factory.mktemp("shop")
    project = made(root)
    package = Package(project, "shop")
    half = State(state(root), package, SETTINGS)
    half.note(
        next(one for one in package.mutants if one.new == "(19 + 1)"), Verdict(mutate.Fate.CAUGHT, "of another run")
    )
    run_tool(root, *CHANGED, "--jobs", "2")
    return root


def run_tool(root, *words):
    """Run the command on a project; return what it prints."""
    tool = [sys.executable, Path(__file__).with_name("mutate.py"), "shop", "--root", root, *words]
    env = {name: value for name, value in os.environ.items() if not name.startswith(("COVERAGE_", "PYTEST_"))}
    ran = subprocess.run(tool, env=env, capture_output=True, text=True, check=False)
    assert 0 == ran.returncode, ran.stderr
    return ran.stdout


def state(root):
    return root / "out" / "mutants" / "shop.json"


@pytest.mark.slow
@pytest.mark.area(name="suite")
def test_every_mutant_has_its_fate_and_the_test_that_notices_it(shop):
    entries = {one["new"]: one for one in json.loads(state(shop).read_text())["mutants"]}
    test = "tests/test_prices.py::test_"
    expected = {
        "(price // count)": ("caught", f"{test}the_basket_costs_6"),  # another test computed it
        "(double(price) - TAX)": ("caught", f"{test}taxes_are_added"),
        "(x - x)": ("caught", f"{test}taxes_are_added"),  # inside a compiled kernel
        "(19 + 1)": ("caught", "of another run"),
        "(19 - 1)": ("caught", f"{test}taxes_are_added"),  # at module level
        "(price < gift)": ("survived", ""),
        "(price > gift)": ("caught", f"{test}a_present_is_free"),
        "(a * b)": ("not reached", ""),
    }
    assert expected == {new: (one["fate"], one["by"]) for new, one in entries.items()}
    assert 1 == entries["(price > gift)"]["tests"]  # the one that fails without a mutant does not judge
    assert FILES["src/shop/prices.py"] == (shop / "src/shop/prices.py").read_text()


@pytest.mark.slow
@pytest.mark.area(name="suite")
def test_an_older_suite_catches_a_survivor_and_the_table_names_its_test(shop, tmp_path):
    made(tmp_path / "older")
    (tmp_path / "older" / "tests" / "test_prices.py").write_text(OLDER)
    table = run_tool(shop, *CHANGED, "--suite", tmp_path / "older").splitlines()
    assert "| shop | 8 | 6 | 1 | 1 | 1 |" in table
    row = "prices.py:7 | `return price <= gift` | `return (price < gift)` | tests/test_prices.py::test_free (older)"
    assert f"| survived | {row} |" in table


def test_a_state_of_other_mutants_is_refused(tmp_path):
    package = Package(made(tmp_path), "shop")
    State(state(tmp_path), package, SETTINGS).note(package.mutants[0], Verdict(mutate.Fate.SURVIVED))
    with pytest.raises(ValueError, match="is of other seed: remove it, or name another with --state"):
        State(state(tmp_path), package, {**SETTINGS, "seed": 1})


# Places and copies -----------------------------------------------------------------------------------
@pytest.mark.parametrize(("marked", "lines", "traced", "compiled"), [
    ("x = §1", [1], False, False),
    ("class A:\n  x = §1", [2], False, False),
    ("def f(a=§1):\n  pass", [1], False, False),
    ("def f():\n  é = (1 +\n    §2)", [2, 3], True, False),
    ("def f():\n  if (a and\n      §b):\n    g()\n  h()", [2, 3], True, False),
    ("def f():\n  if a: return §1", [2], True, False),
    ("@jit.parallel_kernel(relaxed=True)\ndef f(a):\n  return §1", [3], False, True),
    ("@kernel\ndef f(a):\n  def g(): return §1", [3], False, True),
])  # fmt: skip
def test_a_place_is_the_innermost_statement(marked, lines, traced, compiled):
    place = place_of(marked.replace("§", ""), marked.index("§"))
    assert Place(range(lines[0], lines[-1] + 1), traced, compiled) == place


def test_importers_come_level_by_level(tmp_path):
    project = made(tmp_path)
    levels = Importers(project, ["shop"]).levels("src/shop/jit.py")
    assert [["src/shop/jit.py"], ["src/shop/kernels.py"], ["src/shop/prices.py"]] == levels


def test_a_tree_changes_one_file_for_a_while_and_forgets_kernels_of_files(tmp_path):
    project = made(tmp_path / "shop")
    tree = Tree(tmp_path / "trees" / "own", project, project.root)
    tree.refresh()
    (tree.root / "tests" / "left.txt").write_text("by a test")
    prices = tree.root / "src" / "shop" / "prices.py"
    before = prices.stat().st_mtime_ns
    bytecode = prices.parent / "__pycache__" / "prices.cpython-311.pyc"
    bytecode.parent.mkdir()
    bytecode.touch()
    with tree.changed("src/shop/prices.py", "TAX = 7"):
        assert "TAX = 7" == prices.read_text()
        assert not bytecode.exists()
        bytecode.touch()
    assert not bytecode.exists()
    tree.refresh()
    assert before == prices.stat().st_mtime_ns
    assert not (tree.root / "tests" / "left.txt").exists()
    folder = tree.numba_cache / f"shop_{hashlib.sha1(str(prices.parent).encode()).hexdigest()}"  # noqa: S324  # numba's
    folder.mkdir(parents=True)
    for name in ("kernels.double-4.py311.nbi", "kernels_of_others.f-1.py311.nbi"):
        (folder / name).touch()
    copy = tree.numba_cache_without(["src/shop/kernels.py"])
    assert ["kernels_of_others.f-1.py311.nbi"] == [path.name for path in copy.rglob("*.nbi")]
    assert 2 == len(list(tree.numba_cache.rglob("*.nbi")))
