"""Pruning error: the exact leave-one-out error of every splat, in one pass over views.

It is exact for pruning a single splat, with two exceptions: a finished pixel stays finished, although it might continue
without one of its splats (the omitted light has a transmittance of at most 1e-4 / (1 − alpha)); and renders are not
clipped to 0..1. The equations are in `contributions`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_render.camera import Camera
from csplat_render.contributions import Contributions
from csplat_render.conventions import TRANSMITTANCE_MIN, Array
from csplat_render.reference_rasteriser import render_exact


@dataclass(frozen=True, eq=False)
class PruningError:
    """Sums over pixels, channels and views; objects of different views can be added.

    Attributes:
        error: [N] float64, squared change of the renders without the splat.
        squared_weight: [N] float64, squared weight of the splat.
        seen: [N] bool, True for splats that are visible in a view.
        bands: [N, d] float64, squared change of the renders with zeros in the splat's SH band 1, … d; [N, 0] if not
            requested.
        value_count: number of pixels times channels of all views.
        product: [N] float64, change times (render − reference): pruning adds `error + 2 · product` to the squared
            error. `None` if the renders are their own references.
    """

    error: Array
    squared_weight: Array
    seen: Array
    bands: Array
    value_count: int
    product: Array | None = None

    def of_rows(self, rows: Array) -> PruningError:
        """Return the sums of some of the splats."""
        return replace(
            self, error=self.error[rows], squared_weight=self.squared_weight[rows], seen=self.seen[rows],
            bands=self.bands[rows], product=None if self.product is None else self.product[rows],
        )  # fmt: skip

    def __add__(self, other: PruningError) -> PruningError:
        return PruningError(
            self.error + other.error,
            self.squared_weight + other.squared_weight,
            self.seen | other.seen,
            self.bands + other.bands,
            self.value_count + other.value_count,
            None if self.product is None or other.product is None else self.product + other.product,
        )


def measure_pruning_error(
    model: SplatModel,
    cameras: Sequence[Camera],
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    bands: bool = True,
    references: Sequence[Array] | None = None,
    on_render: Callable[[int, Array], object] | None = None,
    dtype: Any = np.float32,
    transmittance_min: float = TRANSMITTANCE_MIN,
    threads: int | None = None,
    progress: Progress | None = None,
) -> PruningError:
    """Measure the effect of pruning each splat alone on the renders of a scene.

    Args:
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: red, green, blue of the background.
        bands: also measure the effect of SH bands.
        references: the reference images, [H, W, 3] each; `None`: renders of the scene itself.
        on_render: called with the index of each render and the render, [H, W, 3].
        dtype: dtype of pixels, float32 or (for tests) float64.
        transmittance_min: transmittance at which a pixel is finished; 0: never.
        threads: number of threads; `None`: all. The result does not depend on it.
        progress: called with the stage and the completed fraction.

    Raises:
        InputError: there is no camera, or the number of references differs.
        LimitError: a render has more than `rasteriser.MAX_INTERSECTIONS`.
    """
    if not cameras:
        raise InputError("measuring the pruning error requires at least one camera")
    if references is not None and len(references) != len(cameras):
        raise InputError(f"found {len(references)} reference images, expected one for each of {len(cameras)} cameras")
    contributions = Contributions(dtype, transmittance_min=transmittance_min, threads=threads)
    totals, by_band = np.zeros((len(model), 5)), np.zeros((len(model), model.sh_degree if bands else 0))
    behind = np.asarray(background, np.float64)
    for number, camera in enumerate(cameras):
        view = contributions.project_view(model, camera, antialiased=model.antialiased, basis=bands)
        reference = None if references is None else references[number]
        render = contributions.measure_pruning(view, model.shN, totals, by_band, background=behind, reference=reference)
        if on_render is not None:
            on_render(number, render)
        if progress is not None:
            progress("measuring splats", (number + 1) / len(cameras))
    error, product, squares = (totals[:, k].copy() for k in (0, 1, 3))
    count = sum(3 * camera.W * camera.H for camera in cameras)
    return PruningError(error, squares, totals[:, 4] > 0.0, by_band, count, None if references is None else product)


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
        return render_exact(
            splats, camera, background=background, antialiased=model.antialiased, transmittance_min=transmittance_min
        ).rgb

    for camera in cameras:
        whole = render(model, camera)
        for place, row in enumerate(rows):
            rest = model.select(np.delete(np.arange(len(model)), row))
            errors[place] += float(np.sum((render(rest, camera) - whole) ** 2))
    return errors
