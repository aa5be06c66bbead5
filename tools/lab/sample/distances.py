"""Signed distances to the garden's surfaces, for ray marching.

The distance to a part is exact or slightly too short, so that no ray passes through a surface.
"""

from __future__ import annotations

import math

import numba
from garden import BALL, CAP, DISH, DISH_CENTRE, DISH_RADIUS, HEART, MOSS, PEBBLE, PETAL, SHELL, STEM, Garden

from csplat.types import F64

Found = tuple[float, int, int]

_DISH_EDGE = math.sqrt(DISH_RADIUS**2 - DISH_CENTRE**2)
_MOUND_RADIUS, _MOUND_TOP = 2.4, 0.10
_PETALS = 9

#: Compiles a function, without numba's cache, which does not detect changes in called functions.
compiled = numba.njit(error_model="numpy", nogil=True)


@compiled
def field(g: Garden, x: float, y: float, z: float) -> Found:
    """Return the distance to the nearest surface, its part, and its index among parts of this kind.

    Parts inside a bounding ball that is farther away than another surface are skipped.
    """
    best = _dish(math.hypot(x, z), y)
    d = _moss(g.cushions, x, y, z)
    found = (best, DISH, 0) if best <= d else (d, MOSS, 0)
    found = _toadstools(g.toadstools, x, y, z, found)
    found = _pebbles(g.pebbles, x, y, z, found)
    found = _strands(g.tufts, g.strands, x, y, z, found)
    found = _daisies(g.daisies, x, y, z, found)
    return _shell(g.shell_ball, g.shell, x, y, z, found)


@compiled
def _toadstools(toadstools: F64, x: float, y: float, z: float, found: Found) -> Found:
    for i in range(toadstools.shape[0]):
        t = toadstools[i]
        if _ball(x, y, z, t[3], t[4], t[5], t[6]) < found[0]:
            d = _cap(x - t[3], y - t[4], z - t[5], t[6])
            if d < found[0]:
                found = (d, CAP, i)
        d = _stick(x, y, z, t[0], t[1], t[2], t[3], t[4], t[5], 0.27 * t[6], 0.17 * t[6])
        if d < found[0]:
            found = (d, STEM, i)
    return found


@compiled
def _pebbles(pebbles: F64, x: float, y: float, z: float, found: Found) -> Found:
    for i in range(pebbles.shape[0]):
        p = pebbles[i]
        if _ball(x, y, z, p[0], p[1], p[2], max(p[3], p[5])) < found[0]:
            dx, dz, c, s = x - p[0], z - p[2], math.cos(p[6]), math.sin(p[6])
            d = _ellipsoid(c * dx + s * dz, y - p[1], c * dz - s * dx, p[3], p[4], p[5])
            if d < found[0]:
                found = (d, BALL if p[7] == 2 else PEBBLE, i)
    return found


@compiled
def _strands(tufts: F64, strands: F64, x: float, y: float, z: float, found: Found) -> Found:
    for k in range(tufts.shape[0]):
        b = tufts[k]
        if _ball(x, y, z, b[0], b[1], b[2], b[3]) < found[0]:
            for i in range(int(b[4]), int(b[5])):
                a = strands[i]
                d = _stick(x, y, z, a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7])
                if d < found[0]:
                    found = (d, int(a[8]), i)
    return found


@compiled
def _daisies(daisies: F64, x: float, y: float, z: float, found: Found) -> Found:
    for i in range(daisies.shape[0]):
        f = daisies[i]
        if _ball(x, y, z, f[0], f[1], f[2], f[12]) < found[0]:
            dx, dy, dz = (x - f[0]) / f[12], (y - f[1]) / f[12], (z - f[2]) / f[12]
            px = f[3] * dx + f[4] * dy + f[5] * dz
            py = f[6] * dx + f[7] * dy + f[8] * dz
            pz = f[9] * dx + f[10] * dy + f[11] * dz
            d = _petals(px, py, pz) * f[12]
            if d < found[0]:
                found = (d, PETAL, i)
            d = _ellipsoid(px, py - 0.06, pz, 0.3, 0.2, 0.3) * f[12]
            if d < found[0]:
                found = (d, HEART, i)
    return found


@compiled
def _shell(ball: F64, shell: F64, x: float, y: float, z: float, found: Found) -> Found:
    if _ball(x, y, z, ball[0], ball[1], ball[2], ball[3]) < found[0]:
        d, nearest, winner = 1e3, 1e3, 0
        for i in range(shell.shape[0]):
            one = _ball(x, y, z, shell[i, 0], shell[i, 1], shell[i, 2], shell[i, 3])
            if one < nearest:
                nearest, winner = one, i
            d = _blend(d, one, 0.12 * shell[i, 3])
        if d < found[0]:
            found = (d, SHELL, winner)
    return found


