"""What robots tell each other, what the node publishes and logs, and its program."""

import copy
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ros2_robot import CONTENTS, POSITIONS, arrive, see

import jaxsense
from jaxsense import export, sim


def test_robots_tell_each_other_their_looks(ros2, robot, stub):
    other = ros2.Robot(CONTENTS, stub.programs(), 0, POSITIONS)
    look = see(ros2, robot, goal := arrive(robot))
    robot.choose(1.0, goal)
    for hears in (other, robot):  # its own report changes nothing
        hears.hear(1.0, robot.report(look))
        np.testing.assert_allclose(hears.known["mean"][:, 0], [0.75, 0, 0])
        np.testing.assert_array_equal(hears.known["seen"][0], [False, True])
        assert np.isfinite(hears.known["looked_from"][0, 1]).all(axis=1).sum() == 1
    np.testing.assert_allclose(other.team["poses"][1], goal, atol=1e-6)
    assert other.team["target"].tolist() == [3, 0]
    assert robot.team["works"].tolist() == [False, True]
    # A robot that says nothing for five seconds has failed; one that never spoke is not there.
    for now, works in ((6.0, True), (6.1, False)):
        other.decide(now)
        assert other.team["works"].tolist() == [True, works]


LOOK = {"poi": 2, "features": [0.75, 0.25], "weight": 1.0, "place": [-1.1, 0.0]}
REPORT = {"robot": 0, "pose": [1, 1, 0], "target": 1, "works": True, "look": LOOK}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("", "JSONDecodeError"),
        ("[" * 100_000, "RecursionError"),
        ("[]", "TypeError"),
        ("{}", "KeyError('robot')"),
        ({"robot": 2}, "robot = 2: must be an integer from 0 to 1"),
        ({"robot": -1}, "robot = -1: must be"),
        ({"pose": [1, 1]}, "pose = [1, 1]: must be finite numbers of shape (3,)"),
        ({"pose": [1, 1, math.nan]}, "pose = [1, 1, nan]: must be finite"),
        ({"target": 4}, "target = 4: must be an integer from 0 to 3"),
        ({"works": "false"}, "works = 'false': must be true or false"),
        ({"look": {**LOOK, "poi": True}}, "poi = True: must be an integer from 0 to 2"),
        ({"look": {**LOOK, "place": [0]}}, "place = [0]: must be finite numbers"),
        ({"look": {**LOOK, "weight": None}}, "weight = None: must be finite"),
        ({"look": {**LOOK, "weight": 7}}, "weight = 7: must be from 0 to 1"),
        ({"look": {**LOOK, "features": [1, 0, 0]}}, "of shape (2,)"),
        ({"look": {**LOOK, "features": [2, -1]}}, "features = [2, -1]: must be from 0 to 1"),
    ],
)
def test_a_message_that_is_no_report_changes_nothing(robot, change, reason):
    report = change if isinstance(change, str) else json.dumps({**REPORT, **change})
    before = copy.deepcopy((robot.team, robot.known, robot.heard_at))
    with pytest.raises(ValueError, match=re.escape(reason)):
        robot.hear(1.0, report)
    jax.tree.map(np.testing.assert_array_equal, (robot.team, robot.known, robot.heard_at), before)


@pytest.mark.slow  # compiles scans in a simulated arena
def test_a_team_of_nodes_finds_out_what_stands_where(ros2, tmp_path):
    config, models = jaxsense.load_pretrained("default")
    archive = tmp_path / "robot.zip"
    archive.write_bytes(export.archive(config, models))
    world, classes = sim.make_world(config), [2, 0, 1]
    scene = sim.random_scene(jax.random.key(0), world, jnp.array(classes))
    positions = np.asarray(scene.layout.position)
    team = [ros2.Robot(*ros2.load(archive), robot, positions) for robot in range(2)]
    poses, number = np.array(scene.poses, float), 0

    @jax.jit
    def scans(key, poses):
        data = sim.place(world.arena, scene.layout, poses)
        return [
            sim.scan(
                key, sensor, world.arena, data, scene.layout, scene.light, i, sensor.directions
            )
            for i, sensor in enumerate(world.sensors)
        ]

    while not all(each.is_done for each in team) and number < 40:
        for i, robot in enumerate(team):
            robot.choose(number, poses[i])
            if robot.goal is None:
                continue
            poses[i] = robot.goal  # it arrives at once
            readings = np.asarray(scans(jax.random.key(number), jnp.float32(poses))[i])
            angles = world.sensors[i].angles
            if robot.name == "lidar":  # from left to right, as some drivers have it
                readings, angles = readings[::-1], angles[::-1]
            looks = [
                robot.see(stamp, ros2.Scan(stamp, poses[i].copy(), angles, readings))
                for stamp in (number, number + 0.1)
            ]
            for other in team:
                other.hear(number, robot.report(looks[1]))
            number += 1
    for robot in team:
        assert robot.is_done
        assert robot.classes("probabilities").argmax(axis=1).tolist() == classes
    assert 6 >= number >= 4
