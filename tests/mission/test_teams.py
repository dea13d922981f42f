"""Teams in which several robots carry the same sensor."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import AHEAD, CONFIG, LATENT, NAIVE, POLICIES, alone, decide_alone, starting, with_values

from jaxsense import mission
from jaxsense.mission import act
from jaxsense.mission.state import DRIVING, FACING

TEAM = replace(CONFIG, robots=("camera", "camera", "lidar"))
FIRST, SECOND, LIDAR = 0, 1, 2
# The PoIs are 0.8 m from the first, the second and the third robot, of which each faces its own.
POSES = [[0.0, 0.0, 0.0], [-0.2, 1.0, np.pi], [-0.2, -1.0, np.pi]]


@pytest.fixture(scope="module")
def many():
    return mission.make_mission(TEAM)


@pytest.fixture(scope="module")
def start_of(many, models):
    start = starting(many, models)
    return lambda poses=POSES, policy=NAIVE: start(AHEAD, poses, (2, 0, 1), policy)


@pytest.fixture(scope="module")
def scan(many, models):
    """A scan of any robot: one program for all of them, as in a mission."""
    return jax.jit(
        lambda key, state, robot: alone(
            lambda key, state: act.scan(key, many, models, state, robot)
        )(key, state)
    )


def test_robots_with_the_same_sensor_write_as_one_modality(scan, start_of, set_robot):
    state = start_of()
    for robot in (FIRST, SECOND, LIDAR):
        state = set_robot(state, robot, phase=FACING, target=robot, progress_at=-100.0)
        state = scan(jax.random.key(robot), state, jnp.int32(robot))
    np.testing.assert_array_equal(state.times_seen, [[1, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(state.robots.looks, [1, 1, 1])
    np.testing.assert_array_equal(state.robots.detections, [1, 1, 1])


@pytest.fixture(scope="module")
def decides(many):
    return jax.jit(lambda models, state, robot: decide_alone(
        jax.random.key(0), many, models, state, robot
    ))  # fmt: skip


def test_each_robot_asks_the_network_of_its_own_sensor(decides, models, start_of):
    trained = with_values(models, [1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.5])
    state = start_of(policy=LATENT)
    found = [int(decides(trained, state, jnp.int32(r)).robots.target[r]) for r in range(3)]
    assert found == [0, 0, 2]


def gaining(models):
    """Models whose tables promise a gain by every look."""
    values = tuple(replace(v, one_step_unseen=jnp.float32(1.0)) for v in models.look_values)
    return replace(models, look_values=values)


def test_rules_for_teams_as_worked_by_hand(decides, models, start_of):
    # The first robot is .8 m from PoI 0, the second 1 m, and the third is far from all. Behind the
    # first is PoI 1, 1.4 m away.
    poses = [[0.0, 0.0, 0.0], [0.8, 1.0, -np.pi / 2], [1.3, -1.3, 0.0]]
    targets = {}
    for policy in ("nearest", "auction"):
        state = start_of(poses, POLICIES.index(policy))
        found = [decides(gaining(models), state, jnp.int32(r)) for r in range(3)]
        targets[policy] = [int(after.robots.target[r]) for r, after in enumerate(found)]
        assert all(after.robots.phase[r] == DRIVING for r, after in enumerate(found))
    assert targets["nearest"] == [0, 0, 0]
    # PoI 0 goes to the first robot. To PoI 1 the second has 1.8 m and a turn, the third 3.25 m; to
    # PoI 2 the third has 2.3 m.
    assert targets["auction"] == [0, 1, 2]
