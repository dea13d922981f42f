"""What robots do that are elsewhere than they believe."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG, POSES, POSITIONS, with_config

from jaxsense import mission
from jaxsense.config.mission import LocalisationConfig, Search
from jaxsense.mission import act, decide
from jaxsense.mission.rollout import drifted
from jaxsense.mission.state import DRIVING, FACING, Robot

CAMERA, LIDAR = 0, 1


@pytest.mark.parametrize("robot", [CAMERA, LIDAR])
@pytest.mark.parametrize(
    ("degrees", "error", "looks", "detections"),
    [
        (0.0, 3.0, 1, 1),
        (0.0, 10.0, 0, 0),  # the PoI seems to be to the right
        (-10.0, 10.0, 1, 0),  # it seems to be ahead, and a window is cut out where it is not
        (-10.0, 0.0, 0, 0),
    ],
)
def test_a_robot_scans_where_it_believes_the_poi_to_be(
    scan, facing, robot, degrees, error, looks, detections
):
    state = facing(robot, [0.0, 0.0, np.radians(degrees)], error=[0.0, 0.0, np.radians(error)])
    robots = scan(jax.random.key(0), state, robot).robots
    assert (robots.looks[robot], robots.detections[robot]) == (looks, detections)


def test_a_detector_is_given_the_distance_that_the_robot_believes(scan, facing):
    # The LiDAR's refuses what is 0.24 m nearer than expected.
    for error, detections in ((0.0, 1), (-0.1, 1), (-0.3, 0)):
        state = facing(LIDAR, error=[error, 0.0, 0.0])
        robots = scan(jax.random.key(0), state, LIDAR).robots
        assert (robots.looks[LIDAR], robots.detections[LIDAR]) == (1, detections)


def test_a_robot_that_searches_looks_from_farther_away(team, facing):
    # It is .35 m from the PoI, and looks from .3 m and farther.
    state = facing(CAMERA, [0.45, 0.0, 0.0])

    @jax.jit
    def sees(config, state):
        robot = Robot(with_config(team, config), state, CAMERA)
        return decide.views(robot, jnp.int32(0), state.roadmap.viewpoints[0])[1]

    for position, expected in ((0.0, True), (0.04, True), (0.06, False)):
        localised = LocalisationConfig(search=Search(position=position))
        config = replace(CONFIG, mission=replace(CONFIG.mission, localisation=localised))
        assert bool(sees(config, state)) is expected


def test_a_robot_arrives_where_it_believes_the_viewpoint_to_be(team, models, facing, set_robot):
    approach = jax.jit(lambda state: act.approach(team, models, state, CAMERA)[0])
    viewpoint = facing(CAMERA).roadmap.viewpoints[0, 0]
    there, short = [*viewpoint, 0.0], [viewpoint[0] + 0.25, viewpoint[1], 0.0]
    for pose, error, phase in (
        (there, 0.0, FACING),
        (there, 0.25, DRIVING),
        (short, 0.0, DRIVING),
        (short, -0.25, FACING),
    ):
        state = facing(CAMERA, pose, error=[error, 0.0, 0.0])
        state = set_robot(state, CAMERA, phase=DRIVING, view=0, path_left=0.5, progress_at=0.0)
        assert approach(state).robots.phase[CAMERA] == phase


def test_errors_are_of_the_robots_that_drive(team, arena_of):
    localised = LocalisationConfig(drift=(0.1, 5.0))
    config = replace(CONFIG, mission=replace(CONFIG.mission, localisation=localised))
    before = arena_of(POSITIONS, POSES)
    poses = before.scene.poses.at[1, 0].add(0.02)
    after = replace(before, scene=replace(before.scene, poses=poses))
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], (before, after))

    @jax.jit
    def error_of(config):
        key = jax.random.key(0)[None]
        return drifted(key, with_config(team, config), *batch).pose_error[0]

    error = error_of(config)
    np.testing.assert_array_equal(error[0], 0.0)
    assert np.all(error[1] != 0)
    without = error_of(CONFIG)
    np.testing.assert_array_equal(without, 0.0)


def test_a_mission_starts_with_constant_errors(team, models):
    localised = LocalisationConfig(error=(0.1, 5.0))

    @jax.jit
    def begin(keys, localisation):
        config = replace(CONFIG, mission=replace(CONFIG.mission, localisation=localisation))
        changed = with_config(team, config)
        states = jax.vmap(lambda key: mission.reset(key, changed, models))(keys)
        return states.scene.poses, states.pose_error, states.believed_poses, states.classes

    keys = jax.random.split(jax.random.key(0), 64)
    poses, errors, believed, classes = begin(keys, localised)
    np.testing.assert_allclose(errors.std(axis=(0, 1)), [0.1, 0.1, np.radians(5.0)], rtol=0.3)
    np.testing.assert_allclose(believed, poses + errors, atol=1e-6)
    assert set(np.ravel(classes)) == {0, 1, 2}
    # They change nothing else.
    same, none, *_ = begin(keys, LocalisationConfig())
    np.testing.assert_array_equal(same, poses)
    np.testing.assert_array_equal(none, 0.0)
