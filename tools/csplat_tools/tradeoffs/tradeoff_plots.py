"""Plot the results of a sweep: size, quality and time, bytes by attribute, and quality with fewer SH layers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from csplat_tools.console import format_bytes
from csplat_tools.html_report import INK, Bar, draw_bars, draw_svg, hover_id
from csplat_tools.tradeoffs.sweep_points import SweepPoint
from csplat_tools.tradeoffs.sweep_run import Tradeoff

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_WIDE, _HIGH = 7.0, 4.4  # width and height of a plot, inches of 100 pixels

# Colours that colour-blind readers can tell apart, on white and on black; markers differ, too.
_STYLES = {
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
_LARGE = 1_000_000  # bytes of the largest file from which sizes are given in MB
_KEY_COLUMNS, _KEY_LINE = 4, 0.16  # columns of the key below a plot that stands alone; height of its lines, inches

Value = Callable[[SweepPoint], "float | None"]


def draw_plot(name: str, tradeoff: Tradeoff, *, inline: bool) -> str | None:
    """Draw one of `PLOTS`.

    Args:
        name: name of the plot.
        tradeoff: the sweep.
        inline: for a page, whose text colour it takes; else with colours and a background of its own.

    Returns:
        An SVG; `None` if the sweep has no data for it.
    """
    return PLOTS[name](tradeoff, name, inline)


def _quality(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    return _front_plot(tradeoff, name, inline, lambda one: one.psnr, tradeoff.front, "PSNR against the source, dB")


def _image_plot(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    scores = tradeoff.source_image_scores
    if scores is None:
        return None
    front, label = tradeoff.image_front, "PSNR on held-out photographs, dB"
    level = scores.psnr
    return _front_plot(tradeoff, name, inline, lambda one: one.image_psnr, front, label, level=level)


def _front_plot(
    tradeoff: Tradeoff,
    name: str,
    inline: bool,
    value: Value,
    front: Sequence[SweepPoint],
    label: str,
    level: float | None = None,
) -> str:
    def draw(figure: Figure) -> None:
        axes, (unit, divisor) = figure.add_subplot(), _unit(tradeoff)
        size = _size_in(divisor)
        line = [(size(one) or 0.0, value(one) or 0.0) for one in front]
        axes.plot(*zip(*line, strict=True), "--", color=INK, linewidth=1, label="none is smaller and better", zorder=1)
        if level is not None:
            axes.axhline(level, color=INK, linewidth=1, linestyle=":", label="the source itself")
        axes.set(xscale="log", xlabel=f"size, {unit}", ylabel=label)
        _scatter(axes, tradeoff, size, value, name, inline, line)

    return draw_svg(draw, (_WIDE, _HIGH), name, inline=inline, titles=_titles(tradeoff, name))


def _encode_time(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    def draw(figure: Figure) -> None:
        axes, (unit, divisor) = figure.add_subplot(), _unit(tradeoff)
        axes.set(xscale="log", yscale="log", xlabel=f"size, {unit}", ylabel="seconds to encode")
        _scatter(axes, tradeoff, _size_in(divisor), lambda one: one.encode_seconds, name, inline)

    return draw_svg(draw, (_WIDE, _HIGH), name, inline=inline, titles=_titles(tradeoff, name))


def _decode_time(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.set(xlabel="PSNR against the source, dB", ylabel="milliseconds to decode")
        _scatter(axes, tradeoff, lambda one: one.psnr, lambda one: 1000.0 * one.decode_seconds, name, inline)

    return draw_svg(draw, (_WIDE, _HIGH), name, inline=inline, titles=_titles(tradeoff, name))


def _attributes(tradeoff: Tradeoff, _name: str, inline: bool) -> str | None:
    bars = [
        Bar(f"{number} {one.name}", one.attribute_bytes, format_bytes(one.size_bytes))
        for number, one in enumerate(tradeoff.measured, 1)
    ]
    return draw_bars(bars, key=True, inline=inline)


def _layers(tradeoff: Tradeoff, name: str, inline: bool) -> str | None:
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
    "size-quality": _quality,
    "size-photographs": _image_plot,
    "size-encode-time": _encode_time,
    "quality-decode-time": _decode_time,
    "attribute-bytes": _attributes,
    "sh-layers": _layers,
}


def _scatter(
    axes: Axes,
    tradeoff: Tradeoff,
    x: Value,
    y: Value,
    plot: str,
    inline: bool,
    line: Sequence[tuple[float, float]] = (),
) -> None:
    """Draw a mark for each file, labelled by its name, or by its number in the table if the names do not fit."""
    from matplotlib.figure import Figure

    points, marks = tradeoff.measured, list[tuple[float, float]]()
    named = set[str]()
    for one in points:
        colour, marker = _STYLES[one.family]
        marks.append((x(one) or 0.0, y(one) or 0.0))
        label = "" if one.family in named else _NAMES[one.family]
        named.add(one.family)
        (mark,) = axes.plot(*([at] for at in marks[-1]), marker, color=colour, markersize=6.5, label=label)
        mark.set_gid(hover_id(plot, one.name))
    axes.margins(0.08)
    for which in "xy":
        _plain_ticks(axes, which)
    handles, labels = axes.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda at: [*_NAMES.values(), labels[at]].index(labels[at]))
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    figure.legend(
        [handles[at] for at in order], [labels[at] for at in order], loc="outside upper left", ncols=4, fontsize="small"
    )
    numbers = [str(number) for number in range(1, len(points) + 1)]
    if label_marks(axes, marks, [one.name for one in points], numbers, [line]) and not inline:
        _write_key(figure, [f"{number} {one.name}" for number, one in zip(numbers, points, strict=True)])


def _write_key(figure: Figure, lines: Sequence[str]) -> None:
    """Write the key of the numbers below a plot that has no table next to it; the plot keeps its height."""
    from matplotlib.lines import Line2D

    figure.set_figheight(figure.get_figheight() + _KEY_LINE * (1 - len(lines) // -_KEY_COLUMNS))
    nothing = [Line2D([], [], linestyle="none") for _ in lines]
    figure.legend(
        nothing, lines, loc="outside lower left", ncols=_KEY_COLUMNS, fontsize="x-small", handlelength=0,
        handletextpad=0,
    )  # fmt: skip


def _titles(tradeoff: Tradeoff, plot: str) -> dict[str, str]:
    """Return the texts that appear when the mouse rests on a point, by the id of its mark."""
    return {
        hover_id(plot, one.name): f"{one.name}: {one.size_bytes} bytes, {one.psnr:.2f} dB, encoded in"
        f" {one.encode_seconds:.2f} s, decoded in {1000.0 * one.decode_seconds:.1f} ms"
        for one in tradeoff.measured
    }


def _unit(tradeoff: Tradeoff) -> tuple[str, float]:
    """Return the unit of sizes, and its number of bytes."""
    return ("MB", 1e6) if max(one.size_bytes for one in tradeoff.measured) >= _LARGE else ("kB", 1e3)


def _size_in(divisor: float) -> Value:
    return lambda one: one.size_bytes / divisor


def _plain_ticks(axes: Axes, which: str) -> None:
    """Put plain numbers on a logarithmic axis; more of them if the axis is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axes.xaxis if which == "x" else axes.yaxis
    if axis.get_scale() != "log":
        return
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(10.0, _FEW if high > 12.0 * low else _MANY, numticks=_TICKS))
    axis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


