# SPDX-License-Identifier: CC0-1.0
"""Build scenes for renders: closed surfaces of discs, like trained scenes, dense enough to reveal every mistake.

The other inputs are sparse random clouds, in which a wrong rotation or opacity hardly changes a render.
"""

from __future__ import annotations

import numpy as np

from csplat.types import F64
from csplat_conformance.encoders.reference_ply import PlyRows

Surface = tuple[F64, F64, float]  # centres, [n, 3], normals, [n, 3], approximate distance between centres

SPACING_MIN = 0.04  #: smallest distance between two centres, scene units

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
#: Directions and colours of the lights.
_LIGHTS = np.array(((0.8, -0.3, 0.5), (-0.7, 0.2, -0.6), (0.2, -0.3, -0.9), (-0.5, 0.3, 0.8)))
_LIGHT_COLOURS = np.array(((1.0, 0.9, 0.7), (0.2, 0.5, 1.0), (0.9, 0.3, 0.2), (0.3, 0.9, 0.4)))
_FACETS = 150  # number of directions to which normals are rounded
_OPPOSITE_MAX = 1e-9  # 1 + z of a normal that counts as opposite to z
_LOBE = (1.0, 0.8, 0.6)  # weight of a highlight by band


def surface_scene(gloss: float, noise: float, seed: int) -> PlyRows:
    """Return a scene of discs on a torus, a ball and a box.

    Args:
        gloss: approximate brightness of highlights.
        noise: standard deviation of the random part of each splat's coefficients.
        seed: seed of all random choices.
    """
    rng = np.random.default_rng(seed)
    surfaces = [_torus(100, 14), _ball(1100), *_box(22)]
    means, normals = (np.concatenate([surface[i] for surface in surfaces]) for i in range(2))
    spacing = np.concatenate([np.full(len(surface[0]), surface[2]) for surface in surfaces])
    count = len(means)
    long, short = rng.uniform(0.5, 0.8, count) * spacing, rng.uniform(0.15, 0.4, count) * spacing
    texture = np.sin(means @ rng.normal(0.0, 5.0, (3, 3))) + 0.8 * np.sign(np.sin(12.0 * means))
    logits = rng.normal(4.0, 1.5, count)
    logits[rng.random(count) < 0.3] -= 4.0
    quats, scales = _permute_axes(_facing(normals, rng), np.log(np.stack([long, short, 0.1 * long], axis=1)), rng)
    return PlyRows(
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=scales.astype(np.float32),
        logits=logits.astype(np.float32),
        sh0=(0.7 * texture + rng.normal(0.0, 0.3, (count, 3))).astype(np.float32),
        shN=(gloss * _highlights(_snap_to_facets(normals)) + rng.normal(0.0, noise, (count, 15, 3))).astype(np.float32),
    )


# Surfaces ------------------------------------------------------------------------------------------


def _torus(columns: int, rows: int) -> Surface:
    """Return a torus about y: `columns` rings of `rows` centres, with every other ring shifted by half a row."""
    big, small = 1.0, 0.35  # radii, scene units
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"))
    around = 2.0 * np.pi * column / columns
    tube = 2.0 * np.pi * (row + 0.5 * (column % 2)) / rows
    ring = np.stack([np.cos(around), np.zeros(len(around)), np.sin(around)], axis=1)
    normals = ring * np.cos(tube)[:, None] + np.sin(tube)[:, None] * (0.0, 1.0, 0.0)
    spacing = float(np.sqrt(4.0 * np.pi**2 * big * small / len(around)))
    return big * ring + small * normals, normals, spacing


def _ball(count: int) -> Surface:
    """Return a ball of `count` centres on a Fibonacci spiral about y."""
    radius = 0.55  # scene units
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count  # equal areas
    around = _GOLDEN_ANGLE * np.arange(count)
    across = np.sqrt(1.0 - height**2)
    normals = np.stack([across * np.cos(around), height, across * np.sin(around)], axis=1)
    return radius * normals + (0.0, -0.3, 0.0), normals, float(radius * np.sqrt(4.0 * np.pi / count))


