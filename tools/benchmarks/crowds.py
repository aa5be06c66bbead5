"""Scenes with a stated number of splats in view, and the cameras that see them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scenes import BLOWN_UP, CROWDS, DATA

from csplat.model import SplatModel, normalise_quats
from csplat_render import Camera
from csplat_render.cameras import load_cameras
from csplat_render.rasterise import Rasteriser
from csplat_render.virtual import virtual_cameras

__all__ = ["cameras_of", "crowd", "split"]


def cameras_of(name: str, model: SplatModel) -> list[Camera]:
    """The eight cameras of the data folder for a scene or what it was made of; else the virtual ones."""
    made_of = {name: source for name, source, _ in (*BLOWN_UP, *CROWDS)}
    path = DATA / "psnr_cameras" / f"{made_of.get(name, name)}.json"
    return load_cameras(path) if path.exists() else virtual_cameras(model)


def crowd(model: SplatModel, cameras: Sequence[Camera], count: int, seed: int = 0) -> SplatModel:
    """Make a scene of which so many splats lie in view, looking much as it did.

    Splats are split as training does it; those that no camera sees are left out, and so are others by chance.

    Args:
        model: a scene.
        cameras: who sees it.
        count: median over the cameras of the splats in view.
        seed: of everything by chance.
    """
    rng = np.random.default_rng(seed)
    rasteriser = Rasteriser(gradients=False)
    seen = np.median([rasteriser.forward(model, camera).drawn for camera in cameras])
    model = split(model, math.ceil(1.1 * count / seen), rng)
    views = np.array([rasteriser.forward(model, camera).radii > 0 for camera in cameras])
    share = count / float(np.median(views.sum(axis=1)))
    return model.select(np.flatnonzero(views.any(axis=0) & (rng.random(len(model)) < share)))


def split(model: SplatModel, parts: int, rng: np.random.Generator) -> SplatModel:
    """Replace each splat by some that are smaller, at places drawn from it."""
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
