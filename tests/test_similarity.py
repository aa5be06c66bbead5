"""The kernels of SSIM, against their NumPy twin."""

import numpy as np
import pytest

pytest.importorskip("numba", reason="the kernels want the extra [render]")

from csplat_render.metric_kernels import RADIUS, WINDOW, blur_across, blur_down, blur_twin, mean_ssim, mean_ssim_twin


def pictures(height, width, dtype=np.float64):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3))
    return x.astype(dtype), np.clip(x + 0.2 * rng.standard_normal(x.shape), 0.0, 1.0).astype(dtype)


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (11, 11), (37, 21), (120, 160)])
def test_the_mean_equals_its_twin(size):
    x, y = pictures(*size)
    assert mean_ssim(x, y) == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)


def test_flat_and_equal_pictures():
    x, y = np.full((30, 20, 3), 0.5), np.full((30, 20, 3), 0.7)
    assert mean_ssim(x, x) == pytest.approx(1.0, abs=1e-12)
    assert mean_ssim(x, y) == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)
    assert mean_ssim(0.0 * x, 0.0 * x) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_both_passes_make_the_window(dtype):
    x, _ = pictures(24, 17, dtype)
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


def test_the_number_of_threads_changes_nothing():
    from csplat_render.kernels import thread_count

    x, y = pictures(61, 80)
    found = []
    for threads in (1, 2):
        with thread_count(threads):
            found.append(mean_ssim(x, y))
    assert found[0] == found[1]
