# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of sensitivity, which several files share."""

import numpy as np
from models import model_of

from csplat.model import normalise_quats
from csplat_render.camera import intrinsics, look_at


def small_scene(count=6, degree=2, seed=0, **fields):
    rng = np.random.default_rng(seed)
    return model_of(
        means=rng.normal(0, 0.5, (count, 3)).astype(np.float32),
        quats=normalise_quats(rng.normal(size=(count, 4)).astype(np.float32)),
        scales=rng.normal(-1.6, 0.4, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.95, count).astype(np.float32),
        sh0=rng.normal(0.5, 0.5, (count, 3)).astype(np.float32),
        shN=rng.normal(0, 0.1, (count, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
        **fields,
    )


def cameras(count=2, size=(40, 32)):
    K = intrinsics(*size, 50.0)
    up = np.array([0.0, 1.0, 0.0])
    eyes = [np.array([3 * np.sin(a), 0.6, 3 * np.cos(a)]) for a in np.arange(count) * 2.1]
    return [look_at(eye, np.zeros(3), up, K, *size, 0.1) for eye in eyes]


def views(count=3, size=(40, 30)):
    return cameras(count, size)


def scene(count=60, degree=3, seed=0):
    return small_scene(count, degree, seed)
