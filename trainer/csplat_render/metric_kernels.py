# SPDX-License-Identifier: Apache-2.0
"""SSIM and the convolution of LPIPS: the kernels of `native/images.cpp`, and their twins.

SSIM (Wang et al. 2004) of a pixel is

    (2 μx μy + C1) (2 σxy + C2) / ((μx² + μy² + C1) (σx² + σy² + C2)),  σxy = E[x y] − μx μy, likewise σx², σy²,

where μ and E are means weighted by the window, a Gaussian of 11×11 pixels and σ 1.5, with zeros beyond the border, and
C1 = 0.01², C2 = 0.03². The trainer's loss uses the same conventions.

The convolution does not use NumPy's BLAS, whose threads spin while they wait: with other programs on the same two
cores, two images of 640×480 took 5 s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat.types import F32, F64
from csplat_render import kernels

C1, C2 = 0.01**2, 0.03**2

RADIUS = 5  #: pixels from the centre of the window to its edge

_SIGMA = 1.5  # pixels
_PANEL = 32  # outputs whose weights lie together, as in native/images.cpp


def _window() -> F64:
    """Return the weights of `WINDOW`."""
    taps = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2.0 * _SIGMA**2))
    normalised: F64 = taps / taps.sum()
    return normalised


#: [11] float64 with sum 1; the window is the outer product with itself.
WINDOW = _window()


def mean_ssim(x: F64, y: F64) -> float:
    """Return the mean SSIM over all pixels and channels.

    Args:
        x, y: [H, W, 3] float64, C-contiguous.
    """
    assert x.dtype == y.dtype == np.float64
    assert x.shape == y.shape
    sums = np.empty(3, np.float64)
    kernels.call("ssim", x, y, len(x), x[0].size, sums)
    return float(sums[1]) / x.size


def mean_ssim_twin(x: F64, y: F64) -> float:
    """Compute `mean_ssim` slowly in NumPy."""
    mx, my = blur_twin(x), blur_twin(y)
    xx, yy, xy = blur_twin(x * x) - mx * mx, blur_twin(y * y) - my * my, blur_twin(x * y) - mx * my
    return float(np.mean((2.0 * mx * my + C1) * (2.0 * xy + C2) / ((mx * mx + my * my + C1) * (xx + yy + C2))))


def blur_twin(x: F64) -> F64:
    """Return the weighted mean over the window around each pixel of [H, W, 3]."""
    for axis in (0, 1):
        padded = np.pad(x, [(RADIUS, RADIUS) if i == axis else (0, 0) for i in range(3)])
        x = sum(
            (tap * np.take(padded, np.arange(k, k + x.shape[axis]), axis) for k, tap in enumerate(WINDOW)),
            np.zeros_like(x),
        )
    return x


def convolve(x: F32, kernel: F32, bias: F32, stride: int, padding: int) -> F32:
    """Convolve an image: y[r, c, o] = bias[o] + Σ_ijk kernel[i, j, k, o] · x[r stride + i, c stride + j, k], padded.

    Args:
        x: [h, w, in].
        kernel: [height, width, in, out].
        bias: [out].
        stride: pixels from one output to the next, in both directions.
        padding: width of the zero border.

    Returns:
        [rows, columns, out].
    """
    height, width, inputs, outputs = kernel.shape
    padded = np.pad(np.ascontiguousarray(x, np.float32), ((padding, padding), (padding, padding), (0, 0)))
    rows, columns = ((size - k) // stride + 1 for size, k in zip(padded.shape, (height, width), strict=False))
    more = -outputs % _PANEL
    weights = np.pad(kernel.astype(np.float32, copy=False).reshape(-1, outputs), ((0, 0), (0, more)))
    panels = np.ascontiguousarray(weights.reshape(len(weights), -1, _PANEL).swapaxes(0, 1))
    offsets = np.pad(bias.astype(np.float32), (0, more))
    result = np.empty((rows, columns, len(offsets)), np.float32)
    # A row of the kernel is contiguous in a row of the image.
    image = padded, padded[0].size
    taps = panels, offsets, height, width * inputs, len(offsets)
    kernels.call("convolve", *image, *taps, stride, stride * inputs, rows, columns, result)
    return np.ascontiguousarray(result[..., :outputs])


def convolve_twin(x: F32, kernel: F32, bias: F32, stride: int, padding: int) -> NDArray[np.float64]:
    """Compute `convolve` slowly in float64."""
    height, width = kernel.shape[:2]
    padded = np.pad(x.astype(np.float64), ((padding, padding), (padding, padding), (0, 0)))
    rows, columns = (padded.shape[0] - height) // stride + 1, (padded.shape[1] - width) // stride + 1
    result = np.broadcast_to(bias.astype(np.float64), (rows, columns, len(bias))).copy()
    for i in range(height):
        for j in range(width):
            taps = padded[i : i + stride * rows : stride, j : j + stride * columns : stride]
            result += taps[:rows, :columns] @ kernel[i, j].astype(np.float64)
    return result
