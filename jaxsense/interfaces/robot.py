"""Runs an exported run with onnxruntime: copy this file and the archive to a robot.

    from robot import load
    contents, programs = load("robot.zip")
    programs["decide"](mean=..., std=..., ...)  # {"action": ..., "values": ...}

`contents` describes the inputs and outputs of each program. An archive holds data alone. In C++,
load `NAME.onnx` from it with `Ort::Session`, and give and take tensors of the same names, shapes
and types.
"""

import json
import reprlib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike

MOST_BYTES = 2**27
"""Of an unpacked archive: those of presets hold 1 % of them."""

Program = Callable[..., dict[str, np.ndarray]]


def load(path: Path | str | BinaryIO) -> tuple[dict[str, Any], dict[str, Program]]:
    """The `contents.json` of an archive, and its programs by name: named arrays to named arrays.

    Raises:
      ValueError: if it cannot be read, is no archive, is damaged or is too large.
    """
    try:
        if isinstance(path, str | Path) and not Path(path).is_file():
            raise FileNotFoundError("no such file")
        content = _unpacked(path)
        contents = json.loads(content["contents.json"])
        return contents, {
            name: _program(name, content[f"{name}.onnx"], about)
            for name, about in contents["programs"].items()
        }
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # zipfile, zlib, json and onnxruntime have no base class in common
        must_be = "must be a file of `jaxsense export`"
        raise ValueError(f"{path}: {must_be} ({error!r:.300})") from error


def _unpacked(path: Path | str | BinaryIO) -> dict[str, bytes]:
    """All files of an archive."""
    with zipfile.ZipFile(path) as files:
        every = files.infolist()
        if (size := sum(each.file_size for each in every)) > MOST_BYTES:
            raise ValueError(f"{size} bytes when unpacked: must be at most {MOST_BYTES}")
        # zipfile bounds what it unpacks of no other kind, and of this one by the number alone.
        if not {each.compress_type for each in every} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise ValueError("packed in another way than by zlib")
        return {each.filename: files.open(each).read(each.file_size) for each in every}


def _program(name: str, model: bytes, about: dict[str, Any]) -> Program:
    options = onnxruntime.SessionOptions()
    # The programs are small: more threads than one would wait for each other.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # fatal errors; others are raised
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    outputs = [*about["outputs"]]

    def program(**given: ArrayLike) -> dict[str, np.ndarray]:
        found = session.run(outputs, checked(name, about["inputs"], given))
        return {output: np.asarray(x) for output, x in zip(outputs, found, strict=True)}

    return program


def checked(
    program: str, inputs: dict[str, Any], given: dict[str, ArrayLike]
) -> dict[str, np.ndarray]:
    """The inputs of a program as arrays of its types.

    Args:
      program: its name.
      inputs: describes them by name, see `contents.json`; axes with a name have any size but 0, the
        same in all inputs.
      given: by name.

    Raises:
      TypeError: if an input is missing or unknown.
      ValueError: if one has another shape, or does not hold numbers of its type.
    """
    if given.keys() != inputs.keys():
        raise TypeError(f"{program} needs {', '.join(inputs)}: not {', '.join(given)}")
    arrays, sizes = {}, {}
    for name, about in inputs.items():
        must_be = f"must be {about['dtype']} of shape {about['shape']} ({about['about']})"
        try:
            array = np.asarray(given[name])
            # A fraction is no index.
            arrays[name] = array.astype(about["dtype"], casting="same_kind")
        except (TypeError, ValueError) as error:
            value = reprlib.repr(given[name])
            raise ValueError(f"{program}: {name} = {value}: {must_be}") from error
        shape = [
            sizes.setdefault(axis, size) if isinstance(axis, str) else axis
            for axis, size in zip(about["shape"], array.shape, strict=False)
        ]
        if (*shape,) != array.shape or len(shape) != len(about["shape"]) or 0 in shape:
            raise ValueError(f"{program}: {name} has the shape {array.shape}: {must_be}")
    return arrays
