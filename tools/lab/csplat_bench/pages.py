# SPDX-License-Identifier: Apache-2.0
"""Generated tables and plots of the documentation: data from `results/*.json`, layout from `results/tables.toml`.

A page holds a block for each table, and its lines are replaced:

    <!-- table: NAME -->
    <!-- end -->
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from csplat.disk_files import atomic_writer
from csplat_bench.tables import digest, draw_plot, markdown_table, select_rows

ROOT = Path(__file__).resolve().parents[3]
RESULTS = ROOT / "tools" / "lab" / "results"
#: Files that may hold tables.
PAGES = ("README.md", "tools/docs/guide/*.md", "tools/docs/results/*.md")

_BLOCK = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def write_pages(check: bool = False) -> list[str]:
    """Regenerate the tables of all pages, and all plots.

    Args:
        check: write nothing.

    Returns:
        The files that were rewritten or, with `check`, are stale, relative to the repository.

    Raises:
        ValueError: a page names an unknown table, or a table is left without rows.
    """
    declared = tomllib.loads((RESULTS / "tables.toml").read_text("utf-8"))
    stale = []
    for path in sorted(path for pattern in PAGES for path in ROOT.glob(pattern)):
        old = path.read_text("utf-8")
        new = with_tables(old, declared["tables"], RESULTS)
        if new != old:
            stale.append(path)
            if not check:
                _write(path, new.encode())
    for spec in declared["plots"].values():
        rows, path = select_rows(spec, RESULTS), ROOT / spec["file"]
        if not path.exists() or digest(spec, rows) not in path.read_text("utf-8"):
            stale.append(path)
            if not check:
                draw_plot(rows, spec, path)
    return [path.relative_to(ROOT).as_posix() for path in stale]


def with_tables(text: str, tables: Mapping[str, Any], folder: Path) -> str:
    """Return a page with its tables made anew.

    Args:
        text: Markdown.
        tables: declarations by name.
        folder: folder of the JSON files.
    """

    def block(match: re.Match[str]) -> str:
        begin, name, end = match.groups()
        if name not in tables:
            raise ValueError(f"table {name} is not declared in tables.toml")
        spec = tables[name]
        table = markdown_table(select_rows(spec, folder), spec["columns"], spec.get("labels"))
        return f"{begin}\n{table}\n\n{end}"

    return _BLOCK.sub(block, text)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(path) as stream:
        stream.write(data)
