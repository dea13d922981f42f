"""Runs an exported run with NumPy alone: copy this file and the archive to a robot.

    from robot_numpy import load
    contents, programs = load("robot.zip")
    programs["decide"](mean=..., std=..., ...)  # {"action": ..., "values": ...}

`contents` describes the inputs and outputs of each program. A program is a list of ONNX operators
(https://onnx.ai/onnx/operators) on named arrays, among them the weights in `weights.npz`.
"""

import io
import json
import reprlib
import sys
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

Arrays = dict[str, np.ndarray]
Program = Callable[..., Arrays]
Values = dict[str, Any]  # arrays and numbers by name
Operator = Callable[..., Any]  # to an array, a number, or a list of arrays
Step = tuple[Operator, list[str], list[str]]


def load(path: Path | str | BinaryIO) -> tuple[dict[str, Any], dict[str, Program]]:
    """Reads an archive.

    Args:
      path: the archive, or a file that is open.

    Returns:
      Its `contents.json`, and its programs by name: from arrays by name to arrays by name.

    Raises:
      ValueError: if it is no archive.
    """
    try:
        with zipfile.ZipFile(path) as files:
            contents = json.loads(files.read("contents.json"))
            graphs = json.loads(files.read("programs.json"))
            weights = dict(np.load(io.BytesIO(files.read("weights.npz"))))
    except (KeyError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: must be a file of `jaxsense export` ({error})") from error
    described = contents["programs"]
    return contents, {
        name: _program(name, graphs[name], weights, described[name]) for name in graphs
    }


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


def _program(
    name: str, graph: Mapping[str, Any], weights: Arrays, about: Mapping[str, Any]
) -> Program:
    known: Values = dict(weights)
    steps: list[Step] = []
    # What depends on weights alone is computed once.
    for node in graph["nodes"]:
        operator, inputs, *_ = node
        is_plain = operator not in ("Loop", "If")
        if is_plain and all(each in known or not each for each in inputs):
            _play([_step(node)], known)
        else:
            steps.append(_step(node))

    def program(*unnamed: object, **given: ArrayLike) -> Arrays:
        values = {**known, **checked(name, about["inputs"], unnamed, given)}
        # As on other runtimes, infinity and NaN are no errors.
        with np.errstate(all="ignore"):
            _play(steps, values)
        names = zip(about["outputs"], graph["outputs"], strict=True)
        return {output: np.asarray(values[of_graph]) for output, of_graph in names}

    return program


def _step(node: list[Any]) -> Step:
    """A function of `values`, or of arrays, and the names of its inputs and outputs."""
    operator, inputs, outputs, attributes = node
    if operator == "Loop":
        return _loop(attributes["body"], inputs), [], outputs
    if operator == "If":
        return _branch(attributes, inputs[0]), [], outputs
    function = OPERATORS[operator]
    if attributes:
        return (lambda *x: function(*x, **attributes)), inputs, outputs
    return function, inputs, outputs


def _play(steps: list[Step], values: Values) -> None:
    """Applies operators in their order; `values` are all arrays by name."""
    for function, inputs, outputs in steps:
        found = function(*[values[name] for name in inputs]) if inputs else function(values)
        if len(outputs) == 1:
            values[outputs[0]] = found
        else:
            values.update(zip(outputs, found, strict=True))


def _loop(body: Mapping[str, Any], inputs: list[str]) -> Operator:
    """ONNX's `Loop`: at most `most` steps, as long as the first output of the body is true."""
    steps = [_step(node) for node in body["nodes"]]
    most, goes_on, *first = inputs
    number = len(first)

    def loop(values: Values) -> Any:
        limit = int(values[most]) if most else sys.maxsize
        is_going, carry = bool(values[goes_on]), [values[name] for name in first]
        rows: list[list[np.ndarray]] = [[] for _ in body["outputs"][1 + number :]]
        step = 0
        while is_going and step < limit:
            values.update(zip(body["inputs"], [np.int64(step), is_going, *carry], strict=True))
            _play(steps, values)
            is_going, *found = [values[name] for name in body["outputs"]]
            carry, step = found[:number], step + 1
            for row, new in zip(rows, found[number:], strict=True):
                row.append(new)
        found = [*carry, *map(np.stack, rows)]
        return found[0] if len(found) == 1 else found

    return loop


def _branch(graphs: Mapping[str, Any], which: str) -> Operator:
    """ONNX's `If`."""
    steps = {key: [_step(node) for node in graph["nodes"]] for key, graph in graphs.items()}

    def branch(values: Values) -> Any:
        key = "then_branch" if values[which] else "else_branch"
        _play(steps[key], values)
        found = [values[name] for name in graphs[key]["outputs"]]
        return found[0] if len(found) == 1 else found

    return branch


def _divide(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    # Whole numbers are divided towards zero.
    if np.issubdtype(np.asarray(x).dtype, np.integer):
        return (np.sign(x) * np.sign(y) * (np.abs(x) // np.abs(y))).astype(x.dtype)
    return x / y


def _slice(
    x: np.ndarray,
    starts: np.ndarray,
    ends: np.ndarray,
    axes: np.ndarray,
    steps: np.ndarray | None = None,
) -> np.ndarray:
    parts = [slice(None)] * x.ndim
    each = [1] * len(axes) if steps is None else steps
    for axis, start, end, step in zip(axes, starts, ends, each, strict=True):
        parts[axis] = slice(int(start), int(end), int(step))
    return x[tuple(parts)]


def _unsqueeze(x: np.ndarray, axes: np.ndarray) -> np.ndarray:
    return np.expand_dims(x, tuple(axes.tolist()))


def _gather_nd(x: np.ndarray, indices: np.ndarray, batch_dims: int) -> np.ndarray:
    """Rows of `x` at vectors of indices; the first axes belong together."""
    batch: Any = np.indices(indices.shape[:batch_dims], sparse=True)
    extra = indices.ndim - 1 - batch_dims
    batch = [index.reshape(*index.shape, *[1] * extra) for index in batch]
    return x[(*batch, *np.moveaxis(indices, -1, 0))]


def _cast(x: np.ndarray, to: str) -> np.ndarray:
    return np.asarray(x).astype(to)


def _reduced(function: Operator) -> Operator:
    return lambda x, axes, keepdims: function(x, axis=tuple(axes.tolist()))


OPERATORS: dict[str, Operator] = {
    "Add": np.add,
    "Sub": np.subtract,
    "Mul": np.multiply,
    "Div": _divide,
    "Max": np.maximum,
    "Min": np.minimum,
    "Pow": np.power,
    "Mod": lambda x, y, fmod: np.fmod(x, y),
    "Exp": np.exp,
    "Log": np.log,
    "Tanh": np.tanh,
    "Sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "Sqrt": np.sqrt,
    "Reciprocal": lambda x: 1 / x,
    "Tan": np.tan,
    "Atan": np.arctan,
    "Abs": np.abs,
    "Neg": np.negative,
    "Sign": np.sign,
    "Floor": np.floor,
    "Ceil": np.ceil,
    "Round": np.round,
    "IsNaN": np.isnan,
    "IsInf": np.isinf,
    "Less": np.less,
    "LessOrEqual": np.less_equal,
    "Greater": np.greater,
    "GreaterOrEqual": np.greater_equal,
    "Equal": np.equal,
    "And": np.logical_and,
    "Or": np.logical_or,
    "Not": np.logical_not,
    "Where": np.where,
    "Identity": lambda x: x,
    "Cast": _cast,
    "Range": np.arange,
    "Shape": lambda x: np.array(np.shape(x), np.int64),
    "Expand": lambda x, shape: np.broadcast_to(x, np.broadcast_shapes(np.shape(x), tuple(shape))),
    "Reshape": lambda x, shape: np.reshape(x, tuple(shape)),
    "Squeeze": lambda x, axes: np.squeeze(x, tuple(axes.tolist())),
    "Unsqueeze": _unsqueeze,
    "Transpose": lambda x, perm: x.transpose(perm),
    "Concat": lambda *x, axis: np.concatenate(x, axis),
    "Split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "Slice": _slice,
    "Gather": np.take,
    "GatherND": _gather_nd,
    "ReduceSum": _reduced(np.sum),
    "ReduceMax": _reduced(np.max),
    "ReduceMin": _reduced(np.min),
    "ArgMax": lambda x, axis, keepdims: np.argmax(x, axis),
    "ArgMin": lambda x, axis, keepdims: np.argmin(x, axis),
    "MatMul": np.matmul,
    "Einsum": lambda *x, equation: np.einsum(equation, *x, optimize=True),
}
"""ONNX operators in NumPy, as far as programs use them."""
