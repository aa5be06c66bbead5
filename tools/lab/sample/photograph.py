# SPDX-License-Identifier: Apache-2.0
"""Photographs of the garden, ray-marched and lit by a lamp and a sky.

Colours depend on the view direction: highlights of the lamp and reflections of a sky with two bright windows have
Fresnel weights and can be occluded. Each function takes many rays or points at once: positions, directions and colours
are [3, P] float64.
"""

from __future__ import annotations

import numpy as np
from distances import field
from garden import BLADE, BOUND, PETAL, Garden
from materials import material, ramp

from csplat.types import F64, I64, U8
from csplat_render.camera import Camera

_LAMP = np.array([0.46, 0.76, 0.46])
_LAMP_COLOUR = np.array([2.7, 2.45, 2.1])
_EXPOSURE = 1.0
_ALIKE = 0.04  # difference in colour (0 to 1) and depth (scene units) below which two rays per pixel suffice
_STEPS = 160
_HIT = 4e-4  # scene units; a ray this close has hit the surface
_RAYS = ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75))  # pixels, to the right and down
_TETRAHEDRON = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])[:, :, None]


def photograph(garden: Garden, camera: Camera) -> tuple[U8, F64]:
    """Render one image with two rays per pixel, or four if these two disagree.

    Args:
        garden: the garden, placed upright in a world with y down.
        camera: the camera.

    Returns:
        Image [H, W, 4] uint8 with straight alpha, the share of a pixel's rays that hit a surface; and the
        world position that each pixel's last ray hit, [H, W, 3], undefined if it hit nothing.
    """
    viewmat, K = np.array(camera.viewmat), np.array(camera.K)
    row, column = (axis.ravel() for axis in np.indices((camera.H, camera.W)))

    def trace(pixels: I64, rays: int) -> tuple[F64, F64, F64]:
        """Return colours [3, R, P], depths [R, P], 0 for no hit, and slopes [2, R, P] of the given rays of pixels."""
        right, down = np.array(_RAYS[rays : rays + 2]).T[:, :, None]
        slopes = np.stack([(column[pixels] + right - K[0, 2]) / K[0, 0], (row[pixels] + down - K[1, 2]) / K[1, 1]])
        colour, depth = _trace(garden, viewmat, slopes.reshape(2, -1))
        return colour.reshape(3, *slopes.shape[1:]), depth.reshape(slopes.shape[1:]), slopes

    colour, depth, slopes = trace(np.arange(len(row)), 0)
    apart = np.maximum(np.abs(np.diff(colour, axis=1)).max(axis=(0, 1)), np.abs(np.diff(depth, axis=0))[0])
    light, hits, rays = colour.sum(axis=1), np.sum(depth > 0.0, axis=0), np.full(len(row), 2)
    last, depth = slopes[:, 1], depth[1]
    unlike = np.flatnonzero(apart >= _ALIKE)
    colour, more, slopes = trace(unlike, 2)
    light[:, unlike] += colour.sum(axis=1)
    hits[unlike] += np.sum(more > 0.0, axis=0)
    rays[unlike], last[:, unlike], depth[unlike] = 4, slopes[:, 1], more[1]
    shades = np.stack([*(255.0 * light / np.maximum(hits, 1)), 255.0 * hits / rays], axis=1)
    points = np.stack([last[0] * depth, last[1] * depth, depth], axis=1) - viewmat[:3, 3]
    size = (camera.H, camera.W)
    return (shades + 0.5).astype(np.uint8).reshape(*size, 4), (points @ viewmat[:3, :3]).reshape(*size, 3)


def _trace(g: Garden, viewmat: F64, slopes: F64) -> tuple[F64, F64]:
    """Return what rays hit: display colours, 0 to 1, and depths along the camera's axis [P]; 0 where they hit nothing.

    Args:
        g: the garden.
        viewmat: [4, 4], world to camera.
        slopes: [2, P], to the right and down, per unit of depth.
    """
    # Camera to world, then y and z negated: the garden's y points up.
    to_garden = np.diag([1.0, -1.0, -1.0]) @ viewmat[:3, :3].T
    length = np.sqrt(slopes[0] ** 2 + slopes[1] ** 2 + 1.0)
    d = to_garden @ np.stack([slopes[0], slopes[1], np.ones_like(length)]) / length
    eye = (-to_garden @ viewmat[:3, 3])[:, None]
    away = eye - np.array([[0.0], [BOUND[0]], [0.0]])
    across = np.sum(away * d, axis=0)
    inside = across * across - (np.sum(away * away) - BOUND[1] ** 2)
    half = np.sqrt(np.maximum(inside, 0.0))
    t, end = np.maximum(-across - half, 0.0), half - across
    active = np.flatnonzero(inside > 0.0)
    for _ in range(_STEPS):
        step = field(g, eye + t[active] * d[:, active]).distance
        goes_on = (step >= _HIT) & (t[active] <= end[active])
        active = active[goes_on]
        if not len(active):
            break
        t[active] += step[goes_on]
    # Rays that run out of steps graze a surface and count as hits.
    hit = np.flatnonzero((inside > 0.0) & (t <= end))
    colour, depth = np.zeros_like(d), np.zeros_like(t)
    colour[:, hit] = _display(_shade(g, eye + t[hit] * d[:, hit], d[:, hit]))
    depth[hit] = t[hit] / length[hit]
    return colour, depth


