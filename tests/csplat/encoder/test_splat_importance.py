# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.splat_importance.

Also: csplat.encoder.quantisation_classes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checked import encoded
from codebooks_cases import exact, scene
from quantisation_cases import COUNT, important, unequal

from csplat import InputError, Target, decode_scene, encode
from csplat.context import DEFAULT_CONTEXT
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions, Importance
from csplat.encoder.coding_parameters import choose_parameters
from csplat.encoder.kmeans import refine_by_metric
from csplat.encoder.splat_importance import (
    CLASSED_ATTRIBUTES,
    ErrorMetric,
    GaussNewtonBlocks,
    apply_weight_floor,
    project_sh,
    rounding_errors,
)
from csplat.spherical_harmonics import evaluate_sh


def test_errors_agree_with_the_matrices():
    points, matrices, metric, _ = scene()
    for rows in (slice(None), np.array([5, 3, 3])):
        expected = exact(points[rows], matrices[rows], metric.weights[rows])
        np.testing.assert_allclose(expected, metric.errors(points[rows], rows), rtol=1e-5)
    expected = exact(points[:, :2], matrices[:, :2, :2], metric.weights)
    np.testing.assert_allclose(expected, metric.first(2).errors(points[:, :2], slice(None)), rtol=1e-5)


def test_entries_of_points_without_weight_do_not_move():
    points, _, metric, entries = scene(50, 2, 1, 5)
    silent = ErrorMetric(np.zeros(50, np.float32), np.zeros_like(metric.triangles))
    moved, _ = refine_by_metric(points, silent, entries, np.arange(50) % 5, DEFAULT_CONTEXT)
    assert {tuple(row) for row in moved.reshape(len(moved), -1)} <= {tuple(row) for row in entries.reshape(5, -1)}


def directions(seed, spread):
    """Draw 60 unit vectors, around +z if the spread is small."""
    drawn = np.random.default_rng(seed).standard_normal((60, 3)) * [spread, spread, 1.0]
    drawn[:, 2] = np.abs(drawn[:, 2]) + (spread < 1.0)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def colours(model, seen):
    """Return the colours [N, V, 3] of splats in directions [V, 3]."""
    coefficients = np.concatenate([model.sh0[:, None], model.shN], axis=1, dtype=np.float64)
    return np.einsum("vb,nbc->nvc", evaluate_sh(model.sh_degree, seen), coefficients)


def seen_from(seen, count):
    """Return the importance of splats that are seen from directions [V, 3] alone."""
    basis = evaluate_sh(3, seen)
    matrix = basis.T @ basis / len(seen)
    matrix /= np.diagonal(matrix)[1:].mean()
    return Importance(np.ones(count), sh_metric=np.tile(matrix[np.triu_indices(16)].astype(np.float32), (count, 1)))


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_dropped_bands_are_projected_where_splats_are_seen(make_model, degree):
    model = make_model(200, 3)
    cap, others = directions(0, 0.3), directions(1, 1.0) * [1.0, 1.0, -1.0]
    dropped, projected = (project_sh(model, degree, one) for one in (None, seen_from(cap, len(model))))
    for lowered in (dropped, projected):
        assert not lowered.shN[:, (degree + 1) ** 2 - 1 :].any()
    np.testing.assert_array_equal(model.sh0, dropped.sh0)
    seen, unseen = (
        [np.square(colours(one, view) - colours(model, view)).mean() for one in (dropped, projected)]
        for view in (cap, others)
    )
    assert seen[1] < 0.35 * seen[0]
    assert unseen[1] < 4.0 * unseen[0]  # part of the matrix is that of all directions
    model.shN[0], model.shN[1] = 3e38, -1e20
    extreme = project_sh(model, degree, seen_from(cap, len(model)))
    assert np.isfinite(extreme.sh0).all()
    assert np.isfinite(extreme.shN).all()
    everywhere = Importance(
        np.ones(200), sh_metric=np.tile(np.eye(16, dtype=np.float32)[np.triu_indices(16)], (200, 1))
    )
    np.testing.assert_allclose(dropped.shN[2:], project_sh(model, degree, everywhere).shN[2:], atol=1e-6)


def test_files_with_fewer_bands_have_projected_colours_and_declare_no_errors_of_these(make_model):
    model, options = make_model(300, 3), EncodeOptions(sh_degree=1, attribute_psnr=70.0)
    importance = seen_from(directions(0, 0.3), len(model))
    result = encode_with_report(model, options, importance=importance)
    wanted = project_sh(model, 1, importance).select(result.source_index)
    scene = decode_scene(result.data)
    np.testing.assert_allclose(wanted.sh0, scene.model.sh0, atol=0.03)
    np.testing.assert_allclose(wanted.shN[:, :3], scene.model.shN, atol=0.03)
    assert scene.declared_bounds.refitted
    assert result.report.errors.keys().isdisjoint({"sh0", "sh1", "sh2", "sh3"})
    bounded = encode_with_report(model, options, importance=importance, target=Target(max_error={"sh0": 0.02}))
    assert 0.0 < bounded.report.search.reached["sh0"] <= 0.02
    with pytest.raises(InputError, match=r"SH matrices float32 \[300, 120\], expected floats \[300, 136\]"):
        encode(model, options, importance=replace(importance, sh_metric=importance.sh_metric[:, :120]))


