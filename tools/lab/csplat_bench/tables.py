# SPDX-License-Identifier: Apache-2.0
"""Tables and plots of results: rows from JSON, columns as templates, Markdown and SVG out.

A template is a format string over the fields of a row, such as `{size_bytes / 1e6:.2f}` or `{psnr - source.psnr:+.1f}`.
Fields and numbers may be joined by ` / `, ` * ` and ` - `, which are evaluated from left to right. A field of a nested
record is called `outer.inner`. A column may have several templates: the first whose fields are all there is shown.
"""

from __future__ import annotations

import hashlib
import io
import json
import operator
import re
import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from csplat.disk_files import atomic_writer
from csplat.errors import InputError
from csplat_bench.published import read_published

MISSING = "–"  # cell of a template with a field that is absent or null

Row = Mapping[str, Any]
#: Heading and templates; or `key`, with `title`, `scale` (1) and `format`.
Column = Sequence[str] | Mapping[str, Any]

# Okabe and Ito's colours, which readers with any colour vision can tell apart.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "0.3", "0.6")
_LEGEND_INCHES = 2.4  # width of an entry of a legend
_OPERATORS = {"/": operator.truediv, "*": operator.mul, "-": operator.sub}


class _Templates(string.Formatter):
    """Format strings whose fields are arithmetic over a row."""

    def get_field(self, field_name: str, _args: Sequence[Any], kwargs: Mapping[str, Any]) -> tuple[Any, str]:
        first, *rest = re.split(r" ([-/*]) ", field_name)
        value = _operand(first, kwargs)
        for sign, name in zip(rest[::2], rest[1::2], strict=True):
            value = _OPERATORS[sign](value, _operand(name, kwargs))
        return value, first


def _operand(name: str, row: Row) -> Any:
    value = row.get(name)
    if value is not None:
        return value
    try:
        return float(name)
    except ValueError:
        raise KeyError(name) from None


def cell(template: str, row: Row) -> str:
    """Return the text of a template for a row, `–` if a field is missing."""
    try:
        return _Templates().vformat(template, (), row)
    except KeyError:
        return MISSING


def markdown_table(rows: Iterable[Row], columns: Sequence[Column], labels: Mapping[str, str] | None = None) -> str:
    """Lay out rows as a Markdown table.

    Args:
        rows: records of results; nested ones are flattened.
        columns: what each shows.
        labels: texts that replace whole cells.
    """
    labels, pairs = labels or {}, [_heading_and_templates(column) for column in columns]
    lines = [[heading for heading, _ in pairs]]
    for row in map(flatten, rows):
        cells = [_first_cell(templates, row) for _, templates in pairs]
        lines.append([labels.get(text, text) for text in cells])
    head, *body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([head, f"|{'---|' * len(pairs)}", *body])


def _heading_and_templates(column: Column) -> tuple[str, Sequence[str]]:
    if not isinstance(column, Mapping):
        heading, *templates = column
        return heading, templates
    key, scale = column["key"], f" * {column['scale']}" if "scale" in column else ""
    return column.get("title", key), [f"{{{key}{scale}:{column.get('format', '')}}}"]


def _first_cell(templates: Iterable[str], row: Row) -> str:
    texts = (cell(template, row) for template in templates)
    return next((text for text in texts if text != MISSING), MISSING)


def select_rows(spec: Mapping[str, Any], folder: Path) -> list[Row]:
    """Read the rows that a table or plot shows.

    Args:
        spec: `source`, one or more files: JSON, or TOML of published figures, which replace those in the JSON files.
            Optional keys: `rows`, the key of the list in a JSON file, or "." for a single row with the file's own
            fields; `where`, allowed values by field, which also give the order; `group` and `by`: rows with equal
            fields `group` are merged into one, and the other fields of a row with `by = VALUE` are renamed to
            `VALUE.FIELD`. A row without `series` gets its `case`. If there are published figures, a measured row gets
            the fields that it lacks of `fill`, templates by field.
        folder: folder of the JSON files.

    Raises:
        ValueError: no row is left.
    """
    files = [folder / name for name in _as_list(spec["source"])]
    published = [row for file in files if file.suffix == ".toml" for row in read_published(file)]
    rows: list[Row]
    rows = [flatten(row) for file in files if file.suffix != ".toml" for row in _read(file, spec.get("rows", "rows"))]
    if published:
        measured = [row for row in rows if "published" not in row]
        fill = spec.get("fill", {}).items()
        rows = [*({**{name: cell(template, row) for name, template in fill}, **row} for row in measured), *published]
    rows = [{"series": row["case"], **row} if "case" in row else row for row in rows]
    for field, values in reversed(spec.get("where", {}).items()):
        order = {value: position for position, value in enumerate(_as_list(values))}
        rows = sorted((row for row in rows if row.get(field) in order), key=lambda row: order[row[field]])
    if "group" in spec:
        rows = _group(rows, _as_list(spec["group"]), spec["by"])
    if not rows:
        raise ValueError(f"{spec['source']}: no row is left, expected some with {spec.get('where', {})}")
    return rows


