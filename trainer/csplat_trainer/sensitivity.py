"""Sensitivity of renders to each splat, attribute by attribute, measured from training cameras or virtual ones.

The sensitivity of a parameter p is S(p) = Σ_i |∂E_i/∂p| / Σ_i P_i over the views i, E_i the sum of the red, green and
blue of view i, P_i its pixels; that of a group of parameters is its maximum (Niedermayr, Stumpfegger, Westermann,
"Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis", CVPR 2024). For colours that is what counts.
For opacity and shape the pixels of one view cancel in E_i: a splat that grows brightens here what it darkens there. So
magnitudes are taken here before pixels and channels are added up; the published figure is reported as well.

Sums of squares in place of magnitudes are the diagonal of the Gauss-Newton matrix: what a small error of the parameter
adds to the squared error of the renders. They are the weights of k-means, whose errors are squared too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, F64, Progress
from csplat_render.camera import Camera
from csplat_render.conventions import view_vector
from csplat_render.kernels import thread_count
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.sensitivity_forms import FORM, covariance_forms
from csplat_trainer.sensitivity_sums import SUMS, add_view, sum_derivatives

_DIAGONAL = [0, 6, 11, 15, 18, 20]  # indices of the diagonal in a triangle of 6 by 6
_LARGEST = 1e37  # largest value of a sum; float32 holds six of them


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sensitivities and squared derivatives of a scene's renders, by splat and group of attributes.

    Attributes:
        colour: [N] float64, S of the SH coefficients, sh0 among them: the largest of up to 48.
        opacity: [N] float64, S of alpha, magnitudes added pixel by pixel and channel by channel.
        shape: [N] float64, S of the covariance divided by its trace, the largest of 6 entries, added likewise.
        opacity_net: [N] float64, S of alpha as published: pixels of a view cancel.
        shape_net: [N] float64, the same of the covariance. All five are `None` if they were not requested.
        colour_squares: [N] float64, squared derivatives of a pixel's channel towards the splat's colour in that
            channel, summed over pixels and views, per pixel.
        opacity_squares: [N] float64, the same of all three channels towards alpha.
        shape_squares: [N] float64, towards all nine entries of the covariance divided by its trace.
        means_squares: [N] float64, towards the three coordinates of the centre, per square scene unit; effects through
            the viewing direction alone are left out.
        shape_metric: [N, 21] float64, the Gauss-Newton matrix whose trace is `shape_squares`: the upper triangle, row
            by row, over xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance divided by its trace.
        metric: [N, B (B + 1) / 2] float32, `colour_squares` with the basis functions of each view, B = (degree + 1)²:
            the Gauss-Newton matrix of the SH coefficients of one channel, its upper triangle; None if it was not
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
        """[N], which splats any view saw: the others have a colour sensitivity of 0."""
        seen: NDArray[np.bool_] = self.views > 0
        return seen

    @property
    def unseen_share(self) -> float:
        """Share of the splats that no view saw."""
        return 1.0 - float(self.seen.mean()) if len(self.views) else 0.0


def measure_sensitivity(
    model: SplatModel,
    cameras: Sequence[Camera],
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    metric: bool = False,
    magnitudes: bool = True,
    dtype: Any = np.float32,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Sensitivity:
    """Measure what pictures depend on.

    Args:
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: red, green, blue behind everything.
        metric: compute the matrices of SH coefficients too: 2 B (B + 1) bytes per splat.
        magnitudes: compute the sensitivities themselves; without them 112 + 12 B bytes per splat less.
        dtype: dtype of pixels, float32 or float64 (which is for tests).
        threads: number of threads; None for all. The result does not depend on it.
        progress: called with the stage and the fraction done.

    Raises:
        InputError: there is no camera.
        LimitError: a picture has more than `rasterise.MAX_INTERSECTIONS`.
    """
    if not cameras:
        raise InputError("measuring sensitivity wants a camera at least")
    drawing = _Derivatives(model, metric=metric, magnitudes=magnitudes, dtype=dtype, threads=threads)
    for number, camera in enumerate(cameras):
        drawing.add(camera, background)
        if progress is not None:
            progress("measuring sensitivity", (number + 1) / len(cameras))
    return drawing.result()


class _Derivatives(Rasteriser):
    """Renders views and adds up the derivatives of each. Owns the sums."""

    def __init__(self, model: SplatModel, *, metric: bool, magnitudes: bool, dtype: Any, threads: int | None) -> None:
        super().__init__("standard", dtype, gradients=True, threads=threads)
        n, count = len(model), 1 + model.shN.shape[1]
        self._model = model
        rows = n if magnitudes else 0
        self._colour = np.zeros((rows, count, 3), np.float32)
        self._net, self._sizes = np.zeros((rows, 7)), np.zeros((rows, 7))
        self._squares, self._bends = np.zeros((n, 3)), np.zeros((n, 21))
        self._metric = np.zeros((n if metric else 0, count * (count + 1) // 2), np.float32)
        self._views = np.zeros(n, np.int64)
        self._wanted, self._magnitudes = metric, magnitudes
        self._view_count = self._pixel_count = 0

    def add(self, camera: Camera, background: ArrayLike) -> None:
        """Add one view."""
        self.forward(self._model, camera, background=background, antialiased=self._model.antialiased)
        last = self._last
        assert last is not None
        a, n = last.splats, len(self._model)
        shape, box = self._buffer("shape", (n, 10), np.float64), self._buffer("box", (n, 4), np.int32)
        near, offsets = self._buffer("near", (n,), np.float32), self._buffer("offsets", (n + 1,), np.int64)
        forms = self._buffer("forms", (n, FORM), np.float64)
        records = self._buffer("derivatives", (last.intersections, SUMS), self.dtype)
        view = view_vector(camera)
        with thread_count(self.threads):
            covariance_forms(a.means, a.quats, a.scales, view, last.antialiased, shape, near, forms)
            sum_derivatives(
                self._buffer("starts", (last.tile_count + 1,), np.int64),
                self._buffer("used", (last.tile_count,), np.int64), self._buffers["ids"], self._buffers["slots"],
                shape, box, forms, last.tiles_x, self._limits, last.rgb, records,
            )  # fmt: skip
            add_view(
                a.means, a.opacities, a.scales, view, last.degree, shape, near, offsets, records,
                self._colour, self._net, self._sizes, self._squares, self._metric, self._bends,
                self._views,
            )  # fmt: skip
        self._view_count += 1
        self._pixel_count += camera.W * camera.H

    def result(self) -> Sensitivity:
        """Divide by the pixels, and take the largest of each group."""
        pixels = max(1, self._pixel_count)
        self._metric /= np.float32(pixels)
        bends, squares, net, sizes = (
            _over(sums, pixels) for sums in (self._bends, self._squares, self._net, self._sizes)
        )
        kept = self._magnitudes
        return Sensitivity(
            colour=self._colour.max(axis=(1, 2), initial=0.0).astype(np.float64) / pixels if kept else None,
            opacity=sizes[:, 0] if kept else None,
            shape=sizes[:, 1:].max(axis=1) if kept else None,
            opacity_net=net[:, 0] if kept else None,
            shape_net=net[:, 1:].max(axis=1) if kept else None,
            colour_squares=squares[:, 0],
            opacity_squares=squares[:, 1],
            shape_squares=bends[:, _DIAGONAL].sum(axis=1),
            means_squares=squares[:, 2],
            shape_metric=bends,
            metric=self._metric if self._wanted else None,
            views=self._views,
            view_count=self._view_count,
            pixel_count=self._pixel_count,
        )


def _over(sums: F64, pixels: int) -> F64:
    """Divide the array in place and make it fit float32; sums that have overflowed float64 become 0. Return it."""
    sums /= pixels
    np.nan_to_num(sums, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    return np.clip(sums, -_LARGEST, _LARGEST, out=sums)
