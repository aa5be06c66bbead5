"""Weighted k-means over lattice integers: the same bytes at any thread count.

Searches are exact (`nearest`); centroids are float64 sums in the order of the points,
rounded to integers; all chance comes from one seeded generator.
"""

from collections.abc import Callable

import numpy as np

from csplat.encoder.nearest import search
from csplat.errors import InputError
from csplat.types import F32, F64, I16, I32, I64, U32

_SEED_ROUNDS = 8


def cluster(
    points: I16 | I32,
    weights: F32,
    size: int,
    *,
    seed: int,
    iterations: int = 8,
    sample_per_entry: int = 24,
    near_groups: int = 0,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[I32, U32]:
    """Find at most `size` entries that stand for the points, and the entry of each point.

    Trains on a weighted sample, then moves the entries twice on all points. Memory beside
    the arguments: the sample and about 40 bytes per point.

    Args:
        points: [N, D], lattice integers. Set outliers aside first: beyond a norm of about
            2,300 all points are searched on a lattice coarser by a power of two.
        weights: [N], finite and >= 0; only ratios matter; all zero means all equal.
        size: the most entries wanted, > 0.
        seed: of the sample and of the first entries, >= 0.
        iterations: k-means steps on the sample.
        sample_per_entry: points of the sample per entry, > 0.
        near_groups: as in `assign`.
        threads: as in `assign`.
        progress: called with steps done and steps in all.

    Returns:
        entries [K, D] int32, K <= size, distinct, each used by a point, in no order of
        meaning; index [N] uint32.

    Raises:
        InputError: shapes, dtypes, weights or numbers outside these ranges.
    """
    w = _check(points, weights)
    if min(size, sample_per_entry) <= 0 or min(iterations, near_groups, seed) < 0:
        raise InputError("cluster: size and sample_per_entry must be > 0, other numbers >= 0")
    if len(points) <= size:
        return _distinct(points)
    rng = np.random.default_rng(seed)
    rows, sample_w = _sample(w, size * sample_per_entry, rng)
    sample = points[rows]
    entries = _first_entries(sample, sample_w, size, rng, near_groups, threads)
    for step in range(iterations + 1):
        most = size >> (2 + 4 * step // iterations) if step < iterations else 0
        if step == iterations:
            sample, sample_w = points, w
        index, error = search(sample, entries, near_groups, threads)
        entries = _means(sample, sample_w, index, entries)
        _relocate(entries, index, sample, sample_w, error, most, rng, threads)
        if progress:
            progress(step + 1, iterations + 2)
    index = assign(points, entries, near_groups=near_groups, threads=threads)
    entries = _means(points, w, index, entries)
    if progress:
        progress(iterations + 2, iterations + 2)
    distinct, merged = _distinct(entries)
    return _drop_unused(distinct, merged[index])


def assign(points: I16 | I32, entries: I32, *, near_groups: int = 0, threads: int | None = None) -> U32:
    """Find the entry nearest to each point; of equally near ones the first.

    Args:
        points: [N, D], lattice integers.
        entries: [K, D], K > 0.
        near_groups: 0 searches every entry. Otherwise entries are put into about sqrt(K)
            groups, and only this many groups, those with the nearest means, are searched:
            faster for thousands of entries, not always the nearest.
        threads: worker threads, all processors unless told; no effect on the result.

    Returns:
        [N] uint32, rows of `entries`.

    Raises:
        InputError: shapes or dtypes that are not those above.
    """
    _check(points, None)
    if entries.ndim != 2 or entries.dtype != np.int32 or entries.shape[1] != points.shape[1]:
        raise InputError(f"assign: entries {entries.dtype} {entries.shape}, points {points.shape}")
    if not len(entries):
        raise InputError("assign: no entries")
    return search(points, entries, near_groups, threads)[0]


def rank_by_frequency(index: U32, entries: I32) -> tuple[U32, I32]:
    """Renumber so that more frequent entries come first, equal ones in their old order.

    Args:
        index: [N], rows of `entries`.
        entries: [K, D].

    Returns:
        The new index [N] and the entries [K, D] in the new order.
    """
    count = np.bincount(index, minlength=len(entries))
    order = np.argsort(-count, kind="stable")
    rank = np.empty(len(entries), np.uint32)
    rank[order] = np.arange(len(entries), dtype=np.uint32)
    return rank[index], entries[order]


def _check(points: I16 | I32, weights: F32 | None) -> F64:
    if points.ndim != 2 or not points.shape[1] or points.dtype not in (np.int16, np.int32):
        found = f"{points.dtype} {points.shape}"
        raise InputError(f"k-means: points are int16 or int32 [N, D], found {found}")
    if weights is None:
        return np.empty(0)
    if weights.shape != points.shape[:1] or not np.all((weights >= 0) & (weights < np.inf)):
        found = f"{weights.shape} for {len(points)} points"
        raise InputError(f"k-means: weights are [N], finite and >= 0, found {found}")
    return weights.astype(np.float64) if weights.any() else np.ones(len(points))


def _largest(keys: F64, count: int) -> I64:
    """Return the rows of the `count` largest keys, ascending."""
    return np.sort(np.argpartition(keys, len(keys) - count)[len(keys) - count :])


def _sample(w: F64, count: int, rng: np.random.Generator) -> tuple[I64, F64]:
    """Priority sampling: an unbiased weighted sample that keeps every heavy row.

    Duffield, Lund, Thorup, "Priority sampling for estimation of arbitrary subset sums".
    """
    if count >= len(w):
        return np.arange(len(w)), w
    keys = w / (1.0 - rng.random(len(w)))
    rows = _largest(keys, count + 1)
    threshold = float(keys[rows].min())
    rows = rows[keys[rows] > threshold] if threshold > 0 else rows[keys[rows] > 0]
    return rows, np.maximum(w[rows], threshold)


def _draw(importance: F64, count: int, rng: np.random.Generator) -> I64:
    """Draw up to `count` different rows with a chance that grows with their importance."""
    count = min(count, int(np.count_nonzero(importance)))
    if count == 0:
        return np.empty(0, np.int64)
    return _largest(importance / (1.0 - rng.random(len(importance))), count)


def _first_entries(
    sample: I16 | I32, w: F64, size: int, rng: np.random.Generator, near: int, threads: int | None
) -> I32:
    """Draw points in rounds by weight times squared distance to those drawn before.

    Bahmani et al., "Scalable k-means++", with as many points drawn as are wanted.
    """
    error = np.ones(len(sample))
    entries = np.empty((0, sample.shape[1]), np.int32)
    for done in range(1, _SEED_ROUNDS + 1):
        new = sample[_draw(w * error, size * done // _SEED_ROUNDS - len(entries), rng)]
        entries = np.concatenate([entries, new.astype(np.int32)])
        if len(new) and done < _SEED_ROUNDS:
            found = search(sample, new.astype(np.int32), near, threads)[1]
            error = np.minimum(error, found) if len(entries) > len(new) else found
    return entries


def _means(points: I16 | I32, w: F64, index: U32, entries: I32) -> I32:
    """Move each entry to the rounded mean of its points; one of no weight stays."""
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
    most: int,
    rng: np.random.Generator,
    threads: int | None,
) -> None:
    """Move the entries that are missed least, and all of no weight, to where errors are largest.

    Patane and Russo, "The enhanced LBG algorithm": k-means alone never carries an entry from
    where there are too many to where there are too few. At most `most` entries of some weight
    move, in place; losing one costs about its weight times its squared distance to the next.
    """
    weight = np.bincount(index, w, len(entries)).astype(np.float64)
    harm = np.bincount(index, w * error, len(entries))
    loss = weight
    if most:
        loss = weight * search(entries, entries, 0, threads, other=True)[1]
    cheap, worst = np.argsort(loss, kind="stable"), np.argsort(-harm, kind="stable")
    limit = max(most, int(np.count_nonzero(weight == 0)))
    count = int(np.count_nonzero((loss[cheap] < harm[worst] / 2)[:limit]))
    if count:
        rows = np.flatnonzero(np.isin(index, worst[:count], kind="table"))
        keys = w[rows] * error[rows] / (1.0 - rng.random(len(rows)))
        rows = rows[np.argsort(keys, kind="stable")]
        drawn = np.zeros(len(entries), np.int64)
        drawn[index[rows]] = rows  # of each entry's points the one with the largest key stays
        entries[cheap[:count]] = points[drawn[worst[:count]]]


def _distinct(rows: I16 | I32) -> tuple[I32, U32]:
    distinct, index = np.unique(rows, axis=0, return_inverse=True)
    return distinct.astype(np.int32), index.reshape(-1).astype(np.uint32)


def _drop_unused(entries: I32, index: U32) -> tuple[I32, U32]:
    used = np.bincount(index, minlength=len(entries)) > 0
    return entries[used], (np.cumsum(used) - 1).astype(np.uint32)[index]
