"""Peak memory of `csplat finetune`, in a process of its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from csplat.ply import read_ply, write_ply
from csplat_bench.common.making import with_splats
from csplat_bench.common.measuring import alone, peak_bytes, reset_peak
from csplat_bench.compression.rows import Memory


def measure_memory(ply: Path, count: int, words: Sequence[str]) -> Memory:
    """Tune a scene with `count` splats in a process of its own.

    Args:
        ply: a scene.
        count: splats.
        words: arguments of the command, without input and output.
    """
    with TemporaryDirectory() as folder:
        source, report = Path(folder) / "scene.ply", Path(folder) / "report.json"
        write_ply(source, with_splats(read_ply(ply), count))
        output = ["-o", str(source.with_suffix(".csplat")), "--report", str(report), "--quiet"]
        before, peak = alone(finetuned, [str(source), *output, *words])
        return {"before_bytes": before, "peak_bytes": peak, "report": json.loads(report.read_text())}


def finetuned(words: Sequence[str]) -> tuple[int, int]:
    """Run `csplat finetune`; largest resident size of this process, and that when everything was imported."""
    from csplat_tools.cli.app import app

    before = reset_peak()
    app(["finetune", *words], standalone_mode=False)
    return before, peak_bytes()
