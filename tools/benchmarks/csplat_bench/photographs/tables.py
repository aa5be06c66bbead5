"""Tables and plots of files made from photographs, next to published figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from csplat_bench.common.plots import new_figure, save_svg
from csplat_bench.common.report import Table, laid_out, optional
from csplat_bench.photographs.published import PUBLISHED, Published

# Okabe and Ito's colours, told apart by all eyes.
_OURS = {"train": ("#0072B2", "o-"), "finetune": ("#56B4E9", "o--"), "encode": ("#0072B2", "o:")}
_STYLES = {
    "HAC": ("#E69F00", "s"), "HAC++": ("#D55E00", "D"), "HEMGS": ("#CC79A7", "^"), "RDO-Gaussian": ("#009E73", "v"),
    "Compact-3DGS": ("0.5", "P"), "Self-Organizing Gaussians": ("0.5", "X"),
    "Self-Organizing Gaussians, SH 0": ("0.5", "x"), "MesonGS": ("0.5", "*"),
}  # fmt: skip
_HEADER = (
    "file",
    "MB",
    "PSNR mean, dB",
    "pooled",
    "SSIM",
    "LPIPS",
    "splats",
    "bytes per splat",
    "minutes",
    "memory, GB",
    "before tuning, MB",
    "PSNR mean, dB",
)
_THEIR_HEADER = ("published", "MB", "PSNR mean, dB", "SSIM", "LPIPS (VGG)", "networks", "from")
_TICKS = [factor * decade for decade in (1e4, 1e5, 1e6) for factor in (1, 1.5, 2, 3, 4, 6, 8)]  # bytes


def tables(known: Mapping[str, Any], name: str, *, markdown: bool = False) -> str:
    """Everything that is known of a scene.

    Args:
        known: the stored results.
        name: name of the scene, as published figures are kept.
        markdown: format tables in Markdown.
    """
    if "trainings" not in known:
        return "nothing is known yet"
    rows = [_row(f"trained: {name}", one) for name, one in known["trainings"].items()]
    rows += [_row(f"{name}, of {one['training']}", one) for name, one in _by_size(known)]
    made = [(name, f"`{one['command']}`") for name, one in known["trainings"].items()]
    theirs = [_their_row(one) for one in sorted(PUBLISHED.get(name, ()), key=lambda one: one.size_bytes)]
    title = f"{known['title']}, {known['test_views']} held-out photographs"
    parts = [Table(_HEADER, rows, title), Table(("training", "made by"), made), Table(_THEIR_HEADER, theirs)]
    return laid_out(parts, markdown=markdown)


def _by_size(known: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    return sorted(known.get("files", {}).items(), key=lambda item: int(item[1]["size_bytes"]))


def _row(name: str, one: Mapping[str, Any]) -> list[str]:
    before = one.get("before_tuning")
    return [
        name,
        f"{one['size_bytes'] / 1e6:.3f}",
        f"{one['psnr_mean']:.2f}",
        f"{one['psnr']:.2f}",
        f"{one['ssim']:.4f}",
        optional(one["lpips"], ".4f"),
        f"{one['splats']:,}",
        f"{one['size_bytes'] / one['splats']:.2f}",
        f"{one['seconds'] / 60:.0f}",
        optional(one["peak_memory_bytes"], lambda size: f"{size / 1e9:.2f}"),
        optional(before and one["size_bytes_before_tuning"] / 1e6, ".3f"),
        optional(before and before["psnr_mean"], ".2f"),
    ]


def _series(one: Mapping[str, Any]) -> tuple[str, str | None]:
    """Return the plot series of a file: the command that made it, and what it is made without."""
    return one["by"], one.get("without")


def _their_row(one: Published) -> list[str]:
    return [
        one.method,
        f"{one.size_bytes / 1e6:.3f}",
        f"{one.psnr:.2f}",
        optional(one.ssim, ".4f"),
        optional(one.lpips, ".4f"),
        "yes" if one.network else "no",
        one.source,
    ]


def plot(known: Mapping[str, Any], name: str, path: Path) -> None:
    """Draw PSNR over bytes; nothing if no file is known.

    Args:
        known: the stored results.
        name: name of the scene, as published figures are kept.
        path: an SVG, replaced. The same results give the same bytes.
    """
    files = [one for _, one in _by_size(known)]
    if not files:
        return
    from matplotlib import rc_context

    with rc_context({"svg.fonttype": "none", "font.size": 9}):  # text stays text: small
        figure = new_figure(7.2, 4.4)
        axis = figure.subplots()
        axis.set_xscale("log")
        for method, (colour, marker) in _STYLES.items():
            points = sorted((one.size_bytes, one.psnr) for one in PUBLISHED.get(name, ()) if one.method == method)
            if points:
                axis.plot(*zip(*points, strict=True), f"{marker}--", color=colour, markersize=5, lw=1, label=method)
        for by, without in dict.fromkeys(_series(one) for one in files):
            colour, style = _OURS[by]
            points = [(one["size_bytes"], one["psnr_mean"]) for one in files if (by, without) == _series(one)]
            label, face = (f"csplat {by}", colour) if without is None else (f"csplat {by}, without {without}", "none")
            axis.plot(*zip(*points, strict=True), style, color=colour, mfc=face, lw=1.8, label=label)
        ticks = [tick for tick in _TICKS if axis.get_xlim()[0] <= tick <= axis.get_xlim()[1]]
        axis.set_xticks(ticks, [f"{tick / 1e6:g}" for tick in ticks])
        axis.set_xticks([], minor=True)
        axis.set_xlabel("MB")
        axis.set_ylabel("PSNR, mean over the test views, dB")
        axis.set_title(known["title"], fontsize=9)
        axis.grid(color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=8, loc="lower right")
        save_svg(figure, path)
