"""Find a root by trials: false position between a place that is too low and one that is too high."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

#: Least slope that is taken from two trials, as a fraction of the expected one: a smaller one may be noise.
FLATTEST = 0.15

_STEEPEST = 4.0  # largest slope that is taken from two trials, as a multiple of the expected one
_STALLED = 0.03  # fraction of the range: over a shorter distance, values that do not grow may be noise
_INSIDE = 0.08  # fraction of a bracket: a trial is never nearer to its ends


@dataclass(frozen=True)
class Window:
    """The range in which a value is to lie.

    Attributes:
        low, high: values between these are good enough.
        aim: the value that a trial aims at.
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
    """Try places until the value of an increasing function lies in a window.

    Args:
        measure: returns the value at a place; expensive.
        window: the range in which the value is to lie.
        start: the first place to try.
        slope: approximate slope of the value, above 0.
        bounds: the least and the largest place.
        tries: largest number of trials.
        known: places and values from before; if there are any, `start` is not used.
        flattest: least slope that is taken from two trials, as a fraction of `slope`.
        patience: number of consecutive long steps without a gain after which the search ends.

    Returns:
        Places and values in the order in which they were tried, those known first; the last one lies in the window if
        any does. Fewer than `tries` if a bound is the best possible place, or the values do not grow any more.
    """
    points = sorted(known, key=lambda point: -abs(point[1] - window.aim))  # the nearest to the aim comes last
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
    """Return the next place to try; None if a bound was tried already, or the values do not grow any more."""
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
            return None  # the values do not grow any more
        slope = min(max(seen, least), _STEEPEST * slope)
    wanted = min(max(place + (window.aim - value) / slope, bounds[0]), bounds[1])
    return None if any(wanted == tried for tried, _ in points) else wanted


def _stalled(points: list[tuple[float, float]], slope: float, bounds: tuple[float, float]) -> bool:
    """Return True if the last step was long and gained next to nothing; a single one may have crossed a plateau."""
    if len(points) < 2:
        return False
    (before, low), (place, high) = points[-2:]
    far = place - before >= _STALLED * (bounds[1] - bounds[0])
    return far and high - low < FLATTEST * slope * (place - before)
