"""Reports of a sweep: tables for a terminal, an HTML page, and plots as SVG files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from csplat.types import F64
from csplat_tools import html_report as html
from csplat_tools.console import format_bytes, format_table
from csplat_tools.file_streams import write_bytes
from csplat_tools.html_report import INK, Bar, draw_bars, draw_svg, hover_id
from csplat_tools.render_files import make_output_folder
from csplat_tools.tradeoffs.sweep_points import DECODE_RUNS, PartialFetch, SweepPoint
from csplat_tools.tradeoffs.sweep_run import Tradeoff
from csplat_tools.views import VIRTUAL, describe_views

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Value = Callable[[SweepPoint], "float | None"]

_FRONT_MARK = "*"  # before the names of points on the Pareto front, in a terminal
_LINE_MBITS = 10.0  # Mbit/s of a mobile connection, for the columns of download times
_MOST_SHOWN = 9  # largest number of points with images, some 60 kB each


@dataclass(frozen=True)
class _Column:
    """A column of the table of points.

    Attributes:
        title: title of the column.
        hint: its meaning, in a sentence.
        value: returns the value of a point; `None` if it is unknown.
        digits: number of digits after the decimal point.
        detailed: shown on the page only: a terminal is too narrow.
    """

    title: str
    hint: str
    value: Value
    digits: int
    detailed: bool = False

    def text(self, point: SweepPoint) -> str:
        value = self.value(point)
        return "-" if value is None else f"{value:.{self.digits}f}"


def _columns(tradeoff: Tradeoff) -> list[_Column]:
    """Return the columns for which a sweep has data."""
    columns = [
        _Column("bytes", "Size of the file.", lambda one: one.size_bytes, 0),
        _Column("bytes/splat", "Size of the file per splat of the source: comparable between scenes.",
                lambda one: one.bytes_per_source_splat, 2),
        _Column("smaller", "Size of the source divided by the size of the file.", lambda one: one.ratio, 1),
        _Column("PSNR", "Similarity of renders of the file and of the source, dB, pooled over all views. At 30 dB a"
                " difference is visible, at 40 dB hardly.", lambda one: one.psnr, 2),
        _Column("worst PSNR", "PSNR of the worst view, dB.", lambda one: one.quality.psnr_worst, 2),
        _Column("SSIM", "Structural similarity, 1 at best: mean over the views.", lambda one: one.quality.ssim, 4),
    ]  # fmt: skip
    if tradeoff.setting.distance is not None:
        columns.append(
            _Column("LPIPS", "Perceptual distance (AlexNet), 0 at best: mean over the views.",
                    lambda one: one.quality.lpips, 4)
        )  # fmt: skip
    if tradeoff.setting.views.images:
        columns.append(_Column("photo PSNR", "PSNR against the test images, dB.", lambda one: one.image_psnr, 2))
    columns += [
        _Column("splats", "Number of splats in the file.", lambda one: one.splats, 0),
        _Column("SH degree", "Degree of the spherical harmonics in the file, which are colours that depend on the view"
                " direction. 0: none.", lambda one: one.sh_degree, 0, detailed=True),
        _Column("encode s", "Seconds to make the file, one run.", lambda one: one.encode_seconds, 2),
        _Column("decode ms", "Milliseconds from the bytes to arrays of splats.",
                lambda one: 1000.0 * one.decode_seconds, 1),
        _Column("preview kB", "kB that a viewer fetches before its first render: everything but the spherical"
                " harmonics, which follow.", lambda one: one.first_picture_bytes / 1000.0, 1),
        _Column("preview s", f"Seconds to fetch the preview at {_LINE_MBITS:g} Mbit/s.",
                lambda one: _line_seconds(one.first_picture_bytes), 2, detailed=True),
        _Column("download s", f"Seconds to fetch the whole file at {_LINE_MBITS:g} Mbit/s.",
                lambda one: _line_seconds(one.size_bytes), 2, detailed=True),
    ]  # fmt: skip
    for mode in tradeoff.source_modes:
        title = "render ms" if mode == "standard" else f"render ms, {mode}"
        hint = f"Milliseconds to render a view on the CPU in mode {mode}, median over the views."
        columns.append(_Column(title, hint, _milliseconds(mode), 1))
    return columns


def _line_seconds(size_bytes: int) -> float:
    return 8.0 * size_bytes / (_LINE_MBITS * 1e6)


def _milliseconds(mode: str) -> Value:
    return lambda one: one.modes[mode].milliseconds


def format_tradeoff(tradeoff: Tradeoff) -> str:
    """Return all tables as text."""
    columns = [one for one in _columns(tradeoff) if not one.detailed]
    front = {one.name for one in tradeoff.front}
    rows: list[Sequence[object]] = [
        (f"{_FRONT_MARK if one.name in front else ' '} {one.name}", *(column.text(one) for column in columns))
        for one in tradeoff.measured
    ]
    setting = tradeoff.setting
    count = f"{len(setting.source)} splats, SH degree {setting.source.sh_degree}"
    parts = [
        f"{setting.name}: {count}, {format_bytes(setting.source_bytes)}; {_views_line(tradeoff)}",
        format_table(("  file", *(column.title for column in columns)), rows)
        + f"\n{_FRONT_MARK} no other file is smaller and at least as good, by PSNR",
        "\n".join(f"{column.title:{max(len(one.title) for one in columns)}}  {column.hint}" for column in columns),
    ]
    if tradeoff.failures:
        parts.append("\n".join(f"not measured: {one.name}: {one.error}" for one in tradeoff.failures))
    modes = _mode_rows(tradeoff)
    parts.append(format_table(("renderer", *modes[0]), modes[1:]))
    partial = _partial_rows(tradeoff)
    if len(partial) > 1:
        parts.append(format_table(("fewer SH layers", *partial[0]), partial[1:]))
    if tradeoff.source_image_scores is not None:
        scores = tradeoff.source_image_scores
        parts.append(f"the source itself scores {scores.psnr:.2f} dB against {len(scores.each)} test images")
    machine = tradeoff.machine
    parts.append(
        f"Times are single runs with {machine['threads']} threads on {machine['cores']} cores ({machine['processor']}),"
        f" csplat {machine['csplat']}, numpy {machine['packages']['numpy']}, numba {machine['packages']['numba']}."
    )
    return "\n\n".join(parts)


def _views_line(tradeoff: Tradeoff) -> str:
    setting = tradeoff.setting
    sizes = sorted({(camera.W, camera.H) for camera in setting.views.test})
    size = f"{sizes[0][0]}x{sizes[0][1]}" if len(sizes) == 1 else f"{len(sizes)} sizes"
    return f"scored on {describe_views(len(setting.views.test), setting.views.name)}, {size}"


def _mode_rows(tradeoff: Tradeoff) -> list[tuple[str, ...]]:
    """Return times and PSNR of the renderer's modes: a header without its first cell, and a row for each mode."""
    shown = [one for one in tradeoff.measured if one.family == "presets"] or tradeoff.front[-1:]
    header = ("source ms", "source PSNR", *(f"{one.name} {what}" for one in shown for what in ("ms", "PSNR")))
    rows = list[tuple[str, ...]]([header])
    for mode, source in tradeoff.source_modes.items():
        cells = [mode, f"{source.milliseconds:.1f}", f"{source.psnr:.2f}"]
        for one in shown:
            cells += [f"{one.modes[mode].milliseconds:.1f}", f"{one.modes[mode].psnr:.2f}"]
        rows.append(tuple(cells))
    return rows


