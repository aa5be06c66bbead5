"""Colours that fit pictures best, with everything else fixed: ridge least squares in spherical harmonics.

With geometry and opacity fixed a pixel is Σ_i w_i · (½ + Y(view)·c_i), linear in the coefficients c, but for the clamp
of each splat's colour at 0. The clamp is linearised: a colour that is 0 in a view with the coefficients that the fit
starts from stays 0 there, the others are taken as free. What is minimised is

    Σ over views, pixels, channels (picture − reference)² + Σ_i r · (c_i − c0_i)²,

with a ridge r that keeps what no view saw where it was. Preconditioned conjugate gradients: the matrix is never built,
its product with a vector is a picture of the vector's colours taken back to the splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.types import F32, Progress
from csplat_render.camera import Camera
from csplat_render.contributions import Contributions, ProjectedView
from csplat_render.conventions import Array, HasSplats

Floats = NDArray[Any]

#: Memory for views that are drawn once and kept; the others are drawn anew in every step.
CACHE_BYTES = 2 << 30

#: Squared error per square of a coefficient: some ten pixels at 40 dB for every 0.1 that a coefficient is moved.
RIDGE = 0.1


class ColourOperator:
    """The matrix from coefficients to pictures, and its transpose, of fixed geometry. Owns views that are drawn once.

    Args:
        splats: the geometry; `sh0` and `shN` say which colours are clamped.
        cameras: the views.
        background: red, green, blue behind everything.
        antialiased: see `Rasteriser.forward`.
        threads: how many; None for all. No result depends on it.
        cache_bytes: memory for views that are kept.
    """

    def __init__(
        self,
        splats: HasSplats,
        cameras: Sequence[Camera],
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
        threads: int | None = None,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        self.cameras = cameras
        self.antialiased = antialiased
        self._drawing = Contributions(threads=threads)
        self._background = np.asarray(background, np.float32)
        self._black = np.zeros(3, np.float32)
        self._cache_left = cache_bytes
        self._kept: dict[int, tuple[ProjectedView, Array]] = {}
        self._splats = splats

    def error(
        self, coefficients: F32, references: Sequence[Array], gradient: F32, diagonal: F32 | None = None
    ) -> float:
        """Squared error of the pictures, and half its gradient.

        Args:
            coefficients: [N, B, 3].
            references: the wanted pictures, [H, W, 3] each.
            gradient: [N, B, 3], added to.
            diagonal: [N, B], added to: the diagonal of the matrix transposed times itself; None if it is not wanted.
        """
        unwanted = np.empty((0, coefficients.shape[1]), np.float32)
        total = 0.0
        for number in range(len(self.cameras)):
            drawn, active = self._view(number)
            rgb = self._drawing.colours(
                drawn, coefficients, active, gradient, unwanted if diagonal is None else diagonal,
                offset=0.5, background=self._background, reference=references[number],
            )  # fmt: skip
            self._keep(number, drawn, active)
            total += float(np.sum(np.square(rgb - references[number], dtype=np.float64)))
        return total

    def normal(self, vector: Floats, result: Floats) -> float:
        """Add the matrix, transposed, times itself, times a vector; return the squared length of the pictures.

        Args:
            vector: [N, B, 3] float32.
            result: [N, B, 3] float32, added to.
        """
        unwanted = np.empty((0, vector.shape[1]), np.float32)
        total = 0.0
        for number in range(len(self.cameras)):
            drawn, active = self._view(number)
            rgb = self._drawing.colours(drawn, vector, active, result, unwanted, offset=0.0, background=self._black)
            self._keep(number, drawn, active)
            total += float(np.sum(np.square(rgb, dtype=np.float64)))
        return total

    def _view(self, number: int) -> tuple[ProjectedView, Array]:
        kept = self._kept.get(number)
        if kept is None:
            drawn = self._drawing.draw(self._splats, self.cameras[number], antialiased=self.antialiased)
            kept = (drawn, drawn.shape[:, 6:9] > 0.0)
        return kept

    def _keep(self, number: int, drawn: ProjectedView, active: Array) -> None:
        """Keep a view whose weights have just been summed, if there is room: what has none is not looked at again."""
        if number in self._kept or drawn.size_bytes > self._cache_left:
            return
        trimmed, left = self._drawing.trimmed(drawn)
        self._cache_left -= trimmed.size_bytes
        self._kept[number] = (trimmed, active[left])


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
    threads: int | None = None,
    cache_bytes: int = CACHE_BYTES,
    progress: Progress | None = None,
) -> tuple[F32, list[float]]:
    """Fit the colours of splats to pictures.

    Args:
        splats: geometry, and the colours to start from.
        cameras: the views, relative to the scene's origin.
        references: the wanted pictures, [H, W, 3] each, as float; they may exceed 1.
        steps: of conjugate gradients at most.
        ridge: squared error per square of a coefficient.
        least_gain: stop when a step takes off less than this share of the error.
        background: red, green, blue behind everything.
        antialiased: see `Rasteriser.forward`.
        threads: how many; None for all. The result does not depend on it.
        cache_bytes: memory for views that are drawn once and kept.
        progress: is told how much is done.

    Returns:
        [N, B, 3] float32, and what is minimised, by the linearised model, before the first and after every step.

    Raises:
        InputError: there is no camera, or there are not as many references.
    """
    if not cameras or len(references) != len(cameras):
        raise InputError(f"a fit wants cameras and as many pictures, found {len(cameras)} and {len(references)}")
    operator = ColourOperator(
        splats, cameras, background=background, antialiased=antialiased, threads=threads, cache_bytes=cache_bytes
    )
    x = np.concatenate([splats.sh0[:, None], splats.shN], axis=1, dtype=np.float32)
    gradient, diagonal = np.zeros_like(x), np.zeros(x.shape[:2], np.float32)
    errors = [operator.error(x, references, gradient, diagonal)]
    residual = -gradient
    scale = (np.float32(1.0) / (diagonal + np.float32(ridge)))[..., None]
    direction = scale * residual
    product = _dot(residual, direction)
    for step in range(steps):
        if progress is not None:
            progress("fitting colours", (step + 1) / (steps + 1))
        image = np.float32(ridge) * direction
        operator.normal(direction, image)
        curvature = _dot(direction, image)
        if not 0.0 < curvature < np.inf:
            break  # nothing is seen, or the fit is exact, or colours are beyond all measure
        length = product / curvature
        x += np.float32(length) * direction
        residual -= np.float32(length) * image
        errors.append(errors[-1] - length * product)
        if errors[-2] - errors[-1] < least_gain * errors[-1]:
            break
        preconditioned = scale * residual
        product, before = _dot(residual, preconditioned), product
        direction = preconditioned + np.float32(product / before) * direction
    if progress is not None:
        progress("fitting colours", 1.0)
    return x, errors


def _dot(a: Floats, b: Floats) -> float:
    """The sum of products in float64; not BLAS, whose sums depend on threads."""
    return float(np.einsum("ijk,ijk->", a, b, dtype=np.float64))
