"""Map lines of the product to the tests that reach them, and run tests in a copy of the project.

A `Tree` is a copy of the project that stays at one place, so that what numba has compiled is found again; one file of
it may be changed for a while. `Map.make` runs the tests there once under `coverage`, with a context for each test and
for each fixture of a wider scope. `mutate.py` asks a map which tests are to judge a mutant.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib.util
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import types
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import coverage
import pytest

ROOT = Path(__file__).resolve().parent.parent
#: Decorators whose functions are compiled, so that coverage does not see their lines.
COMPILING = {"kernel", "inline", "spliced", "relaxed_kernel", "parallel_kernel", "njit", "jit"}

_DATA_BYTES = 8 << 30  # memory limit of a test process: a mutant that allocates without bound fails at once
_MAP_SECONDS = 4 * 3600.0  # a map of the slowest suite so far took half an hour
_SLACK_FACTOR, _SLACK_SECONDS = 5.0, 60.0  # the time limit of tests, on what they took; other processes may be busy
_SHARED_SECONDS = 0.05  # tests that use slower fixtures of their module stay together


@dataclass(frozen=True)
class Project:
    """A checkout.

    Attributes:
        root: its folder.
        folders: the folders in it that are on Python's path.
    """

    root: Path
    folders: tuple[str, ...]

    @classmethod
    def load(cls, root: Path) -> Project:
        """Read the folders from `pyproject.toml`."""
        settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
        return cls(root, tuple(settings["tool"]["hatch"]["build"]["dev-mode-dirs"]))

    def files(self) -> list[str]:
        """Return the files that git would add, or all but those in `out` if git knows none, relative to the root."""
        command = ["git", "-C", str(self.root), "ls-files", "-co", "--exclude-standard", "-z"]
        listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split("\0")[:-1]
        found = listed or [path.relative_to(self.root).as_posix() for path in self.root.rglob("*")]
        ours = [name for name in found if not name.startswith("out/") and "__pycache__" not in name]
        return sorted(name for name in ours if (self.root / name).is_file())

    def folder_of(self, package: str) -> str:
        """Return the folder of a package relative to the root.

        Raises:
            LookupError: there is no such package.
        """
        for folder in self.folders:
            path = f"{folder}/{package.replace('.', '/')}"
            if (self.root / path / "__init__.py").is_file():
                return path
        raise LookupError(f"{package} is no package in {', '.join(self.folders)} of {self.root}")

    def modules(self, package: str) -> dict[str, str]:
        """Return the modules of a package by their names, as files relative to the root."""
        folder = self.root / self.folder_of(package)
        return {
            ".".join([package, *path.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__"): (
                path.relative_to(self.root).as_posix()
            )
            for path in sorted(folder.rglob("*.py"))
        }

    def text(self, name: str) -> str:
        """Return the text of a file."""
        return (self.root / name).read_text(encoding="utf-8")


# Copies of the project, and processes in them ---------------------------------------------------------
@dataclass(frozen=True)
class Answer:
    """The answer of a process or the reason for its absence, and the processor time with its children's."""

    value: dict[str, Any] = field(default_factory=dict)
    failure: str = ""
    seconds: float = 0.0


