"""Clustering where errors weigh otherwise for every point: nearest entries and means under matrices of the points.

The error of a point x served by c is w · Σ_channels (x − c)ᵀ M (x − c), M the Gauss-Newton matrix of the point: how
errors of its parts add up in pictures. What k-means found serves as the start: the neighbours of an entry are the
candidates of its points, and means become solutions of the sums of their equations.

Products run on one thread of the BLAS, and sums have one order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.nearest import one_blas_thread
from csplat.types import F64, I32, I64

Floats = NDArray[Any]

_TRIED = 96  # entries for a point: its own and the nearest to that
_ROUNDS = 2  # how often entries move
_BLOCK = 1 << 12
_RIDGE = 1e-3  # fraction of the mean diagonal: holds an entry in place if its points do not determine it


@dataclass(frozen=True, eq=False)
class Metric:
    """Weights and matrices that measure the errors of points.

    Attributes:
        weights: [N], >= 0.
        triangles: [N, D (D + 1) / 2], upper triangles of the matrices, row by row.
    """

    weights: Floats
    triangles: Floats

    @property
    def size(self) -> int:
        """D."""
        return _order(self.triangles)

    def first(self, size: int) -> Metric:
        """The same for the first `size` parts of a point."""
        rows, columns = np.triu_indices(self.size)
        return Metric(self.weights, self.triangles[:, (rows < size) & (columns < size)])

    def products(self, a: Floats, b: Floats) -> F64:
        """Return aᵀ M b of every point, [N], without the weights; a and b are [N, D, C]."""
        found = np.empty(len(a))
        for at in range(0, len(a), _BLOCK):
            part = slice(at, at + _BLOCK)
            found[part] = np.einsum("nic,nic->n", a[part], _products(self.triangles[part], b[part]))
        return found

    def errors(self, difference: Floats, rows: NDArray[np.intp] | slice) -> F64:
        """Return the errors [n] of points `rows` that are off by `difference` [n, D, C]."""
        triangles, weights = self.triangles[rows], self.weights[rows]
        above, beside = np.triu_indices(self.size)
        found = np.empty(len(difference))
        for at in range(0, len(difference), _BLOCK):
            part = slice(at, at + _BLOCK)
            d = difference[part].astype(np.float64)
            products = np.einsum("npc,npc->np", d[:, above], d[:, beside])
            found[part] = np.einsum("np,np->n", products, _doubled(triangles[part])) * weights[part]
        return found


def reassign(points: Floats, metric: Metric, entries: Floats, index: I64, threads: int, tried: int) -> I64:
    """Give each point the best of the entries near its own.

    Args:
        points: [N, D, C].
        metric: metric of the points.
        entries: [K, D, C].
        index: [N], the entry of each point.
        threads: number to use; the result does not depend on it.
        tried: number of entries to try: its own and that one's nearest neighbours.

    Returns:
        [N].
    """
    with one_blas_thread():
        return _assign(points, metric, entries, index, threads, tried)


def refine(points: Floats, metric: Metric, entries: I32, index: I64, threads: int) -> tuple[I32, I64]:
    """Give each point the best of the entries near its own, and move the entries; twice.

    Args:
        points: [N, D, C], in lattice steps.
        metric: metric of the points.
        entries: [K, D, C] lattice integers.
        index: [N], the entry of each point.
        threads: number to use; the result does not depend on it.

    Returns:
        entries [K', D, C], distinct, each used; index [N].
    """
    with one_blas_thread():
        for _ in range(_ROUNDS):
            index = _assign(points, metric, entries, index, threads, _TRIED)
            entries = _solve(points, metric, entries, index)
        index = _assign(points, metric, entries, index, threads, _TRIED)
    flat, place = np.unique(entries.reshape(len(entries), -1), axis=0, return_inverse=True)
    index = place.reshape(-1)[index]
    used, index = np.unique(index, return_inverse=True)
    return flat[used].reshape(-1, *entries.shape[1:]), index.reshape(-1)


def _assign(points: Floats, metric: Metric, entries: Floats, index: I64, threads: int, tried: int) -> I64:
    """Take the best of the candidates: w xᵀMx falls out, what is left is linear in Mx and M."""
    near = _neighbours(entries, tried)
    size, channels = entries.shape[1:]
    above, beside = np.triu_indices(size)
    wide = entries.astype(np.float64)
    table = np.concatenate(
        [-2.0 * wide.reshape(len(wide), -1), np.einsum("kpc,kpc->kp", wide[:, above], wide[:, beside])], axis=1
    )
    order = np.argsort(index, kind="stable")
    ends = np.searchsorted(index[order], np.arange(len(entries) + 1))
    best = index.copy()

    def work(groups: Sequence[int]) -> None:
        for group in groups:
            rows = order[ends[group] : ends[group + 1]]
            if not len(rows):
                continue
            features = np.empty((len(rows), table.shape[1]))
            features[:, : size * channels] = _products(metric.triangles[rows], points[rows]).reshape(len(rows), -1)
            features[:, size * channels :] = _doubled(metric.triangles[rows])
            best[rows] = near[group, (features @ table[near[group]].T).argmin(axis=1)]

    with ThreadPoolExecutor(max(1, threads)) as pool:
        list(pool.map(work, [range(start, len(entries), threads) for start in range(threads)]))
    return best


def _neighbours(entries: Floats, tried: int) -> I64:
    """[K, candidates]: each entry itself, and those nearest to it."""
    flat = entries.reshape(len(entries), -1).astype(np.float64)
    squares = np.einsum("kd,kd->k", flat, flat)
    count = min(tried, len(flat))
    near = np.empty((len(flat), count), np.int64)
    for at in range(0, len(flat), 256):
        part = slice(at, at + 256)
        distance = squares - 2.0 * (flat[part] @ flat.T)
        rows = np.arange(len(distance))
        distance[rows, at + rows] = -np.inf
        near[part] = np.argpartition(distance, count - 1, axis=1)[:, :count]
    return np.sort(near, axis=1)


def _solve(points: Floats, metric: Metric, entries: I32, index: I64) -> I32:
    """Return the entries, [K, D, C], that minimise the sums of the points' errors, rounded."""
    count, size, channels = entries.shape
    above, beside = np.triu_indices(size)
    weights = metric.weights.astype(np.float64)
    matrices = np.zeros((count, size, size))
    for place, (i, j) in enumerate(zip(above, beside, strict=True)):
        sums = np.bincount(index, weights * metric.triangles[:, place], count)
        matrices[:, i, j] = matrices[:, j, i] = sums
    wanted = np.empty((count, size, channels))
    products = np.empty((len(points), size, channels))
    for at in range(0, len(points), _BLOCK):
        part = slice(at, at + _BLOCK)
        products[part] = _products(metric.triangles[part], points[part])
    for part_of in range(size):
        for c in range(channels):
            wanted[:, part_of, c] = np.bincount(index, weights * products[:, part_of, c], count)
    ridge = _RIDGE * np.einsum("kii->k", matrices) / size
    ridge[ridge == 0.0] = 1.0
    matrices[:, range(size), range(size)] += ridge[:, None]
    wanted += ridge[:, None, None] * entries
    solved: I32 = np.rint(np.linalg.solve(matrices, wanted)).astype(np.int32)
    return solved


def _products(triangles: Floats, points: Floats) -> F64:
    """[n, D, C]: each matrix times its point."""
    size = points.shape[1]
    above, beside = np.triu_indices(size)
    matrices = np.empty((len(points), size, size))
    matrices[:, above, beside] = triangles
    matrices[:, beside, above] = triangles
    found: F64 = np.einsum("nij,njc->nic", matrices, points.astype(np.float64))
    return found


def _doubled(triangles: Floats) -> F64:
    """Return the triangles with the entries doubled that occur twice in the matrix."""
    above, beside = np.triu_indices(_order(triangles))
    return np.asarray(triangles * np.where(above == beside, 1.0, 2.0), np.float64)


def _order(triangles: Floats) -> int:
    """D of triangles [N, D (D + 1) / 2]."""
    return (math.isqrt(8 * int(triangles.shape[1]) + 1) - 1) // 2
