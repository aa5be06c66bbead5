"""K-means finds near entries, the same at any thread count; a metric for each point refines them."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from csplat.encoder import kmeans
from csplat.encoder.kmeans import (
    assign,
    cluster,
    rank_by_frequency,
    reassign_by_metric,
    refine_by_metric,
    search_nearest,
)
from csplat.encoder.splat_importance import ErrorMetric
from csplat.errors import InputError


def blobs(count=3000, width=9, centres=40, spread=3.0, seed=0):
    rng = np.random.default_rng(seed)
    middle = rng.integers(-90, 91, (centres, width))
    noise = rng.normal(0, spread, (count, width))
    points = np.rint(middle[rng.integers(0, centres, count)] + noise).astype(np.int16)
    return points, rng.random(count).astype(np.float32)


def ones(points):
    return np.ones(len(points), np.float32)


def squared_distances(points, entries):
    difference = points[:, None].astype(np.int64) - entries[None].astype(np.int64)
    return (difference**2).sum(2)


def distortion(points, weights, entries, index):
    """Weighted mean of the squared distances of the points from their entries."""
    squares = ((points.astype(np.float64) - entries[index]) ** 2).sum(1)
    return float((squares * weights).sum() / weights.sum(dtype=np.float64))


# Nearest entries.


@pytest.mark.parametrize("entry_count", [1, 2, 300, kmeans._PRODUCT_COLUMNS + 3])
def test_assign_finds_the_first_nearest_entry(entry_count):
    rng = np.random.default_rng(1)
    points = rng.integers(-3, 4, (600, 4)).astype(np.int16)  # many equal distances
    entries = rng.integers(-3, 4, (entry_count, 4)).astype(np.int32)
    expected = squared_distances(points, entries)
    index, error = search_nearest(points, entries)
    assert index.dtype == np.uint32
    np.testing.assert_array_equal(expected.argmin(1), index)
    np.testing.assert_array_equal(expected.min(1), error)


def test_search_is_exact_just_below_the_bound():
    rng = np.random.default_rng(2)
    points = (rng.integers(0, 2, (500, 45)) * 690 - 345 + rng.integers(-2, 3, (500, 45))).astype(np.int16)
    entries = points[:100].astype(np.int32) + rng.integers(-1, 2, (100, 45)).astype(np.int32)
    assert kmeans._shift(points, entries) == 0
    expected = squared_distances(points, entries)
    index, error = search_nearest(points, entries)
    np.testing.assert_array_equal(expected.argmin(1), index)
    np.testing.assert_array_equal(expected.min(1), error)


@pytest.mark.parametrize("largest", [4000, 2**20, 2**31 - 1])
def test_shift_keeps_every_partial_sum_below_the_bound(largest):
    points = np.full((2, 45), largest, np.int32)
    points[1] = -largest - 1
    shift = kmeans._shift(points, points)
    small = kmeans._divide(points, shift)
    norm = float((small**2).sum(1).max())
    assert shift > 0
    assert norm * 1.5 < kmeans._EXACT
    assert kmeans._divide(points, shift - 1).max() ** 2 * 45 * 1.5 > kmeans._EXACT / 4


@pytest.mark.parametrize("entry_count", [2, 300])
def test_search_for_another_entry_skips_the_own_one(entry_count):
    points = np.random.default_rng(6).integers(-9, 10, (entry_count, 4)).astype(np.int32)
    points[-1] = points[0]
    assert_others_are_found(points, slice(None))


def test_search_for_another_entry_skips_the_own_one_in_a_second_block_of_columns():
    points = np.random.default_rng(6).integers(-9, 10, (kmeans._PRODUCT_COLUMNS + 3, 4)).astype(np.int32)
    points[-1] = points[0]
    assert_others_are_found(points, np.r_[0:50, kmeans._PRODUCT_COLUMNS - 50 : len(points)])


def assert_others_are_found(points, rows):
    """Compare what is found for some of the points with a search in the matrix of all distances."""
    expected = squared_distances(points[rows], points)
    expected[np.arange(len(expected)), np.arange(len(points))[rows]] = 10**6
    index, error = search_nearest(points, points, other=True)
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


def test_searching_near_groups_loses_less_than_two_per_cent():
    points, _ = blobs(4000, 12, 900, 8.0)
    entries = points[:1024].astype(np.int32)
    exact, near = search_nearest(points, entries), search_nearest(points, entries, near_groups=8)
    assert np.all(near[1] >= exact[1])
    assert near[1].sum() <= 1.02 * exact[1].sum()
    found = squared_distances(points[:500], entries)[np.arange(500), near[0][:500]]
    np.testing.assert_array_equal(found, near[1][:500])


def test_searching_all_groups_is_the_full_search():
    points, _ = blobs()
    entries = points[:100].astype(np.int32)
    np.testing.assert_array_equal(
        search_nearest(points, entries)[1], search_nearest(points, entries, near_groups=10)[1]
    )


def test_assign_gives_no_index_for_no_points():
    assert assign(np.empty((0, 3), np.int16), np.zeros((1, 3), np.int32)).shape == (0,)


# Clusters.


def check_clusters(points, entries, index, size):
    assert entries.dtype == np.int32
    assert index.dtype == np.uint32
    assert len(index) == len(points)
    assert len(entries) <= size
    assert len(np.unique(entries, axis=0)) == len(entries)
    np.testing.assert_array_equal(np.arange(len(entries)), np.unique(index))


@pytest.mark.parametrize("near_groups", [0, 5])
@pytest.mark.parametrize("dtype", [np.int16, np.int32])
def test_clusters_are_distinct_used_and_close(dtype, near_groups):
    points, weights = blobs()
    points = points.astype(dtype)
    entries, index = cluster(points, weights, 40, seed=0, iterations=6, near_groups=near_groups)
    check_clusters(points, entries, index, 40)
    assert len(entries) == 40
    assert distortion(points, weights, entries, index) < 2.0 * 9 * 3.0**2


def test_more_iterations_and_entries_lower_the_distortion():
    points, weights = blobs(spread=30.0)

    def run(size, iterations):
        found = cluster(points, weights, size, seed=0, iterations=iterations)
        return distortion(points, weights, *found)

    assert run(64, 10) < run(64, 0)
    assert run(256, 4) < 0.9 * run(64, 4)


def test_first_entries_beat_uniform_ones():
    points, _ = blobs(6000, 9, 200, 2.0)
    points[:4000] = points[0] + np.random.default_rng(4).integers(-2, 3, (4000, 9))
    uniform = points[np.random.default_rng(5).choice(6000, 200, replace=False)].astype(np.int32)
    entries, index = cluster(points, ones(points), 200, seed=0, iterations=0)
    found = distortion(points, ones(points), entries, index)
    assert found < 0.5 * distortion(points, ones(points), uniform, assign(points, uniform))


def test_heavy_points_keep_their_values():
    points, _ = blobs(5000, 6, 500, 20.0)
    weights = np.full(5000, 1e-12, np.float32)
    heavy = np.arange(0, 5000, 250)
    weights[heavy] = 1e6
    entries, index = cluster(points, weights, 64, seed=0, iterations=4, sample_per_entry=8)
    check_clusters(points, entries, index, 64)
    np.testing.assert_array_equal(points[heavy], entries[index[heavy]])


def test_weights_matter_by_ratio_only():
    points, weights = blobs()
    first = cluster(points, weights, 30, seed=0, iterations=3)
    second = cluster(points, weights * np.float32(2**-40), 30, seed=0, iterations=3)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_weights_of_zero_alone_mean_equal_weights():
    points, _ = blobs()
    first = cluster(points, ones(points), 30, seed=0, iterations=3)
    second = cluster(points, 0 * ones(points), 30, seed=0, iterations=3)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


@pytest.mark.parametrize("positive", [0, 1, 5, 20])
def test_few_positive_weights_leave_no_unused_entry(positive):
    points, _ = blobs(500)
    weights = np.zeros(500, np.float32)
    weights[:positive] = 2.0
    entries, index = cluster(points, weights, 16, seed=0, iterations=3, sample_per_entry=2)
    check_clusters(points, entries, index, 16)


@pytest.mark.parametrize("count", [0, 1, 7, 16])
def test_fewer_points_than_entries_are_kept_exactly(count):
    points = blobs(16)[0][:count]
    entries, index = cluster(points, ones(points), 16, seed=0, iterations=3)
    check_clusters(points, entries, index, 16)
    np.testing.assert_array_equal(points, entries[index])


@pytest.mark.parametrize("value_count", [1, 2, 10])
@pytest.mark.parametrize("near_groups", [0, 2])
def test_fewer_values_than_entries_are_kept_exactly(value_count, near_groups):
    values = blobs(value_count, 5)[0]
    points = values[np.arange(900) % value_count]
    entries, index = cluster(points, ones(points), 32, seed=0, iterations=3, near_groups=near_groups)
    check_clusters(points, entries, index, 32)
    assert len(entries) == value_count
    np.testing.assert_array_equal(points, entries[index])


def test_points_beyond_the_exact_norm_are_clustered_on_a_coarser_lattice():
    points, weights = blobs(2000, 9, 30, 2.0)
    large = points.astype(np.int32) * 1000
    entries, index = cluster(large, weights, 30, seed=0, iterations=5)
    check_clusters(large, entries, index, 30)
    assert distortion(large, weights, entries, index) < 2.0 * 9 * 2000.0**2


def test_progress_counts_to_the_end():
    points, weights = blobs(500)
    calls = []
    cluster(points, weights, 8, seed=0, iterations=3, progress=lambda done, of: calls.append((done, of)))
    assert [(i, 5) for i in range(1, 6)] == calls


def test_rejects_what_is_out_of_range():
    points, weights = blobs(50)
    for bad in (weights[:-1], -weights, weights * np.inf, weights * np.nan):
        with pytest.raises(InputError, match="weights"):
            cluster(points, bad, 8, seed=0, iterations=1)
    for bad in (points.astype(np.float32), points[0], points[:, :0]):
        with pytest.raises(InputError, match="points"):
            cluster(bad, weights, 8, seed=0, iterations=1)
    with pytest.raises(InputError, match="size"):
        cluster(points, weights, 0, seed=0, iterations=1)
    with pytest.raises(InputError, match="no entries"):
        assign(points, np.empty((0, 9), np.int32))
    with pytest.raises(InputError, match="entries"):
        assign(points, np.empty((4, 8), np.int32))


# Ranks.


def test_ranks_follow_frequency_and_keep_the_order_of_equals():
    index = np.array([3, 3, 1, 0, 1, 2, 3], np.uint32)
    entries = np.array([[10], [11], [12], [13], [14]], np.int32)
    ranked, ordered = rank_by_frequency(index, entries)
    assert [0, 0, 1, 2, 1, 3, 0] == ranked.tolist()
    assert [13, 11, 10, 12, 14] == ordered.ravel().tolist()
    assert ranked.dtype == np.uint32
    np.testing.assert_array_equal(entries[index], ordered[ranked])


# The same bytes at any thread count.


def digest(threads=None):
    """SHA-256 over clusters of two kinds of search; also run by the subprocess below."""
    points, weights = blobs(1500, 45, 150, 12.0)
    state = hashlib.sha256()
    for near_groups, scale in ((0, 1), (6, 1), (0, 300)):
        scaled = points.astype(np.int32) * scale
        entries, index = cluster(scaled, weights, 100, seed=7, iterations=3, near_groups=near_groups, threads=threads)
        state.update(entries.tobytes() + index.tobytes())
    return state.hexdigest()


@pytest.mark.slow
def test_neither_our_threads_nor_those_of_blas_change_the_bytes():
    program = (
        "import runpy, sys; from csplat.encoder import kmeans\n"
        f"digest = runpy.run_path({__file__!r})['digest']\n"
        "print(digest())\n"
        "kmeans._openblas = lambda: None  # its threads cannot be set\n"
        "print(digest())"
    )
    run = subprocess.run(
        [sys.executable, "-c", program],
        env={
            **os.environ,
            "OPENBLAS_NUM_THREADS": "2",
            "OMP_NUM_THREADS": "2",
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        },
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    expected = digest(1)
    assert expected == digest(2) == digest(5)
    assert [expected, expected] == run.stdout.split()


@pytest.mark.slow
def test_blas_keeps_its_own_thread_count():
    control = kmeans._openblas()
    if control is None:
        pytest.skip("NumPy's BLAS here is not an OpenBLAS whose threads can be set")
    before = control[0]()
    with kmeans.one_blas_thread():
        assert control[0]() == 1
    assert control[0]() == before


def scene(count=400, size=3, channels=2, entry_count=30, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 40, (count, size, channels))
    roots = rng.normal(size=(count, size, size))
    matrices = roots @ roots.transpose(0, 2, 1)
    rows, columns = np.triu_indices(size)
    metric = ErrorMetric(rng.random(count).astype(np.float32), matrices[:, rows, columns].astype(np.float32))
    entries = np.rint(points[:entry_count]).astype(np.int32)
    return points, matrices, metric, entries


def exact(difference, matrices, weights):
    return np.einsum("nic,nij,njc->n", difference, matrices, difference) * weights


def test_errors_are_those_of_the_matrices():
    points, matrices, metric, _ = scene()
    np.testing.assert_allclose(exact(points, matrices, metric.weights), metric.errors(points, slice(None)), rtol=1e-5)
    rows = np.array([5, 3, 3])
    expected = exact(points[rows], matrices[rows], metric.weights[rows])
    np.testing.assert_allclose(expected, metric.errors(points[rows], rows), rtol=1e-5)


def test_the_first_parts_keep_their_matrices():
    points, matrices, metric, _ = scene()
    expected = exact(points[:, :2], matrices[:, :2, :2], metric.weights)
    np.testing.assert_allclose(expected, metric.first(2).errors(points[:, :2], slice(None)), rtol=1e-5)


def test_reassign_finds_the_best_where_all_are_tried():
    points, matrices, metric, entries = scene()
    errors = np.stack([exact(points - entry, matrices, np.ones(len(points))) for entry in entries], axis=1)
    found = reassign_by_metric(points, metric, entries, np.zeros(len(points), np.int64), 2, tried=len(entries))
    np.testing.assert_allclose(errors.min(axis=1), errors[np.arange(len(points)), found], rtol=1e-4)


def test_refine_makes_errors_smaller_and_leaves_no_dead_entry():
    points, _, metric, entries = scene()
    start = np.linalg.norm((points[:, None] - entries).reshape(len(points), len(entries), -1), axis=2).argmin(axis=1)
    moved, index = refine_by_metric(points, metric, entries, start, 1)
    before = metric.errors(points - entries[start], slice(None)).sum()
    assert metric.errors(points - moved[index], slice(None)).sum() < 0.8 * before
    assert set(range(len(moved))) == set(index.tolist())
    assert len(moved) == len(np.unique(moved.reshape(len(moved), -1), axis=0))


def test_does_not_depend_on_threads():
    points, _, metric, entries = scene(3000, 5, 3, 200)
    start = np.zeros(len(points), np.int64)
    one, two = (refine_by_metric(points, metric, entries, start, threads) for threads in (1, 2))
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])


def test_entries_stay_where_their_points_weigh_nothing():
    points, _, metric, entries = scene(50, 2, 1, 5)
    silent = ErrorMetric(np.zeros(50, np.float32), np.zeros_like(metric.triangles))
    moved, _ = refine_by_metric(points, silent, entries, np.arange(50) % 5, 1)
    assert {tuple(row) for row in moved.reshape(len(moved), -1)} <= {tuple(row) for row in entries.reshape(5, -1)}
