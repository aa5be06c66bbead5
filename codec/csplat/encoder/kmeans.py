"""Cluster lattice integers by weighted k-means, with the same result for any number of threads.

Assignments are matrix products in float32 of integers and halves. Their partial sums stay below 2**23 and are exact, so
the result depends neither on the order of additions in a BLAS nor on its threads. Centroids are float64 sums in the
order of the points, rounded to integers. All random numbers come from one seeded generator.

`refine_by_metric` continues the iteration if every point x has its own error metric w Σ_channels (x - c)ᵀ M (x - c).
The candidates of a point are the neighbours of its entry; centroids solve the normal equations of their points.
"""

from __future__ import annotations

import ctypes
import math
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder.splat_importance import ErrorMetric, doubled_triangles, matrix_products
from csplat.errors import InputError
from csplat.types import F32, F64, I16, I32, I64, U32

# Searches entries for a block of n points: (rows [x, 1] of the points, [n, D + 1]; index of the first point; index of
# the best entry so far, [n]; its score, [n]). Updates the last two in place.
_Search = Callable[[F32, int, I64, F32], None]
Floats = NDArray[Any]

_SEED_ROUNDS = (8, 2)  # rounds in which the initial entries are drawn, for few points and for many
_FEW_POINTS = 1 << 14  # for more, 8 rounds lower the error by 0.3 %; for a few hundred extreme points, by up to 40 %
_EXACT = 2.0**23  # float32 represents every multiple of 1/2 below this
_PRODUCT = 1 << 18  # scores per matrix product, 1 MiB, which fits the second-level cache
_PRODUCT_COLUMNS = 1024  # entries per matrix product
_BLOCK = 1 << 13  # points that a thread assigns, and sorts by group, at a time
_GROUP_ITERATIONS = 2
_REFINED_POINTS = 1 << 16  # minimum number of points of the last iteration, unless there are fewer
_REFINED_PER_ENTRY = 64  # the same, per entry
_NEXT_GROUPS = 2  # groups searched if a near entry is known; 4 take a fifth longer for 0.2 to 0.6 % less RMS error
_BLAS = threading.RLock()  # a BLAS has one thread count per process: one search at a time
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
        near_groups: see `assign`; once a point has an entry, `_NEXT_GROUPS` groups are searched for a nearer entry.
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
        _relocate(entries, index, sample, sample_w, error, moves_max, min(near_groups, _NEXT_GROUPS), rng, context)
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


def search_nearest(
    points: I16 | I32,
    entries: I32,
    near_groups: int = 0,
    context: Context = DEFAULT_CONTEXT,
    *,
    start: U32 | None = None,
    exclude_own: bool = False,
) -> tuple[U32, F64]:
    """Assign each point to the nearest entry, and return the squared distances.

    As |x - c|² = |x|² - 2 (x·c - |c|²/2), the nearest entry has the highest score x·c - |c|²/2, which is the product of
    [x, 1] and [c, -|c|²/2].

    Args:
        points: [N, D], lattice integers. If max|x| max|c| + max|c|²/2 reaches 2**23 (norms of about 2,300), points and
            entries are first divided by a power of two and rounded.
        entries: [K, D], K > 0.
        near_groups: see `assign`.
        context: threads.
        start: [N], an entry near each point. The result is as near, and at most `_NEXT_GROUPS` groups are searched.
        exclude_own: exclude entry n for point n: the points are the entries.

    Returns:
        index [N] uint32; squared distances [N] float64 of the divided integers, in lattice units.
    """
    shift = _shift(points, entries)
    coarse = _divide(entries, shift)
    index = np.zeros(len(points), np.uint32)
    error = np.zeros(len(points))
    table = _table(coarse)
    if 0 < near_groups < math.isqrt(len(entries)):
        near = near_groups if start is None else min(near_groups, _NEXT_GROUPS)
        search = _near_entries(coarse, table, near, context, exclude_own)
    else:
        start = None
        search = _every_entry(table, exclude_own)

    def work(part: slice) -> None:
        rows = np.ones((part.stop - part.start, table.shape[1]), np.float32)
        rows[:, :-1] = points[part] if shift == 0 else _divide(points[part], shift)
        nearest = np.zeros(len(rows), np.int64)
        best = np.full(len(rows), -np.inf, np.float32)
        if start is not None:
            nearest[:] = start[part]
            best[:] = np.einsum("nd,nd->n", rows, np.take(table, nearest, axis=0))
        search(rows, part.start, nearest, best)
        index[part] = nearest
        norm = np.einsum("nd,nd->n", rows, rows, dtype=np.float64) - 1.0
        error[part] = (norm - 2.0 * best) * 4.0**shift

    with one_blas_thread():
        run_blocks(work, len(points), _BLOCK, context)
    return index, error


