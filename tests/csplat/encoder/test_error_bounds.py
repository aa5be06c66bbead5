"""Measured and declared errors agree with the definitions of the spec, computed splat by splat in Python floats."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from checked import measure_errors

from csplat.encoder.error_bounds import ErrorSums
from csplat.errors import InputError
from csplat.model import SplatModel, normalise_quats
from csplat_conformance.declared_bounds import Source, measure_pairs
from csplat_conformance.encoders.reference_ply import PlyRows, is_splat, source_of_rows
from csplat_conformance.tolerance import bound_tolerance


def test_covariance_errors_do_not_depend_on_the_description(make_model):
    source = make_model(40, 0)
    quats = source.quats[:, [1, 0, 3, 2]] * np.float32([-1, 1, 1, -1])  # a half turn about an axis of the splat
    assert measure_errors(source, replace(source, quats=quats), np.arange(40))["covariance"][0] < 1e-5


def test_covariance_errors_survive_extreme_scales(make_model):
    for size in (-60, 60):
        source = make_model(40, 0, scales=np.full((40, 3), size, np.float32))
        largest = measure_errors(source, replace(source, scales=source.scales + np.float32(0.125)), np.arange(40))
        assert pytest.approx(np.exp(0.25) - 1, rel=1e-4) == largest["covariance"][0]


def test_a_band_that_only_one_model_has_is_measured_against_zero(make_model):
    source = make_model(20, 2)
    cut = replace(source, shN=source.shN[:, :3])
    for first, second in ((source, cut), (cut, source)):
        largest = measure_errors(first, second, np.arange(20))["sh2"][0]
        assert largest == pytest.approx(float(np.abs(source.shN[:, 3:]).max()))


def test_an_invalid_index_is_refused(make_model):
    model = make_model(10, 0)
    for index in (np.arange(9), np.arange(10) - 1, np.arange(10) + 1):
        with pytest.raises(InputError, match="source index"):
            measure_errors(model, model, index)


ORIGIN = (481_250.0, 5_467_100.0, 310.0)


def twin_covariance(quat, scales, top):
    length = math.sqrt(math.fsum(c * c for c in quat))
    w, x, y, z = (c / length for c in quat)
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    variances = [math.exp(2 * (min(88.0, max(-88.0, s)) - top)) for s in scales]
    return [
        [math.fsum(a * v * b for a, v, b in zip(rotation[i], variances, rotation[j], strict=True)) for j in range(3)]
        for i in range(3)
    ]


def twin_norm(matrix):
    return math.sqrt(math.fsum(v * v for row in matrix for v in row))


def twin_errors(source, decoded, i, j):
    """Return the differences of decoded splat i and source splat j, by measure (spec 5.5)."""
    centre = [float(a) + b for a, b in zip(decoded.means[i], decoded.origin, strict=True)]
    wanted = [float(a) + b for a, b in zip(source.means[j], source.origin, strict=True)]
    theirs, ours = (list(map(float, one)) for one in (source.scales[j], decoded.scales[i]))
    top = min(88.0, max(-88.0, *theirs))
    reference = twin_covariance(list(map(float, source.quats[j])), theirs, top)
    found = twin_covariance(list(map(float, decoded.quats[i])), ours, top)
    difference = [[a - b for a, b in zip(*rows, strict=True)] for rows in zip(found, reference, strict=True)]
    errors = {
        "means": [math.dist(centre, wanted)],
        "covariance": [twin_norm(difference) / twin_norm(reference)],
        "opacities": [float(decoded.opacities[i]) - float(source.opacities[j])],
        "sh0": [float(a) - float(b) for a, b in zip(decoded.sh0[i], source.sh0[j], strict=True)],
    }
    for band in range(1, max(decoded.sh_degree, source.sh_degree) + 1):
        rows = range(band * band - 1, (band + 1) ** 2 - 1)
        value = lambda model, k, row, c: float(model.shN[k, row, c]) if row < model.shN.shape[1] else 0.0  # noqa: E731
        errors[f"sh{band}"] = [value(decoded, i, row, c) - value(source, j, row, c) for row in rows for c in range(3)]
    return errors


def twin(source, decoded, index):
    """Return (max, rms) by measure."""
    pairs = [twin_errors(source, decoded, i, int(j)) for i, j in enumerate(index)]
    return {
        name: (
            max(abs(v) for pair in pairs for v in pair[name]),
            math.sqrt(math.fsum(v * v for pair in pairs for v in pair[name]) / len(pairs)),
        )
        for name in pairs[0]
    }


def scene(count, degree, seed, *, doubles=False):
    """Return a source and a coarsely quantised, reordered part of it."""
    rng = np.random.default_rng(seed)
    coefficients = (degree + 1) ** 2 - 1
    means = rng.normal(0, 3, (count, 3))
    source = Source(
        means=means + np.array(ORIGIN) if doubles else means.astype(np.float32),
        quats=normalise_quats(rng.normal(0, 1, (count, 4)).astype(np.float32)),
        scales=rng.uniform(-7, 2, (count, 3)).astype(np.float32),
        opacities=rng.random(count).astype(np.float32),
        sh0=rng.normal(0, 1, (count, 3)).astype(np.float32),
        shN=rng.normal(0, 0.2, (count, coefficients, 3)).astype(np.float32),
    )
    index = rng.permutation(count)[: count - 2]
    kept = min(coefficients, 8)
    decoded = SplatModel(
        means=np.round(means[index] / 0.01).astype(np.float32) * np.float32(0.01),
        quats=normalise_quats(source.quats[index] + rng.normal(0, 0.01, (count - 2, 4)).astype(np.float32)),
        scales=source.scales[index] + rng.uniform(-0.02, 0.02, (count - 2, 3)).astype(np.float32),
        opacities=np.round(source.opacities[index] * 64) / np.float32(64),
        sh0=np.round(source.sh0[index] * 32) / np.float32(32),
        shN=np.round(source.shN[index, :kept] * 16) / np.float32(16),
        origin=ORIGIN if doubles else (0.0, 0.0, 0.0),
    )
    return source, decoded, index


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
@pytest.mark.parametrize("doubles", [False, True])
def test_errors_agree_with_the_slow_twin(degree, doubles):
    # SRC-2, SER-5: bands that the file lacks count against 0.
    source, decoded, index = scene(40, degree, 5 + degree, doubles=doubles)
    expected, found = twin(source, decoded, index), measure_pairs(source, decoded, index)
    reach = source.reach(decoded.origin)
    assert list(expected) == list(found)
    for name, pair in expected.items():
        for true, measured in zip(pair, found[name][:2], strict=True):
            assert abs(true - measured) <= bound_tolerance(name, true, reach) / 4, name
        errors = twin_errors(source, decoded, found[name].worst, int(index[found[name].worst]))[name]
        assert max(map(abs, errors)) == pytest.approx(found[name].max, rel=1e-9)
    if not doubles:
        encoders = measure_errors(source.to_model((0.0, 0.0, 0.0)), decoded, index)
        assert expected == {name: pytest.approx(pair, rel=1e-6) for name, pair in encoders.items()}


def rows_of(count=8):
    rng = np.random.default_rng(0)
    return PlyRows(
        means=rng.normal(0, 1, (count, 3)),
        quats=rng.normal(0, 1, (count, 4)).astype(np.float32),
        scales=rng.normal(-3, 1, (count, 3)).astype(np.float32),
        logits=rng.normal(0, 3, count).astype(np.float32),
        sh0=rng.normal(0, 1, (count, 3)).astype(np.float32),
        shN=rng.normal(0, 1, (count, 3, 3)).astype(np.float32),
    )


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
    for j in range(8):
        assert np.float32(1 / (1 + math.exp(-float(rows.logits[j])))) == source.opacities[j]
        length = math.sqrt(math.fsum(float(c) ** 2 for c in rows.quats[j]))
        unit = [np.float32(float(c) / length) for c in rows.quats[j]] if length else [1, 0, 0, 0]
        np.testing.assert_allclose(source.quats[j], unit, rtol=1.2e-7)


def test_a_source_about_another_origin_has_the_same_errors():
    source, decoded, index = scene(40, 0, 3, doubles=True)
    near = source.about(ORIGIN)
    ours, theirs = (measure_pairs(one, decoded, index)["means"].max for one in (source, near))
    assert abs(ours - theirs) <= bound_tolerance("means", ours, source.reach(ORIGIN))
    assert source.reach(ORIGIN) == pytest.approx(float(np.abs(source.means).max()), rel=1e-12)
    assert float(np.abs(near.to_model(ORIGIN).means).max()) < 20.0


def test_declared_bounds_are_the_same_when_a_processor_rounds_otherwise() -> None:
    for value in (1e-150, 3.7e-5, 0.1, 2 / 3, 7.25e9, 1e150):
        other = math.nextafter(math.nextafter(value, math.inf), math.inf)
        here, there = (ErrorSums(1, {"means": v}, {"means": v * v}).declared()["means"] for v in (value, other))
        assert here == there
        assert value <= here[0] <= value * (1 + 1e-4)


def test_a_bound_that_leaves_float64_by_rounding_up_is_refused() -> None:
    with pytest.raises(InputError, match="too large to declare"):
        ErrorSums(1, {"means": sys.float_info.max}, {"means": 0.0}).declared()
