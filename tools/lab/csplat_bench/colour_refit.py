"""Refit of colours to images with everything else fixed: ridge least squares in spherical harmonics.

With fixed geometry and opacity, a pixel Σ_i w_i · (½ + Y(view)·c_i) is linear in the coefficients c, except for the
clamp of each splat's colour at 0. The clamp is linearised: a colour that is 0 in a view with the initial coefficients
stays 0 in this view, the others are free. The fit minimises

    Σ over views, pixels, channels (render − reference)² + Σ_i r · (c_i − c0_i)²,

with a ridge r that determines colours that no view shows. With A the linear map from coefficients to renders, it solves
the normal equations (Aᵀ A + r I) (c − c0) = −Aᵀ (render_0 − reference) by conjugate gradients with the diagonal as
preconditioner. The matrix is never built: A renders the colours of a vector, Aᵀ projects the image back to the splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_render.contributions import Contributions, ProjectedView
from csplat_render.conventions import Array, HasSplats

Floats = NDArray[Any]

#: Bytes of memory for projected views; further views are projected again in every step.
CACHE_BYTES = 2 << 30

#: r, squared error per square of a coefficient: a change of 0.1 costs the error of about ten pixels at 40 dB.
RIDGE = 0.1


class ColourOperator:
    """The linear map from coefficients to renders of fixed geometry, and its transpose. Owns a cache of views.

    Args:
        splats: the geometry; `sh0` and `shN` determine which colours are clamped.
        cameras: the views.
        background: red, green, blue of the background.
        antialiased: see `Rasteriser.forward`.
        cache_bytes: memory for projected views.
        context: threads.
    """

    def __init__(
        self,
        splats: HasSplats,
        cameras: Sequence[Camera],
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
        cache_bytes: int = CACHE_BYTES,
        context: Context = DEFAULT_CONTEXT,
    ) -> None:
        self.cameras = cameras
        self.antialiased = antialiased
        self._contributions = Contributions(context=context)
        self._background = np.asarray(background, np.float32)
        self._black = np.zeros(3, np.float32)
        self._cache_left = cache_bytes
        self._kept: dict[int, tuple[ProjectedView, Array]] = {}
        self._splats = splats

    def error(
        self, coefficients: F32, references: Sequence[Array], gradient: F32, diagonal: F32 | None = None
    ) -> float:
        """Return the squared error of the renders, and add half its gradient.

        Args:
            coefficients: [N, B, 3].
            references: the reference images, [H, W, 3] each.
            gradient: [N, B, 3], Aᵀ (render − reference) is added.
            diagonal: [N, B], the diagonal of Aᵀ A is added; `None`: it is not computed.
        """
        not_needed = np.empty((0, coefficients.shape[1]), np.float32)
        total = 0.0
        for number in range(len(self.cameras)):
            drawn, active = self._view(number)
            rgb = self._contributions.backproject(
                drawn, coefficients, active, gradient, not_needed if diagonal is None else diagonal,
                offset=0.5, background=self._background, reference=references[number],
            )  # fmt: skip
            self._keep(number, drawn, active)
            total += float(np.sum(np.square(rgb - references[number], dtype=np.float64)))
        return total

    def normal(self, vector: Floats, result: Floats) -> float:
        """Add Aᵀ A v to a result, and return |A v|².

        Args:
            vector: [N, B, 3] float32, v.
            result: [N, B, 3] float32, Aᵀ A v is added.
        """
        not_needed = np.empty((0, vector.shape[1]), np.float32)
        total = 0.0
        for number in range(len(self.cameras)):
            drawn, active = self._view(number)
            rgb = self._contributions.backproject(
                drawn, vector, active, result, not_needed, offset=0.0, background=self._black
            )
            self._keep(number, drawn, active)
            total += float(np.sum(np.square(rgb, dtype=np.float64)))
        return total

    def _view(self, number: int) -> tuple[ProjectedView, Array]:
        kept = self._kept.get(number)
        if kept is None:
            drawn = self._contributions.project_view(self._splats, self.cameras[number], antialiased=self.antialiased)
            kept = (drawn, drawn.shape[:, 6:9] > 0.0)
        return kept

    def _keep(self, number: int, drawn: ProjectedView, active: Array) -> None:
        """Cache a view after its `backproject`, without splats of zero weight, if it fits."""
        if number in self._kept or drawn.size_bytes > self._cache_left:
            return
        trimmed, kept = self._contributions.trim(drawn)
        self._cache_left -= trimmed.size_bytes
        self._kept[number] = (trimmed, active[kept])


def fit_colours(
    splats: HasSplats,
    cameras: Sequence[Camera],
    references: Sequence[Array],
    *,
    steps: int = 8,
    ridge: float = RIDGE,
    least_gain: float = 0.01,
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    cache_bytes: int = CACHE_BYTES,
    context: Context = DEFAULT_CONTEXT,
) -> tuple[F32, list[float]]:
    """Fit the colours of splats to images.

    Args:
        splats: geometry and initial colours.
        cameras: the views, relative to the scene's origin.
        references: the reference images, [H, W, 3] each, floats, which may exceed 1.
        steps: maximum number of steps of conjugate gradients.
        ridge: squared error per square of a coefficient.
        least_gain: stop when a step reduces the error by less than this fraction.
        background: red, green, blue of the background.
        antialiased: see `Rasteriser.forward`.
        cache_bytes: memory for projected views.
        context: threads and progress.

    Returns:
        [N, B, 3] float32, the coefficients; and the minimised sum according to the linearised model, before the first
        and after every step.

    Raises:
        InputError: there is no camera, or the number of references differs.
    """
    if not cameras or len(references) != len(cameras):
        raise InputError(f"found {len(cameras)} cameras and {len(references)} reference images, expected one for each")
    operator = ColourOperator(
        splats, cameras, background=background, antialiased=antialiased, cache_bytes=cache_bytes, context=context
    )
    x = np.concatenate([splats.sh0[:, None], splats.shN], axis=1, dtype=np.float32)
    gradient, diagonal = np.zeros_like(x), np.zeros(x.shape[:2], np.float32)
    errors = [operator.error(x, references, gradient, diagonal)]
    residual = -gradient
    scale = (np.float32(1.0) / (diagonal + np.float32(ridge)))[..., None]
    direction = scale * residual
    product = _dot(residual, direction)
    for step in range(steps):
        context.progress("fitting colours", (step + 1) / (steps + 1))
        image = np.float32(ridge) * direction
        operator.normal(direction, image)
        curvature = _dot(direction, image)
        if not 0.0 < curvature < np.inf:
            break  # no splat is visible, the fit is exact, or colours overflow
        length = product / curvature
        x += np.float32(length) * direction
        residual -= np.float32(length) * image
        errors.append(errors[-1] - length * product)
        if errors[-2] - errors[-1] < least_gain * errors[-1]:
            break
        preconditioned = scale * residual
        product, before = _dot(residual, preconditioned), product
        direction = preconditioned + np.float32(product / before) * direction
    context.progress("fitting colours", 1.0)
    return x, errors


def _dot(a: Floats, b: Floats) -> float:
    """Return the scalar product in float64, without BLAS, whose rounding depends on the number of threads."""
    return float(np.einsum("ijk,ijk->", a, b, dtype=np.float64))
