# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of renders to each splat, attribute by attribute, measured from training or virtual cameras.

The sensitivity of a parameter p is S(p) = Σ_i |∂E_i/∂p| / Σ_i P_i over the views i, with E_i the sum of the red, green
and blue of view i, and P_i its number of pixels. The sensitivity of a group of parameters is its maximum (Niedermayr,
Stumpfegger, Westermann, "Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis", CVPR 2024). This suits
colours. For opacity and shape the pixels of one view cancel in E_i: a growing splat brightens some pixels and darkens
others. So magnitudes are taken here before pixels and channels are summed; the published quantity is computed as well.

Sums of squares instead of magnitudes are the diagonal of the Gauss–Newton matrix: the squared error that a small error
of the parameter adds to the renders. They are the weights of k-means, which minimises squared errors.

At a pixel, let s_c be the derivative of channel c by the exponent of a splat, and t = ∂exponent/∂(Σ / γ²), a symmetric
matrix, with Σ the splat's covariance and γ² its trace. With Σ2 the covariance on the render, M the linearised
perspective and d the distance of the pixel from the centre,

    t = h hᵀ + C,  h = γ/√2 · Mᵀ Σ2⁻¹ d

C is 0 except in antialiased mode, in which the opacity depends on the covariance, too. h is linear in d: its
coefficients are computed once per splat, and `native/sensitivity.cpp` evaluates it at each pixel and sums

    Σ w, Σ w²                        w: the splat's weight at the pixel
    Σ s, Σ |s|, Σ s²                 s, |s|, s²: summed over channels
    Σ s t, Σ |s| |t|                 entries xx, yy, zz, xy, xz, yz of t
    Σ s² |h|²                        squared derivative by the centre, up to 2 / γ²
    Σ s² t tᵀ                        21 entries: the Gauss–Newton matrix of the covariance
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, F64
from csplat_render.camera import Camera
from csplat_render.rasteriser import Rasteriser

_DIAGONAL = [0, 6, 11, 15, 18, 20]  # indices of the diagonal in a triangle of 6 by 6
_MAX_SUM = 1e37  # largest value of a sum, so that six of them fit float32


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sensitivities and squared derivatives of a scene's renders, by splat and group of attributes.

    Attributes:
        colour: [N] float64, S of the SH coefficients including sh0: the largest of up to 75.
        opacity: [N] float64, S of alpha, with magnitudes summed over pixels and channels.
        shape: [N] float64, S of the covariance over its trace, the largest of 6 entries, summed likewise.
        opacity_net: [N] float64, S of alpha as published: pixels of a view cancel.
        shape_net: [N] float64, the same for the covariance. All five are `None` if they were not requested.
        colour_squares: [N] float64, squared derivatives of a pixel's channel by the splat's colour in that channel,
            summed over pixels and views, per pixel.
        opacity_squares: [N] float64, the same of all three channels by alpha.
        shape_squares: [N] float64, by all nine entries of the covariance over its trace.
        means_squares: [N] float64, by the three coordinates of the centre, per square scene unit; effects through the
            viewing direction are ignored.
        shape_metric: [N, 21] float64, the Gauss–Newton matrix whose trace is `shape_squares`: the upper triangle, row
            by row, over xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance over its trace.
        metric: [N, B (B + 1) / 2] float32, `colour_squares` with the basis functions of each view, B = (degree + 1)²:
            the upper triangle of the Gauss–Newton matrix of the SH coefficients of one channel; `None` if it was not
            requested.
        views: [N] int64, number of views that saw the splat.
        view_count: number of views.
        pixel_count: pixels of all views together.
    """

    colour: F64 | None
    opacity: F64 | None
    shape: F64 | None
    opacity_net: F64 | None
    shape_net: F64 | None
    colour_squares: F64
    opacity_squares: F64
    shape_squares: F64
    means_squares: F64
    shape_metric: F64
    metric: F32 | None
    views: NDArray[np.int64]
    view_count: int
    pixel_count: int

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[N] bool, True for splats that any view saw; the others have a colour sensitivity of 0."""
        seen: NDArray[np.bool_] = self.views > 0
        return seen

    @property
    def unseen_share(self) -> float:
        """Fraction of the splats that no view saw."""
        return 1.0 - float(self.seen.mean()) if len(self.views) else 0.0


