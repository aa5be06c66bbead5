"""Opacities and scales of what stays, moved towards what the source looks like by gradient descent.

Where splats have gone, their neighbours have to cover more: opacity and extent decide that, and no linear problem does.
Centres and rotations stay: moved by the same steps they follow the views that teach and lose on others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.rasterise import Rasteriser, Splats
from csplat_tools.files.console import Progress
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_trainer.parameters import Parameters, adam_step, from_model

__all__ = ["adjust"]

F32 = NDArray[np.float32]
_RATES = {"logits": 0.05, "scales": 0.01, "quats": 0.0}  # of logits and of log scales, in the first steps
_LAST_RATE = 0.02  # share of them that is left in the last steps
_LARGE_ERROR = 0.01  # of a pixel, below which the rates fall with it


def adjust(
    model: SplatModel,
    cameras: Sequence[Camera],
    wanted: Sequence[F32],
    options: SimplifyOptions,
    *,
    error: float,
    progress: Progress | None = None,
) -> SplatModel:
    """Move opacities and scales along the gradient of the squared error, view by view.

    Args:
        model: the scene.
        cameras: the views.
        wanted: [H, W, 3], what is to be seen from each.
        options: how often each view is looked at (`passes`), background, seed of their order, threads.
        error: root mean square of what is wrong with the pictures: where little is, steps are small.
        progress: is told how much is done.

    Returns:
        The scene; splats that no view shows are as they were.
    """
    start = from_model(model, model.sh_degree)
    moving = {"logits": start["logits"].copy(), "scales": start["scales"].copy(), "quats": np.zeros((0, 4), np.float32)}
    parameters = Parameters.starting_at(moving)
    rasteriser = Rasteriser(threads=options.threads)
    rng = np.random.default_rng(options.seed)
    order = np.concatenate([rng.permutation(len(cameras)) for _ in range(options.passes)])
    careful = min(1.0, error / _LARGE_ERROR)
    for step, view in enumerate(order):
        alphas = parameters.alphas
        scene = Splats(model.means, model.quats, moving["scales"], alphas, model.sh0, model.shN)
        drawn = rasteriser.forward(scene, cameras[view], background=options.background, antialiased=model.antialiased)
        found = rasteriser.backward(drawn.rgb - wanted[view])
        rate = careful * max(_LAST_RATE, 0.5 + 0.5 * math.cos(math.pi * (step + 1) / len(order)))
        slopes = found.opacities * alphas * (1.0 - alphas)
        gradients = {"logits": slopes, "scales": found.scales, "quats": moving["quats"]}
        adam_step(parameters, gradients, {name: rate * value for name, value in _RATES.items()})
        if progress is not None:
            progress("adjusting splats", (step + 1) / len(order))
    unmoved = moving["logits"] == start["logits"]  # these alphas are not to be rounded
    return replace(model, opacities=np.where(unmoved, model.opacities, parameters.alphas), scales=moving["scales"])
