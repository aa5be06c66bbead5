"""Measure what the first call costs: compiling the kernels, and loading them from the cache afterwards.

    python -m csplat_bench.rendering.compiling

Each part runs in new processes that share a cache of their own, empty for the first. Seconds from the import of the
module to the end of the first call, less what a second call takes.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np

from csplat_bench.common.command import JSON, run
from csplat_bench.common.measuring import alone
from csplat_bench.common.report import table, tell_machine, write_json


def main(*, json: JSON = None) -> None:
    """Measure the parts and print a table."""
    machine, found = tell_machine(), {}
    for name in _PARTS:
        with tempfile.TemporaryDirectory() as cache:
            found[name] = [alone(first_call, name, cache) for _ in range(2)]
    rows = [(name, f"{cold:.1f}", f"{cached:.2f}") for name, (cold, cached) in found.items()]
    print(table(("first call of", "compiled, s", "cached, s"), rows))
    if json is not None:
        write_json(json, {"machine": machine, "seconds": found})


def first_call(name: str, cache: str) -> float:
    """Seconds of the import and the first call of a part, less those of the second call."""
    os.environ["NUMBA_CACHE_DIR"] = cache  # read when numba is imported
    begin = time.perf_counter()
    call = _PARTS[name]()
    call()
    first = time.perf_counter()
    call()
    return first - begin - (time.perf_counter() - first)


def _picture() -> Callable[[], object]:
    from csplat_render.warmup import warm_up

    return lambda: warm_up(gradients=False)


def _gradients() -> Callable[[], object]:
    from csplat_render.warmup import warm_up

    return warm_up


def _training() -> Callable[[], object]:
    from csplat_render import Camera
    from csplat_trainer.engine import CpuEngine
    from csplat_trainer.options import TrainOptions
    from csplat_trainer.parameters import Parameters
    from csplat_trainer.pictures import Picture

    viewmat = np.eye(4)
    viewmat[2, 3] = 5.0
    camera = Camera(np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]), viewmat, 64, 48)
    picture = Picture(camera, np.zeros((48, 64, 4), np.uint8))
    shapes = {"means": (9, 3), "quats": (9, 4), "scales": (9, 3), "logits": (9,), "sh0": (9, 3), "shN": (9, 15, 3)}
    start = {name: np.full(shape, 0.1, np.float32) for name, shape in shapes.items()}
    rates = dict.fromkeys(shapes, 1e-3)
    engine = CpuEngine(Parameters.starting_at(start), TrainOptions(strategy="fixed"))
    rng, white = np.random.default_rng(0), np.ones(3, np.float32)
    return lambda: engine.step(picture, white, 3, rates, rng)


def _ssim() -> Callable[[], object]:
    from csplat_render.metrics import ssim

    picture = np.random.default_rng(0).random((48, 64, 3), np.float32)
    return lambda: ssim(picture, np.float32(0.9) * picture)


def _lpips() -> Callable[[], object]:
    from csplat_render.convolving import convolve

    picture, kernel = np.ones((48, 64, 3), np.float32), np.ones((3, 3, 3, 8), np.float32)
    return lambda: convolve(picture, kernel, np.zeros(8, np.float32), 1, 1)


_PARTS = {
    "a picture": _picture,
    "a picture and its gradients": _gradients,
    "a step of training": _training,
    "SSIM": _ssim,
    "LPIPS": _lpips,
}

if __name__ == "__main__":
    sys.exit(run(main))
