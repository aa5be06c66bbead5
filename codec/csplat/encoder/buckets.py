"""Scenes of many splats: a sample that decisions are made on, and buckets of neighbours that are coded one by one.

A scene of up to `WHOLE` splats is analysed as a whole. From a larger one, `WHOLE` splats, evenly spaced, are analysed
instead; a curve through them cuts space into buckets, and no more than a bucket has to be in memory at once.
Neither depends on how much memory there is, so the file does not depend on it either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.morton import morton_codes
from csplat.types import F32, I64

Rows = NDArray[np.intp]

#: Splats that are analysed as a whole: the most in a bucket, and the size of the sample of a larger scene.
WHOLE = 1 << 19

_FULL = 0.8  # fraction of a bucket to fill: the sample predicts bucket sizes within a few per cent
_EDGE = 0.005  # fraction of the splats on either side that lies beyond the curve's cube
_TOP = (1 << 16) - 1  # cells along a side of the cube, less one
_BLOCK = 1 << 16
_LOOKED_AT = 16  # buckets that are examined for how neighbours differ


@dataclass(frozen=True, eq=False)
class Curve:
    """A Morton curve through space, cut into buckets.

    Attributes:
        corner: [3] float64, corner of the cube that the curve fills; splats outside count as on its faces.
        scale: cells per scene unit.
        bounds: [B - 1] int64, codes at which the buckets but the first begin, ascending.
    """

    corner: NDArray[np.float64]
    scale: float
    bounds: I64

    @classmethod
    def through(cls, means: F32, count: int) -> Curve:
        """Cut the curve so that buckets get about equally many splats.

        Args:
            means: [n, 3] float32, means of the sample.
            count: splats in the scene.
        """
        if count <= WHOLE:
            return cls(np.zeros(3), 0.0, np.zeros(0, np.int64))
        points = np.sort(means.astype(np.float64), axis=0)
        edge = int(len(points) * _EDGE)
        low, high = points[edge], points[len(points) - 1 - edge]
        side = float((high - low).max())
        curve = cls(low, _TOP / side if side > 0.0 else 0.0, np.zeros(0, np.int64))
        buckets = math.ceil(count / (_FULL * WHOLE))
        codes = np.sort(curve._codes(means))
        places = np.arange(1, buckets, dtype=np.int64) * len(codes) // buckets
        return cls(curve.corner, curve.scale, np.unique(codes[places]))

    @property
    def count(self) -> int:
        """Number of buckets."""
        return len(self.bounds) + 1

    def bucket_of(self, means: F32) -> Rows:
        """[n], the bucket of each splat."""
        if not len(self.bounds):
            return np.zeros(len(means), np.intp)
        return np.searchsorted(self.bounds, self._codes(means), side="right")

    def _codes(self, means: F32) -> I64:
        codes = np.empty(len(means), np.int64)
        for at in range(0, len(means), _BLOCK):
            cells = (means[at : at + _BLOCK].T.astype(np.float64) - self.corner[:, None]) * self.scale
            codes[at : at + _BLOCK] = morton_codes(np.clip(cells, 0, _TOP).astype(np.int32))
        return codes


def sample_rows(count: int) -> I64:
    """Return the rows of the sample that decisions are made on, for a scene of more than `WHOLE` splats."""
    return np.arange(WHOLE, dtype=np.int64) * count // WHOLE


def looked_at(buckets: int) -> list[int]:
    """Return the buckets that are examined for how neighbours differ, which a sample does not show."""
    return sorted({place * buckets // _LOOKED_AT for place in range(_LOOKED_AT)})


def slices(count: int) -> list[slice]:
    """A bucket that got more than `WHOLE` splats, since the sample misled: equal parts of it, in the scene's order."""
    parts = max(1, math.ceil(count / WHOLE))
    return [slice(count * part // parts, count * (part + 1) // parts) for part in range(parts)]


def bucket_rows(means: F32) -> Sequence[Rows]:
    """Rows of each bucket of a scene in memory, ascending."""
    if len(means) <= WHOLE:
        return [np.arange(len(means), dtype=np.intp)]
    curve = Curve.through(means[sample_rows(len(means))], len(means))
    bucket = curve.bucket_of(means)
    order = np.argsort(bucket, kind="stable")
    ends = np.searchsorted(bucket[order], np.arange(curve.count + 1))
    found = [order[start:end] for start, end in pairwise(ends)]
    return [rows[part] for rows in found for part in slices(len(rows)) if len(rows)]