Position = tuple[float, float]

_SIZE = 8.5  # font size of labels, points
_MARK = 4.0  # half the side of a mark with some space, points
_WIDER = 1.12  # factor of the text width: readers' fonts may be wider than ours
_TALLER = 1.25  # height of a line as a multiple of the font size
_DISTANCES = (5.0, 8.0, 12.0, 17.0, 23.0, 30.0, 38.0, 48.0, 60.0, 74.0, 90.0)  # tried distances from a mark, points
_DIRECTIONS = 24  # number of directions tried at each distance
_LED = 9.0  # points: a label at a larger distance gets a line to its mark
_LINE_COST = 12.0  # cost of a label across a line of the plot, in points of distance


@dataclass(frozen=True)
class _Box:
    left: float
    bottom: float
    right: float
    top: float

    def meets(self, other: _Box) -> bool:
        return (
            self.left < other.right and other.left < self.right and self.bottom < other.top and other.bottom < self.top
        )

    def crosses(self, a: Position, b: Position) -> bool:
        """Return True if the line from `a` to `b` crosses the box (Liang and Barsky)."""
        enter, leave = 0.0, 1.0
        for start, end, low, high in ((a[0], b[0], self.left, self.right), (a[1], b[1], self.bottom, self.top)):
            step = end - start
            if step == 0.0:
                if not low < start < high:
                    return False
                continue
            near, far = sorted(((low - start) / step, (high - start) / step))
            enter, leave = max(enter, near), min(leave, far)
        return enter < leave


@dataclass(frozen=True)
class _Placed:
    box: _Box
    lead: tuple[Position, Position] | None


