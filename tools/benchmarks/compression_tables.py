"""Tables and a plot of what `compression.py` measured."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from printing import laid_out

from csplat.files import atomic_writer
from csplat_tools.training.report import ply_splat_bytes

__all__ = ["plot_curve", "tables"]

Results = dict[str, dict[str, Any]]

_SCORES = (("psnr", 2), ("psnr_mean", 2), ("ssim", 4), ("lpips", 4))
_SCORE_NAMES = ("PSNR", "mean", "SSIM", "LPIPS")
_TITLES = {
    "main": "The file",
    "others": "Told otherwise",
    "sizes": "Codebook sizes",
    "escapes": "Thresholds: the share that escapes",
    "positions": "Bits per axis of positions",
    "curve": "Simplified first, and coarser",
}
_LINES = {"simplified first": "o-", "coarser": "s--", "both": "^"}
_WORK = ("choosing", "clustering", "tuning", "encoding")


def tables(results: Results, memory: dict[str, Any] | None = None, *, markdown: bool = False) -> str:
    """Everything that is known, as text.

    Args:
        results: by scene, what `compression.py` keeps.
        memory: by number of splats.
        markdown: as documents have tables.
    """
    parts = [_summary(results, markdown=markdown)]
    for name, one in results.items():
        parts += _scene_tables(name, one, markdown=markdown)
    parts += [_attributes(results, markdown=markdown), _times(results, markdown=markdown)]
    parts.append(_memory(memory or {}, markdown=markdown))
    return "\n\n".join(part for part in parts if part)


def _summary(results: Results, *, markdown: bool) -> str:
    """A line for each file, before and after tuning."""
    lines = []
    for name, one in results.items():
        facts = one.get("facts", {}).get("scene", {})
        for key, row in {**one.get("main", {}), **one.get("curve", {})}.items():
            source, before, after = facts["scores"], row["before"], row["after"]
            lines.append(
                (
                    name if key == "main" else f"{name}, {key}", f"{facts['splats']:,}",
                    f"{source['psnr']:.2f} / {source['psnr_mean']:.2f}", _sizes(row["before_bytes"], facts)[0],
                    *(_difference(before[score], source[score]) for score in ("psnr", "psnr_mean")),
                    *_sizes(row["after_bytes"], facts),
                    *(_difference(after[score], source[score]) for score in ("psnr", "psnr_mean")),
                    *_pairs(source, after), f"{_seconds(row):.0f}", _of_training(row, facts),
                )
            )  # fmt: skip
    header = (
        "", "splats", "PSNR / mean", "untuned B/splat", "PSNR", "mean", "tuned B/splat", "ratio", "PSNR", "mean",
        "SSIM", "LPIPS", "s", "% of training",
    )  # fmt: skip
    return _titled("Files, before and after tuning", laid_out(header, lines, markdown=markdown)) if lines else ""


def _pairs(source: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """SSIM and LPIPS of the source and of the file."""
    return [f"{_score(source, name, digits)} → {_score(after, name, digits)}" for name, digits in _SCORES[2:]]


def _of_training(row: dict[str, Any], facts: dict[str, Any]) -> str:
    training = facts["training"].get("seconds")
    return "-" if training is None else f"{100 * _seconds(row) / training:.0f}"


def _scene_tables(name: str, one: dict[str, Any], *, markdown: bool) -> list[str]:
    facts = one.get("facts", {}).get("scene")
    if facts is None:
        return []
    views = f"{facts['test_views']} held-out photographs"
    parts = [
        f"{name}: {facts['splats']:,} splats, SH {facts['sh_degree']}, {facts['train_views']} views that teach, {views}"
    ]
    if "main" in one.get("ablation", {}):
        parts.append(_titled("Ablation", _ablation(one["ablation"]["main"], facts, markdown=markdown)))
    for kind, title in _TITLES.items():
        if one.get(kind):
            parts.append(_titled(title, _files({**one.get("main", {}), **one[kind]}, facts, markdown=markdown)))
    if "main" in one.get("control", {}):
        parts.append(_titled("Control: as many steps unquantised", _control(one, facts, markdown=markdown)))
    if one.get("sh0"):
        parts.append(_titled("Base colour in the codebook, on the model", _sh0(one["sh0"], facts, markdown=markdown)))
    if "main" in one.get("histogram", {}):
        parts.append(_titled("Sensitivities", _histogram(one["histogram"]["main"], markdown=markdown)))
    return parts


def _titled(title: str, table: str) -> str:
    return f"{title}\n\n{table}"


def _ablation(rows: Sequence[dict[str, Any]], facts: dict[str, Any], *, markdown: bool) -> str:
    lines = [
        (
            row["row"], row["stored"], f"{row['size_bytes']:,}", *_sizes(row["size_bytes"], facts), *_scores(row),
            f"{row['seconds']:.1f}",
        )
        for row in rows
    ]  # fmt: skip
    header = ("", "stored as", "bytes", "B/splat", "ratio", *_SCORE_NAMES, "s")
    return laid_out(header, lines, markdown=markdown)


def _files(rows: dict[str, dict[str, Any]], facts: dict[str, Any], *, markdown: bool) -> str:
    lines = [
        (
            name,
            f"{100 * row['splats'] / facts['splats']:.1f}",
            *_book(row["sh_entries"], row["sh_escapes"]),
            *_book(row["shapes"], row["shape_escapes"]),
            _sizes(row["before_bytes"], facts)[0],
            _score(row["before"], "psnr", 2),
            *_sizes(row["after_bytes"], facts),
            *_scores(row["after"]),
            *(_difference(row["after"][score], facts["scores"][score]) for score in ("psnr", "psnr_mean")),
            f"{row['best_step']}",
            f"{_seconds(row):.1f}",
        )
        for name, row in rows.items()
    ]
    header = (
        "", "kept %", "SH", "escape %", "shapes", "escape %", "untuned B/splat", "PSNR", "tuned B/splat", "ratio",
        *_SCORE_NAMES, "to source", "mean to source", "best step", "s",
    )  # fmt: skip
    return laid_out(header, lines, markdown=markdown)


def _control(one: dict[str, Any], facts: dict[str, Any], *, markdown: bool) -> str:
    found, scores = one["control"]["main"], one["control"]["main"]["scores"]
    steps = f"{found['steps']} steps on floats"
    lines = [
        ("source", *_sizes(facts["splats"] * ply_splat_bytes(3), facts), *_scores(scores["source"]), ""),
        (
            steps, *_sizes(found["splats"] * ply_splat_bytes(3), facts), *_scores(scores["trained on"]),
            f"{found['seconds']:.1f}",
        ),
        (f"{steps}, then a file", *_sizes(found["size_bytes"], facts), *_scores(scores["then a file"]), ""),
    ]  # fmt: skip
    if "main" in one.get("main", {}):
        row = one["main"]["main"]
        lines.insert(1, ("file of the source", *_sizes(row["before_bytes"], facts), *_scores(row["before"]), ""))
        seconds = f"{row['seconds']['tuning']:.1f}"
        lines.append(
            (f"{row['steps']} steps on the file", *_sizes(row["after_bytes"], facts), *_scores(row["after"]), seconds)
        )
    return laid_out(("", "B/splat", "ratio", *_SCORE_NAMES, "s"), lines, markdown=markdown)


def _sh0(known: dict[str, Any], facts: dict[str, Any], *, markdown: bool) -> str:
    lines = []
    for rows in known.values():
        lines += [
            (
                row["row"], f"{row['entries']:,}", f"{100 * row['escapes']:.1f}",
                f"{row['colour_bytes'] / facts['splats']:.2f}", *_scores(row),
                _difference(row["psnr"], row["before"]["psnr"]),
            )
            for row in rows
        ]  # fmt: skip
    header = ("", "entries", "escape %", "colour B/splat", *_SCORE_NAMES, "to pruned")
    return laid_out(header, lines, markdown=markdown)


def _histogram(found: dict[str, Any], *, markdown: bool) -> str:
    decades = found["decades"]
    header = ("% of splats", "0", f"< 1e{decades[0]}", *(f"1e{at} …" for at in decades), "above the published")
    lines = [
        (
            name,
            *(f"{100 * share:.1f}" for share in shares),
            f"{100 * found['above'][name]:.1f}" if name in found["above"] else "",
        )
        for name, shares in found["shares"].items()
    ]
    return laid_out(header, lines, markdown=markdown)


def _attributes(results: Results, *, markdown: bool) -> str:
    rows = {name: one for name, one in results.items() if "main" in one.get("main", {})}
    attributes = list(dict.fromkeys(key for one in rows.values() for key in one["main"]["main"]["attribute_bytes"]))
    lines = []
    for name, one in rows.items():
        row, splats = one["main"]["main"], one["facts"]["scene"]["splats"]
        sizes = [row["attribute_bytes"].get(attribute, 0) for attribute in attributes]
        sizes += [row["after_bytes"] - sum(sizes), row["after_bytes"]]
        lines.append((name, *(f"{size / splats:.2f}" for size in sizes)))
    header = ("bytes per source splat", *attributes, "the rest", "all")
    return _titled("The file by attribute", laid_out(header, lines, markdown=markdown)) if lines else ""


def _times(results: Results, *, markdown: bool) -> str:
    lines = []
    for name, one in results.items():
        row = one.get("main", {}).get("main")
        if row is None:
            continue
        facts, total = one["facts"]["scene"], _seconds(row)
        training = facts["training"].get("seconds")
        lines.append(
            (
                name, f"{facts['splats']:,}", *(f"{row['seconds'].get(stage, 0.0):.1f}" for stage in _WORK),
                f"{total:.1f}", "-" if training is None else f"{training:.1f}",
                _of_training(row, facts),
            )
        )  # fmt: skip
    header = ("seconds", "splats", *_WORK, "all", "training", "% of it")
    return _titled("Time", laid_out(header, lines, markdown=markdown)) if lines else ""


def _memory(measured: dict[str, Any], *, markdown: bool) -> str:
    lines = []
    for splats, one in measured.items():
        report, growth = one["report"], one["peak_bytes"] - one["before_bytes"]
        size = f"{report['size_bytes'] / report['source_splats']:.2f}"
        lines.append(
            (
                f"{int(splats):,}", f"{one['peak_bytes'] / 1e6:,.0f}", f"{one['before_bytes'] / 1e6:,.0f}",
                f"{growth / int(splats):,.0f}", f"{report['steps']}", size,
            )
        )  # fmt: skip
    header = ("splats", "peak MB", "before MB", "growth, B/splat", "steps", "file, B/splat")
    return _titled("Peak memory of `csplat finetune`", laid_out(header, lines, markdown=markdown)) if lines else ""


def plot_curve(results: Results, path: Path) -> bool:
    """Draw bytes per source splat against the PSNR on held-out photographs; return whether there was anything."""
    scenes = {name: one for name, one in results.items() if one.get("curve") and "facts" in one}
    if not scenes:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(scenes), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (name, one) in enumerate(scenes.items()):
        facts, axes = one["facts"]["scene"], figure.add_subplot(1, len(scenes), number + 1)
        points = {**one.get("main", {}), **one["curve"]}
        for label, style in _LINES.items():
            shown = [row for key, row in points.items() if label in _lines_of(key)]
            shown.sort(key=lambda row: int(row["after_bytes"]))
            sizes = [row["after_bytes"] / facts["splats"] for row in shown]
            axes.plot(sizes, [row["after"]["psnr"] for row in shown], style, label=label)
        source = facts["scores"]["psnr"]
        axes.axhline(source, color="0.4", linewidth=1, label="source")
        axes.axhline(source - 0.25, color="0.6", linewidth=1, linestyle=":", label="0.25 dB below")
        axes.set(title=name, xlabel="bytes per source splat", ylabel="PSNR on held-out photographs, dB")
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize="small")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    with atomic_writer(path) as stream:
        stream.write(buffer.getvalue())
    return True


def _lines_of(key: str) -> tuple[str, ...]:
    """Which lines of the plot go through a row."""
    if key == "main":
        return "simplified first", "coarser"
    if "," in key:
        return ("both",)
    return ("simplified first",) if key.startswith("keep") else ("coarser",)


def _sizes(size_bytes: int, facts: dict[str, Any]) -> tuple[str, str]:
    """Bytes per source splat, and how many times smaller than the PLY of 62 floats."""
    splats = facts["splats"]
    return f"{size_bytes / splats:.2f}", f"{splats * ply_splat_bytes(3) / size_bytes:.1f}"


def _scores(one: dict[str, Any]) -> list[str]:
    return [_score(one, name, digits) for name, digits in _SCORES]


def _score(one: dict[str, Any], name: str, digits: int) -> str:
    return "-" if one[name] is None else f"{one[name]:.{digits}f}"


def _difference(value: float, other: float) -> str:
    return f"{value - other:+.2f}"


def _book(entries: int, escapes: float | None) -> tuple[str, str]:
    return f"{entries:,}" if entries else "-", "-" if escapes is None else f"{100 * escapes:.1f}"


def _seconds(row: dict[str, Any]) -> float:
    """Of all that the compression takes; reading and judging left out."""
    return float(sum(row["seconds"].get(stage, 0.0) for stage in _WORK))