def _partial_rows(tradeoff: Tradeoff) -> list[tuple[str, ...]]:
    """Return results for files with fewer SH layers fetched: a header without its first cell, and the rows."""
    header = ("bytes", "of the file", "PSNR", "worst PSNR", "SSIM", "decode ms", "render ms")
    return [header, *(_partial_row(point, one) for point in tradeoff.measured for one in point.partial)]


def _partial_row(point: SweepPoint, part: PartialFetch) -> tuple[str, ...]:
    return (
        f"{point.name}, SH {part.sh_degree}",
        str(part.size_bytes),
        f"{100.0 * part.size_bytes / point.size_bytes:.1f} %",
        f"{part.quality.psnr:.2f}",
        f"{part.quality.psnr_worst:.2f}",
        "-" if part.quality.ssim is None else f"{part.quality.ssim:.4f}",
        f"{1000.0 * part.decode_seconds:.1f}",
        f"{part.render_milliseconds:.1f}",
    )


def write_tradeoff_page(path: str, tradeoff: Tradeoff) -> None:
    """Write the HTML report."""
    write_bytes(path, make_tradeoff_page(tradeoff).encode())


def make_tradeoff_page(tradeoff: Tradeoff) -> str:
    """Return the HTML report: plots, tables, commands, images, and the conditions of measurement."""
    setting = tradeoff.setting
    count = f"{len(setting.source):,} splats, SH degree {setting.source.sh_degree}"
    modes, partial = _mode_rows(tradeoff), _partial_rows(tradeoff)
    stages = [
        (point.name, f"{point.encode_seconds:.2f}", ", ".join(f"{k} {v:.2f}" for k, v in point.stages.items()) or "-")
        for point in tradeoff.measured
    ]
    return html.document(
        f"{setting.name}: size, quality and time",
        [
            html.section(
                "Size and quality",
                html.paragraph(
                    "Each mark is a file, labelled with its name or its number in the table below. Left is smaller, up"
                    " is better. The dashed line is the Pareto front: no other file is smaller and at least as good."
                ),
                _plots(tradeoff, "size-quality", "size-photographs"),
            ),
            _files(tradeoff),
            _hardest_places(tradeoff),
            html.section(
                "Time",
                _plots(tradeoff, "size-encode-time", "quality-decode-time"),
                html.details(
                    "Stages of encoding", html.table(("file", "encode s", "known stages, s"), stages, words=(2,))
                ),
            ),
            html.section("Bytes by attribute", _plots(tradeoff, "attribute-bytes")),
            html.section(
                "Fewer SH layers",
                html.paragraph(
                    "A viewer shows the scene as soon as it has header, index and layer 0. It fetches the bands of"
                    " spherical harmonics afterwards, or never. Bytes are those fetched by then."
                ),
                _plots(tradeoff, "sh-layers"),
                html.table(("file", *partial[0]), partial[1:]),
            )
            if len(partial) > 1
            else "",
            html.section(
                "Modes of the renderer",
                html.paragraph("Milliseconds per view, and PSNR against renders of the source in mode standard."),
                html.table(("mode", *modes[0]), modes[1:]),
            ),
            html.section("Measurement", html.definitions(_conditions(tradeoff))),
        ],
        f"{count}, {format_bytes(setting.source_bytes)} in the file; {_views_line(tradeoff)}.",
    )


