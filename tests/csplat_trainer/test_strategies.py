"""Tests of csplat_trainer.strategies."""

from __future__ import annotations

import numpy as np
import pytest

from csplat_trainer.parameters import GROUPS, Parameters, from_model
from csplat_trainer.strategies import (
    ScreenGradients,
    add_noise,
    densify,
    grow,
    reset_opacities,
    share_opacity,
)

pytest.importorskip("numba", reason="requires the extra [render]")


@pytest.fixture
def parameters(make_model):
    return Parameters.starting_at(from_model(make_model(40, 2), 2))


@pytest.mark.parametrize("count", [2, 3, 10, 51])
@pytest.mark.parametrize("alpha", [0.05, 0.5, 0.9])
def test_shared_splats_cover_as_one(alpha, count):
    # n equal splats have the coverage of one splat along a line through their centre, by the integral.
    shared, factor = share_opacity(np.array([alpha]), np.array([count]))
    x = np.linspace(-12, 12, 20_001)
    one = alpha * np.exp(-(x**2) / 2)
    many = 1 - (1 - shared * np.exp(-(x**2) / (2 * factor**2))) ** count
    assert many.sum() == pytest.approx(one.sum(), rel=1e-6)
    assert many.max() == pytest.approx(alpha, rel=1e-9)


def test_growth_stops_at_the_cap(parameters):
    rng = np.random.default_rng(0)
    assert 2 == grow(parameters, 1.05, 1000, 0.005, rng)
    assert 3 == grow(parameters, 2.0, 45, 0.005, rng)
    assert 0 == grow(parameters, 2.0, 45, 0.005, rng)
    assert {45} == {len(part[name]) for part in (parameters.values, parameters.first) for name in GROUPS}


def test_noise_only_moves_transparent_splats(parameters):
    parameters.values["logits"][:20] = 3.0
    parameters.values["logits"][20:] = -8.0
    before = parameters.values["means"].copy()
    add_noise(parameters, 1.0, np.random.default_rng(0).standard_normal(before.shape).astype(np.float32))
    moved = (before != parameters.values["means"]).any(axis=1)
    assert not moved[:20].any()
    assert moved[20:].all()


def test_densification_clones_small_splits_large_and_prunes(parameters):
    parameters.values["logits"][:] = 1.0
    parameters.values["logits"][5] = -9.0
    parameters.values["scales"][:] = np.log(1e-3)
    parameters.values["scales"][1] = np.log(0.5)
    screen = ScreenGradients.none(40)
    screen.add(np.where(np.arange(40) < 2, 1.0, 0.0).astype(np.float32), np.ones(40, bool))
    first, second = parameters.values["means"][:2].copy()
    assert 1 == densify(parameters, screen, 1.0, 1e-3, 100, 0.005, np.random.default_rng(0))
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
    screen = ScreenGradients.none(40)
    screen.add(np.ones(40, np.float32), np.ones(40, bool))
    means = parameters.values["means"].copy()
    assert 40 == densify(parameters, screen, 1.0, 1e-3, 100, 0.005, np.random.default_rng(0))
    moved = parameters.values["means"] - np.concatenate([means, means])
    assert np.abs(moved @ direction).mean() > 0.1
    np.testing.assert_allclose(moved, np.outer(moved @ direction, direction), atol=1e-4)


def test_densification_stops_at_the_cap(parameters):
    parameters.values["logits"][:] = 1.0
    screen = ScreenGradients.none(40)
    screen.add(np.ones(40, np.float32), np.ones(40, bool))
    densify(parameters, screen, 1.0, 1e-3, 50, 0.005, np.random.default_rng(0))
    assert 50 == len(parameters)
    parameters.values["logits"][0] = -9.0
    reset_opacities(parameters)
    np.testing.assert_allclose(0.01, parameters.alphas[1:], rtol=1e-3)
    assert np.float32(-9.0) == parameters.values["logits"][0]
