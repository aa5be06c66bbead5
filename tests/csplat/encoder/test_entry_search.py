# SPDX-License-Identifier: Apache-2.0
"""Searches find the nearest entries, the first of several, in all groups or in near ones."""

from __future__ import annotations

import numpy as np
import pytest

from csplat.context import Context
from csplat.encoder import entry_search
from csplat.encoder.entry_search import EntrySearch, largest_norm, search_nearest
from csplat.encoder.kmeans import assign


def squared_distances(points, entries):
    difference = points[:, None].astype(np.int64) - entries[None].astype(np.int64)
    return (difference**2).sum(2)


def test_search_finds_the_first_nearest_entry():
    rng = np.random.default_rng(1)
    many = rng.integers(-3, 4, (200, 4)).astype(np.int16)  # many equal distances
    sizes = (1, 2, 300, entry_search._PRODUCT_COLUMNS + 3)
    cases = [(many, rng.integers(-3, 4, (entry_count, 4)).astype(np.int32)) for entry_count in sizes]
    wide = (rng.integers(0, 2, (500, 45)) * 690 - 345 + rng.integers(-2, 3, (500, 45))).astype(np.int16)
    cases.append((wide, wide[:100].astype(np.int32) + rng.integers(-1, 2, (100, 45)).astype(np.int32)))
    assert EntrySearch.of(cases[-1][1], 0, largest_norm(wide)).shift == 0  # just below the bound of exact products
    for points, entries in cases:
        expected, (index, error) = squared_distances(points, entries), search_nearest(points, entries)
        assert index.dtype == np.uint32
        np.testing.assert_array_equal(expected.argmin(1), index)
        np.testing.assert_array_equal(expected.min(1), error)
    assert assign(np.empty((0, 3), np.int16), np.zeros((1, 3), np.int32)).shape == (0,)


def test_search_for_another_entry_skips_the_own_one():
    for entry_count in (2, 300, entry_search._PRODUCT_COLUMNS + 3):  # the last has a second block of columns
        points = np.random.default_rng(6).integers(-9, 10, (entry_count, 4)).astype(np.int32)
        points[-1] = points[0]
        rows = np.unique(np.r_[0 : min(100, entry_count), max(0, entry_count - 53) : entry_count])
        expected = squared_distances(points[rows], points)
        expected[np.arange(len(rows)), rows] = 10**6
        index, error = search_nearest(points, points, exclude_own=True)
        np.testing.assert_array_equal(expected.argmin(1), index[rows])
        np.testing.assert_array_equal(expected.min(1), error[rows])


def test_large_points_are_assigned_to_nearly_nearest_entries():
    rng = np.random.default_rng(3)
    points = rng.integers(-30000, 30000, (800, 5)).astype(np.int16)
    entries = rng.integers(-30000, 30000, (50, 5)).astype(np.int32)
    exact = squared_distances(points, entries)
    found = exact[np.arange(800), assign(points, entries)]
    assert np.sqrt(found).max() > 10000
    assert np.all(np.sqrt(found) <= np.sqrt(exact.min(1)) + 60 * np.sqrt(5))


@pytest.mark.slow
def test_searching_near_groups_loses_less_than_two_per_cent_and_all_groups_nothing():
    rng = np.random.default_rng(0)
    middle = rng.integers(-90, 91, (300, 12))
    points = np.rint(middle[rng.integers(0, 300, 1000)] + rng.normal(0, 8.0, (1000, 12))).astype(np.int16)
    entries = points[:400].astype(np.int32)
    (_, exact), (index, error) = search_nearest(points, entries), search_nearest(points, entries, near_groups=5)
    assert np.all(error >= exact)
    assert error.sum() <= 1.02 * exact.sum()
    np.testing.assert_array_equal(squared_distances(points, entries)[np.arange(1000), index], error)
    np.testing.assert_array_equal(exact, search_nearest(points, entries, near_groups=20)[1])


@pytest.mark.slow
def test_the_thread_count_of_blas_is_restored():
    control = entry_search._openblas()
    if control is None:
        pytest.skip("NumPy's BLAS here is not an OpenBLAS whose threads can be set")
    before = control[0]()
    with entry_search.one_blas_thread():
        assert control[0]() == 1
    assert control[0]() == before


def test_few_entries_are_one_group():
    entries = np.arange(40, dtype=np.int32).reshape(20, 2)
    assert EntrySearch.of(entries, 4, 60.0).centres is None
    assert len(EntrySearch.of(entries, 3, 60.0).ends) == 5
    points = np.full((3, 2), 7, np.int16)
    assert [3, 3, 3] == EntrySearch.of(entries, 9, 60.0).nearest(points, Context(threads=1))[0].tolist()
