"""The first call of a kernel compiles it, which takes seconds: do it now, and say so."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from csplat_render.camera import Camera
from csplat_render.rasterise import Rasteriser, Splats

__all__ = ["warm_up"]

_SILENT_SECONDS = 1.0  # what loading compiled kernels from the cache may take


def warm_up(
    announce: Callable[[str], object] | None = None,
    *,
    gradients: bool = True,
    dtype: Any = np.float32,
) -> float:
    """Compile the kernels, or load them from numba's cache, by rendering a splat.

    Args:
        announce: called with one line if it takes longer than a second, and with another at its end.
        gradients: the backward pass too.
        dtype: see `Rasteriser`.

    Returns:
        Seconds that it took.
    """
    started = time.perf_counter()
    timer = threading.Timer(_SILENT_SECONDS, _say, [announce])
    timer.daemon = True
    timer.start()
    try:
        one = np.ones(1, dtype)
        splats = Splats(
            np.zeros((1, 3), dtype), np.ones((1, 4), dtype), np.zeros((1, 3), dtype), one, np.ones((1, 3), dtype),
            np.zeros((1, 0, 3), dtype),
        )  # fmt: skip
        viewmat = np.eye(4)
        viewmat[2, 3] = 5.0
        camera = Camera(np.array([[8.0, 0.0, 8.0], [0.0, 8.0, 8.0], [0.0, 0.0, 1.0]]), viewmat, 16, 16)
        rasteriser = Rasteriser(dtype=dtype, gradients=gradients)
        picture = rasteriser.forward(splats, camera)
        if gradients:
            rasteriser.backward(np.ones_like(picture.rgb))
    finally:
        timer.cancel()
    seconds = time.perf_counter() - started
    if announce is not None and seconds > _SILENT_SECONDS:
        announce(f"the renderer is compiled, in {seconds:.0f} s")
    return seconds


def _say(announce: Callable[[str], object] | None) -> None:
    if announce is not None:
        announce("compiling the renderer for this machine; the result is kept for the next time")
