"""Quantisers stay within half a step, and agree with the reconstruction of the spec."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from csplat.encoder import quantisation


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("levels", [1, 2, 63, 255, 65535])
def test_opacity_keeps_zero_and_one_and_stays_in_range(levels, square):
    alpha = np.linspace(0, 1, 1001, dtype=np.float32)
    q = quantisation.opacity_levels(alpha, levels, square=square)
    values = quantisation.opacity_values(q, levels, square=square)
    assert (0.0, 1.0) == (values[0], values[-1])
    assert ((q >= 0) & (q <= levels)).all()
    domain = np.sqrt if square else np.asarray
    assert float(np.abs(domain(values) - domain(alpha)).max()) <= 0.5 / levels + 1e-6


@pytest.mark.parametrize("levels", [3, 4, 5, 31, 127, 32767])
def test_rotations_stay_legal_and_near(levels):
    rng = np.random.default_rng(levels)
    quats = rng.standard_normal((4, 20000))
    corner = np.array([0.5, 0.5, 0.5, 0.5])[:, None] + rng.normal(0, 1e-3, (4, 2000))
    quats = np.concatenate([quats, corner], axis=1)
    quats /= np.linalg.norm(quats, axis=0)
    order = np.argsort(-np.abs(quats), axis=0)
    quats = np.take_along_axis(quats, order, axis=0)
    quats[0] = np.abs(quats[0])
    q = quantisation.quat_levels(quats.astype(np.float32), levels)
    assert np.abs(q).max() <= levels
    assert int((q.astype(np.int64) ** 2).sum(axis=0).max()) <= 2 * levels * levels
    values = quantisation.quat_values(q, levels)
    np.testing.assert_allclose(np.linalg.norm(values, axis=0), 1.0, atol=1e-6)
    assert float(np.abs(values[1:] - quats[1:]).max()) <= 1.0 / levels


@pytest.mark.parametrize("shift", [0, 1, 2, 5])
@pytest.mark.parametrize("scale", [1.0, 100.0, 2.0**25])
def test_colours_stay_within_a_step_and_a_chroma_step(shift, scale):
    rgb = np.random.default_rng(shift).normal(0, scale, (3, 5000))
    columns = quantisation.colour_integers(rgb if scale > 1e6 else rgb.astype(np.float32), shift)
    error = np.abs(quantisation.colour_lifted(columns, shift) - rgb)
    assert float(error.max()) <= 1.5 + 0.75 * 2**shift


@pytest.mark.slow
@given(st.integers(-(2**20), 2**20), st.integers(-(2**20), 2**20), st.integers(-(2**20), 2**20))
def test_integers_come_back_within_one_step_without_a_shift(r, g, b):
    rgb = np.array([[r], [g], [b]], np.float64)
    columns = quantisation.colour_integers(rgb, 0)
    assert float(np.abs(quantisation.colour_lifted(columns, 0) - rgb).max()) <= 1


def test_coarse_colours_are_multiples_on_the_same_lattice():
    rgb = np.random.default_rng(0).normal(0, 50, (3, 1000)).astype(np.float32)
    coarse = np.arange(1000, dtype=np.int32) % 5
    columns = quantisation.colour_integers(rgb, 1, coarse)
    assert (columns % (1 << coarse) == 0).all()


@pytest.mark.parametrize("largest", [0.0, 1.0, 1e6, 1e20, 3e38])
def test_lattice_exponents_keep_integers_within_what_the_format_holds(largest):
    exponent = quantisation.lattice_exponent(largest, 1e-3)
    assert largest / quantisation.lattice_step(1e-3, exponent) <= 2**21
    assert exponent == 0 or largest / quantisation.lattice_step(1e-3, exponent - 2) >= 2**20


def test_means_at_the_end_of_float32_do_not_become_infinite():
    top = np.finfo(np.float32).max
    means = np.array([[top, -top], [0, 1], [1e30, 0]], np.float32)
    n = quantisation.quantise_means(means, 1.7e36)
    assert np.isfinite(quantisation.lattice_values(n, 1.7e36)).all()