@compiled
def _dish(r: float, y: float) -> float:
    """Return the distance to the dish and its foot, from radius and height."""
    if DISH_CENTRE * r < _DISH_EDGE * (DISH_CENTRE - y):
        wall = abs(math.hypot(r, y - DISH_CENTRE) - DISH_RADIUS) - 0.035
    else:
        wall = math.hypot(r - _DISH_EDGE, y) - 0.035
    lip = math.hypot(r - _DISH_EDGE - 0.01, y) - 0.05
    foot = math.hypot(max(abs(r - 0.44) - 0.02, 0.0), max(abs(y + 0.72) - 0.06, 0.0)) - 0.03
    return _blend(_blend(wall, lip, 0.08), foot, 0.1)


@compiled
def _moss(cushions: F64, x: float, y: float, z: float) -> float:
    """Return the distance to the moss: an uneven mound with cushions that fills the dish."""
    d = _ball(x, y, z, 0.0, _MOUND_TOP - _MOUND_RADIUS, 0.0, _MOUND_RADIUS)
    for i in range(cushions.shape[0]):
        c = cushions[i]
        d = _blend(d, _ball(x, y, z, c[0], c[1], c[2], c[3]), 0.16)
    if d < 0.12:
        bumps = noise(9 * x, 9 * y, 9 * z) + 0.5 * noise(23 * x, 23 * y, 23 * z)
        d = 0.5 * (d - 0.055 * (bumps - 0.75))  # half a step, since bumps are steep
    else:
        d -= 0.05  # maximum height of bumps
    return (
        max(d, _ball(x, y, z, 0.0, DISH_CENTRE, 0.0, DISH_RADIUS)) if y < 0.0 else max(d, math.hypot(x, z) - _DISH_EDGE)
    )


@compiled
def _cap(x: float, y: float, z: float, radius: float) -> float:
    """Return the distance to the cap of a toadstool: a dome that is hollow below."""
    dome = _ellipsoid(x, y, z, radius, 0.66 * radius, radius)
    hollow = _ellipsoid(x, y + 0.34 * radius, z, 0.92 * radius, 0.36 * radius, 0.92 * radius)
    kept = _blend(hollow, y + 0.22 * radius, 0.06 * radius)
    return -_blend(-dome, kept, 0.09 * radius)


@compiled
def _petals(x: float, y: float, z: float) -> float:
    """Return the distance to the petals of a flower of radius 1 that faces along y: one petal, repeated."""
    step = 2 * math.pi / _PETALS
    angle = math.atan2(z, x)
    angle -= step * round(angle / step)
    r = math.hypot(x, z)
    along, across = r * math.cos(angle), r * math.sin(angle)
    return 0.8 * _ellipsoid(along - 0.62, y - 0.12 * along * along, across, 0.37, 0.06, 0.19)


@compiled
def _stick(
    x: float, y: float, z: float, ax: float, ay: float, az: float, bx: float, by: float, bz: float,
    thick: float, thin: float,
) -> float:  # fmt: skip
    """Return the distance to a tapered stick with round ends."""
    px, py, pz, qx, qy, qz = x - ax, y - ay, z - az, bx - ax, by - ay, bz - az
    t = min(1.0, max(0.0, (px * qx + py * qy + pz * qz) / (qx * qx + qy * qy + qz * qz)))
    px, py, pz = px - t * qx, py - t * qy, pz - t * qz
    return math.sqrt(px * px + py * py + pz * pz) - (thick + t * (thin - thick))


@compiled
def _blend(a: float, b: float, width: float) -> float:
    """Return the smaller of two distances, with a fillet."""
    h = max(width - abs(a - b), 0.0) / width
    return min(a, b) - 0.25 * h * h * width


@compiled
def _ball(x: float, y: float, z: float, cx: float, cy: float, cz: float, radius: float) -> float:
    """Return the distance to a ball."""
    return math.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - radius


@compiled
def _ellipsoid(x: float, y: float, z: float, rx: float, ry: float, rz: float) -> float:
    """Return the distance to an ellipsoid, to first order (Quilez's bound)."""
    k0 = math.sqrt((x / rx) ** 2 + (y / ry) ** 2 + (z / rz) ** 2)
    k1 = math.sqrt((x / (rx * rx)) ** 2 + (y / (ry * ry)) ** 2 + (z / (rz * rz)) ** 2)
    return k0 * (k0 - 1.0) / k1 if k1 > 1e-9 else -min(rx, ry, rz)


@compiled
def noise(x: float, y: float, z: float) -> float:
    """Return smooth noise between 0 and 1: random values on a lattice of spacing 1, interpolated."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    total = 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        h = ((int(fx) + i) * 73856093 ^ (int(fy) + j) * 19349663 ^ (int(fz) + k) * 83492791) & 0xFFFFFFFF
        h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
        h = ((h ^ (h >> 12)) * 0x297A2D39) & 0xFFFFFFFF
        weight = (u if i else 1 - u) * (v if j else 1 - v) * (w if k else 1 - w)
        total += weight * ((h ^ (h >> 15)) & 0xFFFF) / 65535.0
    return total