class Tree:
    """A copy of the project in which one file may be changed.

    Args:
        folder: folder of the copy.
        project: whose product it is.
        suite: the checkout that gives `tests` and `pyproject.toml`.
    """

    def __init__(self, folder: Path, project: Project, suite: Path) -> None:
        self.root, self.project, self.suite = folder, project, suite
        self.numba_cache = self._beside("numba")

    def refresh(self) -> None:
        """Copy files that differ from the sources and remove all others; times of files are preserved."""
        wanted = {name: self.project.root / name for name in self.project.files() if not _is_of_suite(name)}
        wanted |= {name: self.suite / name for name in Project.load(self.suite).files() if _is_of_suite(name)}
        for path in self.root.rglob("*"):
            name = path.relative_to(self.root).as_posix()
            if path.is_file() and path.parent.name != "__pycache__" and name not in wanted:
                path.unlink()
        for name, source in wanted.items():
            target = self.root / name
            if not target.is_file() or _stamp(target) != _stamp(source):
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, target)

    def digest(self) -> str:
        """Return a hash of all Python files."""
        total = hashlib.sha256()
        for path in sorted(self.root.rglob("*.py")):
            total.update(f"{path.relative_to(self.root)}\0".encode() + path.read_bytes())
        return total.hexdigest()[:16]

    @contextlib.contextmanager
    def changed(self, name: str, text: str) -> Iterator[None]:
        """Replace the text of a file within a `with` block."""
        target = self.root / name
        try:
            _remove_bytecode(target)
            target.write_text(text, encoding="utf-8", newline="")
            yield
        finally:
            _remove_bytecode(target)
            shutil.copy2(self.project.root / name, target)

    def numba_cache_without(self, names: Iterable[str]) -> Path:
        """Return a copy of numba's cache, made of links, that holds nothing of these files.

        numba compiles a module anew when its text has changed, but not when a module that it imports has. Its cache
        has a folder for each of ours, and in there files that begin with the name of a module.
        """
        stale = set()
        for name in names:
            folder = str((self.root / name).parent)
            digest = hashlib.sha1(folder.encode(), usedforsecurity=False).hexdigest()
            stale.add((f"{Path(folder).name}_{digest}", f"{Path(name).stem}."))

        def ignored(folder: str, files: list[str]) -> list[str]:
            return [one for one in files if any(Path(folder).name == f and one.startswith(stem) for f, stem in stale)]

        copy = self._beside("numba-changed")
        shutil.rmtree(copy, ignore_errors=True)
        self.numba_cache.mkdir(parents=True, exist_ok=True)
        shutil.copytree(self.numba_cache, copy, copy_function=os.link, ignore=ignored)
        return copy

    def ask(self, work: Callable[[], dict[str, Any]], limit: float, numba_cache: Path | None = None) -> Answer:
        """Call something in a forked process that knows this tree alone.

        Args:
            work: its value must go into JSON.
            limit: seconds after which the process is ended.
            numba_cache: folder of compiled kernels; by default the tree's own.
        """
        file = self._beside("answer.json")
        file.unlink(missing_ok=True)
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            try:
                self._enter(numba_cache or self.numba_cache)
                file.write_text(json.dumps(work()), encoding="utf-8")
            except BaseException:  # noqa: BLE001  # whatever it is, it goes into the log and never into the caller
                sys.excepthook(*sys.exc_info())
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(0)
        ended, status, seconds, end = 0, 0, limit, time.monotonic() + limit
        try:
            while not ended and time.monotonic() < end:
                ended, status, usage = os.wait4(child, os.WNOHANG)
                seconds = usage.ru_utime + usage.ru_stime if ended else limit
                time.sleep(0 if ended else 0.01)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)  # with whatever it started
            if not ended:
                os.waitpid(child, 0)
        if not ended:
            return Answer(failure="hangs", seconds=seconds)
        if os.WIFSIGNALED(status):
            return Answer(failure=f"ends with {signal.Signals(os.WTERMSIG(status)).name}", seconds=seconds)
        if not file.is_file():
            return Answer(failure="ends without an answer", seconds=seconds)
        return Answer(json.loads(file.read_text(encoding="utf-8")), seconds=seconds)

    def pytest(self, arguments: Sequence[str], plugin: object) -> int:
        """Run pytest in the present process, which `ask` has forked; return its status."""
        options = ["-q", "--import-mode=importlib", "-p", "no:cacheprovider", f"--basetemp={self._beside('tmp')}"]
        options += ["--assert=plain"]  # the others are rewritten for their messages, which takes time
        options += ["-n0"] if importlib.util.find_spec("xdist") else []
        return int(pytest.main([*options, f"--rootdir={self.root}", *arguments], plugins=[plugin]))

    def _enter(self, numba_cache: Path) -> None:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        log = os.open(self._beside("log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for source, target in ((os.open(os.devnull, os.O_RDONLY), 0), (log, 1), (log, 2)):
            os.dup2(source, target)
        resource.setrlimit(resource.RLIMIT_DATA, (_DATA_BYTES, resource.getrlimit(resource.RLIMIT_DATA)[1]))
        # Nothing comes from the checkout that this file belongs to, not even what is already imported.
        own = [ROOT / "tests", *(ROOT / one for one in Project.load(ROOT).folders)]
        paths = [str(self.root / one) for one in self.project.folders]
        sys.path[:] = [*paths, *(one for one in sys.path if Path(one).absolute() not in own)]
        for name, module in list(sys.modules.items()):
            if any(Path(getattr(module, "__file__", None) or "/").absolute().is_relative_to(one) for one in own):
                del sys.modules[name]
        os.chdir(self.root)
        sys.modules["__main__"] = types.ModuleType("__main__")  # multiprocessing would import the old one again
        os.environ |= {"PYTHONPATH": os.pathsep.join(paths), "NUMBA_CACHE_DIR": str(numba_cache)}
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
        if "numba" in sys.modules:
            sys.modules["numba"].config.reload_config()

    def _beside(self, suffix: str) -> Path:
        return self.root.with_name(f"{self.root.name}-{suffix}")


def _is_of_suite(name: str) -> bool:
    return name.startswith("tests/") or name == "pyproject.toml"


def _stamp(path: Path) -> tuple[int, int]:
    return path.stat().st_mtime_ns, path.stat().st_size


def _remove_bytecode(path: Path) -> None:
    """Remove a module's bytecode: between two texts of one length and one second Python sees no difference."""
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink()


# Lines -----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Place:
    """A statement and what surrounds it.

    Attributes:
        lines: the statement's lines; only those of its head if it has a body.
        is_traced: it runs when a function is called, and coverage sees that.
        is_compiled: it is in a function that is compiled.
    """

    lines: range
    is_traced: bool
    is_compiled: bool


def place_of(text: str, start: int) -> Place:
    """Find the innermost statement at a character of a module."""
    line_start = text.rfind("\n", 0, start) + 1
    position = (text.count("\n", 0, start) + 1, len(text[line_start:start].encode()))
    statement: Any = None
    is_called = is_compiled = False
    for node in ast.walk(ast.parse(text)):  # from outside to inside
        if isinstance(node, ast.stmt) and _start(node) <= position < (node.end_lineno, node.end_col_offset):
            statement = node
            if _is_function(node) and position >= _start(node.body[0]):
                is_called, is_compiled = True, is_compiled or _is_compiled(node)
    body = getattr(statement, "body", None)
    last = body[0].lineno - 1 if body else statement.end_lineno
    lines = range(statement.lineno, max(last, statement.lineno) + 1)
    return Place(lines, is_called and not is_compiled, is_compiled)


@cache
def has_kernels(text: str) -> bool:
    """Return whether a module has functions that are compiled."""
    return any(_is_function(node) and _is_compiled(node) for node in ast.walk(ast.parse(text)))


@cache
def _lines_of_functions(text: str) -> frozenset[int]:
    """Return the lines that run only when a function is called, where coverage sees that."""
    functions = [node for node in ast.walk(ast.parse(text)) if _is_function(node) and not _is_compiled(node)]
    runs = [range(max(one.body[0].lineno, one.lineno + 1), one.end_lineno + 1) for one in functions]
    return frozenset(line for run in runs for line in run)


def _start(node: ast.stmt) -> tuple[int, int]:
    return node.lineno, node.col_offset


def _is_function(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)


def _is_compiled(function: Any) -> bool:
    nodes = [node for one in function.decorator_list for node in ast.walk(one)]
    return any(getattr(node, "id", getattr(node, "attr", "")) in COMPILING for node in nodes)


class Importers:
    """The modules of packages, and which of them import which.

    Attributes:
        files: files relative to the root by names of modules.
    """

    def __init__(self, project: Project, packages: Iterable[str]) -> None:
        self.files = {name: file for package in packages for name, file in project.modules(package).items()}
        self._users: dict[str, set[str]] = defaultdict(set)
        for name, file in self.files.items():
            for node in ast.walk(ast.parse(project.text(file))):
                names = [one.name for one in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
                if isinstance(node, ast.ImportFrom):  # relative imports are forbidden by ruff's TID
                    names = [str(node.module), *(f"{node.module}.{one}" for one in names)]
                for one in {*names} & {*self.files} - {name}:
                    self._users[one].add(name)

    def levels(self, file: str) -> list[list[str]]:
        """Return the file itself, the files of the modules that import it, of those that import these, and so on."""
        levels = [{name for name, one in self.files.items() if one == file}]
        seen = set(levels[0])
        while levels[-1]:
            levels.append({user for one in levels[-1] for user in self._users[one]} - seen)
            seen |= levels[-1]
        return [sorted(self.files[one] for one in level) for level in levels[:-1]]


# Tests -----------------------------------------------------------------------------------------------
class Recorder:
    """A plugin of pytest that switches coverage to the running test or fixture, and records the time of each.

    Attributes:
        uses: fixtures that each test and each fixture uses.
        scopes: scopes of the fixtures.
        seconds: time of each, without that of what it uses.
        passed: tests whose call passed.
        failed: tests, and files, that failed.
    """

    def __init__(self, traced: coverage.Coverage) -> None:
        self.uses: dict[str, set[str]] = defaultdict(set)
        self.scopes: dict[str, str] = {}
        self.seconds: dict[str, float] = defaultdict(float)
        self.passed: set[str] = set()
        self.failed: set[str] = set()
        self._traced = traced
        self._stack: list[str] = []
        self._since = 0.0

    @contextlib.contextmanager
    def within(self, name: str) -> Iterator[None]:
        """Count lines and time for a name; what meanwhile runs within another name counts for that one."""
        if self._stack:
            self.uses[self._stack[-1]].add(name)
        self._switch([*self._stack, name])
        try:
            yield
        finally:
            self._switch(self._stack[:-1])

    def _switch(self, stack: list[str]) -> None:
        now = time.perf_counter()
        if self._stack:
            self.seconds[self._stack[-1]] += now - self._since
        self._stack, self._since = stack, now
        name = stack[-1] if stack else ""
        os.environ["REACH_CONTEXT"] = name  # for processes that are started from here on
        self._traced.switch_context(name)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Count a test for itself, and note the fixtures of a wider scope that it uses."""
        for fixtures in item._fixtureinfo.name2fixturedefs.values():
            self.uses[item.nodeid].update(_label(one) for one in fixtures if one.scope != "function")
        with self.within(item.nodeid):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Count the setup of a fixture of a wider scope for itself, and what `once` computes for its name."""
        if fixturedef.scope == "function":
            return (yield)
        self.scopes[_label(fixturedef)] = fixturedef.scope
        with self.within(_label(fixturedef)):
            value = yield
        if fixturedef.argname == "once":
            value = self._counted(value)
            fixturedef.cached_result = (value, *fixturedef.cached_result[1:])
        return value

    def _counted(self, once: Callable[[str, Callable[[], object]], object]) -> Callable[..., object]:
        def get(name: str, make: Callable[[], object]) -> object:
            with self.within(f"once {name}"):
                return once(name, make)

        return get

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note the outcome of a test."""
        if report.failed:
            self.failed.add(report.nodeid)
        elif report.passed and report.when == "call":
            self.passed.add(report.nodeid)

    def pytest_collectreport(self, report: Any) -> None:
        """Note a file that cannot be collected."""
        if report.failed:
            self.failed.add(report.nodeid)


def _label(fixture: Any) -> str:
    return f"fixture {fixture.baseid}::{fixture.argname}"


@dataclass(frozen=True)
class Map:
    """Map of tests to the lines that they reach.

    Attributes:
        key: hash of all sources and of the choice of tests.
        root: the tree that was traced.
        lines: file with coverage's data.
        tests: the tests that pass there.
        failed: the tests that fail there.
        uses: fixtures that each test and each fixture uses.
        scopes: scopes of the fixtures.
        seconds: time of each test and each fixture, without that of what it uses.
    """

    key: str
    root: Path
    lines: Path
    tests: list[str]
    failed: list[str]
    uses: Mapping[str, list[str]]
    scopes: Mapping[str, str]
    seconds: Mapping[str, float]

    @classmethod
    def make(cls, tree: Tree, packages: Sequence[str], expression: str, patterns: Sequence[str], folder: Path) -> Map:
        """Read the map of a tree's sources from a folder, or run the tests and write it there.

        Args:
            tree: the tree, unchanged.
            packages: names of the packages that are traced.
            expression: selection of tests, as for pytest's `-m`; empty for all.
            patterns: names of files in `tests`; none for all.
            folder: folder of maps.

        Raises:
            RuntimeError: pytest did not run.
        """
        words = json.dumps([tree.digest(), str(tree.root), sorted(packages), expression, sorted(patterns)])
        key = hashlib.sha256(words.encode()).hexdigest()[:16]
        lines, file = folder / key / "lines", folder / key / "map.json"
        if not file.is_file():
            shutil.rmtree(lines.parent, ignore_errors=True)
            lines.parent.mkdir(parents=True)
            paths = [path for one in patterns for path in sorted((tree.root / "tests").glob(one))]
            arguments = [str(path.relative_to(tree.root)) for path in paths] or ["tests"]
            arguments += ["-m", expression] if expression else []
            answer = tree.ask(lambda: _record(tree, packages, lines, arguments), _MAP_SECONDS)
            if answer.failure or answer.value["status"] not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
                raise RuntimeError(f"the tests do not run on the unchanged tree, see {tree.root}-log")
            file.write_text(json.dumps({**answer.value, "seconds_of_map": answer.seconds}), encoding="utf-8")
        value = json.loads(file.read_text(encoding="utf-8"))
        parts = ("tests", "failed", "uses", "scopes", "seconds")
        return cls(key, tree.root, lines, *(value[name] for name in parts))

    def reaching(self, place: Place, levels: Sequence[Mapping[str, str]]) -> list[str]:
        """Return the tests that reach a statement, in the order in which they run.

        Args:
            place: the statement.
            levels: texts of files by level: its own file, files that import it, files that import these, and so on.
        """
        contexts = self._contexts(next(iter(levels[0])))
        names = {name for line in place.lines for name in contexts.get(line, ())}
        if place.is_traced and names != {""}:  # "": it runs when modules are imported
            return self._ordered(self._tests_of(names))
        chosen: dict[str, None] = {}  # a set that keeps the order
        for level in levels:
            near = {
                name
                for file, text in level.items()
                for line, found in self._contexts(file).items()
                if line in _lines_of_functions(text)
                for name in found
            }
            chosen |= dict.fromkeys(self._ordered(self._tests_of(near) - set(chosen)))
        return list(chosen)

    def affordable(self, tests: Sequence[str], seconds: float) -> list[str]:
        """Return the first tests that together take no longer than `seconds`, fixtures included."""
        parts: set[str] = set()
        for count, test in enumerate(tests):
            parts |= {test} | self._closure(test)
            if self._sum(parts) > seconds:
                return list(tests[:count])
        return list(tests)

    def limit(self, tests: Sequence[str]) -> float:
        """Return the time limit of tests in seconds."""
        parts = set(tests).union(*(self._closure(test) for test in tests))
        return _SLACK_SECONDS + _SLACK_FACTOR * self._sum(parts)

    @cached_property
    def _data(self) -> coverage.CoverageData:
        data = coverage.CoverageData(str(self.lines))
        data.read()
        return data

    @cached_property
    def _closures(self) -> dict[str, frozenset[str]]:
        return {}

    def _contexts(self, file: str) -> dict[int, list[str]]:
        return self._data.contexts_by_lineno(str(self.root / file))

    def _closure(self, name: str) -> frozenset[str]:
        """Return all fixtures that a test or a fixture uses, directly or not."""
        if name not in self._closures:
            used = frozenset(self.uses.get(name, ()))
            self._closures[name] = used  # ends the recursion when a name uses itself
            self._closures[name] = used.union(*(self._closure(one) for one in used))
        return self._closures[name]

    def _tests_of(self, names: set[str]) -> set[str]:
        return {test for test in self.tests if test in names or not names.isdisjoint(self._closure(test))}

    def _ordered(self, tests: Iterable[str]) -> list[str]:
        """Sort tests by time, fixtures included; tests that use slow fixtures of their file stay together."""
        total = {test: self._sum([test, *self._closure(test)]) for test in tests}
        groups: dict[str, float] = {}  # least time of the tests of a file that stay together
        ranks: dict[str, tuple[float, str]] = {}
        for test in sorted(total, key=lambda test: (total[test], test)):
            local = [one for one in self._closure(test) if self.scopes.get(one) in ("class", "module", "package")]
            together = self._sum(local) > _SHARED_SECONDS
            file = file_of(test)
            ranks[test] = (groups.setdefault(file, total[test]), file) if together else (total[test], "")
        return sorted(ranks, key=lambda test: ranks[test])  # stable: by time within a group

    def _sum(self, names: Iterable[str]) -> float:
        return sum(self.seconds.get(one, 0.0) for one in names)


def file_of(test: str) -> str:
    """Return the file of a test."""
    return test.split("::", 1)[0]


def _record(tree: Tree, packages: Sequence[str], lines: Path, arguments: Sequence[str]) -> dict[str, Any]:
    """Run tests under coverage, in the present process."""
    settings = lines.with_name("coveragerc")
    folders = "\n    ".join(str(tree.root / tree.project.folder_of(one) / "*") for one in packages)
    settings.write_text(
        f"[run]\ndata_file = {lines}\nparallel = true\ncontext = ${{REACH_CONTEXT-}}\ninclude =\n    {folders}\n"
        "disable_warnings = no-data-collected, module-not-imported, module-not-measured, already-imported\n",
        encoding="utf-8",
    )
    os.environ |= {"COVERAGE_CORE": "ctrace", "REACH_CONTEXT": ""}  # the newer core does not switch contexts
    traced = coverage.Coverage(config_file=str(settings))
    traced.start()
    for package in packages:  # now, so that what runs at import is no test's
        for module in tree.project.modules(package):
            with contextlib.suppress(Exception):  # it needs an extra that is absent
                importlib.import_module(module)
    os.environ["COVERAGE_PROCESS_START"] = str(settings)
    recorder = Recorder(traced)
    status = tree.pytest(arguments, recorder)
    traced.stop()
    traced.save()
    combined = coverage.Coverage(data_file=str(lines), config_file=False)
    combined.combine([str(lines.parent)])
    combined.save()
    return {
        "status": status,
        "tests": sorted(recorder.passed - recorder.failed),
        "failed": sorted(recorder.failed),
        "uses": {name: sorted(used) for name, used in recorder.uses.items()},
        "scopes": recorder.scopes,
        "seconds": {name: round(seconds, 4) for name, seconds in recorder.seconds.items()},
    }
