"""A number of steps of training, each stage by the clock; for a process of its own."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from csplat_bench.common.measuring import peak_bytes, reset_peak
from csplat_render.kernels import thread_count
from csplat_trainer.data import load
from csplat_trainer.engine import CpuEngine
from csplat_trainer.initial_splats import measure_extent, place_splats
from csplat_trainer.parameters import Parameters, adam_step
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_options import TrainOptions

#: In addition to `step`, which is all of them, and `CPU`, the seconds of all threads.
STAGES = ("forward", "loss", "backward", "Adam", "other")

_DEGREE = 3
_WARM_SPLATS = 10  # enough to compile what a step runs


@dataclass(frozen=True)
class Steps:
    """Time and memory of training steps.

    Attributes:
        splats: number of splats.
        size: width and height of the images.
        seconds: median time by stage.
        psnr: on the training images, dB.
        memory_bytes: growth of the process after the images were read.
    """

    splats: int
    size: tuple[int, int]
    seconds: dict[str, float]
    psnr: float
    memory_bytes: int


def measured(folder: Path, count: int, size: tuple[int, int], warm: int, steps: int, threads: int | None) -> Steps:
    """Train `count` splats: first until their sizes are realistic, then with time measured."""
    data = load(folder, size)
    data.read()
    pictures = data.train
    options = TrainOptions(max_splats=count, sh_degree=_DEGREE, strategy="fixed", iterations=warm + steps)
    rng, scene = np.random.default_rng(0), measure_extent(pictures)

    def start(splats: int) -> Parameters:
        return Parameters.starting_at(place_splats(pictures, scene, splats, _DEGREE, rng))

    with thread_count(threads):
        # Engines stay, as for trainer/FIGURES.md: what one gives back the next one would take, unseen. The second
        # one counts twice by that: training by itself takes about half as much.
        compiled = _walk(pictures[:1], options, start(_WARM_SPLATS), 2)
        before = reset_peak()
        parameters = start(count)
        warmed = _walk(pictures, options, parameters, warm)
        times, errors, _ = _walk(pictures, options, parameters, steps)
    growth = peak_bytes() - before
    del compiled, warmed
    seconds = {name: statistics.median(values) for name, values in times.items()}
    return Steps(count, size, seconds, float(-10.0 * np.log10(np.mean(errors))), growth)


def _walk(
    pictures: Sequence[PosedImage], options: TrainOptions, parameters: Parameters, steps: int
) -> tuple[dict[str, list[float]], list[float], CpuEngine]:
    """Train for some steps; return the seconds of each stage, the mean squared errors, and the engine."""
    spent: dict[str, float] = {}

    def clocked(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            result = call(*args, **keywords)
            spent[name] = spent.get(name, 0.0) + time.perf_counter() - start
            return result

        return run

    engine, rng, extent = CpuEngine(parameters, options), np.random.default_rng(1), measure_extent(pictures).extent
    rasteriser, loss_for = engine._rasteriser, engine._loss_for  # noqa: SLF001 - the stages

    def clocked_loss(camera: Any) -> Any:
        loss, *others = loss_for(camera)
        return clocked("loss", loss), *others

    times: dict[str, list[float]] = {name: [] for name in ("step", "CPU", *STAGES)}
    errors, background = [], np.ones(3, np.float32)
    with (
        patch.object(rasteriser, "forward", clocked("forward", rasteriser.forward)),
        patch.object(rasteriser, "backward", clocked("backward", rasteriser.backward)),
        patch("csplat_trainer.engine.adam_step", clocked("Adam", adam_step)),
        patch.object(engine, "_loss_for", clocked_loss),
    ):
        for step in range(steps):
            spent.clear()
            wall, cpu = time.perf_counter(), time.process_time()
            rates = options.learning_rates(step + 1, extent)
            errors.append(engine.step(pictures[step % len(pictures)], background, _DEGREE, rates, rng).mse)
            spent |= {"step": time.perf_counter() - wall, "CPU": time.process_time() - cpu}
            spent["other"] = spent["step"] - sum(spent[name] for name in STAGES[:-1])
            for name, values in times.items():
                values.append(spent[name])
    return times, errors, engine
