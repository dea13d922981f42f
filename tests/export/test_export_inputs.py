"""Inputs that exported programs refuse."""

import contextlib
import json
import os
import re
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from exporting import CONFIG

from jaxsense.interfaces import robot
from jaxsense.sim import sensors


def packed(path, kind=zipfile.ZIP_DEFLATED, **files):
    with zipfile.ZipFile(path, "w", kind) as packed:
        for name, content in files.items():
            packed.writestr(name.replace("__", "."), content)


ONE = {"programs": {"weigh": {"inputs": {}, "outputs": {}}}}


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({"readme__txt": "robot"}, "no item named 'contents.json'"),
        ({"contents__json": "[" * 100_000}, "RecursionError"),
        ({"contents__json": b"\xff"}, "UnicodeDecodeError"),
        ({"contents__json": "[]"}, "TypeError"),
        ({"contents__json": "{}"}, "KeyError('programs')"),
        ({"contents__json": json.dumps({"programs": ["weigh"]}), "weigh__onnx": ""}, "AttributeE"),
        ({"contents__json": json.dumps(ONE)}, "no item named 'weigh.onnx'"),
        ({"contents__json": json.dumps(ONE), "weigh__onnx": b"\x1b[2J"}, "InvalidProtobuf"),
        (
            {"contents__json": " " * (robot.MOST_TEXT + 1)},
            "4194305 in contents.json: must be at most",
        ),
        (
            {"contents__json": "{}", "big": bytes(robot.MOST_BYTES)},
            "134217730 bytes when unpacked, 2 in contents.json",
        ),
    ],
)
def test_what_is_no_archive_is_one_line(tmp_path, files, reason):
    packed(path := tmp_path / "robot.zip", **files)
    with pytest.raises(ValueError, match=re.escape(reason)) as raised:
        robot.load(path)
    assert str(raised.value).startswith(f"{path}: must be a file of `jaxsense export` (")
    assert str(raised.value).isprintable()


def test_no_more_is_unpacked_than_an_archive_says(tmp_path):
    about, zeros = {"contents__json": json.dumps(ONE)}, bytes(2**28)
    packed(path := tmp_path / "deflated.zip", **about, weigh__onnx=zeros)
    content = bytearray(path.read_bytes())
    # The size in the last entry of the table of contents.
    struct.pack_into("<I", content, content.rindex(b"PK\1\2") + 24, 100)
    path.write_bytes(content)
    packed(other := tmp_path / "bzip2.zip", zipfile.ZIP_BZIP2, **about, weigh__onnx=zeros[: 2**20])
    del zeros
    tracemalloc.start()
    for each, reason in ((path, "Bad CRC-32"), (other, "packed in another way than by zlib")):
        with pytest.raises(ValueError, match=reason):
            robot.load(each)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24


def test_a_damaged_archive_is_one_line(file, tmp_path):
    content = file.read_bytes()
    rng = np.random.default_rng(0)
    for number in range(40):
        changed = bytearray(content)
        changed[rng.integers(len(content))] ^= 1 << rng.integers(8)
        path = tmp_path / "robot.zip"
        path.write_bytes(changed[: rng.integers(len(content))] if number % 4 == 0 else changed)
        # A bit that nobody reads, for example of a time stamp, changes nothing.
        with contextlib.suppress(ValueError):
            robot.load(path)


@pytest.mark.parametrize("kind", ["nothing", "folder", "pipe"])
def test_what_is_no_file_is_named(tmp_path, kind):
    path = tmp_path / kind
    {"nothing": lambda x: x, "folder": Path.mkdir, "pipe": os.mkfifo}[kind](path)
    with pytest.raises(ValueError, match=r"cannot be read \(no such file\)$"):
        robot.load(path)


@pytest.mark.parametrize(
    ("key", "value"), [("shape", []), ("dtype", "float32"), ("dtype", "int8"), ("shape", ["pois"])]
)
def test_contents_that_describe_other_programs_are_refused(file, tmp_path, key, value):
    with zipfile.ZipFile(file) as files:
        content = {name: files.read(name) for name in files.namelist()}
    contents = json.loads(content["contents.json"])
    contents["programs"]["decide"]["inputs"]["works"][key] = value
    content["contents.json"] = json.dumps(contents)
    packed(path := tmp_path / "robot.zip", **content)
    with pytest.raises(ValueError, match=r"decide\.onnx has other inputs than contents.json"):
        robot.load(path)


def test_inputs_of_other_names_or_shapes_are_refused(file):
    _, programs = robot.load(file)
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


def test_axes_of_one_name_have_one_size():
    inputs = {
        "poses": {"shape": ["robots", 3], "dtype": "float32", "about": "of the robots"},
        "works": {"shape": ["robots"], "dtype": "bool", "about": "which are at work"},
    }
    for number in (1, 4):
        given = {"poses": np.zeros((number, 3)), "works": np.ones(number)}
        found = robot.checked("decide", inputs, (), given)
        assert found["works"].dtype == bool
    with pytest.raises(ValueError, match=r"poses has the shape \(4,\): must be \(robots, 3\)"):
        robot.checked("decide", inputs, (), {"poses": np.zeros(4), "works": np.ones(4)})
    with pytest.raises(ValueError, match=r"works has the shape \(3,\): must be \(4,\) \(which are"):
        robot.checked("decide", inputs, (), {"poses": np.zeros((4, 3)), "works": np.ones(3)})


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
    assert robot.checked("decide", inputs, (), {"robot": 1.0})["robot"] == 1
    with pytest.raises(ValueError, match=f"^decide: {expected}"):
        robot.checked("decide", inputs, (), {"robot": given})


def test_no_axis_may_be_empty():
    inputs = {"apart": {"shape": ["looks"], "dtype": "float32", "about": "from earlier looks"}}
    expected = r"apart has the shape \(0,\): must be \(looks,\) \(from earlier looks\)"
    with pytest.raises(ValueError, match=expected):
        robot.checked("weigh_lidar", inputs, (), {"apart": np.zeros(0)})
