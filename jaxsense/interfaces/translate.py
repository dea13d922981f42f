"""Translates what JAX has traced into ONNX graphs, primitive by primitive.

The graph of a function follows from the function itself, so that a new fusion, sensor or policy
needs no line here, unless it uses a primitive that `_RULES` lacks.
"""

import ast
import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import spox.opset.ai.onnx.v18 as op
from jax.extend import core
from jax.interpreters import partial_eval
from jax.lax import GatherScatterMode, RoundingMethod
from jaxtyping import PyTree
from onnx import checker, helper, numpy_helper
from onnx.shape_inference import InferenceError
from spox import Tensor, Var, argument, build

from jaxsense.core.types import by_place

IR_VERSION = 9
"""Of the file: of December 2022, as are the operators, so that old runtimes read it."""

Struct = jax.ShapeDtypeStruct
Equation = Any
"""Of a function that JAX has traced."""
Size = Any
"""The size of an axis: a number, or an expression of JAX such as `pois + 1`."""

_ARITHMETIC = {ast.Add: op.add, ast.Sub: op.sub, ast.Mult: op.mul, ast.Pow: op.pow}


@dataclasses.dataclass(frozen=True)
class Graph:
    """What the equations of a function share.

    Attributes:
      sizes: of named axes, int64.
      constants: by their content, so that each is stored once.
    """

    sizes: dict[str, Var] = dataclasses.field(default_factory=dict)
    constants: dict[Any, Var] = dataclasses.field(default_factory=dict)

    def constant(self, value: Any) -> Var:
        """An array; lists become int64."""
        value = np.asarray(value, np.int64 if isinstance(value, list) else None)
        content = value.dtype, value.shape, value.tobytes()
        if content not in self.constants:
            self.constants[content] = op.const(value)
        return self.constants[content]

    def size(self, size: Size) -> Var:
        """The size of an axis, int64; a polynomial such as `2*pois + 1`."""

        def read(tree: ast.expr) -> Var:
            match tree:
                case ast.Constant(value=value):
                    return self.constant(value)
                case ast.Name(id=name):
                    return self.sizes[name]
                case ast.BinOp(left=left, op=by, right=right) if type(by) in _ARITHMETIC:
                    return _ARITHMETIC[type(by)](read(left), read(right))
            raise NotImplementedError(f"the size {size} has no ONNX translation")

        return read(ast.parse(str(size).replace("^", "**"), mode="eval").body)

    def shape(self, sizes: Sequence[Size]) -> Var:
        """A list of sizes, int64."""
        if all(isinstance(size, int | np.integer) for size in sizes):
            return self.constant(list(sizes))
        return self.vector([self.size(size) for size in sizes])

    def vector(self, numbers: Sequence[Var]) -> Var:
        """Numbers as one array."""
        return op.concat([self.unsqueeze(number, [0]) for number in numbers], axis=0)

    def range(self, size: Size) -> Var:
        """The numbers from 0 below a size, int64."""
        return op.range(self.constant(0), self.size(size), self.constant(1))

    def unsqueeze(self, x: Var, axes: Sequence[int]) -> Var:
        """An array with new axes."""
        return op.unsqueeze(x, self.constant([*axes]))

    def broadcast(self, x: Var, shape: Sequence[Size], axes: Sequence[int]) -> Var:
        """An array repeated to a shape, where its axes are `axes`."""
        new = [axis for axis in range(len(shape)) if axis not in axes]
        return op.expand(self.unsqueeze(x, new), self.shape(shape))

    def start(self, index: Var, size: Size, window: Size = 1) -> Var:
        """The index where a window starts, moved into its axis as XLA does."""
        return op.clip(op.cast(index, to=np.int64), self.constant(0), self.size(size - window))

    def run(self, closed: core.ClosedJaxpr, inputs: Sequence[Var]) -> list[Var]:
        """Translates all equations of a function, and returns its outputs."""
        jaxpr = closed.jaxpr
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))

        def read(variable: Any) -> Var:
            dtype = variable.aval.dtype
            value = variable.val if hasattr(variable, "val") else known[variable]
            # Nobody reads a random key.
            is_var = isinstance(value, Var) or jnp.issubdtype(dtype, jax.dtypes.extended)
            return value if is_var else self.constant(np.asarray(value, dtype))

        for equation in jaxpr.eqns:
            kind, given = equation.primitive.name, [read(variable) for variable in equation.invars]
            require(kind in _RULES, f"the primitive {kind}")
            try:
                found = _RULES[kind](self, equation, *given)
            except InferenceError as error:
                types = ", ".join(str(variable.aval) for variable in equation.invars)
                message = f"the primitive {kind} of {types} has no ONNX translation"
                raise NotImplementedError(message) from error
            outputs = [found] if isinstance(found, Var) else found
            known |= dict(zip(equation.outvars, outputs, strict=True))
        return [read(variable) for variable in jaxpr.outvars]


