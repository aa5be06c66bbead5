# SPDX-License-Identifier: Apache-2.0
"""Cluster lattice integers by weighted k-means, with the same result for any number of threads.

Assignments are exact (`entry_search.py`). Centroids are float64 sums in the order of the points, rounded to integers.
All random numbers come from one seeded generator.

`refine_by_metric` continues the iteration if every point x has its own error metric w Σ_channels (x - c)ᵀ M (x - c).
The candidates of a point are the neighbours of its entry; centroids solve the normal equations of their points.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder.entry_search import NEXT_GROUPS, one_blas_thread, search_nearest
from csplat.encoder.splat_importance import ErrorMetric, doubled_triangles, matrix_products
from csplat.errors import InputError
from csplat.types import F32, F64, I16, I32, I64, U32

Floats = NDArray[Any]

_SEED_ROUNDS = (8, 2)  # rounds in which the initial entries are drawn, for few points and for many
_FEW_POINTS = 1 << 14  # for more, 8 rounds lower the error by 0.3 %; for a few hundred extreme points, by up to 40 %
_REFINED_POINTS = 1 << 16  # minimum number of points of the last iteration, unless there are fewer
_REFINED_PER_ENTRY = 64  # the same, per entry
_CANDIDATES = 96  # candidates for a point: its entry and the nearest neighbours of this entry
_REFINE_ROUNDS = 2  # iterations under the metric
_METRIC_BLOCK = 1 << 12  # points per block of temporaries
_NEIGHBOUR_BLOCK = 256  # entries whose distances to all entries are in memory at a time
_RIDGE = 1e-3  # fraction of the mean diagonal; keeps an entry in place along directions its points do not determine


def cluster(
    points: I16 | I32,
    weights: F32,
    size: int,
    *,
    iterations: int = 8,
    sample_per_entry: int = 24,
    near_groups: int = 0,
    context: Context = DEFAULT_CONTEXT,
) -> tuple[I32, U32]:
    """Train a codebook of at most `size` entries, and assign the points to it.

    Iterates on a weighted sample, and once on a larger one. Takes memory for the samples and 40 bytes per point.

    Args:
        points: [N, D], lattice integers. Clip outliers first: if a norm exceeds about 2,300, all points are assigned
            on a coarser lattice.
        weights: [N], finite and >= 0. Only ratios matter. If all are zero, all points weigh the same.
        size: maximum number of entries, > 0.
        iterations: k-means iterations on the sample.
        sample_per_entry: points of the sample per entry, > 0.
        near_groups: see `assign`; once a point has an entry, `NEXT_GROUPS` groups are searched for a nearer entry.
        context: threads, progress, and the seed of the sample and of the initial entries.

    Returns:
        entries [K, D] int32, K <= size, distinct and used, in arbitrary order; index [N] uint32, the entry of each
        point.

    Raises:
        InputError: a shape, dtype, weight or number is outside these ranges.
    """
    w = _check_points(points, weights)
    if min(size, sample_per_entry) <= 0 or min(iterations, near_groups) < 0:
        raise InputError("cluster: size and sample_per_entry must be > 0, other numbers >= 0")
    if len(points) <= size:
        return _distinct(points)
    rng = np.random.default_rng(context.seed)
    rows, sample_w = _priority_sample(w, size * sample_per_entry, rng)
    sample = points[rows]
    entries = _first_entries(sample, sample_w, size, rng, near_groups, context)
    index: U32 | None = None
    for step in range(iterations + 1):
        # A quarter of the entries may move at first, half as many after each quarter of the iterations, none at last.
        moves_max = size >> (2 + 4 * step // iterations) if step < iterations else 0
        if step == iterations and len(sample) < len(points):
            rows, sample_w = _priority_sample(w, max(_REFINED_POINTS, size * _REFINED_PER_ENTRY), rng)
            sample, index = points[rows], None
        index, error = search_nearest(sample, entries, near_groups, context, start=index)
        entries = _move_to_means(sample, sample_w, index, entries)
        _relocate(entries, index, sample, sample_w, error, moves_max, min(near_groups, NEXT_GROUPS), rng, context)
        context.progress("codebook", (step + 1) / (iterations + 2))
    is_sample = len(sample) < len(points)
    index = search_nearest(points, entries, near_groups, context, start=None if is_sample else index)[0]
    entries = entries if is_sample else _move_to_means(points, w, index, entries)
    context.progress("codebook", 1.0)
    distinct, merged = _distinct(entries)
    return _drop_unused(distinct, merged[index])


def assign(points: I16 | I32, entries: I32, *, near_groups: int = 0, context: Context = DEFAULT_CONTEXT) -> U32:
    """Assign each point to the nearest entry, the first of several at equal distance.

    Args:
        points: [N, D], lattice integers.
        entries: [K, D], K > 0.
        near_groups: 0 searches every entry. Otherwise entries are clustered into about sqrt(K) groups, and this number
            of groups with the nearest centroids is searched: faster for thousands of entries, but approximate.
        context: threads.

    Returns:
        [N] uint32, indices of entries.

    Raises:
        InputError: a shape or dtype is wrong.
    """
    _check_points(points, None)
    if entries.ndim != 2 or entries.dtype != np.int32 or entries.shape[1] != points.shape[1]:
        raise InputError(f"assign: entries {entries.dtype} {entries.shape}, points {points.shape}")
    if not len(entries):
        raise InputError("assign: no entries")
    return search_nearest(points, entries, near_groups, context)[0]


def rank_by_frequency(index: U32, entries: I32) -> tuple[U32, I32]:
    """Sort entries [K, D] by descending frequency in `index` [N], stably; return the new index and entries."""
    count = np.bincount(index, minlength=len(entries))
    order = np.argsort(-count, kind="stable")
    rank = np.empty(len(entries), np.uint32)
    rank[order] = np.arange(len(entries), dtype=np.uint32)
    return rank[index], entries[order]


@one_blas_thread()
def reassign_by_metric(
    points: Floats, metric: ErrorMetric, entries: Floats, index: I64, context: Context, candidates: int
) -> I64:
    """Assign each point to the entry with the least error among the neighbours of its present entry.

    With w xᵀ M x constant and w a factor, the error of an entry c is
        Σ_channels cᵀ M c - 2 cᵀ (M x),
    the product of the features [M x, upper triangle of M, off-diagonals doubled] and the table [-2 c, Σ c_i c_j].

    Args:
        points: [N, D, C].
        metric: metric of the points.
        entries: [K, D, C].
        index: [N], the present entry of each point.
        context: threads.
        candidates: number of entries compared: the present entry and its nearest neighbours.

    Returns:
        The new index, [N].
    """
    near = _neighbours(entries, candidates)
    size, channels = entries.shape[1:]
    upper_i, upper_j = np.triu_indices(size)
    wide = entries.astype(np.float64)
    squares = np.einsum("kpc,kpc->kp", wide[:, upper_i], wide[:, upper_j])
    table = np.concatenate([-2.0 * wide.reshape(len(wide), -1), squares], axis=1)
    order = np.argsort(index, kind="stable")
    ends = np.searchsorted(index[order], np.arange(len(entries) + 1))
    best = index.copy()

    def work(groups: Sequence[int]) -> None:
        for group in groups:
            rows = order[ends[group] : ends[group + 1]]
            if not len(rows):
                continue
            triangles = metric.triangles[rows]
            features = np.empty((len(rows), table.shape[1]))
            features[:, : size * channels] = matrix_products(triangles, points[rows]).reshape(len(rows), -1)
            features[:, size * channels :] = doubled_triangles(triangles)
            best[rows] = near[group, (features @ table[near[group]].T).argmin(axis=1)]

    threads = context.thread_count
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, [range(start, len(entries), threads) for start in range(threads)]))
    return best


@one_blas_thread()
def refine_by_metric(
    points: Floats, metric: ErrorMetric, entries: I32, index: I64, context: Context
) -> tuple[I32, I64]:
    """Iterate assignment and centroids under the metric.

    Args:
        points: [N, D, C], in lattice steps.
        metric: metric of the points.
        entries: [K, D, C], lattice integers.
        index: [N], the entry of each point.
        context: threads.

    Returns:
        entries [K', D, C], distinct and used; index [N].
    """
    for _ in range(_REFINE_ROUNDS):
        index = reassign_by_metric(points, metric, entries, index, context, _CANDIDATES)
        entries = _solve_entries(points, metric, entries, index)
    index = reassign_by_metric(points, metric, entries, index, context, _CANDIDATES)
    flat, inverse = np.unique(entries.reshape(len(entries), -1), axis=0, return_inverse=True)
    index = inverse.reshape(-1)[index]
    used, index = np.unique(index, return_inverse=True)
    return flat[used].reshape(-1, *entries.shape[1:]), index.reshape(-1)


def _check_points(points: I16 | I32, weights: F32 | None) -> F64:
    """Check points and weights; return the weights, [N] float64, all 1 if all are 0, empty for `None`.

    Raises:
        InputError: the points are not int16 or int32 [N, D], or the weights not [N], finite and >= 0.
    """
    if points.ndim != 2 or not points.shape[1] or points.dtype not in (np.int16, np.int32):
        actual = f"{points.dtype} {points.shape}"
        raise InputError(f"k-means: points are int16 or int32 [N, D], found {actual}")
    if weights is None:
        return np.empty(0)
    if weights.shape != points.shape[:1] or not np.all((weights >= 0) & (weights < np.inf)):
        actual = f"{weights.shape} for {len(points)} points"
        raise InputError(f"k-means: weights are [N], finite and >= 0, found {actual}")
    return weights.astype(np.float64) if weights.any() else np.ones(len(points))


def _priority_sample(w: F64, count: int, rng: np.random.Generator) -> tuple[I64, F64]:
    """Draw a sample of rows by weights w [N]; return the rows, and weights whose sums are unbiased.

    With uniform u, the rows with the largest priorities w / u are kept, and each counts max(w, τ), where τ is the
    largest priority left out (Duffield, Lund, Thorup, "Priority sampling for estimation of arbitrary subset sums").
    """
    if count >= len(w):
        return np.arange(len(w)), w
    keys = w / (1.0 - rng.random(len(w)))
    rows = _largest(keys, count + 1)
    threshold = float(keys[rows].min())
    rows = rows[keys[rows] > threshold] if threshold > 0 else rows[keys[rows] > 0]
    return rows, np.maximum(w[rows], threshold)


def _largest(keys: F64, count: int) -> I64:
    """Return the rows of the `count` largest keys [N], ascending."""
    limit = np.partition(keys, len(keys) - count)[len(keys) - count]
    rows = np.flatnonzero(keys >= limit)
    same = np.flatnonzero(keys[rows] == limit)  # `argpartition` would choose others of these on other processors
    return np.delete(rows, same[: len(rows) - count])


def _draw_rows(importance: F64, count: int, rng: np.random.Generator) -> I64:
    """Draw up to `count` distinct rows, with a probability that grows with their importance, [N]."""
    count = min(count, int(np.count_nonzero(importance)))
    if count == 0:
        return np.empty(0, np.int64)
    return _largest(importance / (1.0 - rng.random(len(importance))), count)


def _first_entries(sample: I16 | I32, w: F64, size: int, rng: np.random.Generator, near: int, context: Context) -> I32:
    """Draw initial entries, [size, D], from a sample [n, D] with weights w [n]; fewer if fewer points have w d² > 0.

    Rounds draw with a probability that grows with w d², d being the distance to earlier draws (Bahmani et al.,
    "Scalable k-means++", but with exactly `size` points); `near` is the number of groups searched for it, 0 for all.
    """
    error = np.ones(len(sample))
    entries = np.empty((0, sample.shape[1]), np.int32)
    few_rounds, many_rounds = _SEED_ROUNDS
    rounds = few_rounds if len(sample) <= _FEW_POINTS else many_rounds
    for done in range(1, rounds + 1):
        new = sample[_draw_rows(w * error, size * done // rounds - len(entries), rng)]
        entries = np.concatenate([entries, new.astype(np.int32)])
        if len(new) and done < rounds:
            distance = search_nearest(sample, new.astype(np.int32), near, context)[1]
            error = np.minimum(error, distance) if len(entries) > len(new) else distance
    return entries


def _move_to_means(points: I16 | I32, w: F64, index: U32, entries: I32) -> I32:
    """Move each entry [K, D] to the centroid of its points [N, D], rounded; entries without weight stay."""
    where = index.astype(np.int64)
    total = np.bincount(where, w, len(entries))
    moved = entries.copy()
    used = total > 0
    for d in range(points.shape[1]):
        sums = np.bincount(where, w * points[:, d], len(entries))
        moved[used, d] = np.rint(sums[used] / total[used])
    return moved


def _relocate(
    entries: I32,
    index: U32,
    points: I16 | I32,
    w: F64,
    error: F64,
    moves_max: int,
    near_groups: int,
    rng: np.random.Generator,
    context: Context,
) -> None:
    """Move the cheapest entries, and all without weight, into the clusters with the largest errors, in place.

    K-means alone never moves an entry between distant clusters (Patanè and Russo, "The enhanced LBG algorithm"). Giving
    up an entry costs about its weight times the squared distance to its nearest neighbour; splitting a cluster saves
    about half of its error.

    Args:
        entries: [K, D], changed in place.
        index: [N], the entry of each point, not changed.
        points: [N, D].
        w: [N], weights of the points.
        error: [N], squared distance of each point to its entry.
        moves_max: maximum number of entries to move, unless more have no weight; 0 moves only those without weight.
        near_groups: groups searched for the nearest neighbour of an entry, 0 for all.
        rng: draws the point of a cluster to which an entry moves.
        context: threads.
    """
    weight = np.bincount(index, w, len(entries)).astype(np.float64)
    errors = np.bincount(index, w * error, len(entries))
    loss = weight
    if moves_max:  # the distance is infinite if the groups searched have no other entry
        distance = search_nearest(entries, entries, near_groups, context, exclude_own=True)[1]
        loss = np.multiply(weight, distance, out=np.zeros_like(weight), where=weight > 0.0)
    cheap, worst = np.argsort(loss, kind="stable"), np.argsort(-errors, kind="stable")
    limit = max(moves_max, int(np.count_nonzero(weight == 0)))
    count = int(np.count_nonzero((loss[cheap] < errors[worst] / 2)[:limit]))
    if count:
        rows = np.flatnonzero(np.isin(index, worst[:count], kind="table"))
        keys = w[rows] * error[rows] / (1.0 - rng.random(len(rows)))
        rows = rows[np.argsort(keys, kind="stable")]
        drawn = np.zeros(len(entries), np.int64)
        drawn[index[rows]] = rows  # the last point assigned has the largest key
        entries[cheap[:count]] = points[drawn[worst[:count]]]


def _distinct(rows: I16 | I32) -> tuple[I32, U32]:
    """Return the distinct rows [K, D] of rows [N, D], and the index of each row among them, [N]."""
    distinct, index = np.unique(rows, axis=0, return_inverse=True)
    return distinct.astype(np.int32), index.reshape(-1).astype(np.uint32)


def _drop_unused(entries: I32, index: U32) -> tuple[I32, U32]:
    """Return the entries [K, D] that some point uses, in their order, and the points' index [N] among them."""
    used = np.bincount(index, minlength=len(entries)) > 0
    return entries[used], (np.cumsum(used) - 1).astype(np.uint32)[index]


def _neighbours(entries: Floats, candidates: int) -> I64:
    """Return the indices of each entry and its nearest neighbours, [K, min(candidates, K)], each row ascending."""
    flat = entries.reshape(len(entries), -1).astype(np.float64)
    squares = np.einsum("kd,kd->k", flat, flat)
    count = min(candidates, len(flat))
    near = np.empty((len(flat), count), np.int64)
    for start in range(0, len(flat), _NEIGHBOUR_BLOCK):
        part = slice(start, start + _NEIGHBOUR_BLOCK)
        distance = squares - 2.0 * (flat[part] @ flat.T)
        rows = np.arange(len(distance))
        distance[rows, start + rows] = -np.inf  # includes the entry itself, even if others are equal to it
        near[part] = np.argpartition(distance, count - 1, axis=1)[:, :count]
    return np.sort(near, axis=1)


def _solve_entries(points: Floats, metric: ErrorMetric, entries: I32, index: I64) -> I32:
    """Return the centroids [K, D, C] under the metric, rounded.

    The centroid c of the points x_n minimises Σ_n w_n (x_n - c)ᵀ M_n (x_n - c) + r |c - c_old|², that is
        (Σ_n w_n M_n + r I) c = Σ_n w_n M_n x_n + r c_old.
    """
    count, size, channels = entries.shape
    upper_i, upper_j = np.triu_indices(size)
    weights = metric.weights.astype(np.float64)
    matrices = np.zeros((count, size, size))
    for column, (i, j) in enumerate(zip(upper_i, upper_j, strict=True)):
        sums = np.bincount(index, weights * metric.triangles[:, column], count)
        matrices[:, i, j] = matrices[:, j, i] = sums
    right = np.empty((count, size, channels))
    products = np.empty((len(points), size, channels))
    for start in range(0, len(points), _METRIC_BLOCK):
        part = slice(start, start + _METRIC_BLOCK)
        products[part] = matrix_products(metric.triangles[part], points[part])
    for d in range(size):
        for c in range(channels):
            right[:, d, c] = np.bincount(index, weights * products[:, d, c], count)
    ridge = _RIDGE * np.einsum("kii->k", matrices) / size
    ridge[ridge == 0.0] = 1.0  # an entry without weight stays
    matrices[:, range(size), range(size)] += ridge[:, None]
    right += ridge[:, None, None] * entries
    solved: I32 = np.rint(np.linalg.solve(matrices, right)).astype(np.int32)
    return solved
