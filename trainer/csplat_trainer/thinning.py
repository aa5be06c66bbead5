"""Fewer splats, a little at a time: those that pictures need least go, and the others learn to stand in for them.

A splat's worth is the exact squared change of the pictures if it alone were not there. Splats that share a place are
each needed little, and together much: so few go at once, and what is left is trained on before it is measured anew.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from csplat_render.pruning_error import measure_pruning_error
from csplat_trainer.parameters import Parameters, to_model
from csplat_trainer.pictures import Picture

_VIEWS = 32  # at most, spread over all, that say what splats are worth


def thin(
    parameters: Parameters,
    pictures: Sequence[Picture],
    background: NDArray[np.float32],
    count: int,
    *,
    antialiased: bool,
) -> None:
    """Remove the splats that pictures need least.

    Args:
        parameters: changed in place.
        pictures: those that are trained on.
        background: [3], behind the splats.
        count: how many stay.
        antialiased: as the scene is trained.
    """
    views = pictures[:: -(-len(pictures) // _VIEWS)]
    model = to_model(parameters.values, antialiased=antialiased)
    found = measure_pruning_error(model, [one.camera for one in views], background=background, bands=False)
    parameters.keep(np.sort(np.argsort(-found.error, kind="stable")[:count]))