def require(is_translated: bool, what: str) -> None:
    """Raises `NotImplementedError` if something has no translation."""
    if not is_translated:
        raise NotImplementedError(f"{what} has no ONNX translation")


# Each of these builds the operators of an equation of JAX, from its inputs.


def _inlined(graph: Graph, e: Equation, *given: Var) -> list[Var]:
    return graph.run(e.params.get("jaxpr") or e.params["call_jaxpr"], given)


def _round(graph: Graph, e: Equation, x: Var) -> Var:
    is_even = e.params["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN
    require(is_even, "rounding away from zero")
    return op.round(x)


def _atan2(y: Var, x: Var) -> Var:
    zero, pi = op.const(np.float32(0)), op.const(np.float32(np.pi))
    steep = op.atan(op.div(op.abs(y), op.abs(x)))
    ahead = op.where(op.equal(y, zero), zero, steep)
    above = op.where(op.less(x, zero), op.sub(pi, ahead), ahead)
    return op.where(op.less(y, zero), op.neg(above), above)


def _where(which: Var, yes: Var, no: Var) -> Var:
    """Elements of one of two arrays; runtimes choose no bool."""
    if yes.unwrap_tensor().dtype != bool:
        return op.where(which, yes, no)
    return op.or_(op.and_(which, yes), op.and_(op.not_(which), no))


def _select(graph: Graph, e: Equation, which: Var, *cases: Var) -> Var:
    require(len(cases) == 2, "a choice among more than two")
    return _where(which, cases[1], cases[0])


def _iota(graph: Graph, e: Equation) -> Var:
    shape, axis = e.params["shape"], e.params["dimension"]
    numbers = op.cast(graph.range(shape[axis]), to=e.params["dtype"])
    return graph.broadcast(numbers, shape, [axis])


def _stack(graph: Graph, e: Equation, *parts: Var) -> Var:
    axis = e.params["axis"]
    return op.concat([graph.unsqueeze(x, [axis]) for x in parts], axis=axis)


def _slice(graph: Graph, e: Equation, x: Var) -> Var:
    starts, ends = (graph.shape(e.params[f"{end}_indices"]) for end in ("start", "limit"))
    strides = e.params["strides"]
    return op.slice(x, starts, ends, steps=strides and graph.constant([*strides]))


def _dynamic_slice(graph: Graph, e: Equation, x: Var, *starts: Var) -> Var:
    sizes = e.params["slice_sizes"]
    of_axes = zip(starts, e.invars[0].aval.shape, sizes, strict=True)
    first = graph.vector([graph.start(*each) for each in of_axes])
    return op.slice(x, first, op.add(first, graph.shape(sizes)))


def _reduced(operator: Callable[..., Var], dtype: Any = None) -> Callable[..., Var]:
    def reduced(graph: Graph, e: Equation, x: Var) -> Var:
        x = x if dtype is None else op.cast(x, to=dtype)
        axes = graph.constant(list(e.params["axes"]))
        found = operator(x, axes, keepdims=0, noop_with_empty_axes=1)
        return found if dtype is None else op.cast(found, to=e.outvars[0].aval.dtype)

    return reduced


def _best(operator: Callable[..., Var]) -> Callable[..., Var]:
    def best(graph: Graph, e: Equation, x: Var) -> Var:
        (axis,) = e.params["axes"]
        return op.cast(operator(x, axis=axis, keepdims=0), to=e.params["index_dtype"])

    return best


def _product(graph: Graph, e: Equation, x: Var, y: Var) -> Var:
    (of_x, of_y), (batch_x, batch_y) = e.params["dimension_numbers"]
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    left, right = ([next(letters) for _ in v.aval.shape] for v in e.invars)
    for i, j in zip([*of_x, *batch_x], [*of_y, *batch_y], strict=True):
        right[j] = left[i]
    both, summed = [left[i] for i in batch_x], [left[i] for i in of_x]
    free = [n for n in left + right if n not in both + summed]
    sides = f"{''.join(left)},{''.join(right)}->{''.join(both + free)}"
    return op.einsum([x, y], equation=sides)


def _gather(graph: Graph, e: Equation, x: Var, indices: Var) -> Var:
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
        index = op.expand(graph.constant(0), graph.shape(found))
        if axis in of_starts:
            start = op.gather(indices, graph.constant(of_starts[axis]), axis=-1)
            term = graph.broadcast(graph.start(start, length, size), found, batch)
            index = op.add(index, term)
        if axis in of_batch or axis not in numbers.collapsed_slice_dims:
            along = of_batch[axis] if axis in of_batch else next(windows)
            rows = graph.range(length if axis in of_batch else size)
            index = op.add(index, graph.broadcast(rows, found, [along]))
        indices_of.append(graph.unsqueeze(index, [-1]))
    return op.gather_nd(x, op.concat(indices_of, axis=-1))


def _scatter(graph: Graph, e: Equation, x: Var, indices: Var, updates: Var) -> Var:
    """Changes one row, along one axis, unless the row does not exist."""
    numbers, shape = e.params["dimension_numbers"], e.invars[0].aval.shape
    mapped = [*numbers.scatter_dims_to_operand_dims]
    is_row = len(mapped) == 1 and [*numbers.inserted_window_dims] == mapped
    is_one = e.invars[1].aval.ndim == 1 and not numbers.operand_batching_dims
    require(is_row and is_one, "scatter of several rows")
    (axis,) = mapped
    is_row = op.equal(graph.range(shape[axis]), op.cast(indices, to=np.int64))
    is_row = graph.unsqueeze(is_row, range(1, len(shape) - axis))
    return _where(is_row, graph.unsqueeze(updates, [axis]), x)


def _scan(graph: Graph, e: Equation, *given: Var) -> Sequence[Var]:
    require(not e.params["reverse"], "a scan from the end")
    inner, before, after = e.params["jaxpr"], e.invars, e.outvars
    # What moves along has one axis more outside; versions of JAX name the numbers otherwise.
    rows = sum(v.aval.ndim > x.ndim for v, x in zip(before, inner.in_avals, strict=True))
    number = sum(v.aval.ndim == x.ndim for v, x in zip(after, inner.out_avals, strict=True))
    last = len(before) - rows
    consts, carry, moving = given[: last - number], given[last - number : last], given[last:]

    def body(step: Var, goes_on: Var, *within: Var) -> list[Var]:
        of_step = [op.gather(row, op.squeeze(step), axis=0) for row in moving]
        return [goes_on, *graph.run(inner, [*consts, *within, *of_step])]

    length = graph.size(e.params["length"])
    return op.loop(length, graph.constant(np.ones(1, bool)), carry, body=body)


def _plain(operator: Callable[..., Var]) -> Callable[..., Var]:
    return lambda graph, e, *given: operator(*given)


_SAME = (
    "add", "sub", "mul", "div", "pow", "exp", "log", "tanh", "tan", "sqrt", "abs", "neg", "sign",
    "floor", "ceil",
)  # fmt: skip
_OPERATORS: dict[str, Callable[..., Var]] = {
    **{name: getattr(op, name) for name in _SAME},
    # Runtimes take these three of bools alone.
    "and": op.and_,
    "or": op.or_,
    "not": op.not_,
    "lt": op.less,
    "le": op.less_or_equal,
    "gt": op.greater,
    "ge": op.greater_or_equal,
    "eq": op.equal,
    "logistic": op.sigmoid,
    "stop_gradient": op.identity,
    "max": lambda x, y: op.max([x, y]),
    "min": lambda x, y: op.min([x, y]),
    "ne": lambda x, y: op.not_(op.equal(x, y)),
    "rem": lambda x, y: op.mod(x, y, fmod=1),
    "clamp": lambda low, x, high: op.min([op.max([x, low]), high]),
    "square": lambda x: op.mul(x, x),
    "rsqrt": lambda x: op.reciprocal(op.sqrt(x)),
    "is_finite": lambda x: op.not_(op.or_(op.isnan(x), op.isinf(x))),
    "atan2": _atan2,
}
_RULES: dict[str, Callable[..., Any]] = {
    **{name: _plain(operator) for name, operator in _OPERATORS.items()},
    "jit": _inlined,
    "custom_jvp_call": _inlined,
    "integer_pow": lambda graph, e, x: op.pow(x, graph.constant(np.int32(e.params["y"]))),
    "convert_element_type": lambda graph, e, x: op.cast(x, to=e.params["new_dtype"]),
    "round": _round,
    "select_n": _select,
    "iota": _iota,
    "dim_as_value": lambda graph, e: op.cast(
        graph.size(e.params["dim"]), to=e.outvars[0].aval.dtype
    ),
    "broadcast_in_dim": lambda graph, e, x, *_: graph.broadcast(
        x, e.params["shape"], e.params["broadcast_dimensions"]
    ),
    "reshape": lambda graph, e, x, *_: op.reshape(x, graph.shape(e.params["new_sizes"])),
    "squeeze": lambda graph, e, x: op.squeeze(x, graph.constant([*e.params["dimensions"]])),
    "transpose": lambda graph, e, x: op.transpose(x, perm=e.params["permutation"]),
    "concatenate": lambda graph, e, *x: op.concat(x, axis=e.params["dimension"]),
    "stack": _stack,
    "split": lambda graph, e, x: op.split(
        x, graph.constant([*e.params["sizes"]]), axis=e.params["axis"]
    ),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "reduce_sum": _reduced(op.reduce_sum),
    "reduce_max": _reduced(op.reduce_max),
    "reduce_min": _reduced(op.reduce_min),
    "reduce_and": _reduced(op.reduce_min, np.int32),
    "reduce_or": _reduced(op.reduce_max, np.int32),
    "argmax": _best(op.arg_max),
    "argmin": _best(op.arg_min),
    "dot_general": _product,
    "gather": _gather,
    "scatter": _scatter,
    "scan": _scan,
}
"""Primitives of JAX: what builds their operators, from the graph, an equation and its inputs."""


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
    weights = {place: np.asarray(jnp.asarray(x)) for place, x in by_place(models).items()}
    closed, outputs = jax.make_jaxpr(apply, return_shape=True)(models, *inputs.values())
    jaxpr, is_read = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(outputs))
    # Weights begin as inputs, which have names.
    whole = {key: argument(Tensor(x.dtype, _shape(x))) for key, x in {**weights, **inputs}.items()}
    graph = Graph()
    for key, array in inputs.items():
        for axis, size in enumerate(array.shape):
            if not isinstance(size, int):
                graph.sizes[str(size)] = op.squeeze(op.shape(whole[key], start=axis, end=axis + 1))
    given = dict(itertools.compress(whole.items(), is_read))
    found = graph.run(core.ClosedJaxpr(jaxpr, closed.consts), [*given.values()])
    ends = given | {key: whole[key] for key in inputs}
    model = build(ends, dict(zip(sorted(outputs), found, strict=True)))
    model.ir_version, model.producer_name = IR_VERSION, "jaxsense"
    model.graph.name, model.graph.doc_string = name, apply.__doc__ or ""
    model.graph.ClearField("output")  # whose axes have lost their names
    for key, x in outputs.items():
        kind = helper.np_dtype_to_tensor_dtype(x.dtype)
        model.graph.output.append(helper.make_tensor_value_info(key, kind, _shape(x)))
    for each in [x for x in model.graph.input if x.name in weights]:
        model.graph.input.remove(each)
        model.graph.initializer.append(numpy_helper.from_array(weights[each.name], each.name))
    checker.check_model(model)
    return model.SerializeToString(), outputs


def _shape(array: Any) -> tuple[int | str, ...]:
    return tuple(n if isinstance(n, int) else str(n) for n in array.shape)
