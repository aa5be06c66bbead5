# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.declared_bounds.partners."""

from dataclasses import replace

import numpy as np
import pytest
from checked import disturbed

from csplat_conformance.declared_bounds import Source, measurement, partners
from csplat_conformance.declared_bounds.partners import UNDECIDED, UNMATCHED


def match(source, *rest, **options):
    return partners.find_partners(Source.of(source), *rest, **options)


def bounds_of(source, decoded, index):
    return {name: pair.max for name, pair in measurement.measure_pairs(Source.of(source), decoded, index).items()}


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 1e-4, 0.1])
def test_finds_partners(make_model, sigma):
    source, count, rng = make_model(1000, 1), 1000, np.random.default_rng(4)
    index = rng.permutation(count)
    decoded = disturbed(source.select(index), rng, sigma)
    bounds = bounds_of(source, decoded, index)
    found = match(source, decoded, bounds, np.full(count, sigma))
    assert (found >= 0).all()
    errors = measurement.pair_differences(Source.of(source), decoded, found, np.arange(count))
    assert all(np.abs(errors[name]).max() <= bounds[name] * (1 + 1e-9) + 1e-12 for name in bounds)
    # A radius that is too small only costs time.
    some = decoded.select(slice(0, 100))
    assert all((match(source, some, bounds, np.full(100, radius)) >= 0).all() for radius in (0.0, 1e-9))
    assert {UNMATCHED} == {*match(make_model(0, 1), some, bounds, np.zeros(100)).tolist()}


@pytest.mark.slow
def test_a_splat_without_a_partner_is_reported(make_model):
    source = make_model(300, 1)
    decoded = disturbed(source, np.random.default_rng(6))
    bounds = bounds_of(source, decoded, np.arange(300))
    for attribute in ("means", "scales", "opacities", "sh0", "shN"):
        array = getattr(decoded, attribute).copy()
        array[17] = 0.5 * array[17] + 0.3
        found = match(source, replace(decoded, **{attribute: array}), bounds, np.full(300, 1e-3))
        assert [17] == np.flatnonzero(found == UNMATCHED).tolist(), attribute


def test_coordinates_of_all_magnitudes_find_partners(make_model):
    means = np.array([[1e30, 0, 0], [1e-30, 0, 0], [0, -1e7, 1e7], [0, 0, 0], [1e-45, 1, 1]], np.float32)
    source = make_model(5, 0, means=means)
    bounds = bounds_of(source, source, np.arange(5))
    assert list(match(source, source, bounds, np.zeros(5))) == list(range(5))
    assert list(match(source, source, {**bounds, "means": 1e-3}, np.full(5, 1e-30))) == [0, 1, 2, 3, 4]


def test_the_search_gives_up_on_equal_splats(make_model):
    count = 120
    ones = {
        "quats": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        "opacities": np.ones(count, np.float32),
        **dict.fromkeys(("means", "scales", "sh0"), np.zeros((count, 3), np.float32)),
    }
    source = make_model(count, 1, **ones)
    decoded = replace(source, shN=source.shN[::-1].copy())
    bounds = bounds_of(source, source, np.arange(count))
    assert (match(source, decoded, bounds, np.zeros(count)) == np.arange(count)[::-1]).all()
    found = match(source, decoded, bounds, np.zeros(count), candidates_max=20)
    assert set(found[found < 0]) == {UNDECIDED}
