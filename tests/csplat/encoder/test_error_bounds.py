# SPDX-License-Identifier: Apache-2.0
"""Measured and declared errors agree with the definitions of the spec, and sources with their rows."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from checked import covariances, disturbed, measure_errors

from csplat.encoder.error_bounds import ErrorSums
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, measure_pairs
from csplat_conformance.encoders.reference_ply import PlyRows, is_splat, source_of_rows
from csplat_conformance.tolerance import bound_tolerance

ORIGIN = (481_250.0, 5_467_100.0, 310.0)


def test_covariance_errors_survive_extreme_scales_and_other_descriptions(make_model):
    source = make_model(40, 0)
    quats = source.quats[:, [1, 0, 3, 2]] * np.float32([-1, 1, 1, -1])  # a half turn about an axis of the splat
    assert measure_errors(source, replace(source, quats=quats), np.arange(40))["covariance"][0] < 1e-5
    for size in (-60, 60):
        source = make_model(40, 0, scales=np.full((40, 3), size, np.float32))
        largest = measure_errors(source, replace(source, scales=source.scales + np.float32(0.125)), np.arange(40))
        assert pytest.approx(np.exp(0.25) - 1, rel=1e-4) == largest["covariance"][0]


def test_an_invalid_index_is_refused(make_model):
    model = make_model(10, 0)
    for index in (np.arange(9), np.arange(10) - 1, np.arange(10) + 1):
        with pytest.raises(InputError, match="source index"):
            measure_errors(model, model, index)


def scene(make_model, degree, *, doubles=False):
    """Return a source, a disturbed and reordered part of it with at most two bands, and its rows."""
    model, rng = make_model(40, degree, degree), np.random.default_rng(degree)
    index = rng.permutation(40)[:38]
    decoded = disturbed(model.select(index), rng, 0.01)
    decoded = replace(decoded, shN=decoded.shN[:, :8], origin=ORIGIN if doubles else (0.0, 0.0, 0.0))
    source = Source.of(model)
    return replace(source, means=model.means + np.array(ORIGIN)) if doubles else source, decoded, index


def slow_errors(source, decoded, index):
    """Return the differences of each pair of splats by measure, [n, k], by the definitions of the spec (5.5)."""
    count, most = len(index), max(source.shN.shape[1], decoded.shN.shape[1])
    wanted, found = covariances(source.quats[index], source.scales[index]), covariances(decoded.quats, decoded.scales)
    norms = [np.linalg.norm(one.reshape(count, 9), axis=1) for one in (found - wanted, wanted)]
    places = decoded.means + np.array(decoded.origin) - (source.means[index] + np.array(source.origin))
    errors = {"means": np.linalg.norm(places, axis=1), "covariance": norms[0] / norms[1]}
    for name in ("opacities", "sh0"):
        errors[name] = getattr(decoded, name).astype(np.float64) - getattr(source, name)[index]
    rest = np.zeros((count, most, 3))  # bands that one of them lacks count against 0
    rest[:, : decoded.shN.shape[1]] += decoded.shN
    rest[:, : source.shN.shape[1]] -= source.shN[index]
    errors |= {f"sh{band}": rest[:, band**2 - 1 : (band + 1) ** 2 - 1] for band in range(1, math.isqrt(most + 1))}
    return {name: error.reshape(count, -1) for name, error in errors.items()}


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
@pytest.mark.parametrize("doubles", [False, True])
def test_errors_agree_with_the_slow_twin(make_model, degree, doubles):
    # SRC-2, SER-5: bands that the file lacks count against 0.
    source, decoded, index = scene(make_model, degree, doubles=doubles)
    errors, found = slow_errors(source, decoded, index), measure_pairs(source, decoded, index)
    expected = {name: (np.abs(e).max(), math.sqrt((e**2).sum() / len(index))) for name, e in errors.items()}
    assert list(expected) == list(found)
    for name, pair in expected.items():
        for true, measured in zip(pair, found[name][:2], strict=True):
            assert abs(true - measured) <= bound_tolerance(name, true, source.reach(decoded.origin)) / 4, name
        assert np.abs(errors[name][found[name].worst]).max() == pytest.approx(found[name].max, rel=1e-9)
    if not doubles:
        model = source.to_model((0.0, 0.0, 0.0))
        ours = measure_errors(model, decoded, index)
        assert expected == {name: pytest.approx(pair, rel=1e-6) for name, pair in ours.items()}
        turned = measure_errors(decoded, model.select(index), np.arange(len(index)))  # the source lacks bands
        assert [ours[name] for name in ours if "sh" in name] == [turned[name] for name in ours if "sh" in name]


def rows_of(count=8):
    rng = np.random.default_rng(0)
    shapes = {"quats": (4,), "scales": (3,), "logits": (), "sh0": (3,), "shN": (3, 3)}
    columns = {name: rng.normal(0, 1, (count, *shape)).astype(np.float32) for name, shape in shapes.items()}
    return PlyRows(means=rng.normal(0, 1, (count, 3)), **columns)


def test_rows_with_non_finite_values_are_no_splats():
    # SRC-1
    rows = rows_of()
    rows.means[0, 1] = 1e39  # finite only in binary64
    rows.quats[1, 2] = np.nan
    rows.scales[2, 0], rows.scales[7, 1] = np.inf, -np.inf  # the latter is flat
    rows.logits[3], rows.logits[4], rows.logits[5] = np.nan, np.inf, -np.inf
    rows.shN[6, 2, 1] = np.inf
    assert [False, False, False, False, True, True, False, True] == is_splat(rows).tolist()
    assert [1.0, 0.0] == source_of_rows(rows).opacities[:2].tolist()


def test_a_source_has_alphas_unit_quaternions_and_unchanged_means():
    # SRC-2
    rows = rows_of()
    rows.quats[3] = 0
    source = source_of_rows(rows)
    np.testing.assert_array_equal(rows.means, source.means)
    assert source.means.dtype == np.float64
    alphas, quats = 1 / (1 + np.exp(-rows.logits.astype(np.float64))), rows.quats.astype(np.float64)
    np.testing.assert_array_equal(alphas.astype(np.float32), source.opacities)
    quats[3] = [1, 0, 0, 0]
    np.testing.assert_allclose(source.quats, quats / np.linalg.norm(quats, axis=1, keepdims=True), rtol=1.2e-7)


def test_a_source_about_another_origin_has_the_same_errors(make_model):
    source, decoded, index = scene(make_model, 0, doubles=True)
    near = source.about(ORIGIN)
    ours, theirs = (measure_pairs(one, decoded, index)["means"].max for one in (source, near))
    assert abs(ours - theirs) <= bound_tolerance("means", ours, source.reach(ORIGIN))
    assert source.reach(ORIGIN) == pytest.approx(float(np.abs(source.means).max()), rel=1e-12)
    assert float(np.abs(near.to_model(ORIGIN).means).max()) < 20.0


def test_declared_bounds_are_the_same_when_a_processor_rounds_otherwise():
    for value in (1e-150, 3.7e-5, 0.1, 2 / 3, 7.25e9, 1e150):
        other = math.nextafter(math.nextafter(value, math.inf), math.inf)
        here, there = (ErrorSums(1, {"means": v}, {"means": v * v}).declared()["means"] for v in (value, other))
        assert here == there
        assert value <= here[0] <= value * (1 + 1e-4)


def test_a_bound_beyond_float64_is_refused():
    for sums in (({"covariance": 1e160}, {"covariance": math.inf}), ({"means": sys.float_info.max}, {"means": 0.0})):
        with pytest.raises(InputError, match=f"error of {next(iter(sums[0]))} is too large to declare"):
            ErrorSums(3, *sums).declared()
