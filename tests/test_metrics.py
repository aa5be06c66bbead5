"""Metrics of images: PSNR, SSIM with its kernels, FLIP."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest

pytest.importorskip("numba", reason="SSIM wants the extra [render]")

from csplat.errors import InputError
from csplat_render.metric_kernels import RADIUS, WINDOW, blur_across, blur_down, blur_twin, mean_ssim, mean_ssim_twin
from csplat_render.metrics import PSNR_CAP, Scores, flip, psnr, score_view, ssim


def pictures(seed=0, height=30, width=41, noise=0.1):
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3), np.float32)
    return a, np.clip(a + noise * rng.standard_normal(a.shape), 0.0, 1.0).astype(np.float32)


def slow_ssim(a, b):
    """Pixel by pixel: the full 11×11 window, zeros beyond the border."""
    g = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    window = np.outer(g, g) / np.outer(g, g).sum()
    values = []
    for c in range(3):
        x, y = (np.pad(p[..., c].astype(np.float64), 5) for p in (a, b))
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                pp, qq, pq = ((window * s).sum() for s in (p * p, q * q, p * q))
                up = (2 * mp * mq + 0.01**2) * (2 * (pq - mp * mq) + 0.03**2)
                values.append(up / ((mp**2 + mq**2 + 0.01**2) * (pp - mp**2 + qq - mq**2 + 0.03**2)))
    return np.mean(values)


def test_psnr_of_a_known_error():
    a = np.full((4, 5, 3), 0.5, np.float64)
    assert math.isclose(20.0, psnr(a, a + 0.1))


def test_equal_pictures_score_the_cap():
    a, _ = pictures()
    assert PSNR_CAP == psnr(a, a)
    assert PSNR_CAP == psnr(a, a + np.float32(1e-9))
    assert math.isclose(1.0, ssim(a, a))


def test_pictures_are_clipped_first():
    a, b = pictures()
    over = np.where(b == 1.0, 7.0, b)
    assert psnr(a, b) == psnr(a, over)


def test_ssim_is_the_sum_over_the_window_written_out():
    a, b = pictures(height=14, width=17)
    assert math.isclose(slow_ssim(a, b), ssim(a, b), rel_tol=1e-12)


def test_ssim_of_a_picture_smaller_than_the_window():
    a, b = pictures(height=3, width=2)
    assert math.isclose(slow_ssim(a, b), ssim(a, b), rel_tol=1e-12)


def test_the_error_is_pooled_and_the_mean_stands_beside_it():
    zero = np.zeros((4, 4, 3))
    scores = Scores.of([score_view(zero, zero + 0.1), score_view(zero, zero + 0.01)])
    assert np.allclose([20.0, 40.0], [one.psnr for one in scores.each])
    assert math.isclose(30.0, scores.psnr_mean)
    assert math.isclose(-10.0 * math.log10((0.01 + 0.0001) / 2.0), scores.psnr)
    assert (0, 2) == (scores.worst_view, scores.as_json()["views"])
    assert math.isclose(20.0, scores.psnr_worst)
    assert scores.cover is None
    assert scores.psnr_covered is None
    assert scores.lpips is None


def test_views_of_different_sizes_weigh_by_their_pixels():
    wide = score_view(np.zeros((1, 3, 3)), np.full((1, 3, 3), 0.1))
    one = score_view(np.zeros((1, 1, 3)), np.zeros((1, 1, 3)))
    assert math.isclose(-10.0 * math.log10(0.01 * 3 / 4), Scores.of([wide, one]).psnr)


def test_an_empty_background_inflates_psnr_by_what_covered_pixels_tell():
    reference, image = np.ones((10, 10, 3)), np.ones((10, 10, 3))
    reference[:5], image[:5] = 0.5, 0.6
    covered = np.zeros((10, 10), bool)
    covered[:5] = True
    scores = Scores.of([score_view(reference, image, covered)])
    assert math.isclose(0.5, scores.cover)
    assert math.isclose(20.0, scores.psnr_covered)
    assert math.isclose(20.0 + 10.0 * math.log10(2.0), scores.psnr)
    assert {"psnr", "psnr_mean", "psnr_worst", "ssim", "cover"} <= scores.as_json().keys()


def test_refuses_what_cannot_be_compared():
    a, b = pictures()
    for reference, image in ((a, b[1:]), (a[..., 0], b[..., 0]), ((a * 255).astype(np.uint8), b), (a * np.nan, b)):
        with pytest.raises(InputError):
            psnr(reference, image)
    with pytest.raises(InputError, match="no pictures"):
        Scores.of([])
    with pytest.raises(InputError, match="cover"):
        score_view(a, b, np.zeros((2, 2), bool))


def noise_pair(height, width, dtype=np.float64):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3))
    return x.astype(dtype), np.clip(x + 0.2 * rng.standard_normal(x.shape), 0.0, 1.0).astype(dtype)


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (11, 11), (37, 21), (120, 160)])
def test_the_mean_equals_its_twin(size):
    x, y = noise_pair(*size)
    assert mean_ssim(x, y) == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)


def test_flat_and_equal_pictures():
    x, y = np.full((30, 20, 3), 0.5), np.full((30, 20, 3), 0.7)
    assert mean_ssim(x, x) == pytest.approx(1.0, abs=1e-12)
    assert mean_ssim(x, y) == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)
    assert mean_ssim(0.0 * x, 0.0 * x) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_both_passes_make_the_window(dtype):
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


def test_the_number_of_threads_changes_nothing():
    from csplat_render.kernels import thread_count

    x, y = noise_pair(61, 80)
    found = []
    for threads in (1, 2):
        with thread_count(threads):
            found.append(mean_ssim(x, y))
    assert found[0] == found[1]


def test_flip_is_zero_for_equal_pictures_and_grows():
    pytest.importorskip("flip_evaluator", reason="an optional package: pip install 'csplat[flip]'")
    a = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    assert 0.0 == flip(a, a)
    assert 0.0 < flip(a, 0.95 * a) < flip(a, 0.7 * a) <= 1.0
    assert flip(a, 0.95 * a) == flip(a.astype(np.float64), (0.95 * a).astype(np.float64))


def test_black_against_white_differs_fully():
    pytest.importorskip("flip_evaluator", reason="an optional package: pip install 'csplat[flip]'")
    black = np.zeros((30, 30, 3))
    assert flip(black, black + 1.0) > 0.9


def test_refuses_pictures_that_differ_in_shape():
    with pytest.raises(InputError, match="FLIP"):
        flip(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))


def test_an_absent_package_is_named(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(InputError, match="flip-evaluator"):
        flip(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)))
