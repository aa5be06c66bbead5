"""How long pictures of a scene take on this machine, now: what long work is foretold by."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from csplat.model import SplatModel
from csplat_render import Camera, Mode
from csplat_render.cameras import resized
from csplat_render.judge import Drawable, renderer

__all__ = ["picture_seconds", "pictures_seconds"]

_SAMPLES = 2  # cameras that are tried
_SMALLER = 8  # times on each side, where a whole picture takes a minute: seconds grow with its pixels


def pictures_seconds(source: SplatModel, cameras: Sequence[Camera], *, mode: Mode = "standard") -> float:
    """Seconds that all pictures take, by some of them; 0 where there are none."""
    return len(cameras) * picture_seconds(source, cameras, mode=mode) if len(source) and cameras else 0.0


def picture_seconds(
    source: SplatModel | Drawable,
    cameras: Sequence[Camera],
    *,
    mode: Mode = "standard",
    threads: int | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Seconds that a picture takes, by some that are made and thrown away.

    Args:
        source: the scene.
        cameras: one at least.
        mode, threads: of the renderer.
        clock: returns the seconds that have passed.
    """
    draw = renderer(source, (0.0, 0.0, 0.0), mode=mode, threads=threads)
    tried, times = cameras[:: max(1, len(cameras) // _SAMPLES)][:_SAMPLES], 1
    if mode == "exact":
        times = _SMALLER**2
        tried = [resized(one, max(1, one.W // _SMALLER), max(1, one.H // _SMALLER)) for one in tried[:1]]
    else:
        draw(tried[0])  # buffers are made, kernels loaded
    start = clock()
    for camera in tried:
        draw(camera)
    return times * (clock() - start) / len(tried)
