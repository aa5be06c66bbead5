"""What came of photographs: a table and a plot, beside published figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from csplat_bench.common.plots import new_figure, save_svg
from csplat_bench.common.report import Table, laid_out, optional
from csplat_bench.photographs.published import PUBLISHED, Published

__all__ = ["plot", "tables"]

# Okabe and Ito's colours, told apart by all eyes.
_OURS = "#0072B2"
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
)
_THEIR_HEADER = ("published", "MB", "PSNR mean, dB", "SSIM", "LPIPS (VGG)", "networks", "from")
_FROM, _TO = 3.5e5, 5.2e6  # bytes that the plot shows


def tables(known: Mapping[str, Any], name: str, *, markdown: bool = False) -> str:
    """Everything that is known of a scene.

    Args:
        known: as it is kept.
        name: of the scene, as published figures are kept.
        markdown: as documents have tables.
    """
    if "training" not in known:
        return "nothing is known yet"
    scene = known["training"]["scene"]
    rows = [_row(name, one) for name, one in (("trained scene", scene), *_by_size(known))]
    theirs = [_their_row(one) for one in sorted(PUBLISHED.get(name, ()), key=lambda one: one.size_bytes)]
    title = f"{known['title']}, {known['test_views']} held-out photographs: `{scene['command']}`"
    return laid_out([Table(_HEADER, rows, title), Table(_THEIR_HEADER, theirs)], markdown=markdown)


def _by_size(known: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    return sorted(known.get("files", {}).items(), key=lambda item: int(item[1]["size_bytes"]))


def _row(name: str, one: Mapping[str, Any]) -> list[str]:
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
    ]


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
    """Draw PSNR over bytes; nothing where no file is known.

    Args:
        known: as it is kept.
        name: of the scene, as published figures are kept.
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
        sizes, decibels = [one["size_bytes"] for one in files], [one["psnr_mean"] for one in files]
        axis.plot(sizes, decibels, "o-", color=_OURS, lw=1.8, label="csplat")
        axis.set_xlim(_FROM, _TO)
        ticks = [0.4e6, 0.6e6, 0.8e6, 1e6, 1.5e6, 2e6, 3e6, 4e6, 5e6]
        axis.set_xticks(ticks, [f"{tick / 1e6:g}" for tick in ticks])
        axis.set_xticks([], minor=True)
        axis.set_xlabel("MB")
        axis.set_ylabel("PSNR, mean over the test views, dB")
        axis.set_title(known["title"], fontsize=9)
        axis.grid(color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=8, loc="lower right")
        save_svg(figure, path)
