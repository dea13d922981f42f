"""Inputs that exported programs refuse."""

import inspect
import re
import zipfile

import numpy as np
import pytest
from exporting import CONFIG

from jaxsense.interfaces import robot_numpy, robot_onnx
from jaxsense.sim import sensors


@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_what_is_no_archive_is_named(player, tmp_path):
    text, other = tmp_path / "text.zip", tmp_path / "other.zip"
    text.write_text("robot")
    with zipfile.ZipFile(other, "w") as files:
        files.writestr("readme.txt", "robot")
    for path in (text, other):
        expected = re.escape(f"{path}: must be a file of `jaxsense export` (")
        with pytest.raises(ValueError, match=expected):
            player.load(path)


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
    for name in ("checked", "_array", "_text"):
        assert len({inspect.getsource(getattr(x, name)) for x in (robot_numpy, robot_onnx)}) == 1


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("lidar", r"robot = 'lidar': must be int32 of shape \(\) \(index of the robot's own"),
        (1.5, r"robot = 1.5: must be int32 of shape \(\)"),
        (np.nan, r"robot = nan: must be int32"),
        (None, "robot = None: must be int32"),
        ([[0], [1, 2]], r"robot = \[\[0\], \[1, 2\]\]: must be int32"),
        (1j, r"robot = 1j: must be int32"),
        ([0, 1], r"robot has the shape \(2,\): must be \(\) \(index of the robot's own"),
    ],
)
def test_values_that_are_no_numbers_of_a_type_are_named(given, expected):
    inputs = {"robot": {"shape": [], "dtype": "int32", "about": "index of the robot's own"}}
    assert robot_numpy.checked("decide", inputs, (), {"robot": 1.0})["robot"] == 1
    with pytest.raises(ValueError, match=f"^decide: {expected}"):
        robot_numpy.checked("decide", inputs, (), {"robot": given})


def test_no_axis_may_be_empty():
    inputs = {"apart": {"shape": ["looks"], "dtype": "float32", "about": "from earlier looks"}}
    expected = r"apart has the shape \(0,\): must be \(looks,\) \(from earlier looks\)"
    with pytest.raises(ValueError, match=expected):
        robot_numpy.checked("weigh_lidar", inputs, (), {"apart": np.zeros(0)})
