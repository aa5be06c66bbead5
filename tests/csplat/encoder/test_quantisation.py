# SPDX-License-Identifier: Apache-2.0
"""Quantisers and quantisation classes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from checked import covariances, quaternion_of
from chromium import absent
from codebooks_cases import few_shapes
from quantisation_cases import COUNT, important, unequal

import csplat
from csplat.context import Context
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions, EncodePlan, Importance, fix_quantisation, quantisation
from csplat.encoder.coding_parameters import choose_parameters
from csplat.encoder.encode_plan import trial_rows
from csplat.encoder.error_bounds import covariance_entries
from csplat.encoder.quantisation import canonicalise_shape, opacity_levels, quantise_colour, quat_levels
from csplat.encoder.quantisation_classes import choose_classes
from csplat.encoder.shape_codebook import quantise_shape
from csplat.encoder.splat_importance import rounding_errors
from csplat.encoder.tiling import cut_scene
from csplat.errors import InputError
from csplat.model import normalise_quats
from csplat_conformance.adapter import answer
from csplat_selftest.decoder_processes import JsDecoder, missing_javascript
from csplat_selftest.fuzzing.decoder_targets import compared
from csplat_trainer.tuned_scene import TunedScene, count_integers, slopes_of


@pytest.mark.parametrize("square", [False, True])
def test_opacity_keeps_zero_and_one_and_stays_in_range(square):
    alpha = np.linspace(0, 1, 1001, dtype=np.float32)
    domain = np.sqrt if square else np.asarray
    for levels in (1, 2, 63, 255, 65535):
        q = opacity_levels(alpha, levels, square=square)
        values = quantisation.opacity_values(q, levels, square=square)
        assert (0.0, 1.0) == (values[0], values[-1])
        assert ((q >= 0) & (q <= levels)).all()
        assert float(np.abs(domain(values) - domain(alpha)).max()) <= 0.5 / levels + 1e-6


def test_coarse_opacities_are_multiples_or_ends():
    alpha = np.linspace(0, 1, 999, dtype=np.float32)
    for multiple in (2, 3, 7):
        q = opacity_levels(alpha, 50, square=True, multiple=multiple)
        assert (q[0], q[-1]) == (0, 50)
        assert set(q) <= {*range(0, 51, multiple), 50}
        assert np.abs(q - 50 * np.sqrt(alpha)).max() <= multiple
        assert (np.diff(q) >= 0).all()


def random_quats(count, seed):
    return normalise_quats(np.random.default_rng(seed).normal(size=(count, 4)).astype(np.float32))


@pytest.mark.parametrize(("levels", "multiple"), [
    (3, 1), (4, 1), (5, 1), (31, 1), (127, 1), (32767, 1), (12, 4), (50, 7), (255, 30),
])  # fmt: skip
def test_rotations_stay_legal_and_near_and_are_multiples(levels, multiple):
    rng = np.random.default_rng(levels)
    quats = np.concatenate([rng.standard_normal((4, 2000)), 0.5 + rng.normal(0, 1e-3, (4, 2000))], axis=1)
    quats = -np.sort(-np.abs(quats / np.linalg.norm(quats, axis=0)), axis=0)
    quats[1:] *= rng.choice([-1, 1], (3, 4000))
    quats[:, 0] = 0.5
    q = quat_levels(quats.astype(np.float32), levels, multiple)
    assert not (q % multiple).any()
    assert np.abs(q).max() <= levels
    assert int((q.astype(np.int64) ** 2).sum(axis=0).max()) <= 2 * levels * levels
    values = quantisation.quat_values(q, levels)
    np.testing.assert_allclose(np.linalg.norm(values, axis=0), 1.0, atol=1e-6)
    assert float(np.abs(values[1:] - quats[1:]).max()) <= multiple / levels


def test_colours_stay_within_a_step_and_a_chroma_step():
    rng = np.random.default_rng(0)
    for scale in (1.0, 100.0, 2.0**25):
        rgb = rng.normal(0, scale, (3, 1000))
        for shift in (0, 1, 2, 5):
            columns = quantisation.colour_integers(rgb if scale > 1e6 else rgb.astype(np.float32), shift)
            assert float(np.abs(quantisation.lift_colour(columns, shift) - rgb).max()) <= 1.5 + 0.75 * 2**shift
    whole = rng.integers(-(2**20), 2**20, (3, 5000)).astype(np.float64)  # without a shift within one step
    assert np.abs(quantisation.lift_colour(quantisation.colour_integers(whole, 0), 0) - whole).max() <= 1
    coarse = np.arange(1000, dtype=np.int32) % 5
    columns = quantisation.colour_integers(rng.normal(0, 50, (3, 1000)).astype(np.float32), 1, coarse)
    assert (columns % (1 << coarse) == 0).all()  # multiples on the same lattice


def test_lattices_keep_integers_and_values_within_the_range_of_the_format():
    for largest in (0.0, 1.0, 1e6, 1e20, 3e38):
        exponent = quantisation.lattice_exponent(largest, 1e-3)
        assert largest / math.ldexp(1e-3, exponent) <= 2**21
        assert exponent == 0 or largest / math.ldexp(1e-3, exponent - 2) >= 2**20
    top = np.finfo(np.float32).max
    n = quantisation.quantise_means(np.array([[top, -top], [0, 1], [1e30, 0]], np.float32), 1.7e36)
    assert np.isfinite(quantisation.lattice_values(n, 1.7e36)).all()


def test_canonical_axis_order_sorts_scales_and_keeps_the_covariance():
    quats, scales = random_quats(2000, 0), np.random.default_rng(0).normal(0, 2, (2000, 3)).astype(np.float32)
    rotation, ordered = canonicalise_shape(quats, scales)
    before, after = covariances(quats, scales), covariances(rotation.T, ordered.T)
    size = np.linalg.norm(before, axis=(1, 2))
    assert float((np.linalg.norm(after - before, axis=(1, 2)) / size).max()) < 1e-5
    assert (rotation[0] >= np.abs(rotation).max(axis=0)).all()
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=0), 1.0, atol=1e-6)
    np.testing.assert_array_equal(np.sort(scales, axis=1)[:, ::-1], ordered.T)


def test_equivalent_shapes_get_the_same_canonical_form():
    quats, scales = random_quats(16, 2), np.random.default_rng(2).normal(0, 2, (16, 3)).astype(np.float32)
    first = canonicalise_shape(quats, scales)
    for order, sign in itertools.product(itertools.permutations(range(3)), (1, -1)):
        axes = np.eye(3)[list(order)].T
        again = turned(quats.astype(np.float64), quaternion_of(axes * np.linalg.det(axes))).astype(np.float32)
        second = canonicalise_shape(again * sign, scales[:, list(order)])
        np.testing.assert_allclose(second[0], first[0], atol=2e-6)
        np.testing.assert_array_equal(second[1], first[1])


def turned(q, turn):
    """Return q · turn, a rotation in the splat's own axes."""
    w, v, a, b = q[:, :1], q[:, 1:], turn[0], turn[1:]
    return np.concatenate([w * a - (v @ b)[:, None], w * b + a * v + np.cross(v, b)], axis=1)


