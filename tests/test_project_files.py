"""Files that other programs read: workflows, hooks, attributes, metadata of packages."""

import importlib.util
import json
import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

import csplat

ROOT = Path(__file__).resolve().parent.parent
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PUBLISHING = ("npm publish ", "gh release create ")  # commands of a release after everything was built and tested


def make_targets():
    return set(re.findall(r"(?m)^([a-z][a-z-]*):", (ROOT / "Makefile").read_text("utf-8")))


def commands(text):
    """Return the commands of a workflow's steps; blocks of several lines are given as `|`."""
    return re.findall(r"(?m)^ *(?:- )?run: *(.+)$", text)


def problem(command, targets):
    """Return the problem of a step; nothing if it runs existing make targets, or publishes."""
    program, *words = command.split()
    if command.startswith(PUBLISHING):
        return ""
    if program == ".ci/run":
        program, words = "make", words or ["test"]
        if not os.access(ROOT / ".ci" / "run", os.X_OK):
            return f"{command}: not executable"
    if program != "make":
        return f"{command}: neither make nor .ci/run"
    unknown = [word for word in words if "=" not in word and word not in targets]
    return f"{command}: no such target" if unknown or not words else ""


def test_steps_of_workflows_run_targets_that_exist():
    targets = make_targets()
    steps = [(path.name, one) for path in WORKFLOWS for one in commands(path.read_text("utf-8"))]
    assert {"check.yml", "nightly.yml", "release.yml", "test.yml"} == {name for name, _ in steps}
    assert [] == [(name, said) for name, one in steps if (said := problem(one, targets))]


@pytest.mark.parametrize("command", ["make tset", "make", "|", "pip install csplat", ".ci/run tset"])
def test_a_step_that_runs_anything_else_is_reported(command):
    assert problem(command, make_targets())


def test_workflows_have_few_rights_and_a_time_limit():
    for path in WORKFLOWS:
        text = path.read_text("utf-8")
        jobs = text[text.index("\njobs:") :].count("    runs-on:")
        assert re.search(r"(?m)^permissions:( \{\}|\n  contents: read)$", text), path.name
        assert re.search(r"(?m)^concurrency:$", text), path.name
        assert jobs == text.count("    timeout-minutes:"), path.name
        assert text.count("actions/checkout@") == text.count("persist-credentials: false"), path.name
        assert "secrets." not in text, path.name
        for command in commands(text):
            assert "${{" not in command, f"{path.name}: {command}: hand it over by env"


def test_attributes_of_git_know_binary_files():
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout: git knows nothing of these files")
    listed = subprocess.run(["git", "ls-files", "--eol"], cwd=ROOT, capture_output=True, text=True, check=True).stdout  # noqa: S607
    wrong = []
    for line in listed.splitlines():
        facts, path = line.split("\t")
        content, _, attributes = facts.split(None, 2)
        is_text = "-text" not in attributes
        if (is_text and content not in ("i/lf", "i/none")) or (is_text and path.endswith((".csplat", ".ply"))):
            wrong.append(line)
    assert [] == wrong


def test_generated_files_that_attributes_name_exist():
    text = (ROOT / ".gitattributes").read_text("utf-8")
    patterns = re.findall(r"(?m)^(\S+) linguist-generated", text)
    assert len(patterns) > 5
    assert [] == [one for one in patterns if not any(ROOT.glob(one))]


@pytest.mark.parametrize(("page", "least"), [("ARCHITECTURE.md", 50), ("CONTRIBUTING.md", 20)])
def test_every_file_that_a_page_about_the_code_names_exists(page, least):
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout: git knows nothing of these files")
    text = (ROOT / page).read_text("utf-8")
    named = set(re.findall(r"`([\w./-]+\.(?:py|mjs|md|toml|c|h))`", text))
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)  # noqa: S607
    found = {name for path in listed.stdout.split() for name in named if f"/{path}".endswith(f"/{name}")}
    assert len(found) >= least
    assert [] == sorted(name for name in named - found if "NAME" not in name)


def prepare(root, *words):
    place = ROOT / "tools" / "release" / "prepare.py"
    spec = importlib.util.spec_from_file_location("prepare", place)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main(list(words), root)


@pytest.fixture
def copied(tmp_path):
    """The files that a release changes."""
    for name in ("pyproject.toml", "codec/js/package.json", "codec/csplat/__init__.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    return tmp_path


def test_a_release_names_its_own_repository(copied):
    before = tomllib.loads((copied / "pyproject.toml").read_text("utf-8"))
    tag = f"v{csplat.__version__}"
    for url in ("https://github.com/first/csplat", "https://github.com/second/csplat"):  # twice: links are replaced
        assert prepare(copied, "--tag", tag, "--url", url) == 0
        after = tomllib.loads((copied / "pyproject.toml").read_text("utf-8"))
        assert url == after["project"].pop("urls")["Homepage"]
        assert before == after
        package = json.loads((copied / "codec" / "js" / "package.json").read_text("utf-8"))
        assert {"type": "git", "url": f"git+{url}.git", "directory": "codec/js"} == package["repository"]


def test_a_release_refuses_a_tag_of_another_version_and_other_addresses(copied):
    text = (copied / "pyproject.toml").read_bytes()
    assert prepare(copied, "--tag", "v9.9.9", "--url", "https://github.com/owner/csplat") == 1
    with pytest.raises(SystemExit):
        prepare(copied, "--tag", "v0.1.0", "--url", "git@github.com:owner/csplat")
    assert text == (copied / "pyproject.toml").read_bytes()
