"""Tests of csplat_conformance.declared_bounds.partners."""

from dataclasses import replace

import numpy as np
import pytest
from checked import disturbed

from csplat_conformance.declared_bounds import Source
from csplat_conformance.declared_bounds.measurement import measure_pairs as measured
from csplat_conformance.declared_bounds.measurement import pair_differences as differences_of
from csplat_conformance.declared_bounds.partners import UNDECIDED, UNMATCHED
from csplat_conformance.declared_bounds.partners import find_partners as match_source


def differences(source, *rest):
    return differences_of(Source.of(source), *rest)


def match(source, *rest, **options):
    return match_source(Source.of(source), *rest, **options)


def measure_pairs(source, *rest, **options):
    """Return (max, rms) by measure."""
    return {name: found[:2] for name, found in measured(Source.of(source), *rest, **options).items()}


def bounds_of(source, decoded, index):
    return {name: pair[0] for name, pair in measure_pairs(source, decoded, index).items()}


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 1e-4, 0.1])
def test_finds_partners(make_model, sigma):
    source, count = make_model(1500, 1), 1500
    rng = np.random.default_rng(4)
    index = rng.permutation(count)
    decoded = disturbed(source.select(index), rng, sigma)
    bounds = bounds_of(source, decoded, index)
    found = match(source, decoded, bounds, np.full(count, sigma))
    assert (found >= 0).all()
    errors = differences(source, decoded, found, np.arange(count))
    assert all(np.abs(errors[name]).max() <= bounds[name] * (1 + 1e-9) + 1e-12 for name in bounds)
    # A radius that is too small only costs time.
    some = decoded.select(slice(0, 100))
    assert all((match(source, some, bounds, np.full(100, radius)) >= 0).all() for radius in (0.0, 1e-9))
    assert {UNMATCHED} == {*match(make_model(0, 1), some, bounds, np.zeros(100)).tolist()}


@pytest.mark.slow
@pytest.mark.parametrize("attribute", ["means", "scales", "opacities", "sh0", "shN"])
def test_a_splat_without_a_partner_is_reported(make_model, attribute):
    source = make_model(300, 1)
    decoded = disturbed(source, np.random.default_rng(6))
    bounds = bounds_of(source, decoded, np.arange(300))
    array = getattr(decoded, attribute).copy()
    array[17] = 0.5 * array[17] + 0.3
    found = match(source, replace(decoded, **{attribute: array}), bounds, np.full(300, 1e-3))
    assert list(np.flatnonzero(found == UNMATCHED)) == [17]


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
