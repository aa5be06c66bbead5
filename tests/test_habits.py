"""Habits of the code base: no patched private parts, reasons for skips, areas of tests, language."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import areas
import pytest

TESTS = Path(__file__).resolve().parent

#: Words in the text of a file that replaces something private: no other file is parsed, which takes a while.
REPLACES = re.compile(
    r"""(?:setattr|delattr|patch|object)\b(?s:.{0,200}?)["'](?:[\w.]*\.)?_\w+["']|(?<!self)(?<!cls)\._\w+ *[-+*/|]?= """
)

#: Calls that skip, or expect a failure; all but the first take the reason as an argument of its place.
CALLS = ("pytest.importorskip", "pytest.skip", "pytest.xfail")

#: Skips and expected failures in the text of a file, and the ones that obviously have a reason.
SKIPS = re.compile(r"pytest\.(?:mark\.)?(?:importorskip|skip|skipif|xfail)\b")
EXPLAINED = re.compile(
    r"""pytest\.(?:importorskip|mark\.skipif)\([^()]*?\breason=f?["'][^"']|pytest\.(?:skip|xfail)\((?!\)|""|'')"""
)


@pytest.fixture(scope="module")
def texts():
    """Each Python file of the tests, by its name."""
    return {path.name: path.read_text("utf-8") for path in sorted(TESTS.rglob("*.py"))}


def may_replace(text):
    """Return whether a file has to be parsed to know whether it replaces something private."""
    return REPLACES.search(text) is not None


def may_skip(text):
    """Return whether a file has to be parsed to know whether all of its skips carry a reason."""
    return len(SKIPS.findall(text)) > len(EXPLAINED.findall(text))


def nodes_of(text):
    """Return calls, decorators, imports and assignments of a file."""
    kinds = (ast.Call, ast.FunctionDef, ast.Import, ast.ImportFrom, ast.Assign, ast.AugAssign, ast.AnnAssign)
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)]


def name_of(node):
    """Return the dotted name of an expression, as `os.path`; an empty string for anything else."""
    if isinstance(node, ast.Attribute):
        base = name_of(node.value)
        return f"{base}.{node.attr}" if base else ""
    return node.id if isinstance(node, ast.Name) else ""


def imported(nodes):
    """Return the names that a file binds to modules, classes and functions of others."""
    found = set()
    for node in nodes:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            found |= {(one.asname or one.name).partition(".")[0] for one in node.names}
        elif isinstance(node, ast.Assign) and is_module(node.value):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return found


def is_module(node):
    """Return whether an expression looks a module up: `sys.modules[...]` or `import_module(...)`."""
    if isinstance(node, ast.Subscript):
        return name_of(node.value).endswith("sys.modules")
    return isinstance(node, ast.Call) and name_of(node.func).rpartition(".")[2] in ("import_module", "__import__")


def is_private(name):
    return name.startswith("_") and not name.endswith("__")


def replaced(nodes):
    """Yield the line and the name of each private attribute of a module or class that a file replaces."""
    known = imported(nodes)

    def is_foreign(node):
        return is_module(node) or name_of(node).partition(".")[0] in known

    for node in nodes:
        if isinstance(node, ast.Call):
            function = name_of(node.func).rpartition(".")
            text = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else None
            if function[2] in ("setattr", "delattr", "patch") and isinstance(text, str):
                if is_private(text.rpartition(".")[2]):
                    yield node.lineno, text
            elif function[2] in ("setattr", "delattr", "object") and len(node.args) > 1 and is_foreign(node.args[0]):
                name = node.args[1].value if isinstance(node.args[1], ast.Constant) else ""
                if is_private(str(name)):
                    yield node.lineno, f"{ast.unparse(node.args[0])}.{name}"
        elif isinstance(node, (ast.Assign, ast.AugAssign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                if isinstance(target, ast.Attribute) and is_private(target.attr) and is_foreign(target.value):
                    yield node.lineno, ast.unparse(target)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("import a\nmonkeypatch.setattr(a, '_SIZE', 1)", ["a._SIZE"]),
        ("from a import b as c\npatch.setattr(c.Thing, '_draw', f)", ["c.Thing._draw"]),
        ("monkeypatch.setattr('a.b._SIZE', 1)", ["a.b._SIZE"]),
        ("monkeypatch.setattr(\n    sys.modules[name],\n    '_SIZE', 1)", ["sys.modules[name]._SIZE"]),
        ("module = importlib.import_module(name)\nmodule._SIZE = 1", ["module._SIZE"]),
        ("mock.patch('a._f')\nimport a\nmock.patch.object(a, '_f')", ["a._f", "a._f"]),
        ("import a\nmonkeypatch.setattr(a, 'SIZE', 1)\nmonkeypatch.setattr('a.f', g)", []),
        ("import sys\nmonkeypatch.setattr(sys, '__stdin__', f)", []),
        ("double = Double()\ndouble._state = 1\nmonkeypatch.setattr(double, '_state', 2)", []),
    ],
)
def test_what_is_private_is_found_in_all_ways_of_replacing_it(text, names):
    assert names == [name for _, name in replaced(nodes_of(text))]
    assert may_replace(text) or not names


def test_no_test_replaces_what_is_private_to_a_module(texts):
    trees = {file: nodes_of(text) for file, text in texts.items() if may_replace(text)}
    found = [f"{file}:{line}: {name}" for file, nodes in trees.items() for line, name in replaced(nodes)]
    assert not found, "\n".join(["make it a parameter, a field or a fixture:", *found])


