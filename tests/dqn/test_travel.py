"""The travel model with times and poses worked by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import TRAVEL

from jaxsense.dqn import travel
from jaxsense.dqn.travel import Travel

seconds_of_ways = jax.jit(travel.travel_seconds)
move = jax.jit(travel.move)


@pytest.mark.parametrize(
    ("pose", "place", "seconds"),
    [
        # A quarter turn at 1 rad/s, 2 - .9 m at .2 m/s, and the look.
        ((0, 0, 0), (0, 2), math.pi / 2 + 5.5 + 1),
        ((0, 0, 0), (0, -2), math.pi / 2 + 5.5 + 1),
        # From (1, 1) to (1, 3), from which the robot looks away by .5 rad.
        ((1, 1, math.pi / 2 - 0.5), (1, 3), 0.5 + 5.5 + 1),
        # The short way around: from 3 to -3 rad, 2 pi - 6.
        ((0, 0, 3.0), (-2 * math.cos(0.14159265), -2 * math.sin(0.14159265)), 0.28319 + 5.5 + 1),
        # A heading of two turns too many.
        ((0, 0, 4 * math.pi), (2, 0), 5.5 + 1),
        # Near enough: only turning and looking.
        ((0, 0, 0), (0, 0.8), math.pi / 2 + 1),
        # All at one place: only looking, whatever the heading.
        ((1, 2, 0.7), (1, 2), 1.0),
    ],
)
def test_time_until_a_look_as_worked_by_hand(pose, place, seconds):
    pose, places = jnp.array(pose, jnp.float32), jnp.array([place], jnp.float32)
    np.testing.assert_allclose(seconds_of_ways(TRAVEL, pose, places), [seconds], rtol=1e-4)


def test_every_number_of_the_model_counts():
    pose, places = jnp.zeros(3), jnp.array([[0.0, 2.0]])
    model = Travel(speed=0.4, turn_rate=2.0, view_distance=0.4, look_seconds=3.0)
    expected = math.pi / 2 / 2 + (2 - 0.4) / 0.4 + 3
    np.testing.assert_allclose(seconds_of_ways(model, pose, places)[0], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.0, (0, 0, 0)),
        (0.5, (0, 0, 0.5)),  # still turning, to the left
        (math.pi / 2 + 2, (0, 0.4, math.pi / 2)),  # and 2 s of driving at .2 m/s
        (math.pi / 2 + 5.5, (0, 1.1, math.pi / 2)),
        (99.0, (0, 1.1, math.pi / 2)),  # it waits there
    ],
)
def test_the_pose_on_the_way_as_worked_by_hand(seconds, expected):
    moved = move(TRAVEL, jnp.zeros(3), jnp.array([0.0, 2.0]), jnp.float32(seconds))
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    mirrored = move(TRAVEL, jnp.zeros(3), jnp.array([0.0, -2.0]), jnp.float32(seconds))
    np.testing.assert_allclose(mirrored, np.array(expected) * (1, -1, -1), atol=1e-6)


@jax.jit
def in_two_parts(pose, place, share):
    """The time of a way in one part; in two; and the pose at its end, in one and in two."""
    whole = travel.travel_seconds(TRAVEL, pose, place[None])[0]
    before = share * (whole - TRAVEL.look_seconds)
    between = travel.move(TRAVEL, pose, place, before)
    rest = travel.travel_seconds(TRAVEL, between, place[None])[0]
    end = travel.move(TRAVEL, pose, place, whole)
    return whole, before + rest, end, travel.move(TRAVEL, between, place, rest)


PLACE = st.floats(-3, 3, width=32)


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(st.tuples(PLACE, PLACE, PLACE), st.tuples(PLACE, PLACE), st.floats(0, 1, width=32))
def test_a_way_in_two_parts_takes_as_long_as_in_one(pose, place, share):
    numbers = (np.float32(x) for x in (pose, place, share))
    one, two, end, end_of_two = in_two_parts(*numbers)
    np.testing.assert_allclose(one, two, atol=1e-3)
    np.testing.assert_allclose(end[:2], end_of_two[:2], atol=1e-3)
    # A heading counts only up to full turns.
    np.testing.assert_allclose(np.exp(1j * end[2]), np.exp(1j * end_of_two[2]), atol=2e-3)
