# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of codebooks, which several files share."""

from __future__ import annotations

import numpy as np

from csplat.encoder.splat_importance import ErrorMetric
from csplat.model import normalise_quats


def scene(count=400, size=3, channels=2, entry_count=30, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 40, (count, size, channels))
    roots = rng.normal(size=(count, size, size))
    matrices = roots @ roots.transpose(0, 2, 1)
    rows, columns = np.triu_indices(size)
    metric = ErrorMetric(rng.random(count).astype(np.float32), matrices[:, rows, columns].astype(np.float32))
    entries = np.rint(points[:entry_count]).astype(np.int32)
    return points, matrices, metric, entries


def exact(difference, matrices, weights):
    return np.einsum("nic,nij,njc->n", difference, matrices, difference) * weights


def few_shapes(make_model, count=2500, kinds=12, seed=0, degree=1, **fields):
    """Return a model of a few shapes, which vary in size and a little noise."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, kinds, count)
    quats = normalise_quats(rng.normal(size=(kinds, 4)))[kind] + rng.normal(0, 0.01, (count, 4))
    scales = rng.normal(0, 1, (kinds, 3))[kind] + rng.normal(-4, 0.7, (count, 1)) + rng.normal(0, 0.02, (count, 3))
    arrays = {"quats": normalise_quats(quats.astype(np.float32)), "scales": scales.astype(np.float32)}
    return make_model(count, degree, **{**arrays, **fields})
