"""Change a scene on its way from one file to another, some splats at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.scene import Scene, without_bands
from csplat.turning import in_axes, moved, scaled, turned
from csplat.types import F64, Mask

_CELL = 0.01  # fraction of a scene's extent: distance within which neighbours count for any splat
_SPREAD = 4.0  # standard deviations of a splat: distance within which neighbours count if that is farther
_COMPANY = 8  # number of splats, itself included: with fewer in its neighbourhood a splat is a floater


@dataclass(frozen=True)
class Filters:
    """Changes of a scene, applied in the order of the fields; `None` and False change nothing.

    Attributes:
        to_axes: turn the scene to these axes, as in `SplatModel`; a scene without axes is taken to have x right,
            y down, z forward.
        rotate: rotate about x, y, z in this order, degrees, counter-clockwise as seen from the tip of the axis.
        scale: factor by which the scene is enlarged about the origin of its coordinates.
        translate: offset added to all positions, scene units.
        crop_box: keep splats whose centres lie between two corners, x y z each.
        crop_sphere: keep splats whose centres lie within a sphere, x y z and radius.
        drop_floaters: drop splats that have next to no others around them.
        sh_degree: leave out the SH bands above.
    """

    to_axes: str | None = None
    rotate: tuple[float, float, float] | None = None
    scale: float | None = None
    translate: tuple[float, float, float] | None = None
    crop_box: tuple[float, ...] | None = None
    crop_sphere: tuple[float, ...] | None = None
    drop_floaters: bool = False
    sh_degree: int | None = None

    def applied(self, scene: Scene) -> Scene:
        """Return the changed scene."""
        if self.to_axes is not None:
            scene = in_axes(scene, self.to_axes)
        if self.rotate is not None:
            matrix = _rotation(self.rotate)
            scene = _changed(scene, lambda model: turned(model, matrix))
        if self.scale is not None:
            factor = self.scale
            scene = _changed(scene, lambda model: scaled(model, factor))
        if self.translate is not None:
            offset = self.translate
            scene = _changed(scene, lambda model: moved(model, offset))
        if self.crop_box is not None:
            corners = np.sort(np.array(self.crop_box).reshape(2, 3), axis=0)
            scene = _kept(scene, lambda model: _inside_box(model, corners))
        if self.crop_sphere is not None:
            sphere = np.array(self.crop_sphere)
            scene = _kept(scene, lambda model: _inside_sphere(model, sphere))
        if self.drop_floaters:
            scene = _without_floaters(scene)
        if self.sh_degree is not None:
            degree = self.sh_degree
            scene = _changed(scene, lambda model: without_bands(model, degree))
        return scene


def isolated(points: F64, sizes: F64) -> Mask:
    """Find splats with next to no others around them: within 1 % of the extent, or four times their own size.

    Args:
        points: [N, 3] centres.
        sizes: [N] standard deviations, scene units.

    Returns:
        [N] bool, True for isolated splats.
    """
    if len(points) < _COMPANY:
        return np.zeros(len(points), np.bool_)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    extent = float(np.sqrt(np.sum((high - low) ** 2)))
    if not extent > 0.0:
        return np.zeros(len(points), np.bool_)
    with np.errstate(divide="ignore", over="ignore"):
        octaves = np.ceil(np.log2(np.maximum(_SPREAD * sizes / (_CELL * extent), 1.0)))
    octaves = np.minimum(octaves, 40.0).astype(np.int64)
    found = np.zeros(len(points), np.bool_)
    for octave in np.unique(octaves):
        cells = np.floor(np.clip((points - low) / (_CELL * extent * 2.0**octave), -(2.0**19), 2.0**19)).astype(np.int64)
        keys, counts = np.unique(_key(cells), return_counts=True)
        own = np.flatnonzero(octaves == octave)
        company = np.zeros(len(own), np.int64)
        for step in np.ndindex(3, 3, 3):
            wanted = _key(cells[own] + (np.array(step) - 1))
            at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            company += np.where(keys[at] == wanted, counts[at], 0)
        found[own] = company < _COMPANY
    return found


def _key(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = (cells[:, k] + (1 << 20) for k in range(3))
    key: NDArray[np.int64] = (x << 42) | (y << 21) | z
    return key


def _changed(scene: Scene, change: Callable[[SplatModel], SplatModel]) -> Scene:
    blocks = scene.blocks
    return replace(scene, facts=change(scene.facts), blocks=lambda: (change(model) for model in blocks()))


def _kept(scene: Scene, keep: Callable[[SplatModel], Mask]) -> Scene:
    def blocks() -> Iterator[SplatModel]:
        for model in scene.blocks():
            left = keep(model)
            if left.any():
                yield model.select(left)

    count = sum(int(np.count_nonzero(keep(model))) for model in scene.blocks())
    return replace(scene, count=count, blocks=blocks)


def _without_floaters(scene: Scene) -> Scene:
    """Drop isolated splats; holds centres and sizes of all splats in memory, 16 bytes each."""
    points, sizes = np.empty((scene.count, 3), np.float32), np.empty(scene.count, np.float32)
    at = 0
    for model in scene.blocks():
        part = slice(at, at + len(model))
        points[part], sizes[part] = model.means, np.exp(np.clip(model.scales.max(axis=1), -80.0, 80.0))
        at += len(model)
    floats = isolated(points.astype(np.float64), sizes.astype(np.float64))

    def blocks() -> Iterator[SplatModel]:
        at = 0
        for model in scene.blocks():
            left = ~floats[at : at + len(model)]
            at += len(model)
            if left.any():
                yield model.select(left)

    return replace(scene, count=scene.count - int(np.count_nonzero(floats)), blocks=blocks)


def _inside_box(model: SplatModel, corners: F64) -> Mask:
    places = model.means + np.array(model.origin)
    inside: Mask = ((places >= corners[0]) & (places <= corners[1])).all(axis=1)
    return inside


def _inside_sphere(model: SplatModel, sphere: F64) -> Mask:
    places = model.means + np.array(model.origin)
    inside: Mask = np.sum((places - sphere[:3]) ** 2, axis=1) <= sphere[3] ** 2
    return inside


def _rotation(degrees: tuple[float, float, float]) -> F64:
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        one = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        c, s = np.cos(angle), np.sin(angle)
        one[i, i], one[i, j], one[j, i], one[j, j] = c, -s, s, c
        matrix = one @ matrix
    return matrix
