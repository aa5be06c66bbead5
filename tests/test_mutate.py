"""Mutants of a small package, and the map of the tests that reach them."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from mutate import Fate, Package, State, Verdict
from reach import Importers, Place, Project, Tree, place_of

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
    half.note(next(one for one in package.mutants if one.new == "(19 + 1)"), Verdict(Fate.CAUGHT, "of another run"))
    command(root, *CHANGED, "--jobs", "2")
    return root


def command(root, *words):
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
    table = command(shop, *CHANGED, "--suite", tmp_path / "older").splitlines()
    assert "| shop | 8 | 6 | 1 | 1 | 1 |" in table
    row = "prices.py:7 | `return price <= gift` | `return (price < gift)` | tests/test_prices.py::test_free (older)"
    assert f"| survived | {row} |" in table


def test_a_state_of_other_mutants_is_refused(tmp_path):
    package = Package(made(tmp_path), "shop")
    State(state(tmp_path), package, SETTINGS).note(package.mutants[0], Verdict(Fate.SURVIVED))
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
