"""Tests of csplat_render.metric_kernels."""

import numpy as np
import pytest

from csplat_render import metric_kernels as metric
from csplat_render.kernels import thread_count

pytest.importorskip("numba", reason="SSIM requires the extra [render]")


def noise_pair(height, width, dtype=np.float64):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3))
    return x.astype(dtype), np.clip(x + 0.2 * rng.standard_normal(x.shape), 0.0, 1.0).astype(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-6), (np.float64, 1e-14)])
def test_both_passes_of_the_blur_equal_the_window(dtype, tolerance):
    x, _ = noise_pair(24, 17, dtype)
    flat, taps = x.reshape(24, 51), metric.WINDOW[metric.RADIUS :].astype(dtype)
    across, found = np.zeros((24 + 2 * metric.RADIUS, 51), dtype), np.empty_like(flat)
    for r in range(24):
        metric.blur_across(np.pad(flat[r], 3 * metric.RADIUS), taps, across[r + metric.RADIUS])
    for r in range(24):
        metric.blur_down(across, r, taps, found[r])
    np.testing.assert_allclose(found.reshape(x.shape), metric.blur_twin(x.astype(np.float64)), atol=tolerance)


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
    one, two = in_threads(lambda: metric.mean_ssim(x, y))
    assert one == two == pytest.approx(metric.mean_ssim_twin(x, y), rel=1e-12)
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
    ((4, 7, 1), (4, 7, 1, 1), 1, 0),
])  # fmt: skip
def test_the_convolution_and_its_twin_equal_explicit_sums(picture, kernel, stride, padding):
    x, weights, bias = convolution_case(picture, kernel)
    found, again = in_threads(lambda: metric.convolve(x, weights, bias, stride, padding))
    padded = np.pad(x.astype(np.float64), ((padding, padding), (padding, padding), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel[:2], axis=(0, 1))[::stride, ::stride]
    wanted = np.einsum("rcihw,hwio->rco", windows, weights.astype(np.float64)) + bias
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, again)
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    np.testing.assert_allclose(metric.convolve_twin(x, weights, bias, stride, padding), wanted, atol=1e-12)
