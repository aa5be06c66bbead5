"""Errors under a matrix of each point's own; the nearest of the entries near by; entries that solve their sums."""

import numpy as np

from csplat.encoder.kmeans import reassign_by_metric, refine_by_metric
from csplat.encoder.weights import ErrorMetric


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
