"""Inputs that exported programs refuse."""

import inspect

import numpy as np
import pytest
from exporting import CONFIG

from jaxsense.interfaces import robot_numpy, robot_onnx
from jaxsense.sim import sensors


@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_inputs_of_other_names_or_shapes_are_refused(file, player):
    _, programs = player.load(file)
    look = {"bearing": 0.0, "distance": 0.9}
    rays = len(sensors.make(CONFIG)[1].angles)
    other_scan = rf"detect_lidar: readings has the shape \({rays + 37},\): must be \({rays},\) .*; "
    with pytest.raises(ValueError, match=f"{other_scan}resample other scans first"):
        programs["detect_lidar"](readings=np.ones(rays + 37), **look)
    with pytest.raises(ValueError, match=r"bearing has the shape \(1,\): must be \(\) \(of the "):
        programs["detect_lidar"](readings=np.ones(rays), bearing=[0.0], distance=0.9)
    needs = "^detect_lidar needs readings, bearing, distance"
    with pytest.raises(TypeError, match=f"{needs}; scan is none of them; readings is missing$"):
        programs["detect_lidar"](scan=np.ones(rays), **look)
    with pytest.raises(TypeError, match=f"{needs}; more is none of them$"):
        programs["detect_lidar"](readings=np.ones(rays), more=1, **look)
    with pytest.raises(TypeError, match=f"{needs}, by name$"):
        programs["detect_lidar"](np.ones(rays), 0.0, 0.9)


@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_axes_of_one_name_have_one_size(player):
    inputs = {
        "poses": {"shape": ["robots", 3], "dtype": "float32", "about": "of the robots"},
        "works": {"shape": ["robots"], "dtype": "bool", "about": "which are at work"},
    }
    for number in (1, 4):
        given = {"poses": np.zeros((number, 3)), "works": np.ones(number)}
        found = player.checked("decide", inputs, (), given)
        assert found["works"].dtype == bool
    with pytest.raises(ValueError, match=r"poses has the shape \(4,\): must be \(robots, 3\)"):
        player.checked("decide", inputs, (), {"poses": np.zeros(4), "works": np.ones(4)})
    with pytest.raises(ValueError, match=r"works has the shape \(3,\): must be \(4,\) \(which are"):
        player.checked("decide", inputs, (), {"poses": np.zeros((4, 3)), "works": np.ones(3)})


def test_both_players_check_alike():
    # Each file is copied to robots alone.
    assert inspect.getsource(robot_numpy.checked) == inspect.getsource(robot_onnx.checked)
