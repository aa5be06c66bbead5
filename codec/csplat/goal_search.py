# SPDX-License-Identifier: Apache-2.0
"""Search for the value with which a measured result meets a goal, in few measurements.

A result is a function of one number, such as the log error of a file by its precision. It meets the goal if it is at
most the goal. Callers make and measure something for each value, and take logarithms where results are proportional.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

_SLOPES = (0.2, 2.0)  # range of the factor by which a second result on the same side of the goal may scale the model
_EDGE = 0.1  # fraction of an interval between two measured values at whose ends no value is proposed
_HALVINGS = 50  # bisection steps to invert a model; they exhaust the precision of float64


def next_value(
    goal: float,
    measured: Sequence[tuple[float, float]],
    model: float | Callable[[float], float],
    *,
    bounds: tuple[float, float],
    margin: float = 0.0,
    tolerance: float = 0.0,
    largest_step: float = math.inf,
    least_step: float = 1e-9,
    tries: int | None = None,
) -> float | None:
    """Propose the value to measure next.

    The model is shifted to pass through the result nearest to the goal, and scaled to pass through a second result: the
    nearest on the other side of the goal, as in a search by secants, or else another on the same side.

    Args:
        goal: results that are at most the goal meet it.
        measured: values and their results.
        model: expected result of a value, or the slope of a straight line. It rises or falls everywhere.
        bounds: least and largest value, finite.
        margin: distance below the goal that is aimed at until a result is nearer.
        tolerance: results that meet the goal and are this near to it end the search.
        largest_step: largest distance to the value of the nearest result.
        least_step: least distance to all measured values.
        tries: largest number of measured values.

    Returns:
        The value; `None` if a result is within the tolerance, or if no value is left to try.
    """
    met = max((result for _, result in measured if result <= goal), default=-math.inf)
    is_near = math.isfinite(met) and met >= goal - tolerance
    if is_near or (tries is not None and len(measured) >= tries):
        return None
    expected = _as_function(model)
    aim = max(goal - margin, 0.5 * (met + goal))
    low, high = bounds
    if measured:
        first, second, is_bracket = _choose_pairs(goal, measured, least_step)
        value, result = first
        factor = 1.0
        low, high = max(low, value - largest_step), min(high, value + largest_step)
        if second is not None:
            other, its_result = second
            change = expected(other) - expected(value)
            edge = max(_EDGE * abs(other - value), least_step)
            factor = (its_result - result) / change if change else 1.0
            if is_bracket and factor > 0.0:
                low, high = max(low, min(value, other) + edge), min(high, max(value, other) - edge)
            else:
                factor = min(max(factor, _SLOPES[0]), _SLOPES[1])
        aim = expected(value) + (aim - result) / factor
    if low > high:
        return None
    proposed = _inverse(expected, aim, low, high)
    while any(abs(proposed - value) < least_step for value, _ in measured):
        if math.isfinite(met):
            return None
        proposed += least_step if expected(high) < expected(low) else -least_step  # to smaller results
    return proposed if bounds[0] <= proposed <= bounds[1] else None


def _as_function(model: float | Callable[[float], float]) -> Callable[[float], float]:
    """Return the model as a function; a number is the slope of a line through the origin."""
    return model if callable(model) else lambda value: model * value


def _choose_pairs(
    goal: float, measured: Sequence[tuple[float, float]], least_step: float
) -> tuple[tuple[float, float], tuple[float, float] | None, bool]:
    """Return the two pairs that determine the model, the nearest to the goal first, and True if they enclose the goal.

    Of all such pairs, their values are the nearest to each other.
    """
    by_result = sorted(measured, key=lambda pair: abs(pair[1] - goal))
    met = [pair for pair in by_result if pair[1] <= goal]
    missed = [pair for pair in by_result if not pair[1] <= goal]  # a NaN misses
    if met and missed:
        ends = min(itertools.product(met, missed), key=lambda pairs: abs(pairs[0][0] - pairs[1][0]))
        first, second = sorted(ends, key=lambda pair: abs(pair[1] - goal))
        return first, second, True
    first = by_result[0]
    return first, next((pair for pair in by_result if abs(pair[0] - first[0]) >= least_step), None), False


def _inverse(expected: Callable[[float], float], result: float, low: float, high: float) -> float:
    """Return the value of an expected result, or the end of the interval whose result is nearest to it."""
    is_rising = expected(low) < expected(high)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if (expected(middle) < result) == is_rising else (low, middle)
    return 0.5 * (low + high)
