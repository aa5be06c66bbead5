"""One number looked for by trials: false position between what is too low and what is too high."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

__all__ = ["FLATTEST", "Window", "meet"]

#: Of the slope that is expected, the least that two trials are believed: what they say may be noise.
FLATTEST = 0.15

_STEEPEST = 4.0  # the most
_STALLED = 0.03  # of the bounds; over a shorter way values that do not grow may be noise
_INSIDE = 0.08  # of a bracket: a trial never lies nearer to its ends


@dataclass(frozen=True)
class Window:
    """Where a value is to come to lie.

    Attributes:
        low, high: within is good enough.
        aim: what a trial is made for.
    """

    low: float
    high: float
    aim: float


def meet(
    measure: Callable[[float], float],
    window: Window,
    *,
    start: float,
    slope: float,
    bounds: tuple[float, float],
    tries: int,
    known: Sequence[tuple[float, float]] = (),
    flattest: float = FLATTEST,
    patience: int = 2,
) -> list[tuple[float, float]]:
    """Try places until a value that grows with them lies in a window.

    Args:
        measure: the value at a place; dear.
        window: where the value is to lie.
        start: where to try first.
        slope: of the value, about, above 0.
        bounds: the least and the largest place.
        tries: how many at most.
        known: places and values from before; where there are some, `start` says nothing.
        flattest: how much less steep than `slope` two trials may say that the value is.
        patience: after so many long steps one after the other that gained next to nothing no more are tried.

    Returns:
        Places and values in the order in which they were tried, those known first; the last one lies in the window
        where any does. Fewer than `tries` where a bound is the best that there is, or values grow no more.
    """
    points = sorted(known, key=lambda point: -abs(point[1] - window.aim))  # what is nearest to the aim comes last
    if points and window.low <= points[-1][1] <= window.high:
        return points
    for _ in range(tries):
        place: float | None = min(max(start, bounds[0]), bounds[1])
        if points:
            place = _next(points, window, slope, flattest * slope, bounds, patience)
        if place is None:
            break
        value = measure(place)
        points.append((place, value))
        if window.low <= value <= window.high:
            break
    return points


def _next(
    points: list[tuple[float, float]],
    window: Window,
    slope: float,
    least: float,
    bounds: tuple[float, float],
    patience: int,
) -> float | None:
    """Where to try next, by a slope that is expected and the least; None where a bound was tried, or nothing grows."""
    below = max((point for point in points if point[1] < window.low), default=None)
    above = min((point for point in points if point[1] > window.high), default=None)
    if below is not None and above is not None and above[0] > below[0]:
        share = (window.aim - below[1]) / (above[1] - below[1])
        share = min(max(share, _INSIDE), 1.0 - _INSIDE)
        return below[0] + share * (above[0] - below[0])
    place, value = points[-1]
    if len(points) > 1 and points[-2][0] != place:
        seen = (value - points[-2][1]) / (place - points[-2][0])
        if value < window.low and all(
            _stalled(points[: len(points) - back], slope, bounds) for back in range(patience)
        ):
            return None  # it grows no more
        slope = min(max(seen, least), _STEEPEST * slope)
    wanted = min(max(place + (window.aim - value) / slope, bounds[0]), bounds[1])
    return None if any(wanted == tried for tried, _ in points) else wanted


def _stalled(points: list[tuple[float, float]], slope: float, bounds: tuple[float, float]) -> bool:
    """Whether the last step went far and gained next to nothing; one that did may have crossed a plateau."""
    if len(points) < 2:
        return False
    (before, low), (place, high) = points[-2:]
    far = place - before >= _STALLED * (bounds[1] - bounds[0])
    return far and high - low < FLATTEST * slope * (place - before)
