"""One encoding or decoding after the other, for a process of its own."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import preset_of
from csplat_bench.common.making import ARRAYS
from csplat_bench.common.measuring import medians, peak_bytes, reset_peak, timed

__all__ = ["Run", "decoded", "encoded"]


@dataclass(frozen=True)
class Run:
    """What one way takes.

    Attributes:
        seconds: median of the runs.
        growth_bytes: what the first run made the process grow by.
        array_bytes: of the scene's arrays.
    """

    seconds: float
    growth_bytes: int
    array_bytes: int


def encoded(ply: Path, output: Path, preset: str, threads: int | None, runs: int) -> Run:
    """Encode a PLY, from arrays to bytes, and write the file."""
    model, options = read_ply(ply), EncodeOptions(preset=preset_of(preset), threads=threads)
    data, seconds, growth = _run(lambda: encode(model, options), runs)
    output.write_bytes(data)
    return Run(seconds, growth, _array_bytes(model))


def decoded(path: Path, runs: int) -> Run:
    """Decode a file, from bytes to arrays."""
    data = path.read_bytes()
    model, seconds, growth = _run(lambda: decode(data), runs)
    return Run(seconds, growth, _array_bytes(model))


def _run(call: Callable[[], Any], runs: int) -> tuple[Any, float, int]:
    """The last result, the median of the seconds, and what the first call made the process grow by."""
    gc.collect()
    before = reset_peak()
    result, timing = timed(call)
    growth, timings = peak_bytes() - before, [timing]
    for _ in range(runs - 1):
        result = None  # the next call does not find the memory taken
        result, timing = timed(call)
        timings.append(timing)
    return result, medians(timings).wall, growth


def _array_bytes(model: SplatModel) -> int:
    return sum(getattr(model, name).nbytes for name in ARRAYS)
