"""Tables of a sweep: as text for a terminal, and as cells for a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from csplat_tools.console import format_bytes, format_table
from csplat_tools.tradeoffs.sweep_points import PartialFetch, SweepPoint
from csplat_tools.tradeoffs.sweep_run import Tradeoff
from csplat_tools.views import describe_views

#: Mark before the names of points on the Pareto front.
MARK = "*"


_LINE_MBITS = 10.0  # Mbit/s of a mobile connection, for the columns of download times


@dataclass(frozen=True)
class Column:
    """A column of the table of points.

    Attributes:
        title: title of the column.
        hint: its meaning, in a sentence.
        value: returns the value of a point; `None` if it is not known.
        digits: number of digits after the decimal point.
        detailed: shown on the page only: a terminal is too narrow.
    """

    title: str
    hint: str
    value: Callable[[SweepPoint], float | None]
    digits: int
    detailed: bool = False

    def text(self, point: SweepPoint) -> str:
        """Return the text of a point's cell."""
        value = self.value(point)
        return "-" if value is None else f"{value:.{self.digits}f}"


def columns_of(tradeoff: Tradeoff) -> list[Column]:
    """Return the columns for which a sweep has data."""
    columns = [
        Column("bytes", "Size of the file.", lambda one: one.size_bytes, 0),
        Column("bytes/splat", "Size of the file over the number of splats of the source: comparable between scenes.",
               lambda one: one.bytes_per_source_splat, 2),
        Column("smaller", "How many times the file is smaller than the source.", lambda one: one.ratio, 1),
        Column("PSNR", "How near pictures of the file come to pictures of the source, in dB, more is better: at 30"
               " people see a difference, at 40 they hardly do. Of the squared error pooled over all views.",
               lambda one: one.psnr, 2),
        Column("worst PSNR", "Of the view that came out worst.", lambda one: one.quality.psnr_worst, 2),
        Column("SSIM", "Likeness of structure, 1 at best: the mean over the views.", lambda one: one.quality.ssim, 4),
    ]  # fmt: skip
    if tradeoff.setting.distance is not None:
        columns.append(
            Column("LPIPS", "Distance as a trained network sees it (Alex), 0 at best: the mean over the views.",
                   lambda one: one.quality.lpips, 4)
        )  # fmt: skip
    if tradeoff.setting.views.images:
        columns.append(
            Column("photo PSNR", "dB against photographs that training has not seen.",
                   lambda one: one.image_psnr, 2)
        )  # fmt: skip
    columns += [
        Column("splats", "How many the file holds.", lambda one: one.splats, 0),
        Column("SH degree", "Of the spherical harmonics that the file holds: colours that change with the direction of"
               " view. 0: none.", lambda one: one.sh_degree, 0, detailed=True),
        Column("encode s", "Seconds that making the file took, one run.", lambda one: one.encode_seconds, 2),
        Column("decode ms", "Milliseconds from the bytes to arrays of splats.",
               lambda one: 1000.0 * one.decode_seconds, 1),
        Column("preview kB", "What a viewer fetches before it shows the first picture, kB: everything but the spherical"
               " harmonics, which come afterwards.", lambda one: one.first_picture_bytes / 1000.0, 1),
        Column("preview s", f"Seconds that this takes on a line of {_LINE_MBITS:g} Mbit/s.",
               lambda one: _line_seconds(one.first_picture_bytes), 2, detailed=True),
        Column("download s", "Seconds that the whole file takes on the same line.",
               lambda one: _line_seconds(one.size_bytes), 2, detailed=True),
    ]  # fmt: skip
    for mode in tradeoff.source_modes:
        title = "render ms" if mode == "standard" else f"render ms, {mode}"
        hint = f"Milliseconds to draw a view on this machine's processor in the renderer's mode {mode}; the median."
        columns.append(Column(title, hint, _milliseconds(mode), 1))
    return columns


