"""What primitives of JAX are in ONNX operators: numbers, shapes, sums and products."""

import ast
import functools
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import numpy as np
from jax.core import Atom, ShapedArray
from jax.extend.core import JaxprEqn
from jax.typing import DTypeLike

from jaxsense.interfaces.graph import Array, Builder

Size = Any
"""The size of an axis: a number, or an expression of JAX such as `pois + 1`."""

SAME = {
    "add": "Add",
    "sub": "Sub",
    "mul": "Mul",
    "max": "Max",
    "min": "Min",
    "pow": "Pow",
    "exp": "Exp",
    "log": "Log",
    "tanh": "Tanh",
    "logistic": "Sigmoid",
    "tan": "Tan",
    "sqrt": "Sqrt",
    "abs": "Abs",
    "neg": "Neg",
    "sign": "Sign",
    "floor": "Floor",
    "ceil": "Ceil",
    "div": "Div",
    "lt": "Less",
    "le": "LessOrEqual",
    "gt": "Greater",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
    "copy": "Identity",
    "stop_gradient": "Identity",
}
"""Primitives that are one operator."""


def aval(variable: Atom) -> ShapedArray:
    """What JAX knows of an input or output of an equation: all are arrays."""
    return cast(ShapedArray, variable.aval)


def described(traced: ShapedArray | jax.ShapeDtypeStruct) -> Array:
    """Dtype and shape of what JAX has traced."""
    shape = tuple(n if isinstance(n, int) else str(n) for n in traced.shape)
    return traced.dtype.name, shape


