"""Teams in which several robots carry the same sensor."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG, LATENT, NAIVE, POLICIES, alone, with_class_beliefs, with_values

import jaxsense
from jaxsense import mission
from jaxsense.core.types import Belief
from jaxsense.mission import act, decide
from jaxsense.mission.state import DRIVING, ENDED, FACING, FAILED, Faults
from jaxsense.summary import make

TEAM = replace(CONFIG, robots=("camera", "camera", "lidar"))
FIRST, SECOND, LIDAR = 0, 1, 2
# The PoIs are 0.8 m from the first, the second and the third robot, of which each faces its own.
POSITIONS = [[0.8, 0.0], [-1.0, 1.0], [-1.0, -1.0]]
POSES = [[0.0, 0.0, 0.0], [-0.2, 1.0, np.pi], [-0.2, -1.0, np.pi]]


@pytest.fixture(scope="module")
def many():
    return mission.make_mission(TEAM)


@pytest.fixture(scope="module")
def start_of(many, models):
    begin = jax.jit(lambda *given: mission.start(many, models, *given))

    def make(poses=POSES, policy=NAIVE, faults=None, classes=(2, 0, 1)):
        classes = jnp.array(classes)
        layout = jaxsense.sim.make_layout(TEAM.arena, jnp.array(POSITIONS), jnp.zeros(3), classes)
        light = jaxsense.sim.Light(jnp.array([0.6, 0.0, 0.8]), jnp.float32(0.5), jnp.float32(0.5))
        scene = jaxsense.sim.Scene(layout, light, jnp.array(poses, jnp.float32))
        faults = mission.no_faults(TEAM) if faults is None else faults
        return begin(scene, classes, jnp.int32(policy), faults)

    return make


@pytest.fixture(scope="module")
def scan(many, models):
    """A scan of any robot: one program for all of them, as in a mission."""
    return jax.jit(
        lambda key, state, robot: alone(
            lambda key, state: act.scan(key, many, models, state, robot)
        )(key, state)
    )


def facing(state, set_robot, robot, target):
    return set_robot(state, robot, phase=FACING, target=target, progress_at=-100.0)


def test_robots_with_the_same_sensor_write_as_one_modality(scan, start_of, set_robot):
    state = start_of()
    for robot in (FIRST, SECOND, LIDAR):
        state = facing(state, set_robot, robot, robot)
        state = scan(jax.random.key(robot), state, jnp.int32(robot))
    np.testing.assert_array_equal(state.times_seen, [[1, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(state.robots.looks, [1, 1, 1])
    np.testing.assert_array_equal(state.robots.detections, [1, 1, 1])
    assert state.version == 3


def test_a_second_camera_adds_to_what_the_first_has_seen(scan, start_of, set_robot):
    # Both look at PoI 0, from two sides.
    state = start_of([POSES[0], [0.8, -0.8, np.pi / 2], POSES[2]])
    for robot in (FIRST, SECOND):
        state = facing(state, set_robot, robot, 0)
        state = scan(jax.random.key(robot), state, jnp.int32(robot))
    np.testing.assert_array_equal(state.times_seen, [[2, 0], [0, 0], [0, 0]])


def exchanged(state, robots):
    """The same mission with two robots in each other's place."""
    order = jnp.arange(3).at[jnp.array(robots)].set(jnp.array(robots[::-1]))
    turn = lambda tree: jax.tree.map(lambda x: x[order], tree)  # noqa: E731
    return replace(
        state,
        scene=replace(state.scene, poses=turn(state.scene.poses)),
        robots=turn(state.robots),
        faults=turn(state.faults),
    )


