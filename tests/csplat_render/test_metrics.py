# SPDX-License-Identifier: Apache-2.0
"""Metrics of images: PSNR, SSIM and LPIPS with their kernels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from csplat.errors import InputError
from csplat.types import PSNR_CAP
from csplat_render.metrics import Scores, psnr, score_view, ssim


def two_images(seed=0, height=30, width=41, noise=0.1):
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3), np.float32)
    return a, np.clip(a + noise * rng.standard_normal(a.shape), 0.0, 1.0).astype(np.float32)


def slow_ssim(a, b):
    """Compute SSIM pixel by pixel with the full 11×11 window, and zeros beyond the border."""
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


def test_psnr_is_that_of_clipped_images_and_has_a_largest_value():
    flat = np.full((4, 5, 3), 0.5, np.float64)
    a, b = two_images()
    assert math.isclose(20.0, psnr(flat, flat + 0.1))
    assert PSNR_CAP == psnr(a, a) == psnr(a, a + np.float32(1e-9))
    assert psnr(a, b) == psnr(a, np.where(b == 1.0, 7.0, b))


def test_ssim_agrees_with_explicit_sums():
    for height, width in ((14, 17), (3, 2)):  # larger and smaller than the window
        a, b = two_images(height=height, width=width)
        assert math.isclose(slow_ssim(a, b), ssim(a, b), rel_tol=1e-12)


def test_errors_are_pooled_by_pixels_and_a_mean_psnr_is_reported():
    zero = np.zeros((4, 4, 3))
    scores = Scores.of([score_view(zero, zero + 0.1), score_view(zero, zero + 0.01), score_view(zero[:1], zero[:1])])
    pooled = -10.0 * math.log10((0.01 * 16 + 0.0001 * 16) / 36)
    found = [*(one.psnr for one in scores.each), scores.psnr_mean, scores.psnr, scores.psnr_worst]
    assert np.allclose([20.0, 40.0, PSNR_CAP, (60 + PSNR_CAP) / 3, pooled, 20.0], found)
    assert (0, 3) == (scores.worst_view, scores.as_json()["views"])
    assert (None, None, None) == (scores.cover, scores.psnr_covered, scores.lpips)


def test_psnr_of_covered_pixels_excludes_the_background():
    reference, image = np.ones((10, 10, 3)), np.ones((10, 10, 3))
    reference[:5], image[:5] = 0.5, 0.6
    scores = Scores.of([score_view(reference, image, np.arange(100).reshape(10, 10) < 50)])
    found = scores.cover, scores.psnr_covered, scores.psnr
    assert np.allclose([0.5, 20.0, 20.0 + 10.0 * math.log10(2.0)], found)
    assert {"psnr", "psnr_mean", "psnr_worst", "ssim", "cover"} <= scores.as_json().keys()


def test_incomparable_images_are_refused():
    a, b = two_images()
    for reference, image in ((a, b[1:]), (a[..., 0], b[..., 0]), ((a * 255).astype(np.uint8), b), (a * np.nan, b)):
        with pytest.raises(InputError):
            psnr(reference, image)
    with pytest.raises(InputError, match="found no images"):
        Scores.of([])
    with pytest.raises(InputError, match="cover"):
        score_view(a, b, np.zeros((2, 2), bool))
