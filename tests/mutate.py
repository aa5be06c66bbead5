"""Mutation testing of any package of the project: change one operator, constant or statement, and run the tests.

A mutant that fails a test is caught. One that passes every test that reaches it has survived: either no test states
the fact, or the change makes no difference.

    python tests/mutate.py csplat.encoder --count 60         # 60 mutants chosen by --seed; run again to resume
    python tests/mutate.py csplat_trainer --select 'tuning/*' --jobs 2
    python tests/mutate.py csplat.encoder csplat_trainer --table      # the verdicts, in Markdown; runs nothing
    python tests/mutate.py csplat.encoder --survivors        # after tests were added: again those that survived
    python tests/mutate.py csplat.encoder --suite ../older -m 'not benchmark'
                             # would the tests of another checkout catch what these tests do not?

1. The tests run once on an unchanged copy of the project, and coverage notes which of them reach which lines
   (`reach.py`). What a fixture of a wider scope runs counts for every test that uses it, and what `once(name, make)`
   computes for every test that asks for the name. Python processes that tests start are traced, too; what runs only in
   forked processes, or in those started without our environment, counts as not reached. The map is kept next to the
   state, in `maps`, until a Python file changes. Tests that fail here judge no mutant.
2. Each mutant is written into a copy of the project, one copy for each job and always at the same place, so that numba
   finds there what it has compiled. For a mutant in a kernel or at module level, it compiles the modules that import
   it anew.
3. The tests that reach the mutant's statement run in a forked process, the quickest first, until one fails. Five times
   what they took, and 60 s, is the time limit. Coverage sees neither the inside of kernels nor uses of a constant
   of a module: for these run the tests that reach any function of the module, then those that reach modules that
   import it.

`--budget SECONDS` leaves out the slowest tests of each mutant, and the verdict holds how many. By default the tests of
`make test` judge: not those of areas, unless their sources have changed.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import functools
import hashlib
import importlib
import json
import math
import multiprocessing
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import areas
import filelock
import pytest
from reach import ROOT, Importers, Map, Project, Tree, file_of, has_kernels, place_of

from csplat_selftest.mutation.mutants import Mutant, MutantResult, sample, table
from csplat_selftest.mutation.operators import python_mutants

#: Packages that every map covers, so that one map serves all of them.
MAPPED = ("csplat.encoder", "csplat_tools.optimise", "csplat_trainer")
#: Imported once, before processes are forked, if the project depends on them. None of them knows the project.
PRELOADED = ("hypothesis.strategies", "numpy", "numba", "scipy.spatial", "PIL.Image", "rich.console", "typer")

_FIRST_TESTS, _FIRST_FILES = 30, 3  # run before the others are even collected: most mutants fail one of these


class Fate(StrEnum):
    """Verdict on a mutant."""

    CAUGHT = "caught"  #: a test fails
    SURVIVED = "survived"  #: all tests that reach it pass
    UNREACHED = "not reached"  #: no test reaches it


@dataclass(frozen=True)
class Verdict:
    """The verdict on a mutant.

    Attributes:
        fate: the outcome.
        by: the test that fails.
        tests: number of tests that were to judge it.
        left_out: number of tests that reach it, but are beyond the budget.
        seconds: processor time.
    """

    fate: Fate
    by: str = ""
    tests: int = 0
    left_out: int = 0
    seconds: float = 0.0


class Package:
    """A package and its mutants.

    Args:
        project: the project that contains it.
        name: the package's name.
        patterns: files in it that are changed; none for all.
    """

    def __init__(self, project: Project, name: str, patterns: Sequence[str] = ()) -> None:
        self.name, self.folder, self.patterns = name, project.folder_of(name), patterns or ("*",)
        paths = project.modules(name).values()
        self.texts = {path.removeprefix(f"{self.folder}/"): project.text(path) for path in paths}

    @functools.cached_property
    def mutants(self) -> list[Mutant]:
        """All mutants, in the order of the files."""
        changed = [file for file in self.texts if any(fnmatch.fnmatch(file, one) for one in self.patterns)]
        return [mutant for file in changed for mutant in python_mutants(file, self.texts[file])]

    def valid(self, mutant: Mutant) -> bool:
        """Return whether a mutant is a program."""
        try:
            compile(mutant.apply(self.texts[mutant.file]), mutant.file, "exec", dont_inherit=True)
        except SyntaxError:
            return False
        return True

    def digest(self) -> str:
        """Return a hash of the texts."""
        return hashlib.sha256(json.dumps(self.texts).encode()).hexdigest()[:16]


# What becomes of a mutant -----------------------------------------------------------------------------
@dataclass(frozen=True)
class Task:
    """A mutant and the tests that judge it.

    Attributes:
        mutant: the change.
        file: the file, relative to the root.
        text: its changed text.
        tests: the tests that reach the mutant, in the order in which they run.
        left_out: number of tests that reach it, but are beyond the budget.
        limit: seconds after which it counts as caught.
        stale: files whose compiled kernels may contain what is changed.
    """

    mutant: Mutant
    file: str
    text: str
    tests: Sequence[str]
    left_out: int
    limit: float
    stale: Sequence[str]


class _Chosen:
    """A plugin of pytest that runs chosen tests in a given order and notes the first failure."""

    def __init__(self, tests: Sequence[str]) -> None:
        self.ranks = {test: rank for rank, test in enumerate(tests)}
        self.failed = ""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted((one for one in items if one.nodeid in self.ranks), key=lambda one: self.ranks[one.nodeid])

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.failed = self.failed or report.nodeid

    def pytest_collectreport(self, report: Any) -> None:
        self.pytest_runtest_logreport(report)


def judge(tree: Tree, task: Task) -> Verdict:
    """Run tests on a mutant until one fails: some of the first files, then the others."""
    files = list(dict.fromkeys(file_of(test) for test in task.tests))
    first = [test for test in task.tests if file_of(test) in files[:_FIRST_FILES]][:_FIRST_TESTS]
    others = [test for test in task.tests if test not in set(first)]
    seconds, by = 0.0, ""
    with tree.changed(task.file, task.text):
        cache = tree.numba_cache_without(task.stale) if task.stale else tree.numba_cache
        for tests in filter(None, (first, others)):
            answer = tree.ask(functools.partial(_failed, tree, tests), task.limit, cache)
            seconds += answer.seconds
            by = answer.failure or answer.value["failed"]
            if by:
                break
    return Verdict(Fate.CAUGHT if by else Fate.SURVIVED, by, len(task.tests), task.left_out, round(seconds, 2))


def _failed(tree: Tree, tests: Sequence[str]) -> dict[str, str]:
    """Run tests in the present process; return the first failure, or nothing."""
    plugin = _Chosen(tests)
    status = tree.pytest(["-x", *dict.fromkeys(file_of(test) for test in tests)], plugin)
    passed = status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)  # ids may hold what is changed
    return {"failed": plugin.failed or ("" if passed else f"pytest ends with status {status}")}


_tree: Tree  # set once in each worker process


def _claim(trees: Any) -> None:
    global _tree  # noqa: PLW0603  # a worker keeps its tree
    _tree = trees.get()


def _judged(task: Task) -> tuple[Mutant, Verdict]:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the tests end, too
    try:
        return task.mutant, judge(_tree, task)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@dataclass(frozen=True)
class Suite:
    """Tests that judge mutants of packages.

    Attributes:
        project: the product.
        trees: a copy of it with these tests for each job.
        map: the tests that reach each line.
        importers: the modules that import each module of the packages.
        budget: seconds that the tests of a mutant may take, by what they took on the unchanged tree.
    """

    project: Project
    trees: Sequence[Tree]
    map: Map
    importers: Importers
    budget: float

    @classmethod
    def load(
        cls,
        project: Project,
        trees: Sequence[Tree],
        packages: Sequence[str],
        *,
        expression: str,
        patterns: Sequence[str],
        budget: float,
        folder: Path,
    ) -> Suite:
        """Bring the trees up to date, and read or make the map.

        Args:
            project: the product.
            trees: one for each job.
            packages: names of the packages that are mapped.
            expression: selection of tests, as for pytest's `-m`.
            patterns: names of files in `tests`; none for all.
            budget: seconds that the tests of a mutant may take.
            folder: folder of maps.
        """
        for tree in trees:
            tree.refresh()
        for module in PRELOADED:
            if module.split(".")[0] in project.text("pyproject.toml"):
                with contextlib.suppress(ImportError):
                    importlib.import_module(module)
        mapped = Map.make(trees[0], packages, expression, patterns, folder)
        return cls(project, trees, mapped, Importers(project, packages), budget)

    def verdicts(self, package: Package, mutants: Sequence[Mutant]) -> Iterator[tuple[Mutant, Verdict]]:
        """Yield the verdict on each mutant, in the order of completion."""
        tasks = [self._task(package, mutant) for mutant in mutants]
        unreached = [task for task in tasks if not task.tests and not task.left_out]
        yield from ((task.mutant, Verdict(Fate.UNREACHED)) for task in unreached)
        context = multiprocessing.get_context("fork")
        trees = context.SimpleQueue()
        for tree in self.trees:
            trees.put(tree)
        handler = signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a worker that waits could not run a handler
        with context.Pool(len(self.trees), _claim, (trees,)) as pool:
            signal.signal(signal.SIGTERM, handler)
            yield from pool.imap_unordered(_judged, [task for task in tasks if task not in unreached])

    def _task(self, package: Package, mutant: Mutant) -> Task:
        text, file = package.texts[mutant.file], f"{package.folder}/{mutant.file}"
        place = place_of(text, mutant.start)
        levels = [{one: self.project.text(one) for one in level} for level in self.importers.levels(file)]
        reaching = self.map.reaching(place, levels)
        tests = self.map.affordable(reaching, self.budget)
        changed = levels[:1] if place.is_traced else levels
        texts = {name: source for level in changed for name, source in level.items()}
        stale = [*texts] if any(has_kernels(source) for source in texts.values()) else []
        left_out, limit = len(reaching) - len(tests), self.map.limit(tests)
        return Task(mutant, file, mutant.apply(text), tests, left_out, limit, stale)


# What is kept ----------------------------------------------------------------------------------------
class State:
    """The mutants of a package and their verdicts, stored in a file.

    Args:
        file: path of the file.
        package: the package.
        settings: settings that the choice of mutants depends on.

    Raises:
        ValueError: the file is of other sources or settings.
    """

    def __init__(self, file: Path, package: Package, settings: Mapping[str, Any]) -> None:
        self.file, self.package = file, package
        expected = {"package": package.name, "sources": package.digest(), **settings}
        self.data: dict[str, Any] = {**expected, "map": "", "mutants": []}
        if file.is_file():
            self.data = json.loads(file.read_text(encoding="utf-8"))
            differing = [name for name, value in expected.items() if self.data[name] != value]
            if differing:
                raise ValueError(f"{file} is of other {', '.join(differing)}: remove it, or name another with --state")

    @property
    def entries(self) -> list[dict[str, Any]]:
        """Return mutants and verdicts in the form of the file."""
        entries: list[dict[str, Any]] = self.data["mutants"]
        return entries

    def known(self) -> list[Mutant]:
        """Return the mutants that have a verdict."""
        return [_mutant(entry) for entry in self.entries]

    def uncaught(self, suite: str = "") -> list[Mutant]:
        """Return the mutants that no test catches; those on which another suite has no verdict yet."""
        entries = [one for one in self.entries if one["fate"] != Fate.CAUGHT]
        return [_mutant(one) for one in entries if not suite or suite not in one.get("suites", {})]

    def note(self, mutant: Mutant, verdict: Verdict, suite: str = "") -> None:
        """Store a verdict; the verdict of another suite is stored next to this one's."""
        entry = next((one for one in self.entries if _mutant(one) == mutant), asdict(mutant))
        if suite:
            entry.setdefault("suites", {})[suite] = asdict(verdict)
        else:
            entry.update(asdict(verdict))
        if entry not in self.entries:
            self.entries.append(entry)
            self.entries.sort(key=lambda one: (one["file"], one["start"], one["new"]))
        self.file.parent.mkdir(parents=True, exist_ok=True)
        whole = self.file.with_name(f"{self.file.name}.part")
        whole.write_text(f"{json.dumps(self.data, indent=1)}\n", encoding="utf-8")
        whole.replace(self.file)

    def table(self) -> str:
        """Return counts and survivors in Markdown."""
        suites = sorted({suite for one in self.entries for suite in one.get("suites", {})})
        caught = [
            sum(one.get("suites", {}).get(suite, {}).get("fate") == Fate.CAUGHT for one in self.entries)
            for suite in suites
        ]
        counts = [len(self.entries), *(sum(one["fate"] == fate for one in self.entries) for fate in Fate), *caught]
        head = ["package", "mutants", *Fate, *(f"caught by {suite} alone" for suite in suites)]
        rows = [head, ["---", *["---:"] * len(counts)], [self.package.name, *counts]]
        results = [MutantResult(_mutant(one), Fate(one["fate"]), _by_others(one)) for one in self.entries]
        shown = table(results, self.package.texts, (Fate.SURVIVED, Fate.UNREACHED), "caught by others")
        return "\n".join([*(f"| {' | '.join(map(str, row))} |" for row in rows), "", shown])


