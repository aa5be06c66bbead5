"""The light baseline, repeated: Lego at 200×200, by number of splats.

    python tools/benchmarks/train_lego.py FOLDER [--splats 1000,5000] [--iterations 7000] [--lpips FILE.npz]

FOLDER is the NeRF-synthetic set, pictures of 200×200 pixels (others are scaled). One process for
each row, so that memory is that of the run alone. Trained in front of white, SH degree 1 at 1,000
splats as in the published study (15.08 dB, SSIM 0.690, LPIPS 0.572 in 75 minutes), 3 elsewhere.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from machine import describe_machine

from csplat_tools.files.console import format_table

_HEADER = ("splats", "SH", "PSNR mean, dB", "pooled", "covered", "SSIM", "LPIPS", "train, s", "ms/step", "peak, MB")


def main() -> None:
    """Train each row and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splats", default="1000,5000,10000,20000")
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--lpips", type=Path)
    parser.add_argument("--keep", type=Path, help="folder for the scenes, logs and early pictures")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for count in (int(text) for text in arguments.splats.split(",")):
            log = run(arguments, folder, count, 1 if count == 1000 else 3)
            rows.append(row(log))
            print("  ".join(rows[-1]), file=sys.stderr, flush=True)
    print(format_table(_HEADER, rows))
    print(*(f"{name}: {text}" for name, text in describe_machine(("numpy", "numba")).items()), sep="\n")
    print(f"load average at the end: {os.getloadavg()[0]:.1f}")


def run(arguments: argparse.Namespace, folder: Path, count: int, degree: int) -> dict[str, Any]:
    """Train one scene; its log."""
    name = folder / f"lego{count}"
    command = [sys.executable, "-m", "csplat_tools", "train", str(arguments.folder), "-o", f"{name}.ply", "--force"]
    command += ["--max-splats", str(count), "--sh-degree", str(degree), "--iterations", str(arguments.iterations)]
    command += ["--size", "200x200", "--json", f"{name}.json", "--previews", f"{name}", "--quiet"]
    if arguments.lpips is not None:
        command += ["--lpips-weights", str(arguments.lpips)]
    subprocess.run(command, check=True)
    log: dict[str, Any] = json.loads(Path(f"{name}.json").read_text())
    return log


def row(log: dict[str, Any]) -> list[str]:
    """One line of the table."""
    m = log["metrics"]
    return [
        str(log["splat_count"]),
        str(log["options"]["sh_degree"]),
        f"{m['psnr_mean']:.2f}",
        f"{m['psnr']:.2f}",
        f"{m['psnr_covered']:.2f}",
        f"{m['ssim']:.3f}",
        "-" if m["lpips"] is None else f"{m['lpips']:.3f}",
        f"{log['seconds']:.0f}",
        f"{1e3 * log['seconds'] / len(log['losses']):.1f}",
        f"{log['peak_memory_bytes'] / 1e6:.0f}",
    ]


if __name__ == "__main__":
    main()
