"""Photographs of the garden, ray-marched and lit by a lamp and a sky.

Colours depend on the view direction: highlights of the lamp and reflections of a sky with two bright windows have
Fresnel weights and can be occluded.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from distances import compiled, field
from garden import BLADE, BOUND, PETAL, Garden
from materials import Colour, material, ramp
from numba import prange

from csplat.types import F64, U8
from csplat_render.camera import Camera

_LAMP = (0.46, 0.76, 0.46)
_LAMP_COLOUR = (2.7, 2.45, 2.1)
_EXPOSURE = 1.0
_ALIKE = 0.04  # difference in colour (0 to 1) and depth (scene units) below which two rays per pixel suffice
_STEPS = 160
_HIT = 4e-4  # scene units; a ray this close has hit the surface


def photograph(garden: Garden, camera: Camera) -> tuple[U8, F64]:
    """Render one image with two rays per pixel, or four if these two disagree.

    Args:
        garden: the garden, placed upright in a world with y down.
        camera: the camera.

    Returns:
        Image [H, W, 4] uint8 with straight alpha, the share of a pixel's rays that hit a surface; and the
        world position that each pixel's last ray hit, [H, W, 3], undefined if it hit nothing.
    """
    viewmat = np.array(camera.viewmat)
    pixels, points = np.empty((camera.H, camera.W, 4), np.uint8), np.empty((camera.H, camera.W, 3))
    _expose(garden, viewmat, np.array(camera.K), pixels, points)
    return pixels, np.sum((points - viewmat[:3, 3])[..., None] * viewmat[:3, :3], axis=2)


@numba.njit(parallel=True, error_model="numpy", nogil=True)
def _expose(g: Garden, viewmat: F64, K: F64, pixels: U8, points: F64) -> None:
    """Render an image, with positions in camera axes; rows are rendered in parallel."""
    for row in prange(pixels.shape[0]):
        for column in range(pixels.shape[1]):
            red, green, blue, hits, rays = 0.0, 0.0, 0.0, 0, 0
            first, apart = 0.0, 0.0
            for right, down in ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75)):
                u, v = (column + right - K[0, 2]) / K[0, 0], (row + down - K[1, 2]) / K[1, 1]
                depth, r, s, t = _trace(g, viewmat, u, v)
                apart = max(abs(red - r), abs(green - s), abs(blue - t), abs(depth - first))
                rays, first = rays + 1, depth
                if depth > 0.0:
                    red, green, blue, hits = red + r, green + s, blue + t, hits + 1
                points[row, column, 0], points[row, column, 1], points[row, column, 2] = u * depth, v * depth, depth
                if rays == 2 and apart < _ALIKE:
                    break
            over = 255.0 / max(hits, 1)
            pixels[row, column, 0] = np.uint8(red * over + 0.5)
            pixels[row, column, 1] = np.uint8(green * over + 0.5)
            pixels[row, column, 2] = np.uint8(blue * over + 0.5)
            pixels[row, column, 3] = np.uint8(255.0 * hits / rays + 0.5)


@compiled
def _trace(g: Garden, V: F64, u: float, v: float) -> tuple[float, float, float, float]:
    """Return what a ray hits: depth along the camera's axis (0: nothing), and a display colour, 0 to 1."""
    # Camera to world, then y and z negated: the garden's y points up.
    length = math.sqrt(u * u + v * v + 1.0)
    dx = (V[0, 0] * u + V[1, 0] * v + V[2, 0]) / length
    dy = -(V[0, 1] * u + V[1, 1] * v + V[2, 1]) / length
    dz = -(V[0, 2] * u + V[1, 2] * v + V[2, 2]) / length
    ox = -(V[0, 0] * V[0, 3] + V[1, 0] * V[1, 3] + V[2, 0] * V[2, 3])
    oy = V[0, 1] * V[0, 3] + V[1, 1] * V[1, 3] + V[2, 1] * V[2, 3]
    oz = V[0, 2] * V[0, 3] + V[1, 2] * V[1, 3] + V[2, 2] * V[2, 3]
    across = ox * dx + (oy - BOUND[0]) * dy + oz * dz
    inside = across * across - (ox * ox + (oy - BOUND[0]) ** 2 + oz * oz - BOUND[1] ** 2)
    if inside <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    t, end = max(0.0, -across - math.sqrt(inside)), -across + math.sqrt(inside)
    for _ in range(_STEPS):
        d = field(g, ox + t * dx, oy + t * dy, oz + t * dz)[0]
        if d < _HIT or t > end:
            break
        t += d
    if t > end:  # nothing hit; rays that run out of steps graze a surface and count as hits
        return 0.0, 0.0, 0.0, 0.0
    red, green, blue = _shade(g, ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz)
    return t / length, _display(red), _display(green), _display(blue)


