"""`index.html`: the report of a batch as one page that opens from a disk and loads nothing else."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from contextlib import suppress
from html import escape
from pathlib import Path

from csplat_tools.batches.records import JOURNAL, Record
from csplat_tools.batches.scene import THUMBNAILS
from csplat_tools.batches.thumbnails import THUMBNAIL_SIZE
from csplat_tools.files.console import format_bytes, format_seconds
from csplat_tools.files.streams import write_bytes
from csplat_tools.pages.parts import definitions, document, table

PAGE = "index.html"
_PICTURES_MAX = 1000  # thumbnails on the page, 4 kB each
_HEADS = ("scene", "splats", "source, kB", "output, kB", "share, %", "bytes per splat", "seconds", "memory, MB")


def write_page(records: Sequence[Record], folder: Path) -> None:
    """Write the page of a folder of outputs.

    Raises:
        OSError: it cannot be written.
    """
    write_bytes(str(folder / PAGE), make_page(records, folder).encode())


def make_page(records: Sequence[Record], folder: Path) -> str:
    """Return the page: totals, scenes that failed, and a table of all scenes that are done, with thumbnails."""
    done = [one for one in records if one.state == "done"]
    title = f"{folder.resolve().name}: {len(records):,} scenes"
    return document(
        title, [f"<h1>{escape(title)}</h1>", _totals(records, done), _failures(records), _scenes(done, folder)]
    )


def _totals(records: Sequence[Record], done: Sequence[Record]) -> str:
    source, output = (sum(getattr(one, name) or 0 for one in done) for name in ("source_bytes", "output_bytes"))
    seconds = sum(one.seconds or 0.0 for one in done)
    commands = sorted({" ".join(("csplat", *one.command)) for one in records})
    entries = {
        "done": f"{len(done):,} of {len(records):,}",
        "command": "; ".join(commands[:3]) + ("; ..." if len(commands) > 3 else ""),
        "splats": f"{sum(one.splats or 0 for one in done):,}",
        "bytes": f"{format_bytes(source)} -> {format_bytes(output)}" + (f", {output / source:.1%}" if source else ""),
        "work": f"{format_seconds(seconds)}, of all processes together",
        "most memory of one": format_bytes(max((one.memory_bytes or 0 for one in done), default=0)),
        "version": ", ".join(sorted({one.version for one in records})),
    }
    return definitions(entries) + f'\n<p class="quiet">All of it, for programs: {JOURNAL}.</p>'


def _failures(records: Sequence[Record]) -> str:
    rows = [(one.path, one.code, one.error) for one in records if one.state == "failed"]
    return f"<h2>Failed</h2>\n{table(('scene', 'code', 'why'), rows, words=(1, 2))}" if rows else ""


def _scenes(done: Sequence[Record], folder: Path) -> str:
    if not done:
        return ""
    pictures = [_picture(one, folder) for one in done[:_PICTURES_MAX]] + [""] * len(done[_PICTURES_MAX:])
    heads = '<th scope="col"></th>' * any(pictures) + "".join(
        f'<th scope="col"{_kind(place)}><button type="button">{escape(head)}</button></th>'
        for place, head in enumerate(_HEADS)
    )
    rows = "\n".join(
        f"<tr>{f'<td>{picture}</td>' * any(pictures)}{_cells(one)}</tr>"
        for one, picture in zip(done, pictures, strict=True)
    )
    return (
        "<h2>Done</h2>\n<p>A click on a heading sorts.</p>\n"
        f'<div class="scroll"><table class="sortable"><thead><tr>{heads}</tr></thead><tbody>\n{rows}\n'
        "</tbody></table></div>"
    )


def _kind(place: int) -> str:
    return "" if place else ' class="name" data-kind="text"'


def _cells(one: Record) -> str:
    source, output, splats = one.source_bytes, one.output_bytes, one.splats
    numbers = (
        (splats, "{:,.0f}"),
        (None if source is None else source / 1e3, "{:,.1f}"),
        (None if output is None else output / 1e3, "{:,.1f}"),
        (100.0 * output / source if source and output is not None else None, "{:.1f}"),
        (output / splats if splats and output is not None else None, "{:.2f}"),
        (one.seconds, "{:.2f}"),
        (None if one.memory_bytes is None else one.memory_bytes / 1e6, "{:,.0f}"),
    )
    name = f'<td class="name" data-value="{escape(one.output)}" title="{escape(one.path)}">{escape(one.output)}</td>'
    return name + "".join(
        f'<td data-value="{"" if value is None else f"{value:.6g}"}">{"" if value is None else form.format(value)}</td>'
        for value, form in numbers
    )


def _picture(one: Record, folder: Path) -> str:
    with suppress(OSError):
        data = base64.b64encode((folder / THUMBNAILS / f"{one.output}.jpg").read_bytes()).decode()
        width, height = THUMBNAIL_SIZE
        return f'<img src="data:image/jpeg;base64,{data}" width="{width}" height="{height}" alt="" loading="lazy">'
    return ""
