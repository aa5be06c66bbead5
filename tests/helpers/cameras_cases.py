# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of cameras, which several files share."""

import numpy as np
from checked import cloud

from csplat_render.camera import intrinsics

K = intrinsics(640, 480, 60.0)
UP = np.array([0.0, 0.0, 1.0])


def figure(seed=0):
    """Return a round body with thin legs (y points down) and a few floaters, and the number of splats without these."""
    rng = np.random.default_rng(seed)
    heights = 0.95 + 1.2 * rng.random(60)
    legs = np.stack([np.where(np.arange(60) % 2, 0.3, -0.3), heights, 0.02 * rng.standard_normal(60)], axis=1)
    crumbs = [[9.0, 9.0, 9.0], [-8.0, 0.0, 0.0], [-8.1, 0.1, 0.0]]
    return cloud(np.concatenate([on_a_sphere(rng, 2000), legs, crumbs])), 2060


def on_a_sphere(rng, count, radius=1.0):
    points = rng.standard_normal((count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def same(cameras, others):
    return all((a.viewmat == b.viewmat).all() for a, b in zip(cameras, others, strict=True))


def niche(seed=0):
    """Return fine splats in front of a coarse wall at x = -1, within a large coarse room."""
    rng = np.random.default_rng(seed)
    things = 0.3 * rng.standard_normal((5000, 3))
    wall = np.stack([np.full(900, -1.0), *(6.0 * rng.random((2, 900)) - 3.0)], axis=1)
    sizes = np.repeat([0.02, 0.3, 0.4], [5000, 900, 1500])
    return cloud(np.concatenate([things, wall, on_a_sphere(rng, 1500, 6.0)]), sizes)


def ball(count=1500, radius=1.0, seed=0, **fields):
    return cloud(on_a_sphere(np.random.default_rng(seed), count, radius), **fields)
