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
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike

MOST_BYTES, MOST_TEXT = 2**27, 2**22
"""Bytes of an unpacked archive and of its `contents.json`: those of presets hold 1 % of them."""
_DTYPES = {"tensor(float)": "float32", "tensor(int32)": "int32", "tensor(bool)": "bool"}

Arrays = dict[str, np.ndarray]
Program = Callable[..., Arrays]


def load(path: Path | str | BinaryIO) -> tuple[dict[str, Any], dict[str, Program]]:
    """Reads an archive.

    Args:
      path: the archive, or a file that is open.

    Returns:
      Its `contents.json`, and its programs by name: from arrays by name to arrays by name.

    Raises:
      ValueError: if it cannot be read, is no archive, is damaged or is too large.
    """
    try:
        contents, models = _read(path)
        return contents, {
            name: _program(name, models[name], about)
            for name, about in contents["programs"].items()
        }
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # zipfile, zlib, json and onnxruntime have no base class in common
        must_be = "must be a file of `jaxsense export`"
        raise ValueError(f"{path}: {must_be} ({error!r:.300})") from error


def _read(path: Path | str | BinaryIO) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Content of `contents.json`, and the ONNX file of each program."""
    if isinstance(path, str | Path) and not Path(path).is_file():
        raise FileNotFoundError("no such file")
    with zipfile.ZipFile(path) as files:
        every = files.infolist()
        size, of_text = sum(x.file_size for x in every), files.getinfo("contents.json").file_size
        if size > MOST_BYTES or of_text > MOST_TEXT:
            must_be = f"must be at most {MOST_BYTES}, and {MOST_TEXT} in contents.json"
            raise ValueError(f"{size} bytes when unpacked, {of_text} in contents.json: {must_be}")
        # zipfile bounds what it unpacks of no other kind.
        if not {x.compress_type for x in every} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise ValueError("packed in another way than by zlib")
        contents = json.loads(_unpacked(files, "contents.json"))
        return contents, {name: _unpacked(files, f"{name}.onnx") for name in contents["programs"]}


def _unpacked(files: zipfile.ZipFile, name: str) -> bytes:
    with files.open(name) as file:
        # Without a number, it would unpack more than the size that was checked.
        return file.read(files.getinfo(name).file_size)


def checked(
    program: str,
    inputs: Mapping[str, Any],
    unnamed: tuple[object, ...],
    given: Mapping[str, ArrayLike],
) -> Arrays:
    """The inputs of a program as arrays of its types.

    Args:
      program: its name.
      inputs: describes them by name, see `contents.json`; axes with a name have any size but 0, the
        same in all inputs.
      unnamed: what is given without a name.
      given: by name.

    Raises:
      TypeError: if an input is missing, unknown or unnamed.
      ValueError: if one has another shape, or does not hold numbers of its type.
    """
    wrong = [f"{name} is none of them" for name in given if name not in inputs]
    wrong += [f"{name} is missing" for name in inputs if name not in given and not unnamed]
    if wrong or unnamed:
        needs = f"{program} needs {', '.join(inputs)}"
        raise TypeError("; ".join([f"{needs}, by name" if unnamed else needs, *wrong]))
    arrays, sizes = {}, {}
    for name, each in inputs.items():
        arrays[name] = array = _array(program, name, given[name], each)
        if array.ndim == len(each["shape"]):
            for axis, size in zip(each["shape"], array.shape, strict=True):
                if isinstance(axis, str) and size:
                    sizes.setdefault(axis, size)
        expected = tuple(sizes.get(axis, axis) for axis in each["shape"])
        if array.shape != expected or 0 in array.shape:
            must_be = f"must be {_text(expected)} ({each['about']})"
            raise ValueError(f"{program}: {name} has the shape {array.shape}: {must_be}")
    return arrays


def _array(program: str, name: str, given: ArrayLike, about: Mapping[str, Any]) -> np.ndarray:
    """An input as an array of its type; raises `ValueError` if it holds something else."""
    try:
        array = np.asarray(given)
        if array.dtype.kind in "biuf":
            with np.errstate(invalid="ignore"):
                found = array.astype(about["dtype"])
            # A fraction is no index.
            if about["dtype"] == "float32" or np.array_equal(found, array):
                return found
    except ValueError:  # lists of unequal lengths
        pass
    must_be = f"must be {about['dtype']} of shape {_text(about['shape'])} ({about['about']})"
    raise ValueError(f"{program}: {name} = {reprlib.repr(given)}: {must_be}")


def _text(shape: Iterable[int | str]) -> str:
    return str(tuple(shape)).replace("'", "")


def _program(name: str, model: bytes, about: Mapping[str, Any]) -> Program:
    options = onnxruntime.SessionOptions()
    # The programs are small: more threads than one would wait for each other.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # fatal errors; others are raised
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    for ends, found in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
        described = {key: (each["dtype"], each["shape"]) for key, each in about[ends].items()}
        if described != {each.name: (_DTYPES.get(each.type), each.shape) for each in found}:
            raise ValueError(f"{name}.onnx has other {ends} than contents.json")
    outputs = [*about["outputs"]]

    def program(*unnamed: object, **given: ArrayLike) -> Arrays:
        found = session.run(outputs, checked(name, about["inputs"], unnamed, given))
        return {output: np.asarray(x) for output, x in zip(outputs, found, strict=True)}

    return program
