"""Tables of the study: its published rows next to ours, and the results of each scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from csplat_bench.common.report import Table, laid_out, optional
from csplat_bench.study.records import Facts, Measured, Results

MIB = 1 << 20


@dataclass(frozen=True)
class Published:
    """A row as it was published; Lego at 200×200, 200 test views.

    Attributes:
        mib: raw float32, or codebooks and indices, MiB.
        ratio: to the baseline.
        splats: number of splats kept.
        psnr, psnr_std: dB, mean and standard deviation over views.
        ssim, lpips: means.
    """

    mib: float
    ratio: float
    splats: int
    psnr: float
    psnr_std: float
    ssim: float
    lpips: float


#: By our name of the row. Codebook sizes were not given.
PUBLISHED = {
    "baseline": Published(0.0877, 1.0, 1000, 15.08, 1.18, 0.6900, 0.5721),
    "SH 0": Published(0.0534, 1.64, 1000, 15.17, 0.97, 0.6895, 0.5733),
    "SH 0, τ 0.005": Published(0.0109, 8.05, 204, 10.16, 1.10, 0.6781, 0.5617),
    "SH 0, τ 0.01": Published(0.0105, 8.34, 197, 10.16, 1.10, 0.6782, 0.5617),
    "SH 0, τ 0.02": Published(0.0097, 9.08, 181, 10.16, 1.10, 0.6784, 0.5617),
    "k-means": Published(0.0136, 6.47, 1000, 9.52, 0.96, 0.4836, 0.6593),
}
_PUBLISHED_MINUTES = "75 minutes of training, 5 to 8 for the suite"

_HEADER = ("", "splats", "MiB", "ratio", "PSNR", "SSIM", "LPIPS", ".csplat, bytes", "ratio", "its PSNR", "s")


def tables(results: Results, *, markdown: bool = False) -> str:
    """Everything that is known, scene by scene.

    Args:
        results: by name of the scene, what is kept of it.
        markdown: format tables in Markdown.
    """
    parts = []
    for name, one in results.items():
        facts = one["facts"]
        how = "" if facts["how"] is None else f": {facts['how']}"
        head = f"{name}{how}; {facts['splats']:,} splats, SH {facts['sh_degree']}, judged by {facts['judged_by']}"
        published = PUBLISHED if name == "study1k" else {}
        lines = [_line(key, one["rows"][key], facts, published.get(key)) for key in one["order"]]
        header: list[str] = list(_HEADER)
        if published:
            header[1:7] = [f"{title} (published)" for title in _HEADER[1:7]]
        parts.append(Table(header, lines, head))
    return laid_out([*parts, _books(results), _times(results)], markdown=markdown)


def _line(key: str, row: Measured, facts: Facts, published: Published | None) -> list[str]:
    decoded = row["how"]["decoded"]
    cells = [
        f"{row['splats']:,}",
        "–" if decoded else f"{row['study_bytes'] / MIB:.4f}",
        "–" if decoded else f"{facts['bytes'] / row['study_bytes']:.2f}×",
        _with_std(row["psnr_mean"], row["psnr_std"]),
        optional(row["ssim"], ".4f", "–"),
        optional(row["lpips"], ".4f", "–"),
    ]
    if published is not None:
        theirs = (
            f"{published.splats:,}", f"{published.mib:.4f}", f"{published.ratio:.2f}×",
            _with_std(published.psnr, published.psnr_std), f"{published.ssim:.4f}", f"{published.lpips:.4f}",
        )  # fmt: skip
        cells = [f"{ours} ({other})" for ours, other in zip(cells, theirs, strict=True)]
    ratio = facts["bytes"] / row["csplat_bytes"]
    file = (f"{row['csplat_bytes']:,}", f"{ratio:.2f}×", _with_std(row["file_psnr_mean"], row["file_psnr_std"]))
    return [key, *cells, *file, f"{row['seconds']:.1f}"]


def _with_std(mean: float, std: float) -> str:
    return f"{mean:.2f} ± {std:.2f}"


def _books(results: Results) -> Table:
    """Entries of each codebook, as they came to be."""
    lines = []
    for name, one in results.items():
        for key in one["order"]:
            books = one["rows"][key]["books"]
            if books:
                sizes = ", ".join(f"{attribute} {_entries(book)}" for attribute, book in sorted(books.items()))
                lines.append((name, key, sizes))
    return Table(("", "row", "entries"), lines, "Codebooks: entries (share of the variance that is lost)")


def _entries(book: dict[str, Any]) -> str:
    sizes = "+".join(str(size) for size in book["sizes"]) or "none"
    return f"{sizes} ({book['error_share']:.2g})"


def _times(results: Results) -> Table:
    lines, total = list[tuple[str, ...]](), 0.0
    for name, one in results.items():
        # Renders are of a scene that counts already.
        trained = None if "@" in name else one["facts"]["training_seconds"]
        spent = sum(row["seconds"] for row in one["rows"].values())
        total += spent + (trained if trained is not None and name.startswith("study1k") else 0.0)
        each = spent / max(1, len(one["rows"]))
        lines.append((name, optional(trained, ".0f", "–"), f"{spent:.0f}", f"{each:.1f}"))
    title = f"Time (published: {_PUBLISHED_MINUTES}): {total / 60:.1f} minutes in all"
    without = "without the training of scenes that were trained for another benchmark"
    return Table(("", "training, s", "rows, s", "s per row"), lines, f"{title}, {without}")
