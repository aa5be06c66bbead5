# SPDX-License-Identifier: Apache-2.0
"""Prepare the packages of a release: check tag and changelog, and write address and date into metadata.

The project names no home of its own, so a release takes it from where it is made. `make dist TAG=v1.0.0 URL=https://…`
calls this before it builds. npm accepts a provenance only if `repository` in package.json is where it was built.

    python tools/release/prepare.py --tag v1.0.0 --url https://github.com/OWNER/NAME
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
_PACKAGES = ("codec/js", "codec/js-encoder")  # of npm


def main(words: list[str] | None = None, root: Path = ROOT) -> int:
    """Change pyproject.toml, both package.json and CITATION.cff; status 1: tag or changelog have another version."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tag", required=True, help="`v` and the version")
    parser.add_argument("--url", required=True, help="of the repository, https")
    args = parser.parse_args(words)
    if not re.fullmatch(r"https://[\w.-]+(/[\w.-]+)+", args.url):
        parser.error(f"--url is {args.url!r}, expected https://HOST/OWNER/NAME")
    project = root / "pyproject.toml"
    text = project.read_text("utf-8")
    version = re.findall(r'(?m)^__version__ = "(.+)"$', (root / "codec/csplat/__init__.py").read_text("utf-8"))[0]
    if args.tag != f"v{version}":
        sys.stderr.write(f"error: the tag is {args.tag}, expected v{version}, as codec/csplat/__init__.py states\n")
        return 1
    dates = re.findall(
        rf"(?m)^## \[{re.escape(version)}\] - (\d{{4}}-\d\d-\d\d)$", (root / "CHANGELOG.md").read_text("utf-8")
    )
    if not dates:
        sys.stderr.write(f"error: CHANGELOG.md has no section [{version}] - YEAR-MONTH-DAY\n")
        return 1
    citation = root / "CITATION.cff"
    citation.write_text(with_release(citation.read_text("utf-8"), args.url, dates[0]), "utf-8", newline="\n")
    project.write_text(with_links(with_urls(text, args.url), f"{args.url}/blob/{args.tag}"), "utf-8", newline="\n")
    for folder in _PACKAGES:
        package = root / folder / "package.json"
        metadata = json.loads(package.read_text("utf-8")) | {
            "homepage": args.url,
            "repository": {"type": "git", "url": f"git+{args.url}.git", "directory": folder},
        }
        package.write_text(json.dumps(metadata, indent=2, ensure_ascii=False) + "\n", "utf-8", newline="\n")
    return 0


def with_urls(text: str, url: str) -> str:
    """Return a pyproject.toml with the links that a package index shows; links that are there are replaced.

    Args:
        text: the file.
        url: address of the repository.
    """
    links = {
        "Homepage": url,
        "Issues": f"{url}/issues",
        "Changelog": f"{url}/blob/main/CHANGELOG.md",
    }
    table = "[project.urls]\n" + "".join(f'{name} = "{link}"\n' for name, link in links.items()) + "\n"
    text = re.sub(r"(?ms)^\[project\.urls\]\n.*?(?=^\[)", "", text)
    changed, count = re.subn(r"(?m)^(?=\[project\.optional-dependencies\]$)", lambda _: table, text)
    assert count == 1, "pyproject.toml has no [project.optional-dependencies] to stand before"
    return changed


def with_links(text: str, base: str) -> str:
    """Return a pyproject.toml by which relative links of the README, as a package index shows it, lead to a repository.

    Args:
        text: the file.
        base: address of the files of the release.
    """
    changed, count = re.subn(r"(?<=replacement = )'[^']*'", lambda _: rf"'[\1]({base}/\2)'", text)
    assert count == 1, "pyproject.toml has no substitution for the links of the README"
    return changed


def with_release(text: str, url: str, date: str) -> str:
    """Return a CITATION.cff with the repository and the date of a release; those that are there are replaced.

    Args:
        text: the file; `make spec` writes its version.
        url: address of the repository.
        date: of the release, YYYY-MM-DD.
    """
    kept = re.sub(r"(?m)^(repository-code|date-released): .*\n", "", text)
    return f"{kept}repository-code: {url}\ndate-released: {date}\n"


if __name__ == "__main__":
    sys.exit(main())
