"""Place names or numbers next to the marks of a plot, so that none covers another one.

Each label tries places around its mark, near ones first, and takes the cheapest that is free; a label that is farther
away gets a line to its mark. Names are tried first. If not all of them find a free place, numbers are used instead.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from csplat_tools.pages.svg import INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes


Point = tuple[float, float]

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

    def crosses(self, a: Point, b: Point) -> bool:
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
    lead: tuple[Point, Point] | None


def label_marks(
    axes: Axes,
    marks: Sequence[Point],
    names: Sequence[str],
    numbers: Sequence[str],
    lines: Sequence[Sequence[Point]] = (),
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

    def in_points(those: Sequence[Point]) -> list[Point]:
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


def _write(axes: Axes, text: str, one: _Placed, mark: Point, scale: float) -> None:
    middle = ((one.box.left + one.box.right) / 2.0, (one.box.bottom + one.box.top) / 2.0)
    where = tuple(axes.transData.inverted().transform((mark[0] / scale, mark[1] / scale)))
    lead = {"arrowstyle": "-", "color": INK, "linewidth": 0.6, "alpha": 0.6, "shrinkA": 1.0, "shrinkB": 3.0}
    note = axes.annotate(
        text, where, (middle[0] - mark[0], middle[1] - mark[1]), textcoords="offset points", fontsize=_SIZE,
        ha="center", va="center", arrowprops=lead if one.lead else None, zorder=4,
    )  # fmt: skip
    note.set_in_layout(False)


def _placed(
    at: Sequence[Point], texts: Sequence[str], room: _Box, lines: Sequence[tuple[Point, Point]], *, forced: bool = False
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


def _candidates(mark: Point, text: str) -> list[tuple[_Placed, float]]:
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
