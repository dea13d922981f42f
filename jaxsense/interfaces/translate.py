"""Translates what JAX has traced into ONNX graphs, primitive by primitive.

The graph of a function follows from the function itself, so that a new fusion, sensor or policy
needs no line here, unless it uses a primitive that `_OPERATORS` lacks.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import partial_eval
from jax.lax import GatherScatterMode, RoundingMethod
from jaxtyping import PyTree
from onnx import checker, helper, numpy_helper

from jaxsense.core.types import by_place
from jaxsense.interfaces.graph import Graph, Struct, info, require

OPSET, IR_VERSION = 18, 9
"""The version of the operators, and of the file: of December 2022, so that old runtimes read it."""

Equation = Any
"""Of a function that JAX has traced."""


# Each of these builds the operators of an equation of JAX, from the names of its inputs.


def _inlined(graph: Graph, e: Equation, *given: str) -> list[str]:
    return graph.run(e.params.get("jaxpr") or e.params["call_jaxpr"], given)


def _round(graph: Graph, e: Equation, x: str) -> str:
    require(
        e.params["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN, "rounding away from zero"
    )
    return graph.op("Round", x)


def _is_finite(graph: Graph, e: Equation, x: str) -> str:
    return graph.op("Not", graph.op("Or", graph.op("IsNaN", x), graph.op("IsInf", x)))


def _atan2(graph: Graph, e: Equation, y: str, x: str) -> str:
    op = graph.op
    steep = op("Atan", op("Div", op("Abs", y), op("Abs", x)))
    ahead = op("Where", op("Equal", y, np.float32(0)), np.float32(0), steep)
    above = op("Where", op("Less", x, np.float32(0)), op("Sub", np.float32(np.pi), ahead), ahead)
    return op("Where", op("Less", y, np.float32(0)), op("Neg", above), above)


def _select(graph: Graph, e: Equation, which: str, *cases: str) -> str:
    require(e.invars[0].aval.dtype.kind == "b", "a choice among more than two")
    return graph.where(which, cases[1], cases[0], e.invars[1].aval.dtype)


def _iota(graph: Graph, e: Equation) -> str:
    shape, axis = e.params["shape"], e.params["dimension"]
    return graph.broadcast(graph.cast(graph.range(shape[axis]), e.params["dtype"]), shape, [axis])


def _broadcast(graph: Graph, e: Equation, x: str, *_: str) -> str:
    return graph.broadcast(x, e.params["shape"], e.params["broadcast_dimensions"])


def _stack(graph: Graph, e: Equation, *parts: str) -> str:
    axis = int(e.params["axis"])
    return graph.op("Concat", *(graph.op("Unsqueeze", x, [axis]) for x in parts), axis=axis)


def _split(graph: Graph, e: Equation, x: str) -> list[str]:
    sizes = list(e.params["sizes"])
    return graph.ops("Split", len(sizes), x, sizes, axis=int(e.params["axis"]))


def _slice(graph: Graph, e: Equation, x: str) -> str:
    starts, ends = (graph.shape(e.params[f"{end}_indices"]) for end in ("start", "limit"))
    axes = list(range(len(e.params["start_indices"])))
    return graph.op("Slice", x, starts, ends, axes, list(e.params["strides"] or [1] * len(axes)))


def _dynamic_slice(graph: Graph, e: Equation, x: str, *starts: str) -> str:
    sizes, axes = e.params["slice_sizes"], [*range(len(starts))]
    of_axes = zip(starts, e.invars[0].aval.shape, sizes, strict=True)
    first = graph.op(
        "Concat", *(graph.op("Reshape", graph.start(*y), [1]) for y in of_axes), axis=0
    )
    return graph.op("Slice", x, first, graph.op("Add", first, graph.shape(sizes)), axes)


def _reduced(operator: str, dtype: Any = None) -> Callable[..., str]:
    def reduced(graph: Graph, e: Equation, x: str) -> str:
        x = x if dtype is None else graph.cast(x, dtype)
        axes = list(e.params["axes"])
        found = graph.op(operator, x, axes, keepdims=0, noop_with_empty_axes=1)
        return found if dtype is None else graph.cast(found, e.outvars[0].aval.dtype)

    return reduced


def _best(operator: str) -> Callable[..., str]:
    def best(graph: Graph, e: Equation, x: str) -> str:
        (axis,) = e.params["axes"]
        return graph.cast(
            graph.op(operator, x, axis=int(axis), keepdims=0), e.params["index_dtype"]
        )

    return best


def _product(graph: Graph, e: Equation, x: str, y: str) -> str:
    (of_x, of_y), (batch_x, batch_y) = e.params["dimension_numbers"]
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    left, right = ([next(letters) for _ in v.aval.shape] for v in e.invars)
    for i, j in zip([*of_x, *batch_x], [*of_y, *batch_y], strict=True):
        right[j] = left[i]
    both, summed = [left[i] for i in batch_x], [left[i] for i in of_x]
    free = [n for n in left + right if n not in both + summed]
    sides = f"{''.join(left)},{''.join(right)}->{''.join(both + free)}"
    return graph.op("Einsum", x, y, equation=sides)


def _gather(graph: Graph, e: Equation, x: str, indices: str) -> str:
    require(e.params["mode"] != GatherScatterMode.FILL_OR_DROP, "gather that fills")
    numbers, sizes = e.params["dimension_numbers"], e.params["slice_sizes"]
    shape, found = e.invars[0].aval.shape, e.outvars[0].aval.shape
    batch = [axis for axis in range(len(found)) if axis not in numbers.offset_dims]
    of_starts = {axis: i for i, axis in enumerate(numbers.start_index_map)}
    batched = zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)
    of_batch = {axis: batch[at] for axis, at in batched}
    windows, indices_of = iter(numbers.offset_dims), []
    for axis, (length, size) in enumerate(zip(shape, sizes, strict=True)):
        # The index on this axis is a sum of terms, each along some axes of the result.
        index = graph.op("Expand", 0, graph.shape(found))
        if axis in of_starts:
            start = graph.op("Gather", indices, of_starts[axis], axis=e.invars[1].aval.ndim - 1)
            term = graph.broadcast(graph.start(start, length, size), found, batch)
            index = graph.op("Add", index, term)
        if axis in of_batch or axis not in numbers.collapsed_slice_dims:
            along = of_batch[axis] if axis in of_batch else next(windows)
            rows = graph.range(length if axis in of_batch else size)
            index = graph.op("Add", index, graph.broadcast(rows, found, [along]))
        indices_of.append(graph.op("Unsqueeze", index, [-1]))
    return graph.op("GatherND", x, graph.op("Concat", *indices_of, axis=-1))


def _scatter(graph: Graph, e: Equation, x: str, indices: str, updates: str) -> str:
    """Changes one row, along one axis, unless the row does not exist."""
    numbers, shape = e.params["dimension_numbers"], e.invars[0].aval.shape
    mapped = [*numbers.scatter_dims_to_operand_dims]
    is_row = len(mapped) == 1 and [*numbers.inserted_window_dims] == mapped
    is_one = e.invars[1].aval.ndim == 1 and not numbers.operand_batching_dims
    require(is_row and is_one, "scatter of several rows")
    (axis,) = mapped
    is_row = graph.op("Equal", graph.range(shape[axis]), graph.cast(indices, np.int64))
    is_row = graph.op("Unsqueeze", is_row, [n for n in range(1, len(shape) - axis)])
    return graph.where(is_row, graph.op("Unsqueeze", updates, [axis]), x, e.invars[0].aval.dtype)


def _scan(graph: Graph, e: Equation, *given: str) -> list[str]:
    require(not e.params["reverse"], "a scan from the end")
    inner, before, after = e.params["jaxpr"], e.invars, e.outvars
    # What moves along has one axis more outside; versions of JAX name the numbers otherwise.
    rows = sum(v.aval.ndim > x.ndim for v, x in zip(before, inner.in_avals, strict=True))
    number = sum(v.aval.ndim == x.ndim for v, x in zip(after, inner.out_avals, strict=True))
    last = len(before) - rows
    consts, carry, moving = given[: last - number], given[last - number : last], given[last:]
    # The graph of one step, of which each output has a name of its own.
    kinds = [Struct((), np.int64), Struct((), bool), *(v.aval for v in after[:number])]
    inputs = {next(graph.names): kind for kind in kinds}
    step, goes_on, *within = inputs
    body = dataclasses.replace(graph, nodes=[])
    of_step = [body.op("Gather", row, step, axis=0) for row in moving]
    found = [goes_on, *body.run(inner, [*consts, *within, *of_step])]
    outputs = [body.ops("Identity", 1, x)[0] for x in found]
    untyped = [helper.make_empty_tensor_value_info(x) for x in outputs]
    given_info = [info(*each) for each in inputs.items()]
    whole = helper.make_graph(body.nodes, "body", given_info, untyped)
    length = graph.size(e.params["length"])
    return graph.ops("Loop", len(after), length, np.bool_(True), *carry, body=whole)


# Runtimes take `and`, `or` and `not` of bools alone.
_SAME = (
    "add", "sub", "mul", "div", "max", "min", "pow", "exp", "log", "tanh", "tan", "sqrt", "abs",
    "neg", "sign", "floor", "ceil", "and", "or", "not",
)  # fmt: skip
_OPERATORS: dict[str, str | Callable[..., str | list[str]]] = {
    "jit": _inlined,
    "custom_jvp_call": _inlined,
    **{name: name.capitalize() for name in _SAME},
    "logistic": "Sigmoid",
    "lt": "Less",
    "le": "LessOrEqual",
    "gt": "Greater",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
    "stop_gradient": "Identity",
    "ne": lambda graph, e, x, y: graph.op("Not", graph.op("Equal", x, y)),
    "rem": lambda graph, e, x, y: graph.op("Mod", x, y, fmod=1),
    "clamp": lambda graph, e, low, x, high: graph.op("Min", graph.op("Max", x, low), high),
    "square": lambda graph, e, x: graph.op("Mul", x, x),
    "rsqrt": lambda graph, e, x: graph.op("Reciprocal", graph.op("Sqrt", x)),
    "integer_pow": lambda graph, e, x: graph.op("Pow", x, np.int32(e.params["y"])),
    "convert_element_type": lambda graph, e, x: graph.cast(x, e.params["new_dtype"]),
    "round": _round,
    "is_finite": _is_finite,
    "atan2": _atan2,
    "select_n": _select,
    "iota": _iota,
    "dim_as_value": lambda graph, e: graph.cast(
        graph.op("Identity", graph.size(e.params["dim"])), e.outvars[0].aval.dtype
    ),
    "broadcast_in_dim": _broadcast,
    "reshape": lambda graph, e, x, *_: graph.op("Reshape", x, graph.shape(e.params["new_sizes"])),
    "squeeze": lambda graph, e, x: graph.op("Squeeze", x, list(e.params["dimensions"])),
    "transpose": lambda graph, e, x: graph.op(
        "Transpose", x, perm=[*map(int, e.params["permutation"])]
    ),
    "concatenate": lambda graph, e, *x: graph.op("Concat", *x, axis=int(e.params["dimension"])),
    "stack": _stack,
    "split": _split,
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "reduce_sum": _reduced("ReduceSum"),
    "reduce_max": _reduced("ReduceMax"),
    "reduce_min": _reduced("ReduceMin"),
    "reduce_and": _reduced("ReduceMin", np.int32),
    "reduce_or": _reduced("ReduceMax", np.int32),
    "argmax": _best("ArgMax"),
    "argmin": _best("ArgMin"),
    "dot_general": _product,
    "gather": _gather,
    "scatter": _scatter,
    "scan": _scan,
}
"""Primitives of JAX: the operator that each is, or what builds its operators."""


def program(
    name: str,
    apply: Callable[..., dict[str, jax.Array]],
    models: PyTree,
    inputs: Mapping[str, Struct],
) -> tuple[bytes, dict[str, Struct]]:
    """A function as an ONNX file, whose weights are named by their place in the models.

    Args:
      name: of the graph.
      apply: `(models, *inputs) -> {name: output}`; its docstring says what it does.
      models: a pytree.
      inputs: by name; an axis of any size is a dimension of `jax.export.symbolic_shape`.

    Returns:
      The file, and the outputs by name.

    Raises:
      NotImplementedError: if a primitive of the function has no translation.
    """
    # Parameters that a user has made with NumPy may have 64 bits.
    models = jax.tree.map(lambda x: np.asarray(jnp.asarray(x)), models)
    weights = by_place(models)
    closed, outputs = jax.make_jaxpr(apply, return_shape=True)(models, *inputs.values())
    jaxpr, is_read = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(outputs))
    given = list(itertools.compress([*weights, *inputs], is_read))
    constants = {name: weights[name] for name in given if name in weights}
    graph = Graph(_OPERATORS, constants, {}, map("x{}".format, itertools.count()))
    for key, array in inputs.items():
        for axis, size in enumerate(array.shape):
            if not isinstance(size, int):
                graph.sizes[str(size)] = graph.op("Gather", graph.op("Shape", key), axis, axis=0)
    found = graph.run(core.ClosedJaxpr(jaxpr, closed.consts), given)
    named = [
        helper.make_node("Identity", [x], [y]) for x, y in zip(found, sorted(outputs), strict=True)
    ]
    whole = helper.make_graph(
        [*graph.nodes, *named],
        name,
        [info(*each) for each in inputs.items()],
        [info(*each) for each in outputs.items()],
        [numpy_helper.from_array(x, key) for key, x in graph.constants.items()],
        doc_string=apply.__doc__,
    )
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(
        whole, opset_imports=opsets, ir_version=IR_VERSION, producer_name="jaxsense"
    )
    checker.check_model(model)
    return model.SerializeToString(), outputs
