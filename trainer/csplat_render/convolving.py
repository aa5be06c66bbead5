"""The convolution of LPIPS: numba where NumPy would ask BLAS, whose threads spin while they wait.

Measured where other programs wanted the same two cores: 5 s for two pictures of 640×480 by BLAS on
two threads, most of it spent waiting for a thread that another program kept from its core.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.types import F32
from csplat_render.jit import parallel_kernel, thread_count

_PIXELS = 4  # of a row, whose sums are made together
_TAPS = 4  # products that are added to a sum at a time


def convolve(x: F32, kernel: F32, bias: F32, stride: int, padding: int) -> F32:
    """Convolve a picture with zeros around it.

    Args:
        x: [h, w, in].
        kernel: [height, width, in, out].
        bias: [out].
        stride: pixels from one place to the next, both ways.
        padding: zeros on each side.

    Returns:
        [rows, columns, out].
    """
    height, width, inputs, outputs = kernel.shape
    rows, columns = ((size + 2 * padding - k) // stride + 1 for size, k in zip(x.shape, (height, width), strict=False))
    # A row of the kernel lies in one piece in a row of the picture. Zeros fill it up to a multiple of
    # the taps, and there are places beyond the last column up to a multiple of the pixels.
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
    """Sums of four pixels at a time; parallel over rows, vectorised over the outputs.

    Args:
        x: [h, values] float32, rows of pixels.
        weights: [height, taps, out] float32.
        bias: [out] float32.
        down: rows of `x` from one row of the result to the next.
        across: values of a row of `x` from one pixel of the result to the next.
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
    """The slow twin of `convolve`: float64, one product of the sum after the other."""
    height, width = kernel.shape[:2]
    padded = np.pad(x.astype(np.float64), ((padding, padding), (padding, padding), (0, 0)))
    rows, columns = (padded.shape[0] - height) // stride + 1, (padded.shape[1] - width) // stride + 1
    result = np.broadcast_to(bias.astype(np.float64), (rows, columns, len(bias))).copy()
    for i in range(height):
        for j in range(width):
            taps = padded[i : i + stride * rows : stride, j : j + stride * columns : stride]
            result += taps[:rows, :columns] @ kernel[i, j].astype(np.float64)
    return result