def _files(tradeoff: Tradeoff) -> str:
    columns, front = _columns(tradeoff), {one.name for one in tradeoff.front}
    heads = [
        html.Head("file", kind="name"),
        html.Head("no."),
        html.Head("run", "The command that makes the file.", kind="html"),
        *(html.Head(one.title, one.hint) for one in columns),
    ]
    rows = [
        [
            (point.name, ""),
            (str(number), number),
            html.copy_button(f"command-{number}", point.command),
            *((one.text(point), one.value(point)) for one in columns),
        ]
        for number, point in enumerate(tradeoff.measured, 1)
    ]
    marked = [place for place, point in enumerate(tradeoff.measured) if point.name in front]
    commands = "\n".join(
        f"<div>{number} {escape(point.name)} {html.copy_button(f'command-{number}', point.command)}<br>"
        f"{html.command_line(f'command-{number}', point.command)}</div>"
        for number, point in enumerate(tradeoff.measured, 1)
    )
    failures = [(one.name, one.error) for one in tradeoff.failures]
    return html.section(
        "Files",
        html.paragraph(
            "Coloured rows are on the Pareto front. A click on a heading sorts; copy takes the command that makes the"
            " file."
        ),
        html.sortable_table(heads, rows, marked),
        html.definitions({one.title: one.hint for one in columns}, "legend"),
        html.details(
            "All commands",
            html.paragraph(
                "Run in the folder where the report was made, each command makes the bytes that were measured. Those"
                " that begin with python require a Python with csplat installed."
            ),
            f'<div class="commands">\n{commands}\n</div>',
        ),
        f"<h3>Not measured</h3>\n{html.table(('file', 'error'), failures, words=(1,))}" if failures else "",
    )


