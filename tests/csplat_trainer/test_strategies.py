# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.strategies."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from csplat.encoder.error_bounds import rotation_rows
from csplat_render import kernels
from csplat_trainer.parameters import GROUPS, Parameters, from_model
from csplat_trainer.strategies import ScreenGradients, add_noise, densify, grow, reset_opacities, share_opacity


@pytest.fixture
def parameters(make_model):
    return Parameters.starting_at(from_model(make_model(40, 2), 2))


def densified(parameters, moved=40, cap=100):
    """Let splats with gradients, the first `moved` of them, be cloned or split; return the number of new splats."""
    screen = ScreenGradients.none(40)
    screen.add((np.arange(40) < moved).astype(np.float32), np.ones(40, bool))
    return densify(parameters, screen, 1.0, 1e-3, cap, 0.005, np.random.default_rng(0))


def test_shared_splats_cover_as_one():
    # n equal splats have the coverage of one splat along a line through their centre, by the integral.
    x = np.linspace(-12, 12, 20_001)
    for alpha, count in itertools.product((0.05, 0.5, 0.9), (2, 3, 10, 51)):
        shared, factor = share_opacity(np.array([alpha]), np.array([count]))
        many = 1 - (1 - shared * np.exp(-(x**2) / (2 * factor**2))) ** count
        assert many.sum() == pytest.approx((alpha * np.exp(-(x**2) / 2)).sum(), rel=1e-6)
        assert many.max() == pytest.approx(alpha, rel=1e-9)


def test_growth_stops_at_the_cap(parameters):
    rng = np.random.default_rng(0)
    assert [2, 3, 0] == [grow(parameters, *growth, 0.005, rng) for growth in ((1.05, 1000), (2.0, 45), (2.0, 45))]
    assert {45} == {len(part[name]) for part in (parameters.values, parameters.first) for name in GROUPS}


def test_noise_only_moves_transparent_splats(parameters):
    parameters.values["logits"][:20] = 3.0
    parameters.values["logits"][20:] = -8.0
    before = parameters.values["means"].copy()
    add_noise(parameters, 1.0, np.random.default_rng(0).standard_normal(before.shape).astype(np.float32))
    assert [False] * 20 + [True] * 20 == (before != parameters.values["means"]).any(axis=1).tolist()


def test_noise_follows_its_formula_with_any_number_of_threads(make_model, monkeypatch):
    monkeypatch.setattr(kernels, "available_threads", lambda: 8)
    values = from_model(make_model(2000, 0), 0)
    values["logits"][:] = np.random.default_rng(1).normal(-5.0, 2.0, 2000)
    values["scales"][0] = 300.0  # would overflow
    normals, found = np.random.default_rng(0).standard_normal((2000, 3)).astype(np.float32), []
    for threads in (1, 8):
        parameters = Parameters.starting_at({name: array.copy() for name, array in values.items()})
        with kernels.thread_count(threads):
            add_noise(parameters, 0.3, normals)
        found.append(parameters.values["means"])
    assert np.array_equal(*found)
    wide = {name: array.astype(np.float64) for name, array in values.items()}
    gate = 0.3 / (1.0 + np.exp(-100.0 * (1.0 - 1.0 / (1.0 + np.exp(-wide["logits"])) - 0.995)))
    deviations = np.exp(wide["scales"])
    rotations = np.moveaxis(np.array(rotation_rows(wide["quats"].T)), 2, 0)
    local = np.einsum("nji,nj->ni", rotations, normals) * np.minimum(gate[:, None] * deviations, 1.0) * deviations
    moved = (wide["logits"] < np.log(1.0 / 9.0)) & (np.arange(2000) > 0)
    expected = wide["means"] + moved[:, None] * np.einsum("nij,nj->ni", rotations, local)
    np.testing.assert_allclose(found[0], expected, rtol=1e-6, atol=1e-7)


def test_densification_clones_small_splits_large_and_prunes(parameters):
    parameters.values["logits"][:] = 1.0
    parameters.values["logits"][5] = -9.0
    parameters.values["scales"][:] = np.log(1e-3)
    parameters.values["scales"][1] = np.log(0.5)
    first, second = parameters.values["means"][:2].copy()
    assert 1 == densified(parameters, moved=2)
    means, scales = parameters.values["means"], parameters.values["scales"]
    assert np.array_equal(first, means[0])
    assert np.array_equal(first, means[-2])
    assert not np.array_equal(second, means[1])
    assert np.allclose(scales[[1, -1]], np.log(0.5 / 1.6))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_needle_is_split_along_its_axis(parameters, axis):
    w, u, along = 0.4, np.array([0.2, -0.6, np.sqrt(0.44)]), np.eye(3)[axis]
    direction = along + 2.0 * w * np.cross(u, along) + 2.0 * np.cross(u, np.cross(u, along))
    parameters.values["logits"][:] = 1.0
    parameters.values["scales"][:] = np.log(np.where(along > 0.0, 0.5, 1e-6))
    parameters.values["quats"][:] = (w, *u)
    means = parameters.values["means"].copy()
    assert 40 == densified(parameters)
    moved = parameters.values["means"] - np.concatenate([means, means])
    assert np.abs(moved @ direction).mean() > 0.1
    np.testing.assert_allclose(moved, np.outer(moved @ direction, direction), atol=1e-4)


def test_densification_stops_at_the_cap_and_opacities_are_reset(parameters):
    parameters.values["logits"][:] = 1.0
    densified(parameters, cap=50)
    assert 50 == len(parameters)
    parameters.values["logits"][0] = -9.0
    reset_opacities(parameters)
    np.testing.assert_allclose(0.01, parameters.alphas[1:], rtol=1e-3)
    assert np.float32(-9.0) == parameters.values["logits"][0]
