"""Rate–distortion curves: points, interpolation between them, and which point to measure next."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

_WINDOW = 2.0  # dB on either side of a goal in which a point has to lie for a straight line to be trusted
_BESIDE = 0.4  # dB: points are aimed this far from a goal
_SLOPES = (0.1, 2.0)  # dB of PSNR per dB of quality that are believed
_LEAST_RATE = 0.03  # share of the bytes that a decibel costs, at least
_CLOSE = 0.02  # dB of quality that change nothing any more
_GAP = 4.5  # dB between two points of a series, at most, for what lies between them


@dataclass(frozen=True)
class Point:
    """A file that was written and judged.

    Attributes:
        psnr: against the source, dB.
        size_bytes: size of the file.
        quality: the encoder's option; 0 if it has none.
        seconds: time of encoding.
    """

    psnr: float
    size_bytes: int
    quality: float = 0.0
    seconds: float = 0.0


Series = Mapping[str, Sequence[Point]]  # by the settings other than the quality


@dataclass(frozen=True)
class Rate:
    """Size of files at a given PSNR.

    Attributes:
        size_bytes: interpolated size, or the size of a file with a higher PSNR than the given one.
        how: name of the series.
        measured: PSNR of that file, dB, if nothing was interpolated.
    """

    size_bytes: float
    how: str
    measured: float | None = None


def rate_at(series: Series, psnr: float) -> Rate | None:
    """Smallest size at which a PSNR is reached: log(bytes) is straight between two points of the same series.

    A point that is better than asked and smaller than all interpolated ones counts as it is. Nothing is extrapolated.

    Args:
        series: points by what was chosen.
        psnr: dB.

    Returns:
        `None` if no point is good enough.
    """
    found: list[Rate] = []
    for how, points in series.items():
        found += [Rate(one.size_bytes, how, one.psnr) for one in points if one.psnr >= psnr]
        between = bytes_between(points, psnr)
        if between is not None:
            found.append(Rate(between, how))
    return min(found, key=lambda rate: rate.size_bytes, default=None)


def bytes_between(points: Sequence[Point], psnr: float, gap: float = _GAP) -> float | None:
    """Bytes at a PSNR, log(bytes) being straight between the points on either side.

    Args:
        points: files of one kind.
        psnr: dB.
        gap: between the two points, at most, dB.

    Returns:
        `None` if a side has no point, or the two are further apart.
    """
    below = max((one for one in points if one.psnr <= psnr), key=lambda one: one.psnr, default=None)
    above = min((one for one in points if one.psnr >= psnr), key=lambda one: one.psnr, default=None)
    if below is None or above is None or above.psnr - below.psnr > gap:
        return None
    if above.psnr == below.psnr:
        return float(min(below.size_bytes, above.size_bytes))
    share = (psnr - below.psnr) / (above.psnr - below.psnr)
    return math.exp((1.0 - share) * math.log(below.size_bytes) + share * math.log(above.size_bytes))


def psnr_at(series: Series, size_bytes: float) -> float | None:
    """Highest PSNR that files of a size reach, on the front's straight lines; `None` below the smallest file."""
    points = front(series)
    if not points or size_bytes < points[0].size_bytes:
        return None
    for low, high in pairwise(points):
        if size_bytes <= high.size_bytes:
            share = math.log(size_bytes / low.size_bytes) / math.log(high.size_bytes / low.size_bytes)
            return low.psnr + share * (high.psnr - low.psnr)
    return points[-1].psnr


def front(series: Series) -> list[Point]:
    """The points that no other one beats in both size and PSNR, by size."""
    best, chosen = -math.inf, list[Point]()
    every = (one for points in series.values() for one in points)
    for one in sorted(every, key=lambda one: (one.size_bytes, -one.psnr)):
        if one.psnr > best:
            best = one.psnr
            chosen.append(one)
    return chosen


def bracket(
    points: Sequence[Point],
    goal: float,
    measure: Callable[[float], Point],
    *,
    start: float,
    limits: tuple[float, float],
    ceiling: float = math.inf,
    most: int = 8,
) -> list[Point]:
    """Measure until a point lies just below a PSNR and one just above it.

    Args:
        points: the points measured so far.
        goal: PSNR, dB.
        measure: encodes at a quality.
        start: quality to begin with if nothing is known.
        limits: limits of the quality.
        ceiling: bytes of another series at the goal; one that is not going to be below is given up.
        most: measurements at most; then what is there has to do.

    Returns:
        The new points, in order.
    """
    known, new = list(points), list[Point]()
    while len(new) < most:
        below = any(goal - _WINDOW <= one.psnr <= goal for one in known)
        above = any(goal <= one.psnr <= goal + _WINDOW for one in known)
        if (below and above) or _expected(known, goal) >= ceiling:
            break
        aim = goal + (_BESIDE if below else -_BESIDE)
        quality = min(max(_quality_for(known, aim, start), limits[0]), limits[1])
        if any(abs(quality - one.quality) < _CLOSE for one in known):
            break  # at an end of what the encoder offers
        new.append(measure(quality))
        known.append(new[-1])
    return new


def _expected(points: Sequence[Point], goal: float) -> float:
    """Bytes at a PSNR above all points, by the straight line through the best two; too few rather than too many.

    Curves of log(bytes) bend upwards. 0 if a point is above.
    """
    if not points or any(one.psnr >= goal for one in points):
        return 0.0
    best = sorted(points, key=lambda one: -one.psnr)
    slope = _LEAST_RATE
    if len(best) > 1 and best[0].psnr > best[1].psnr:
        slope = max(slope, math.log(best[0].size_bytes / best[1].size_bytes) / (best[0].psnr - best[1].psnr))
    return best[0].size_bytes * math.exp(slope * (goal - best[0].psnr))


def _quality_for(points: Sequence[Point], psnr: float, start: float) -> float:
    """Return the quality at which the line through the two points nearest to a PSNR reaches it.

    With one point, or two of equal quality, the slope is 0.8 dB per dB; slopes are clamped to `_SLOPES`.
    Without points the result is `start`.
    """
    if not points:
        return start
    near = sorted(points, key=lambda one: abs(one.psnr - psnr))
    slope = 0.8
    if len(near) > 1 and near[0].quality != near[1].quality:
        slope = (near[0].psnr - near[1].psnr) / (near[0].quality - near[1].quality)
    return near[0].quality + (psnr - near[0].psnr) / min(max(slope, _SLOPES[0]), _SLOPES[1])
