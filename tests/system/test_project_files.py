"""Files that other programs read: attributes, metadata of packages."""

import importlib.util
import json
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

import csplat

ROOT = Path(__file__).resolve().parents[2]
in_a_checkout = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a checkout: git knows nothing of it")


def listed(*words):
    words = ["git", "ls-files", *words]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.mark.slow
@in_a_checkout
def test_attributes_of_git_know_binary_files():
    wrong = []
    for line in listed("--eol"):
        facts, path = line.split("\t")
        content, _, attributes = facts.split(None, 2)
        is_text = "-text" not in attributes
        if (is_text and content not in ("i/lf", "i/none")) or (is_text and path.endswith((".csplat", ".ply"))):
            wrong.append(line)
    assert [] == wrong


@pytest.mark.slow
@in_a_checkout
@pytest.mark.parametrize(("page", "least"), [("ARCHITECTURE.md", 50), ("CONTRIBUTING.md", 20)])
def test_every_file_that_a_page_about_the_code_names_exists(page, least):
    named = set(re.findall(r"`([\w./-]+\.(?:py|mjs|md|toml|c|h))`", (ROOT / page).read_text("utf-8")))
    found = {name for path in listed() for name in named if f"/{path}".endswith(f"/{name}")}
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