def _mutant(entry: Mapping[str, Any]) -> Mutant:
    return Mutant(**{name: entry[name] for name in ("file", "line", "start", "old", "new")})


def _by_others(entry: Mapping[str, Any]) -> str:
    caught = [(suite, one["by"]) for suite, one in entry.get("suites", {}).items() if one["fate"] == Fate.CAUGHT]
    return ", ".join(f"{by} ({suite})" for suite, by in caught)


# The command -----------------------------------------------------------------------------------------
def main(words: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    option = parser.add_argument
    option("packages", nargs="+", metavar="PACKAGE", help="name of a package, such as csplat.encoder")
    option("--count", type=int, default=60, help="mutants of each package (default 60)")
    option("--seed", type=int, default=0, help="of the choice of mutants (default 0)")
    option("--select", action="append", default=[], metavar="GLOB", help="files of the package to change (default all)")
    option("--tests", action="append", default=[], metavar="GLOB", help="files in tests that judge (default all)")
    option("-m", dest="expression", metavar="MARKEXPR", help="tests that judge (default those of `make test`)")
    option(
        "--budget", type=float, default=math.inf, help="seconds of tests for a mutant, the quickest first (default all)"
    )
    option("--jobs", type=int, default=1, help="mutants at a time (default 1)")
    option("--state", type=Path, metavar="FILE", help="where verdicts are kept (default out/mutants/PACKAGE.json)")
    option("--survivors", action="store_true", help="run again those that were not caught")
    option("--suite", type=Path, metavar="DIR", help="run those that were not caught against the tests of a checkout")
    option("--table", action="store_true", help="print what became of the mutants, run nothing")
    option("--root", type=Path, default=ROOT, help="the project (default this one)")
    args = parser.parse_args(words)
    if args.state and len(args.packages) > 1:
        parser.error("--state is the file of one package")
    folder = args.state.absolute().parent if args.state else args.root.absolute() / "out" / "mutants"
    folder.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the workers end, too
    try:
        project = Project.load(args.root.absolute())
        packages = [Package(project, name, args.select) for name in args.packages]
        settings = {"seed": args.seed, "select": args.select}
        states = [State(args.state or folder / f"{one.name}.json", one, settings) for one in packages]
        if not args.table:
            with filelock.FileLock(folder / "lock", timeout=0):
                _run(args, project, states, folder)
    except filelock.Timeout:
        parser.error(f"another run uses {folder}: name a file in another folder with --state")
    except (LookupError, RuntimeError, ValueError) as error:
        parser.error(str(error))
    print("\n\n".join(state.table() for state in states))
    return 0


def _run(args: argparse.Namespace, project: Project, states: Sequence[State], folder: Path) -> None:
    checkout = (args.suite or project.root).absolute()
    name = _revision(checkout) if args.suite else ""
    file = checkout / "tests" / "areas.toml"
    usual = areas.expression(areas.load(file), root=checkout) if file.is_file() else ""
    packages = {state.package.name for state in states}
    for one in MAPPED:
        with contextlib.suppress(LookupError):
            project.folder_of(one)
            packages.add(one)
    suite = Suite.load(project,
        [Tree(folder / "trees" / f"{name or 'own'}-{job}", project, checkout) for job in range(args.jobs)],
        sorted(packages), expression=usual if args.expression is None else args.expression, patterns=args.tests,
        budget=args.budget, folder=folder / "maps")  # fmt: skip
    _say(f"{len(suite.map.tests)} tests judge; {len(suite.map.failed)} fail on the unchanged tree and judge nothing")
    for failed in suite.map.failed:
        _say(f"  {failed}")
    for state in states:
        if name or args.survivors:
            chosen = state.uncaught(name)
        else:
            known = set(state.known())
            chosen = [one for one in sample(state.package, args.count, args.seed) if one not in known]
            if known and state.data["map"] != suite.map.key:
                _say(f"{state.file} holds verdicts of other tests, which stay; --survivors renews those not caught")
        if not name:
            state.data["map"] = suite.map.key
        for number, (mutant, verdict) in enumerate(suite.verdicts(state.package, chosen), 1):
            state.note(mutant, verdict, name)
            left_out = f", {verdict.left_out} left out" if verdict.left_out else ""
            words = (
                f"{verdict.seconds:.1f} s, {verdict.tests} tests{left_out}, {mutant.file}:{mutant.line} {verdict.by}"
            )
            _say(f"{state.package.name} {number} of {len(chosen)}: {verdict.fate}, {words.strip()}")


def _revision(checkout: Path) -> str:
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or checkout.name


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
