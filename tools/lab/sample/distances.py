# SPDX-License-Identifier: Apache-2.0
"""Signed distances to the garden's surfaces, for ray marching; each function takes many points at once.

The distance to a part is exact or slightly too short, so that no ray passes through a surface. Points are [3, P]
float64 in the garden's axes, and distances [P]; both may have axes before P.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from garden import BALL, CAP, DISH, DISH_CENTRE, DISH_RADIUS, HEART, MOSS, PEBBLE, PETAL, SHELL, STEM, Garden

from csplat.types import F64, I64

_DISH_EDGE = math.sqrt(DISH_RADIUS**2 - DISH_CENTRE**2)
_MOUND_RADIUS, _MOUND_TOP = 2.4, 0.10
_PETALS = 9


class Nearest(NamedTuple):
    """The nearest surface of each point.

    Attributes:
        distance: [P].
        part: [P] int64.
        item: [P] int64, index among parts of this kind.
    """

    distance: F64
    part: I64
    item: I64

    def within(self, p: F64, centre: F64, radius: float) -> I64:
        """Return the points that are nearer to a bounding ball than to the nearest surface so far."""
        return np.flatnonzero(_ball(p, centre, radius) < self.distance)

    def offer(self, rows: I64, distance: F64, part: I64 | int, item: I64 | int) -> None:
        """Take a surface for those of the points [M] `rows` that are nearer to it; arguments are [M] or one value."""
        closer = distance < self.distance[rows]
        rows = rows[closer]
        self.distance[rows] = distance[closer]
        for own, offered in ((self.part, part), (self.item, item)):
            own[rows] = np.broadcast_to(offered, closer.shape)[closer]


def field(g: Garden, p: F64) -> Nearest:
    """Return the nearest surface of each point.

    Parts inside a bounding ball that is farther away than another surface are skipped.
    """
    dish, moss = _dish(_length(p[0], p[2]), p[1]), _moss(g.cushions, p)
    found = Nearest(np.minimum(dish, moss), np.where(dish <= moss, DISH, MOSS), np.zeros(p.shape[1], np.int64))
    _toadstools(g.toadstools, p, found)
    _pebbles(g.pebbles, p, found)
    _strands(g.tufts, g.strands, p, found)
    _daisies(g.daisies, p, found)
    _shell(g.shell_ball, g.shell, p, found)
    return found


def _toadstools(toadstools: F64, p: F64, found: Nearest) -> None:
    everywhere = np.arange(p.shape[1])
    for i, t in enumerate(toadstools):
        rows = found.within(p, t[3:6], t[6])
        if len(rows):
            found.offer(rows, _cap(p[:, rows] - t[3:6, None], t[6]), CAP, i)
        found.offer(everywhere, _stick(p, t[:3], t[3:6], 0.27 * t[6], 0.17 * t[6]), STEM, i)


def _pebbles(pebbles: F64, p: F64, found: Nearest) -> None:
    for i, s in enumerate(pebbles):
        rows = found.within(p, s[:3], max(s[3], s[5]))
        if len(rows):
            (x, y, z), cos, sin = p[:, rows] - s[:3, None], math.cos(s[6]), math.sin(s[6])
            d = _ellipsoid(cos * x + sin * z, y, cos * z - sin * x, s[3], s[4], s[5])
            found.offer(rows, d, BALL if s[7] == 2 else PEBBLE, i)


def _strands(tufts: F64, strands: F64, p: F64, found: Nearest) -> None:
    for tuft in tufts:
        rows = found.within(p, tuft[:3], tuft[3])
        if len(rows):
            first, end = int(tuft[4]), int(tuft[5])
            a = strands[first:end].T[:, :, None]
            d = _stick(p[:, None, rows], a[:3], a[3:6], a[6], a[7])
            nearest = np.argmin(d, axis=0)
            found.offer(
                rows, d[nearest, np.arange(len(rows))], strands[first + nearest, 8].astype(np.int64), first + nearest
            )


def _daisies(daisies: F64, p: F64, found: Nearest) -> None:
    for i, f in enumerate(daisies):
        rows = found.within(p, f[:3], f[12])
        if len(rows):
            x, y, z = f[3:12].reshape(3, 3) @ ((p[:, rows] - f[:3, None]) / f[12])
            found.offer(rows, _petals(x, y, z) * f[12], PETAL, i)
            found.offer(rows, _ellipsoid(x, y - 0.06, z, 0.3, 0.2, 0.3) * f[12], HEART, i)


def _shell(ball: F64, shell: F64, p: F64, found: Nearest) -> None:
    rows = found.within(p, ball[:3], ball[3])
    if len(rows):
        balls = _ball(p[:, None, rows], shell.T[:3, :, None], shell[:, 3, None])
        d = np.full(len(rows), 1e3)
        for one, radius in zip(balls, shell[:, 3], strict=True):
            d = _blend(d, one, 0.12 * radius)
        found.offer(rows, d, SHELL, np.argmin(balls, axis=0))


def _dish(r: F64, y: F64) -> F64:
    """Return the distance to the dish and its foot, from radius and height."""
    is_inside = DISH_CENTRE * r < _DISH_EDGE * (DISH_CENTRE - y)
    edge = _length(r - _DISH_EDGE, y)
    wall = np.where(is_inside, np.abs(_length(r, y - DISH_CENTRE) - DISH_RADIUS), edge) - 0.035
    lip = _length(r - _DISH_EDGE - 0.01, y) - 0.05
    foot = _length(np.maximum(np.abs(r - 0.44) - 0.02, 0.0), np.maximum(np.abs(y + 0.72) - 0.06, 0.0)) - 0.03
    return _blend(_blend(wall, lip, 0.08), foot, 0.1)


def _moss(cushions: F64, p: F64) -> F64:
    """Return the distance to the moss: an uneven mound with cushions that fills the dish."""
    d = _ball(p, (0.0, _MOUND_TOP - _MOUND_RADIUS, 0.0), _MOUND_RADIUS)
    for c in cushions:
        d = _blend(d, _ball(p, c[:3], c[3]), 0.16)
    near = np.flatnonzero(d < 0.12)
    bumps = noise(9 * p[:, near]) + 0.5 * noise(23 * p[:, near])
    bumpy = 0.5 * (d[near] - 0.055 * (bumps - 0.75))  # half a step, since bumps are steep
    d -= 0.05  # maximum height of bumps
    d[near] = bumpy
    within = np.where(p[1] < 0.0, _ball(p, (0.0, DISH_CENTRE, 0.0), DISH_RADIUS), _length(p[0], p[2]) - _DISH_EDGE)
    return np.maximum(d, within)


def _cap(p: F64, radius: float) -> F64:
    """Return the distance to the cap of a toadstool: a dome that is hollow below."""
    x, y, z = p
    dome = _ellipsoid(x, y, z, radius, 0.66 * radius, radius)
    hollow = _ellipsoid(x, y + 0.34 * radius, z, 0.92 * radius, 0.36 * radius, 0.92 * radius)
    kept = _blend(hollow, y + 0.22 * radius, 0.06 * radius)
    return -_blend(-dome, kept, 0.09 * radius)


def _petals(x: F64, y: F64, z: F64) -> F64:
    """Return the distance to the petals of a flower of radius 1 that faces along y: one petal, repeated."""
    step = 2 * math.pi / _PETALS
    angle = np.arctan2(z, x)
    angle -= step * np.rint(angle / step)
    r = _length(x, z)
    along, across = r * np.cos(angle), r * np.sin(angle)
    return 0.8 * _ellipsoid(along - 0.62, y - 0.12 * along * along, across, 0.37, 0.06, 0.19)


def _stick(p: F64, a: F64, b: F64, thick: F64 | float, thin: F64 | float) -> F64:
    """Return the distance to a tapered stick with round ends, from `a` to `b`."""
    px, py, pz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    qx, qy, qz = b - a
    t = np.clip((px * qx + py * qy + pz * qz) / (qx * qx + qy * qy + qz * qz), 0.0, 1.0)
    return _length(px - t * qx, py - t * qy, pz - t * qz) - (thick + t * (thin - thick))


def _blend(a: F64, b: F64, width: float) -> F64:
    """Return the smaller of two distances, with a fillet."""
    h = np.maximum(width - np.abs(a - b), 0.0)
    return np.minimum(a, b) - (0.25 / width) * (h * h)


def _ball(p: F64, centre: F64 | tuple[float, ...], radius: F64 | float) -> F64:
    """Return the distance to a ball."""
    x, y, z = centre
    return _length(p[0] - x, p[1] - y, p[2] - z) - radius


def _ellipsoid(x: F64, y: F64, z: F64, rx: float, ry: float, rz: float) -> F64:
    """Return the distance to an ellipsoid, to first order (Quilez's bound)."""
    x, y, z = x / rx, y / ry, z / rz
    k0, k1 = _length(x, y, z), _length(x / rx, y / ry, z / rz)
    return np.where(k1 > 1e-9, k0 * (k0 - 1.0) / np.maximum(k1, 1e-9), -min(rx, ry, rz))


def _length(*p: F64) -> F64:
    """Return the length of vectors."""
    return np.sqrt(sum((x * x for x in p[1:]), p[0] * p[0]))


def noise(p: F64) -> F64:
    """Return smooth noise between 0 and 1: random values on a lattice of spacing 1, interpolated."""
    corner = np.floor(p)
    t = p - corner
    t *= t * (3.0 - 2.0 * t)
    near = corner.astype(np.int64).astype(np.uint32) * np.array([[73856093], [19349663], [83492791]], np.uint32)
    far = near + np.array([[73856093], [19349663], [83492791]], np.uint32)
    (u, v, w), total = t, np.zeros_like(t[0])
    for x, by_x in ((near[0], 1.0 - u), (far[0], u)):
        for y, by_y in ((near[1], 1.0 - v), (far[1], v)):
            for z, by_z in ((near[2], 1.0 - w), (far[2], w)):
                h = x ^ y ^ z
                h = (h ^ (h >> 15)) * np.uint32(0x2C1B3C6D)
                h = (h ^ (h >> 12)) * np.uint32(0x297A2D39)
                total += by_x * by_y * by_z * ((h ^ (h >> 15)) & np.uint32(0xFFFF))
    return total / 65535.0