@pytest.fixture
def model(make_model):
    return make_model(COUNT, 0)


@pytest.fixture
def parameters(model):
    return choose_parameters(model, EncodeOptions(), importance_given=True)


@pytest.fixture
def graded(model):
    """A file of several classes."""
    return encode_with_report(model, importance=important(model))


def test_blocks_of_shapes_agree_with_the_covariance(make_model):
    model = make_model(50, 0)
    plan = choose_parameters(model, EncodeOptions(scale_step=1.0, quat_levels=100), importance_given=True)
    curvatures = unequal(model)
    found = rounding_errors(model, curvatures, plan)
    rows, columns = np.triu_indices(6)
    matrices = np.zeros((50, 6, 6))
    matrices[:, rows, columns] = matrices[:, columns, rows] = curvatures.shapes

    def lost(quats, scales):
        """Return the cost of a small change of shape, from the covariance relative to the trace before the change."""
        variances = np.exp(2.0 * model.scales.T.astype(np.float64))
        before = covariance_entries(model.quats.T, variances) / variances.sum(axis=0)
        after = covariance_entries(quats.T, np.exp(2.0 * scales.T.astype(np.float64))) / variances.sum(axis=0)
        vectors = (after - before).T * np.sqrt([1, 1, 1, 2, 2, 2])
        return np.einsum("ni,nij,nj->n", vectors, matrices, vectors)

    small, axes, quats = 1e-4, np.eye(3), model.quats.astype(np.float64)
    sizes = sum(lost(model.quats, model.scales + small * axis) for axis in axes) / small**2
    np.testing.assert_allclose(found[:, 1], sizes / 12.0, rtol=2e-3)
    turns = sum(lost(turned(quats, np.r_[1.0, small / 2.0 * axis]), model.scales) for axis in axes) / small**2
    angle = 2.0 / (plan.quat_levels * np.sqrt(2.0))
    np.testing.assert_allclose(found[:, 2], turns * angle**2 / 12.0, rtol=2e-3)


@pytest.mark.slow
def test_the_error_of_rounding_is_predicted():
    from captures import cameras, shell

    from csplat_render import render
    from csplat_tools.scene_sensitivity import measure_importance

    scene, views, options = shell(0), cameras(12), EncodeOptions(attribute_psnr=58)
    importance = measure_importance(scene, views, (0.0, 0.0, 0.0))
    plan = choose_parameters(scene, options, importance_given=True)
    foretold = rounding_errors(scene, importance.blocks, plan).sum()
    decoded = csplat.decode(encode_with_report(scene, options).data)
    lost = np.mean([np.mean(np.square(render(decoded, view).rgb - render(scene, view).rgb)) for view in views])
    assert foretold / 1.6 < lost < 1.6 * foretold


