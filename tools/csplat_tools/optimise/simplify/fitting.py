"""What stays, fitted to what the source looks like, and which SH bands it needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.metrics import squared_error
from csplat_render.removal import measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.optimise.simplify.adjusting import adjust
from csplat_tools.optimise.simplify.bands import band_mask, free_coefficients, without
from csplat_tools.optimise.simplify.options import SimplifyOptions

__all__ = ["BAND_STEPS", "FIT_STEPS", "Fit", "fit"]

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Of a fit, and of one after bands were left out.
FIT_STEPS, BAND_STEPS = 960, 160


@dataclass(frozen=True, eq=False)
class Fit:
    """A scene that was fitted.

    Attributes:
        model: the scene.
        stays: [N, d], which SH bands are not zero; None where that was not asked.
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
    """Adjust the splats; set bands to zero that are not worth their bits, and adjust the others once more.

    Args:
        model: the scene, with the source's values.
        cameras: the views.
        wanted: what the source looks like there.
        options: whether to fit and to choose bands, steps, background.
        deciding: so many of the views, the first ones, say which bands stay; `None`: all do.
        progress: is told how much is done.
    """
    if options.refit:
        model = adjust(model, cameras, wanted, options, steps=options.steps(FIT_STEPS), progress=progress)
    if not options.bands or not model.sh_degree:
        return Fit(model, None)
    error = 0.0

    def add(number: int, picture: NDArray[np.float32]) -> None:
        nonlocal error
        error += float(np.sum(squared_error(wanted[number], picture)))

    removal = measure_removal(
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
