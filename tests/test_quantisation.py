"""Quantisers stay within half a step, and canonical axis order keeps the ellipsoid."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from csplat.encoder import quantisation
from csplat.encoder.quantisation import canonicalise_shape


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


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """[n, 3, 3] from [n, 4] and [n, 3], in float64."""
    w, x, y, z = (quats.astype(np.float64) / np.linalg.norm(quats.astype(np.float64), axis=1)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = np.moveaxis(np.array(rows), 2, 0)
    return np.einsum("nij,nj,nkj->nik", rotation, np.exp(2 * scales.astype(np.float64)), rotation)


def random_shapes(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1)[:, None]
    return quats.astype(np.float32), rng.normal(0, 2, (count, 3)).astype(np.float32)


def test_keeps_the_covariance():
    quats, scales = random_shapes(5000, 0)
    rotation, ordered = canonicalise_shape(quats, scales)
    before, after = covariances(quats, scales), covariances(rotation.T, ordered.T)
    size = np.linalg.norm(before, axis=(1, 2))
    assert float((np.linalg.norm(after - before, axis=(1, 2)) / size).max()) < 1e-5


def test_sorts_the_scales_and_makes_w_largest():
    quats, scales = random_shapes(5000, 1)
    rotation, ordered = canonicalise_shape(quats, scales)
    assert (np.diff(ordered, axis=0) <= 0).all()
    assert (rotation[0] >= np.abs(rotation).max(axis=0)).all()
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=0), 1.0, atol=1e-6)
    np.testing.assert_array_equal(np.sort(scales, axis=1)[:, ::-1], ordered.T)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("sign", [1, -1])
def test_descriptions_of_one_ellipsoid_become_one(order, sign):
    quats, scales = random_shapes(64, 2)
    axes = np.eye(3)[list(order)].T
    if np.linalg.det(axes) < 0:
        axes = -axes
    turn = quaternion_of(axes)
    again = np.stack([product(quat, turn) for quat in quats.astype(np.float64)]) * sign
    first = canonicalise_shape(quats, scales)
    second = canonicalise_shape(again.astype(np.float32), scales[:, list(order)])
    np.testing.assert_allclose(second[0], first[0], atol=2e-6)
    np.testing.assert_array_equal(second[1], first[1])


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    symmetric = np.zeros((4, 4))
    r = rotation
    symmetric[0] = [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    symmetric[1, 1:] = [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]]
    symmetric[2, 2:] = [r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]]
    symmetric[3, 3] = r[2, 2] - r[0, 0] - r[1, 1]
    full = np.triu(symmetric) + np.triu(symmetric, 1).T
    return np.linalg.eigh(full)[1][:, -1]


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])
