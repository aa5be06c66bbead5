"""One encoding after the other, for a process of its own."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from pathlib import Path

from csplat.encoder import EncodeOptions, encode
from csplat.ply import read_ply
from csplat_bench.common.command import preset_of
from csplat_bench.common.making import ARRAYS
from csplat_bench.common.measuring import medians, peak_bytes, reset_peak, timed


@dataclass(frozen=True)
class Run:
    """Time and memory of encoding.

    Attributes:
        seconds: median of the runs.
        growth_bytes: growth of the process during the first run.
        array_bytes: size of the scene's arrays.
    """

    seconds: float
    growth_bytes: int
    array_bytes: int


def encoded(ply: Path, output: Path, preset: str, threads: int | None, runs: int) -> Run:
    """Encode a PLY, from arrays to bytes, and write the file."""
    model, options = read_ply(ply), EncodeOptions(preset=preset_of(preset), threads=threads)
    gc.collect()
    before = reset_peak()
    data, timing = timed(encode, model, options)
    growth, timings = peak_bytes() - before, [timing]
    for _ in range(runs - 1):
        del data  # the next call does not find the memory taken
        data, timing = timed(encode, model, options)
        timings.append(timing)
    output.write_bytes(data)
    return Run(medians(timings).wall, growth, sum(getattr(model, name).nbytes for name in ARRAYS))
