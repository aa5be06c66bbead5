"""Tables and a plot of what `simplify.py` measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from csplat_tools.console import format_table

__all__ = ["plot_files", "tables"]

_TWIN = (("never finished", "largest"), ("finished", "median"), ("finished", "sum"))
_COLUMNS = ("opacity", "opacity-area", "exact", "rounds")

_HEADER = (
    "PSNR, dB", *_COLUMNS, "+ colours", "+ shapes", "used views", "check views", "far: rounds", "+ colours", "views",
    "rounds s", "colours s", "all s",
)  # fmt: skip

Results = dict[str, dict[str, Any]]


def tables(results: Results) -> str:
    """Everything that is known, as text."""
    parts = [
        _pass_table(results),
        *(_removal_table(name, one["removal"]) for name, one in results.items() if "removal" in one),
    ]
    parts += [_files_table(results), _bands_table(results)]
    return "\n\n".join(part for part in parts if part)


def _removal_table(name: str, measured: dict[str, Any]) -> str:
    percents = sorted({int(key.split()[0]) for key in measured})
    rows = []
    for percent in percents:
        found = [measured.get(f"{percent} {method}") for method in _COLUMNS]
        row = [f"{name} {percent} %", *("-" if one is None else f"{one['psnr']:.1f}" for one in found)]
        last = found[-1]
        if last is not None:
            row += [f"{last[key]:.1f}" for key in ("fit_psnr", "adjusted_psnr", "adjusted_used", "adjusted_check")]
            far = measured.get(f"{percent} far")
            row += ["-"] * 2 if far is None else [f"{far['psnr']:.1f}", f"{far['fit_psnr']:.1f}"]
            row.append(f"{last['views']}")
            row += [f"{last[key]:.0f}" for key in ("seconds", "fit_seconds", "adjusted_seconds")]
        rows.append([*row, *["-"] * (len(_HEADER) - len(row))])
    return format_table(_HEADER, rows)


def _files_table(results: Results) -> str:
    rows = []
    for name, one in results.items():
        for goal, file in sorted(one.get("files", {}).items(), key=lambda item: float(item[0])):
            count, plain, size = file["source_splats"], file["plain_bytes"], file["size_bytes"]
            saved = "-" if plain is None else f"{100.0 * (1.0 - size / plain):.0f}"
            rows.append(
                (
                    f"{name} at {goal} dB", "-" if plain is None else f"{plain / count:.2f}",
                    f"{size / count:.2f}", saved,
                    f"{100.0 * file['splats'] / count:.0f}", f"{file['psnr']:.2f}", f"{file['seconds']:.0f}",
                )
            )  # fmt: skip
    header = ("bytes per source splat", "without", "with", "saved %", "splats %", "PSNR", "s")
    return format_table(header, rows) if rows else ""


def _pass_table(results: Results) -> str:
    rows = []
    for name, one in results.items():
        if "pass" not in one:
            continue
        seconds, twin = one["pass"].get("seconds", {}), one["pass"].get("twin", {})
        views = seconds.get("views", 1)
        rows.append(
            (
                name, *(f"{1000.0 * seconds.get(key, 0.0) / views:.1f}" for key in ("render", "pass", "step")),
                *(f"{twin[rule][key]:.1e}" for rule, key in _TWIN if rule in twin),
            )
        )  # fmt: skip
    header = (
        "the pass, per view",
        "render ms",
        "pass ms",
        "step of a fit ms",
        "off twin: largest",
        "with stop: median",
        "of the sum",
    )
    return format_table(header, rows) if rows else ""


def _bands_table(results: Results) -> str:
    ways = ("values for all", "as runs", "tile cut", "zero codebooks", "k-means codebook")
    rows = []
    for name, one in results.items():
        for found in one.get("bands", {}).values():
            absent = " ".join(f"{100.0 * share:.0f}" for share in found["absent"])
            rows.append((name, absent, *(f"{found[way] / found['splats']:.2f}" for way in ways)))
    return format_table(("SH bytes per splat", "% without band", *ways), rows) if rows else ""


def plot_files(results: Results, path: Path) -> None:
    """Draw bytes per source splat against PSNR, without and with simplification; nothing where nothing is known."""
    scenes = {name: one["files"] for name, one in results.items() if one.get("files")}
    if not scenes:
        return
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    columns = min(4, len(scenes))
    rows = -(-len(scenes) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4 * columns, 3.2 * rows), squeeze=False)
    for axis in axes.flat[len(scenes) :]:
        axis.set_visible(False)
    for axis, (name, files) in zip(axes.flat, scenes.items(), strict=False):
        points = sorted(files.values(), key=lambda file: file["psnr"])
        plain = [file for file in points if file["plain_bytes"] is not None]
        axis.plot(
            [file["plain_bytes"] / file["source_splats"] for file in plain],
            [min(one["psnr"] for one in file["tried"] if one["size_bytes"] == file["plain_bytes"]) for file in plain],
            "o--", color="0.5", label="whole",
        )  # fmt: skip
        axis.plot(
            [file["size_bytes"] / file["source_splats"] for file in points], [file["psnr"] for file in points],
            "o-", color="C0", label="simplified",
        )  # fmt: skip
        axis.set_title(name)
        axis.set_xlabel("bytes per source splat")
        axis.set_ylabel("PSNR, dB")
        axis.grid(alpha=0.3)
        axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
