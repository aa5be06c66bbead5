"""Plots of the study, for `tools/STUDY.md`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csplat_bench.common.plots import new_figure, save_svg
from csplat_bench.study.records import Known, Measured, Results
from csplat_bench.study.tables import MIB, PUBLISHED

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Okabe and Ito's colours, which differ for everyone.
_ORANGE, _SKY, _GREEN, _YELLOW, _BLUE, _RED, _PINK, _BLACK = (
    "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#000000",
)  # fmt: skip
_MARKERS = "os^vDPX*<>"
_WIDTH = 7.2  # inches, of 100 pixels

#: Variants of the baseline whose lines would lie on its own.
_SAME = ("study1k-short", "study1k-sh0", "study1k-lpips")

_PARTS = {
    "means": _BLUE, "quats": _ORANGE, "scales": _GREEN, "opacities": _BLACK, "sh0": _PINK, "shN": _SKY, "frame": "0.7",
}  # fmt: skip


def draw(results: Results, folder: Path) -> list[Path]:
    """Draw what is known; return the files.

    Args:
        results: by name of the scene, what is kept of it.
        folder: folder for the SVG files.
    """
    known = {name: one for name, one in results.items() if "baseline" in one["rows"]}
    drawn = []
    for name, plot in (("sh", _draw_sh), ("pruning", _draw_pruning), ("attributes", _draw_attributes)):
        figure = plot(known)
        if figure is not None:
            drawn.append(save_svg(figure, folder / f"{name}.svg"))
    return drawn


def _draw_sh(results: Results) -> Figure | None:
    """SH 1 against SH 0 on four figures: as published, and for our baselines."""
    ways = {
        "SH 1": ("baseline", _BLUE),
        "SH 0, truncated": ("SH 0", _ORANGE),
        "SH 0, distilled": ("SH 0 distilled", _GREEN),
    }
    ours = {name: one for name, one in results.items() if name.startswith("study1k") and one["facts"]["sh_degree"] == 1}
    if not any("SH 0" in one["rows"] for one in ours.values()):
        return None
    figure = new_figure(_WIDTH, 3.6)
    panels: dict[str, Callable[[Measured], float | None]] = {
        "PSNR, dB": lambda row: row["psnr_mean"],
        "SSIM": lambda row: row["ssim"],
        "LPIPS (less is better)": lambda row: row["lpips"],
        "MiB of float32": lambda row: row["study_bytes"] / MIB,
    }
    scenes = ["published", *ours]
    for number, (title, value) in enumerate(panels.items()):
        axes = figure.add_subplot(1, 4, number + 1)
        for offset, (label, (row, colour)) in enumerate(ways.items()):
            heights = [
                _published(row, title),
                *(value(one["rows"][row]) if row in one["rows"] else None for one in ours.values()),
            ]
            known = {place: height for place, height in enumerate(heights) if height is not None}
            spans = None
            if number == 0:
                spans = [_spread(row, None if not place else ours[scenes[place]]) for place in known]
            axes.bar(
                [place + 0.27 * (offset - 1) for place in known],
                list(known.values()),
                0.25,
                color=colour,
                label=label,
                yerr=spans,
                error_kw={"elinewidth": 0.8},
            )
        axes.set_title(title, fontsize=9)
        axes.set_xticks(range(len(scenes)), [_short(name) for name in scenes], rotation=60, ha="right", fontsize=8)
        axes.tick_params(axis="y", labelsize=8)
        axes.grid(visible=True, axis="y", alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8)
    return figure


def _published(row: str, title: str) -> float | None:
    one = PUBLISHED.get(row)
    if one is None:
        return None
    return {"PSNR, dB": one.psnr, "SSIM": one.ssim, "MiB of float32": one.mib}.get(title, one.lpips)


def _spread(row: str, one: Known | None) -> float:
    return float(PUBLISHED[row].psnr_std if one is None else one["rows"][row]["psnr_std"])


def _short(name: str) -> str:
    return "study1k" if name == "study1k" else name.removeprefix("study1k-")


def _draw_pruning(known: Results) -> Figure | None:
    """Survivors by threshold; what that costs against photographs; how far it is from the source."""
    scenes = {name: one for name, one in known.items() if one.get("taus", {}).get("all") and name not in _SAME}
    if not scenes:
        return None
    figure = new_figure(_WIDTH, 4.0)
    left, middle, right = (figure.add_subplot(1, 3, number + 1) for number in range(3))
    colours = (_BLUE, _ORANGE, _GREEN, _RED, _PINK, _SKY, _BLACK, "0.5", "#8B5A2B", _YELLOW)
    for number, (name, one) in enumerate(scenes.items()):
        taus = one["taus"]["all"]
        style: dict[str, Any] = {
            "color": colours[number % 10],
            "marker": _MARKERS[number % 10],
            "markersize": 4,
            "linewidth": 1.2,
        }
        x = [point["tau"] for point in taus]
        left.plot(x, [100.0 * point["splats"] / one["facts"]["splats"] for point in taus], label=name, **style)
        if "photographs" in one["facts"]["judged_by"]:
            whole = one["rows"]["baseline"]["psnr_mean"]
            middle.plot(x, [point["psnr_mean"] - whole for point in taus], **style)
        else:
            right.plot(x, [point["psnr_mean"] for point in taus], **style)
    left.set_title("splats left, %", fontsize=9)
    middle.set_title("photographs: change of PSNR, dB", fontsize=9)
    right.set_title("against the source: PSNR, dB", fontsize=9)
    for axes in (left, middle, right):
        axes.set_xscale("log")
        axes.set_xlabel("τ", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.axvline(1.0 / 255.0, color="0.6", linewidth=0.8, linestyle=":")
        axes.grid(visible=True, alpha=0.3)
    left.set_ylim(0, 102)
    middle.set_ylim(bottom=max(-12.0, middle.get_ylim()[0]))
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5, fontsize=8)
    return figure


def _draw_attributes(known: Results) -> Figure | None:
    """Bytes per source splat by attribute, of three files of each scene."""
    scenes = {
        name: one["attributes"]["all"]
        for name, one in known.items()
        if one.get("attributes", {}).get("all") and name not in _SAME
    }
    if not scenes:
        return None
    bars = [
        (f"{name}, {kind}", sizes[kind], known[name]["facts"]["splats"])
        for name, sizes in scenes.items()
        for kind in sizes
        if kind != "float32"
    ]
    figure = new_figure(_WIDTH, 0.9 + 0.2 * len(bars))
    axes = figure.add_subplot()
    ends = [0.0] * len(bars)
    for attribute, colour in _PARTS.items():
        widths = [sizes.get(attribute, 0) / splats for _, sizes, splats in bars]
        axes.barh(range(len(bars)), widths, left=ends, color=colour, label=attribute, height=0.8)
        ends = [end + width for end, width in zip(ends, widths, strict=True)]
    axes.set_yticks(range(len(bars)), [label for label, _, _ in bars], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("bytes per source splat", fontsize=9)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(visible=True, axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=7, fontsize=8)
    return figure
