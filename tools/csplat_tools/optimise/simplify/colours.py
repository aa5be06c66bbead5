"""What stays, fitted to what the source looks like: colours, opacities and scales, and which SH bands it needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.refit import fit_colours
from csplat_render.removal import measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.optimise.simplify.adjusting import adjust
from csplat_tools.optimise.simplify.bands import band_mask, free_coefficients, without
from csplat_tools.optimise.simplify.options import SimplifyOptions

__all__ = ["ColourFit", "fit", "refitted"]

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_SECOND_STEPS = 2  # of a fit after something has changed a little


@dataclass(frozen=True, eq=False)
class ColourFit:
    """A scene with new colours, and opacities and scales adjusted.

    Attributes:
        model: the scene.
        stays: [N, d], which SH bands are not zero; None where that was not asked.
        errors: squared error over the views that were fitted, before the first and after every step, fit by fit.
    """

    model: SplatModel
    stays: Mask | None
    errors: tuple[tuple[float, ...], ...]


def fit(
    model: SplatModel,
    cameras: Sequence[Camera],
    wanted: Sequence[F32],
    options: SimplifyOptions,
    *,
    progress: Progress | None = None,
) -> ColourFit:
    """Fit colours; adjust opacities and scales; set bands to zero; after each of the two fit colours once more.

    Args:
        model: the scene, with the source's colours.
        cameras: the views.
        wanted: what the source looks like there.
        options: whether to fit, to adjust and to choose bands, steps, background.
        progress: is told how much is done.
    """
    goal = _coefficients(model)
    errors: list[tuple[float, ...]] = []

    def fitted(scene: SplatModel, steps: int, free: Mask | None) -> SplatModel:
        x, found = fit_colours(
            scene, cameras, wanted, centre=goal, free=free, steps=steps, background=options.background,
            antialiased=scene.antialiased, threads=options.threads, progress=progress,
        )  # fmt: skip
        errors.append(tuple(found))
        return replace(scene, sh0=np.ascontiguousarray(x[:, 0]), shN=np.ascontiguousarray(x[:, 1:]))

    if options.refit:
        model = fitted(model, options.steps, None)
    if options.refit and options.adjust:
        rms = (max(0.0, errors[-1][-1]) / sum(picture.size for picture in wanted)) ** 0.5
        moved = adjust(model, cameras, wanted, options, error=rms, progress=progress)
        moved = fitted(moved, _SECOND_STEPS, None)
        model = moved if errors[-1][-1] < errors[-2][-1] else model
    if not options.bands or not model.sh_degree:
        return ColourFit(model, None, tuple(errors))
    removal = measure_removal(model, cameras, background=options.background, threads=options.threads, progress=progress)
    left = min(one[-1] for one in errors) if errors else 0.0
    stays = band_mask(removal, left / max(1, len(model)))
    if not stays.all():
        model = without(model, stays)
        if options.refit:
            model = fitted(model, _SECOND_STEPS, free_coefficients(stays))
    return ColourFit(model, stays, tuple(errors))


def refitted(
    model: SplatModel,
    cameras: Sequence[Camera],
    wanted: Sequence[F32],
    options: SimplifyOptions,
    *,
    steps: int,
    free: Mask | None,
    centre: SplatModel,
    progress: Progress | None = None,
) -> SplatModel:
    """Fit colours once, and nothing else.

    Args:
        model: geometry, and the colours to start from.
        cameras, wanted, options, progress: as for `fit`.
        centre: the scene to whose colours the ridge pulls.
        steps: at most.
        free: [N, (d + 1)²], which coefficients may change; None for all.
    """
    x, _ = fit_colours(
        model, cameras, wanted, centre=_coefficients(centre), free=free, steps=steps, background=options.background,
        antialiased=model.antialiased, threads=options.threads, progress=progress,
    )  # fmt: skip
    return replace(model, sh0=np.ascontiguousarray(x[:, 0]), shN=np.ascontiguousarray(x[:, 1:]))


def _coefficients(model: SplatModel) -> F32:
    return np.concatenate([model.sh0[:, None], model.shN], axis=1)
