# SPDX-License-Identifier: Apache-2.0
"""Pruning error: the exact leave-one-out error of every splat, in one pass over views.

It is exact for pruning a single splat, with two exceptions: a finished pixel stays finished, although it might continue
without one of its splats (the omitted light has a transmittance of at most 1e-4 / (1 − alpha)); and renders are not
clipped to 0..1. The equations are in `native/pruning.cpp`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.camera import Camera
from csplat_render.conventions import TRANSMITTANCE_MIN, Array
from csplat_render.rasteriser import Rasteriser
from csplat_render.reference_rasteriser import render_exact


@dataclass(frozen=True, eq=False)
class PruningError:
    """Sums over pixels, channels and views; objects of different views can be added.

    Attributes:
        error: [N] float64, squared change of the renders without the splat.
        seen: [N] bool, True for splats that are visible in a view.
        value_count: number of pixels times channels of all views.
    """

    error: Array
    seen: Array
    value_count: int

    def of_rows(self, rows: Array) -> PruningError:
        """Return the sums of some of the splats."""
        return replace(self, error=self.error[rows], seen=self.seen[rows])

    def __add__(self, other: PruningError) -> PruningError:
        return PruningError(self.error + other.error, self.seen | other.seen, self.value_count + other.value_count)


def measure_pruning_error(
    model: SplatModel,
    cameras: Sequence[Camera],
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    transmittance_min: float = TRANSMITTANCE_MIN,
    context: Context = DEFAULT_CONTEXT,
    on_render: Callable[[Array], None] | None = None,
) -> PruningError:
    """Measure the effect of pruning each splat alone on the renders of a scene.

    Args:
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: red, green, blue of the background.
        transmittance_min: transmittance at which a pixel is finished; 0: never.
        context: threads and progress.
        on_render: called with the render of each view, [H, W, 3].

    Raises:
        InputError: there is no camera.
        LimitError: a render has more than `rasteriser.MAX_INTERSECTIONS`.
    """
    if not cameras:
        raise InputError("measuring the pruning error requires at least one camera")
    rasteriser = Rasteriser(transmittance_min=transmittance_min, context=context)
    error, seen = np.zeros(len(model)), np.zeros(len(model), np.bool_)
    for number, camera in enumerate(cameras):
        render = rasteriser.measure_pruning(
            model, camera, error, seen, background=background, antialiased=model.metadata.antialiased
        )
        if on_render is not None:
            on_render(render)
        context.progress("measuring splats", (number + 1) / len(cameras))
    return PruningError(error, seen, sum(3 * camera.W * camera.H for camera in cameras))


def pruning_error_exact(
    model: SplatModel,
    cameras: Sequence[Camera],
    rows: ArrayLike,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    transmittance_min: float = TRANSMITTANCE_MIN,
) -> Array:
    """Compute the errors of `measure_pruning_error` slowly, by rendering in float64 without each splat.

    Args:
        model: the scene.
        cameras: the views.
        rows: indices of the splats to measure.
        background: red, green, blue of the background.
        transmittance_min: transmittance at which a pixel is finished; 0: never, for which the fast pass is exact.

    Returns:
        Squared change of the renders for each of `rows`, float64.
    """
    rows = np.asarray(rows, np.int64)
    errors = np.zeros(len(rows))

    def render(splats: SplatModel, camera: Camera) -> Array:
        """Return the render of some of the splats, [H, W, 3] float64, with the settings of the whole scene."""
        return render_exact(
            splats,
            camera,
            background=background,
            antialiased=model.metadata.antialiased,
            transmittance_min=transmittance_min,
        ).rgb

    for camera in cameras:
        complete = render(model, camera)
        for place, row in enumerate(rows):
            others = model.select(np.delete(np.arange(len(model)), row))
            errors[place] += float(np.sum((render(others, camera) - complete) ** 2))
    return errors
