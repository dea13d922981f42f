"""Runs an exported run with onnxruntime: copy this file and the archive to a robot.

    from robot_onnx import load
    contents, programs = load("robot.zip")
    programs["decide"](mean=..., std=..., ...)  # {"action": ..., "values": ...}

`contents` describes the inputs and outputs of each program. In C++, load `NAME.onnx` from the
archive with `Ort::Session`, and give and take tensors of the same names, shapes and types.
"""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import onnxruntime

Arrays = dict[str, np.ndarray]
Program = Callable[..., Arrays]


def load(path: Path | str | BinaryIO) -> tuple[dict[str, Any], dict[str, Program]]:
    """Reads an archive.

    Args:
      path: the archive, or a file that is open.

    Returns:
      Its `contents.json`, and its programs by name: from arrays by name to arrays by name.
    """
    with zipfile.ZipFile(path) as files:
        contents = json.loads(files.read("contents.json"))
        models = {name: files.read(f"{name}.onnx") for name in contents["programs"]}
    described = contents["programs"]
    return contents, {name: _program(model, described[name]) for name, model in models.items()}


def _program(model: bytes, about: dict[str, Any]) -> Program:
    options = onnxruntime.SessionOptions()
    # The programs are small: more threads than one would wait for each other.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    outputs = [*about["outputs"]]

    def program(**given: Any) -> Arrays:
        inputs = {
            name: np.asarray(given[name], each["dtype"]) for name, each in about["inputs"].items()
        }
        found = session.run(outputs, inputs)
        return {name: np.asarray(x) for name, x in zip(outputs, found, strict=True)}

    return program
