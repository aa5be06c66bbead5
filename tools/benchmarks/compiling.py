"""Measure what the first call costs: compiling the kernels, and loading them from the cache afterwards.

    python tools/benchmarks/compiling.py

Each part runs in new processes that share a cache of their own, empty for the first. Seconds from the import of the
module to the end of the first call, less what a second call takes.
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

_PICTURES = "import numpy as np; x = np.random.default_rng(0).random((48, 64, 3)); y = 0.9 * x\n"
_TRAINING = """
import numpy as np
from csplat_render import Camera
from csplat_trainer.engine import CpuEngine
from csplat_trainer.options import TrainOptions
from csplat_trainer.parameters import Parameters
from csplat_trainer.pictures import Picture
viewmat = np.eye(4)
viewmat[2, 3] = 5.0
camera = Camera([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]], viewmat, 64, 48)
picture = Picture(camera, np.zeros((48, 64, 4), np.uint8))
shapes = {"means": (9, 3), "quats": (9, 4), "scales": (9, 3), "logits": (9,), "sh0": (9, 3), "shN": (9, 15, 3)}
start = {name: np.full(shape, 0.1, np.float32) for name, shape in shapes.items()}
rates = dict.fromkeys(shapes, 1e-3)
engine = CpuEngine(Parameters.starting_at(start), TrainOptions(strategy="fixed"))
rng, white = np.random.default_rng(0), np.ones(3, np.float32)
call = lambda: engine.step(picture, white, 3, rates, rng)
"""
#: Name, and what makes `call`, after which it is called twice.
_PARTS = {
    "a picture": "from csplat_render.warmup import warm_up; call = lambda: warm_up(gradients=False)",
    "a picture and its gradients": "from csplat_render.warmup import warm_up; call = warm_up",
    "a step of training": _TRAINING,
    "SSIM": _PICTURES + "from csplat_render.metrics import ssim; call = lambda: ssim(x, y)",
    "LPIPS": _PICTURES
    + """
from csplat_render.convolving import convolve
x, kernel, bias = x.astype(np.float32), np.ones((3, 3, 3, 8), np.float32), np.zeros(8, np.float32)
call = lambda: convolve(x, kernel, bias, 1, 1)
""",
}
_CLOCK = """
import time
begin = time.perf_counter()
{part}
call()
first = time.perf_counter()
call()
print(first - begin - (time.perf_counter() - first))
"""


def main() -> None:
    """Measure the parts and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    args = parser.parse_args()
    machine = describe_machine(("numpy", "numba"))
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    results: list[dict[str, Any]] = []
    for name, part in _PARTS.items():
        with tempfile.TemporaryDirectory() as cache:
            cold, cached = (_seconds(part, cache) for _ in range(2))
        results.append({"name": name, "cold_seconds": cold, "cached_seconds": cached})
    rows = [[row["name"], f"{row['cold_seconds']:.1f}", f"{row['cached_seconds']:.2f}"] for row in results]
    print(format_table(["first call of", "compiled, s", "cached, s"], rows))
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, "results": results}, indent=2) + "\n")


def _seconds(part: str, cache: str) -> float:
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    run = subprocess.run(
        [sys.executable, "-c", _CLOCK.format(part=part)], env=environment, check=True, stdout=subprocess.PIPE
    )
    return float(run.stdout.split()[-1])


if __name__ == "__main__":
    main()
