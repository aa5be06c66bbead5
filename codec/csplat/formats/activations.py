"""Recognise logarithms of standard deviations, and logits of opacities, in formats that should hold neither.

glTF, .splat and .ksplat hold values after activation: scales of at least 0, opacities from 0 to 1. Some writers forget
to activate them (splat-transform 2.3.1 in its GLB). One value does not tell; all of them together do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import counted
from csplat.lint import Finding

_LOGS = (-30.0, 10.0)  # natural logarithms of lengths in scene units: from 1e-13 to 22,026
_MOST_ARE_LOGS = 0.5  # share of negative values: splats of trained scenes are smaller than a unit, but for the sky
_MANY_LOGITS = 0.25  # share of values outside of 0..1: of trained scenes it is two thirds and more
_SLIGHTLY = (-1.0, 2.0)  # opacities that are clipped: what a writer without a sigmoid at its end gives now and then


@dataclass
class Spread:
    """Statistics of values relative to the range that is allowed, updated by `add`.

    Attributes:
        low, high: the range.
        count: number of values.
        below, above: number of values on either side of the range.
        least, most: smallest and largest of all values.
        rows: splats with a value outside.
        first: index of the first of these splats, and its value; `None`: there is none.
    """

    low: float = 0.0
    high: float = np.inf
    count: int = 0
    below: int = 0
    above: int = 0
    least: float = np.inf
    most: float = -np.inf
    rows: int = 0
    first: tuple[int, float] | None = None

    def add(self, values: NDArray[Any], start: int) -> None:
        """Look at values [N] or [N, C] of the splats from number `start` on; NaN is neither here nor there."""
        if not values.size:
            return
        least, most = float(np.fmin.reduce(values, axis=None)), float(np.fmax.reduce(values, axis=None))
        self.count += values.size
        self.least, self.most = min(self.least, least), max(self.most, most)
        if least >= self.low and most <= self.high:
            return
        below, above = values < self.low, values > self.high
        self.below += int(np.count_nonzero(below))
        self.above += int(np.count_nonzero(above))
        outside = (below | above).reshape(len(values), -1)
        rows = np.flatnonzero(outside.any(axis=1))
        self.rows += len(rows)
        if len(rows) and self.first is None:
            value = values.reshape(len(values), -1)[rows[0]][outside[rows[0]]][0]
            self.first = (start + int(rows[0]), float(value))


def read_scales_as(found: Spread, name: str, *, strict: bool, writer: str = "") -> tuple[bool, list[Finding]]:
    """Decide whether scales are logarithms.

    Args:
        found: the scales of a file, with 0 for its lower limit.
        name: name of their column, for messages.
        strict: the format forbids negative ones; else the sign means nothing: a covariance has their squares.
        writer: the program that wrote the file, if the file names it.

    Returns:
        True if they are logarithms, and the findings about it: an error if they are neither.
    """
    if found.first is None:
        return False, []
    share, (row, value) = found.below / found.count, found.first
    if share >= _MOST_ARE_LOGS and _LOGS[0] <= found.least and found.most <= _LOGS[1]:
        by = f" (written by {writer})" if writer else ""
        text = f"{name}: {share:.0%} of the values are negative, standard deviations never are: read as logarithms{by}"
        return True, [Finding("log-scales", found.rows, text, "repair")]
    text = f"{name} of splat {row} is {value:.6g}, expected a standard deviation of at least 0"
    if not strict:
        told = f"{text}; {counted(found.rows, 'splat')} of that kind: the sign is left out"
        return False, [Finding("negative-scales", found.rows, told, "repair")]
    text += f"; {share:.1%} of the values are negative, from {found.least:.3g} to {found.most:.3g}: export it again"
    return False, [Finding("negative-scales", found.rows, text, "error")]


def read_opacities_as(found: Spread, name: str) -> tuple[bool, list[Finding]]:
    """Decide whether opacities are logits; the rest as `read_scales_as`, with 0 and 1 for limits."""
    if found.first is None:
        return False, []
    share, (row, value) = found.rows / found.count, found.first
    if share >= _MANY_LOGITS and found.below and (found.above or found.least < _SLIGHTLY[0]):
        text = f"{name}: {share:.0%} of the values lie outside of 0 to 1, from {found.least:.3g} to {found.most:.3g}"
        return True, [Finding("logit-opacities", found.rows, f"{text}: read as logits", "repair")]
    text = f"{name} of splat {row} is {value:.6g}, expected 0 to 1"
    if _SLIGHTLY[0] <= found.least and found.most <= _SLIGHTLY[1]:
        told = f"{text}; {counted(found.rows, 'splat')} of that kind: clipped"
        return False, [Finding("out-of-range-opacities", found.rows, told, "repair")]
    text += f"; the values go from {found.least:.3g} to {found.most:.3g}: export it again"
    return False, [Finding("out-of-range-opacities", found.rows, text, "error")]
