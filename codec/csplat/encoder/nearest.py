"""Nearest of many integer vectors by matrix products: the same result at any thread count.

A product is float32 over integers (and halves) whose partial sums stay below 2**23, so
its value depends neither on the order in which a BLAS adds nor on the BLAS's threads.
"""

import ctypes
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np

from csplat.types import F32, F64, I16, I32, I64, U32

_Find = Callable[[F32, int], tuple[I64, F32]]  # rows [x, 1] and the number of the first

_EXACT = 2.0**23  # below it float32 holds every multiple of 1/2
_ROWS, _COLUMNS = 256, 4096  # points and entries of one product: a result of 4 MiB
_GROUPED_ROWS = 4096  # points that share one sort by group
_GROUP_ITERATIONS = 4
_BLAS = threading.Lock()  # its thread count is one for the process: one search at a time


def search(
    points: I16 | I32,
    entries: I32,
    near_groups: int = 0,
    threads: int | None = None,
    *,
    other: bool = False,
) -> tuple[U32, F64]:
    """Find the entry nearest to each point, and how far it is.

    Minimises |c|**2 / 2 - x.c: one product of [x, 1] and [c, -|c|**2 / 2].

    Args:
        points: [N, D], lattice integers. Where max|x| max|c| + max|c|**2 / 2 reaches 2**23
            (norms of about 2,300) both are first divided by a power of two and rounded.
        entries: [K, D], K > 0.
        near_groups: 0, or how many groups of about sqrt(K) entries to search for a point.
        threads: worker threads, all processors unless told.
        other: point n may not find entry n (the points are the entries; `near_groups` 0).

    Returns:
        index [N] uint32, the first of equally near entries when all are searched; and the
        squared distance [N] float64, of the divided integers, in units of the lattice.
    """
    shift = _shift(points, entries)
    coarse = _shifted(entries, shift)
    index = np.zeros(len(points), np.uint32)
    error = np.zeros(len(points))
    width, length = points.shape[1] + 1, _ROWS
    find = _every_entry(_matrix(coarse), other)
    if 0 < near_groups < _group_count(len(entries)):
        length = _GROUPED_ROWS
        find = _near_entries(coarse, near_groups, threads)

    def work(starts: range) -> None:
        x = np.ones((length, width), np.float32)
        for a in starts:
            part = slice(a, min(a + length, len(points)))
            rows = x[: part.stop - a]
            rows[:, :-1] = points[part] if shift == 0 else _shifted(points[part], shift)
            index[part], best = find(rows, a)
            norm = np.einsum("nd,nd->n", rows, rows, dtype=np.float64) - 1.0
            error[part] = (norm - 2.0 * best) * 4.0**shift

    workers = max(1, min(threads or os.cpu_count() or 1, -(-len(points) // length)))
    jobs = [range(w * length, len(points), workers * length) for w in range(workers)]
    with one_blas_thread():
        if workers == 1:  # to start a thread takes longer than a small search
            work(jobs[0])
        else:
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(work, jobs))
    return index, error


def _shift(points: I16 | I32, entries: I32) -> int:
    """Return the least shift after which every product is exact."""
    x, c = _largest_norm(points), _largest_norm(entries)
    slack = math.sqrt(points.shape[1])  # rounding moves a vector by half of this at most
    shift = 0
    while (x + slack) * (c + slack) + (c + slack) ** 2 / 2 >= _EXACT:
        x, c, shift = x / 2, c / 2, shift + 1
    return shift


def _largest_norm(rows: I16 | I32) -> float:
    largest = 0.0
    for a in range(0, len(rows), _GROUPED_ROWS):
        part = rows[a : a + _GROUPED_ROWS].astype(np.float64)
        largest = max(largest, float(np.einsum("nd,nd->n", part, part).max()))
    return math.sqrt(largest)


def _shifted(rows: I16 | I32, shift: int) -> I64:
    return (rows.astype(np.int64) + ((1 << shift) >> 1)) >> shift


def _matrix(entries: I64) -> F32:
    """Return [D + 1, K]: the entries as columns, minus half their squares below."""
    half = np.einsum("kd,kd->k", entries, entries) * -0.5
    return np.concatenate([entries.T, half[None]]).astype(np.float32)


def _every_entry(matrix: F32, other: bool) -> _Find:
    def find(x: F32, start: int) -> tuple[I64, F32]:
        rows = np.arange(len(x))
        index = np.zeros(len(x), np.int64)
        best = np.full(len(x), -np.inf, np.float32)
        for k in range(0, matrix.shape[1], _COLUMNS):
            scores = x @ matrix[:, k : k + _COLUMNS]
            if other:
                own = rows + (start - k)
                here = (own >= 0) & (own < scores.shape[1])
                scores[rows[here], own[here]] = -np.inf
            first = scores.argmax(1)
            score = scores[rows, first]
            better = score > best
            index[better] = first[better] + k
            best[better] = score[better]
        return index, best

    return find


def _group_count(entry_count: int) -> int:
    return math.isqrt(entry_count)


def _near_entries(entries: I64, near: int, threads: int | None) -> _Find:
    centres, label = _groups(entries, threads)
    order = np.argsort(label, kind="stable")
    matrix, coarse = _matrix(entries[order]), _matrix(centres)
    bounds = np.searchsorted(label[order], np.arange(len(centres) + 1))

    def find(x: F32, _: int) -> tuple[I64, F32]:
        index = np.zeros(len(x), np.int64)
        best = np.full(len(x), -np.inf, np.float32)
        negated = x @ -coarse
        chosen = np.argpartition(negated, near - 1, axis=1)[:, :near].astype(np.uint16).ravel()
        by_group = np.argsort(chosen, kind="stable")
        ends = np.searchsorted(chosen[by_group], np.arange(len(centres) + 1))
        for g in range(len(centres)):
            rows = by_group[ends[g] : ends[g + 1]] // near
            if len(rows) == 0 or bounds[g] == bounds[g + 1]:
                continue
            scores = x[rows] @ matrix[:, bounds[g] : bounds[g + 1]]
            first = scores.argmax(1)
            score = scores[np.arange(len(rows)), first]
            better = score > best[rows]
            index[rows[better]] = first[better] + bounds[g]
            best[rows[better]] = score[better]
        return order[index], best

    return find


def _groups(entries: I64, threads: int | None) -> tuple[I64, U32]:
    """Put the entries into about sqrt(K) groups by plain k-means; the means of the groups."""
    count = _group_count(len(entries))
    rows = entries.astype(np.int32)
    centres = rows[np.arange(count) * len(rows) // count]
    label, _ = search(rows, centres, 0, threads)
    for _ in range(_GROUP_ITERATIONS - 1):
        size = np.bincount(label, minlength=count)
        sums = [np.bincount(label, column, count) for column in rows.T]
        used = size > 0
        centres[used] = np.rint(np.stack(sums, 1)[used] / size[used, None])
        label, _ = search(rows, centres, 0, threads)
    return centres.astype(np.int64), label


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let each product run on one thread, where NumPy's BLAS is an OpenBLAS that lets us.

    Our threads already fill the processors. OpenBLAS's wait for each other by spinning:
    with one other program at work these products took 20 times as long.
    """
    control = _openblas()
    if control is None:
        yield
        return
    with _BLAS:
        before = control[0]()
        control[1](1)
        try:
            yield
        finally:
            control[1](before)


@cache
def _openblas() -> tuple[Callable[[], int], Callable[[int], object]] | None:
    core = sys.modules.get("numpy._core._multiarray_umath") or sys.modules.get("numpy.core._multiarray_umath")
    beside = Path(np.__file__).parent.parent / "numpy.libs"
    paths = [str(getattr(core, "__file__", "")), *map(str, sorted(beside.glob("*openblas*")))]
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
