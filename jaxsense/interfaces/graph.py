"""A graph of ONNX operators, built from the names of arrays; `translate` fills it."""

import ast
import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from jax.extend import core
from onnx import helper

Struct = jax.ShapeDtypeStruct
Size = Any
"""The size of an axis: a number, or an expression of JAX such as `pois + 1`."""

_ARITHMETIC = {ast.Add: "Add", ast.Sub: "Sub", ast.Mult: "Mul", ast.Pow: "Pow"}


@dataclasses.dataclass
class Graph:
    """A graph of operators so far; arrays are known by their names.

    Attributes:
      operators: of each primitive of JAX: the name of an operator, or what builds several.
      constants: arrays by name, of all graphs.
      sizes: names of the numbers that hold the sizes of named axes.
      names: new ones.
      nodes: operators, in their order.
    """

    operators: Mapping[str, Any]
    constants: dict[str, np.ndarray]
    sizes: dict[str, str]
    names: Iterator[str]
    nodes: list[onnx.NodeProto] = dataclasses.field(default_factory=list)

    def constant(self, value: Any) -> str:
        """The name of an array, which says what it holds."""
        value = np.asarray(value, np.int64 if isinstance(value, list) else None)
        content = hashlib.sha256(value.tobytes()).hexdigest()[:16]
        name = f"{value.dtype}{list(value.shape)}{content}"
        self.constants[name] = value
        return name

    def ops(self, operator: str, number: int, *inputs: Any, **attributes: Any) -> list[str]:
        """Applies an operator to names and numbers; returns the names of its outputs."""
        given = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        outputs = [next(self.names) for _ in range(number)]
        self.nodes.append(helper.make_node(operator, given, outputs, **attributes))
        return outputs

    def op(self, operator: str, *inputs: Any, **attributes: Any) -> str:
        """Applies an operator with one output."""
        return self.ops(operator, 1, *inputs, **attributes)[0]

    def cast(self, x: str, dtype: Any) -> str:
        """An array with another dtype."""
        return self.op("Cast", x, to=_kind(dtype))

    def where(self, which: str, yes: str, no: str, dtype: Any) -> str:
        """Elements of one of two arrays; runtimes choose no bool."""
        if np.dtype(dtype).kind != "b":
            return self.op("Where", which, yes, no)
        chosen = self.op("And", which, yes), self.op("And", self.op("Not", which), no)
        return self.op("Or", *chosen)

    def size(self, size: Size) -> str | int:
        """The size of an axis: a number, or the name of one; a polynomial such as `2*pois + 1`."""

        def read(tree: ast.expr) -> Any:
            match tree:
                case ast.Constant(value=value):
                    return value
                case ast.Name(id=name):
                    return self.sizes[name]
                case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
                    return self.op(_ARITHMETIC[type(op)], read(left), read(right))
            raise NotImplementedError(f"the size {size} has no ONNX translation")

        return read(ast.parse(str(size).replace("^", "**"), mode="eval").body)

    def shape(self, sizes: Sequence[Size]) -> str:
        """A list of sizes, int64."""
        if all(isinstance(size, int | np.integer) for size in sizes):
            return self.constant(list(sizes))
        return self.op("Concat", *(self.op("Reshape", self.size(n), [1]) for n in sizes), axis=0)

    def range(self, size: Size) -> str:
        """The numbers from 0 below a size, int64."""
        return self.op("Range", 0, self.size(size), 1)

    def broadcast(self, x: str, shape: Sequence[Size], axes: Sequence[int]) -> str:
        """An array repeated to a shape, where its axes are `axes`."""
        new = [axis for axis in range(len(shape)) if axis not in axes]
        return self.op("Expand", self.op("Unsqueeze", x, new), self.shape(shape))

    def start(self, index: str, size: Size, window: Size = 1) -> str:
        """The index where a window starts, moved into its axis as XLA does."""
        last = self.op("Min", self.cast(index, np.int64), self.size(size - window))
        return self.op("Max", last, 0)

    def run(self, closed: core.ClosedJaxpr, inputs: Sequence[str]) -> list[str]:
        """Translates all equations of a function, and returns the names of its outputs."""
        jaxpr = closed.jaxpr
        names = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))

        def read(variable: Any) -> str:
            dtype = variable.aval.dtype
            value = variable.val if hasattr(variable, "val") else names[variable]
            if jnp.issubdtype(dtype, jax.dtypes.extended):
                return ""  # a random key, which nobody reads
            return value if isinstance(value, str) else self.constant(np.asarray(value, dtype))

        for equation in jaxpr.eqns:
            kind, given = equation.primitive.name, map(read, equation.invars)
            require(kind in self.operators, f"the primitive {kind}")
            operator = self.operators[kind]
            is_one = isinstance(operator, str)
            found = self.op(operator, *given) if is_one else operator(self, equation, *given)
            outputs = [found] if isinstance(found, str) else found
            names |= dict(zip(equation.outvars, outputs, strict=True))
        return [read(variable) for variable in jaxpr.outvars]


def info(name: str, array: Any) -> onnx.ValueInfoProto:
    """The name, shape and type of an array."""
    shape = [n if isinstance(n, int) else str(n) for n in array.shape]
    return helper.make_tensor_value_info(name, _kind(array.dtype), shape)


def _kind(dtype: Any) -> int:
    return helper.np_dtype_to_tensor_dtype(np.dtype(dtype))


def require(is_translated: bool, what: str) -> None:
    """Raises `NotImplementedError` if something has no translation."""
    if not is_translated:
        raise NotImplementedError(f"{what} has no ONNX translation")
