"""Tables of what was measured of compressions."""

from __future__ import annotations

from collections.abc import Mapping

from csplat_bench.common.report import Table, laid_out, optional
from csplat_bench.compression.rows import Facts, Known, Memory, Row, Scores
from csplat_tools.scene_files import ply_splat_bytes

Results = Mapping[str, Known]

_SCORES = ("PSNR", "mean", "SSIM", "LPIPS")
_WORK = ("choosing", "clustering", "tuning", "encoding")
_FILE = (
    "", "kept %", "SH", "escape %", "shapes", "escape %", "untuned B/splat", "PSNR", "tuned B/splat", "ratio", *_SCORES,
    "to source", "mean to source", "best step", "s",
)  # fmt: skip
_SUMMARY = (
    "", "splats", "PSNR / mean", "untuned B/splat", "PSNR", "mean", "tuned B/splat", "ratio", "PSNR", "mean", "SSIM",
    "LPIPS", "s", "% of training",
)  # fmt: skip


def tables(results: Results, memory: Mapping[str, Memory] | None = None, *, markdown: bool = False) -> str:
    """Everything that is known, as text.

    Args:
        results: by scene, what is kept of it.
        memory: by number of splats.
        markdown: format tables in Markdown.
    """
    known = {name: one for name, one in results.items() if "facts" in one}
    parts: list[Table | str] = [_summary(known)]
    for name, one in known.items():
        parts += _scene_parts(name, one)
    return laid_out([*parts, _attributes(known), _times(known), _memory(memory or {})], markdown=markdown)


def _summary(known: Results) -> Table:
    """A line for each file, before and after tuning."""
    lines = []
    for name, one in known.items():
        facts = one["facts"]["scene"]
        source = facts["scores"]
        for key, row in {**one.get("main", {}), **one.get("curve", {})}.items():
            before, after = row["before"], row["after"]
            lines.append(
                (
                    name if key == "main" else f"{name}, {key}",
                    f"{facts['splats']:,}",
                    f"{source['psnr']:.2f} / {source['psnr_mean']:.2f}",
                    _sizes(row["before_bytes"], facts)[0],
                    *_differences(before, source),
                    *_sizes(row["after_bytes"], facts),
                    *_differences(after, source),
                    f"{source['ssim']:.4f} → {after['ssim']:.4f}",
                    f"{optional(source['lpips'], '.4f')} → {optional(after['lpips'], '.4f')}",
                    f"{_seconds(row):.0f}",
                    _of_training(row, facts),
                )
            )
    return Table(_SUMMARY, lines, "Files, before and after tuning")


def _scene_parts(name: str, one: Known) -> list[Table | str]:
    facts, main = one["facts"]["scene"], one.get("main", {})
    views = f"{facts['train_views']} views that teach, {facts['test_views']} held-out photographs"
    steps = [
        (
            step["row"],
            step["stored"],
            f"{step['size_bytes']:,}",
            *_sizes(step["size_bytes"], facts),
            *_scores(step),
            f"{step['seconds']:.1f}",
        )
        for step in one.get("ablation", {}).get("main", [])
    ]
    varied = {
        "The file": main,
        "Told otherwise": one.get("others", {}),
        "Codebook sizes": one.get("sizes", {}),
        "Thresholds: the share that escapes": one.get("escapes", {}),
        "Bits per axis of positions": one.get("positions", {}),
        "Simplified first": one.get("curve", {}),
    }
    files = [
        Table(_FILE, [_file_cells(key, row, facts) for key, row in {**main, **rows}.items()], title)
        for title, rows in varied.items()
        if rows
    ]
    return [
        f"{name}: {facts['splats']:,} splats, SH {facts['sh_degree']}, {views}",
        Table(("", "stored as", "bytes", "B/splat", "ratio", *_SCORES, "s"), steps, "Ablation"),
        *files,
        _control(one),
    ]


def _file_cells(name: str, row: Row, facts: Facts) -> tuple[str, ...]:
    return (
        name,
        f"{100 * row['splats'] / facts['splats']:.1f}",
        *_book(row["sh_entries"], row["sh_escapes"]),
        *_book(row["shapes"], row["shape_escapes"]),
        _sizes(row["before_bytes"], facts)[0],
        f"{row['before']['psnr']:.2f}",
        *_sizes(row["after_bytes"], facts),
        *_scores(row["after"]),
        *_differences(row["after"], facts["scores"]),
        str(row["best_step"]),
        f"{_seconds(row):.1f}",
    )


