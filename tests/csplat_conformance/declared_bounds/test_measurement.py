# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.declared_bounds.measurement."""

from dataclasses import replace

import numpy as np
import pytest
from checked import covariances, disturbed, measure_errors

from csplat.context import Context
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, check_source_index, measurement


def differences(source, decoded):
    rows = np.arange(len(source))
    return measurement.pair_differences(Source.of(source), decoded, rows, rows)


def measure_pairs(source, *rest, **options):
    """Return (max, rms) by measure."""
    pairs = measurement.measure_pairs(Source.of(source), *rest, **options)
    return {name: found[:2] for name, found in pairs.items()}


def test_covariance_errors_agree_with_the_definition(make_model):
    source = make_model(60, 0)
    decoded = disturbed(source, np.random.default_rng(1), 0.1)
    found = differences(source, decoded)["covariance"][:, 0]
    theirs, ours = (covariances(one.quats, one.scales) for one in (source, decoded))
    expected = np.linalg.norm(ours - theirs, axis=(1, 2)) / np.linalg.norm(theirs, axis=(1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    negated = replace(source, quats=-source.quats)  # the same rotations
    assert measure_pairs(source, negated, np.arange(60))["covariance"][0] < 1e-15


def test_log_scales_of_any_size_have_covariance_errors(make_model):
    source = make_model(3, 0, scales=np.array([[60, 60, 60], [-60, -60, -60], [60, -60, 0]], np.float32))
    decoded = replace(source, scales=source.scales + np.float32(0.0078125))
    np.testing.assert_allclose(differences(source, decoded)["covariance"], np.expm1(2 * 0.0078125), rtol=1e-12)
    # An RMS beyond float64 is infinite.
    low, high = (make_model(9000, 0, scales=np.full((9000, 3), scale, np.float32)) for scale in (-88.0, 88.0))
    assert measure_pairs(low, high, np.arange(9000))["covariance"][1] == np.inf


@pytest.mark.parametrize(("source", "decoded", "clipped"), [
    (-1e6, 1e6, (-88, 88)), (90, 3e38, (1, 1)), (-1, 99, (-1, 88)),
])  # fmt: skip
def test_scales_beyond_float32_are_clipped_to_its_range(make_model, source, decoded, clipped):
    def error(*scales):
        pair = [make_model(1, 0, scales=np.full((1, 3), scale, np.float32)) for scale in scales]
        return [measure(*pair, np.zeros(1, int))["covariance"] for measure in (measure_pairs, measure_errors)]

    found, expected = error(source, decoded), error(*clipped)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_agrees_with_the_encoder_in_any_number_of_threads(make_model):
    source = make_model(9000, 3)
    rng = np.random.default_rng(2)
    index = rng.permutation(9000)[:8500]
    decoded = disturbed(source.select(index), rng)
    ours = measure_pairs(source, decoded, index, context=Context(threads=1))
    theirs = measure_errors(source, decoded, index)
    assert ours == measure_pairs(source, decoded, index, context=Context(threads=3))
    assert set(ours) == set(theirs)
    for name, pair in ours.items():
        assert pair == pytest.approx(theirs[name], rel=1e-5), name


def test_bands_that_one_model_lacks_are_zero_there(make_model):
    source = make_model(30, 2)
    decoded = replace(source, shN=np.ascontiguousarray(source.shN[:, :3]))
    errors = measure_pairs(source, decoded, np.arange(30))
    assert errors["sh1"] == (0.0, 0.0)
    assert errors["sh2"][0] == np.abs(source.shN[:, 3:]).max()


def test_invalid_source_indices_are_refused_in_blocks_of_any_size(make_model):
    model = make_model(5, 0)
    for index in (np.array([0, 1, 2, 3, 5]), np.array([-1, 0, 1, 2, 3]), np.arange(4), np.arange(5.0)):
        with pytest.raises(InputError, match="source index"):
            measure_pairs(model, model, index)
    for index, message in {
        (0, 1, 1): "splats 1 and 2 both have the source index 1",
        (2, 0, 2): "splats 0 and 2 both have the source index 2",
        (0, 1, 5): "splat 2 is 5",
    }.items():
        for block in (1, 2, 3):
            with pytest.raises(InputError, match=message):
                check_source_index(np.array(index), 5, 3, block=block)
