"""Find the source splat of each decoded one: the only one nearby, since the inputs keep splats apart."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from csplat.types import F64, I64

_NONE = -1
_CELL_MAX = 2.0**40  # centres more cells away from the origin than this share a cell; distance decides anyway
_MIX = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F), np.uint64(0x165667B19E3779F9))


@dataclass(frozen=True)
class Pairs:
    """Pairs of decoded splats and source splats.

    Attributes:
        source_index: [N], the source splat of each decoded splat; −1 if none is near.
        strays: decoded splats without a source.
        surplus: decoded splats whose source splat is already paired with another.
        missing: source splats without a decoded splat.
        examples: index of the first of `strays` and of `surplus`; −1 if there is none.
    """

    source_index: I64
    strays: int
    surplus: int
    missing: int
    examples: tuple[int, int] = (_NONE, _NONE)


def pair(source: F64, decoded: F64, apart: float) -> Pairs:
    """Pair splats by their centres.

    Args:
        source: [M, 3]; different centres are at least `apart` from each other. Equal ones are exact duplicates, which
            are paired one by one.
        decoded: [N, 3].
        apart: a decoded splat belongs to the source centre that is nearer than half of this.
    """
    if not len(source) or not len(decoded):
        first_stray = 0 if len(decoded) else _NONE
        return Pairs(np.full(len(decoded), _NONE, np.int64), len(decoded), 0, len(source), (first_stray, _NONE))
    centres, member_of, counts = np.unique(source, axis=0, return_inverse=True, return_counts=True)
    group = _nearest(centres, decoded, apart)
    members = np.argsort(member_of.reshape(-1), kind="stable")
    first = np.concatenate([[0], np.cumsum(counts)])
    index = np.full(len(decoded), _NONE, np.int64)
    near = np.flatnonzero(group != _NONE)
    order = near[np.argsort(group[near], kind="stable")]
    groups = group[order]
    rank = np.arange(len(order)) - np.searchsorted(groups, groups, "left")
    taken = rank < counts[groups]
    index[order[taken]] = members[first[groups[taken]] + rank[taken]]
    paired = int(taken.sum())
    examples = _first(group == _NONE), _first((group != _NONE) & (index == _NONE))
    return Pairs(index, len(decoded) - len(near), len(near) - paired, len(source) - paired, examples)


def _first(which: NDArray[np.bool_]) -> int:
    return int(which.argmax()) if which.any() else _NONE


def _nearest(centres: F64, decoded: F64, apart: float) -> I64:
    """Return for each decoded centre the source centre that is nearer than half of `apart`, or −1."""
    keys = _keys(_cells(centres, apart))
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    own = _cells(decoded, apart)
    found = np.full(len(decoded), _NONE, np.int64)
    left = np.arange(len(decoded))
    # Its own cell first: most need no other one.
    for step in sorted(product((-1, 0, 1), repeat=3), key=lambda step: sum(map(abs, step))):
        wanted = _keys(own[left] + np.array(step, np.int64))
        first, last = np.searchsorted(keys, wanted, "left"), np.searchsorted(keys, wanted, "right")
        # One cell holds few centres, since its side is their distance.
        for nth in range(int((last - first).max(initial=0))):
            more = first + nth < last
            rows, candidates = left[more], order[first[more] + nth]
            moved = decoded[rows] - centres[candidates]
            good = np.sqrt(np.square(moved).sum(axis=1)) < apart / 2.0
            found[rows[good]] = candidates[good]
        left = left[found[left] == _NONE]
    return found


def _cells(points: F64, side: float) -> I64:
    with np.errstate(over="ignore", invalid="ignore"):
        cells = np.clip(np.floor(points / side), -_CELL_MAX, _CELL_MAX)
    result: I64 = np.nan_to_num(cells).astype(np.int64)
    return result


def _keys(cells: I64) -> NDArray[np.uint64]:
    """Mix three numbers into one; equal keys of unequal cells cost a comparison, no more."""
    keys = np.zeros(len(cells), np.uint64)
    for axis, factor in enumerate(_MIX):
        keys ^= cells[:, axis].astype(np.uint64) * factor
        keys ^= keys >> np.uint64(29)
    return keys
