# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.losses."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from csplat_render import kernels
from csplat_render.metric_kernels import convolve
from csplat_render.metrics import ssim
from csplat_trainer.losses import LOSS_WEIGHTS, PhotometricLoss, photometric_loss_twin


def random_images(height, width):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3), dtype=np.float32)
    return x, np.clip(x + 0.2 * rng.standard_normal((height, width, 3)), 0, 1).astype(np.float32)


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (37, 21), (64, 48)])
@pytest.mark.parametrize("weights", LOSS_WEIGHTS.values(), ids=LOSS_WEIGHTS.keys())
def test_the_loss_equals_its_twin(size, weights):
    x, y = random_images(*size)
    value, gradient = PhotometricLoss(*size, *weights)(x, y)
    expected, slope = photometric_loss_twin(x, y, *weights)
    assert value.loss == pytest.approx(expected.loss, rel=1e-5)
    assert value.mse == pytest.approx(expected.mse, rel=1e-5)
    assert np.abs(gradient - slope).max() <= 1e-5 * np.abs(slope).max()


def test_the_gradient_of_the_twin_agrees_with_finite_differences():
    x, y = (picture.astype(np.float64) for picture in random_images(13, 9))
    _, slope = photometric_loss_twin(x, y)
    direction = np.random.default_rng(1).standard_normal(x.shape)
    up, down = (photometric_loss_twin(x + step * direction, y)[0].loss for step in (1e-6, -1e-6))
    assert (slope * direction).sum() == pytest.approx((up - down) / 2e-6, rel=1e-6)


def test_a_loss_has_the_ssim_of_the_metric_whatever_was_called_before():
    (x, y), loss = random_images(40, 30), PhotometricLoss(40, 30)
    value, first = loss(x, y)[0], loss(x, y)[1].copy()
    assert value.ssim == pytest.approx(ssim(y, x), abs=1e-5)
    loss(y, x)
    assert np.array_equal(first, loss(x, y)[1])


@pytest.mark.parametrize("weights", LOSS_WEIGHTS.values(), ids=LOSS_WEIGHTS.keys())
def test_masked_pixels_do_not_change_the_loss(weights):
    x, y = random_images(32, 24)
    mask = np.ones((32, 24), bool)
    mask[5:20, 3:12] = False
    other = np.where(mask[..., None], y, 1.0 - y)
    value, gradient = PhotometricLoss(32, 24, *weights)(x, y.copy(), mask)
    again, slope = PhotometricLoss(32, 24, *weights)(x, other, mask)
    assert again == value or np.isnan(value.ssim)
    assert np.array_equal(gradient, slope)
    assert not gradient[~mask].any()
    assert gradient[mask].all()
    assert value.mse == pytest.approx(float(np.square(x - y)[mask].mean()), rel=1e-5)


def digest():
    """Return a hash of losses, gradients, SSIM and convolutions."""
    results = hashlib.sha256()
    for size in ((150, 21), (64, 48)):
        x, y = random_images(*size)
        for weights in LOSS_WEIGHTS.values():
            value, gradient = PhotometricLoss(*size, *weights)(x, y)
            results.update(np.array([value.l1, value.ssim, value.mse]).tobytes() + gradient.tobytes())
        weights = np.random.default_rng(0).standard_normal((5, 5, 3, 70)).astype(np.float32)
        results.update(convolve(x, weights, weights[0, 0, 0], 2, 1).tobytes() + np.array(ssim(x, y)).tobytes())
    return results.hexdigest()


@pytest.mark.slow
def test_results_have_the_same_bits_with_any_threads_and_instructions(monkeypatch):
    monkeypatch.setattr(kernels, "available_threads", lambda: 8)
    found = set()
    for threads in (1, 2, 8):
        with kernels.thread_count(threads):
            found.add(digest())
    for name in kernels.INSTRUCTION_SETS:
        environment = {**os.environ, kernels.SET_VARIABLE: name}
        run = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True, check=False)
        if "InputError" not in run.stderr:  # the processor has these instructions
            found.add(run.stdout.strip())
    assert {digest()} == found


if __name__ == "__main__":
    print(digest())
