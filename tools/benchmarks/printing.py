"""Tables as text for a terminal, or as Markdown for a guide."""

from __future__ import annotations

from collections.abc import Sequence

from csplat_tools.files.console import format_table

__all__ = ["laid_out"]


def laid_out(header: Sequence[str], rows: Sequence[Sequence[str]], *, markdown: bool) -> str:
    """Lay out a table; nothing where it has no rows."""
    if not rows:
        return ""
    if not markdown:
        return format_table(header, rows)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, ["---"] * len(header), *rows))
