"""The light baseline, repeated: Lego at 200×200, by number of splats.

    python -m csplat_bench.training.lego FOLDER [--splats 1000,5000] [--iterations 7000] [--lpips FILE.npz]

FOLDER is the NeRF-synthetic set, pictures of 200×200 pixels (others are scaled). One process for each row, so that
memory is that of the run alone. Trained in front of white, SH degree 1 at 1,000 splats as in the published study
(15.08 dB, SSIM 0.690, LPIPS 0.572 in 75 minutes), 3 elsewhere.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from csplat_bench.common.command import LPIPS, listed, run
from csplat_bench.common.report import describe, optional, table
from csplat_bench.common.scenes import DATA
from csplat_tools.console import note

_HEADER = ("splats", "SH", "PSNR mean, dB", "pooled", "covered", "SSIM", "LPIPS", "train, s", "ms/step", "peak, MB")


def main(
    folder: Annotated[Path, typer.Argument(help="the data set")] = DATA / "images" / "lego200",
    *,
    splats: Annotated[str, typer.Option(help="of each row, separated by commas")] = "1000,5000,10000,20000",
    iterations: Annotated[int, typer.Option(help="of training")] = 7000,
    lpips: LPIPS = None,
) -> None:
    """Train each row and print the table."""
    rows = []
    for count in listed(splats):
        words = ["--max-splats", count, "--sh-degree", "1" if count == "1000" else "3", "--iterations", str(iterations)]
        words += [] if lpips is None else ["--lpips-weights", lpips]
        rows.append(_row(folder, words))
        note("  ".join(rows[-1]))
    print(table(_HEADER, rows))
    print(*(f"{name}: {text}" for name, text in describe().items()), sep="\n")
    print(f"load average at the end: {os.getloadavg()[0]:.1f}")


def _row(folder: Path, words: list[str]) -> list[str]:
    """Train one scene; its line of the table."""
    with tempfile.TemporaryDirectory() as scratch:
        ply, report = Path(scratch) / "scene.ply", Path(scratch) / "log.json"
        command = [sys.executable, "-m", "csplat_tools", "train", str(folder), "-o", str(ply), "--size", "200x200"]
        subprocess.run([*command, "--json", str(report), "--quiet", *words], check=True)
        log = json.loads(report.read_text())
    scores = log["metrics"]
    return [
        str(log["splat_count"]),
        str(log["options"]["sh_degree"]),
        *(f"{scores[name]:.2f}" for name in ("psnr_mean", "psnr", "psnr_covered")),
        f"{scores['ssim']:.3f}",
        optional(scores["lpips"], ".3f"),
        f"{log['seconds']:.0f}",
        f"{1e3 * log['seconds'] / len(log['losses']):.1f}",
        f"{log['peak_memory_bytes'] / 1e6:.0f}",
    ]


if __name__ == "__main__":
    sys.exit(run(main))