class Operators:
    """Builds the operators of a primitive: method `_NAME(equation, *inputs)`, by names of arrays.

    Attributes:
      build: builds the graph.
      sizes: names of the numbers that hold the sizes of named axes.
    """

    def __init__(self, build: Builder, sizes: Mapping[str, str]):
        self.build = build
        self.sizes = sizes

    # Sizes.

    def size(self, size: Size) -> str:
        """The name of a number that holds the size of an axis, int64."""
        return self._expression(ast.parse(str(size).replace("^", "**"), mode="eval").body)

    def _expression(self, tree: ast.expr) -> str:
        """A polynomial in sizes, such as `2*pois + 1`."""
        operators: dict[type, str] = {ast.Add: "Add", ast.Sub: "Sub", ast.Mult: "Mul"}
        match tree:
            case ast.Constant(value=int(value)):
                return self.build.constant(np.int64(value))
            case ast.Name(id=name) if name in self.sizes:
                return self.sizes[name]
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self.build.op("Neg", self._expression(operand))
            case ast.BinOp(left=left, op=ast.Pow(), right=ast.Constant(value=int(power))):
                factors = [self._expression(left)] * power
                return functools.reduce(lambda x, y: self.build.op("Mul", x, y), factors)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in operators:
                sides = self._expression(left), self._expression(right)
                return self.build.op(operators[type(op)], *sides)
        raise NotImplementedError(f"the size {ast.unparse(tree)} has no ONNX translation")

    def shape(self, sizes: Sequence[Size]) -> str:
        """The name of a list of sizes, int64."""
        if all(isinstance(size, (int, np.integer)) for size in sizes):
            return self.build.integers(*sizes)
        axis = self.build.integers(0)
        return self.build.op(
            "Concat", *(self.build.op("Unsqueeze", self.size(n), axis) for n in sizes), axis=0
        )

    def _dim_as_value(self, equation: JaxprEqn) -> str:
        return self.cast(self.size(equation.params["dim"]), aval(equation.outvars[0]).dtype)

    # Numbers.

    def cast(self, x: str, dtype: DTypeLike) -> str:
        """An array with another dtype."""
        return self.build.op("Cast", x, to=np.dtype(dtype).name)

    def _convert_element_type(self, equation: JaxprEqn, x: str) -> str:
        before, after = aval(equation.invars[0]).dtype, equation.params["new_dtype"]
        return x if before == after else self.cast(x, after)

    def _ne(self, equation: JaxprEqn, x: str, y: str) -> str:
        return self.build.op("Not", self.build.op("Equal", x, y))

    def _is_finite(self, equation: JaxprEqn, x: str) -> str:
        odd = self.build.op("Or", self.build.op("IsNaN", x), self.build.op("IsInf", x))
        return self.build.op("Not", odd)

    def _and(self, equation: JaxprEqn, x: str, y: str) -> str:
        return self._of_bools("And", equation, x, y)

    def _or(self, equation: JaxprEqn, x: str, y: str) -> str:
        return self._of_bools("Or", equation, x, y)

    def _not(self, equation: JaxprEqn, x: str) -> str:
        return self._of_bools("Not", equation, x)

    def _of_bools(self, operator: str, equation: JaxprEqn, *given: str) -> str:
        if aval(equation.invars[0]).dtype != bool:
            raise NotImplementedError(f"{operator} of bits has no ONNX translation")
        return self.build.op(operator, *given)

    def _rem(self, equation: JaxprEqn, x: str, y: str) -> str:
        return self.build.op("Mod", x, y, fmod=1)

    def _clamp(self, equation: JaxprEqn, least: str, x: str, most: str) -> str:
        return self.build.op("Min", self.build.op("Max", x, least), most)

    def _round(self, equation: JaxprEqn, x: str) -> str:
        if equation.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            raise NotImplementedError("rounding away from zero has no ONNX translation")
        return self.build.op("Round", x)

    def _square(self, equation: JaxprEqn, x: str) -> str:
        return self.build.op("Mul", x, x)

    def _rsqrt(self, equation: JaxprEqn, x: str) -> str:
        return self.build.op("Reciprocal", self.build.op("Sqrt", x))

    def _integer_pow(self, equation: JaxprEqn, x: str) -> str:
        power = equation.params["y"]
        product = functools.reduce(
            lambda y, _: self.build.op("Mul", y, x), range(abs(power) - 1), x
        )
        return product if power > 0 else self.build.op("Reciprocal", product)

    def _atan2(self, equation: JaxprEqn, y: str, x: str) -> str:
        """By the arc tangent of `y / x`, which is one of two half planes."""
        op = self.build.op
        zero, pi = (self.build.constant(np.float32(n)) for n in (0, np.pi))
        half = op("Where", op("Less", y, zero), op("Neg", pi), pi)
        steep = op("Div", half, self.build.constant(np.float32(2)))
        steep = op("Where", op("Equal", y, zero), zero, steep)
        angle = op("Atan", op("Div", y, x))
        behind = op("Where", op("Less", x, zero), op("Add", angle, half), angle)
        return op("Where", op("Equal", x, zero), steep, behind)

    def _select_n(self, equation: JaxprEqn, which: str, *cases: str) -> str:
        if len(cases) != 2 or aval(equation.invars[0]).dtype != bool:
            raise NotImplementedError("a choice among more than two has no ONNX translation")
        if aval(equation.invars[1]).dtype != bool:
            return self.build.op("Where", which, cases[1], cases[0])
        # Runtimes choose no bool.
        op = self.build.op
        return op("Or", op("And", which, cases[1]), op("And", op("Not", which), cases[0]))

    # Shapes.

    def _iota(self, equation: JaxprEqn) -> str:
        shape, axis = equation.params["shape"], equation.params["dimension"]
        numbers = self.cast(self.range(shape[axis]), equation.params["dtype"])
        return self.broadcast(numbers, shape[axis : axis + 1], shape, (axis,))

    def range(self, size: Size) -> str:
        """The numbers from 0 below a size, int64."""
        first, step = self.build.constant(np.int64(0)), self.build.constant(np.int64(1))
        return self.build.op("Range", first, self.size(size), step)

    def _broadcast_in_dim(self, equation: JaxprEqn, x: str, *_: str) -> str:
        before, shape = aval(equation.invars[0]).shape, equation.params["shape"]
        return self.broadcast(x, before, shape, equation.params["broadcast_dimensions"])

    def broadcast(
        self, x: str, before: Sequence[Size], shape: Sequence[Size], axes: Sequence[int]
    ) -> str:
        """An array of shape `before` repeated to `shape`, where its axes are `axes`."""
        new = [axis for axis in range(len(shape)) if axis not in axes]
        if new:
            x = self.build.op("Unsqueeze", x, self.build.integers(*new))
        widened = [before[axes.index(a)] if a in axes else 1 for a in range(len(shape))]
        return x if widened == list(shape) else self.build.op("Expand", x, self.shape(shape))

    def _reshape(self, equation: JaxprEqn, x: str, *_: str) -> str:
        return self.build.op("Reshape", x, self.shape(equation.params["new_sizes"]))

    def _squeeze(self, equation: JaxprEqn, x: str) -> str:
        return self.without(x, equation.params["dimensions"])

    def without(self, x: str, axes: Sequence[int]) -> str:
        """An array less axes of size 1."""
        return self.build.op("Squeeze", x, self.build.integers(*axes)) if len(axes) else x

    def _transpose(self, equation: JaxprEqn, x: str) -> str:
        return self.permuted(x, equation.params["permutation"])

    def permuted(self, x: str, axes: Sequence[int]) -> str:
        """An array with its axes in another order."""
        axes = [int(axis) for axis in axes]
        return x if axes == sorted(axes) else self.build.op("Transpose", x, perm=axes)

    def _concatenate(self, equation: JaxprEqn, *parts: str) -> str:
        return self.build.op("Concat", *parts, axis=int(equation.params["dimension"]))

    def _stack(self, equation: JaxprEqn, *parts: str) -> str:
        axis = int(equation.params["axis"])
        parts = tuple(self.build.op("Unsqueeze", x, self.build.integers(axis)) for x in parts)
        return self.build.op("Concat", *parts, axis=axis)

    def _split(self, equation: JaxprEqn, x: str) -> Sequence[str]:
        sizes, axis = equation.params["sizes"], int(equation.params["axis"])
        return self.build.ops("Split", len(sizes), x, self.build.integers(*sizes), axis=axis)

    def _slice(self, equation: JaxprEqn, x: str) -> str:
        params = equation.params
        starts, ends = self.shape(params["start_indices"]), self.shape(params["limit_indices"])
        steps = params["strides"] or [1] * len(params["start_indices"])
        axes = self.build.integers(*range(len(steps)))
        return self.build.op("Slice", x, starts, ends, axes, self.build.integers(*steps))

    def _dynamic_slice(self, equation: JaxprEqn, x: str, *starts: str) -> str:
        sizes, shape = equation.params["slice_sizes"], aval(equation.invars[0]).shape
        return self.window(x, shape, dict(enumerate(starts)), sizes)

    def window(
        self, x: str, shape: Sequence[Size], starts: Mapping[int, str], sizes: Sequence[Size]
    ) -> str:
        """A slice from starts on some axes that are moved inside, as XLA does."""
        axes = self.build.integers(0)
        for axis, start in starts.items():
            if sizes[axis] == shape[axis]:
                continue
            first = self.inside(start, shape[axis], sizes[axis])
            last = self.build.op("Add", first, self.size(sizes[axis]))
            ends = (self.build.op("Unsqueeze", n, axes) for n in (first, last))
            x = self.build.op("Slice", x, *ends, self.build.integers(axis))
        return x

    def inside(self, index: str, size: Size, window: Size = 1) -> str:
        """The index where a window starts, moved into the axis if it is not inside."""
        op = self.build.op
        last = op("Sub", self.size(size), self.size(window))
        index = op("Min", self.cast(index, np.int64), last)
        return op("Max", index, self.build.constant(np.int64(0)))

    # Reductions.

    def reduced(self, operator: str, equation: JaxprEqn, x: str) -> str:
        """An array reduced along the axes of an equation."""
        axes = self.build.integers(*equation.params["axes"])
        return self.build.op(operator, x, axes, keepdims=0) if len(equation.params["axes"]) else x

    def _reduce_sum(self, equation: JaxprEqn, x: str) -> str:
        return self.reduced("ReduceSum", equation, x)

    def _reduce_max(self, equation: JaxprEqn, x: str) -> str:
        return self.reduced("ReduceMax", equation, x)

    def _reduce_min(self, equation: JaxprEqn, x: str) -> str:
        return self.reduced("ReduceMin", equation, x)

    def _reduce_and(self, equation: JaxprEqn, x: str) -> str:
        return self.cast(self.reduced("ReduceMin", equation, self.cast(x, np.int32)), bool)

    def _reduce_or(self, equation: JaxprEqn, x: str) -> str:
        return self.cast(self.reduced("ReduceMax", equation, self.cast(x, np.int32)), bool)

    def _argmax(self, equation: JaxprEqn, x: str) -> str:
        return self.best("ArgMax", equation, x)

    def _argmin(self, equation: JaxprEqn, x: str) -> str:
        return self.best("ArgMin", equation, x)

    def best(self, operator: str, equation: JaxprEqn, x: str) -> str:
        """Index of the first maximum or minimum along an axis."""
        (axis,) = equation.params["axes"]
        found = self.build.op(operator, x, axis=int(axis), keepdims=0)
        return self.cast(found, equation.params["index_dtype"])

    def _dot_general(self, equation: JaxprEqn, x: str, y: str) -> str:
        (of_x, of_y), (batch_x, batch_y) = equation.params["dimension_numbers"]
        letters = iter("abcdefghijklmnopqrstuvwxyz")
        left = [next(letters) for _ in aval(equation.invars[0]).shape]
        right = [next(letters) for _ in aval(equation.invars[1]).shape]
        for i, j in zip([*of_x, *batch_x], [*of_y, *batch_y], strict=True):
            right[j] = left[i]
        both = [left[i] for i in batch_x]
        summed = [left[i] for i in of_x]
        free_x = [n for n in left if n not in both + summed]
        free_y = [n for n in right if n not in both + summed]
        if len(summed) == 1 and len(free_y) <= 1 and (not both or len(free_x) == len(free_y) == 1):
            x = self.permuted(x, [left.index(n) for n in both + free_x + summed])
            y = self.permuted(y, [right.index(n) for n in both + summed + free_y])
            # As a matrix: onnxruntime 1.32 multiplies a transposed matrix and a vector wrongly.
            vector = [axis for axis, free in ((-2, free_x), (-1, free_y)) if not free]
            x = x if free_x else self.build.op("Unsqueeze", x, self.build.integers(0))
            y = y if free_y else self.build.op("Unsqueeze", y, self.build.integers(1))
            return self.without(self.build.op("MatMul", x, y), vector)
        result = "".join(both + free_x + free_y)
        sides = f"{''.join(left)},{''.join(right)}->{result}"
        return self.build.op("Einsum", x, y, equation=sides)