def _box(side: int) -> list[Surface]:
    """Return the faces of a flat box below the torus and the ball, with `side` centres along x and z and 2 along y."""
    half = np.array((1.5, 0.12, 1.5))  # half the edges, scene units
    spacing = 2.0 * half[0] / side
    positions = [(np.arange(count) + 0.5) / count * 2.0 - 1.0 for count in (side, 2, side)]
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            ends = [np.array((sign,)) if i == axis else positions[i] for i in range(3)]
            points = np.stack([grid.ravel() for grid in np.meshgrid(*ends, indexing="ij")], axis=1)
            normals = np.tile(sign * np.eye(3)[axis], (len(points), 1))
            faces.append((points * half + (0.0, 0.6, 0.0), normals, spacing))
    return faces


def _facing(normals: F64, rng: np.random.Generator) -> F64:
    """Return quats [N, 4] that map z to normals [N, 3], with a random rotation about the normal, sign and length."""
    # The vector half-way between z and the normal gives half the rotation; the opposite of z is reached about x.
    half = np.stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    half[half[:, 0] < _OPPOSITE_MAX] = (0.0, 1.0, 0.0, 0.0)
    twist = rng.uniform(0.0, np.pi, len(normals))
    cos, sin, (w, x, y, z) = np.cos(twist), np.sin(twist), half.T
    quats = np.stack([w * cos - z * sin, x * cos + y * sin, y * cos - x * sin, z * cos + w * sin], axis=1)
    quats *= rng.choice((-1.0, 1.0), (len(normals), 1))
    return quats


def _permute_axes(quats: F64, scales: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Return quats [N, 4] and scales [N, 3] of the same splats, with axes in a random order, as in trained scenes."""
    quats, scales = quats.copy(), scales.copy()
    for first in (0, 1, 0):  # exchanges of neighbouring axes that give all six orders
        rows = rng.random(len(quats)) < 0.5
        w, x, y, z = quats[rows].T
        # A half turn about the bisector of two axes exchanges them.
        turned = (-x - y, w - z, w + z, x - y) if first == 0 else (-y - z, y - z, w - x, w + x)
        quats[rows] = np.sqrt(0.5) * np.stack(turned, axis=1)
        scales[rows, first : first + 2] = scales[rows, first : first + 2][:, ::-1]
    return quats, scales


# Colours -------------------------------------------------------------------------------------------


def _snap_to_facets(normals: F64) -> F64:
    """Return the facet normal nearest to each normal, [N, 3], so that splats of a facet have the same highlights."""
    facets = _ball(_FACETS)[1]
    nearest: F64 = facets[np.argmax(normals @ facets.T, axis=1)]
    return nearest


def _highlights(normals: F64) -> F64:
    """Return coefficients of bands 1 to 3, [N, 15, 3]: for each light, a lobe about its mirror direction."""
    shares = np.repeat(_LOBE, (3, 5, 7))
    total = np.zeros((len(normals), 15, 3))
    for position, colour in zip(_LIGHTS, _LIGHT_COLOURS, strict=True):
        light = position / np.sqrt(np.square(position).sum())
        facing = normals @ light
        # Directions point from the camera to the splat.
        mirrored = light - 2.0 * facing[:, None] * normals
        lobe = _harmonics(mirrored) * shares * np.clip(facing, 0.0, 1.0)[:, None]
        total += lobe[:, :, None] * colour
    return total


def _harmonics(directions: F64) -> F64:
    """Return the real spherical harmonics of bands 1 to 3, [N, 15], in the order and signs of splat renderers.

    `directions` are unit vectors, [N, 3].
    """
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = np.sqrt(np.array((3.0, 15.0, 35.0)) / (4.0 * np.pi))
    return np.stack(
        [
            -c1 * y,
            c1 * z,
            -c1 * x,
            c2 * x * y,
            -c2 * y * z,
            c2 / np.sqrt(12.0) * (3.0 * zz - 1.0),
            -c2 * x * z,
            c2 / 2.0 * (xx - yy),
            -c3 / np.sqrt(8.0) * y * (3.0 * xx - yy),
            c3 * np.sqrt(3.0) * x * y * z,
            -np.sqrt(21.0 / (32.0 * np.pi)) * y * (5.0 * zz - 1.0),
            np.sqrt(7.0 / (16.0 * np.pi)) * z * (5.0 * zz - 3.0),
            -np.sqrt(21.0 / (32.0 * np.pi)) * x * (5.0 * zz - 1.0),
            c3 * np.sqrt(0.75) * z * (xx - yy),
            -c3 / np.sqrt(8.0) * x * (xx - 3.0 * yy),
        ],
        axis=1,
    )
