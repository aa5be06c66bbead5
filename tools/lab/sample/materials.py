# SPDX-License-Identifier: Apache-2.0
"""Materials of the garden: glaze, moss, gills, gloss; each function takes many points [3, P] at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from distances import Nearest, noise
from garden import BALL, BLADE, CAP, DISH, HEART, MOSS, PEBBLE, PETAL, SHELL, STALK, STEM, Garden

from csplat.types import F64, I64

_Values = F64 | float


class Material(NamedTuple):
    """The material of points.

    Attributes:
        colour: [3, P], linear.
        gloss: [P], 0 to 1.
        sharpness: [P], the exponent of the cosine of highlights.
    """

    colour: F64
    gloss: F64
    sharpness: F64

    def put(self, rows: I64, colour: tuple[_Values, _Values, _Values], gloss: _Values, sharp: float) -> None:
        """Set the material of the points [M] `rows`; red, green, blue and gloss are [M] or one value."""
        for channel, value in zip(self.colour, colour, strict=True):
            channel[rows] = value
        self.gloss[rows], self.sharpness[rows] = gloss, sharp


def material(g: Garden, p: F64, nearest: Nearest) -> Material:
    """Return the materials of surfaces at points [3, P]."""
    made = Material(np.empty_like(p), np.empty(p.shape[1]), np.empty(p.shape[1]))
    for part in np.unique(nearest.part):
        rows = np.flatnonzero(nearest.part == part)
        item = nearest.item[rows]
        if part == CAP:
            for one in np.unique(item):
                _paint_cap(made, rows[item == one], g.toadstools[one], int(one), p)
        elif part == DISH:
            _paint_dish(made, rows, p)
        else:
            made.put(rows, *_plain(g, p[:, rows], int(part), item))
    return made


def _plain(g: Garden, p: F64, part: int, item: I64) -> tuple[tuple[_Values, _Values, _Values], _Values, float]:
    """Return colour, gloss and sharpness of a part other than caps and the dish, as for `Material.put`."""
    x, y, z = p
    if part == MOSS:
        a, b = noise(6 * p), noise(38 * p)
        k = 0.55 + 0.75 * b
        return (k * (0.06 + 0.19 * a), k * (0.21 + 0.17 * a), k * 0.035), 0.0, 1.0
    if part == STEM:
        k, foot = 0.75 + 0.25 * noise(np.stack([9 * x, 2 * y, 9 * z])), g.toadstools[item, 1]
        low = ramp(foot + 0.16, foot, y)
        return (k * (0.86 - 0.3 * low), k * (0.78 - 0.3 * low), k * (0.60 - 0.36 * low)), 0.12, 12.0
    if part == PEBBLE:
        vein = ramp(0.06, 0.0, np.abs(noise(np.stack([7 * x + 11 * item, 7 * y, 7 * z])) - 0.5))
        k = np.where(g.pebbles[item, 7] == 0, 0.16 + 0.1 * noise(30 * p), 0.55)
        return (k + 0.35 * vein * (1 - k), k * 0.98 + 0.33 * vein * (1 - k), k * 0.93 + 0.3 * vein * (1 - k)), 0.6, 40.0
    if part == BALL:
        k = ramp(0.42, 0.62, noise(np.stack([6 * x + 2 * np.sin(9 * y), 9 * y, 6 * z])))
        return (0.01 + 0.05 * k, 0.035 + 0.35 * k, 0.22 + 0.42 * k), 1.0, 55.0
    if part == BLADE:
        tip = ramp(0.1, 0.75, y)
        return (0.10 + 0.28 * tip, 0.33 + 0.23 * tip, 0.04 + 0.02 * tip), 0.22, 14.0
    if part == STALK:
        return (0.16, 0.34, 0.07), 0.1, 12.0
    if part == PETAL:
        f = g.daisies[item].T
        pink = ramp(0.55, 1.0, np.sqrt((x - f[0]) ** 2 + (y - f[1]) ** 2 + (z - f[2]) ** 2) / f[12])
        return (0.92, 0.88 - 0.34 * pink, 0.86 - 0.12 * pink), 0.1, 10.0
    if part == HEART:
        k = 0.7 + 0.5 * noise(60 * p)
        return (0.95 * k, 0.58 * k, 0.03), 0.1, 12.0
    if part == SHELL:
        stripe = 0.5 + 0.5 * np.sin(0.5 * item * item * 0.09 + 22.0 * z)
        k = 0.75 * stripe + 0.25 * (0.5 + 0.5 * np.sin(1.57 * item))
        return (0.16 + 0.60 * k, 0.035 + 0.34 * k, 0.01 + 0.07 * k), 0.85, 40.0
    k = 0.8 + 0.3 * noise(40 * p)
    return (0.36 * k, 0.24 * k, 0.15 * k), 0.5, 22.0  # the snail's body


def _paint_dish(made: Material, rows: I64, p: F64) -> None:
    """Set teal glaze over bare clay, thin at the lip, with a band of slip waves."""
    x, y, z = p[:, rows]
    angle = np.arctan2(z, x)
    waves = np.stack([7 * x, np.zeros_like(x), 7 * z])
    drip = -0.50 + 0.05 * np.sin(5 * angle + 1.0) + 0.035 * np.sin(11 * angle) - 0.06 * noise(waves)
    pool = ramp(drip + 0.28, drip, y) + 0.5 * noise(np.stack([5 * x, 8 * y, 5 * z]))
    slip = ramp(0.022, 0.012, np.abs(y + 0.24 + 0.04 * np.sin(10 * angle)))
    bead = np.hypot(np.sin(5 * angle + 0.785) / 5.0, y + 0.24 - 0.03 * np.sin(10 * angle))
    slip = np.maximum(slip, ramp(0.042, 0.034, bead))
    lip = ramp(0.0, 0.035, y + 0.012 * noise(np.stack([14 * x, np.full_like(x, 3.0), 14 * z])))
    clay, is_bare = 0.8 + 0.35 * noise(np.stack([26 * x, 60 * y, 26 * z])), y < drip
    channels = []
    for teal, deep, of_slip, of_lip, of_clay in (
        (0.035, 0.02, 0.8, 0.33, 0.42), (0.36, 0.2, 0.78, 0.16, 0.20), (0.37, 0.13, 0.66, 0.06, 0.11),
    ):  # fmt: skip
        glaze = teal - deep * pool
        glaze += slip * (of_slip - glaze)
        channels.append(np.where(is_bare, of_clay * clay, glaze + lip * (of_lip - glaze)))
    red, green, blue = channels
    made.put(rows[is_bare], (red[is_bare], green[is_bare], blue[is_bare]), 0.05, 8.0)
    made.put(rows[~is_bare], (red[~is_bare], green[~is_bare], blue[~is_bare]), 1.0, 45.0)


def _paint_cap(made: Material, rows: I64, toadstool: F64, item: int, p: F64) -> None:
    """Set the material of a cap: glossy with dots above, gills below."""
    *_, radius, kind = toadstool
    q = (p[:, rows] - toadstool[3:6, None]) / radius
    is_below = ((q[0] ** 2 + q[2] ** 2) / 0.9**2 + ((q[1] + 0.34) / 0.40) ** 2 < 1.0) & (q[1] < 0.1)
    below, above = q[:, is_below], q[:, ~is_below]
    k = 0.55 + 0.35 * (0.5 + 0.5 * np.cos(36 * np.arctan2(below[2], below[0])))
    made.put(rows[is_below], (0.95 * k, 0.82 * k, 0.58 * k), 0.0, 1.0)
    # Dots on a Fibonacci spiral over the dome; larger caps have more.
    count = 26 if radius > 0.25 else 14
    u = above / np.array([1.0, 0.66, 1.0])[:, None]
    u /= np.sqrt(np.sum(u * u, axis=0)) + 1e-9
    uneven, dot = 1.0 + 0.25 * noise(9 * u), np.zeros(u.shape[1])
    for i in range(count):
        h = 1.0 - (i + 0.4) / count
        ring, turn, size = math.sqrt(1.0 - h * h), 2.399963 * i + 1.3 * item, 0.15 + 0.055 * math.sin(5.0 * i + item)
        middle = np.array([ring * math.cos(turn), h, ring * math.sin(turn)])[:, None]
        dot = np.maximum(dot, ramp(size, 0.8 * size, np.sqrt(np.sum((u - middle) ** 2, axis=0)) * uneven))
    k = 0.85 + 0.3 * noise(5 * u)
    red, green, blue = (0.66 * k, 0.014, 0.012) if kind == 0 else (0.85 * k, 0.26 * k, 0.015)
    colour = red + dot * (0.9 - red), green + dot * (0.85 - green), blue + dot * (0.72 - blue)
    made.put(rows[~is_below], colour, 0.9 - 0.6 * dot, 36.0)


def ramp(low: _Values, high: _Values, value: F64) -> F64:
    """Return 0 below `low`, 1 above `high`, smooth between; reversed if low > high."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