@pytest.mark.parametrize("target", [0, 1, 2])
def test_robots_that_exchange_places_see_what_the_other_saw(scan, start_of, set_robot, target):
    # Each PoI .8 m ahead of the robot under test, with the other camera in view beside it.
    pose, ahead = np.array(POSES[target]), -1.0 if target else 1.0
    poses = [pose, np.add(pose, (0.5 * ahead, 0.3, 0.3)), [1.2, -1.2, 0.0]]
    state = facing(start_of(poses), set_robot, FIRST, target)
    here = scan(jax.random.key(5), state, jnp.int32(FIRST))
    there = scan(jax.random.key(5), exchanged(state, [0, 1]), jnp.int32(SECOND))
    assert here.robots.detections[FIRST] == 1
    assert np.any(here.belief.mean != state.belief.mean)
    close = lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5)  # noqa: E731
    jax.tree.map(close, exchanged(here, [0, 1]).belief, there.belief)
    jax.tree.map(close, here.log_posterior, there.log_posterior)
    jax.tree.map(close, exchanged(here, [0, 1]).robots, there.robots)
    np.testing.assert_array_equal(here.times_seen, there.times_seen)
    # Nobody has moved for it.
    np.testing.assert_array_equal(there.scene.poses, exchanged(state, [0, 1]).scene.poses)


def test_a_robot_in_the_view_hides_the_poi_also_from_the_second_camera(scan, start_of, set_robot):
    for hiding in (FIRST, LIDAR):
        poses = [[1.2, 1.2, 0.0], [0.0, 0.0, 0.0], [1.2, -1.2, 0.0]]
        poses[hiding] = [0.4, 0.0, 0.0]
        state = facing(start_of(poses), set_robot, SECOND, 0)
        after = scan(jax.random.key(0), state, jnp.int32(SECOND))
        assert (after.robots.looks[SECOND], after.robots.detections[SECOND]) == (1, 0)
        away = replace(state.scene, poses=state.scene.poses.at[hiding, :2].set(-1.3))
        after = scan(jax.random.key(0), replace(state, scene=away), jnp.int32(SECOND))
        assert after.robots.detections[SECOND] == 1


def test_only_the_robot_whose_sensor_is_blind_sees_nothing(scan, start_of, set_robot):
    never = jnp.full(3, jnp.inf)
    blind = Faults(never, never.at[SECOND].set(0.0))
    for robot, detections in ((FIRST, 1), (SECOND, 0), (LIDAR, 1)):
        state = facing(start_of(faults=blind), set_robot, robot, robot)
        after = scan(jax.random.key(0), state, jnp.int32(robot))
        assert (after.robots.looks[robot], after.robots.detections[robot]) == (1, detections)


@pytest.fixture(scope="module")
def decides(many):
    return jax.jit(lambda models, state, robot: decide.decide(
        jax.random.key(0), many, models, state, robot
    ))  # fmt: skip


def test_each_robot_asks_the_network_of_its_own_sensor(decides, models, start_of):
    trained = with_values(models, [1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.5])
    state = start_of(policy=LATENT)
    found = [int(decides(trained, state, jnp.int32(r)).robots.target[r]) for r in range(3)]
    assert found == [0, 0, 2]


@pytest.mark.parametrize("policy", ["nearest", "auction", "rollout"])
def test_rules_for_teams_end_where_nothing_is_to_be_learned(decides, models, start_of, policy):
    # The tables of untrained models promise no gain.
    state = start_of(policy=POLICIES.index(policy))
    assert decides(models, state, jnp.int32(SECOND)).robots.phase[SECOND] == ENDED


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


@pytest.mark.parametrize("policy", ["nearest", "auction", "rollout"])
def test_each_robot_expects_what_its_own_sensor_gains(decides, models, start_of, policy):
    # Looks of the LiDAR pay, those of cameras do not.
    gains = models.look_values[0], gaining(models).look_values[1]
    trained, state = replace(models, look_values=gains), start_of(policy=POLICIES.index(policy))
    after = [decides(trained, state, jnp.int32(r)).robots for r in range(3)]
    assert [int(robots.phase[r]) for r, robots in enumerate(after)] == [ENDED, ENDED, DRIVING]
    assert after[LIDAR].target[LIDAR] == 2


def test_who_has_ended_or_failed_does_not_bid(decides, models, start_of, set_robot):
    poses = [[0.0, 0.0, 0.0], [0.8, 1.0, -np.pi / 2], [1.3, -1.3, 0.0]]
    for phase in (ENDED, FAILED):
        state = set_robot(start_of(poses, POLICIES.index("auction")), FIRST, phase=phase, target=3)
        assert decides(gaining(models), state, jnp.int32(SECOND)).robots.target[SECOND] == 0