@compiled
def _shade(g: Garden, x: float, y: float, z: float, dx: float, dy: float, dz: float) -> Colour:
    """Return the light from a surface point back along a ray from the camera."""
    _, part, item = field(g, x, y, z)
    e = 8e-4
    a, b = field(g, x + e, y - e, z - e)[0], field(g, x - e, y - e, z + e)[0]
    c, d = field(g, x - e, y + e, z - e)[0], field(g, x + e, y + e, z + e)[0]
    nx, ny, nz = a - b - c + d, -a - b + c + d, -a + b - c + d
    length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
    nx, ny, nz = nx / length, ny / length, nz / length
    base, gloss, sharp = material(g, x, y, z, part, item)
    px, py, pz = x + 0.006 * nx, y + 0.006 * ny, z + 0.006 * nz
    facing = nx * _LAMP[0] + ny * _LAMP[1] + nz * _LAMP[2]
    lit = _clear(g, px, py, pz, _LAMP[0], _LAMP[1], _LAMP[2], 9.0) if facing > 0.0 else 0.0
    open_sky = 0.35 + 0.65 * _openness(g, x, y, z, nx, ny, nz)
    through = 0.25 * max(-facing, 0.0) if part in (BLADE, PETAL) else 0.0  # thin leaves let light through
    lamp = max(facing, 0.0) * lit + through
    up = 0.5 + 0.5 * ny
    red = base[0] * (lamp * _LAMP_COLOUR[0] + open_sky * (0.34 + 0.30 * up))
    green = base[1] * (lamp * _LAMP_COLOUR[1] + open_sky * (0.32 + 0.38 * up))
    blue = base[2] * (lamp * _LAMP_COLOUR[2] + open_sky * (0.28 + 0.52 * up))
    if gloss > 0.0:
        view = -(dx * nx + dy * ny + dz * nz)
        fresnel = gloss * (0.06 + 0.4 * (1.0 - max(view, 0.0)) ** 5)
        rx, ry, rz = dx + 2 * view * nx, dy + 2 * view * ny, dz + 2 * view * nz
        seen = _clear(g, px, py, pz, rx, ry, rz, 5.0)
        mirror = max(rx * _LAMP[0] + ry * _LAMP[1] + rz * _LAMP[2], 0.0) ** sharp
        shine = lit * 0.45 * gloss * mirror
        sky = _sky(rx, ry, rz)
        red += shine * _LAMP_COLOUR[0] + fresnel * (seen * sky[0] + (1 - seen) * 0.10)
        green += shine * _LAMP_COLOUR[1] + fresnel * (seen * sky[1] + (1 - seen) * 0.11)
        blue += shine * _LAMP_COLOUR[2] + fresnel * (seen * sky[2] + (1 - seen) * 0.06)
    return red, green, blue


@compiled
def _sky(x: float, y: float, z: float) -> Colour:
    """Return the colour of the surroundings: a pale sky, a warm ground, two soft windows."""
    up = ramp(-0.35, 0.6, y)
    window = 5.0 * ramp(0.55, 0.95, -0.62 * x + 0.55 * y + 0.56 * z)
    window += 3.0 * ramp(0.6, 0.95, 0.55 * x + 0.42 * y - 0.72 * z)
    return 0.25 + 0.25 * up + window, 0.22 + 0.4 * up + window, 0.18 + 0.6 * up + 1.05 * window


@compiled
def _clear(g: Garden, x: float, y: float, z: float, dx: float, dy: float, dz: float, hard: float) -> float:
    """Return the unoccluded share of a soft light in one direction, 0 to 1."""
    open_share, t = 1.0, 0.01
    for _ in range(26):
        d = field(g, x + t * dx, y + t * dy, z + t * dz)[0]
        open_share = min(open_share, 0.5 + 0.5 * hard * d / t)
        if open_share <= 0.0:
            return 0.0
        t += max(d, 0.02)
        if t > 1.6:
            break
    return open_share * open_share * (3 - 2 * open_share)


@compiled
def _openness(g: Garden, x: float, y: float, z: float, nx: float, ny: float, nz: float) -> float:
    """Return the ambient openness close above a surface: 0 (covered) to 1 (open)."""
    hidden, weight, h = 0.0, 1.0, 0.02
    for _ in range(4):
        hidden += weight * max(h - field(g, x + h * nx, y + h * ny, z + h * nz)[0], 0.0) / h
        weight, h = 0.75 * weight, 2.0 * h
    return max(0.0, 1.0 - hidden / 2.734)


@compiled
def _display(light: float) -> float:
    """Map light to a display value, 0 to 1: a shoulder, then gamma."""
    return (1.0 - math.exp(-_EXPOSURE * max(light, 0.0))) ** (1.0 / 2.2)