@pytest.fixture
def model(make_model):
    return make_model(COUNT, 0)


def test_twice_the_step_gives_four_times_the_error(model):
    def errors(step, levels):
        steps = dict.fromkeys(("position_step", "scale_step", "sh0_step"), step)
        options = EncodeOptions(**steps, quat_levels=levels, opacity_levels=levels)
        return rounding_errors(model, unequal(model), choose_parameters(model, options, importance_given=True))

    bright = model.opacities > 0.01
    np.testing.assert_allclose(errors(0.02, 100)[bright], 4.0 * errors(0.01, 200)[bright], rtol=1e-5)


def test_classes_have_steps_of_their_own_except_for_explicit_options(model):
    result, _ = encoded(model, important(model))
    classes = result.report.options["classes"]
    assert sum(classes["splats"]) == COUNT
    assert len(classes["splats"]) == result.report.tile_count > 1
    for name in CLASSED_ATTRIBUTES:
        assert min(classes[name]) == (1 if name in ("opacities", "quats") else 0)
    assert any(max(classes[name]) > 1 for name in CLASSED_ATTRIBUTES)
    assert result.report.notes == ()
    result, _ = encoded(model, important(model), scale_step=0.01, opacity_levels=100, position_bits=12)
    said = result.report.options
    assert (said["scale_step"], said["opacity_levels"]) == (float(np.float32(0.01)), 100)
    assert set(said["classes"]["scales"]) == set(said["classes"]["means"]) == {0}
    assert set(said["classes"]["opacities"]) == {1}
    assert max(said["classes"]["sh0"]) > 0


def test_important_splats_have_smaller_errors(model):
    importance = important(model)
    result, decoded = encoded(model, importance, attribute_psnr=45)
    source = model.select(result.source_index)
    source, decoded = (replace(one, scales=np.sort(one.scales, axis=1)) for one in (source, decoded))
    order = np.argsort(importance.blocks.means[result.source_index])
    for name in ("means", "opacities", "scales", "sh0"):
        errors = np.abs(getattr(decoded, name) - getattr(source, name)).reshape(COUNT, -1).mean(axis=1)
        assert errors[order[-COUNT // 10 :]].mean() < 0.75 * errors[order[: COUNT // 10]].mean(), name


@pytest.mark.slow
def test_small_scenes_equal_blocks_and_some_options_give_one_class(model):
    for options in ({"max_classes": 1}, {"shape_codebook_size": 16}):
        one, other = (encoded(model, by, **options)[0] for by in (important(model), Importance(np.ones(COUNT))))
        assert one.data == other.data
    few = model.select(slice(200))
    zeros = GaussNewtonBlocks(np.zeros(COUNT), np.zeros((COUNT, 21)), np.zeros(COUNT), np.zeros(COUNT))
    for splats, importance, options, count in (
        (few, important(few), {}, 0),
        (model, Importance(np.ones(COUNT), blocks=zeros), {}, 0),
        (model, important(model), {"preset": "fast"}, 0),
        (model, important(model), {"preset": "fast", "max_classes": 2}, 2),
    ):
        result = encode_with_report(splats, EncodeOptions(**options), importance=importance)
        assert count == len(result.report.options.get("classes", {}).get("splats", ())), options


def test_outliers_get_tiles_of_their_own(model):
    sh0 = model.sh0.copy()
    sh0[5] = 3e12
    exploded = replace(model, sh0=sh0)
    result, decoded = encoded(exploded, important(exploded))
    errors = np.abs(decoded.sh0[np.argsort(result.source_index)] - sh0).max(axis=1)
    assert np.delete(errors, 5).max() < 5.0  # the step of the coarsest class, not that of 3e12


@pytest.mark.slow
def test_scenes_and_steps_of_any_size_are_encoded(model):
    for factor in (1e-30, 1e22, 1e37):
        scaled = replace(model, means=(model.means * np.float32(factor)).astype(np.float32))
        encoded(scaled, important(scaled))
    assert encoded(model, important(model), position_step=1e200)[0].report.options["position_step"] == 1e200


def test_measured_weights_have_a_floor(model):
    measured = np.zeros((COUNT, 2))
    measured[:10] = 1.0
    floored = apply_weight_floor(measured, model)
    assert (floored >= measured).all()
    assert floored[10:].min() > 0.0
    np.testing.assert_allclose(floored[10:, 0], apply_weight_floor(measured[:, 0], model)[10:])
    assert floored[10:].mean() < 0.6 * measured.mean()
