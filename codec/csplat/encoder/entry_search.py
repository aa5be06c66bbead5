# SPDX-License-Identifier: Apache-2.0
"""Search the nearest entries of a codebook, with the same result for any number of threads, compiled or in NumPy.

As |x - c|² = |x|² - 2 (x·c - |c|²/2), the nearest entry has the highest score x·c - |c|²/2, which is the product of
[x, 1] and [c, -|c|²/2]. All numbers are integers and halves whose partial sums stay below 2**23, so scores are exact in
float32, and depend neither on the order of additions in a BLAS or in compiled code nor on threads.
"""

from __future__ import annotations

import ctypes
import math
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.plugins import load_plugins
from csplat.types import F32, F64, I16, I32, I64, U32

# Searches entries for a block of n points: (rows [x, 1] of the points, [n, D + 1]; entries to exclude, [n], or `None`;
# the best entry so far, [n]; its score, [n]). Updates the last two in place.
_Search = Callable[[F32, "I32 | None", I32, F32], None]

#: Groups searched if a near entry is known; 4 take a fifth longer for 0.2 to 0.6 % less RMS error.
NEXT_GROUPS = 2

_EXACT = 2.0**23  # float32 represents every multiple of 1/2 below this
_PRODUCT = 1 << 18  # scores per matrix product, 1 MiB, which fits the second-level cache
_PRODUCT_COLUMNS = 1024  # entries per matrix product
_BLOCK = 1 << 13  # points that a thread assigns, and sorts by group, at a time
_GROUP_ITERATIONS = 2
_blas_lock = threading.Lock()
_blas_users = list[int]()  # thread counts of the BLAS before each use of `one_blas_thread` that has not ended


class NearestEntries(Protocol):
    """A search for the nearest entries; an entry point of `csplat.kernels` returns one."""

    def __call__(
        self,
        points: I16,
        entries: I16,
        ends: I64,
        centres: I16 | None,
        near: int,
        found: I32,
        own: I32 | None,
        *,
        threads: int,
    ) -> F64:
        """Find the nearest entry of each point, the first of several at equal distance.

        Args:
            points: [N, D].
            entries: [K, D], group by group. For all points x and entries c, |x| |c| + |c|²/2 is below 2**23.
            ends: [G + 1], where groups begin and end.
            centres: [G, D], centres of the groups; `None` for one group.
            near: number of groups with the nearest centres that are searched, 1 to G.
            found: [N], an entry near each point, which only a nearer one replaces, or -1; updated in place, to -1 if
                the groups have no entry.
            own: [N], an entry to exclude for each point.
            threads: number of threads.

        Returns:
            [N] squared distances, infinite without an entry.
        """
        ...