def format_tradeoff(tradeoff: Tradeoff) -> str:
    """Return all tables as text."""
    columns = [one for one in columns_of(tradeoff) if not one.detailed]
    front = {one.name for one in tradeoff.front}
    rows: list[Sequence[object]] = [
        (f"{MARK if one.name in front else ' '} {one.name}", *(column.text(one) for column in columns))
        for one in tradeoff.measured
    ]
    setting = tradeoff.setting
    count = f"{len(setting.source)} splats, SH degree {setting.source.sh_degree}"
    parts = [
        f"{setting.name}: {count}, {format_bytes(setting.source_bytes)}; {views_line(tradeoff)}",
        format_table(("  file", *(column.title for column in columns)), rows)
        + f"\n{MARK} no other file is smaller and at least as good, by PSNR",
        "\n".join(f"{column.title:{max(len(one.title) for one in columns)}}  {column.hint}" for column in columns),
    ]
    if tradeoff.failures:
        parts.append("\n".join(f"not measured: {one.name}: {one.error}" for one in tradeoff.failures))
    modes = mode_rows(tradeoff)
    parts.append(format_table(("renderer", *modes[0]), modes[1:]))
    partial = partial_rows(tradeoff)
    if len(partial) > 1:
        parts.append(format_table(("fewer SH layers", *partial[0]), partial[1:]))
    if tradeoff.source_image_scores is not None:
        scores = tradeoff.source_image_scores
        parts.append(f"the source itself scores {scores.psnr:.2f} dB against {len(scores.each)} held-out photographs")
    machine = tradeoff.machine
    parts.append(
        f"Times are single runs with {machine['threads']} threads on {machine['cores']} cores ({machine['processor']}),"
        f" csplat {machine['csplat']}, numpy {machine['packages']['numpy']}, numba {machine['packages']['numba']}."
    )
    return "\n\n".join(parts)


def views_line(tradeoff: Tradeoff) -> str:
    """Describe the test views in a line."""
    setting = tradeoff.setting
    sizes = sorted({(camera.W, camera.H) for camera in setting.views.test})
    size = f"{sizes[0][0]}x{sizes[0][1]}" if len(sizes) == 1 else f"{len(sizes)} sizes"
    return f"judged from {describe_views(len(setting.views.test), setting.views.name)}, {size}"


def mode_rows(tradeoff: Tradeoff) -> list[tuple[str, ...]]:
    """Return times and PSNR of the renderer's modes: a header without its first cell, and a row for each mode."""
    shown = _presets(tradeoff) or tradeoff.front[-1:]
    header: tuple[str, ...] = (
        "source ms",
        "source PSNR",
        *(f"{one.name} {what}" for one in shown for what in ("ms", "PSNR")),
    )
    rows = list[tuple[str, ...]]([header])
    for mode, source in tradeoff.source_modes.items():
        cells = [mode, f"{source.milliseconds:.1f}", f"{source.psnr:.2f}"]
        for one in shown:
            cells += [f"{one.modes[mode].milliseconds:.1f}", f"{one.modes[mode].psnr:.2f}"]
        rows.append(tuple(cells))
    return rows


def partial_rows(tradeoff: Tradeoff) -> list[tuple[str, ...]]:
    """Return results for files with fewer SH layers fetched: a header without its first cell, and the rows."""
    rows: list[tuple[str, ...]] = [
        ("bytes", "of the file", "PSNR", "worst PSNR", "SSIM", "decode ms", "render ms"),
    ]
    rows += [_partial_row(point, one) for point in tradeoff.measured for one in point.partial]
    return rows


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


def _presets(tradeoff: Tradeoff) -> list[SweepPoint]:
    return [one for one in tradeoff.measured if one.family == "presets"]


def _line_seconds(size_bytes: int) -> float:
    return 8.0 * size_bytes / (_LINE_MBITS * 1e6)


def _milliseconds(mode: str) -> Callable[[SweepPoint], float | None]:
    return lambda one: one.modes[mode].milliseconds
