"""Scanning: what is seen is written, what is not is not, and a robot does not try for ever."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG

from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core.novelty import Novelty
from jaxsense.mission import act
from jaxsense.mission.state import (
    ATTEMPTS,
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    IDLE,
    RECENT_LOOKS,
    Faults,
    Robot,
)

CAMERA, LIDAR = 0, 1
IN_THE_VIEW = [0.4, 0.0, 0.0]
BLIND = Faults(np.full(2, np.inf, np.float32), np.zeros(2, np.float32))


def sure(models, robot, confidence):
    """Models whose detector returns one probability of its first label, whatever it sees."""
    # All weights are zero: of two labels one has the probability 1 / (1 + exp(-logit)).
    logit = np.log(confidence / (1 - confidence))
    seeing = models.detectors[robot]
    params = jax.tree.map(np.zeros_like, seeing.detector.params)
    layers = params["params"]
    layers[max(layers, key=lambda name: int(name.split("_")[1]))]["bias"][0] = logit
    detectors = list(models.detectors)
    detectors[robot] = replace(seeing, detector=replace(seeing.detector, params=params))
    return replace(models, detectors=tuple(detectors))


@pytest.mark.parametrize(
    ("robot", "expected"),
    [
        # .8 for red and .2 for green, of one green class before two red ones, which were of the
        # odds 2 to 1 to 1: 2 x .2 / (1/3) to .8 / (2/3) to .8 / (2/3) = 1.2 to 1.2 to 1.2.
        (CAMERA, [1 / 3, 1 / 3, 1 / 3]),
        # .8 for a cylinder, of two classes before one cube: 2 x 1.2 to 1.2 to .6.
        (LIDAR, [4 / 7, 2 / 7, 1 / 7]),
    ],
)
def test_a_detection_is_written_into_the_map_and_counted(scan, models, facing, robot, expected):
    before = facing(robot)
    counts = before.times_seen.at[0, robot].set(4).at[1].set(2)
    posterior = before.log_posterior.at[0].set(jnp.log(jnp.array([0.5, 0.25, 0.25])))
    before = replace(before, times_seen=counts, log_posterior=posterior)
    after = scan(jax.random.key(0), before, robot, sure(models, robot, 0.8))
    np.testing.assert_allclose(np.exp(after.log_posterior[0]), expected, rtol=1e-5)
    np.testing.assert_array_equal(after.log_posterior[1:], posterior[1:])
    np.testing.assert_array_equal(after.times_seen, counts.at[0, robot].set(5))
    assert (after.robots.looks[robot], after.robots.detections[robot]) == (1, 1)
    assert after.robots.phase[robot] == IDLE
    assert after.robots.target[robot] == CONFIG.arena.num_pois
    assert not np.array_equal(after.belief.mean[0], before.belief.mean[0])
    np.testing.assert_array_equal(after.belief.mean[1:], before.belief.mean[1:])


@pytest.mark.parametrize("robot", [CAMERA, LIDAR])
def test_a_look_from_near_an_earlier_one_counts_in_part(scan, models, facing, robot):
    trained = sure(models, robot, 0.8)
    half = Novelty(
        strength=np.full(2, np.sqrt(2.0) - 1, np.float32), length=np.full(2, 0.1, np.float32)
    )
    before = facing(robot)
    whole = scan(jax.random.key(0), before, robot, trained)
    np.testing.assert_allclose(whole.looked_from[0, robot, 0], [0.0, 0.0], atol=1e-6)
    assert np.all(
        np.isinf(np.delete(whole.looked_from.reshape(-1, 2), RECENT_LOOKS * robot, axis=0))
    )
    # Another look from the same place adds half of what the first one has said.
    again = replace(before, looked_from=whole.looked_from, times_seen=whole.times_seen)
    after = scan(jax.random.key(0), again, robot, replace(trained, novelty=half))
    said = whole.log_posterior[0] - before.log_posterior[0]
    expected = jax.nn.log_softmax(before.log_posterior[0] + said / 2)
    np.testing.assert_allclose(after.log_posterior[0], expected, atol=1e-5)
    # Where all places are taken, the next look takes that of the first.
    last = replace(again, times_seen=again.times_seen.at[0, robot].set(RECENT_LOOKS))
    moved = replace(last, looked_from=last.looked_from.at[0, robot].set(7.0))
    after = scan(jax.random.key(0), moved, robot, trained)
    np.testing.assert_allclose(after.looked_from[0, robot, 0], [0.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(after.looked_from[0, robot, 1:], 7.0)


@pytest.mark.parametrize(
    ("robot", "setting"),
    [
        (CAMERA, {"other": IN_THE_VIEW}),
        (CAMERA, {"other": [0.4, 0.03, 0.0]}),  # in a part of the view
        (CAMERA, {"faults": BLIND}),
        (LIDAR, {"faults": BLIND}),
    ],
)
def test_what_is_hidden_or_not_seen_gives_no_detection(scan, facing, robot, setting):
    before = facing(robot, **setting)
    after = scan(jax.random.key(0), before, robot)
    assert (after.robots.looks[robot], after.robots.detections[robot]) == (1, 0)
    assert not np.any(after.seen)
    np.testing.assert_array_equal(after.times_seen, before.times_seen)
    np.testing.assert_array_equal(after.log_posterior, before.log_posterior)
    jax.tree.map(np.testing.assert_array_equal, after.belief, before.belief)
    assert after.robots.attempts[robot] == 1
    assert after.robots.target[robot] == 0


@pytest.mark.parametrize("robot", [CAMERA, LIDAR])
def test_an_unsure_detector_writes_nothing(scan, models, facing, robot):
    strict = replace(CONFIG, mission=replace(CONFIG.mission, least_confidence=0.6))
    for confidence, detections in ((0.59, 0), (0.61, 1)):
        after = scan(
            jax.random.key(0), facing(robot), robot, sure(models, robot, confidence), strict
        )
        assert (after.robots.looks[robot], after.robots.detections[robot]) == (1, detections)


@pytest.mark.parametrize(
    ("pose", "turning", "scans"),
    [
        ((0.0, 0.0, np.radians(5.0)), 0.0, True),
        ((0.0, 0.0, np.radians(7.0)), 0.0, False),  # more than 6 degrees off
        ((0.0, 0.0, 0.0), 0.3, True),
        ((0.0, 0.0, 0.0), 0.4, False),  # rad/s
    ],
)
def test_only_a_robot_that_faces_the_poi_and_is_calm_scans(
    scan, facing, set_robot, pose, turning, scans
):
    state = facing(CAMERA, pose)
    state = set_robot(state, CAMERA, command=jnp.array([0.0, turning]), progress_at=0.0)
    after = scan(jax.random.key(0), state, CAMERA)
    assert after.robots.looks[CAMERA] == scans


def test_a_robot_turns_to_either_side_of_its_target(team, facing):
    bearing = lambda key, state: act._looks_at(key, Robot(team, state, CAMERA))  # noqa: E731
    keys = jax.random.split(jax.random.key(0), 100)
    shares = jax.jit(jax.vmap(bearing, (0, None)))(keys, facing(CAMERA)) / np.radians(
        CONFIG.viewpoint.bearing_error
    )
    assert -1 <= shares.min() < -0.9 < 0.9 < shares.max() <= 1


def test_after_some_failures_the_poi_is_given_up(scan, facing, set_robot):
    state = facing(CAMERA, other=IN_THE_VIEW)
    for attempt in range(1, ATTEMPTS + 1):
        assert not state.robots.undetected[CAMERA, 0]
        state = set_robot(state, CAMERA, phase=FACING, view=attempt)
        state = scan(jax.random.key(attempt), state, CAMERA)
        assert state.robots.attempts[CAMERA] == attempt
        # The viewpoints, and where it stands.
        excluded = np.flatnonzero(state.robots.excluded[CAMERA])
        views = state.robots.excluded.shape[1] - 1
        np.testing.assert_array_equal(excluded, [*range(1, attempt + 1), views])
    np.testing.assert_array_equal(state.robots.undetected[CAMERA], [True, False, False])


@pytest.fixture(scope="module")
def approach(team, models):
    return jax.jit(lambda state, robot: act.approach(team, models, state, robot)[0])


def driving(state, set_robot, view, seconds, progress_at, path_left=0.1):
    steps = round(seconds / CONTROL_PERIOD)
    state = replace(state, steps=jnp.int32(steps))
    values = {"phase": DRIVING, "target": 0, "view": view, "goals": 1}
    return set_robot(state, CAMERA, **values, progress_at=progress_at, path_left=path_left)


def test_a_robot_without_progress_backs_off_and_tries_another_viewpoint(
    approach, facing, set_robot
):
    # It wants to a viewpoint on the far side of the PoI.
    patience = act.STUCK_TIME
    start = facing(CAMERA, pose=(-1.3, 0.0, 0.0))  # too far to look
    still = approach(driving(start, set_robot, 0, patience - 0.05, 0.0), CAMERA)
    assert still.robots.phase[CAMERA] == DRIVING
    stuck = approach(driving(start, set_robot, 0, patience + 0.2, 0.0), CAMERA)
    assert stuck.robots.phase[CAMERA] == BACKING
    assert stuck.robots.attempts[CAMERA] == 1
    np.testing.assert_array_equal(np.flatnonzero(stuck.robots.excluded[CAMERA]), [0])
    assert (stuck.robots.goals[CAMERA], stuck.robots.reached[CAMERA]) == (1, 0)
    # A way that has become shorter is progress.
    goes_on = approach(driving(start, set_robot, 0, patience + 0.2, 0.0, path_left=9.0), CAMERA)
    assert goes_on.robots.phase[CAMERA] == DRIVING
    assert goes_on.robots.path_left[CAMERA] < 9.0
    assert goes_on.robots.progress_at[CAMERA] == goes_on.time
    # And after the time of recovery it asks again.
    for seconds, phase in ((act.RECOVERY_TIME - 0.05, BACKING), (act.RECOVERY_TIME + 0.05, IDLE)):
        later = replace(stuck, steps=stuck.steps + round(seconds / CONTROL_PERIOD))
        assert approach(later, CAMERA).robots.phase[CAMERA] == phase
    # The third failure is the last.
    last = approach(set_robot(driving(start, set_robot, 0, patience + 0.2, 0.0), 0, attempts=2), 0)
    np.testing.assert_array_equal(last.robots.unreachable, [[True, False, False], [False] * 3])


def test_a_robot_looks_on_the_way_but_after_a_failure_from_the_viewpoint(
    approach, facing, set_robot
):
    # It wants to the far side of the PoI, which it sees already.
    start = facing(CAMERA)
    on_the_way = driving(start, set_robot, 0, 0.1, 0.0)
    # Neither that another robot stands at the viewpoint nor that it took long is of importance.
    there = facing(CAMERA, other=[*start.roadmap.viewpoints[0, 0], 0.0])
    for state in (on_the_way, driving(there, set_robot, 0, act.STUCK_TIME + 0.2, 0.0)):
        own = jax.tree.map(lambda x: x[CAMERA], approach(state, CAMERA).robots)
        assert (own.phase, own.goals, own.reached, own.attempts) == (FACING, 1, 1, 0)
        assert own.progress_at == state.time
    # A look from where it stands is no goal.
    views = on_the_way.robots.excluded.shape[1] - 1
    stays = approach(set_robot(on_the_way, CAMERA, view=views), CAMERA).robots
    assert (stays.phase[CAMERA], stays.reached[CAMERA]) == (FACING, 0)
    failed = set_robot(on_the_way, CAMERA, attempts=1)
    assert approach(failed, CAMERA).robots.phase[CAMERA] == DRIVING


def test_a_viewpoint_on_which_a_robot_has_come_to_stand_is_left_without_blame(
    approach, facing, set_robot
):
    view = 8  # on the other side than the PoI is from the robot's start
    start = facing(CAMERA, pose=(-1.0, 0.0, 0.0))
    place = start.roadmap.viewpoints[0, view]
    taken = replace(start, scene=replace(start.scene, poses=start.scene.poses.at[1, :2].set(place)))
    state = approach(driving(taken, set_robot, view, 1.0, 0.9), CAMERA)
    assert state.robots.phase[CAMERA] == IDLE
    assert state.robots.goals[CAMERA] == 0
    assert state.robots.attempts[CAMERA] == 0
    assert state.robots.excluded[CAMERA, view]
    # One that drives past or backs off will be gone.
    for phase in (DRIVING, BACKING):
        passing = set_robot(driving(taken, set_robot, view, 1.0, 0.9), LIDAR, phase=phase)
        assert approach(passing, CAMERA).robots.phase[CAMERA] == DRIVING


def test_a_robot_that_has_ended_makes_room_for_one_that_is_stuck(team, models, facing, set_robot):
    @jax.jit
    def wanted(state):
        after, course = act.approach(team, models, state, LIDAR)
        return act.steer(team, after, LIDAR, course)

    state = facing(CAMERA, pose=(0.0, 0.0, 0.0), other=[0.3, 0.0, 0.0])
    state = set_robot(state, LIDAR, phase=ENDED, target=3)
    state = driving(state, set_robot, 0, 3.0, 0.0)
    assert np.any(wanted(state) != 0)
    for waits in (dict(phase=BACKING, progress_at=2.5, backs_off_until=9.0), dict(phase=FACING)):
        assert np.any(wanted(set_robot(state, CAMERA, **waits)) != 0)
    # But not if it has failed since.
    stops = replace(state, faults=Faults(jnp.array([jnp.inf, 2.9]), state.faults.blind_at))
    np.testing.assert_array_equal(wanted(stops), 0.0)
    # Nor for one that gets on, or that is far away.
    gets_on = set_robot(state, CAMERA, progress_at=2.5)
    np.testing.assert_array_equal(wanted(gets_on), 0.0)
    for place in ([-1.3, 0.0], [0.8, -0.8]):  # the second one is at 1.13 m
        far = state.scene.poses.at[LIDAR, :2].set(jnp.array(place))
        far = replace(state, scene=replace(state.scene, poses=far))
        np.testing.assert_array_equal(wanted(far), 0.0)
