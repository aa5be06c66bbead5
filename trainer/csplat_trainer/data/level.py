"""Up direction of a set, estimated from how its cameras were held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from csplat.types import F64
from csplat.upright import Direction, unit_up

_TURNED = 0.03  # least mean square, across the weakest direction but one, of the axes that point to the right
_TILT_MAX = 20.0  # degrees; cameras that were held less level determine nothing
_UNDECIDED = 0.1  # cosine with the cameras' mean up below which they look down: up is then where they look away from


@dataclass(frozen=True)
class Level:
    """Up direction according to the cameras of a set.

    Attributes:
        up: unit length, in the scene's coordinates.
        tilt_degrees: median error of the images: of their horizons against level ones, or, if `by_horizons` is False,
            of the cameras' own up against this one. Some images taken with the camera on its side change little.
        by_horizons: True if up is the direction in which the cameras' right axes point least: people hold cameras level
            and look up and down. It requires cameras that are turned to several sides; otherwise up is the mean of
            the cameras' own.
    """

    up: Direction
    tilt_degrees: float
    by_horizons: bool

    def __str__(self) -> str:
        """The same in words, for people."""
        words = " ".join(f"{value:g}" for value in self.up)
        how = "their horizons lie" if self.by_horizons else "their own up lies"
        return f"up is {words} by the cameras: {how} within {self.tilt_degrees:.1f} degrees of that, for half of them"


def find_level(viewmats: Sequence[F64]) -> Level | None:
    """Find up from the cameras of a set.

    Args:
        viewmats: [4, 4] each, world to camera, OpenCV axes: rows are right, down, forward. At least one.

    Returns:
        The estimate; `None` if the cameras were held at all angles.
    """
    rotations = np.stack([viewmat[:3, :3] for viewmat in viewmats])
    right, own_up, forward = rotations[:, 0], -rotations[:, 1], rotations[:, 2]
    values, directions = np.linalg.eigh(np.mean(right[:, :, None] * right[:, None, :], axis=0))
    mean_up = np.mean(own_up, axis=0)
    found: list[Level] = []
    if values[1] > _TURNED:
        up = directions[:, 0]
        towards = float(np.sum(up * mean_up))
        if abs(towards) < _UNDECIDED:
            towards = -float(np.sum(up * np.mean(forward, axis=0)))
        up = up if towards >= 0.0 else -up
        found.append(_level(up, np.arcsin(np.clip(np.sum(right * up, axis=1), -1.0, 1.0)), by_horizons=True))
    length = float(np.sqrt(np.sum(mean_up**2)))
    if length > _UNDECIDED:
        up = mean_up / length
        found.append(_level(up, np.arccos(np.clip(np.sum(own_up * up, axis=1), -1.0, 1.0)), by_horizons=False))
    return next((one for one in found if one.tilt_degrees <= _TILT_MAX), None)


def _level(up: F64, angles: F64, *, by_horizons: bool) -> Level:
    tilt = float(np.degrees(np.median(np.abs(angles))))
    return Level(unit_up([float(value) for value in up]), tilt, by_horizons)