def _hardest_places(tradeoff: Tradeoff) -> str:
    shown = shown_points(tradeoff)
    blocks = [
        f'<h3>{number} {escape(point.name)} <span class="quiet">{format_bytes(point.size_bytes)},'
        f" {point.psnr:.2f} dB</span></h3>\n{html.piece_images(point.hardest, point.name)}"
        for number, point in enumerate(tradeoff.measured, 1)
        if point.hardest is not None and point in shown
    ]
    note = f"The presets, and files on the Pareto front. {html.IMAGES_NOTE}"
    if tradeoff.setting.views.name == VIRTUAL:
        note += " Views are chosen because they show the scene well; they may differ from the test views."
    return html.section("The hardest places", html.paragraph(note), *blocks) if blocks else ""


def shown_points(tradeoff: Tradeoff) -> list[SweepPoint]:
    """Return the points with images: the presets, and others of the front, evenly spread; the smallest file first."""
    presets = [one for one in tradeoff.measured if one.family == "presets"]
    others = [one for one in tradeoff.front if one not in presets]
    room = max(0, _MOST_SHOWN - len(presets))
    if len(others) > room:
        others = [others[place * (len(others) - 1) // max(1, room - 1)] for place in range(room)]
    return sorted({*presets, *others}, key=lambda one: (one.size_bytes, one.name))


def _conditions(tradeoff: Tradeoff) -> dict[str, str]:
    machine, scores = tradeoff.machine, tradeoff.source_image_scores
    facts = {
        "PSNR": "from the squared error pooled over views, pixels and channels, against the source's own renders, 99 dB"
        " at most; other cameras or another background give other numbers",
        "times": f"single runs on this machine; decoding is the median of {DECODE_RUNS},"
        " rendering the median over views",
        "views": _views_line(tradeoff),
        "background": ", ".join(f"{value:g}" for value in tradeoff.setting.views.test_background),
        "machine": f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads in use,"
        f" {machine['system']}",
        "versions": f"csplat {machine['csplat']}, format {machine['format']}, Python {machine['python']}, "
        + ", ".join(f"{name} {version}" for name, version in machine["packages"].items()),
    }
    if scores is not None:
        facts["test images"] = f"{len(scores.each)}; the source itself scores {scores.psnr:.2f} dB"
    return facts


def _plots(tradeoff: Tradeoff, *names: str) -> str:
    drawn = ((name, PLOTS[name](tradeoff, name, True)) for name in names)
    figures = [html.figure(text, _CAPTIONS.get(name, "")) for name, text in drawn if text is not None]
    return f'<div class="plots">{"".join(figures)}</div>' if len(names) > 1 else "".join(figures)


_CAPTIONS = {
    "size-encode-time": "From the splats to the bytes, including renders of searches.",
    "quality-decode-time": "From the bytes in memory to float32 arrays.",
    "attribute-bytes": "Codebooks count with their attributes; overhead is header, index, frames and metadata.",
}


def write_plots(folder: str, tradeoff: Tradeoff, *, force: bool = False) -> Sequence[str]:
    """Write the plots for which the sweep has data, as SVG files, and return their paths.

    Raises:
        InputError: one of the files exists, and not `force`.
        OSError: the folder cannot be made.
    """
    make_output_folder(folder, [f"{name}.svg" for name in PLOTS], force=force)
    drawn = {f"{folder}/{name}.svg": draw(tradeoff, name, False) for name, draw in PLOTS.items()}
    paths = [path for path, text in drawn.items() if text is not None]
    for path in paths:
        write_bytes(path, str(drawn[path]).encode())
    return paths


_WIDE, _HIGH = 7.0, 4.4  # width and height of a plot, inches of 100 pixels
_STYLES = {  # colours that colour-blind readers can tell apart, on white and on black; and markers
    "presets": ("#d55e00", "s"),
    "precision": ("#2f83c9", "o"),
    "strategies": ("#cc79a7", "^"),
    "targets": ("#e69f00", "D"),
    "simplify": ("#009e73", "v"),
    "finetune": ("#8b8be6", "P"),
}
_NAMES = {
    "presets": "presets",
    "precision": "--attribute-psnr",
    "strategies": "simple strategies",
    "targets": "targets",
    "simplify": "simplified",
    "finetune": "fine-tuned",
}
# Ticks in each decade of long and of short logarithmic axes; largest number of ticks of an axis.
_FEW, _MANY, _TICKS = (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0), 15
_LARGE = 1_000_000  # bytes; if the largest file has as many, sizes are in MB
_KEY_COLUMNS, _KEY_LINE = 4, 0.16  # columns of the key below a plot that is a file; height of its lines, inches


def _plot_quality(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    label = "PSNR against the source, dB"
    return _scatter_plot(tradeoff, name, inline, None, lambda one: one.psnr, ("", label), front=tradeoff.front)


def _plot_image_quality(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    scores = tradeoff.source_image_scores
    if scores is None:
        return None
    front, label = tradeoff.image_front, "PSNR against test images, dB"
    return _scatter_plot(
        tradeoff, name, inline, None, lambda one: one.image_psnr, ("", label), front=front, level=scores.psnr
    )


def _plot_encode_time(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    labels = ("", "seconds to encode")
    return _scatter_plot(tradeoff, name, inline, None, lambda one: one.encode_seconds, labels, log_y=True)


def _plot_decode_time(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    labels = ("PSNR against the source, dB", "milliseconds to decode")
    return _scatter_plot(tradeoff, name, inline, lambda one: one.psnr, lambda one: 1000.0 * one.decode_seconds, labels)


def _plot_attributes(tradeoff: Tradeoff, _name: str, inline: bool) -> str | None:
    bars = [
        Bar(f"{number} {one.name}", one.attribute_bytes, format_bytes(one.size_bytes))
        for number, one in enumerate(tradeoff.measured, 1)
    ]
    return draw_bars(bars, key=True, inline=inline)


def _plot_layers(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    points = [one for one in tradeoff.measured if len(one.partial) > 1]
    if not points:
        return None
    styles = list(_STYLES.values())

    def draw(figure: Figure) -> None:
        axes, (unit, divisor) = figure.add_subplot(), _unit(tradeoff)
        lines = [[(one.size_bytes / divisor, one.quality.psnr) for one in point.partial] for point in points]
        for number, (point, line) in enumerate(zip(points, lines, strict=True)):
            colour, marker = styles[number % len(styles)]
            axes.plot(*zip(*line, strict=True), marker=marker, color=colour, label=point.name)
        axes.set(xlabel=f"{unit} fetched", ylabel="PSNR against the source, dB")
        axes.margins(0.08)
        figure.legend(loc="outside upper left", ncols=len(points), fontsize="small")
        names = [f"SH {one.sh_degree}" for point in points for one in point.partial]
        label_marks(axes, [mark for line in lines for mark in line], names, names, lines)

    return draw_svg(draw, (_WIDE, _HIGH), name, inline=inline)


#: Plots by name, which is that of the file, too; drawn in this order.
PLOTS: dict[str, Callable[[Tradeoff, str, bool], str | None]] = {
    "size-quality": _plot_quality,
    "size-photographs": _plot_image_quality,
    "size-encode-time": _plot_encode_time,
    "quality-decode-time": _plot_decode_time,
    "attribute-bytes": _plot_attributes,
    "sh-layers": _plot_layers,
}


def _unit(tradeoff: Tradeoff) -> tuple[str, float]:
    """Return the unit of sizes, and its number of bytes."""
    return ("MB", 1e6) if max(one.size_bytes for one in tradeoff.measured) >= _LARGE else ("kB", 1e3)


def _scatter_plot(
    tradeoff: Tradeoff,
    plot: str,
    inline: bool,
    x: Value | None,
    y: Value,
    labels: tuple[str, str],
    *,
    log_y: bool = False,
    front: Sequence[SweepPoint] = (),
    level: float | None = None,
) -> str:
    """Draw a mark for each file, labelled by its name, or by its number in the table if the names do not fit.

    Args:
        tradeoff: the sweep.
        plot: name of the plot.
        inline: for a page, in its text colour; else with a background of its own.
        x, y: values of a file; for `x`, `None` is its size, on a logarithmic axis.
        labels: labels of the axes; that of a size is made here.
        log_y: make the y axis logarithmic.
        front: files that a dashed line joins.
        level: y of a dotted line, that of the source.
    """
    points, (unit, divisor) = tradeoff.measured, _unit(tradeoff)

    def position(one: SweepPoint) -> tuple[float, float]:
        return (one.size_bytes / divisor if x is None else x(one) or 0.0), y(one) or 0.0

    def draw(figure: Figure) -> None:
        axes, line = figure.add_subplot(), [position(one) for one in front]
        if line:
            columns = zip(*line, strict=True)
            axes.plot(*columns, "--", color=INK, linewidth=1, label="none is smaller and better", zorder=1)
        if level is not None:
            axes.axhline(level, color=INK, linewidth=1, linestyle=":", label="the source itself")
        axes.set(xlabel=f"size, {unit}" if x is None else labels[0], ylabel=labels[1])
        axes.set(xscale="log" if x is None else "linear", yscale="log" if log_y else "linear")
        named = set[str]()
        for one in points:
            colour, marker = _STYLES[one.family]
            label = "" if one.family in named else _NAMES[one.family]
            named.add(one.family)
            (mark,) = axes.plot(*([at] for at in position(one)), marker, color=colour, markersize=6.5, label=label)
            mark.set_gid(hover_id(plot, one.name))
        axes.margins(0.08)
        for which in "xy":
            _set_plain_ticks(axes, which)
        handles, texts = axes.get_legend_handles_labels()
        order = sorted(range(len(texts)), key=lambda at: [*_NAMES.values(), texts[at]].index(texts[at]))
        figure.legend(
            [handles[at] for at in order], [texts[at] for at in order], loc="outside upper left", ncols=4,
            fontsize="small",
        )  # fmt: skip
        numbers = [str(number) for number in range(1, len(points) + 1)]
        names = [one.name for one in points]
        if label_marks(axes, [position(one) for one in points], names, numbers, [line]) and not inline:
            _write_key(figure, [f"{number} {name}" for number, name in zip(numbers, names, strict=True)])

    titles = {
        hover_id(plot, one.name): f"{one.name}: {one.size_bytes} bytes, {one.psnr:.2f} dB, encoded in"
        f" {one.encode_seconds:.2f} s, decoded in {1000.0 * one.decode_seconds:.1f} ms"
        for one in points
    }
    return draw_svg(draw, (_WIDE, _HIGH), plot, inline=inline, titles=titles)


def _write_key(figure: Figure, lines: Sequence[str]) -> None:
    """Write the key of the numbers below a plot that has no table next to it; the plot keeps its height."""
    from matplotlib.lines import Line2D

    figure.set_figheight(figure.get_figheight() + _KEY_LINE * (1 - len(lines) // -_KEY_COLUMNS))
    nothing = [Line2D([], [], linestyle="none") for _ in lines]
    figure.legend(
        nothing, lines, loc="outside lower left", ncols=_KEY_COLUMNS, fontsize="x-small", handlelength=0,
        handletextpad=0,
    )  # fmt: skip


def _set_plain_ticks(axes: Axes, which: str) -> None:
    """Put plain numbers on a logarithmic axis; more of them if the axis is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axes.xaxis if which == "x" else axes.yaxis
    if axis.get_scale() != "log":
        return
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(10.0, _FEW if high > 12.0 * low else _MANY, numticks=_TICKS))
    axis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


# Placement of labels; lengths are in points.
_FONT_SIZE = 8.5
_MARK = 4.0  # half the side of a mark, with some space
_WIDER, _TALLER = 1.12, 1.25  # factors of a text's width, since fonts differ, and of the font size for its height
_DISTANCES = (5.0, 8.0, 12.0, 17.0, 23.0, 30.0, 38.0, 48.0, 60.0, 74.0, 90.0)  # distances from the mark to try
_DIRECTIONS = 24  # directions to try at each distance, from the top
_LEAD_FROM = 9.0  # labels at a larger distance get a line to their mark
_LINE_COST, _HIT_COST = 12.0, 1000.0  # costs of a label across a line, and across anything else, as distances
_SAMPLES = np.linspace(0.0, 1.0, 33)[:, None]  # points of a line that labels are tested against


def label_marks(
    axes: Axes,
    marks: Sequence[tuple[float, float]],
    names: Sequence[str],
    numbers: Sequence[str],
    lines: Sequence[Sequence[tuple[float, float]]] = (),
) -> bool:
    """Write a label next to each mark.

    Args:
        axes: the axes, with their final limits and place in the figure.
        marks: positions of the marks, in data coordinates.
        names: labels of the marks.
        numbers: labels to use instead if the names do not fit.
        lines: corners of lines of the plot, which labels avoid if possible.

    Returns:
        True if numbers were used.
    """
    from matplotlib.figure import Figure

    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    figure.draw_without_rendering()  # fixes the limits and places of axes
    scale = 72.0 / figure.dpi
    at = scale * np.asarray(axes.transData.transform(marks), np.float64)
    corners = [scale * np.asarray(axes.transData.transform(line), np.float64) for line in lines if line]
    sampled = [_sample(*ends) for line in corners for ends in pairwise(line)]
    frame = scale * np.asarray(axes.get_window_extent().extents)
    texts = names
    centres = _place_labels(at, texts, frame, np.concatenate([np.empty((0, 4)), *sampled]))
    if centres is None:
        texts = numbers
        centres = _place_labels(at, texts, frame, np.concatenate([np.empty((0, 4)), *sampled]), forced=True)
    assert centres is not None
    lead = {"arrowstyle": "-", "color": INK, "linewidth": 0.6, "alpha": 0.6, "shrinkA": 1.0, "shrinkB": 3.0}
    for mark, point, text, (offset, has_lead) in zip(marks, at, texts, centres, strict=True):
        note = axes.annotate(
            text, mark, tuple(offset - point), textcoords="offset points", fontsize=_FONT_SIZE, ha="center",
            va="center", arrowprops=lead if has_lead else None, zorder=4,
        )  # fmt: skip
        note.set_in_layout(False)
    return texts is not names


def _place_labels(
    at: F64, texts: Sequence[str], frame: F64, lines: F64, *, forced: bool = False
) -> list[tuple[F64, bool]] | None:
    """Place labels around marks one by one, the most crowded mark first.

    Args:
        at: [N, 2] marks.
        texts: their labels.
        frame: left, bottom, right and top of the axes.
        lines: [n, 4] boxes of points on lines.
        forced: allow labels to overlap if there is no free place.

    Returns:
        The centre of each label, and whether it has a line to its mark; `None` if a label has no free place.
    """
    from matplotlib.textpath import TextPath

    angles = math.pi * (0.5 + 2.0 * np.arange(_DIRECTIONS) / _DIRECTIONS)
    across, up = np.tile(np.cos(angles), len(_DISTANCES)), np.tile(np.sin(angles), len(_DISTANCES))
    distances = np.repeat(_DISTANCES, _DIRECTIONS)
    occupied = np.concatenate([at - _MARK, at + _MARK], axis=1)
    crowd = (1.0 / (1.0 + np.linalg.norm(at[:, None] - at, axis=2))).sum(axis=1)
    placed: dict[int, tuple[F64, bool]] = {}
    for place in np.argsort(-crowd, kind="stable"):
        width = TextPath((0.0, 0.0), texts[place], size=_FONT_SIZE).get_extents().width
        half = np.array([_WIDER * width / 2.0, _TALLER * _FONT_SIZE / 2.0])
        aside = np.where(np.abs(across) > 0.3, half[0], 0.0)
        centres = at[place] + np.stack([across * (distances + aside), up * (distances + half[1])], axis=1)
        boxes = np.concatenate([centres - half, centres + half], axis=1)
        outside = (boxes[:, :2] < frame[:2]).any(axis=1) | (boxes[:, 2:] > frame[2:]).any(axis=1)
        hits = outside + _overlaps(boxes, occupied)
        best = int(np.argmin(distances + _HIT_COST * hits + _LINE_COST * (_overlaps(boxes, lines) > 0)))
        if hits[best] and not forced:
            return None
        has_lead = bool(distances[best] > _LEAD_FROM)
        occupied = np.concatenate([occupied, boxes[best : best + 1]])
        if has_lead:
            occupied = np.concatenate([occupied, _sample(at[place], centres[best])])
        placed[int(place)] = centres[best], has_lead
    return [placed[place] for place in range(len(at))]


def _sample(start: F64, end: F64) -> F64:
    """Return points on a line as boxes without area."""
    return np.tile(start + _SAMPLES * (end - start), 2)


def _overlaps(boxes: F64, others: F64) -> F64:
    """Return for each box (left, bottom, right, top) the number of others that it overlaps."""
    meets = (boxes[:, None, :2] < others[:, 2:]) & (others[:, :2] < boxes[:, None, 2:])
    counts: F64 = meets.all(axis=2).sum(axis=1).astype(np.float64)
    return counts