def measure_sensitivity(
    model: SplatModel,
    cameras: Sequence[Camera],
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    metric: bool = False,
    magnitudes: bool = True,
    context: Context = DEFAULT_CONTEXT,
) -> Sensitivity:
    """Measure how much renders depend on each splat.

    Args:
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: background colour.
        metric: compute the matrices of SH coefficients, too, which take 2 B (B + 1) bytes per splat.
        magnitudes: compute the sensitivities themselves, which take 112 + 12 B bytes per splat.
        context: threads and progress.

    Raises:
        InputError: there are no cameras.
        LimitError: a render has more than `rasteriser.MAX_INTERSECTIONS`.
    """
    if not cameras:
        raise InputError("measuring sensitivity requires at least one camera")
    derivatives = _Derivatives(model, metric=metric, magnitudes=magnitudes, context=context)
    for number, camera in enumerate(cameras):
        derivatives.add(camera, background)
        context.progress("measuring sensitivity", (number + 1) / len(cameras))
    return derivatives.result()


class _Derivatives:
    """The sums of the derivatives of views.

    Args:
        model, metric, magnitudes, context: as for `measure_sensitivity`. Sums not requested have no rows.
    """

    def __init__(self, model: SplatModel, *, metric: bool, magnitudes: bool, context: Context) -> None:
        n, count = len(model), 1 + model.shN.shape[1]
        self._model, self._rasteriser = model, Rasteriser(context=context)
        self._forms = np.empty((n, 12))  # scratch
        rows = n if magnitudes else 0
        self._colour = np.zeros((rows, count, 3), np.float32)
        self._net, self._sizes = np.zeros((rows, 7)), np.zeros((rows, 7))  # alpha, six entries of the covariance
        self._squares = np.zeros((n, 3))  # colour, alpha, centre
        self._shape_matrices = np.zeros((n, 21))  # upper triangles over the six entries
        self._metric = np.zeros((n if metric else 0, count * (count + 1) // 2), np.float32)
        self._views = np.zeros(n, np.int64)
        self._keeps_metric, self._keeps_magnitudes = metric, magnitudes
        self._view_count = self._pixel_count = 0

    def add(self, camera: Camera, background: ArrayLike) -> None:
        """Add one view."""
        magnitudes = (self._colour, self._net, self._sizes) if self._keeps_magnitudes else (None, None, None)
        metric = self._metric if self._keeps_metric else None
        self._rasteriser.add_derivatives(
            self._model,
            camera,
            (self._forms, *magnitudes, self._squares, metric, self._shape_matrices, self._views),
            background=background,
            antialiased=self._model.metadata.antialiased,
        )
        self._view_count += 1
        self._pixel_count += camera.W * camera.H

    def result(self) -> Sensitivity:
        """Divide by the number of pixels, and take the maximum of each group."""
        pixels = max(1, self._pixel_count)
        self._metric /= np.float32(pixels)
        shape_matrices, squares, net, sizes = (
            _mean_over(sums, pixels) for sums in (self._shape_matrices, self._squares, self._net, self._sizes)
        )
        kept = self._keeps_magnitudes
        return Sensitivity(
            colour=self._colour.max(axis=(1, 2), initial=0.0).astype(np.float64) / pixels if kept else None,
            opacity=sizes[:, 0] if kept else None,
            shape=sizes[:, 1:].max(axis=1) if kept else None,
            opacity_net=net[:, 0] if kept else None,
            shape_net=net[:, 1:].max(axis=1) if kept else None,
            colour_squares=squares[:, 0],
            opacity_squares=squares[:, 1],
            shape_squares=shape_matrices[:, _DIAGONAL].sum(axis=1),
            means_squares=squares[:, 2],
            shape_metric=shape_matrices,
            metric=self._metric if self._keeps_metric else None,
            views=self._views,
            view_count=self._view_count,
            pixel_count=self._pixel_count,
        )


def _mean_over(sums: F64, pixels: int) -> F64:
    """Divide an array of any shape in place, and limit it to float32; sums that overflowed float64 become 0."""
    sums /= pixels
    np.nan_to_num(sums, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    return np.clip(sums, -_MAX_SUM, _MAX_SUM, out=sums)
