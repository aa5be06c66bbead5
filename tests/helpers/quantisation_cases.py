# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of quantisation, which several files share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from csplat import decode
from csplat.encoder import Importance
from csplat.encoder.splat_importance import GaussNewtonBlocks

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def moved(fixed, seed=1, share=0.3):
    """Return values after a random walk, which goes further than any tuning."""
    values, rng = fixed.start(), np.random.default_rng(seed)
    for name in ("means", "quats", "scales", "sh0", "sh", "sizes"):
        array = getattr(values, name)
        if array.size:
            array += (share * array.std() * rng.standard_normal(array.shape)).astype(np.float32)
    values.opacities[:] = np.clip(values.opacities + 0.2 * rng.standard_normal(len(values.opacities)), 0.0, 1.0)
    values.quats /= np.linalg.norm(values.quats, axis=1, keepdims=True)
    fixed.constrain(values)
    return values


def assert_dequantised_as_decoded(fixed, values, result):
    places = np.full(len(fixed.source), -1)
    places[fixed.source_index] = np.arange(len(fixed.source_index))
    rows, expected, decoded = places[result.source_index], fixed.dequantise(values), decode(result.data)
    assert sorted(rows) == list(range(len(rows)))
    for name in ARRAYS:
        assert getattr(decoded, name).tobytes() == getattr(expected, name)[rows].tobytes(), name


COUNT = 5_000  # splats; enough for several classes


def unequal(model, seed=0, spread=3.0):
    """Return blocks that differ from splat to splat by orders of magnitude."""
    rng = np.random.default_rng(seed)
    size = rng.lognormal(0.0, spread, len(model))
    roots = rng.normal(size=(len(model), 6, 3))
    rows, columns = np.triu_indices(6)
    matrices = (roots @ roots.transpose(0, 2, 1))[:, rows, columns]
    return GaussNewtonBlocks(size, matrices * size[:, None], 1e3 * size, size)


def important(model, **changes):
    return Importance(np.ones(len(model)), blocks=replace(unequal(model), **changes))
