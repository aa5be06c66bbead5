# SPDX-License-Identifier: Apache-2.0
"""Build the documentation site: collect its pages from the repository, then run MkDocs.

A page is a Markdown file of the repository or generated. Links between files become links between pages, so any site
generator that supports mkdocstrings can build the result.

Usage:
    python tools/docs/make_site.py            # writes out/site; the collected pages are in out/docs
"""

from __future__ import annotations

import os
import posixpath
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("tools/docs/guide", "tools/docs/results")  # every file in them is a page
CONFIGURATION = ROOT / "tools" / "docs" / "mkdocs.yml"
COLLECTED, SITE = ROOT / "out" / "docs", ROOT / "out" / "site"  # as in mkdocs.yml

#: Pages elsewhere in the repository.
SOURCES = {
    "index.md": "README.md",
    "embedding.md": "codec/EMBEDDING.md",
    "implementers.md": "conformance/IMPLEMENTERS.md",
    "hardening.md": "conformance/HARDENING.md",
    "javascript.md": "codec/js/README.md",
    "c.md": "codec/c/README.md",
    "format.md": "spec/format.md",
    "encoders.md": "spec/encoders.md",
    "example.md": "spec/example.md",
    "versions.md": "spec/VERSIONS.md",
    "media-type.md": "spec/media-type.md",
    "gltf.md": "spec/gltf.md",
    "gltf-assets.md": "conformance/gltf/README.md",
    "conformance.md": "conformance/README.md",
    "clauses.md": "conformance/CLAUSES.md",
    "interface.md": "API.md",
    "security.md": "SECURITY.md",
    "architecture.md": "ARCHITECTURE.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
#: Packages whose `__all__` is the Python interface.
PACKAGES = ("csplat", "csplat_tools", "csplat_render", "csplat_trainer")
_DOCSTRING_ALONE = "{members: false, show_root_heading: false, show_root_toc_entry: false}"
_PICTURES = {".svg", ".png", ".webp"}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
_COMMENT = re.compile(r"^<!--.*?-->\n", re.MULTILINE)
_WORDS = re.compile(r"^(`{3,}\w+) .+$", re.MULTILINE)
_FENCE = re.compile(r"^\s*(`{3,}|~{3,})")
_ITEM = re.compile(r"^(?:[-*]|\d+\.) ")
_BLOCK = re.compile(r"(?ms)^ *(`{3,}).*?^ *\1$")
_COLUMNS = "80"


def pages() -> dict[str, str]:
    """Return the path in the repository of each page that is a file."""
    own = {path.name: f"{folder}/{path.name}" for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.md"))}
    return own | SOURCES


def links(text: str) -> Iterator[re.Match[str]]:
    """Yield the links and images of a Markdown text, except those inside code."""
    code = [match.span() for match in re.finditer(r"(?ms)^(`{3,}).*?^\1|`[^`\n]+`", text)]
    for match in _LINK.finditer(text):
        target = match.start(3)
        if not any(start <= target < end for start, end in code):
            yield match


def target_of(source: str, link: str) -> tuple[str, str]:
    """Resolve a link in a file of the repository to a path in the repository and an anchor.

    Raises:
        FileNotFoundError: the file does not exist.
    """
    path, _, place = link.partition("#")
    found = posixpath.normpath(posixpath.join(posixpath.dirname(source), path)) if path else source
    if not (ROOT / found).exists():
        raise FileNotFoundError(f"{source}: {link} leads nowhere")
    return found, place


def rewritten(text: str, source: str, on_picture: Callable[[str], object] | None = None) -> str:
    """Return a text with its links replaced by those of the site.

    Links to files that are not pages become plain text, because the site does not know the repository's address.

    Args:
        text: Markdown.
        source: its path in the repository.
        on_picture: called with the path of each image in the repository.
    """
    page_of = {path: page for page, path in pages().items()}

    def one(match: re.Match[str]) -> str:
        mark, words, link = match.groups()
        if "://" in link or link.startswith("mailto:"):
            return match[0]
        path, place = target_of(source, link)
        if Path(path).suffix in _PICTURES:
            if on_picture is not None:
                on_picture(path)
            return f"{mark}[{words}](pictures/{Path(path).name})"
        if path in page_of:
            return f"{mark}[{words}]({page_of[path]}{'#' * bool(place)}{place})"
        return words if "`" in words or path != link.rstrip("/") else f"`{words}`"

    parts, last = [], 0
    for match in links(text):
        parts += [text[last : match.start()], one(match)]
        last = match.end()
    return "".join([*parts, text[last:]])


def collect(folder: Path) -> None:
    """Empty a folder and write all pages, their images and the style sheet into it."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "pictures").mkdir(parents=True)
    pictures: set[str] = set()
    for page, source in pages().items():
        text = rewritten((ROOT / source).read_text("utf-8"), source, pictures.add)
        (folder / page).write_text(for_python_markdown(text), "utf-8")
    for path in pictures:
        shutil.copy(ROOT / path, folder / "pictures")
    (folder / "commands.md").write_text(commands(), "utf-8")
    (folder / "python.md").write_text(python(), "utf-8")
    shutil.copy(CONFIGURATION.with_name("site.css"), folder)


def commands() -> str:
    """Return the reference of the command line, made of the commands' own help."""
    from typer.main import get_command

    from csplat_tools.cli.app import app

    group: Any = get_command(app)
    parts = ["# Commands\n\nThe output of `--help-all` of each command.\n"]
    parts += [f"## csplat {name}\n\n```text\n{_help(name)}\n```\n" for name in group.list_commands(None)]
    return "\n".join(parts)


def python() -> str:
    """Return the reference of the Python interface: directives for mkdocstrings, which reads the docstrings."""
    parts = ["# Python\n"]
    for package in PACKAGES:
        module = import_module(package)
        parts += [f"## {package}\n\n::: {package}\n    options: {_DOCSTRING_ALONE}\n"]
        for name in sorted(getattr(module, "__all__", ()), key=lambda name: (name[0].isupper(), name)):
            one = getattr(module, name)
            if callable(one) and hasattr(one, "__qualname__"):
                options = f"{{heading: {package}.{name}, toc_label: {name}}}"
                parts += [f"::: {one.__module__}.{one.__qualname__}\n    options: {options}\n"]
    return "\n".join(parts)


def _help(name: str) -> str:
    words = [sys.executable, "-m", "csplat_tools", name, "--help-all"]
    found = subprocess.run(words, capture_output=True, text=True, env=_environment(), check=False)
    if found.returncode:  # groups of commands lack --help-all
        words[-1] = "--help"
        found = subprocess.run(words, capture_output=True, text=True, env=_environment(), check=True)
    lines = [line.rstrip() for line in found.stdout.splitlines()]
    return "\n".join(lines).strip("\n")


def _environment() -> dict[str, str]:
    return {**os.environ, "COLUMNS": _COLUMNS, "NO_COLOR": "1", "TERM": "dumb", "PYTHONIOENCODING": "utf-8"}


def for_python_markdown(text: str) -> str:
    """Convert GitHub's Markdown to Python-Markdown's.

    Comments go, because Python-Markdown reads the lines after one as HTML. A code block keeps only the language of its
    info string. A list gets an empty line before it.
    """
    text = _WORDS.sub(r"\1", _COMMENT.sub("", text))
    lines: list[str] = []
    fence = ""
    for line in text.split("\n"):
        mark = _FENCE.match(line)
        if mark and (not fence or line.strip() == fence):
            fence = "" if fence else mark[1]
        before = lines[-1] if lines else ""
        if not fence and _ITEM.match(line) and before.strip() and not _ITEM.match(before) and before[0] not in " |":
            lines.append("")
        lines.append(line)
    return "\n".join(lines)


def main() -> int:
    """Collect the pages and run MkDocs; its warnings are errors."""
    collect(COLLECTED)
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", str(CONFIGURATION)]
    status = subprocess.run(words, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False).returncode
    lost = [page for page in pages() if not status and _is_cut(page)]
    for page in lost:
        print(f"{page}: headings, tables or code blocks are missing on the site")
    return status or bool(lost)


def _is_cut(page: str) -> bool:
    """Return True if headings, tables or code blocks were lost: Python-Markdown parses less than GitHub."""
    text = (COLLECTED / page).read_text("utf-8")
    html = (SITE / page).with_suffix(".html").read_text("utf-8").partition("md-content__inner")[2]
    blocks = len(_BLOCK.findall(text))
    prose = _BLOCK.sub("", text)
    headings, tables = (len(re.findall(one, prose, re.MULTILINE)) for one in (r"^#{1,6} ", r"^\|[ :|-]+\|$"))
    found = len(re.findall(r"<h[1-6] id=", html)), html.count("<table>"), html.count("<pre>")
    return found != (headings, tables, blocks)


if __name__ == "__main__":
    sys.exit(main())
