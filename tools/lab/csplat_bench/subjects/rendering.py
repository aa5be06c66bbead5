# SPDX-License-Identifier: Apache-2.0
"""The renderer: milliseconds of a render and of its gradients, and the PSNR of the other modes.

A case has a `mode`, and perhaps `antialiased`. Values are medians over the scene's cameras (640 by 480; the data
folder's, else virtual ones), wall-clock and CPU time of all threads, which other programs disturb less. PSNR is pooled
over the views, against the standard mode. Options: `threads`; `views`, how many of the cameras.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from csplat.context import Context
from csplat.ply import read_ply
from csplat_bench.measuring import Timing, timed
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render.metrics import psnr_of_mse
from csplat_render.rasteriser import Rasteriser
from csplat_tools.views import comparison_cameras


@contextmanager
def measure_rendering(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that renders all views once, with and without gradients."""
    scene, context = find_scene(name, setup.data, setup.work), Context(threads=setup.options["threads"])
    model = read_ply(scene.path)
    cameras = list(scene.cameras or comparison_cameras(model))[: setup.options["views"]]
    standard = Rasteriser(context=context)
    references = [standard.forward(model, camera).rgb.clip(0.0, 1.0) for camera in cameras]

    def measure(case: Case) -> Mapping[str, Any]:
        mode, antialiased = case["mode"], case.get("antialiased", False)
        rasteriser = Rasteriser(mode, context=context)
        forward, backward, drawn, errors = list[Timing](), list[Timing](), list[int](), list[float]()
        for camera, reference in zip(cameras, references, strict=True):
            render, timing = timed(rasteriser.forward, model, camera, antialiased=antialiased)
            forward.append(timing)
            drawn.append(render.drawn)
            errors.append(float(np.mean((render.rgb.clip(0.0, 1.0) - reference) ** 2)))
            backward.append(timed(rasteriser.backward, np.ones_like(render.rgb))[1])
        error = float(np.mean(errors))
        return {
            "splats": len(model), "sh_degree": model.sh_degree, "in_view": int(statistics.median(drawn)),
            **_milliseconds("forward", forward), **_milliseconds("backward", backward),
            "psnr": psnr_of_mse(error) if error else None,
        }  # fmt: skip

    yield measure


def _milliseconds(name: str, timings: Sequence[Timing]) -> dict[str, float]:
    return {
        f"{name}_ms": 1e3 * statistics.median(one.wall for one in timings),
        f"{name}_cpu_ms": 1e3 * statistics.median(one.cpu for one in timings),
    }
