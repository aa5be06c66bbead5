# SPDX-License-Identifier: Apache-2.0
"""Levels of detail next to the scene: level k at 1/2^k and 1/2^(k - 1) of the size of its cameras.

A case is a `level`, from 1, and its `maker`: `fitted`, as `csplat encode` builds scenes of up to two million splats;
`merged`, without a fit; `decimate` or `decimate-adaptive` of splat-transform, or `nanogs`, at as many splats. Fitted
levels are decoded from a file, and compared with its level 0; the others are not quantised, and compared with the
scene. Seconds are those of all levels for csplat, with the encoding of the file, and of this one for the others. PSNR
is pooled over eight cameras.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from csplat.decoder import decode
from csplat.encoder import EncodePlan
from csplat.model import SplatModel
from csplat.ply import read_ply, write_ply
from csplat_bench.measuring import run_program
from csplat_bench.peers import CAP_SECONDS, find_nanogs, find_splat_transform
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render import Camera
from csplat_render.camera import resized
from csplat_render.metrics import psnr_of_mse, ssim
from csplat_render.rasteriser import Rasteriser
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.level_builder import FittedLevelBuilder
from csplat_tools.level_merging import merge_neighbours

_CAMERAS = 8
_SHARE = 0.25  # splats of a level, as a share of the finer one


@contextmanager
def measure_levels(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that measures a level."""
    model, cameras = _scene(setup, name)
    source = setup.work / f"{Path(name).stem}-levels.ply"
    write_ply(source, model)
    rasteriser = Rasteriser()

    def render(splats: SplatModel, camera: Camera) -> np.ndarray:
        return rasteriser.forward(splats, camera, antialiased=splats.metadata.antialiased).rgb.clip(0.0, 1.0)

    @cache
    def build(maker: str) -> tuple[dict[int, SplatModel], float]:
        """Return levels by number, 0 being the scene, and seconds."""
        start = time.perf_counter()
        if maker == "merged":
            levels, splats = {0: model}, model
            while len(splats) > FittedLevelBuilder.root_splats:
                splats = merge_neighbours(splats, np.zeros(len(splats), np.int64), math.ceil(_SHARE * len(splats)))[1]
                levels[len(levels)] = splats
            return levels, time.perf_counter() - start
        encoded = FittedLevelBuilder().encode_plan(EncodePlan.of(model))
        seconds, nodes = time.perf_counter() - start, encoded.nodes
        numbers = sorted({node.level for node in nodes})
        return {n: decode(encoded.part([node for node in nodes if node.level == n])) for n in numbers}, seconds

    def measure(case: Case) -> Mapping[str, Any]:
        maker, level = case["maker"], case["level"]
        if maker in ("fitted", "merged"):
            levels, seconds = build(maker)
            if level not in levels:
                raise AbsentError(f"{name} has {len(levels) - 1} coarser levels")
            fine, coarse = levels[0], levels[level]
        else:
            fine = model
            coarse, seconds = _simplified(setup, source, maker, len(model), level)
        scores: dict[str, float] = {}
        for suffix, factor in (("", 0.5**level), ("_finer", 0.5 ** (level - 1))):
            views = [resized(one, max(1, round(one.W * factor)), max(1, round(one.H * factor))) for one in cameras]
            pairs = [(render(fine, view), render(coarse, view)) for view in views]
            errors = [np.mean((a - b) ** 2, dtype=np.float64) for a, b in pairs]
            scores[f"psnr{suffix}"] = psnr_of_mse(float(np.mean(errors)))
            scores[f"ssim{suffix}"] = float(np.mean([ssim(a, b) for a, b in pairs]))
        return {"splats": len(model), "level_splats": len(coarse), "seconds": seconds, **scores}

    yield measure


def _scene(setup: Setup, name: str) -> tuple[SplatModel, list[Camera]]:
    """Return a PLY or `.csplat` scene, and its cameras: those of the data folder, else virtual ones."""
    coded = setup.data / "splats" / f"{name}.csplat"
    if coded.exists():
        model = decode(coded)
        return model, list(virtual_cameras(model, _CAMERAS))
    scene = find_scene(name, setup.data, setup.work)
    model = read_ply(scene.path)
    every = max(1, len(scene.cameras) // _CAMERAS)
    return model, list(scene.cameras[::every][:_CAMERAS] or virtual_cameras(model, _CAMERAS))


def _simplified(setup: Setup, source: Path, maker: str, count: int, level: int) -> tuple[SplatModel, float]:
    """Return a level by a program of others, and its seconds."""
    share = _SHARE**level
    output = setup.work / f"{source.stem}-{maker}-{level}.ply"
    words: list[object]
    if maker == "nanogs":
        words = [sys.executable, find_nanogs(setup.peers), "--ply", source, "-o", output, "-r", share]
    else:
        transform = find_splat_transform(setup.peers)
        words = [*transform, "-g", "cpu", "-q", "-w", source, f"--{maker}", round(count * share), output]
    start = time.perf_counter()
    run_program([str(word) for word in words], CAP_SECONDS)
    return read_ply(output), time.perf_counter() - start
