"""Which way is up, from how the cameras of a set were held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.upright import Direction, unit_up

__all__ = ["Level", "find_level"]

F64 = NDArray[np.float64]

_TURNED = 0.03  # least mean square, across the weakest direction but one, of the axes that point to the right
_TILT_MAX = 20.0  # degrees; cameras that were held less level say nothing
_UNDECIDED = 0.1  # of the mean of the cameras' up: below, they look down, and what they look away from is up


@dataclass(frozen=True)
class Level:
    """What cameras say of up.

    Attributes:
        up: unit length, in the scene's coordinates.
        tilt_degrees: half of the pictures are off by no more: their horizons against level ones, or where
            `by_horizons` does not hold the cameras' own up against this one. Some pictures taken with the camera on its
            side change little.
        by_horizons: people hold cameras level and look up and down: up is the direction that axes to the right show
            least of. It takes cameras that are turned to several sides; of others up is the mean of theirs.
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
        What they say; `None` where they were held at all angles.
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
