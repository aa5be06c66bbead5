# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.goal_search on formulas."""

import math

import pytest

from csplat.goal_search import next_value


def searched(function, goal, model, start=None, **how):
    """Measure proposed values until the search ends; return all pairs of value and result."""
    measured = [] if start is None else [(start, function(start))]
    while (value := next_value(goal, measured, model, **how)) is not None:
        assert how["bounds"][0] <= value <= how["bounds"][1]
        assert all(abs(value - earlier) >= how.get("least_step", 1e-9) for earlier, _ in measured)
        measured.append((value, function(value)))
        assert len(measured) <= 30
    return measured


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_line_of_the_models_slope_is_hit_at_once_and_of_another_soon(sign):
    def line(slope):
        return lambda value: 3.0 + slope * (value - 5.0)

    how = {"bounds": (-100.0, 100.0), "margin": 0.1, "tolerance": 0.2}
    assert 6.9 == pytest.approx(searched(line(sign), 5.0, sign, 5.0, **how)[-1][0] * sign + 5.0 * (1.0 - sign))
    for slope in (0.3, 1.9):
        found = searched(line(sign * slope), 5.0, sign, -20.0, **how)
        assert 4.8 <= found[-1][1] <= 5.0
        assert len(found) <= 4


def test_curves_are_hit_by_a_poor_model_and_at_once_by_a_good_one():
    for function in (math.exp, lambda value: value**3 + value, lambda value: 20.0 * math.tanh(value)):
        found = searched(function, 15.0, 4.0, -2.0, bounds=(-10.0, 10.0), margin=0.1, tolerance=0.2)
        assert 14.8 <= found[-1][1] <= 15.0
        assert len(found) <= 15
    found = searched(math.exp, 15.0, lambda value: math.exp(value) + 1.0, bounds=(-10.0, 10.0), tolerance=1.01)
    assert [pytest.approx((math.log(14.0), 14.0))] == found


def test_a_monotone_function_with_jumps_is_met_from_the_allowed_side():
    def jumping(value):
        return -math.floor(3.0 * value) - 0.3 * math.sin(40.0 * value)

    found = searched(jumping, -7.5, -1.0, 0.0, bounds=(0.0, 10.0), least_step=0.01, tolerance=0.2)
    best = max(result for _, result in found if result <= -7.5)
    assert -8.3 <= best
    assert len(found) <= 15


def test_values_stay_within_bounds_and_steps_and_the_number_of_tries():
    assert 4.0 == pytest.approx(next_value(9.0, [(2.0, 2.0)], 1.0, bounds=(0.0, 4.0)))
    assert 2.5 == pytest.approx(next_value(9.0, [(2.0, 2.0)], 1.0, bounds=(0.0, 4.0), largest_step=0.5))
    assert next_value(9.0, [(4.0, 4.0)], 1.0, bounds=(0.0, 4.0)) is None  # nothing beyond
    assert next_value(9.0, [(2.0, 2.0), (3.0, 3.0)], 1.0, bounds=(0.0, 20.0), tries=2) is None


def test_the_search_ends_at_a_result_within_the_tolerance_on_the_allowed_side_alone():
    bounds = (0.0, 20.0)
    assert next_value(9.0, [(2.0, 8.9)], 1.0, bounds=bounds, tolerance=0.1 + 1e-9) is None
    assert 1.9 == pytest.approx(next_value(9.0, [(2.0, 9.1)], 1.0, bounds=bounds, tolerance=0.2))
    # A missed result hardly above the goal is followed by the next value on the allowed side.
    assert 1.49 == pytest.approx(next_value(9.0, [(2.0, 9.01)], 1.0, bounds=bounds, least_step=0.5))
    assert next_value(9.0, [(2.0, 9.01), (1.5, 8.0)], 1.0, bounds=bounds, least_step=0.5) is None


def test_results_that_contradict_the_model_do_not_turn_the_search_around():
    assert next_value(9.0, [(2.0, 3.0), (3.0, 2.0)], 1.0, bounds=(0.0, 20.0), largest_step=5.0) == pytest.approx(7.0)
    assert next_value(9.0, [(2.0, 10.0), (3.0, 8.5)], 1.0, bounds=(0.0, 20.0)) > 3.0
