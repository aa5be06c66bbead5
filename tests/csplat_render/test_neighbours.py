# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours are those of a search through all pairs; points at one place are told apart by their rows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csplat_render.kernels import available_threads, thread_count
from csplat_render.neighbours import nearest_neighbours


def all_pairs(points, count, first=0):
    """Return what `nearest_neighbours` specifies, by comparing all pairs; rows are counted from `first`."""
    rows, places = np.full((len(points), count), -1), np.arange(len(points))
    distances = np.full(rows.shape, np.inf)
    for row, point in enumerate(points):
        squares = np.square(points - point)
        squares = squares[:, 0] + squares[:, 1] + squares[:, 2]
        order = np.lexsort((places, np.abs(places - row), squares))
        order = order[order != row][:count]
        rows[row, : len(order)], distances[row, : len(order)] = order + first, np.sqrt(squares[order])
    return rows, distances


CLOUDS = {
    "anywhere": lambda rng, count: rng.normal(size=(count, 3)),
    "far apart": lambda rng, count: rng.normal(size=(count, 3)) ** 9 * 1e30,
    "on a lattice": lambda rng, count: rng.integers(0, 4, (count, 3)).astype(float),
    "on a line": lambda rng, count: rng.normal(size=(count, 1)) * [1.0, 0.0, -2.0],
    "at two places": lambda rng, count: rng.integers(0, 2, (count, 1)) * np.ones(3),
}


@settings(max_examples=60)
@given(kind=st.sampled_from([*CLOUDS]), sizes=st.lists(st.integers(1, 150), min_size=1, max_size=4),
       count=st.integers(1, 20), seed=st.integers(0, 1000))  # fmt: skip
def test_neighbours_are_those_of_a_search_through_all_pairs(kind, sizes, count, seed):
    points = CLOUDS[kind](np.random.default_rng(seed), sum(sizes))
    starts = np.cumsum([0, *sizes])
    groups = [all_pairs(points[start : start + size], count, start) for start, size in zip(starts, sizes, strict=False)]
    for threads in (1, available_threads()):
        with thread_count(threads):
            found = nearest_neighbours(points, count, np.array(sizes))
        for expected, got in zip(zip(*groups, strict=True), found, strict=True):
            assert np.array_equal(np.concatenate(expected), got)


def test_no_points_have_no_neighbours():
    rows, distances = nearest_neighbours(np.zeros((0, 3)), 3)
    assert (0, 3) == rows.shape == distances.shape


@pytest.mark.slow
def test_many_points_at_one_place_are_searched_by_their_rows():
    rows, distances = nearest_neighbours(np.ones((100_000, 3)), 4)
    assert not distances.any()
    assert [[1, 2, 3, 4], [4, 6, 3, 7], [99_998, 99_997, 99_996, 99_995]] == rows[[0, 5, -1]].tolist()
