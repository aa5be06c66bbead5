"""Compile kernels ahead of their first call, and announce it, because compilation takes seconds to a minute."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from csplat.model import SplatModel
from csplat_render import metrics
from csplat_render.camera import Camera
from csplat_render.conventions import UncheckedSplats
from csplat_render.kernels import cache_failure, on_compiling
from csplat_render.metric_kernels import convolve
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.rasteriser import Rasteriser

_IMAGE_SIZE = 16  # width and height of the render, pixels


def warm_up(
    announce: Callable[[str], object] | None = None,
    *,
    gradients: bool = True,
    simplify: bool = False,
    ssim: bool = False,
    lpips: bool = False,
    kernel_calls: Sequence[Callable[[], object]] = (),
    dtype: Any = np.float32,
) -> float:
    """Compile kernels, or load them from numba's cache, by running them on a single splat.

    Args:
        announce: called with a message if something has to be compiled, and with another message at the end.
        gradients: also compile the renderer's backward pass.
        simplify: compile the kernels of `measure_pruning_error`.
        ssim: compile the kernels of `metrics.ssim`.
        lpips: compile the kernels of `lpips.Lpips`.
        kernel_calls: functions that call further kernels.
        dtype: dtype of pixels and gradients, see `Rasteriser`; the other kernels have a fixed dtype.

    Returns:
        Duration in seconds.
    """
    started = time.perf_counter()
    has_compiled = False

    def announce_compilation() -> None:
        """Note that something has to be compiled, and announce it."""
        nonlocal has_compiled
        has_compiled = True
        if announce is not None:
            often = "" if cache_failure() else " for this machine, once"
            announce(f"compiling a part of the renderer{often}: this takes up to a minute")

    with on_compiling(announce_compilation):
        viewmat = np.eye(4)
        viewmat[2, 3] = 5.0  # scene units; the splat is in view
        camera = Camera(
            np.array([[8.0, 0.0, 8.0], [0.0, 8.0, 8.0], [0.0, 0.0, 1.0]]), viewmat, _IMAGE_SIZE, _IMAGE_SIZE
        )
        rasteriser = Rasteriser(dtype=dtype, gradients=gradients)
        image = rasteriser.forward(_one_splat(dtype), camera)
        if gradients:
            rasteriser.backward(np.ones_like(image.rgb))
        if simplify:
            measure_pruning_error(SplatModel(**vars(_one_splat(np.float32))), [camera])
        if ssim:
            metrics.ssim(image.rgb, image.rgb)
        if lpips:
            convolve(image.rgb.astype(np.float32), np.ones((3, 3, 3, 4), np.float32), np.zeros(4, np.float32), 1, 1)
        for call in kernel_calls:
            call()
    seconds = time.perf_counter() - started
    if announce is not None and has_compiled:
        why = cache_failure()
        kept = f", for this run alone ({why}); NUMBA_CACHE_DIR names another folder" if why else ""
        announce(f"the renderer is compiled, in {seconds:.0f} s{kept}")
    return seconds


def _one_splat(dtype: Any) -> UncheckedSplats:
    """Return an opaque splat of SH degree 0 at the origin."""
    quat, shN = np.array([[1.0, 0.0, 0.0, 0.0]], dtype), np.zeros((1, 0, 3), dtype)
    zeros = np.zeros((1, 3), dtype)
    return UncheckedSplats(zeros, quat, zeros, np.ones(1, dtype), np.ones((1, 3), dtype), shN)
