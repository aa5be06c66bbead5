"""Measure the time of renders on this machine, from which the time of long work is estimated."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from csplat.model import SplatModel
from csplat_render import Camera, Mode
from csplat_render.camera import resized
from csplat_render.scorer import Renderable, renderer

_SAMPLES = 2  # largest number of cameras that are rendered
_SMALLER = 8  # divisor of width and height in mode `exact`, in which a render takes a minute: time grows with pixels


def pictures_seconds(source: SplatModel, cameras: Sequence[Camera], *, mode: Mode = "standard") -> float:
    """Estimate the seconds that renders from all cameras take, from some of them; 0 without splats or cameras."""
    return len(cameras) * picture_seconds(source, cameras, mode=mode) if len(source) and cameras else 0.0


def picture_seconds(
    source: SplatModel | Renderable,
    cameras: Sequence[Camera],
    *,
    mode: Mode = "standard",
    threads: int | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Measure the seconds that a render takes, from some that are discarded.

    Args:
        source: the scene.
        cameras: the views, at least one.
        mode, threads: mode of the renderer, and its number of threads.
        clock: returns the seconds that have passed.
    """
    draw = renderer(source, (0.0, 0.0, 0.0), mode=mode, threads=threads)
    tried, times = cameras[:: max(1, len(cameras) // _SAMPLES)][:_SAMPLES], 1
    if mode == "exact":
        times = _SMALLER**2
        tried = [resized(one, max(1, one.W // _SMALLER), max(1, one.H // _SMALLER)) for one in tried[:1]]
    else:
        draw(tried[0])  # not timed: allocates buffers and loads kernels
    start = clock()
    for camera in tried:
        draw(camera)
    return times * (clock() - start) / len(tried)