def flatten(row: Row, prefix: str = "") -> dict[str, Any]:
    """Return a record without nested ones: `{"a": {"b": 1}}` becomes `{"a.b": 1}`."""
    return dict(_fields(row, prefix))


def _fields(row: Row, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in row.items():
        if isinstance(value, Mapping):
            yield from _fields(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _read(path: Path, key: str) -> list[Row]:
    document: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if key == ".":
        return [{"file": path.name, **{name: value for name, value in document.items() if not isinstance(value, list)}}]
    found: list[Row] = document[key]
    return found


def _group(rows: Iterable[Row], group: Sequence[str], by: str) -> list[Row]:
    merged: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        one = merged.setdefault(tuple(row.get(field) for field in group), {field: row.get(field) for field in group})
        one.update({f"{row[by]}.{name}": value for name, value in row.items() if name not in (*group, by)})
    return list(merged.values())


def _as_list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def draw_plot(rows: Sequence[Row], spec: Mapping[str, Any], path: Path) -> None:
    """Draw an SVG; the same rows give the same bytes.

    Args:
        rows: records of results.
        spec: `x`, `y` and `series`, fields or arithmetic over them. Optional keys: `per`, a field with a panel for each
            value, `columns` panels in a row; `note`, a field whose text is shown next to a point; `styles`, colour and
            matplotlib's format by series; `labels` of series and panels; `x_title`, `y_title`, `x_scale` (log or
            linear), `ticks`, `x_limits`, `y_limits`, `size` in inches.
        path: the file, which is replaced. A legend above the panels shows all series.

    Raises:
        InputError: there are no rows.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not rows:
        raise InputError(f"no row has both {spec['x']} and {spec['y']}")
    panels = list(dict.fromkeys(_value(spec.get("per"), row) for row in rows))
    across = min(spec.get("columns", 1), len(panels))
    buffer = io.BytesIO()
    # Text stays text, which keeps the file small.
    with rc_context({"svg.fonttype": "none", "font.size": 9, "svg.hashsalt": path.stem}):
        figure = Figure(figsize=spec.get("size", (7.2, 4.0)), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(-(-len(panels) // across), across, squeeze=False)
        for axis in grid.flat[len(panels) :]:
            axis.set_visible(False)
        series: dict[str, Any] = {}  # a line for each label
        for axis, panel in zip(grid.flat, panels, strict=False):
            _draw_panel(axis, spec, [row for row in rows if _value(spec.get("per"), row) == panel])
            axis.set_title(spec.get("labels", {}).get(panel, panel), fontsize=9)
            series = {line.get_label(): line for line in axis.get_lines()} | series
        across = max(1, int(figure.get_figwidth() / _LEGEND_INCHES))
        figure.legend(handles=series.values(), ncols=across, frameon=False, fontsize=8, loc="outside upper center")
        figure.supxlabel(spec.get("x_title", spec["x"]), fontsize=9)
        figure.supylabel(spec.get("y_title", spec["y"]), fontsize=9)
        figure.savefig(buffer, format="svg", dpi=100, metadata={"Date": None, "Source": digest(spec, rows)})
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(path) as stream:
        stream.write(b"\n".join(line.rstrip() for line in buffer.getvalue().split(b"\n")))


def digest(spec: Mapping[str, Any], rows: Sequence[Row]) -> str:
    """Return a digest of what a plot shows; a plot carries it, to be recognised under any version of matplotlib."""
    return hashlib.sha256(json.dumps([spec, rows], sort_keys=True).encode()).hexdigest()[:16]


def _draw_panel(axis: Any, spec: Mapping[str, Any], rows: Sequence[Row]) -> None:
    styles, labels = spec.get("styles", {}), spec.get("labels", {})
    axis.set_xscale(spec.get("x_scale", "linear"))
    for number, name in enumerate(dict.fromkeys(_value(spec["series"], row) for row in rows)):
        chosen = [row for row in rows if _value(spec["series"], row) == name]
        points = sorted(
            (*(float(_value(spec[name], row)) for name in "xy"), _value(spec.get("note"), row)) for row in chosen
        )
        colour, style = styles.get(name, (_COLOURS[number % len(_COLOURS)], "o-"))
        x, y, notes = zip(*points, strict=True)
        axis.plot(x, y, style, color=colour, markersize=4.5, linewidth=1.5, label=labels.get(name, name))
        for *point, note in zip(x, y, notes, strict=True):
            axis.annotate(note, point, (5, -3), textcoords="offset points", fontsize=8, color=colour)
    if "ticks" in spec:
        axis.set_xticks(spec["ticks"], [f"{tick:g}" for tick in spec["ticks"]])
        axis.set_xticks([], minor=True)
    elif spec.get("x_scale") == "log":
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in "235" else "")
    axis.set(xlim=spec.get("x_limits"), ylim=spec.get("y_limits"))
    axis.grid(color="0.9", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def _value(expression: str | None, row: Row) -> str:
    """Return a field of a row, or arithmetic over its fields, as text."""
    return "" if expression is None or (text := cell(f"{{{expression}}}", row)) == MISSING else text
