"""Output of benchmarks: tables for a terminal or a document, the machine's description, JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.disk_files import atomic_writer
from csplat_tools.console import format_table, note
from csplat_tools.optional_packages import describe_machine

#: The machine that figures were taken on: descriptions by name.
Machine = dict[str, str]


def table(header: Sequence[str], rows: Iterable[Sequence[object]], *, markdown: bool = False) -> str:
    """Lay out a table; nothing if it has no rows."""
    lines = [[str(cell) for cell in row] for row in rows]
    if not lines:
        return ""
    if not markdown:
        return format_table(header, lines)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, ["---"] * len(header), *lines))


@dataclass(frozen=True)
class Table:
    """A table that is not laid out yet, and what stands above it."""

    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    title: str = ""


def laid_out(parts: Iterable[Table | str], *, markdown: bool) -> str:
    """Lay out tables and texts, one below the other; those without rows, and empty texts, are left out."""
    found = []
    for part in parts:
        if isinstance(part, str):
            found.append(part)
        elif part.rows:
            found += [part.title, table(part.header, part.rows, markdown=markdown)]
    return "\n\n".join(text for text in found if text)


def optional(value: float | None, say: str | Callable[[float], str], none: str = "-") -> str:
    """A figure in this format, or what stands for one that was not measured."""
    if value is None:
        return none
    return format(value, say) if isinstance(say, str) else say(value)


def describe() -> Machine:
    """Describe processor, system, and the versions of packages."""
    found = describe_machine(None)
    packages = {"csplat": found["csplat"], **found["packages"]}
    return {
        "machine": f"{found['processor']}, {found['cores']} cores, {_memory()}",
        "system": f"{found['system']}, Python {found['python']}",
        "packages": ", ".join(f"{name} {version}" for name, version in packages.items()),
    }


def tell_machine(**more: str) -> Machine:
    """Describe the machine, on standard error as well."""
    machine = {**describe(), **more}
    for name, text in machine.items():
        note(f"{name}: {text}")
    return machine


def machines(found: Iterable[Machine]) -> str:
    """The machines that results were measured on, each once."""
    each = sorted({tuple(one.items()) for one in found})
    return "\n\n".join("\n".join(f"{name}: {text}" for name, text in one) for one in each)


def write_json(path: Path, document: Any) -> None:
    """Replace a file, in a folder that is made for it. NaN and infinities do not occur in it: JSON has none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(path) as stream:
        stream.write((json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.0f} GiB"
    except (ValueError, OSError, AttributeError):
        return "memory unknown"
