# SPDX-License-Identifier: Apache-2.0
"""The compiled library: milliseconds per view or step of what searches and training repeat.

A case has a `work`: `render`, `pruning` (the pruning errors of all splats), `refit` and `quantised_refit` (steps of the
refits of a target search, of the splats with the largest pruning errors), or `training` (steps on renders of the scene,
whose splats are split). Values are means over the views or steps of a turn, by the number of threads: `ms_1`,
`cpu_ms_1`, `ms_2`… Options: `threads`, numbers of threads; `views` and `size` of the search; `kept`, a fraction of the
splats; `steps` of a refit; `train_splats`, `train_size`, `train_steps`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from csplat.context import Context
from csplat.encoder import PRESETS, EncodeOptions, EncodePlan, FixedQuantisation, Origin, fix_quantisation
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.types import F32, I64
from csplat_bench.made_scenes import split
from csplat_bench.measuring import Timing
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render import Camera
from csplat_render.kernels import thread_count
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import renderer
from csplat_tools.optimise.candidates import Coding
from csplat_tools.scene_sensitivity import measure_importance
from csplat_tools.views import BLACK, camera_sequence
from csplat_trainer.engine import CpuEngine
from csplat_trainer.initial_splats import measure_extent
from csplat_trainer.parameters import Parameters, from_model
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.splat_refit import quantisation_aware_refit, refit_splats
from csplat_trainer.training_options import TrainOptions

_DEGREE = 3
_TRAIN_VIEWS = 5


@contextmanager
def measure_kernels(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that does the work of a case once for each number of threads."""
    inputs = _Inputs(read_ply(find_scene(name, setup.data, setup.work).path), setup.options)

    def measure(case: Case) -> Mapping[str, Any]:
        row: dict[str, Any] = {"splats": len(inputs.model)}
        for threads in setup.options["threads"]:
            with thread_count(threads):
                timing = _WORKS[case["work"]](inputs, Context(threads=threads))
            row |= {f"ms_{threads}": 1e3 * timing.wall, f"cpu_ms_{threads}": 1e3 * timing.cpu}
        return row

    yield measure


@dataclass(eq=False)
class _Inputs:
    """The inputs of all works; each is made at first use.

    Attributes:
        model: the scene.
        options: the suite's.
    """

    model: SplatModel
    options: Mapping[str, Any]

    @cached_property
    def cameras(self) -> list[Camera]:
        """The views of a search."""
        return camera_sequence(self.model, self.options["views"], tuple(self.options["size"]))

    @cached_property
    def references(self) -> list[F32]:
        """[H, W, 3], the scene's render of each view."""
        draw = renderer(self.model, BLACK)
        return [draw(camera).rgb for camera in self.cameras]

    @cached_property
    def rows(self) -> I64:
        """The splats with the largest pruning errors, ascending."""
        errors = measure_pruning_error(self.model, self.cameras).error
        return np.sort(np.argsort(-errors, kind="stable")[: round(self.options["kept"] * len(self.model))])

    @cached_property
    def kept(self) -> SplatModel:
        """These splats."""
        return self.model.select(self.rows)

    @cached_property
    def fixed(self) -> FixedQuantisation:
        """Their quantisation as a target search begins, with a codebook and the precision of `small`."""
        usual = PRESETS["small"]
        options = Coding("codebook", usual.codebook_share).options(EncodeOptions(), len(self.kept), usual.quality[0])
        importance = measure_importance(self.kept, self.cameras, BLACK)
        if scene_frame(self.model).kind == "surrounding":
            importance = replace(importance, blocks=None)  # a search has no quantisation classes there
        origin = Origin(len(self.model), self.rows, refitted=True, adjusted=True)
        return fix_quantisation(EncodePlan.of(self.kept, options, importance=importance, origin=origin), self.model)

    @cached_property
    def training(self) -> tuple[SplatModel, list[PosedImage]]:
        """Splats to train, and images."""
        count, rng, draw = self.options["train_splats"], np.random.default_rng(0), renderer(self.model, BLACK)
        parts = split(self.model, math.ceil(count / len(self.model)), rng)
        images = [
            PosedImage(camera, (255.0 * draw(camera).rgb.clip(0.0, 1.0) + 0.5).astype(np.uint8))
            for camera in camera_sequence(self.model, _TRAIN_VIEWS, tuple(self.options["train_size"]))
        ]
        return parts.select(np.sort(rng.permutation(len(parts))[:count])), images


@dataclass
class _StepClock:
    """A progress callback that measures the time per step; the first step warms up."""

    marks: list[tuple[float, float]] = field(default_factory=list)

    def __call__(self, _stage: str = "", _done: float = 0.0) -> None:
        self.marks.append((time.perf_counter(), time.process_time()))

    def per_step(self) -> Timing:
        """Return the mean time of a step."""
        wall, cpu = (np.array(self.marks[-1]) - self.marks[0]) / (len(self.marks) - 1)
        return Timing(float(wall), float(cpu))


def _render(inputs: _Inputs, context: Context) -> Timing:
    draw, clock = renderer(inputs.model, BLACK, context=context), _StepClock()
    for camera in (inputs.cameras[0], *inputs.cameras):
        draw(camera)
        clock()
    return clock.per_step()


def _measure_pruning(inputs: _Inputs, context: Context) -> Timing:
    clock = _StepClock()
    cameras = [inputs.cameras[0], *inputs.cameras]
    measure_pruning_error(inputs.model, cameras, context=replace(context, progress=clock))
    return clock.per_step()


def _refit(inputs: _Inputs, context: Context) -> Timing:
    clock, steps = _StepClock(), inputs.options["steps"] + 1
    refit_splats(inputs.kept, inputs.cameras, inputs.references, steps=steps, context=replace(context, progress=clock))
    return clock.per_step()


def _refit_quantised(inputs: _Inputs, context: Context) -> Timing:
    clock, steps = _StepClock(), inputs.options["steps"] + 1
    fixed = replace(inputs.fixed, encode_plan=replace(inputs.fixed.encode_plan, context=context))
    quantisation_aware_refit(
        fixed, inputs.cameras, inputs.references, steps=steps, before=inputs.kept,
        context=replace(context, progress=clock),
    )  # fmt: skip
    return clock.per_step()


def _train(inputs: _Inputs, context: Context) -> Timing:
    (model, images), clock, rng = inputs.training, _StepClock(), np.random.default_rng(0)
    options = TrainOptions(max_splats=len(model), sh_degree=_DEGREE)
    engine = CpuEngine(Parameters.starting_at(from_model(model, _DEGREE)), options, context=context)
    rates, black = options.learning_rates(1, measure_extent(images).extent), np.zeros(3, np.float32)
    for step in range(inputs.options["train_steps"] + 1):
        engine.step(images[step % len(images)], black, _DEGREE, rates, rng)
        clock()
    return clock.per_step()


_WORKS: dict[str, Callable[[_Inputs, Context], Timing]] = {
    "render": _render,
    "pruning": _measure_pruning,
    "refit": _refit,
    "quantised_refit": _refit_quantised,
    "training": _train,
}