def test_cases_are_named_after_each_robot():
    cases = mission.cases(TEAM)
    robots = ("camera_1", "camera_2", "lidar")
    faults = [f"{robot}_{fault}" for robot in robots for fault in ("alone", "stops", "blind")]
    assert list(cases) == [*POLICIES, *faults]
    np.testing.assert_array_equal(cases["camera_2_alone"].faults.stops_at, [0, np.inf, 0])
    np.testing.assert_array_equal(cases["camera_1_blind"].faults.blind_at, [6, np.inf, np.inf])


def test_what_is_measured_of_three_robots(many, models, start_of):
    state = start_of()
    robots = replace(
        state.robots,
        phase=jnp.full(3, ENDED),
        looks=jnp.array([3, 2, 1]),
        detections=jnp.array([3, 1, 0]),
    )
    means = jnp.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])

    @jax.jit
    def measure(classes, state):
        return mission.measure(many, with_class_beliefs(models, classes), state)

    ended = replace(state, robots=robots, done=jnp.bool_(True))
    found = measure(Belief(means, jnp.full((3, 2), 0.3)), ended)
    np.testing.assert_array_equal(found["detections"], [3, 1, 0])
    assert found["observations_per_poi"] == 2
    assert set(found["told"]) == {"camera", "lidar"}
    # Four scans of 640 pixels of 3 bytes, and none of 683 beams of 4; then one more of these.
    assert make.traffic(many, np.array([3, 1, 0]))["raw"] == 1920
    raw = make.traffic(many, np.array([3, 0, 1]))["raw"]
    assert raw == pytest.approx((3 * 1920 + 2732) / 4)


def test_a_robot_alone_is_measured_by_the_labels_of_its_sensor():
    found = {
        "classes": np.array([[0, 1, 2]]),
        "is_right": np.ones((1, 3), bool),
        "ambiguous": np.array([[False, True, False]]),
        **{name: np.ones((1, 3)) for name in ("confidence", "nll")},
        "seen": np.ones((1, 3), bool),
        "told": {"camera": np.array([0.25]), "lidar": np.array([0.75])},
        **{name: np.ones(1) for name in (
            "observations_per_poi", "time_s", "collisions", "goals", "goals_reached", "information",
            "reason",
        )},
    }  # fmt: skip
    block = make.case(TEAM, "camera_2_alone", found)
    # The camera cannot tell the red ones apart, classes 1 and 2.
    assert (block["told"], block["ambiguous_reported"]) == (0.25, 0.5)
    block = make.case(TEAM, "lidar_alone", found)
    assert (block["told"], block["ambiguous_reported"]) == (0.75, 0.5)


@pytest.mark.slow  # traces two missions
def test_the_program_of_a_mission_does_not_grow_with_its_robots(models):
    def lines(pairs):
        scenario = mission.make_mission(replace(CONFIG, robots=("camera", "lidar") * pairs))
        play = jax.jit(lambda key, state: mission.rollout(key, scenario, models, state, 4))
        key = jax.random.key(0)
        state = jax.eval_shape(lambda key: mission.reset(key, scenario, models, NAIVE), key)
        return str(play.trace(key, state).jaxpr).count("\n")

    assert lines(4) <= 1.3 * lines(1)


@pytest.mark.slow  # compiles a mission of three robots
def test_a_team_of_three_visits_every_poi_with_both_sensors(many, models):
    # Naive exploration counts what robots with the same sensor have seen.
    roll = jax.jit(lambda key, state: mission.rollout(key, many, models, state, 400))
    state = jax.jit(lambda key: mission.reset(key, many, models, NAIVE))(jax.random.key(2))
    end, record = roll(jax.random.key(3), state)
    assert mission.REASONS[mission.reason(end)] == "finished"
    assert np.all(end.seen)
    assert end.contacts == 0
    np.testing.assert_array_equal(end.times_seen.sum(axis=0)[1], 3)
    np.testing.assert_array_equal(record.detected.sum(axis=0), end.robots.detections)
    assert np.all(record.phase[-1] == ENDED)
