# SPDX-License-Identifier: Apache-2.0
"""Steps of training: milliseconds by stage, and memory, in a process of its own.

Stages are the forward pass, the loss, and `descend`, the gradients with the step of Adam.

A scene is COUNT:WxH: splats, and the size of the images of option `data_set`. Splats start as in training, with SH
degree 3; option `warm` steps make their sizes realistic, then `steps` steps are timed. Memory is the largest growth of
the process after the images were read. A case may set `threads`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from csplat.errors import InputError
from csplat_bench.measuring import alone, peak_bytes, reset_peak
from csplat_bench.protocol import Measure, Setup
from csplat_bench.subjects.photographs import find_data_set
from csplat_bench.suites import Case
from csplat_render.kernels import thread_count
from csplat_trainer.data import load
from csplat_trainer.engine import CpuEngine
from csplat_trainer.initial_splats import measure_extent, place_splats
from csplat_trainer.parameters import Parameters
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_options import TrainOptions

_STAGES = ("forward", "loss", "descend", "other")
_DEGREE = 3


@contextmanager
def measure_training(setup: Setup, scene: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that times some steps in a new process."""
    try:
        count, width, height = map(int, scene.replace("x", ":").split(":"))
    except ValueError:
        raise InputError(f"a scene of training is {scene!r}, expected SPLATS:WIDTHxHEIGHT") from None
    folder, options = find_data_set(setup, setup.options["data_set"]), setup.options

    def measure(case: Case) -> Mapping[str, Any]:
        size, threads = (width, height), case.get("threads")
        return alone(time_steps, folder, count, size, options["warm"], options["steps"], threads)

    yield measure


def time_steps(
    folder: Path, count: int, size: tuple[int, int], warm: int, steps: int, threads: int | None
) -> dict[str, Any]:
    """Train `count` splats until their sizes are realistic, then time some steps."""
    data = load(folder, size)
    data.read()
    images = data.train
    options = TrainOptions(max_splats=count, sh_degree=_DEGREE, strategy="fixed", iterations=warm + steps)
    rng, scene = np.random.default_rng(0), measure_extent(images)

    with thread_count(threads):
        # The engine of warming up stays alive: memory that it freed would be reused without being seen.
        before = reset_peak()
        parameters = Parameters.starting_at(place_splats(images, scene, count, _DEGREE, rng))
        warmed = _walk(images, options, parameters, warm)
        times, errors, _ = _walk(images, options, parameters, steps)
    growth = peak_bytes() - before
    del warmed
    return {
        "splats": count, "width": size[0], "height": size[1], "memory_bytes": growth,
        **{f"{name}_ms": 1e3 * statistics.median(values) for name, values in times.items()},
        "psnr": float(-10.0 * np.log10(np.mean(errors))),
    }  # fmt: skip


def _walk(
    images: Sequence[PosedImage], options: TrainOptions, parameters: Parameters, steps: int
) -> tuple[dict[str, list[float]], list[float], CpuEngine]:
    """Train for some steps; return the seconds of each stage, the mean squared errors, and the engine."""
    spent: dict[str, float] = {}

    def clock(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            result = call(*args, **keywords)
            spent[name] = spent.get(name, 0.0) + time.perf_counter() - start
            return result

        return run

    engine, rng, extent = CpuEngine(parameters, options), np.random.default_rng(1), measure_extent(images).extent
    rasteriser, losses = engine._rasteriser, engine._losses  # noqa: SLF001  # its stages are timed
    loss_of = losses.of

    def clock_loss(camera: Any) -> Any:
        loss, *others = loss_of(camera)
        return clock("loss", loss), *others

    times: dict[str, list[float]] = {name: [] for name in ("step", "step_cpu", *_STAGES)}
    errors, background = [], np.ones(3, np.float32)
    with (
        patch.object(rasteriser, "forward", clock("forward", rasteriser.forward)),
        patch.object(rasteriser, "descend", clock("descend", rasteriser.descend)),
        patch.object(losses, "of", clock_loss),
    ):
        for step in range(steps):
            spent.clear()
            wall, cpu = time.perf_counter(), time.process_time()
            rates = options.learning_rates(step + 1, extent)
            errors.append(engine.step(images[step % len(images)], background, _DEGREE, rates, rng).mse)
            spent |= {"step": time.perf_counter() - wall, "step_cpu": time.process_time() - cpu}
            spent["other"] = spent["step"] - sum(spent[name] for name in _STAGES[:-1])
            for name, values in times.items():
                values.append(spent[name])
    return times, errors, engine