def _shade(g: Garden, p: F64, d: F64) -> F64:
    """Return the light from surface points back along rays with directions `d` from the camera."""
    surface = field(g, p)
    normal = np.sum([side * field(g, p + 8e-4 * side).distance for side in _TETRAHEDRON], axis=0)
    normal /= np.sqrt(np.sum(normal * normal, axis=0)) + 1e-12
    base, gloss, sharpness = material(g, p, surface)
    above, facing, lit = p + 0.006 * normal, _LAMP @ normal, np.zeros(p.shape[1])
    to_lamp = np.flatnonzero(facing > 0.0)
    lit[to_lamp] = _clear(g, above[:, to_lamp], np.broadcast_to(_LAMP[:, None], (3, len(to_lamp))), 9.0)
    open_sky = 0.35 + 0.65 * _openness(g, p, normal)
    is_thin = (surface.part == BLADE) | (surface.part == PETAL)
    through = np.where(is_thin, 0.25 * np.maximum(-facing, 0.0), 0.0)  # thin leaves let light through
    lamp, up = np.maximum(facing, 0.0) * lit + through, 0.5 + 0.5 * normal[1]
    ambient = np.stack([0.34 + 0.30 * up, 0.32 + 0.38 * up, 0.28 + 0.52 * up])
    light = base * (lamp * _LAMP_COLOUR[:, None] + open_sky * ambient)
    shiny = np.flatnonzero(gloss > 0.0)
    d, normal, gloss = d[:, shiny], normal[:, shiny], gloss[shiny]
    view = -np.sum(d * normal, axis=0)
    fresnel = gloss * (0.06 + 0.4 * (1.0 - np.maximum(view, 0.0)) ** 5)
    mirrored = d + 2 * view * normal
    seen = _clear(g, above[:, shiny], mirrored, 5.0)
    shine = lit[shiny] * 0.45 * gloss * np.maximum(_LAMP @ mirrored, 0.0) ** sharpness[shiny]
    covered = np.array([[0.10], [0.11], [0.06]])
    light[:, shiny] += shine * _LAMP_COLOUR[:, None] + fresnel * (seen * _sky(mirrored) + (1 - seen) * covered)
    return light


def _sky(d: F64) -> F64:
    """Return the colour of the surroundings: a pale sky, a warm ground, two soft windows."""
    up = ramp(-0.35, 0.6, d[1])
    window = 5.0 * ramp(0.55, 0.95, -0.62 * d[0] + 0.55 * d[1] + 0.56 * d[2])
    window += 3.0 * ramp(0.6, 0.95, 0.55 * d[0] + 0.42 * d[1] - 0.72 * d[2])
    return np.stack([0.25 + 0.25 * up + window, 0.22 + 0.4 * up + window, 0.18 + 0.6 * up + 1.05 * window])


def _clear(g: Garden, p: F64, d: F64, hard: float) -> F64:
    """Return the unoccluded share of a soft light in directions `d`, [P] in 0..1."""
    open_share, t, active = np.ones(p.shape[1]), np.full(p.shape[1], 0.01), np.arange(p.shape[1])
    for _ in range(26):
        distance = field(g, p[:, active] + t[active] * d[:, active]).distance
        open_share[active] = np.minimum(open_share[active], 0.5 + 0.5 * hard * distance / t[active])
        t[active] += np.maximum(distance, 0.02)
        active = active[(open_share[active] > 0.0) & (t[active] <= 1.6)]
        if not len(active):
            break
    open_share = np.maximum(open_share, 0.0)
    return open_share * open_share * (3 - 2 * open_share)


def _openness(g: Garden, p: F64, normal: F64) -> F64:
    """Return the ambient openness close above surfaces, [P]: 0 (covered) to 1 (open)."""
    hidden, weight, h = np.zeros(p.shape[1]), 1.0, 0.02
    for _ in range(4):
        hidden += weight * np.maximum(h - field(g, p + h * normal).distance, 0.0) / h
        weight, h = 0.75 * weight, 2.0 * h
    return np.maximum(0.0, 1.0 - hidden / 2.734)


def _display(light: F64) -> F64:
    """Map light to display values, 0 to 1: a shoulder, then gamma."""
    return (1.0 - np.exp(-_EXPOSURE * np.maximum(light, 0.0))) ** (1.0 / 2.2)
