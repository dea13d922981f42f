"""Files and inputs that a robot refuses."""

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

from jaxsense.interfaces import robot


def packed(path, kind=zipfile.ZIP_DEFLATED, **files):
    with zipfile.ZipFile(path, "w", kind) as packed:
        for name, content in files.items():
            packed.writestr(name.replace("__", "."), content)


ONE = {"programs": {"weigh": {"inputs": {}, "outputs": {}}}}


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({"readme__txt": "robot"}, "KeyError('contents.json')"),
        ({"contents__json": "[" * 100_000}, "RecursionError"),
        ({"contents__json": b"\xff"}, "UnicodeDecodeError"),
        ({"contents__json": "[]"}, "TypeError"),
        ({"contents__json": json.dumps({"programs": ["weigh"]}), "weigh__onnx": ""}, "AttributeE"),
        ({"contents__json": json.dumps(ONE)}, "KeyError('weigh.onnx')"),
        ({"contents__json": json.dumps(ONE), "weigh__onnx": b"\x1b[2J"}, "InvalidProtobuf"),
        ({"big": bytes(robot.MOST_BYTES + 1)}, "134217729 bytes when unpacked: must be at most"),
    ],
)
def test_what_is_no_archive_is_one_line(tmp_path, files, reason):
    packed(path := tmp_path / "robot.zip", **files)
    with pytest.raises(ValueError, match=re.escape(reason)) as raised:
        robot.load(path)
    assert str(raised.value).startswith(f"{path}: must be a file of `jaxsense export` (")
    assert str(raised.value).isprintable()


def test_no_more_is_unpacked_than_an_archive_says(tmp_path):
    about, zeros = {"contents__json": json.dumps(ONE)}, bytes(2**26)
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
    content, path = file.read_bytes(), tmp_path / "robot.zip"
    rng = np.random.default_rng(0)
    for number in range(12):
        changed = bytearray(content)
        changed[rng.integers(len(content))] ^= 1 << rng.integers(8)
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


INPUTS = {
    "poses": {"shape": ["robots", 3], "dtype": "float32", "about": "of the robots"},
    "works": {"shape": ["robots"], "dtype": "bool", "about": "which are at work"},
    "robot": {"shape": [], "dtype": "int32", "about": "index of the robot's own"},
}
GIVEN = {"poses": np.zeros((4, 3)), "works": np.ones(4, bool), "robot": 1}


def test_inputs_become_arrays_of_their_types():
    for number in (1, 4):
        given = {"poses": np.zeros((number, 3)), "works": [True] * number, "robot": np.int64(1)}
        found = robot.checked("decide", INPUTS, given)
        assert {key: x.dtype.name for key, x in found.items()} == {
            key: about["dtype"] for key, about in INPUTS.items()
        }


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"poses": np.zeros(4)},
            r"poses has the shape \(4,\): must be float32",
        ),
        ({"poses": np.zeros((0, 3))}, r"poses has the shape \(0, 3\)"),
        ({"works": np.ones(3, bool)}, r"works has the shape \(3,\): .* \(which are at work\)"),
        ({"works": np.ones(4)}, "works = .*: must be bool"),
        ({"robot": "lidar"}, r"robot = 'lidar': must be int32 .* \(index of the robot's own"),
        ({"robot": 1.5}, r"robot = 1.5: must be int32"),
        ({"robot": None}, "robot = None: must be int32"),
        ({"robot": [[0], [1, 2]]}, r"robot = \[\[0\], \[1, 2\]\]: must be int32"),
        ({"robot": [0, 1]}, r"robot has the shape \(2,\)"),
        ({"more": 1}, "^decide needs poses, works, robot: not poses, works, robot, more$"),
    ],
)
def test_other_inputs_are_named(change, expected):
    with pytest.raises((TypeError, ValueError), match=expected):
        robot.checked("decide", INPUTS, {**GIVEN, **change})
