"""The plot of what was measured of curves: a panel per scene, PSNR over bytes per splat."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csplat_bench.common.curves import Point, front
from csplat_bench.common.plots import new_figure, save_svg
from csplat_bench.distortion.known import FIGURES, Measured

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Okabe and Ito's colours, told apart by all eyes.
_OURS, _SIMPLIFIED, _SPZ, _SOG, _SPX = "#0072B2", "#009E73", "#D55E00", "#CC79A7", "#E69F00"
_PEERS = {"SPZ": (_SPZ, "s"), "SOG": (_SOG, "D")}
_COLUMNS = 2
_TICKS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # bytes
_ABOVE = 3.0  # dB above the best peer that are shown


def plot(results: Mapping[str, Measured], path: Path) -> None:
    """Draw the curves; nothing if nothing is known.

    Args:
        results: by scene.
        path: an SVG, replaced. The same results give the same bytes.
    """
    drawn = {name: one for name, one in results.items() if one.plain()}
    if not drawn:
        return
    from matplotlib import rc_context

    rows = -(-len(drawn) // _COLUMNS)
    with rc_context({"svg.fonttype": "none", "font.size": 9}):  # text stays text: small
        figure = new_figure(7.2, 2.5 * rows + 0.7)
        axes = figure.subplots(rows, _COLUMNS, squeeze=False)
        for axis in axes.flat[len(drawn) :]:
            axis.set_visible(False)
        for axis, (name, one) in zip(axes.flat, drawn.items(), strict=False):
            _panel(axis, name, one)
        entries: dict[str, Any] = {}
        for axis in axes.flat:
            handles, labels = axis.get_legend_handles_labels()
            entries.update(zip(labels, handles, strict=True))
        labels = sorted(entries, key=list(_LEGEND).index)
        figure.legend(
            [entries[label] for label in labels], [_LEGEND[label] for label in labels], loc="outside upper center",
            ncols=3, frameon=False, fontsize=8.5,
        )  # fmt: skip
        save_svg(figure, path)


_LEGEND = {
    "front": "csplat, whole scene (front)",
    "blind": "csplat, without a look at pictures",
    "other": "csplat, other presets and codings",
    "simplified": "csplat, simplified",
    "SPZ": "SPZ, written in the same run",
    "SOG": "SOG, written in the same run",
    "elsewhere": "other formats, other scenes",
}


def _panel(axis: Axes, name: str, one: Measured) -> None:
    from matplotlib.ticker import MaxNLocator

    plain = one.plain()
    best = front(plain)
    blind = front(one.unmeasured())
    simplified = front(one.simplified())
    peers = one.peers()
    highest = max((point.psnr for point in peers.values()), default=99.0) + _ABOVE
    every = [point for points in plain.values() for point in points if point.psnr <= highest]
    others = [point for point in every if point not in best]
    shown = [point for point in (*best, *blind, *simplified, *peers.values()) if point.psnr <= highest]
    axis.set_xscale("log")
    axis.plot(*_xy(one, others), ".", color=_OURS, alpha=0.35, markersize=4, label="other")
    axis.plot(*_xy(one, blind), "-", color=_OURS, alpha=0.45, linewidth=1.0, label="blind")
    axis.plot(*_xy(one, best), "o-", color=_OURS, markersize=3.5, linewidth=1.4, label="front")
    if simplified:
        axis.plot(*_xy(one, simplified), "^--", color=_SIMPLIFIED, markersize=5, linewidth=1.2, label="simplified")
    for peer, point in peers.items():
        colour, marker = _PEERS[peer]
        axis.plot(*_xy(one, [point]), marker, color=colour, markersize=6, label=peer)
    sizes = [one.per_splat(point.size_bytes) for point in shown]
    decibels = [point.psnr for point in shown]
    axis.set_xlim(min(sizes) * 0.85, max(*sizes, 18.0) * 1.2)
    axis.set_ylim(min(decibels) - 1.5, max(decibels) + 1.5)
    _elsewhere(axis, one)
    degree = one.values["sh_degree"]
    axis.set_title(f"{name}: {one.splats:,} splats, SH {degree}", fontsize=9)
    axis.set_xlabel("bytes per splat of the source", fontsize=8)
    axis.set_ylabel("PSNR, dB", fontsize=8)
    axis.tick_params(labelsize=8, length=0)
    axis.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    left, right = axis.get_xlim()
    ticks = [size for size in _TICKS if left <= size <= right]
    axis.set_xticks(ticks, [str(size) for size in ticks])
    axis.set_xticks([], minor=True)
    axis.grid(color="0.9", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def _xy(one: Measured, points: list[Point]) -> tuple[list[float], list[float]]:
    return [one.per_splat(point.size_bytes) for point in points], [point.psnr for point in points]


def _elsewhere(axis: Axes, one: Measured) -> None:
    """Boxes for what others were found to take on other scenes; bands if their PSNR is not known."""
    from matplotlib.patches import Rectangle

    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    for figure in FIGURES[one.has_sh]:
        low, high = figure.bytes_per_splat
        if low > right or high < left:
            continue
        colour = _colour(figure.name)
        high = max(high, low * 1.01)
        y, y1 = figure.psnr or (bottom, top)
        if y > top or y1 < bottom:
            continue
        box = Rectangle((low, y), high - low, y1 - y, facecolor=colour, edgecolor=colour, alpha=0.16, label="elsewhere")
        axis.add_patch(box)
        middle = (low * high) ** 0.5
        if not left < middle < right:
            continue
        place = max(y, bottom) + 0.03 * (top - bottom)
        axis.text(
            middle, place, figure.short, color=colour, fontsize=6.5, rotation=90, ha="center",
            va="bottom", clip_on=True,
        )  # fmt: skip


def _colour(name: str) -> str:
    for start, (colour, _) in _PEERS.items():
        if name.startswith(start):
            return colour
    return _SPX if name == ".spx" else "0.35"
