"""Materials of the garden: glaze, moss, gills, gloss."""

from __future__ import annotations

import math

from distances import compiled, noise
from garden import BALL, BLADE, CAP, DISH, HEART, MOSS, PEBBLE, PETAL, SHELL, STALK, STEM, Garden

Colour = tuple[float, float, float]
#: Colour (linear), gloss from 0 to 1, sharpness of highlights (the exponent of their cosine).
Material = tuple[Colour, float, float]


@compiled
def material(g: Garden, x: float, y: float, z: float, part: int, item: int) -> Material:
    """Return the material of a surface at a point."""
    if part == DISH:
        return _glaze(x, y, z)
    if part == MOSS:
        a, b = noise(6 * x, 6 * y, 6 * z), noise(38 * x, 38 * y, 38 * z)
        k = 0.55 + 0.75 * b
        return (k * (0.06 + 0.19 * a), k * (0.21 + 0.17 * a), k * 0.035), 0.0, 1.0
    if part == CAP:
        return _cap_colour(g, x, y, z, item)
    if part == STEM:
        t = g.toadstools[item]
        k = 0.75 + 0.25 * noise(9 * x, 2 * y, 9 * z)
        low = ramp(t[1] + 0.16, t[1], y)
        return (k * (0.86 - 0.3 * low), k * (0.78 - 0.3 * low), k * (0.60 - 0.36 * low)), 0.12, 12.0
    if part == PEBBLE:
        vein = ramp(0.06, 0.0, abs(noise(7 * x + 11 * item, 7 * y, 7 * z) - 0.5))
        k = 0.16 + 0.1 * noise(30 * x, 30 * y, 30 * z) if g.pebbles[item, 7] == 0 else 0.55
        return (k + 0.35 * vein * (1 - k), k * 0.98 + 0.33 * vein * (1 - k), k * 0.93 + 0.3 * vein * (1 - k)), 0.6, 40.0
    if part == BALL:
        swirl = noise(6 * x + 2 * math.sin(9 * y), 9 * y, 6 * z)
        k = ramp(0.42, 0.62, swirl)
        return (0.01 + 0.05 * k, 0.035 + 0.35 * k, 0.22 + 0.42 * k), 1.0, 55.0
    if part == BLADE:
        tip = ramp(0.1, 0.75, y)
        return (0.10 + 0.28 * tip, 0.33 + 0.23 * tip, 0.04 + 0.02 * tip), 0.22, 14.0
    if part == STALK:
        return (0.16, 0.34, 0.07), 0.1, 12.0
    if part == PETAL:
        f = g.daisies[item]
        near = math.sqrt((x - f[0]) ** 2 + (y - f[1]) ** 2 + (z - f[2]) ** 2) / f[12]
        pink = ramp(0.55, 1.0, near)
        return (0.92, 0.88 - 0.34 * pink, 0.86 - 0.12 * pink), 0.1, 10.0
    if part == HEART:
        k = 0.7 + 0.5 * noise(60 * x, 60 * y, 60 * z)
        return (0.95 * k, 0.58 * k, 0.03), 0.1, 12.0
    if part == SHELL:
        stripe = 0.5 + 0.5 * math.sin(0.5 * item * item * 0.09 + 22.0 * z)
        growth = 0.5 + 0.5 * math.sin(1.57 * item)
        k = 0.75 * stripe + 0.25 * growth
        return (0.16 + 0.60 * k, 0.035 + 0.34 * k, 0.01 + 0.07 * k), 0.85, 40.0
    k = 0.8 + 0.3 * noise(40 * x, 40 * y, 40 * z)
    return (0.36 * k, 0.24 * k, 0.15 * k), 0.5, 22.0  # the snail's body


@compiled
def _glaze(x: float, y: float, z: float) -> Material:
    """Return teal glaze over bare clay, thin at the lip, with a band of slip waves."""
    angle = math.atan2(z, x)
    drip = -0.50 + 0.05 * math.sin(5 * angle + 1.0) + 0.035 * math.sin(11 * angle) - 0.06 * noise(7 * x, 0.0, 7 * z)
    if y < drip:
        k = 0.8 + 0.35 * noise(26 * x, 60 * y, 26 * z)
        return (0.42 * k, 0.20 * k, 0.11 * k), 0.05, 8.0
    pool = ramp(drip + 0.28, drip, y) + 0.5 * noise(5 * x, 8 * y, 5 * z)
    red, green, blue = 0.035 - 0.02 * pool, 0.36 - 0.2 * pool, 0.37 - 0.13 * pool
    slip = ramp(0.022, 0.012, abs(y + 0.24 + 0.04 * math.sin(10 * angle)))
    bead = math.hypot(math.sin(5 * angle + 0.785) / 5.0, y + 0.24 - 0.03 * math.sin(10 * angle))
    slip = max(slip, ramp(0.042, 0.034, bead))
    lip = ramp(0.0, 0.035, y + 0.012 * noise(14 * x, 3.0, 14 * z))
    red, green, blue = red + slip * (0.8 - red), green + slip * (0.78 - green), blue + slip * (0.66 - blue)
    return (red + lip * (0.33 - red), green + lip * (0.16 - green), blue + lip * (0.06 - blue)), 1.0, 45.0


@compiled
def _cap_colour(g: Garden, x: float, y: float, z: float, item: int) -> Material:
    """Return the material of a cap: glossy with dots above, gills below."""
    t = g.toadstools[item]
    qx, qy, qz, radius = (x - t[3]) / t[6], (y - t[4]) / t[6], (z - t[5]) / t[6], t[6]
    flat = math.hypot(qx, qz)
    if (flat / 0.9) ** 2 + ((qy + 0.34) / 0.40) ** 2 < 1.0 and qy < 0.1:
        gill = 0.5 + 0.5 * math.cos(36 * math.atan2(qz, qx))
        k = 0.55 + 0.35 * gill
        return (0.95 * k, 0.82 * k, 0.58 * k), 0.0, 1.0
    # Dots on a Fibonacci spiral over the dome; larger caps have more.
    count = 26 if radius > 0.25 else 14
    height = math.sqrt(qx * qx + qz * qz + (qy / 0.66) ** 2) + 1e-9
    ux, uy, uz = qx / height, qy / 0.66 / height, qz / height
    dot = 0.0
    for i in range(count):
        h = 1.0 - (i + 0.4) / count
        ring, turn = math.sqrt(1.0 - h * h), 2.399963 * i + 1.3 * item
        size = 0.15 + 0.055 * math.sin(5.0 * i + item)
        gap = math.sqrt((ux - ring * math.cos(turn)) ** 2 + (uy - h) ** 2 + (uz - ring * math.sin(turn)) ** 2)
        dot = max(dot, ramp(size, 0.8 * size, gap * (1.0 + 0.25 * noise(9 * ux, 9 * uy, 9 * uz))))
    k = 0.85 + 0.3 * noise(5 * ux, 5 * uy, 5 * uz)
    red, green, blue = (0.66 * k, 0.014, 0.012) if t[7] == 0 else (0.85 * k, 0.26 * k, 0.015)
    return (red + dot * (0.9 - red), green + dot * (0.85 - green), blue + dot * (0.72 - blue)), 0.9 - 0.6 * dot, 36.0


@compiled
def ramp(low: float, high: float, value: float) -> float:
    """Return 0 below `low`, 1 above `high`, smooth between; reversed if low > high."""
    t = min(1.0, max(0.0, (value - low) / (high - low)))
    return t * t * (3.0 - 2.0 * t)
