# SPDX-License-Identifier: Apache-2.0
"""Divide a large scene into buckets of neighbours, and survey it.

A scene of up to `EncodeOptions.bucket_splats` splats is one bucket. For a larger scene, a sample of that size is
analysed: all choices are made on it, and a Morton curve through it divides space into buckets. Each bucket is cut into
tiles by itself, so that only one bucket has to be in memory, and the file does not depend on the available memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from csplat.context import Context
from csplat.encoder.coding_parameters import contrast_of, contrast_sums
from csplat.encoder.entropy import morton_codes
from csplat.encoder.sh_codebook import largest_sh
from csplat.model import SplatModel
from csplat.types import F32, F64, I64

Rows = NDArray[np.intp]
Item = TypeVar("Item")

_BUCKET_FILL = 0.8  # fraction of a bucket to fill; the sample predicts bucket sizes within a few per cent
_CURVE_EDGE = 0.005  # fraction of the splats beyond either side of the curve's cube
_CURVE_TOP = (1 << 16) - 1  # cells along a side of the cube, minus one
_CURVE_BLOCK = 1 << 16  # splats per block of temporaries
_CONTRAST_BUCKETS = 16  # buckets in which the contrast is measured


@dataclass(frozen=True, eq=False)
class SceneSurvey:
    """The values that choices for a scene of several buckets depend on.

    Attributes:
        sample: the splats `sample_rows` of the scene.
        count: number of splats of the scene.
        largest_sh: largest magnitude of the SH coefficients of all splats.
        contrast: contrast of the scene, see `contrast_of`.
    """

    sample: SplatModel
    count: int
    largest_sh: float
    contrast: float


class BucketStore(Protocol):
    """The splats of a scene of several buckets, in memory or on disk."""

    @property
    def model(self) -> SplatModel:
        """The scene; without splats if they are on disk."""
        ...

    @property
    def rows(self) -> Sequence[Rows]:
        """Rows of the model in each bucket, ascending; none if the splats are on disk."""
        ...

    def survey(self) -> SceneSurvey:
        """Survey the scene."""
        ...


@dataclass(frozen=True, eq=False)
class MemoryBuckets:
    """A bucket store in memory, which shares the arrays of the scene; see `BucketStore`."""

    model: SplatModel
    rows: Sequence[Rows]
    bucket_splats: int
    context: Context

    @classmethod
    def of(cls, model: SplatModel, bucket_splats: int, context: Context) -> MemoryBuckets:
        """Sort the splats of a scene into buckets, which are surveyed on threads."""
        return cls(model, bucket_rows(model.means, bucket_splats), bucket_splats, context)

    def survey(self) -> SceneSurvey:
        """Survey the scene."""
        plain = replace(self.model, shN=self.model.shN[:, :0], extra={})  # SH has no influence, and takes most memory
        with ThreadPoolExecutor(self.context.thread_count) as pool:
            sums = pool.map(lambda rows: contrast_sums(plain.select(rows)), contrast_buckets(self.rows))
            largest = pool.map(largest_sh, np.array_split(self.model.shN, len(self.rows)))
            sample = pool.submit(self.model.select, sample_rows(len(self.model), self.bucket_splats))
            return SceneSurvey(sample.result(), len(self.model), max(largest), contrast_of(sums))


@dataclass(frozen=True, eq=False)
class BucketCurve:
    """A Morton curve through space, divided into buckets.

    Attributes:
        corner: [3] float64, corner of the cube that the curve fills; splats outside are clamped to it.
        scale: cells per scene unit.
        bounds: [B - 1] int64, first code of each bucket except the first, ascending.
    """

    corner: F64
    scale: float
    bounds: I64

    @classmethod
    def through(cls, means: F32, count: int, bucket_splats: int) -> BucketCurve:
        """Divide the curve into buckets of about equal numbers of splats.

        Args:
            means: [n, 3] float32, means of the sample.
            count: number of splats in the scene.
            bucket_splats: maximum number of splats in a bucket.
        """
        if count <= bucket_splats:
            return cls(np.zeros(3), 0.0, np.zeros(0, np.int64))
        points = np.sort(means.astype(np.float64), axis=0)
        edge = int(len(points) * _CURVE_EDGE)
        low, high = points[edge], points[len(points) - 1 - edge]
        side = float((high - low).max())
        curve = cls(low, _CURVE_TOP / side if side > 0.0 else 0.0, np.zeros(0, np.int64))
        buckets = math.ceil(count / (_BUCKET_FILL * bucket_splats))
        codes = np.sort(curve._codes(means))
        starts = np.arange(1, buckets, dtype=np.int64) * len(codes) // buckets
        return cls(curve.corner, curve.scale, np.unique(codes[starts]))

    @property
    def count(self) -> int:
        """Number of buckets."""
        return len(self.bounds) + 1

    def bucket_of(self, means: F32) -> Rows:
        """Return the bucket of each splat, [n]."""
        if not len(self.bounds):
            return np.zeros(len(means), np.intp)
        return np.searchsorted(self.bounds, self._codes(means), side="right")

    def _codes(self, means: F32) -> I64:
        """Return the Morton codes of means [n, 3], int64 [n]; positions outside the curve are clipped to it."""
        codes = np.empty(len(means), np.int64)
        for start in range(0, len(means), _CURVE_BLOCK):
            cells = (means[start : start + _CURVE_BLOCK].T.astype(np.float64) - self.corner[:, None]) * self.scale
            codes[start : start + _CURVE_BLOCK] = morton_codes(np.clip(cells, 0, _CURVE_TOP).astype(np.int32))
        return codes


def bucket_rows(means: F32, bucket_splats: int) -> Sequence[Rows]:
    """Return the rows of each bucket of a scene in memory, ascending."""
    if len(means) <= bucket_splats:
        return [np.arange(len(means), dtype=np.intp)]
    curve = BucketCurve.through(means[sample_rows(len(means), bucket_splats)], len(means), bucket_splats)
    bucket = curve.bucket_of(means)
    order = np.argsort(bucket, kind="stable")
    ends = np.searchsorted(bucket[order], np.arange(curve.count + 1))
    buckets = [order[start:end] for start, end in pairwise(ends)]
    return [rows[part] for rows in buckets for part in bucket_slices(len(rows), bucket_splats) if len(rows)]


def bucket_slices(count: int, bucket_splats: int) -> list[slice]:
    """Split a bucket of more than `bucket_splats` splats into equal parts, in the scene's order."""
    parts = max(1, math.ceil(count / bucket_splats))
    return [slice(count * part // parts, count * (part + 1) // parts) for part in range(parts)]


def sample_rows(count: int, bucket_splats: int) -> I64:
    """Return the evenly spaced rows of the sample of a scene of several buckets."""
    return np.arange(bucket_splats, dtype=np.int64) * count // bucket_splats


def contrast_buckets(buckets: Sequence[Item]) -> list[Item]:
    """Return the buckets in which the contrast is measured; a sample of the scene has no neighbours for it."""
    chosen = {index * len(buckets) // _CONTRAST_BUCKETS for index in range(_CONTRAST_BUCKETS)}
    return [buckets[index] for index in sorted(chosen)]
