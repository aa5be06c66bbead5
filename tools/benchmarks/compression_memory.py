"""Peak memory of `csplat finetune`, in a process of its own: `compression_memory.py WORD ...` are its words.

The child prints one line of JSON: largest resident size of the process, and what it was when everything was imported.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from child import peak_bytes, reset_peak
from crowds import split

from csplat.model import SplatModel
from csplat.ply import read_ply, write_ply

__all__ = ["measure_memory", "with_splats"]


def main() -> None:
    """Run `csplat finetune` with the words of the command line."""
    from csplat_tools.cli.app import app

    before = reset_peak()
    app(["finetune", *sys.argv[1:]], standalone_mode=False)
    json.dump({"before_bytes": before, "peak_bytes": peak_bytes()}, sys.stdout)


def measure_memory(ply: Path, count: int, words: list[str], scratch: Path) -> dict[str, Any]:
    """Tune a scene with so many splats in a process of its own.

    Args:
        ply: a scene.
        count: splats.
        words: of the command, but for its input and its output.
        scratch: an existing folder.

    Returns:
        `before_bytes`, `peak_bytes`, and `report`, which is the command's.
    """
    source, file, report = (scratch / f"{ply.stem}-{count}.{end}" for end in ("ply", "csplat", "json"))
    write_ply(source, with_splats(read_ply(ply), count))
    command = [sys.executable, __file__, str(source), "-o", str(file), "--report", str(report), "--force", "--quiet"]
    try:
        done = subprocess.run([*command, *words], check=True, stdout=subprocess.PIPE, text=True)
        return {**json.loads(done.stdout), "report": json.loads(report.read_text())}
    finally:
        for path in (source, file, report):
            path.unlink(missing_ok=True)


def with_splats(model: SplatModel, count: int, seed: int = 0) -> SplatModel:
    """A scene that looks much like another, with so many splats: some of them, or all split into smaller ones.

    Args:
        model: the other.
        count: splats.
        seed: of everything by chance.
    """
    rng = np.random.default_rng(seed)
    if count > len(model):
        model = split(model, math.ceil(count / len(model)), rng)
    return model.select(np.sort(rng.choice(len(model), count, replace=False)))


if __name__ == "__main__":
    main()
