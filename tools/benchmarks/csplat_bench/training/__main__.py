"""Measure a step of training, stage by stage, and the memory that training takes.

    python -m csplat_bench.training                        # Lego of the data folder; two minutes
    python -m csplat_bench.training FOLDER --rows 20000:200x200 --steps 100

FOLDER is a data set. Each row runs in a process of its own: splats start as in training, with SH degree 3 and pictures
of the row's size, --warm steps make their sizes realistic, then as many steps as --steps are timed, medians. Memory is
what the process grew by at its largest, from the moment that the pictures were read.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from csplat_bench.common.command import JSON, THREADS, WrongWords, listed, run
from csplat_bench.common.measuring import alone
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import DATA
from csplat_bench.training.stages import STAGES, Steps, measured
from csplat_tools.console import note

_ROWS = "1000:200x200,20000:200x200,100000:400x400,500000:640x480"
_HEADER = (
    "splats", "pixels", "step ms", "CPU ms", *(f"{name} ms" for name in STAGES), "PSNR dB", "memory MB", "B/splat",
    "B/pixel",
)  # fmt: skip


def main(
    folder: Annotated[Path, typer.Argument(help="a data set")] = DATA / "images" / "lego200",
    *,
    rows: Annotated[str, typer.Option(help="SPLATS:WIDTHxHEIGHT, with commas")] = _ROWS,
    warm: Annotated[int, typer.Option(help="steps before the clock starts")] = 200,
    steps: Annotated[int, typer.Option(help="steps that are timed")] = 60,
    threads: THREADS = None,
    json: JSON = None,
) -> None:
    """Measure the rows that the command line names, each in a process of its own, and print a table."""
    machine, found = tell_machine(), []
    for row in listed(rows):
        count, width, height = _numbers(row)
        found.append(alone(measured, folder, count, (width, height), warm, steps, threads))
        note(f"{row} measured")
    print(table(_HEADER, map(_cells, found)))
    if json is not None:
        write_json(json, {"machine": machine, "results": [asdict(one) for one in found]})


def _numbers(row: str) -> tuple[int, int, int]:
    try:
        count, width, height = map(int, row.replace("x", ":").split(":"))
    except ValueError:
        raise WrongWords(f"a row is {row}, wanted SPLATS:WIDTHxHEIGHT") from None
    return count, width, height


def _cells(one: Steps) -> list[str]:
    width, height = one.size
    return [
        f"{one.splats:,}",
        f"{width}×{height}",
        *(f"{1e3 * one.seconds[name]:.1f}" for name in ("step", "CPU", *STAGES)),
        f"{one.psnr:.1f}",
        f"{one.memory_bytes / 1e6:.0f}",
        f"{one.memory_bytes / one.splats:.0f}",
        f"{one.memory_bytes / (width * height):.0f}",
    ]


if __name__ == "__main__":
    sys.exit(run(main))
