"""Kernels of SSIM and LPIPS.

SSIM (Wang et al. 2004) of a pixel is

    (2 μx μy + C1) (2 σxy + C2) / ((μx² + μy² + C1) (σx² + σy² + C2)),  σxy = E[x y] − μx μy, likewise σx², σy²,

where μ and E are means weighted by the window, a Gaussian of 11×11 pixels and σ 1.5, with zeros beyond the border, and
C1 = 0.01², C2 = 0.03². The window is separable, so images are blurred along the rows, then across them. The trainer's
loss uses the same conventions.

The convolution of LPIPS uses numba because NumPy uses BLAS, whose threads spin while they wait: with other programs on
the same two cores, two images of 640×480 took 5 s.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.types import F32, F64
from csplat_render.kernels import parallel_kernel, relaxed_kernel, thread_count

C1, C2 = 0.01**2, 0.03**2

RADIUS = 5  #: pixels from the centre of the window to its edge

CHANNELS = 3  #: values per pixel, adjacent in a row

_SIGMA = 1.5  # pixels
_PAD = CHANNELS * RADIUS  # values of zero on either side of a row


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
    height, width = x.shape[0], CHANNELS * x.shape[1]
    across = np.zeros((5, height + 2 * RADIUS, width), np.float64)
    sums = np.empty(height, np.float64)
    with thread_count(None):
        blur_products(x.reshape(height, width), y.reshape(height, width), WINDOW[RADIUS:], across)
        _sum_ssim_of_rows(across, WINDOW[RADIUS:], sums)
    return float(sums.sum()) / x.size


@relaxed_kernel
def blur_across(row: Any, taps: Any, out: Any) -> None:
    """Blur a row that has `RADIUS` pixels of zeros on either side; vectorised over its values.

    Args:
        row: [3·W + 30].
        taps: [6], the window from its centre outwards, in the dtype of the row.
        out: [3·W], written.
    """
    w0, w1, w2, w3, w4, w5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for i in range(out.shape[0]):
        out[i] = (
            w0 * row[i + 15]
            + w1 * (row[i + 12] + row[i + 18])
            + w2 * (row[i + 9] + row[i + 21])
            + w3 * (row[i + 6] + row[i + 24])
            + w4 * (row[i + 3] + row[i + 27])
            + w5 * (row[i] + row[i + 30])
        )


@relaxed_kernel
def blur_down(field: Any, r: int, taps: Any, out: Any) -> None:
    """Blur across the rows r to r + 10 of a field; vectorised over the values of a row.

    Args:
        field: [rows, 3·W].
        r: first row of the window.
        taps: see `blur_across`.
        out: [3·W], written.
    """
    w0, w1, w2, w3, w4, w5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for i in range(out.shape[0]):
        out[i] = (
            w0 * field[r + 5, i]
            + w1 * (field[r + 4, i] + field[r + 6, i])
            + w2 * (field[r + 3, i] + field[r + 7, i])
            + w3 * (field[r + 2, i] + field[r + 8, i])
            + w4 * (field[r + 1, i] + field[r + 9, i])
            + w5 * (field[r, i] + field[r + 10, i])
        )


@parallel_kernel(relaxed=True)
def blur_products(lane: int, lanes: int, x: Any, y: Any, taps: Any, across: Any) -> None:
    """Blur x, y, x², y², xy along each row; parallel over rows, vectorised over the values of a row.

    Args:
        x, y: [H, 3·W].
        taps: [6], see `blur_across`.
        across: [5, H + 10, 3·W], rows 5 to H + 4 are written.
    """
    height, width = x.shape
    for r in range(lane, height, lanes):
        rows = np.zeros((5, width + 2 * _PAD), x.dtype)
        a, b, aa, bb, ab = rows[0], rows[1], rows[2], rows[3], rows[4]
        for i in range(width):
            u, v = x[r, i], y[r, i]
            a[i + _PAD] = u
            b[i + _PAD] = v
            aa[i + _PAD] = u * u
            bb[i + _PAD] = v * v
            ab[i + _PAD] = u * v
        for f in range(5):
            blur_across(rows[f], taps, across[f, r + RADIUS])


@parallel_kernel(relaxed=True)
def _sum_ssim_of_rows(lane: int, lanes: int, across: Any, taps: Any, sums: Any) -> None:
    """Sum SSIM over each row; parallel over rows, vectorised over the values of a row.

    Args:
        across: [5, H + 10, 3·W], from `blur_products`.
        taps: [6].
        sums: [H], written.
    """
    width = across.shape[2]
    moments = np.empty((5, width), across.dtype)
    for r in range(lane, len(sums), lanes):
        for f in range(5):
            blur_down(across[f], r, taps, moments[f])
        mean_x, mean_y, mean_xx, mean_yy, mean_xy = moments[0], moments[1], moments[2], moments[3], moments[4]
        total = 0.0
        for i in range(width):
            mx, my = mean_x[i], mean_y[i]
            xx, yy, xy = mean_xx[i] - mx * mx, mean_yy[i] - my * my, mean_xy[i] - mx * my  # σx², σy², σxy
            total += (2.0 * mx * my + C1) * (2.0 * xy + C2) / ((mx * mx + my * my + C1) * (xx + yy + C2))
        sums[r] = total


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


_PIXELS = 4  # pixels of a row computed together
_TAPS = 4  # products added to a sum at a time


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
    rows, columns = ((size + 2 * padding - k) // stride + 1 for size, k in zip(x.shape, (height, width), strict=False))
    # A row of the kernel is contiguous in a row of the image. It is padded with zeros to a multiple of `_TAPS`, and the
    # columns of the result to a multiple of `_PIXELS`.
    taps, places = -(-width * inputs // _TAPS) * _TAPS, -(-columns // _PIXELS) * _PIXELS
    values = max((x.shape[1] + 2 * padding) * inputs, (places - 1) * stride * inputs + taps)
    flat = np.zeros((x.shape[0] + 2 * padding, values), np.float32)
    flat[padding : padding + x.shape[0], padding * inputs : (padding + x.shape[1]) * inputs] = x.reshape(len(x), -1)
    weights = np.zeros((height, taps, outputs), np.float32)
    weights[:, : width * inputs] = kernel.reshape(height, width * inputs, outputs)
    result = np.empty((rows, places, outputs), np.float32)
    with thread_count(None):
        _convolve(flat, weights, bias.astype(np.float32), stride, stride * inputs, result)
    return np.ascontiguousarray(result[:, :columns])


@parallel_kernel(relaxed=True)
def _convolve(lane: int, lanes: int, x: Any, weights: Any, bias: Any, down: int, across: int, result: Any) -> None:
    """Convolve four pixels at a time; parallel over rows, vectorised over the outputs.

    Args:
        x: [h, values] float32, rows of pixels.
        weights: [height, taps, out] float32.
        bias: [out] float32.
        down: rows of `x` per row of the result.
        across: values of a row of `x` per pixel of the result.
        result: [rows, columns, out] float32, written; columns are a multiple of four.
    """
    outputs = len(bias)
    sums = np.empty(_PIXELS * outputs, np.float32)
    for r in range(lane, result.shape[0], lanes):
        for column in range(0, result.shape[1], _PIXELS):
            for p in range(_PIXELS):
                sums[p * outputs : (p + 1) * outputs] = bias
            for i in range(weights.shape[0]):
                row = x[r * down + i, column * across :]
                a, b, c, d = row, row[across:], row[2 * across :], row[3 * across :]
                for k in range(0, weights.shape[1], _TAPS):
                    w = weights[i, k : k + _TAPS].reshape(-1)
                    a0, a1, a2, a3 = a[k], a[k + 1], a[k + 2], a[k + 3]
                    b0, b1, b2, b3 = b[k], b[k + 1], b[k + 2], b[k + 3]
                    c0, c1, c2, c3 = c[k], c[k + 1], c[k + 2], c[k + 3]
                    d0, d1, d2, d3 = d[k], d[k + 1], d[k + 2], d[k + 3]
                    for o in range(outputs):
                        w0, w1, w2, w3 = w[o], w[outputs + o], w[2 * outputs + o], w[3 * outputs + o]
                        sums[o] += a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
                        sums[outputs + o] += b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3
                        sums[2 * outputs + o] += c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3
                        sums[3 * outputs + o] += d0 * w0 + d1 * w1 + d2 * w2 + d3 * w3
            for p in range(_PIXELS):
                result[r, column + p] = sums[p * outputs : (p + 1) * outputs]


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
