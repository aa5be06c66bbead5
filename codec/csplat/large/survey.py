"""The first pass over a scene: a sample of it, on which is decided, and how its buckets lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from csplat.encoder.sh_codebook import largest_sh
from csplat.encoder.tiling import BucketCurve, sample_rows
from csplat.large.bucket_files import Layout
from csplat.model import SplatModel
from csplat.scene import Scene


@dataclass(frozen=True, eq=False)
class Survey:
    """Results of one pass over all splats of a scene.

    Attributes:
        sample: some of its splats, in the scene's order.
        largest: magnitude of its largest SH coefficient.
        curve: its buckets.
    """

    sample: SplatModel
    largest: float
    curve: BucketCurve


def take_survey(scene: Scene, layout: Layout) -> Survey:
    """Look at a scene of more than `WHOLE` splats, and take a sample that has the arrays of the layout.

    Raises:
        CsplatError: its blocks cannot be read.
        OSError: likewise.
    """
    rows = sample_rows(scene.count)
    arrays, largest = layout.empty(len(rows)), 0.0
    for where, block in scene.numbered():
        first, last = np.searchsorted(rows, (where.start, where.stop))
        for array, values in zip(arrays, layout.arrays(block), strict=True):
            array[first:last] = values[rows[first:last] - where.start]
        largest = max(largest, largest_sh(block.shN))
    sample = layout.model(arrays)
    return Survey(sample, largest, BucketCurve.through(sample.means, scene.count))
