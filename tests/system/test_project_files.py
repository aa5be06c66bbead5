# SPDX-License-Identifier: Apache-2.0
"""Files that other programs read: attributes, metadata of packages."""

import json
import re
import runpy
import subprocess
import tomllib
from pathlib import Path

import pytest

import csplat

ROOT = Path(__file__).resolve().parents[2]
SOURCE_ENDINGS = "c cc cpp css h html mjs py sh ts wgsl"
in_a_checkout = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a checkout: git knows nothing of it")


def listed(*words):
    words = ["git", "ls-files", *words]
    return subprocess.check_output(words, cwd=ROOT, text=True).splitlines()


@pytest.mark.slow
@in_a_checkout
def test_attributes_of_git_know_binary_files():
    texts = [line for line in listed("--eol") if "-text" not in line.split("\t")[0]]
    assert [] == [one for one in texts if not one.startswith(("i/lf", "i/none")) or one.endswith((".csplat", ".ply"))]


@pytest.mark.slow
@in_a_checkout
@pytest.mark.parametrize(("page", "least"), [("ARCHITECTURE.md", 50), ("CONTRIBUTING.md", 20)])
def test_every_file_that_a_page_about_the_code_names_exists(page, least):
    named = set(re.findall(r"`([\w./-]+\.(?:py|mjs|md|toml|c|h))`", (ROOT / page).read_text("utf-8")))
    found = {name for path in listed() for name in named if f"/{path}".endswith(f"/{name}")}
    assert len(found) >= least
    assert [] == sorted(name for name in named - found if "NAME" not in name)


@in_a_checkout
def test_each_source_file_begins_with_the_licence_of_its_folder():
    def licence(path):
        text = next(one for folder in path.parents if (one := ROOT / folder / "LICENSE").exists()).read_text("utf-8")
        return "CC0-1.0" if text.startswith("Creative Commons Legal Code\n\nCC0 1.0") else "Apache-2.0"

    paths = [Path(path) for path in listed(*(f"*.{ending}" for ending in SOURCE_ENDINGS.split()), ".ci/run")]
    assert len(paths) > 700
    for path in paths:
        first_lines = (ROOT / path).read_text("utf-8").split("\n")[:2]  # the first may be a shebang or a doctype
        assert any(f"SPDX-License-Identifier: {licence(path)}" in line for line in first_lines), path


@in_a_checkout
def test_each_module_has_a_file_of_tests_or_is_named_in_the_head_of_another():
    heads = [(ROOT / path).read_text("utf-8").partition("import ")[0] for path in listed("tests/**/test_*.py")]
    named = set(re.findall(r"csplat[\w.]*\w", "\n".join(heads)))
    roots = ("codec/csplat", "trainer", "tools/csplat_tools", "conformance/csplat_conformance")
    modules = [Path(path) for path in listed(*(f"{root}/**/*.py" for root in roots), "codec/csplat/*.py")]
    inside = [Path(*path.parts[1:]) for path in modules if not path.stem.startswith("_")]
    assert len(inside) > 200
    untested = [path for path in inside if not (ROOT / "tests" / path.with_name(f"test_{path.name}")).exists()]
    assert [] == [path for path in untested if ".".join(path.with_suffix("").parts) not in named]


def test_a_release_names_its_own_repository_and_refuses_another_version(tmp_path):
    def prepared(tag, url):
        return runpy.run_path(ROOT / "tools" / "release" / "prepare.py")["main"](["--tag", tag, "--url", url], tmp_path)

    packages = ("codec/js", "codec/js-encoder")
    names = (f"{folder}/package.json" for folder in packages)
    for name in ("CITATION.cff", "pyproject.toml", "codec/csplat/__init__.py", *names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    project = tmp_path / "pyproject.toml"
    for heading in ("[Unreleased]", f"[{csplat.__version__}]"):  # a citation needs the date
        (tmp_path / "CHANGELOG.md").write_text(f"## {heading}\n", "utf-8")
        assert 1 == prepared(f"v{csplat.__version__}", "https://github.com/owner/csplat")
    (tmp_path / "CHANGELOG.md").write_text(f"## [{csplat.__version__}] - 2027-01-01\n", "utf-8")
    text, before = project.read_bytes(), tomllib.loads(project.read_text("utf-8"))
    assert 1 == prepared("v9.9.9", "https://github.com/owner/csplat")
    with pytest.raises(SystemExit):
        prepared("v1.0.0", "git@github.com:owner/csplat")
    assert text == project.read_bytes()
    for url in ("https://github.com/first/csplat", "https://github.com/second/csplat"):  # twice: links are replaced
        assert 0 == prepared(f"v{csplat.__version__}", url)
        after = tomllib.loads(project.read_text("utf-8"))
        assert url == after["project"].pop("urls")["Homepage"]
        shown = readme_of_the_package(after)
        assert f"]({url}/blob/v{csplat.__version__}/spec/format.md)" in shown
        assert [] == re.findall(r"\]\((?!https://)[^)]*\)", shown)
        after["tool"]["hatch"]["metadata"] = before["tool"]["hatch"]["metadata"]
        assert before == after
        for folder in packages:
            package = json.loads((tmp_path / folder / "package.json").read_text("utf-8"))
            assert {"type": "git", "url": f"git+{url}.git", "directory": folder} == package["repository"]
        citation = (tmp_path / "CITATION.cff").read_text("utf-8")
        written = f"repository-code: {url}\ndate-released: 2027-01-01\n"
        assert (ROOT / "CITATION.cff").read_text("utf-8") + written == citation


def readme_of_the_package(project):
    """Return README.md as the metadata of the package have it."""
    text = (ROOT / "README.md").read_text("utf-8")
    for one in project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text, count = re.subn(one["pattern"], one["replacement"], text)
        assert count, one
    return text


def test_the_readme_of_the_package_needs_no_checkout():
    shown = readme_of_the_package(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8")))
    for words in (
        'pip install "csplat[render]"',
        "PLY files are read with plyfile",
        "csplat encode scene.ply",
        "## Licence",
    ):
        assert words in shown
    assert [] == re.findall(r"!\[|\]\((?!https://)|make demo|CSPLAT_NATIVE", shown)
