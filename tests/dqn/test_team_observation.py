"""What a robot of a team knows when it chooses."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import PLACES, TRAVEL

from jaxsense.core.types import Belief
from jaxsense.dqn import team_mdp
from jaxsense.dqn.team_mdp import Team

NOP, CAMERA, LIDAR = 3, 0, 1
BELIEF = Belief(jnp.array([[3.0], [-1.0], [0.5]]), jnp.array([[0.3], [2.0], [1.0]]))


def team_of_three(**changed):
    """A camera and a LiDAR at the origin, which heads for PoI 1, and a camera that has ended."""
    team = Team(
        positions=PLACES,
        present=jnp.ones(3, bool),
        poses=jnp.array([[0, 0, 0], [0, 0, math.pi / 2], [1.9, 0, 0]]),
        modality=jnp.array([CAMERA, LIDAR, CAMERA]),
        works=jnp.array([True, True, False]),
        target=jnp.array([NOP, 1, 0]),
    )
    return replace(team, **changed)


observe = jax.jit(
    lambda team, agent, belief=BELIEF: team_mdp.observation(TRAVEL, belief, team, agent, 2)
)


def test_what_a_robot_knows_as_worked_by_hand():
    turn, half = math.pi / 2, math.pi
    # Seconds to PoIs 0, 1 and 2: 5, 10 and 15 of driving, 1 of looking, and the turns.
    camera = np.array([6, 11 + turn, 16 + half]) / 10
    lidar = np.exp(-np.array([6 + turn, 11, 16 + turn]) / 10)
    # The camera that has ended stands at PoI 0 and counts nowhere.
    expected = [
        [3, -1, 0.5],
        [0.3, 2, 1],
        camera,
        [0, 0, 0],  # no other camera heads for anything
        [0, lidar[1], 0],
        [0, 0, 0],  # nor could be anywhere
        lidar,
        [1, 1, 1],  # its own sensor is a camera
        [0, 0, 0],
        [1, 1, 1],
        *np.asarray(PLACES).T,
    ]
    found = observe(team_of_three(), jnp.int32(0))
    assert found.shape == (team_mdp.num_features(1, 2), 3)
    np.testing.assert_allclose(found, np.array(expected), atol=1e-5)
    np.testing.assert_allclose(team_mdp.own_seconds(found, 1), 10 * camera, rtol=1e-5)
    # For the LiDAR the camera is the other one; it heads for PoI 2 now.
    heading = team_of_three(target=jnp.array([2, 1, 0]))
    found = observe(heading, jnp.int32(1))
    np.testing.assert_allclose(found[3], [0, 0, np.exp(-camera[2])], atol=1e-5)
    np.testing.assert_array_equal(found[4], 0)
    np.testing.assert_allclose(found[5], np.exp(-camera), atol=1e-5)
    np.testing.assert_array_equal(found[6], 0)
    np.testing.assert_array_equal(found[7:9], [[0] * 3, [1] * 3])


def test_of_robots_with_the_same_sensor_the_nearest_counts():
    found = observe(team_of_three(works=jnp.ones(3, bool)), jnp.int32(1))
    times = np.stack(
        [
            [6, 11 + math.pi / 2, 16 + math.pi],
            # The second camera stands at PoI 0 and looks away from PoIs 1 and 2.
            team_mdp.travel_seconds(TRAVEL, jnp.array([1.9, 0, 0]), PLACES),
        ]
    )
    assert times[1, 0] == 1 < times[0, 0]
    np.testing.assert_allclose(found[5], np.exp(-times.min(axis=0) / 10), atol=1e-5)
    # It heads for PoI 0, where it is.
    np.testing.assert_allclose(found[3], [np.exp(-0.1), 0, 0], atol=1e-5)


def test_the_place_is_seen_from_the_robot():
    moved = team_of_three(poses=jnp.array([[1.0, -2.0, 0.5], [0, 0, 0], [0, 0, 0]]))
    found = observe(moved, jnp.int32(0))
    np.testing.assert_allclose(found[-2:].T, np.asarray(PLACES) - (1.0, -2.0), atol=1e-6)


@pytest.mark.parametrize("agent", [0, 1])
def test_permuting_pois_permutes_what_is_known_of_them(agent):
    order = jnp.array([2, 0, 1])
    heading = team_of_three(present=jnp.array([True, True, False]))
    there = replace(
        heading,
        positions=PLACES[order],
        present=heading.present[order],
        target=jnp.array([NOP, 2, 1]),  # PoI 1 is now the third, PoI 0 the second
    )
    belief = jax.tree.map(lambda x: x[order], BELIEF)
    here = observe(heading, jnp.int32(agent))
    np.testing.assert_array_equal(observe(there, jnp.int32(agent), belief), here[:, order])


def test_of_an_absent_poi_nothing_is_known():
    found = observe(team_of_three(present=jnp.array([True, False, True])), jnp.int32(0))
    np.testing.assert_array_equal(found[:, 1], 0.0)
    whole = observe(team_of_three(), jnp.int32(0))
    np.testing.assert_array_equal(found[:, [0, 2]], whole[:, [0, 2]])


def test_a_standard_deviation_of_zero_is_refused():
    belief = replace(BELIEF, std=BELIEF.std.at[1].set(0.0))
    with pytest.raises(ValueError, match=r"belief\.std = 0\.0"):
        team_mdp.observation(TRAVEL, belief, team_of_three(), jnp.int32(0), 2)
