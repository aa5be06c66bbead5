# SPDX-License-Identifier: Apache-2.0
"""The scene of the sample: a dish garden of moss, toadstools, daisies, grass, pebbles and a snail.

An original design, made for this project and dedicated to the public domain (CC0-1.0). Lengths are
in scene units, y points up; the dish has radius 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from csplat.types import F64

DISH, MOSS, CAP, STEM, PEBBLE, BALL, BLADE, STALK, PETAL, HEART, SHELL, BODY = range(12)

#: Centre (on the y axis) and radius of a sphere around everything.
BOUND = (0.12, 1.36)

#: Height and radius of the sphere that the dish is cut from.
DISH_CENTRE, DISH_RADIUS = 0.30, 1.04


class Garden(NamedTuple):
    """The layout of the garden.

    Attributes:
        toadstools: [n, 8] foot x y z, middle of the cap x y z, radius of the cap, kind.
        cushions: [n, 4] balls of moss: x y z, radius.
        pebbles: [n, 8] centre x y z, radii x y z, turn about y (radians), kind.
        strands: [n, 9] tapered sticks: x y z, x y z, radius at either end, part.
        tufts: [n, 6] bounding ball x y z, radius; first index of its strands and the index after the last.
        daisies: [n, 13] centre, three axes (the second is the normal of the flower), radius.
        shell: [n, 4] balls along a spiral: x y z, radius.
        shell_ball: [4] bounding ball of the shell.
    """

    toadstools: F64
    cushions: F64
    pebbles: F64
    strands: F64
    tufts: F64
    daisies: F64
    shell: F64
    shell_ball: F64


def make_garden(seed: int = 7) -> Garden:
    """Plant the garden.

    Args:
        seed: seed of the blades of grass, which differ slightly.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    toadstools = [
        (-0.16, 0.05, -0.12, -0.22, 0.74, -0.10, 0.46, 0),
        (0.36, 0.02, -0.34, 0.47, 0.47, -0.40, 0.29, 0),
        (0.24, 0.05, 0.16, 0.30, 0.30, 0.20, 0.19, 1),
        (-0.56, 0.00, 0.30, -0.66, 0.25, 0.37, 0.15, 1),
    ]
    cushions = [(-0.42, 0.0, -0.5, 0.24), (0.62, -0.03, 0.0, 0.2), (-0.1, 0.02, 0.42, 0.17), (-0.68, -0.06, -0.1, 0.2)]
    pebbles = [
        (0.52, 0.05, 0.56, 0.12, 0.075, 0.10, 0.4, 0),
        (0.68, 0.03, 0.46, 0.085, 0.06, 0.075, 1.3, 1),
        (0.43, 0.02, 0.73, 0.075, 0.05, 0.06, 2.2, 1),
        (-0.72, 0.03, -0.42, 0.11, 0.08, 0.085, 0.9, 1),
        (-0.58, 0.03, -0.62, 0.075, 0.06, 0.07, 0.1, 0),
        (0.05, 0.05, -0.72, 0.12, 0.075, 0.09, 2.6, 0),
        (0.23, 0.03, -0.77, 0.07, 0.05, 0.06, 1.1, 1),
        (0.66, 0.13, 0.20, 0.115, 0.115, 0.115, 0.0, 2),
    ]
    tufts = [(0.68, 0.0, -0.22), (-0.44, 0.02, -0.34), (-0.14, 0.03, 0.66), (-0.86, -0.04, 0.12)]
    strands, balls = [], []
    for number, root in enumerate(tufts):
        blades = [_blade(rng, root, 0.62 if number < 2 else 0.36) for _ in range(7 if number < 2 else 5)]
        _bundle(strands, balls, [stick for blade in blades for stick in blade])
    daisies = []
    for foot, head, tilt, size in (
        ((-0.30, 0.04, 0.34), (-0.36, 0.50, 0.50), (-0.25, 0.75, 0.6), 0.125),
        ((-0.36, 0.03, 0.40), (-0.56, 0.36, 0.66), (-0.5, 0.7, 0.5), 0.105),
        ((0.52, 0.04, -0.02), (0.62, 0.56, 0.06), (0.45, 0.8, 0.25), 0.12),
        ((-0.12, 0.04, -0.55), (-0.14, 0.46, -0.76), (-0.1, 0.7, -0.7), 0.115),
    ):
        middle = (np.add(foot, head) / 2 + np.array([0.0, 0.09, 0.0])).tolist()
        _bundle(strands, balls, _curve(foot, middle, head, 0.016, 0.011, STALK))
        daisies.append([*head, *_axes(tilt).ravel(), size])
    _bundle(strands, balls, _snail())
    shell = _shell(centre=(0.02, 0.25, 0.72), size=0.185)
    middle = shell[:, :3].mean(axis=0)
    reach = np.max(np.linalg.norm(shell[:, :3] - middle, axis=1) + shell[:, 3])
    return Garden(
        np.array(toadstools), np.array(cushions), np.array(pebbles), np.array(strands), np.array(balls),
        np.array(daisies), shell, np.array([*middle, reach]),
    )  # fmt: skip


