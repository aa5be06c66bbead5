# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.parameters."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from csplat_render import kernels
from csplat_render.camera import intrinsics, orbit
from csplat_render.pruning_error import measure_pruning_error
from csplat_trainer.parameters import GROUPS, Parameters, adam_step, from_model, sigmoid, to_model
from csplat_trainer.strategies import prune_least_needed, relocate


@pytest.fixture
def parameters(make_model):
    return Parameters.starting_at(from_model(make_model(40, 2), 2))


@pytest.mark.parametrize("beta2", [0.999, 0.98])
def test_adam_agrees_with_the_textbook(parameters, beta2):
    parameters.beta2 = beta2
    rng = np.random.default_rng(0)
    x = parameters.values["means"].astype(np.float64)
    m, v = np.zeros_like(x), np.zeros_like(x)
    for step in (1, 2, 3):
        gradient = {name: rng.standard_normal(parameters.values[name].shape).astype(np.float32) for name in GROUPS}
        g = gradient["means"].astype(np.float64)
        m, v = 0.9 * m + 0.1 * g, beta2 * v + (1 - beta2) * g * g
        x -= 0.01 * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - beta2**step)) + 1e-15)
        adam_step(parameters, gradient, dict.fromkeys(GROUPS, 0.01))
    assert np.abs(parameters.values["means"] - x).max() <= 1e-6
    assert np.abs(np.linalg.norm(parameters.values["quats"], axis=1) - 1).max() <= 1e-6


def test_a_step_survives_extremes(make_model):
    values = from_model(make_model(37, 1), 1)  # not a multiple of the vectors' lanes
    parameters = Parameters.starting_at(values)
    gradient = {name: np.full_like(array, 1e-25) for name, array in values.items()}  # squares are denormal
    gradient["means"][3] = np.nan
    values["quats"][:2] = [[0.0, 1e-13, 0.0, 0.0], [np.nan, 1.0, 0.0, 0.0]]
    values["quats"][2] = [0.0, 3.0, 0.0, 4.0]
    values["logits"][:3] = [50.0, -50.0, np.nan]
    before = values["means"].copy()
    adam_step(parameters, gradient, dict.fromkeys(GROUPS, 0.0) | {"means": 0.1})
    assert np.array_equal(before, values["means"])  # moments of NaN, and tiny moments, are 0
    assert not parameters.second["means"].any()
    assert np.array_equal([[1, 0, 0, 0]] * 2, values["quats"][:2])
    assert np.allclose([0.0, 0.6, 0.0, 0.8], values["quats"][2])
    assert np.array_equal([14.0, -14.0, np.nan], values["logits"][:3], equal_nan=True)


def test_steps_do_not_depend_on_the_number_of_threads(make_model, monkeypatch):
    monkeypatch.setattr(kernels, "available_threads", lambda: 8)
    results, model = [], make_model(9_000, 3)
    for threads in (1, 2, 8):
        parameters, rng = Parameters.starting_at(from_model(model, 3)), np.random.default_rng(0)
        with kernels.thread_count(threads):
            for _ in range(2):
                steps = {name: rng.standard_normal(array.shape).astype(np.float32)
                         for name, array in parameters.values.items()}  # fmt: skip
                adam_step(parameters, steps, dict.fromkeys(GROUPS, 0.01))
            results.append([array.tobytes() for array in (*parameters.values.values(), parameters.alphas)])
    assert results[0] == results[1] == results[2]


def test_opacities_are_sigmoids_rounded_once():
    logits = np.concatenate([np.linspace(-20, 20, 1003), [-800.0, -90.0, 0.0, 800.0, np.nan]]).astype(np.float32)
    with np.errstate(over="ignore"):
        expected = (1.0 / (1.0 + np.exp(-logits.astype(np.float64)))).astype(np.float32)
    assert np.array_equal(expected, sigmoid(logits), equal_nan=True)


def test_parameters_of_a_model_convert_back(make_model):
    model = make_model(20, 1)
    again = to_model(from_model(model, 3))
    assert again.sh_degree == 3
    assert np.array_equal(model.means, again.means)
    assert np.allclose(model.opacities, again.opacities, atol=1e-6)
    assert np.array_equal(model.shN, again.shN[:, :3])


def test_transparent_splats_are_relocated_to_others(parameters):
    parameters.values["logits"][:] = -9.0
    assert 0 == relocate(parameters, 0.005, np.random.default_rng(0))
    parameters.values["logits"][10:] = 2.0
    adam_step(parameters, {name: np.ones_like(parameters.values[name]) for name in GROUPS}, dict.fromkeys(GROUPS, 0.0))
    assert 10 == relocate(parameters, 0.005, np.random.default_rng(0))
    alive = {tuple(row) for row in parameters.values["means"][10:].tolist()}
    assert all(tuple(row) in alive for row in parameters.values["means"][:10].tolist())
    assert (parameters.first["means"][:10] == 0).all()
    assert parameters.alphas.min() > 0.005


def test_splats_with_the_least_effect_are_pruned(make_model):
    cameras = orbit((0, 0, 0), 6.0, (0, 0, 1), 6, intrinsics(40, 40, 50.0), 40, 40)
    values = from_model(make_model(40, 1, seed=3, scales=np.full((40, 3), -1.2, np.float32)), 1)
    values["logits"][5:15] = -7.0
    parameters = Parameters.starting_at(values)
    parameters.second["means"][:] = np.arange(40, dtype=np.float32)[:, None]
    measure = partial(measure_pruning_error, background=np.ones(3, np.float32))
    prune_least_needed(parameters, cameras, lambda seen: measure(to_model(parameters.values), seen), 30)
    assert [*range(5), *range(15, 40)] == parameters.second["means"][:, 0].tolist()
