# SPDX-License-Identifier: Apache-2.0
"""The compiled search for entries finds what the search in NumPy finds, ties and extremes included."""

import numpy as np
import pytest

from csplat.context import Context
from csplat.encoder.entry_search import EntrySearch, largest_norm, search_in_numpy
from csplat_render.nearest_entries import compiled_search, nearest_entries

rng = np.random.default_rng(2)


def integers(low, high, *shape):
    return rng.integers(low, high + 1, shape).astype(np.int16)


def alternating(count, width, size):
    return (np.where(integers(0, 1, count, width), size, -size)).astype(np.int16)


#: name: points, entries, groups that are searched
CASES = {
    "ties": (integers(-2, 2, 700, 4), integers(-2, 2, 300, 4), 3),
    "ties of centres": (integers(-1, 1, 500, 3), integers(-1, 1, 900, 3), 5),
    "one entry": (integers(-90, 90, 40, 7), integers(-90, 90, 1, 7), 0),
    "one point": (integers(-90, 90, 1, 45), integers(-90, 90, 400, 45), 4),
    "no points": (integers(0, 0, 0, 45), integers(-90, 90, 400, 45), 4),
    "one coordinate": (integers(-400, 400, 5000, 1), integers(-400, 400, 257, 1), 2),
    "one run and a point": (integers(-40, 40, 4097, 45), integers(-40, 40, 500, 45), 4),
    "large norms": (alternating(300, 45, 345), alternating(90, 45, 345), 2),
    "the largest points": (alternating(300, 45, 32767), integers(-5, 5, 90, 45), 2),
    "the smallest coordinate": (np.full((9, 2), -32768, np.int16), integers(-80, 80, 30, 2), 0),
    "equal entries": (integers(-9, 9, 200, 6), np.repeat(integers(-9, 9, 40, 6), 5, axis=0), 2),
    "all groups but one": (integers(-30, 30, 300, 9), integers(-30, 30, 150, 9), 11),
}


@pytest.mark.parametrize("case", CASES)
def test_finds_what_numpy_finds(case):
    points, entries, near = CASES[case]
    search = EntrySearch.of(entries.astype(np.int32), near, largest_norm(points))
    assert search.shift == 0
    starts = [np.full(len(points), -1, np.int32), integers(0, len(entries) - 1, len(points)).astype(np.int32)]
    owns = [None, integers(-1, len(entries) - 1, len(points)).astype(np.int32)]
    compiled = [search.entries.astype(np.int16), search.ends, search.centres, search.near]
    if search.centres is not None:
        compiled[2] = search.centres.astype(np.int16)
    for start in starts:
        for own in owns:
            expected, found = start.copy(), start.copy()
            distances = search_in_numpy(
                points, search.entries, search.ends, search.centres, search.near, expected, own, Context(threads=1)
            )
            for threads in (1, 2):
                found[:] = start
                assert np.array_equal(distances, nearest_entries(points, *compiled, found, own, threads=threads))
                assert np.array_equal(expected, found)


def test_a_point_whose_groups_are_empty_finds_nothing():
    points, entries = integers(5, 9, 20, 3), integers(-9, -5, 8, 3)
    centres = np.array([[-7, -7, -7], [7, 7, 7]], np.int16)
    found = np.full(20, -1, np.int32)
    squared = nearest_entries(points, entries, np.array([0, 8, 8]), centres, 1, found, None, threads=1)
    assert np.isinf(squared).all()
    assert (found == -1).all()
    assert compiled_search() is nearest_entries