@dataclass(frozen=True, eq=False)
class EntrySearch:
    """Entries that are prepared for searches.

    Attributes:
        order: [K], the index of each entry of `entries`.
        entries: [K, D] int64, divided by 2**shift, group by group.
        ends: [G + 1] int64, where groups begin and end.
        centres: [G, D] int64, centres of the groups; `None` if there is one group.
        near: number of groups with the nearest centres that are searched.
        shift: log2 of the number that points and entries are divided by, so that scores are exact.
    """

    order: I64
    entries: I64
    ends: I64
    centres: I64 | None
    near: int
    shift: int

    @classmethod
    def of(cls, entries: I32, near: int, reach: float, context: Context = DEFAULT_CONTEXT) -> EntrySearch:
        """Prepare entries.

        Args:
            entries: [K, D], K > 0.
            near: number of groups searched; 0, or if there are no more than that: one group of all entries.
            reach: norm that no point exceeds. Points that are searched in parts need the same.
            context: threads.
        """
        shift = _shift(reach, entries)
        divided = _divide(entries, shift)
        if not 0 < near < math.isqrt(len(entries)):
            return cls(np.arange(len(entries)), divided, np.array([0, len(entries)]), None, 1, shift)
        centres, label = _groups(divided, context)
        order = np.argsort(label, kind="stable")
        ends = np.searchsorted(label[order], np.arange(len(centres) + 1))
        return cls(order, divided[order], ends.astype(np.int64), centres, near, shift)

    def nearest(
        self, points: I16 | I32, context: Context, *, start: U32 | None = None, exclude_own: bool = False
    ) -> tuple[U32, F64]:
        """Find the nearest entries of points [N, D]; arguments and results as for `search_nearest`."""
        place = np.empty(len(self.order), np.int32)  # the inverse of `order`
        place[self.order] = np.arange(len(place), dtype=np.int32)
        found = np.full(len(points), -1, np.int32) if start is None else place[start]
        own = place if exclude_own else None
        divided = points if self.shift == 0 else _divide(points, self.shift)
        compiled = _compiled_search()
        if compiled is None or not _fits_int16(divided):
            squared = search_in_numpy(divided, self.entries, self.ends, self.centres, self.near, found, own, context)
        else:
            rows = np.ascontiguousarray(divided, np.int16)
            centres = None if self.centres is None else self.centres.astype(np.int16)
            squared = compiled(
                rows, self.entries.astype(np.int16), self.ends, centres, self.near, found, own,
                threads=context.thread_count,
            )  # fmt: skip
        index = np.where(found < 0, 0, self.order[found]).astype(np.uint32)
        squared *= 4.0**self.shift
        return index, squared


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

    Args:
        points: [N, D], lattice integers. If max|x| max|c| + max|c|²/2 reaches 2**23 (norms of about 2,300), points and
            entries are first divided by a power of two and rounded.
        entries: [K, D], K > 0.
        near_groups: see `assign`.
        context: threads.
        start: [N], an entry near each point. The result is as near, and at most `NEXT_GROUPS` groups are searched.
        exclude_own: exclude entry n for point n: the points are the entries.

    Returns:
        index [N] uint32; squared distances [N] float64 of the divided integers, in lattice units.
    """
    if not 0 < near_groups < math.isqrt(len(entries)):
        near_groups, start = 0, None
    near = near_groups if start is None else min(near_groups, NEXT_GROUPS)
    search = EntrySearch.of(entries, near, largest_norm(points, context), context)
    return search.nearest(points, context, start=start, exclude_own=exclude_own)


def search_in_numpy(
    points: I16 | I32 | I64,
    entries: I64,
    ends: I64,
    centres: I64 | None,
    near: int,
    found: I32,
    own: I32 | None,
    context: Context,
) -> F64:
    """Find the nearest entry of each point by matrix products, as `NearestEntries` does; any integers are allowed."""
    table, squared = _table(entries), np.empty(len(points))
    search = _every_entry(table) if centres is None else _near_entries(table, ends, _table(centres), near)

    def work(part: slice) -> None:
        rows = np.ones((part.stop - part.start, table.shape[1]), np.float32)
        rows[:, :-1] = points[part]
        best = np.full(len(rows), -np.inf, np.float32)
        known = np.flatnonzero(found[part] >= 0)
        if len(known):
            best[known] = np.einsum("nd,nd->n", rows[known], np.take(table, found[part][known], axis=0))
        search(rows, None if own is None else own[part], found[part], best)
        norm = np.einsum("nd,nd->n", rows, rows, dtype=np.float64) - 1.0
        squared[part] = norm - 2.0 * best

    with one_blas_thread():
        run_blocks(work, len(points), _BLOCK, context)
    return squared


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
    with _blas_lock:
        _blas_users.append(get_thread_count())
        set_thread_count(1)
    try:
        yield
    finally:
        with _blas_lock:
            before = _blas_users.pop()
            if not _blas_users:
                set_thread_count(before)


def largest_norm(rows: I16 | I32 | I64, context: Context = DEFAULT_CONTEXT) -> float:
    """Return the largest Euclidean norm of rows [N, D]; 0 without rows."""
    squares = [0.0] * -(-len(rows) // _BLOCK)

    def work(part: slice) -> None:
        wide = rows[part].astype(np.float64)
        squares[part.start // _BLOCK] = float(np.einsum("nd,nd->n", wide, wide).max())

    run_blocks(work, len(rows), _BLOCK, context)
    return math.sqrt(max(squares, default=0.0))


def _shift(reach: float, entries: I32) -> int:
    """Return the smallest shift after which all scores of points of norms up to `reach` and entries are exact."""
    x, c = reach, largest_norm(entries)
    slack = math.sqrt(entries.shape[1])  # rounding moves a vector by at most half of this
    shift = 0
    while (x + slack) * (c + slack) + (c + slack) ** 2 / 2 >= _EXACT:
        x, c, shift = x / 2, c / 2, shift + 1
    return shift


def _divide(rows: I16 | I32 | I64, shift: int) -> I64:
    """Return integers divided by 2**shift, rounded to the nearest, halves up."""
    return (rows.astype(np.int64) + ((1 << shift) >> 1)) >> shift


def _table(entries: I64) -> F32:
    """Return the rows [c, -|c|²/2] of the entries, [K, D + 1]."""
    half = np.einsum("kd,kd->k", entries, entries) * -0.5
    return np.concatenate([entries, half[:, None]], axis=1).astype(np.float32)


def _every_entry(table: F32) -> _Search:
    """Return a search of every entry in a `_table`, [K, D + 1]."""
    matrix = np.ascontiguousarray(table.T)
    width = min(matrix.shape[1], _PRODUCT_COLUMNS)
    step = _PRODUCT // width

    def search(x: F32, own: I32 | None, found: I32, best: F32) -> None:
        for first_row in range(0, len(x), step):
            part = slice(first_row, first_row + step)
            rows = np.arange(len(x[part]))
            for first_entry in range(0, matrix.shape[1], width):
                scores = x[part] @ matrix[:, first_entry : first_entry + width]
                if own is not None:
                    _exclude(scores, own[part] - first_entry)
                _keep_better(rows, scores, first_entry, found[part], best[part])

    return search


def _near_entries(table: F32, ends: I64, centres: F32, near: int) -> _Search:
    """Return a search of the entries in the `near` groups whose centres are nearest to a point.

    Args:
        table: [K, D + 1], the `_table` of the entries, group by group.
        ends: [G + 1], where groups begin and end.
        centres: [G, D + 1], the `_table` of the centres.
        near: number of groups per point, > 0.
    """
    matrices = [np.ascontiguousarray(table[a:b].T) for a, b in pairwise(ends)]
    coarse = np.ascontiguousarray(centres.T)

    def search(x: F32, own: I32 | None, found: I32, best: F32) -> None:
        for group_rows, group in _by_group(x @ coarse, near):
            width = matrices[group].shape[1]
            for rows in np.array_split(group_rows, -(-len(group_rows) * width // _PRODUCT)) if width else ():
                scores = np.take(x, rows, axis=0) @ matrices[group]  # unlike x[rows], `take` releases the GIL
                if own is not None:
                    _exclude(scores, own[rows] - ends[group])
                _keep_better(rows, scores, int(ends[group]), found, best)

    return search


def _exclude(scores: F32, columns: NDArray[Any]) -> None:
    """Set the score of one column of each row to -infinity; columns [n] outside of the scores [n, k] are ignored."""
    inside = np.flatnonzero((columns >= 0) & (columns < scores.shape[1]))
    scores[inside, columns[inside]] = -np.inf


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


def _keep_better(rows: I64, scores: F32, first: int, index: I32, best: F32) -> None:
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


def _fits_int16(rows: I16 | I32 | I64) -> bool:
    """Return True if all integers of rows [N, D] have 16 bits."""
    if rows.dtype == np.int16:
        return True
    bounds = np.iinfo(np.int16)
    return int(rows.min(initial=0)) >= bounds.min and int(rows.max(initial=0)) <= bounds.max


@cache
def _compiled_search() -> NearestEntries | None:
    """Return the compiled search of an installed package; `None` without one."""
    plugin = load_plugins("csplat.kernels").get("nearest_entries")
    search: NearestEntries | None = None if plugin is None else plugin()
    return search


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