def unexplained(nodes):
    """Yield the line and the name of each skip and expected failure without a reason."""
    marks = [f"pytest.mark.{name}" for name in ("skip", "skipif", "xfail")]
    for node in nodes:
        if isinstance(node, ast.FunctionDef):
            yield from ((node.lineno, name_of(one)) for one in node.decorator_list if name_of(one) in marks)
        elif isinstance(node, ast.Call) and name_of(node.func) in (*marks, *CALLS):
            reasons = [one.value for one in node.keywords if one.arg == "reason"]
            if name_of(node.func) in CALLS[1:]:
                reasons += node.args
            if not any(not isinstance(one, ast.Constant) or one.value for one in reasons):
                yield node.lineno, name_of(node.func)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("@pytest.mark.skip\ndef f(): pass", 1),
        ("@pytest.mark.skipif(True, reason='no such thing here')\ndef f(): pass", 0),
        ("@pytest.mark.xfail(reason='')\ndef f(): pass", 1),
        ("pytest.importorskip('numba')\npytest.skip()", 2),
        ("pytest.importorskip('numba', reason='it renders')\npytest.skip(f'{name} is absent')", 0),
    ],
)
def test_skips_without_a_reason_are_found(text, count):
    assert count == len(list(unexplained(nodes_of(text))))
    assert may_skip(text) or not count


def test_every_skip_and_expected_failure_carries_its_reason(texts):
    trees = {file: nodes_of(text) for file, text in texts.items() if may_skip(text)}
    found = [f"{file}:{line}: {name}" for file, nodes in trees.items() for line, name in unexplained(nodes)]
    assert not found, "\n".join(found)


@pytest.fixture
def project(tmp_path):
    """A project of one source in one area, recorded."""
    file = tmp_path / "areas.toml"
    file.write_text('# why\n[engines]\nguards = "drawing"\nsources = ["*.mjs"]\nhash = ""\n', encoding="utf-8")
    (tmp_path / "loader.mjs").write_text("draw();\n", encoding="utf-8")
    assert ["engines"] == areas.record(["engines"], file, tmp_path)
    return file, tmp_path


def test_an_area_runs_again_after_an_edit_of_its_sources(project):
    file, root = project
    assert "not area" == areas.expression(areas.load(file), root=root)
    (root / "loader.mjs").write_text("draw(1);\n", encoding="utf-8")
    assert "not area or area(name='engines')" == areas.expression(areas.load(file), root=root)


def test_a_new_file_and_another_name_are_edits(project):
    file, root = project
    (root / "loader.mjs").rename(root / "other.mjs")
    assert areas.load(file)[0].is_changed(root)


def test_line_ends_are_no_edit(project):
    file, root = project
    (root / "loader.mjs").write_bytes(b"draw();\r\n")
    assert not areas.load(file)[0].is_changed(root)


def test_recording_keeps_what_else_the_file_holds(project):
    file, root = project
    assert [] == areas.record(["engines"], file, root)
    assert file.read_text(encoding="utf-8").startswith('# why\n[engines]\nguards = "drawing"')


def test_a_pattern_without_files_is_an_error(project):
    file, root = project
    (root / "loader.mjs").unlink()
    with pytest.raises(ValueError, match=r"\*\.mjs matches no file"):
        areas.load(file)[0].digest(root)


def test_fast_tests_are_neither_slow_nor_of_an_area_and_want_no_shared_scenes():
    assert "not slow and not area and not shared_data" == areas.expression([], fast=True)


def test_markers_and_file_name_the_same_areas():
    texts = [path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py")]
    used = {name for text in texts for name in re.findall(r'mark\.area\(name="(\w+)"\)', text)}
    assert used == {area.name for area in areas.load()}


ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("codec", "trainer", "tools", "conformance", "tests", "spec")

#: Phrases that the project's prose avoids, and what to write instead. Words in quotation marks, such as JSON keys, are
#: exempt.
BANNED = {
    r'^\s*r?"""(?:What|Who|Whom|Whose|Whether|Which|Where|Of|How|Why|When)\b': "a verb in the imperative",
    r"# (?:of|as of|those) ": "a whole phrase: unit, meaning, reason",
    r"\bso many\b|\bso much\b|\bas many as\b|\bas much as\b": "N, at most N",
    r'(?<!["\w])[Bb]eside\b(?!")': "next to, compared with, in addition to",
    r"\b(?:is|are) told\b": "is called with",
    r"\b(?:teach|teaches|taught)\b": "training views",
    r"(?<!people )(?<!users )\b[Ww]ho\b": "a noun, except for people",
    r"\bsays\b": "specifies, reports",
    r"\bstands\b": "is in",
    r"\bwants\b": "requires",
}
PAGES = ("*.md", ".github/*.md", "conformance/*.md", "codec/*.md", "codec/*/*.md", "tools/docs/*/*.md", "spec/*.md")


@pytest.fixture(scope="module")
def prose():
    """Return the text of each Python file and page of the project, by its path."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if "node_modules" not in path.parts]
    paths += [path for pattern in PAGES for path in ROOT.glob(pattern)]
    texts = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}
    return {path: text for path, text in texts.items() if path != "tests/test_habits.py"}


def test_prose_avoids_banned_phrases(prose):
    found = [
        f"{path}:{text.count(chr(10), 0, match.start()) + 1}: {match[0].strip()!r}: write {instead}"
        for pattern, instead in BANNED.items()
        for path, text in prose.items()
        for match in re.finditer(pattern, text, re.MULTILINE)
    ]
    assert not found, "\n".join(found)