def run_blocks(work: Callable[[slice], object], count: int, length: int, context: Context) -> None:
    """Call `work` with the slices of `length` of `count` rows, in threads unless there is one slice.

    Args:
        work: writes results to these rows; releases the GIL for most of its time.
        count: number of rows.
        length: rows per slice.
        context: threads.
    """
    slices = [slice(start, min(start + length, count)) for start in range(0, count, length)]
    workers = min(context.thread_count, len(slices))
    if workers <= 1:  # a small scene takes less time than starting a thread
        for part in slices:
            work(part)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, slices))


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Run matrix products on one thread, if NumPy's BLAS is an OpenBLAS whose thread count can be set.

    Our own threads already use all processors. OpenBLAS's threads wait by spinning: next to another busy program, these
    products took 20 times as long.
    """
    control = _openblas()
    if control is None:
        yield
        return
    get_thread_count, set_thread_count = control
    with _BLAS:
        previous = get_thread_count()
        set_thread_count(1)
        try:
            yield
        finally:
            set_thread_count(previous)


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


def _shift(points: I16 | I32, entries: I32) -> int:
    """Return the smallest shift after which all scores of points [N, D] and entries [K, D] are exact."""
    x, c = _largest_norm(points), _largest_norm(entries)
    slack = math.sqrt(points.shape[1])  # rounding moves a vector by at most half of this
    shift = 0
    while (x + slack) * (c + slack) + (c + slack) ** 2 / 2 >= _EXACT:
        x, c, shift = x / 2, c / 2, shift + 1
    return shift


def _largest_norm(rows: I16 | I32) -> float:
    """Return the largest Euclidean norm of rows [N, D]."""
    largest = 0.0
    for a in range(0, len(rows), _BLOCK):
        part = rows[a : a + _BLOCK].astype(np.float64)
        largest = max(largest, float(np.einsum("nd,nd->n", part, part).max()))
    return math.sqrt(largest)


def _divide(rows: I16 | I32, shift: int) -> I64:
    """Return integers divided by 2**shift, rounded to the nearest, halves up."""
    return (rows.astype(np.int64) + ((1 << shift) >> 1)) >> shift


def _table(entries: I64) -> F32:
    """Return the rows [c, -|c|²/2] of the entries, [K, D + 1]."""
    half = np.einsum("kd,kd->k", entries, entries) * -0.5
    return np.concatenate([entries, half[:, None]], axis=1).astype(np.float32)


def _every_entry(table: F32, exclude_own: bool) -> _Search:
    """Return a search of every entry in a `_table`, [K, D + 1]; `exclude_own` skips entry i for point i."""
    matrix = np.ascontiguousarray(table.T)
    width = min(matrix.shape[1], _PRODUCT_COLUMNS)
    step = _PRODUCT // width

    def search(x: F32, start: int, index: I64, best: F32) -> None:
        for first_row in range(0, len(x), step):
            part = slice(first_row, first_row + step)
            rows = np.arange(len(x[part]))
            for first_entry in range(0, matrix.shape[1], width):
                scores = x[part] @ matrix[:, first_entry : first_entry + width]
                if exclude_own:
                    own = rows + (start + first_row - first_entry)  # columns of the points' own entries
                    inside = (own >= 0) & (own < scores.shape[1])
                    scores[rows[inside], own[inside]] = -np.inf
                _keep_better(rows, scores, first_entry, index[part], best[part])

    return search


def _near_entries(entries: I64, table: F32, near: int, context: Context, exclude_own: bool) -> _Search:
    """Return a search of the entries in the `near` groups whose centroids are nearest to a point.

    A point whose groups have no entry, or only its own that is excluded, keeps index and score.

    Args:
        entries: [K, D], which are grouped here.
        table: [K, D + 1], the `_table` of the entries.
        near: number of groups per point, > 0.
        context: threads.
        exclude_own: skip entry i for point i.
    """
    centres, label = _groups(entries, context)
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(len(centres) + 1))
    matrices = [np.ascontiguousarray(table[order[a:b]].T) for a, b in pairwise(ends)]
    coarse = np.ascontiguousarray(_table(centres).T)
    place = np.empty_like(order)  # the inverse of `order`
    place[order] = np.arange(len(order))

    def search(x: F32, start: int, index: I64, best: F32) -> None:
        nearest = np.empty_like(index)  # positions in `order`
        previous_best = best.copy()
        for group_rows, group in _by_group(x @ coarse, near):
            width = matrices[group].shape[1]
            for rows in np.array_split(group_rows, -(-len(group_rows) * width // _PRODUCT)) if width else ():
                scores = np.take(x, rows, axis=0) @ matrices[group]  # unlike x[rows], `take` releases the GIL
                if exclude_own:
                    own = place[rows + start] - ends[group]  # columns of the points' own entries
                    inside = np.flatnonzero((own >= 0) & (own < width))
                    scores[inside, own[inside]] = -np.inf
                _keep_better(rows, scores, int(ends[group]), nearest, best)
        better = best > previous_best
        index[better] = order[nearest[better]]

    return search


def _by_group(scores: F32, near: int) -> Iterator[tuple[I64, int]]:
    """Yield the rows of which a group is among the `near` with the highest scores [n, groups], and the group.

    Groups ascend; a group without rows is omitted. The highest scores are overwritten.
    """
    count, groups = scores.shape
    rows = np.arange(count)
    chosen = np.empty((near, count), np.uint16)  # NumPy sorts 16 bits by radix
    for number in range(near):
        chosen[number] = first = scores.argmax(1)
        scores[rows, first] = -np.inf
    flat = chosen.reshape(-1)
    order = np.argsort(flat, kind="stable")
    ends = np.searchsorted(flat[order], np.arange(groups + 1))
    order %= count  # from indices in `flat` to rows
    for group in range(groups):
        if ends[group] < ends[group + 1]:
            yield order[ends[group] : ends[group + 1]], group


def _keep_better(rows: I64, scores: F32, first: int, index: I64, best: F32) -> None:
    """Update `index` and `best` in place for the `rows` [n] that one of k further entries has a higher score for.

    Args:
        rows: [n], distinct rows of `index` and `best`.
        scores: [n, k], k > 0, of the entries `first` to `first` + k - 1; of equal ones the first counts.
        first: the entry of the first column.
        index, best: entry and score of every point so far; equal scores keep the entry.
    """
    column = scores.argmax(1)
    score = scores[np.arange(len(column)), column]
    better = np.flatnonzero(score > best[rows])
    rows = rows[better]
    index[rows] = column[better] + first
    best[rows] = score[better]


def _groups(entries: I64, context: Context) -> tuple[I64, U32]:
    """Cluster entries [K, D] into G = floor(sqrt(K)) groups by plain k-means; a group may be empty.

    Returns:
        The centroids, [G, D], rounded; the group of each entry, [K].
    """
    count = math.isqrt(len(entries))
    rows = entries.astype(np.int32)
    centres = rows[np.arange(count) * len(rows) // count]
    label, _ = search_nearest(rows, centres, 0, context)
    for _ in range(_GROUP_ITERATIONS - 1):
        size = np.bincount(label, minlength=count)
        sums = [np.bincount(label, column, count) for column in rows.T]
        used = size > 0
        centres[used] = np.rint(np.stack(sums, 1)[used] / size[used, None])
        label, _ = search_nearest(rows, centres, 0, context)
    return centres.astype(np.int64), label


@cache
def _openblas() -> tuple[Callable[[], int], Callable[[int], object]] | None:
    """Return the functions of NumPy's OpenBLAS that get and set its number of threads; `None` if unavailable."""
    core = sys.modules.get("numpy._core._multiarray_umath") or sys.modules.get("numpy.core._multiarray_umath")
    bundled = Path(np.__file__).parent.parent / "numpy.libs"
    paths = [str(getattr(core, "__file__", "")), *map(str, sorted(bundled.glob("*openblas*")))]
    for path in filter(None, paths):
        try:
            library = ctypes.CDLL(path)
        except OSError:
            continue
        for name in ("scipy_openblas_{}64_", "openblas_{}64_", "scipy_openblas_{}", "openblas_{}"):
            get = getattr(library, name.format("get_num_threads"), None)
            put = getattr(library, name.format("set_num_threads"), None)
            if get and put:
                return get, put
    return None


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