def _blade(rng: np.random.Generator, root: Sequence[float], height: float) -> list[list[float]]:
    """Return a blade of grass that bends to a random side."""
    angle, tall = 2 * np.pi * rng.random(), height * (0.65 + 0.5 * rng.random())
    lean = np.array([np.cos(angle), 0.0, np.sin(angle)])
    foot = np.array(root) + 0.06 * rng.random() * lean
    middle = foot + [0.0, 0.8 * tall, 0.0] + 0.12 * lean
    tip = foot + [0.0, tall * (0.75 + 0.25 * rng.random()), 0.0] + (0.16 + 0.2 * rng.random()) * lean
    return _curve(foot, middle, tip, 0.021, 0.006, BLADE)


def _curve(foot: Sequence[float], middle: Sequence[float], tip: Sequence[float],
           thick: float, thin: float, part: int) -> list[list[float]]:  # fmt: skip
    """Return a quadratic Bézier curve as six tapered sticks."""
    t = np.linspace(0.0, 1.0, 7)[:, None]
    points = (1 - t) ** 2 * np.array(foot) + 2 * t * (1 - t) * np.array(middle) + t**2 * np.array(tip)
    radii = thick + (thin - thick) * t[:, 0] ** 1.5
    return [[*points[i], *points[i + 1], radii[i], radii[i + 1], part] for i in range(6)]


def _snail() -> list[list[float]]:
    """Return the body of the snail: foot, neck and horns."""
    sticks = [
        ((-0.30, 0.045, 0.72), (-0.02, 0.075, 0.74), 0.02, 0.06),
        ((-0.02, 0.075, 0.74), (0.15, 0.085, 0.73), 0.06, 0.058),
        ((0.15, 0.085, 0.73), (0.23, 0.20, 0.72), 0.058, 0.048),
        ((0.24, 0.23, 0.735), (0.29, 0.335, 0.775), 0.012, 0.009),
        ((0.24, 0.23, 0.705), (0.30, 0.325, 0.665), 0.012, 0.009),
        ((0.29, 0.335, 0.775), (0.291, 0.337, 0.776), 0.018, 0.018),
        ((0.30, 0.325, 0.665), (0.301, 0.327, 0.664), 0.018, 0.018),
    ]
    return [[*a, *b, thick, thin, BODY] for a, b, thick, thin in sticks]


def _shell(centre: Sequence[float], size: float) -> F64:
    """Return the shell of a snail: balls along a logarithmic spiral."""
    count, turns = 40, 2.6
    along = np.arange(count) / (count - 1)
    growth = 0.13 ** (1 - along)
    angle = 2 * np.pi * turns * along - 1.9
    x = centre[0] - size * growth * np.cos(angle) * 0.62
    y = centre[1] + size * growth * np.sin(angle) * 0.62
    z = centre[2] + 0.42 * size * (0.5 - growth)
    return np.stack([x, y, z, 0.5 * size * growth], axis=1)


def _bundle(strands: list[list[float]], balls: list[list[float]], more: list[list[float]]) -> None:
    """Add strands and their bounding ball."""
    ends = np.array([stick[:3] for stick in more] + [stick[3:6] for stick in more])
    middle = (ends.min(axis=0) + ends.max(axis=0)) / 2
    reach = np.max(np.linalg.norm(ends - middle, axis=1)) + max(max(stick[6:8]) for stick in more)
    balls.append([*middle, reach, len(strands), len(strands) + len(more)])
    strands += more


def _axes(normal: Sequence[float]) -> F64:
    """Return three axes as rows, the second along the normal."""
    y = np.array(normal) / np.linalg.norm(normal)
    x = np.cross(y, [0.0, 0.0, 1.0] if abs(y[2]) < 0.8 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)])
