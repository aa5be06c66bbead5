"""Refit kept splats to renders of the source, and choose the SH bands that they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.types import F32, Mask, Progress
from csplat_render import Camera
from csplat_render.metrics import squared_error
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.optimise.simplify.adjusting import adjust
from csplat_tools.optimise.simplify.bands import band_mask, free_coefficients, without
from csplat_tools.optimise.simplify.options import SimplifyOptions

#: Steps of a fit, and of the one after bands were left out.
FIT_STEPS, BAND_STEPS = 960, 160


@dataclass(frozen=True, eq=False)
class Fit:
    """A refitted scene.

    Attributes:
        model: the scene.
        stays: [N, d], mask of the SH bands that are kept; None if bands were not chosen.
    """

    model: SplatModel
    stays: Mask | None


def fit(
    model: SplatModel,
    cameras: Sequence[Camera],
    wanted: Sequence[F32],
    options: SimplifyOptions,
    *,
    deciding: int | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Refit the splats; set bands to zero that are not worth their bits, and refit the others once more.

    Args:
        model: the scene, with the source's values.
        cameras: the views.
        wanted: [H, W, 3], the source's render of each view.
        options: `refit` and `bands`, effort, background.
        deciding: number of views, from the first on, by which bands are chosen; `None`: all.
        progress: progress callback.
    """
    if options.refit:
        model = adjust(model, cameras, wanted, options, steps=options.steps(FIT_STEPS), progress=progress)
    if not options.bands or not model.sh_degree:
        return Fit(model, None)
    error = 0.0

    def add(number: int, picture: NDArray[np.float32]) -> None:
        nonlocal error
        error += float(np.sum(squared_error(wanted[number], picture)))

    removal = measure_pruning_error(
        model,
        cameras[:deciding],
        background=options.background,
        on_picture=add,
        threads=options.threads,
        progress=progress,
    )
    stays = band_mask(removal, error / max(1, len(model)))
    if not stays.all():
        model = without(model, stays)
        if options.refit:
            free = free_coefficients(stays)
            model = adjust(
                model, cameras, wanted, options, steps=options.steps(BAND_STEPS), free=free, progress=progress
            )
    return Fit(model, stays)
