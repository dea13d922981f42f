"""The program of the node for ROS 2, and a team of nodes, without ROS."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import export, sim


def run_node(ros2, monkeypatch, *argv):
    """Why the program ends where there is no ROS, and with what it makes a robot."""
    given = []
    monkeypatch.setattr(ros2, "load", lambda archive: (archive, "programs"))
    monkeypatch.setattr(ros2, "Robot", lambda *each: given.append(each))
    monkeypatch.setattr(ros2.sys, "argv", ["ros2_node.py", *argv])
    monkeypatch.setitem(ros2.sys.modules, "rclpy", None)
    with pytest.raises(SystemExit) as stop:
        ros2.main()
    return stop.value.code, given


def test_the_program_reads_its_command_before_it_needs_ros(ros2, monkeypatch):
    pois = ["--pois", "1.0,0.5", "-1.2,0.8", "-.3,-1.1"]
    ros = ["--ros-args", "-r", "scan:=/front/scan"]
    ended, given = run_node(ros2, monkeypatch, "robot.zip", "--robot", "-1", *pois, *ros)
    assert ended == "needs ROS 2: source /opt/ros/.../setup.bash"
    ((archive, _, robot, positions),) = given
    assert (archive, robot) == (Path("robot.zip"), -1)
    np.testing.assert_array_equal(positions, [[1.0, 0.5], [-1.2, 0.8], [-0.3, -1.1]])


@pytest.mark.parametrize("poi", ["1.0", "1,2,3", "1;2", "-1"])
def test_the_program_refuses_what_is_no_place(ros2, monkeypatch, capsys, poi):
    assert run_node(ros2, monkeypatch, "robot.zip", "--pois", poi, "0,1") == (2, [])
    assert f"argument --pois: ' {poi}': must be two numbers X,Y" in capsys.readouterr().err.replace(
        f"'{poi}'", f"' {poi}'"
    )


def test_the_program_refuses_what_is_no_archive(ros2, monkeypatch, capsys, tmp_path):
    text = tmp_path / "text.zip"
    text.write_text("no archive")
    not_there = "cannot be read (no such file)"
    for file, words in ((text, "must be a file of `jaxsense export`"), ("x.zip", not_there)):
        monkeypatch.setattr(ros2.sys, "argv", ["ros2_node.py", str(file), "--pois", "0,1"])
        with pytest.raises(SystemExit):
            ros2.main()
        assert f"{file}: {words}" in capsys.readouterr().err


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
            sim.sensors.scan(
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
        said = robot.programs["classify"](mean=robot.known["mean"], std=robot.known["std"])
        assert said["most_likely"].tolist() == classes
    assert 6 >= number >= 4
