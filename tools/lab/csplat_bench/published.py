# SPDX-License-Identifier: Apache-2.0
"""Published figures: rows from the TOML files in `published`.

A file is a table of rows by scene or set, or a list `methods` of compact blocks:

    [[methods]]
    case = "HAC"                            # fields of all rows of the block
    fields = ["size_bytes", "psnr_mean"]    # fields that differ
    [methods.rows]
    synthetic-mic = [[1063256, 36.7093], [700763, 35.9192]]
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

#: Folder of published figures.
PUBLISHED = Path(__file__).resolve().parent.parent / "published"


def read_published(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a file; the field `scene` holds their key, SET-SCENE or SET.

    Raises:
        ValueError: a row of a block has more or fewer values than `fields`.
    """
    tables = tomllib.loads(path.read_text("utf-8"))
    methods = tables.pop("methods", [])
    rows = [{"scene": key, **row} for key, found in tables.items() for row in found]
    return rows + [row for method in methods for row in _block_rows(method)]


def _block_rows(method: dict[str, Any]) -> Iterator[dict[str, Any]]:
    shared = {name: value for name, value in method.items() if name not in ("fields", "rows")}
    for key, found in method["rows"].items():
        for values in found:
            yield {"scene": key, **shared, **dict(zip(method["fields"], values, strict=True))}