def test_costs_count_the_encoded_integers_of_each_class(make_model):
    # The encoder counts integers divided by the multiple of their class.
    model = make_model(8_000, 0)  # counts of fewer splats differ by more than a thousandth
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(sh_coding="none"), importance=important(model)))
    scene, plan, tiles = TunedScene(fixed), fixed.parameters, fixed.encode_plan.tiles
    values, bits = scene.free_values, 0.0
    classes = list(dict.fromkeys(tile.factors for tile in tiles))
    assert len(classes) > 1
    for factors in classes:
        rows = np.concatenate([tile.rows for tile in tiles if tile.factors == factors])
        shape = quantise_shape(values.quats[rows], values.scales[rows], plan, None, factors)
        alpha = opacity_levels(values.opacities[rows], plan.opacity_levels, square=True, multiple=factors.opacities)
        sh0 = np.ascontiguousarray(values.sh0[rows].T)
        colour = quantise_colour(sh0, plan.sh0_step, plan.chroma_shift, factors.sh0)[0]
        for columns in (shape.scales, shape.quats // factors.quats, alpha[None] // factors.opacities, colour):
            bits += slopes_of(count_integers([columns.T]))[1]
    assert scene.count(scene.dequantise()[0], 1.0).bits == pytest.approx(bits, rel=1e-3)


def test_tiles_and_trial_rows_are_of_the_classes(model, parameters):
    finer, classes = choose_classes(model, unequal(model), parameters, EncodeOptions())
    tiles = cut_scene(model, finer, classes)
    assert sorted(np.concatenate([tile.rows for tile in tiles])) == list(range(COUNT))
    for tile in tiles:
        assert len(set(classes.index[tile.rows])) == 1
        assert tile.factors == classes.factors[classes.index[tile.rows[0]]]
        assert tile.exponent >= tile.factors.means
    assert min(one.means for one in classes.factors) == min(one.sh0 for one in classes.factors) == 0
    weights = unequal(model).means
    first, last = (weights[classes.index == index].mean() for index in (0, classes.index.max()))
    assert first > last
    found = classes.index[trial_rows(model, tiles, classes)]
    assert set(found) == set(classes.index)
    np.testing.assert_allclose(np.bincount(found) / len(found), np.bincount(classes.index) / COUNT, atol=0.05)
    assert set(trial_rows(model, tiles, None)) == set(tiles[len(tiles) // 2].rows)


@pytest.mark.slow
def test_one_splat_does_not_change_the_steps_of_others(model, graded):
    weights = unequal(model).means.copy()
    weights[7] *= 1e20
    heavy = encode_with_report(model, importance=important(model, means=weights)).report.options
    for name in ("scale_step", "sh0_step", "position_step"):
        assert 0.5 < heavy[name] / graded.report.options[name] < 2.0, name


def test_invalid_blocks_and_matrices_are_refused(model, make_model):
    for field, value in (
        ("means", np.ones(3)), ("means", np.full(COUNT, -1.0)), ("opacities", np.full(COUNT, np.nan)),
        ("colours", np.ones(COUNT, np.int64)), ("shapes", np.ones((COUNT, 6))),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"Gauss-Newton blocks of {field}"):
            encode_with_report(model, importance=important(model, **{field: value}))
    shapes, options = few_shapes(make_model, 200), EncodeOptions(shape_codebook_size=4)
    for bad in (np.ones((200, 20)), np.ones((199, 21)), np.ones((200, 21), int), np.full((200, 21), np.nan)):
        with pytest.raises(InputError, match="shape matrices"):
            encode_with_report(shapes, options, importance=Importance(np.ones(200), None, None, bad))


def test_the_number_of_threads_does_not_change_the_bytes_of_classes(model, graded):
    assert graded.data == encode_with_report(model, importance=important(model), context=Context(threads=3)).data
    assert "classes" in graded.report.options


@pytest.mark.slow
def test_the_javascript_decoder_agrees_about_classes_and_shape_codebooks(graded, make_model):
    if missing_javascript():
        absent(missing_javascript())
    shapes = few_shapes(make_model, 600, degree=2)
    options = {"shape_codebook_size": 40, "shape_escape_fraction": 0.3, "tile_splats": 250}
    with JsDecoder() as decoder:
        for data in (graded.data, csplat.encode(shapes, EncodeOptions(**options))):
            assert ("decoded", "") == compared(answer(data), decoder.ask(data), "JavaScript")
