# SPDX-License-Identifier: CC0-1.0
"""Rendered scenes and their cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.recipe import Recipe, View
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    as_binary32,
    attributes,
    axis,
    integers,
    levels,
    means_rows,
    offset,
    quat_rows,
    rows_of,
    sh_attribute,
    signed,
)
from csplat_authoring.scene import PAIRS, Attribute, Scene, Tile

_SIDE = 128  # pixels
_NEAR = 0.2  # scene units
_PSNR = 45.0  # dB; rounding to 8 bits gives 59, cutting splats at three standard deviations 40
_MEANS_STEP, _MEANS_CELLS = 1 / 128, 256  # a box of two scene units
_SCALES_STEP = as_binary32(0.05)

_Vec = tuple[float, float, float]


def rendered_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [_ellipsoids(), _harmonics("harmonics", 3), _antialiased(), _harmonics("harmonics_4", 4)]


def _ellipsoids() -> Recipe:
    made = _scene(0, 90, (-4.2, -1.6))
    return _recipe(
        "ellipsoids",
        "overlapping splats of any rotation and shape, from outside and from amidst them",
        made,
        [_camera((0.4, -0.6, -3.2), (0.0, 0.0, 0.0)), _camera((0.3, 0.1, 0.5), (-1.0, 0.2, -1.0), focal=70.0)],
    )


def _harmonics(name: str, degree: int) -> Recipe:
    made = _scene(degree, 40, (-2.6, -1.4))
    return _recipe(
        name,
        f"colours of degree {degree} that depend on the direction, some below 0, from two sides; the origin is not"
        " added",
        replace(made, origin=(1000.0, -2000.0, 0.25)),
        [_camera((2.6, -1.0, -1.4), (0.0, 0.0, 0.0)), _camera((-2.2, 1.5, 1.8), (0.1, 0.0, 0.0))],
    )


def _antialiased() -> Recipe:
    made = _scene(1, 500, (-5.6, -3.0))
    return _recipe(
        "antialiased",
        "splats smaller than a pixel, with the low-pass filter's loss made good; off the middle of the picture",
        replace(made, antialiasing=_spec.ANTIALIASING_MIP),
        [
            _camera((1.5, 2.0, -3.4), (0.0, 0.0, 0.0), focal=170.0),
            _camera((0.0, -0.4, 2.6), (0.3, 0.3, 0.0), centre=(40.0, 80.0)),
        ],
    )


def _recipe(name: str, why: str, made: Scene, cameras: list[dict[str, Any]]) -> Recipe:
    views = tuple(View(camera, _PSNR) for camera in cameras)
    return Recipe(f"render/{name}", why, ("CNF-1",), lambda: build(made).data, made, views=views)


def _scene(degree: int, n: int, scales: tuple[float, float]) -> Scene:
    """Return pseudo-random splats in a box from −1 to 1.

    Args:
        degree: SH degree.
        n: number of splats.
        scales: smallest and largest log scale.
    """
    low, high = (round(value / _SCALES_STEP) for value in scales)
    blocks = {
        OPACITIES: levels(integers(n, n, 60, 255)),
        SCALES: offset(rows_of(n + 1, n, 3, low, high)),
        QUATS: signed(quat_rows(n + 2, n)),
        MEANS: axis(means_rows(n + 3, n, _MEANS_CELLS), PAIRS),
        SH0: offset(rows_of(n + 4, n, 3, -50, 60)),
    }
    for band in range(1, degree + 1):
        blocks[sh_attribute(band)] = signed(rows_of(n + 4 + band, n, 3 * (2 * band + 1), -25, 25))
    records = attributes(degree) | {
        OPACITIES: Attribute(_spec.MAPPING_SQUARE, levels=255),
        SCALES: Attribute(_spec.MAPPING_LATTICE, _SCALES_STEP),
        MEANS: Attribute(_spec.MAPPING_LATTICE, _MEANS_STEP),
    }
    half = _MEANS_CELLS // 2
    return Scene(records, (Tile(blocks, corner=(-half, -half, -half)),), sh_degree=degree)


def _camera(
    position: _Vec, target: _Vec, focal: float = 150.0, centre: tuple[float, float] = (64.0, 64.0)
) -> dict[str, Any]:
    """Return a camera that looks at a point; the up direction is −y."""
    forward = _unit(tuple(t - p for t, p in zip(target, position, strict=True)))
    right = _unit(_cross((0.0, 1.0, 0.0), forward))
    rows = (right, _cross(forward, right), forward)
    viewmat = [
        # By fsum, since sum rounds otherwise from Python 3.12 on; without a zero's sign, which depends on the rounding.
        [
            *(round(value, 9) for value in row),
            0.0 - round(math.fsum(r * p for r, p in zip(row, position, strict=True)), 9),
        ]
        for row in rows
    ]
    return {
        "K": [[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]],
        "viewmat": [*viewmat, [0.0, 0.0, 0.0, 1.0]],
        "W": _SIDE,
        "H": _SIDE,
        "near": _NEAR,
    }


def _unit(v: tuple[float, ...]) -> tuple[float, ...]:
    length = math.sqrt(math.fsum(x * x for x in v))
    return tuple(x / length for x in v)


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
