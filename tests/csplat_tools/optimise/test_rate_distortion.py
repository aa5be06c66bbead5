# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.optimise.rate_distortion."""

import math

import numpy as np
import pytest

from csplat_tools.optimise.rate_distortion import RateLine, RatePoint, log_bytes_at_error, log_bytes_at_size

LINE = RateLine(RatePoint(40.0, 1e-4, 1000), -0.23, 0.045)


def test_a_line_predicts_error_and_bytes_of_another_precision():
    assert 50.0 == pytest.approx(LINE.quality_at_error(1e-4 * math.exp(-2.3)))
    assert 1000 * math.exp(0.45) == pytest.approx(math.exp(LINE.log_bytes_at(50.0)))
    assert 44.0 == pytest.approx(LINE.quality_at_size(1000 * math.exp(0.18)))
    assert LINE.error_at(LINE.quality_at_error(3e-5)) == pytest.approx(3e-5)


def test_slopes_are_measured_on_two_files_within_limits():
    near, far = RatePoint(40.5, 9e-5, 1010), RatePoint(44.0, 1e-4 * math.exp(-0.8), 1000 * math.exp(0.2))
    line = RateLine.through([LINE.nearest, near, far], -0.23, 0.045)
    assert (line.error_slope, line.bytes_slope) == pytest.approx((math.log(0.9) / 0.5, math.log(1.01) / 0.5 * 1.0))
    line = RateLine.through([LINE.nearest, far], -0.23, 0.045)
    assert (line.error_slope, line.bytes_slope) == pytest.approx((-0.2, 0.05))
    flat = RateLine.through([LINE.nearest, RatePoint(50.0, 1e-4, 1000)], -0.23, 0.045)
    assert (flat.error_slope, flat.bytes_slope) == pytest.approx((-0.046, 0.009))


def test_the_model_weighs_pruning_against_quantisation():
    counts, errors = np.array([1000.0, 500.0, 250.0]), np.array([0.0, 2e-5, 2e-4])
    costs = log_bytes_at_error(counts, errors, 1e-4, 0.2, 0.65)
    assert math.log(1000.0) - 0.2 * math.log(1e-4) == pytest.approx(costs[0])
    assert 1 == np.argmin(costs)  # half of the splats leave most of the error to quantisation
    assert np.isinf(costs[2])  # more than the allowed error
    costs = log_bytes_at_size(counts / 1000.0, errors, 1e-4, 0.2)
    assert 1 == np.argmin(costs)
