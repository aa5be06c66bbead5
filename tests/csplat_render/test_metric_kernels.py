# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.metric_kernels."""

import numpy as np
import pytest

from csplat_render import kernels
from csplat_render import metric_kernels as metric
from csplat_render.kernels import thread_count


def noise_pair(height, width):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3))
    return x, np.clip(x + 0.2 * rng.standard_normal(x.shape), 0.0, 1.0)


@pytest.fixture
def in_threads(monkeypatch):
    """A function that returns the results of a call in 1, 2 and 8 threads."""
    monkeypatch.setattr(kernels, "available_threads", lambda: 8)

    def results(make):
        found = []
        for threads in (1, 2, 8):
            with thread_count(threads):
                found.append(make())
        return found

    return results


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (11, 11), (37, 21), (150, 33)])
def test_mean_ssim_equals_its_twin_in_any_number_of_threads(size, in_threads):
    x, y = noise_pair(*size)
    one, two, eight = in_threads(lambda: metric.mean_ssim(x, y))
    assert one == two == eight == pytest.approx(metric.mean_ssim_twin(x, y), rel=1e-12)
    for flat in (x, 0.0 * x):
        assert metric.mean_ssim(flat, flat) == pytest.approx(1.0, abs=1e-12)
    x, y = np.full_like(x, 0.5), np.full_like(x, 0.7)
    assert metric.mean_ssim(x, y) == pytest.approx(metric.mean_ssim_twin(x, y), rel=1e-12)


def convolution_case(picture, kernel):
    rng = np.random.default_rng(0)
    weights = rng.standard_normal(kernel) / np.sqrt(np.prod(kernel[:3]))
    arrays = (rng.standard_normal(picture), weights, rng.standard_normal(kernel[3]))
    return (array.astype(np.float32) for array in arrays)


@pytest.mark.long
@pytest.mark.parametrize(("picture", "kernel", "stride", "padding"), [  # kernel: height, width, in, out
    ((13, 11, 3), (5, 3, 3, 4), 1, 2),
    ((13, 11, 3), (5, 3, 3, 4), 4, 2),
    ((13, 11, 3), (5, 3, 3, 4), 2, 0),
    ((31, 31, 3), (11, 11, 3, 64), 4, 2),
    ((9, 14, 64), (5, 5, 64, 192), 1, 2),
    ((3, 3, 8), (3, 3, 8, 16), 1, 1),
    ((1, 1, 8), (3, 3, 8, 16), 1, 1),
    ((4, 40, 8), (3, 3, 8, 33), 1, 1),
    ((4, 7, 1), (4, 7, 1, 1), 1, 0),
])  # fmt: skip
def test_the_convolution_and_its_twin_equal_explicit_sums(picture, kernel, stride, padding, in_threads):
    x, weights, bias = convolution_case(picture, kernel)
    found, *others = in_threads(lambda: metric.convolve(x, weights, bias, stride, padding))
    padded = np.pad(x.astype(np.float64), ((padding, padding), (padding, padding), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel[:2], axis=(0, 1))[::stride, ::stride]
    wanted = np.einsum("rcihw,hwio->rco", windows, weights.astype(np.float64)) + bias
    assert found.dtype == np.float32
    assert all(np.array_equal(found, other) for other in others)
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    np.testing.assert_allclose(metric.convolve_twin(x, weights, bias, stride, padding), wanted, atol=1e-12)
