"""What it is worth to choose from where to look, in problems with a known answer."""

import numpy as np
import pytest

from benchmarks import where

CERTAIN, USELESS = np.full(100, 20.0), np.zeros(100)


def test_a_single_certain_look_is_all_that_anybody_takes():
    problem = where.Problem([CERTAIN] * 5, np.array([1.0]), 0.5, speed=0.2, stays=False)
    for by_rule in (True, False):
        time, accuracy = problem.solve(1000.0, by_rule)
        assert time == pytest.approx(0.1)
        assert accuracy > 0.9999


def test_where_only_near_looks_tell_something_the_best_choice_drives_there_at_once():
    # From .5 m looks are certain, from elsewhere they say nothing: 1 to 3 m at .2 m/s, and a look.
    looks = [CERTAIN, *[USELESS] * 4]
    problem = where.Problem(looks, np.ones(2), 0.5, speed=0.2, stays=False)
    time, accuracy = problem.solve(1000.0, False)
    assert time == pytest.approx((5 + 10 + 15) / 3 + 0.1)
    assert accuracy > 0.9999
    # The rule looks in vain from where it stands, and from .9 m.
    assert problem.solve(1000.0, True)[1] == pytest.approx(0.5)


def test_a_cheap_error_is_made():
    looks = [CERTAIN, *[USELESS] * 4]
    problem = where.Problem(looks, np.ones(2), 0.5, speed=0.2, stays=False)
    time, accuracy = problem.solve(1.0, False)
    assert (time, accuracy) == pytest.approx((0.0, 0.5))


def test_the_best_choice_is_never_worse_than_the_rule():
    noise = np.random.default_rng(0).normal(size=1000)
    ratios = [strength * noise + strength**2 / 2 for strength in (3.0, 2.5, 2.0, 1.5, 1.0)]
    problem = where.Problem(ratios, np.array([1.0, 0.3, 0.1]), 0.6, speed=0.2, stays=False)
    for price in (50.0, 500.0):
        (rule, right), (best, best_right) = (problem.solve(price, by) for by in (True, False))
        assert best + price * (1 - best_right) <= rule + price * (1 - right) + 1e-9


def test_times_are_interpolated_between_points():
    assert where.at(0.95, [(4.0, 0.96), (2.0, 0.94)]) == pytest.approx(3.0)
    assert np.isnan(where.at(0.99, [(4.0, 0.96), (2.0, 0.94)]))


def test_looks_from_one_place_say_less_and_less():
    # A robot that stays gets the first look of .1 s, then one that says nothing; then it drives.
    problem = where.Problem([CERTAIN] * 5, np.array([0.0, 0.0]), 0.5, speed=0.2, stays=True)
    assert problem.solve(1000.0, True) == pytest.approx((0.0, 0.5))
    # The best choice drives .5 m: no look says anything, and it does not look.
    assert problem.solve(1000.0, False) == pytest.approx((0.0, 0.5))
    assert [problem.actions(2, looks, True) for looks in (0, 1)] == [[(2, 0.1, 0)], [(2, 0.1, 1)]]
    assert problem.actions(2, 2, True) == [(1, pytest.approx(0.6 / 0.2 + 0.1), 0)]