def _control(one: Known) -> Table:
    """Compare the same number of training steps without quantisers with the steps that tune the file."""
    facts, main = one["facts"]["scene"], one.get("main", {}).get("main")
    lines = []
    for found in one.get("control", {}).values():
        steps, scores, seconds = f"{found['steps']} steps on floats", found["scores"], f"{found['seconds']:.1f}"
        rows = [
            ("source", facts["splats"] * ply_splat_bytes(3), scores["source"], ""),
            (steps, found["splats"] * ply_splat_bytes(3), scores["trained on"], seconds),
            (f"{steps}, then a file", found["size_bytes"], scores["then a file"], ""),
        ]
        if main is not None:
            tuning = f"{main['seconds']['tuning']:.1f}"
            rows.insert(1, ("file of the source", main["before_bytes"], main["before"], ""))
            rows.append((f"{main['steps']} steps on the file", main["after_bytes"], main["after"], tuning))
        lines += [(name, *_sizes(size, facts), *_scores(score), spent) for name, size, score, spent in rows]
    return Table(("", "B/splat", "ratio", *_SCORES, "s"), lines, "Control: as many steps unquantised")


def _attributes(known: Results) -> Table:
    rows = {name: one["main"]["main"] for name, one in known.items() if "main" in one.get("main", {})}
    attributes = list(dict.fromkeys(key for row in rows.values() for key in row["attribute_bytes"]))
    lines = []
    for name, row in rows.items():
        sizes = [row["attribute_bytes"].get(attribute, 0) for attribute in attributes]
        sizes += [row["after_bytes"] - sum(sizes), row["after_bytes"]]
        lines.append((name, *(f"{size / known[name]['facts']['scene']['splats']:.2f}" for size in sizes)))
    return Table(("bytes per source splat", *attributes, "the rest", "all"), lines, "The file by attribute")


def _times(known: Results) -> Table:
    lines = []
    for name, one in known.items():
        row, facts = one.get("main", {}).get("main"), one["facts"]["scene"]
        if row is not None:
            stages = (f"{row['seconds'].get(stage, 0.0):.1f}" for stage in _WORK)
            training = optional(facts["training"].get("seconds"), ".1f")
            cells = (f"{_seconds(row):.1f}", training, _of_training(row, facts))
            lines.append((name, f"{facts['splats']:,}", *stages, *cells))
    return Table(("seconds", "splats", *_WORK, "all", "training", "% of it"), lines, "Time")


def _memory(measured: Mapping[str, Memory]) -> Table:
    lines = [
        (
            f"{int(splats):,}",
            f"{one['peak_bytes'] / 1e6:,.0f}",
            f"{one['before_bytes'] / 1e6:,.0f}",
            f"{(one['peak_bytes'] - one['before_bytes']) / int(splats):,.0f}",
            f"{one['report']['steps']}",
            f"{one['report']['size_bytes'] / one['report']['source_splats']:.2f}",
        )
        for splats, one in measured.items()
    ]
    header = ("splats", "peak MB", "before MB", "growth, B/splat", "steps", "file, B/splat")
    return Table(header, lines, "Peak memory of `csplat finetune`")


def _sizes(size_bytes: int, facts: Facts) -> tuple[str, str]:
    """Bytes per source splat, and how many times smaller than the PLY of 62 floats."""
    splats = facts["splats"]
    return f"{size_bytes / splats:.2f}", f"{splats * ply_splat_bytes(3) / size_bytes:.1f}"


def _scores(one: Scores) -> tuple[str, ...]:
    return f"{one['psnr']:.2f}", f"{one['psnr_mean']:.2f}", f"{one['ssim']:.4f}", optional(one["lpips"], ".4f")


def _differences(one: Scores, source: Scores) -> tuple[str, str]:
    return f"{one['psnr'] - source['psnr']:+.2f}", f"{one['psnr_mean'] - source['psnr_mean']:+.2f}"


def _book(entries: int, escapes: float | None) -> tuple[str, str]:
    return f"{entries:,}" if entries else "-", optional(escapes, lambda share: f"{100 * share:.1f}")


def _of_training(row: Row, facts: Facts) -> str:
    return optional(facts["training"].get("seconds"), lambda seconds: f"{100 * _seconds(row) / seconds:.0f}")


def _seconds(row: Row) -> float:
    """Return the total time of the compression, without reading and judging."""
    return float(sum(row["seconds"].get(stage, 0.0) for stage in _WORK))
