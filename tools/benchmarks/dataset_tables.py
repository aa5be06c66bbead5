"""The tables of the benchmark: a block of rows per scene, means per set, and what makes them no papers' figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import fmean
from typing import Any

from dataset_protocols import (
    C3DGS,
    OTHER,
    PAPER_STEPS,
    PROTOCOLS,
    THREE_DGS,
    Protocol,
    Published,
    published_means,
    published_splats,
)

from csplat_tools.files.console import format_table

__all__ = ["HEADER", "means_table", "notes", "one_line", "scenes_table"]

HEADER = (
    "scene", "file", "PSNR", "SSIM", "LPIPS", "LPIPS-VGG", "MB", "splats", "SH", "pixels", "views", "steps", "train",
)  # fmt: skip
_MEASURES = ("psnr_mean", "ssim", "lpips")
_FIELDS = len(HEADER)


def one_line(row: dict[str, Any]) -> str:
    """A scene in one line, for when it is done."""
    parts = [f"{one['file']} {one['psnr_mean']:.2f} dB, {one['size_bytes'] / 1e6:.2f} MB" for one in row["files"]]
    return f"{row['title']}, {row['splats']} splats: " + "; ".join(parts)


def scenes_table(rows: Sequence[dict[str, Any]], *, markdown: bool) -> str:
    """Each scene: the trained PLY, its compressed files, and what was published for the scene.

    Args:
        rows: of `run_scene`.
        markdown: with pipes, for documents.
    """
    lines: list[list[str]] = []
    for row in rows:
        first, *others = [_file_cells(one, row) for one in row["files"]]
        about = _about(row)
        lines += [[*first[: -len(about)], *about], *others]
        if row["set"] != OTHER.slug:
            lines.append(_published_cells(row["title"], "3DGS, published", THREE_DGS[row["scene"]]))
    return _laid_out(lines, markdown=markdown)


def means_table(rows: Sequence[dict[str, Any]], *, markdown: bool) -> str | None:
    """Means over the scenes of each benchmark set; `None` where there is none of them."""
    lines: list[list[str]] = []
    for protocol in PROTOCOLS:
        own = [row for row in rows if row["set"] == protocol.slug]
        if own:
            lines += _mean_lines(protocol, own)
    return _laid_out(lines, markdown=markdown) if lines else None


def notes(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What a reader must know before comparing these figures with published ones; nothing where none are printed."""
    known = [row for row in rows if row["set"] != OTHER.slug]
    if not known:
        return []
    lines = [_fewer_steps(known), _smaller_pictures(known), _fewer_splats(known)]
    lines = [line for line in lines if line]
    if lines:
        lines.insert(0, "NOT THE PAPERS' SETTINGS: the rows of 3DGS and c3dgs are no like-for-like comparison.")
    lines.append("LPIPS is AlexNet's here; the papers printed VGG's, which stands in a column of its own.")
    lines.append(
        "Published: 3DGS, Kerbl et al. 2023, 30,000 steps on a GPU; c3dgs, Niedermayr et al. 2024, means of whole sets;"
        " MB as printed there."
    )
    return lines


def _fewer_steps(rows: Iterable[dict[str, Any]]) -> str:
    fewer = {
        row["title"]: row["settings"]["iterations"]
        for row in rows
        if row["settings"] is not None and row["settings"]["iterations"] < PAPER_STEPS
    }
    return f"- steps, the papers' {PAPER_STEPS}: " + _listed(fewer) if fewer else ""


def _smaller_pictures(rows: Iterable[dict[str, Any]]) -> str:
    smaller = {}
    for row in rows:
        papers = [800, 800] if row["set"] == "synthetic" else list(row["protocol_size"])
        if row["pixels"][0] < papers[0]:
            smaller[row["title"]] = f"{_pixels(row['pixels'])} for {_pixels(papers)}"
    return "- pictures smaller than the papers': " + _listed(smaller) if smaller else ""


