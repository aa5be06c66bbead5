"""Tests of csplat_render.metric_kernels."""

from __future__ import annotations

import numpy as np
import pytest

from csplat_render.kernels import thread_count
from csplat_render.metric_kernels import (
    RADIUS,
    WINDOW,
    blur_across,
    blur_down,
    blur_twin,
    convolve,
    convolve_twin,
    mean_ssim,
    mean_ssim_twin,
)

pytest.importorskip("numba", reason="SSIM requires the extra [render]")


def noise_pair(height, width, dtype=np.float64):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3))
    return x.astype(dtype), np.clip(x + 0.2 * rng.standard_normal(x.shape), 0.0, 1.0).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_both_passes_of_the_blur_equal_the_window(dtype):
    x, _ = noise_pair(24, 17, dtype)
    flat = x.reshape(24, 51)
    taps = WINDOW[RADIUS:].astype(dtype)
    across = np.zeros((24 + 2 * RADIUS, 51), dtype)
    for r in range(24):
        blur_across(np.pad(flat[r], 3 * RADIUS), taps, across[r + RADIUS])
    found = np.empty_like(flat)
    for r in range(24):
        blur_down(across, r, taps, found[r])
    tolerance = 1e-6 if dtype == np.float32 else 1e-14
    np.testing.assert_allclose(found.reshape(x.shape), blur_twin(x.astype(np.float64)), atol=tolerance)


def in_threads(make):
    """Return the results of a call in one thread and in two."""
    found = []
    for threads in (1, 2):
        with thread_count(threads):
            found.append(make())
    return found


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (11, 11), (37, 21), (61, 80)])
def test_mean_ssim_equals_its_twin_in_any_number_of_threads(size):
    x, y = noise_pair(*size)
    one, two = in_threads(lambda: mean_ssim(x, y))
    assert one == two == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)
    for flat in (x, 0.0 * x):
        assert mean_ssim(flat, flat) == pytest.approx(1.0, abs=1e-12)
    x, y = np.full_like(x, 0.5), np.full_like(x, 0.7)
    assert mean_ssim(x, y) == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)


SHAPES_AND_STRIDES = [
    # image, kernel (height, width, in, out), stride, padding
    ((13, 11, 3), (5, 3, 3, 4), 1, 2),
    ((13, 11, 3), (5, 3, 3, 4), 4, 2),
    ((13, 11, 3), (5, 3, 3, 4), 2, 0),
    ((31, 31, 3), (11, 11, 3, 64), 4, 2),
    ((9, 14, 64), (5, 5, 64, 192), 1, 2),
    ((3, 3, 8), (3, 3, 8, 16), 1, 1),
    ((1, 1, 8), (3, 3, 8, 16), 1, 1),
    ((4, 7, 1), (4, 7, 1, 1), 1, 0),
]


def convolution_case(picture, kernel, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.standard_normal(kernel) / np.sqrt(np.prod(kernel[:3]))
    arrays = (rng.standard_normal(picture), weights, rng.standard_normal(kernel[3]))
    return (array.astype(np.float32) for array in arrays)


@pytest.mark.long
@pytest.mark.parametrize(("picture", "kernel", "stride", "padding"), SHAPES_AND_STRIDES)
def test_the_convolution_equals_its_twin(picture, kernel, stride, padding):
    x, weights, bias = convolution_case(picture, kernel)
    found, again = in_threads(lambda: convolve(x, weights, bias, stride, padding))
    wanted = convolve_twin(x, weights, bias, stride, padding)
    assert found.dtype == np.float32
    assert wanted.shape == found.shape
    np.testing.assert_array_equal(found, again)
    np.testing.assert_allclose(found, wanted, atol=2e-5)


@pytest.mark.long
@pytest.mark.parametrize(("stride", "padding"), [(1, 2), (4, 2), (2, 0)])
def test_the_twin_agrees_with_explicit_sums(stride, padding):
    x, kernel, bias = convolution_case((13, 11, 3), (5, 3, 3, 4))
    padded = np.pad(x, ((padding, padding), (padding, padding), (0, 0))).astype(np.float64)
    rows, columns = (padded.shape[0] - 5) // stride + 1, (padded.shape[1] - 3) // stride + 1
    windows = [[padded[r * stride :][:5, c * stride :][:, :3] for c in range(columns)] for r in range(rows)]
    expected = np.einsum("rchwi,hwio->rco", np.array(windows), kernel.astype(np.float64))
    np.testing.assert_allclose(convolve_twin(x, kernel, bias, stride, padding), expected + bias, atol=1e-12)
