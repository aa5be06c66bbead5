# SPDX-License-Identifier: CC0-1.0
"""Mutants of a package, judged by the tests that reach them.

Coverage lists once which tests reach which lines, function by function. Each mutant is written into a copy of the
checkout, where the tests that reach its statement run, unmarked tests first and among these the quickest, until a test
fails. For changes that coverage cannot see (constants of a module), tests that reach any line of the module take their
place.
"""

from __future__ import annotations

import ast
import json
import os
import random
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from xml.etree import ElementTree as ET

from csplat.errors import InputError
from csplat_selftest.mutation.mutants import Mutant
from csplat_selftest.mutation.operators import python_mutants

ROOTS = {
    "csplat": "codec", "csplat_render": "trainer", "csplat_trainer": "trainer", "csplat_tools": "tools",
    "csplat_conformance": "conformance",
}  # fmt: skip
_PATH = ("tests/helpers", "codec", "conformance", "conformance/lab", "tools", "tools/lab", "trainer")
_EVERYDAY = "not (browser or engines or peers or torch or gpu or remote or long)"
_UNMARKED = f"{_EVERYDAY} and not slow and not shared_data"
_TESTS_MAX = 120  # tests per mutant
_FIRST = 25  # tests that run first, alone: most mutants fail one of them, and fewer files are imported
_SECONDS = 300.0  # time limit of a mutant's tests; a mutant beyond it counts as caught
_SKIPPED = (".git", ".venv", "out", "node_modules", "__pycache__", ".mypy_cache", ".ruff_cache", ".hypothesis")


@dataclass(frozen=True)
class JudgedMutant:
    """A mutant, at a place that survives edits elsewhere in its file, and its verdict.

    Attributes:
        file: path relative to the checkout.
        line: text of its line.
        occurrence: number of equal lines before it.
        column: column of the change.
        old: text that changes.
        new: its replacement.
        verdict: `caught`, `survived`, `unreached` (by tests), `gone` (no such line) or empty.
        by: the test that failed.
        is_unmarked: the test belongs to `make check`.
        left_out: number of tests that reach the mutant, but did not run.
    """

    file: str
    line: str
    occurrence: int
    column: int
    old: str
    new: str
    verdict: str = ""
    by: str = ""
    is_unmarked: bool = False
    left_out: int = 0

    def place(self, text: str) -> tuple[int, int] | None:
        """Return line number, from 1, and index of the change in a text of the file; `None` if the line is gone."""
        start, seen = 0, 0
        for number, line in enumerate(text.splitlines(keepends=True), 1):
            if line.rstrip("\n") == self.line:
                if seen == self.occurrence:
                    return number, start + self.column
                seen += 1
            start += len(line)
        return None