def _fewer_splats(rows: Iterable[dict[str, Any]]) -> str:
    means = {protocol.slug: published_splats(protocol) for protocol in PROTOCOLS}
    few = {}
    for row in rows:
        cap, mean = None if row["settings"] is None else row["settings"]["max_splats"], means[row["set"]]
        if cap is not None and (mean is None or cap < mean):
            few[row["title"]] = f"{cap}" + (
                "" if mean is None else f" (3DGS, mean of its set: {mean / 1e6:.1f} million)"
            )
    return "- splats at most, where 3DGS has no limit: " + _listed(few) if few else ""


def _listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())


def _mean_lines(protocol: Protocol, rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """One line for each kind of file that all of the scenes have, then the papers'."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    title = f"{protocol.name}, {len(names)} of {len(protocol.factors)}"
    lines = []
    for name in (one["file"] for one in rows[0]["files"]):
        files = [one for row in rows for one in row["files"] if one["file"] == name]
        if len(files) < len(rows):
            continue
        values = [_mean(one[measure] for one in files) for measure in _MEASURES]
        size = fmean(one["size_bytes"] for one in files)
        cells = [title, name, *_scores(*values), "-", _megabytes(size)]
        about = ["-"] * (_FIELDS - len(cells))
        if not lines:
            about[0] = f"{fmean(row['splats'] for row in rows):.0f}"
            about[-1] = _seconds(_mean(row["train_seconds"] for row in rows))
        lines.append([*cells, *about])
    lines.append(_published_cells(title, f"3DGS, published, {len(names)}", published_means(protocol, names)))
    lines.append(_published_cells(title, f"c3dgs, published, {len(protocol.factors)}", C3DGS[protocol.slug]))
    return lines


def _file_cells(one: dict[str, Any], row: dict[str, Any]) -> list[str]:
    scores = _scores(*(one[measure] for measure in _MEASURES))
    cells = [row["title"], one["file"], *scores, "-", _megabytes(one["size_bytes"])]
    return [*cells, *["-"] * (_FIELDS - len(cells))]


def _about(row: dict[str, Any]) -> list[str]:
    steps = "?" if row["settings"] is None else str(row["settings"]["iterations"])
    return [
        str(row["splats"]),
        str(row["sh_degree"]),
        _pixels(row["pixels"]),
        str(row["test_views"]),
        steps,
        _seconds(row["train_seconds"]),
    ]


def _published_cells(title: str, name: str, published: Published) -> list[str]:
    cells = [
        title,
        name,
        *_scores(published.psnr, published.ssim, None),
        "-" if published.lpips_vgg is None else f"{published.lpips_vgg:.3f}",
        "-" if published.size_mb is None else f"{published.size_mb:.1f}",
    ]
    about = ["-"] * (_FIELDS - len(cells))
    about[-2:] = [str(PAPER_STEPS), published.train or "-"] if name.startswith("3DGS") else ["-", "-"]
    return [*cells, *about]


def _scores(psnr: float | None, ssim: float | None, lpips: float | None) -> list[str]:
    return ["-" if value is None else f"{value:.{digits}f}" for value, digits in ((psnr, 2), (ssim, 3), (lpips, 3))]


def _mean(values: Iterable[float | None]) -> float | None:
    known = list(values)
    numbers = [value for value in known if value is not None]
    return fmean(numbers) if len(numbers) == len(known) else None


def _seconds(value: float | None) -> str:
    return "?" if value is None else f"{value:.0f} s"


def _megabytes(size_bytes: float) -> str:
    return f"{size_bytes / 1e6:.{2 if size_bytes >= 1e6 else 3}f}"


def _pixels(size: Sequence[int]) -> str:
    return f"{size[0]}×{size[1]}"


def _laid_out(lines: list[list[str]], *, markdown: bool) -> str:
    if not markdown:
        return format_table(HEADER, lines)
    return "\n".join("| " + " | ".join(line) + " |" for line in [list(HEADER), ["---"] * _FIELDS, *lines])
