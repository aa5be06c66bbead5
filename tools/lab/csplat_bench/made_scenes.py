# SPDX-License-Identifier: Apache-2.0
"""Scenes made of others: copies side by side, and a given number of splats in view."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from csplat.model import SplatModel, normalise_quats
from csplat.types import F32
from csplat_render import Camera
from csplat_render.rasteriser import Rasteriser

#: Arrays of a model.
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def copies(model: SplatModel, count: int, seed: int = 0) -> Iterator[SplatModel]:
    """Yield copies of a scene to lay side by side, each a little different in every number.

    Args:
        model: a scene.
        count: splats of all copies together.
        seed: seed of the differences.
    """
    rng = np.random.default_rng(seed)
    low, high = np.quantile(model.means, (0.01, 0.99), axis=0)
    many = math.ceil(count / len(model))
    columns = math.ceil(math.sqrt(many))
    for copy in range(many):
        part = model.select(slice(0, min(len(model), count - copy * len(model))))
        shift = (high - low) * 1.5 * np.array([copy % columns, copy // columns, 0])
        yield _vary(part, rng, shift.astype(np.float32)) if copy else part


def _vary(model: SplatModel, rng: np.random.Generator, shift: F32) -> SplatModel:
    def noise(like: F32, sigma: float) -> F32:
        return rng.standard_normal(like.shape, np.float32) * np.float32(sigma)

    size = np.exp(model.scales.max(axis=1, keepdims=True))
    return replace(
        model,
        means=model.means + shift + noise(model.means, 0.1) * np.minimum(size, np.float32(1.0)),
        quats=normalise_quats(model.quats + noise(model.quats, 0.01)),
        scales=model.scales + noise(model.scales, 0.02),
        opacities=np.clip(model.opacities * (1 + noise(model.opacities, 0.02)), 0, 1),
        sh0=model.sh0 + noise(model.sh0, 0.01),
        shN=model.shN * (1 + noise(model.shN, 0.05)),
    )


def crowd(model: SplatModel, cameras: Sequence[Camera], count: int, seed: int = 0) -> SplatModel:
    """Make a scene with `count` splats in view that looks like the given one.

    Splats are split as training splits them; those that no camera sees are left out, and so are others at random.

    Args:
        model: a scene.
        cameras: the cameras that see it.
        count: median over the cameras of the splats in view.
        seed: seed of all random choices.
    """
    rng = np.random.default_rng(seed)
    rasteriser = Rasteriser()
    seen = np.median([rasteriser.forward(model, camera).drawn for camera in cameras])
    model = split(model, math.ceil(1.1 * count / seen), rng)
    views = np.array([rasteriser.forward(model, camera).radii > 0 for camera in cameras])
    share = count / float(np.median(views.sum(axis=1)))
    return model.select(np.flatnonzero(views.any(axis=0) & (rng.random(len(model)) < share)))


def split(model: SplatModel, parts: int, rng: np.random.Generator) -> SplatModel:
    """Replace each splat by smaller ones, whose positions are drawn from it."""
    many = model.select(np.repeat(np.arange(len(model)), parts))
    smaller = parts**-0.5
    quats = normalise_quats(many.quats).astype(np.float64)
    step = rng.standard_normal((len(many), 3)) * np.exp(many.scales.astype(np.float64)) * math.sqrt(1.0 - smaller**2)
    w, v = quats[:, :1], quats[:, 1:]
    twice = 2.0 * np.cross(v, step)
    return replace(
        many,
        means=(many.means + step + w * twice + np.cross(v, twice)).astype(np.float32),
        scales=(many.scales + math.log(smaller)).astype(np.float32),
    )