class Checkout:
    """A checkout of the project with its tests.

    Args:
        root: its folder.
        work: folder for the map of reached lines and for copies.
    """

    def __init__(self, root: Path, work: Path) -> None:
        self.root, self.work = root, work
        self._seconds: dict[str, float] = {}

    def files(self, package: str) -> list[str]:
        """Return the paths of a package's modules, relative to the root.

        Raises:
            InputError: there is no such package.
        """
        folder = Path(ROOTS.get(package.split(".", maxsplit=1)[0], ""), *package.split("."))
        single = folder.with_suffix(".py")
        found = [single] if (self.root / single).exists() else [
            path.relative_to(self.root) for path in sorted((self.root / folder).rglob("*.py"))
        ]  # fmt: skip
        if package.split(".", maxsplit=1)[0] not in ROOTS or not found:
            raise InputError(f"package {package} does not exist in {self.root}, expected one below {', '.join(ROOTS)}")
        return [path.as_posix() for path in found if path.name != "_spec.py"]

    def text(self, file: str) -> str:
        """Return the text of a file; an empty string if it is gone."""
        path = self.root / file
        return path.read_text("utf-8") if path.exists() else ""

    def draw(self, package: str, count: int, seed: int) -> list[JudgedMutant]:
        """Return random mutants of a package that compile."""
        mutants = [one for file in self.files(package) for one in python_mutants(file, self.text(file))]
        random.Random(seed).shuffle(mutants)  # noqa: S311 - repeatable, no secret
        chosen: list[JudgedMutant] = []
        for mutant in mutants:
            if len(chosen) == count:
                break
            if _compiles(mutant, self.text(mutant.file)):
                chosen.append(self._placed(mutant))
        return chosen

    def _placed(self, mutant: Mutant) -> JudgedMutant:
        text = self.text(mutant.file)
        begin = text.rfind("\n", 0, mutant.start) + 1
        line = text[begin:].split("\n", 1)[0]
        before = sum(one == line for one in text[:begin].split("\n")[:-1])
        return JudgedMutant(mutant.file, line, before, mutant.start - begin, mutant.old, mutant.new)

    @cached_property
    def reached(self) -> Mapping[str, Mapping[int, Sequence[str]]]:
        """Names of tests by line and file, from a run of all tests with coverage; kept in the work folder."""
        saved = self.work / "reached.json"
        if not saved.exists():
            self._run_all(saved)
        raw = json.loads(saved.read_text("utf-8"))
        names = list(raw["seconds"])
        self._seconds = raw["seconds"]
        return {
            file: {int(line): [names[one] for one in tests] for line, tests in lines.items()}
            for file, lines in raw["lines"].items()
        }

    def _run_all(self, saved: Path) -> None:
        import coverage

        self.work.mkdir(parents=True, exist_ok=True)
        settings, data = self.work / "coveragerc", self.work / "coverage"
        settings.write_text(
            f"[run]\nparallel = true\ndata_file = {data}\ndynamic_context = test_function\n"
            f"concurrency = multiprocessing,thread\npatch = subprocess\nsource_pkgs = {','.join(ROOTS)}\n",
            "utf-8",
        )
        words = ["-m", "coverage", "run", f"--rcfile={settings}", "-m", "pytest", "-q", "-n", "auto"]
        report = self.work / "report.xml"
        self._python(self.root, [*words, "--dist", "loadfile", "-m", _EVERYDAY, f"--junitxml={report}"], None)
        measured = coverage.Coverage(data_file=str(data), config_file=str(settings))
        measured.combine(keep=True)
        save_reached(measured.get_data(), report, self.root, saved)

    @cached_property
    def unmarked(self) -> frozenset[str]:
        """Names of the tests of `make check`, as coverage spells them."""
        words = ["-m", "pytest", "-q", "-n", "0", "--collect-only", "-m", _UNMARKED]
        listed = self._python(self.root, words, None).stdout
        return frozenset(line.split("[")[0] for line in listed.splitlines() if "::" in line)

    def tests_of(self, mutant: JudgedMutant, line: int) -> list[str]:
        """Return the ids of tests that reach a mutant, in the order in which they run."""
        text, lines = self.text(mutant.file), self.reached.get(mutant.file, {})
        begin, end = _statement(text, line)
        tests = {test for number in range(begin, end + 1) for test in lines.get(number, ())}
        if not tests:  # a constant
            tests = {test for reached in lines.values() for test in reached}
        return sorted(tests, key=lambda test: (test not in self.unmarked, self._seconds[test], test))

    def judge(self, mutants: Sequence[JudgedMutant], jobs: int) -> Iterator[JudgedMutant]:
        """Yield mutants with their verdicts, several at a time, each in a copy of the checkout."""
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(jobs):
            copy = self.work / f"copy{number}"
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(self.root, copy, ignore=shutil.ignore_patterns(*_SKIPPED))
            copies.put(copy)
        assert self.unmarked  # computed here, by one thread
        assert self.reached
        with ThreadPoolExecutor(jobs) as pool:
            yield from pool.map(lambda one: self._judged(one, copies), mutants)

    def _judged(self, mutant: JudgedMutant, copies: SimpleQueue[Path]) -> JudgedMutant:
        text = self.text(mutant.file)
        place = mutant.place(text)
        if place is None:
            return replace(mutant, verdict="gone")
        tests = self.tests_of(mutant, place[0])
        if not tests:
            return replace(mutant, verdict="unreached")
        copy = copies.get()
        path, start = copy / mutant.file, place[1]
        try:
            path.write_text(text[:start] + mutant.new + text[start + len(mutant.old) :], "utf-8")
            by = self._failed(copy, tests[:_FIRST])
            if not by and len(tests) > _FIRST:
                by = self._failed(copy, tests[_FIRST:_TESTS_MAX])
        finally:
            path.write_text(text, "utf-8")
            copies.put(copy)
        verdict, left_out = ("caught" if by else "survived"), max(0, len(tests) - _TESTS_MAX)
        return replace(mutant, verdict=verdict, by=by, is_unmarked=by in self.unmarked, left_out=left_out)

    def _failed(self, copy: Path, tests: Sequence[str]) -> str:
        words = ["-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--no-header", *tests]
        try:
            ended = self._python(copy, words, _SECONDS)
        except subprocess.TimeoutExpired:
            return "time limit"
        if ended.returncode == 0:
            return ""
        failed = [line.split()[1] for line in ended.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        return failed[0].split("[")[0] if failed else "crash"

    def _python(self, folder: Path, words: Sequence[str], limit: float | None) -> Any:
        path = os.pathsep.join(str(folder / one) for one in _PATH)
        environment = {**os.environ, "PYTHONPATH": path, "CSPLAT_DATA": "absent"}
        command = [sys.executable, *words]
        return subprocess.run(command, cwd=folder, env=environment, timeout=limit, capture_output=True, text=True)  # noqa: PLW1510, S603


def save_reached(data: Any, report: Path, root: Path, saved: Path) -> None:
    """Write the tests that reach each line, and their seconds, as JSON, from coverage and a JUnit report."""
    names = {f"{path.relative_to(root).with_suffix('').as_posix().replace('/', '.')}": path.relative_to(root).as_posix()
             for path in (root / "tests").rglob("test_*.py")}  # fmt: skip
    names |= {name.rpartition(".")[2]: path for name, path in names.items()}

    def test(context: str) -> str:
        module, _, function = context.rpartition(".")
        return f"{names[module]}::{function}" if module in names else ""

    seconds: dict[str, float] = defaultdict(float)
    for case in ET.parse(report).getroot().iter("testcase"):  # noqa: S314 - written by our own run
        seconds[test(f"{case.get('classname')}.{case.get('name', '').split('[')[0]}")] += float(case.get("time", "0"))
    numbers: dict[str, int] = {}
    reached = {}
    for file in data.measured_files():
        if file.startswith(f"{root}/"):
            lines = {n: {test(one) for one in found} - {""} for n, found in data.contexts_by_lineno(file).items()}
            reached[file.removeprefix(f"{root}/")] = {
                n: sorted(numbers.setdefault(one, len(numbers)) for one in tests) for n, tests in lines.items() if tests
            }
    saved.write_text(json.dumps({"seconds": {one: seconds[one] for one in numbers}, "lines": reached}), "utf-8")


def read_mutants(path: Path) -> list[JudgedMutant]:
    """Read mutants, and their earlier verdicts."""
    return [JudgedMutant(**one) for one in json.loads(path.read_text("utf-8"))]


def write_mutants(path: Path, mutants: Sequence[JudgedMutant]) -> None:
    """Write mutants with their verdicts as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(one) for one in mutants], indent=1), "utf-8")


def _compiles(mutant: Mutant, text: str) -> bool:
    try:
        compile(mutant.apply(text), mutant.file, "exec", dont_inherit=True)
    except SyntaxError:
        return False
    return True


def _statement(text: str, line: int) -> tuple[int, int]:
    """Return the first and last line of the smallest statement, without its body, that contains a line."""
    best = (line, line)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or line):
            body = getattr(node, "body", None)
            end = body[0].lineno - 1 if isinstance(body, list) and body else node.end_lineno or line
            if line <= end:
                best = (node.lineno, end)
    return best
