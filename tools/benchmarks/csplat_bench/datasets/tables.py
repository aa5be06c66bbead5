"""The tables of the benchmark: a block of rows per scene, means per set, and what makes them no papers' figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

from csplat_bench.common.report import optional, table
from csplat_bench.datasets.protocols import (
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
from csplat_bench.datasets.records import File, Record

HEADER = (
    "scene", "file", "PSNR", "SSIM", "LPIPS", "LPIPS-VGG", "MB", "splats", "SH", "pixels", "views", "steps", "train",
)  # fmt: skip
_SYNTHETIC_PIXELS = (800, 800)

_NOTES = (
    "LPIPS is AlexNet's here; the papers printed VGG's, which stands in a column of its own.",
    "Published: 3DGS, Kerbl et al. 2023, 30,000 steps on a GPU; c3dgs, Niedermayr et al. 2024, whole sets; their MB.",
)


def scenes_table(records: Sequence[Record], *, markdown: bool) -> str:
    """Each scene: the trained PLY, its compressed files, and what was published for the scene."""
    lines: list[list[str]] = []
    for one in records:
        first, *others = [_file_cells(one["title"], file) for file in one["files"]]
        lines += [[*first, *_about(one)], *map(_filled, others)]
        if one["set"] != OTHER.slug:
            lines.append(_published_cells(one["title"], "3DGS, published", THREE_DGS[one["scene"]]))
    return table(HEADER, lines, markdown=markdown)


def means_table(records: Sequence[Record], *, markdown: bool) -> str:
    """Means over the scenes of each benchmark set; nothing if there is none of them."""
    lines: list[list[str]] = []
    for protocol in PROTOCOLS:
        own = [one for one in records if one["set"] == protocol.slug]
        lines += _mean_lines(protocol, own) if own else []
    return table(HEADER, lines, markdown=markdown)


def notes(records: Sequence[Record]) -> list[str]:
    """Return what a reader must know before comparing these figures with published ones; empty if none are printed."""
    known = [one for one in records if one["set"] != OTHER.slug]
    if not known:
        return []
    lesser = {
        f"- steps, the papers' {PAPER_STEPS}": _fewer_steps(known),
        "- pictures smaller than the papers'": _smaller_pictures(known),
        "- splats at most, where 3DGS has no limit": _fewer_splats(known),
    }
    lines = [
        f"{what}: " + ", ".join(f"{name} {value}" for name, value in values.items())
        for what, values in lesser.items()
        if values
    ]
    if lines:
        lines.insert(0, "NOT THE PAPERS' SETTINGS: the rows of 3DGS and c3dgs are no like-for-like comparison.")
    return [*lines, *_NOTES]


def _fewer_steps(records: Iterable[Record]) -> Mapping[str, object]:
    steps = {one["title"]: one["settings"]["iterations"] for one in records if one["settings"] is not None}
    return {name: count for name, count in steps.items() if count < PAPER_STEPS}


def _smaller_pictures(records: Iterable[Record]) -> Mapping[str, object]:
    found = {}
    for one in records:
        papers = _SYNTHETIC_PIXELS if one["set"] == "synthetic" else one["protocol_size"]
        if one["pixels"][0] < papers[0]:
            found[one["title"]] = f"{_pixels(one['pixels'])} for {_pixels(papers)}"
    return found


def _fewer_splats(records: Iterable[Record]) -> Mapping[str, object]:
    means = {protocol.slug: published_splats(protocol) for protocol in PROTOCOLS}
    found = {}
    for one in records:
        cap, mean = None if one["settings"] is None else one["settings"]["max_splats"], means[one["set"]]
        if cap is not None and (mean is None or cap < mean):
            beside = "" if mean is None else f" (3DGS, mean of its set: {mean / 1e6:.1f} million)"
            found[one["title"]] = f"{cap}{beside}"
    return found


def _mean_lines(protocol: Protocol, records: Sequence[Record]) -> list[list[str]]:
    """One line for each kind of file that all of the scenes have, then the papers'."""
    names = list(dict.fromkeys(one["scene"] for one in records))
    title, lines = f"{protocol.name}, {len(names)} of {len(protocol.factors)}", list[list[str]]()
    for name in (file["file"] for file in records[0]["files"]):
        files = [file for one in records for file in one["files"] if file["file"] == name]
        if len(files) < len(records):
            continue
        psnr, ssim, lpips = (
            _mean(values)
            for values in zip(*((one["psnr_mean"], one["ssim"], one["lpips"]) for one in files), strict=True)
        )
        cells = [title, name, *_scores(psnr, ssim, lpips), "-", _megabytes(fmean(one["size_bytes"] for one in files))]
        if not lines:
            splats = f"{fmean(one['splats'] for one in records):.0f}"
            cells += [splats, "-", "-", "-", "-", _seconds(_mean(one["train_seconds"] for one in records))]
        lines.append(_filled(cells))
    lines.append(_published_cells(title, f"3DGS, published, {len(names)}", published_means(protocol, names)))
    lines.append(_published_cells(title, f"c3dgs, published, {len(protocol.factors)}", C3DGS[protocol.slug]))
    return lines


def _file_cells(title: str, one: File) -> list[str]:
    scores = _scores(one["psnr_mean"], one["ssim"], one["lpips"])
    return [title, one["file"], *scores, "-", _megabytes(one["size_bytes"])]


def _about(one: Record) -> list[str]:
    steps = "?" if one["settings"] is None else str(one["settings"]["iterations"])
    pixels, views = _pixels(one["pixels"]), str(one["test_views"])
    return [str(one["splats"]), str(one["sh_degree"]), pixels, views, steps, _seconds(one["train_seconds"])]


def _published_cells(title: str, name: str, published: Published) -> list[str]:
    scores = _scores(published.psnr, published.ssim, None)
    cells = [title, name, *scores, optional(published.lpips_vgg, ".3f"), optional(published.size_mb, ".1f")]
    last = [str(PAPER_STEPS), published.train or "-"] if name.startswith("3DGS") else ["-", "-"]
    return [*cells, "-", "-", "-", "-", *last]


def _filled(cells: Sequence[str]) -> list[str]:
    return [*cells, *["-"] * (len(HEADER) - len(cells))]


def _scores(psnr: float | None, ssim: float | None, lpips: float | None) -> list[str]:
    return [optional(psnr, ".2f"), optional(ssim, ".3f"), optional(lpips, ".3f")]


def _mean(values: Iterable[float | None]) -> float | None:
    every = list(values)
    known = [value for value in every if value is not None]
    return fmean(known) if len(known) == len(every) else None


def _seconds(value: float | None) -> str:
    return optional(value, lambda seconds: f"{seconds:.0f} s", "?")


def _megabytes(size_bytes: float) -> str:
    return f"{size_bytes / 1e6:.{2 if size_bytes >= 1e6 else 3}f}"


def _pixels(size: Sequence[int]) -> str:
    return f"{size[0]}×{size[1]}"