def label_marks(
    axes: Axes,
    marks: Sequence[Position],
    names: Sequence[str],
    numbers: Sequence[str],
    lines: Sequence[Sequence[Position]] = (),
) -> bool:
    """Write a label next to each mark.

    Args:
        axes: the axes, with their final limits and place in the figure.
        marks: the marks in data coordinates.
        names: names of the marks; a mark with an empty name gets no label.
        numbers: labels to use instead if the names do not fit.
        lines: corners of lines of the plot, which labels avoid if possible.

    Returns:
        True if numbers were used.
    """
    from matplotlib.figure import Figure

    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    figure.draw_without_rendering()  # axes get their place, and limits their values
    scale = 72.0 / figure.dpi

    def in_points(those: Sequence[Position]) -> list[Position]:
        return [(scale * float(x), scale * float(y)) for x, y in (axes.transData.transform(one) for one in those)]

    frame = axes.get_window_extent()
    room = _Box(scale * frame.x0, scale * frame.y0, scale * frame.x1, scale * frame.y1)
    at, parts = in_points(marks), [part for line in lines for part in pairwise(in_points(line))]
    found = _placed(at, names, room, parts)
    texts = names if found is not None else numbers
    if found is None:
        found = _placed(at, numbers, room, parts, forced=True)
    assert found is not None
    for (x, y), text, one in zip(at, texts, found, strict=True):
        if one is not None:
            _write(axes, text, one, (x, y), scale)
    return texts is not names


def _write(axes: Axes, text: str, one: _Placed, mark: Position, scale: float) -> None:
    middle = ((one.box.left + one.box.right) / 2.0, (one.box.bottom + one.box.top) / 2.0)
    where = tuple(axes.transData.inverted().transform((mark[0] / scale, mark[1] / scale)))
    lead = {"arrowstyle": "-", "color": INK, "linewidth": 0.6, "alpha": 0.6, "shrinkA": 1.0, "shrinkB": 3.0}
    note = axes.annotate(
        text, where, (middle[0] - mark[0], middle[1] - mark[1]), textcoords="offset points", fontsize=_SIZE,
        ha="center", va="center", arrowprops=lead if one.lead else None, zorder=4,
    )  # fmt: skip
    note.set_in_layout(False)


def _placed(
    at: Sequence[Position],
    texts: Sequence[str],
    room: _Box,
    lines: Sequence[tuple[Position, Position]],
    *,
    forced: bool = False,
) -> list[_Placed | None] | None:
    """Return a place for each text, or `None` if one has no free place. The most crowded marks choose first."""
    marks = [_Box(x - _MARK, y - _MARK, x + _MARK, y + _MARK) for x, y in at]
    crowd = [sum(1.0 / (1.0 + math.dist(one, other)) for other in at) for one in at]
    placed: list[_Placed | None] = [None] * len(at)
    for place in sorted(range(len(at)), key=lambda i: (-crowd[i], i)):
        if not texts[place]:
            continue
        others = [one for one in placed if one is not None]
        best, best_cost = None, math.inf
        for one, distance in _candidates(at[place], texts[place]):
            if distance >= best_cost:
                break
            found = _hits(one, place, marks, others, room)
            hits = sum(found) if forced else 0
            if not forced and any(found):
                continue
            cost = distance + 1000.0 * hits + _LINE_COST * sum(one.box.crosses(*line) for line in lines)
            if cost < best_cost:
                best, best_cost = one, cost
        if best is None:
            return None
        placed[place] = best
    return placed


def _candidates(mark: Position, text: str) -> list[tuple[_Placed, float]]:
    """Return places for a text around a mark, near ones first, with their distances in points."""
    width, height = _WIDER * _text_width(text), _TALLER * _SIZE
    found = []
    for distance in _DISTANCES:
        for step in range(_DIRECTIONS):
            angle = math.pi * (0.5 + 2.0 * step / _DIRECTIONS)  # above the mark is tried first
            across, up = math.cos(angle), math.sin(angle)
            x = mark[0] + across * (distance + width / 2.0 if abs(across) > 0.3 else distance)
            y = mark[1] + up * (distance + height / 2.0)
            box = _Box(x - width / 2.0, y - height / 2.0, x + width / 2.0, y + height / 2.0)
            found.append((_Placed(box, (mark, (x, y)) if distance > _LED else None), distance))
    return found


def _hits(one: _Placed, place: int, marks: Sequence[_Box], others: Sequence[_Placed], room: _Box) -> Iterator[bool]:
    """Yield for each possible conflict whether it occurs: with the frame, the marks, other labels and their lines."""
    box, lead = one.box, one.lead
    yield box.left < room.left or box.right > room.right or box.bottom < room.bottom or box.top > room.top
    for mark in marks:
        yield box.meets(mark)
    for other in others:
        yield box.meets(other.box) or (other.lead is not None and box.crosses(*other.lead))
    if lead is not None:
        yield any(mark.crosses(*lead) for number, mark in enumerate(marks) if number != place)
        yield any(other.box.crosses(*lead) for other in others)


def _text_width(text: str) -> float:
    from matplotlib.textpath import TextPath

    return float(TextPath((0.0, 0.0), text, size=_SIZE).get_extents().width)
