# SPDX-License-Identifier: Apache-2.0
"""Compare the renders of two scenes on a GPU; only sums are read back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.types import Progress
from csplat_render.camera import Camera, relative_to
from csplat_render.conventions import checked_background
from csplat_render.gpu.renderer import GpuRenderer, GpuScene
from csplat_render.metrics import Scores, ViewScore, psnr_of_mse

_RUN = 4096  # pixels per sum
_SUM_BYTES = 16  # squared error, the same of covered pixels, their number, and an unused number


def compare_scenes(
    source: GpuScene,
    other: GpuScene,
    cameras: Sequence[Camera],
    background: ArrayLike = (0.0, 0.0, 0.0),
    *,
    progress: Progress | None = None,
) -> Scores:
    """Measure the PSNR of a scene's renders against renders of its source; other metrics are `None`.

    Args:
        source, other: the scenes, on one device.
        cameras: the views, at least one, relative to the origin of `source`.
        background: red, green, blue of the background.
        progress: called with the stage and the completed fraction.

    Raises:
        InputError, LimitError: as in `GpuRenderer.render`; there are no views.
    """
    colour = checked_background(background)
    first, second = GpuRenderer(source), GpuRenderer(other)
    shift = np.subtract(other.origin, source.origin)
    scores = []
    for number, camera in enumerate(cameras):
        if progress is not None:
            progress("comparing", number / len(cameras))
        scores.append(_compare_view(first, second, camera, relative_to(shift, camera), colour))
    if progress is not None:
        progress("comparing", 1.0)
    return Scores.of(scores, other.ignored)


def _compare_view(
    first: GpuRenderer, second: GpuRenderer, camera: Camera, moved: Camera, background: NDArray[np.float32]
) -> ViewScore:
    """Compare the renders of a view, band by band.

    Args:
        first, second: renderers of the source and of the other scene.
        camera, moved: the view, relative to the origin of each.
        background: [3].
    """
    device, sums = first.device, np.zeros(4)
    second.bands(moved)  # makes room; the bands are the same
    for rows in first.bands(camera):
        for renderer, view in ((first, camera), (second, moved)):
            renderer.draw(view, rows)
        pixels = len(rows) * camera.W
        runs = -(-pixels // _RUN)
        backdrop = np.zeros(8, np.float32)  # `Backdrop` of difference.wgsl
        backdrop[:3] = background
        backdrop.view(np.uint32)[4] = pixels
        differences = device.buffer(_SUM_BYTES * runs)
        uniform = device.uploaded(backdrop, uniform=True)
        device.run([device.bind("difference", "difference", runs, uniform, first.pixels, second.pixels, differences)])
        partial = device.read(differences, _SUM_BYTES * runs).view(np.float32).reshape(runs, 4)
        sums += partial.sum(axis=0, dtype=np.float64)
    count = camera.W * camera.H
    mse, covered = sums[0] / (3 * count), sums[2]
    return ViewScore(
        camera.image,
        count,
        float(mse),
        psnr_of_mse(float(mse)),
        float(sums[1] / (3 * covered)) if covered else None,
        float(covered / count),
    )
