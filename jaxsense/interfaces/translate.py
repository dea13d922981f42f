"""Translates what JAX has traced into graphs of ONNX operators, primitive by primitive.

The graph of a function follows from the function itself, so that a new fusion, sensor or policy
needs no line here, unless it uses a primitive that has no translation yet.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Atom, ShapedArray
from jax.extend import core
from jax.lax import GatherScatterMode
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxsense.interfaces.graph import Array, Builder, Constants, Graph
from jaxsense.interfaces.operators import SAME, Operators, Size, aval, described

_INLINED = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")


class Translator(Operators):
    """Translates the equations of a function, also those that take indices, and loops."""

    def run(
        self, jaxpr: core.Jaxpr, consts: Sequence[ArrayLike | str], inputs: Sequence[str]
    ) -> list[str]:
        """Translates all equations, and returns the names of the outputs.

        Args:
          jaxpr: what was traced.
          consts: its constants, arrays or names.
          inputs: names of its inputs.

        Raises:
          NotImplementedError: if a primitive has no translation.
        """
        names: dict[core.Var, ArrayLike | str] = dict(zip(jaxpr.constvars, consts, strict=True))
        names |= dict(zip(jaxpr.invars, inputs, strict=True))

        def read(variable: Atom) -> str:
            value = variable.val if isinstance(variable, core.Literal) else names[variable]
            if isinstance(value, str):
                return value
            return self.build.constant(np.asarray(value, described(aval(variable))[0]))

        for equation in jaxpr.eqns:
            # An input that nobody reads, such as a random key, may have no name.
            given = [read(v) if _is_array(v) else "" for v in equation.invars]
            outputs = self._equation(equation, given)
            names |= dict(zip(equation.outvars, outputs, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _equation(self, equation: core.JaxprEqn, given: list[str]) -> Sequence[str]:
        kind, params = equation.primitive.name, equation.params
        if kind in _INLINED:
            closed = params.get("jaxpr") or params["call_jaxpr"]
            return self._closed(closed, given)
        if kind in SAME:
            return [self.build.op(SAME[kind], *given)]
        translate = getattr(self, f"_{kind.replace('-', '_')}", None)
        if translate is None:
            raise NotImplementedError(f"the primitive {kind} has no ONNX translation")
        found = translate(equation, *given)
        return [found] if isinstance(found, str) else found

    def _closed(self, closed: core.ClosedJaxpr, given: Sequence[str]) -> list[str]:
        return self.run(closed.jaxpr, closed.consts, given)

    # Indices.

    def _gather(self, equation: core.JaxprEqn, x: str, indices: str) -> str:
        numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
        shape, rank = aval(equation.invars[0]).shape, len(aval(equation.invars[1]).shape)
        mapped = [int(axis) for axis in numbers.start_index_map]
        dropped = [int(axis) for axis in numbers.collapsed_slice_dims]
        if equation.params["mode"] == GatherScatterMode.FILL_OR_DROP:
            raise NotImplementedError("gather that fills has no ONNX translation")
        if rank == 1:
            starts = {axis: self.component(indices, 0, i) for i, axis in enumerate(mapped)}
            return self.without(self.window(x, shape, starts, sizes), dropped)
        batched = [int(axis) for axis in numbers.operand_batching_dims]
        together = [int(axis) for axis in numbers.start_indices_batching_dims]
        # A whole axis starts at 0 wherever it is told to.
        moved = [axis for axis in mapped if sizes[axis] != shape[axis] or axis in dropped]
        moved = moved or mapped[:1]
        wide = [axis for axis in moved if sizes[axis] != 1]
        rest = [axis for axis in range(len(shape)) if axis not in moved + batched]
        leading = [*together, *(axis for axis in range(rank - 1) if axis not in together)]
        indices = self.permuted(indices, [*leading, rank - 1])
        of_batch = [aval(equation.invars[1]).shape[axis] for axis in leading]
        grid = self.shape([*of_batch, *(sizes[axis] for axis in wide)])
        parts = []
        for axis in moved:
            start = self.component(indices, rank - 1, mapped.index(axis))
            part = self.inside(start, shape[axis], sizes[axis])
            if wide:
                part = self.build.op("Unsqueeze", part, self.build.integers(*range(-len(wide), 0)))
            if axis in wide:
                after = range(1, len(wide) - wide.index(axis))
                steps = self.range(sizes[axis])
                steps = self.build.op("Unsqueeze", steps, self.build.integers(*after))
                part = self.build.op("Add", part, steps)
            part = self.build.op("Expand", part, grid)
            parts.append(self.build.op("Unsqueeze", part, self.build.integers(-1)))
        x = self.permuted(x, batched + moved + rest)
        index = self.build.op("Concat", *parts, axis=-1)
        found = self.build.op("GatherND", x, index, batch_dims=len(batched))
        # Axes of size 1 that were taken, and are not dropped, come back at the end.
        kept = [axis for axis in range(len(shape)) if axis not in dropped + batched]
        single = [axis for axis in kept if axis in moved and axis not in wide]
        of_window = [*wide, *rest, *single]
        if single:
            ends = range(rank - 1 + len(wide + rest), rank - 1 + len(of_window))
            found = self.build.op("Unsqueeze", found, self.build.integers(*ends))
        batch = iter([leading.index(axis) for axis in range(rank - 1)])
        window = iter([rank - 1 + of_window.index(axis) for axis in kept])
        offset = [int(axis) for axis in numbers.offset_dims]
        order = [next(window if n in offset else batch) for n in range(rank - 1 + len(kept))]
        return self.permuted(found, order)

    def component(self, indices: str, axis: int, i: int) -> str:
        """One number of each index."""
        return self.build.op("Gather", indices, self.build.constant(np.int64(i)), axis=axis)

    def _scatter(self, equation: core.JaxprEqn, x: str, indices: str, updates: str) -> str:
        return self._scattered(equation, x, indices, lambda old: updates)

    def _scatter_add(self, equation: core.JaxprEqn, x: str, indices: str, updates: str) -> str:
        return self._scattered(equation, x, indices, lambda old: self.build.op("Add", old, updates))

    def _scattered(
        self, equation: core.JaxprEqn, x: str, indices: str, new: Callable[[str], str]
    ) -> str:
        """Changes one row, along one axis, unless the row does not exist."""
        numbers, shape = equation.params["dimension_numbers"], aval(equation.invars[0]).shape
        mapped = [int(axis) for axis in numbers.scatter_dims_to_operand_dims]
        is_one = len(mapped) == 1 and [*map(int, numbers.inserted_window_dims)] == mapped
        if not is_one or len(aval(equation.invars[1]).shape) != 1 or numbers.operand_batching_dims:
            raise NotImplementedError("scatter of several rows has no ONNX translation")
        op, (axis,) = self.build.op, mapped
        row = self.cast(self.component(indices, 0, 0), np.int64)
        old = op("Gather", x, self.inside(row, shape[axis]), axis=axis)
        is_row = op("Equal", self.range(shape[axis]), row)
        after = [n for n in range(len(shape)) if n != axis]
        if after:
            is_row = op("Unsqueeze", is_row, self.build.integers(*after))
        value = op("Unsqueeze", new(old), self.build.integers(axis))
        if aval(equation.invars[0]).dtype == bool:
            return op("Or", op("And", is_row, value), op("And", op("Not", is_row), x))
        return op("Where", is_row, value, x)

    # Loops and branches.

    def _platform_index(self, equation: core.JaxprEqn) -> str:
        platforms = equation.params["platforms"]
        return self.build.constant(np.int32(platforms.index(None)))

    def _cond(self, equation: core.JaxprEqn, index: str, *given: str) -> Sequence[str]:
        branches, arrays = equation.params["branches"], self.build.constants.arrays
        if index in arrays:
            return self._closed(branches[int(arrays[index])], given)
        if len(branches) != 2:
            raise NotImplementedError("a choice among more than two has no ONNX translation")
        no, yes = (
            self._within({}, lambda inner, branch=branch: inner._closed(branch, given))
            for branch in branches
        )
        is_second = self.cast(index, bool)
        number = len(equation.outvars)
        return self.build.control("If", number, is_second, then_branch=yes, else_branch=no)

    def _within(
        self, inputs: dict[str, Array], body: Callable[["Translator"], Sequence[str]]
    ) -> Graph:
        """A graph within this one, of which each output has a name of its own."""
        build = Builder(self.build.constants, self.build)
        build.graph.inputs = inputs
        outputs = body(Translator(build, self.sizes))
        build.graph.outputs = [build.ops("Identity", 1, name)[0] for name in outputs]
        return build.graph

    def _loop(
        self,
        equation: core.JaxprEqn,
        most: str,
        goes_on: str,
        carry: Sequence[str],
        avals: Sequence[ShapedArray],
        body: Callable[["Translator", str, list[str]], Sequence[str]],
    ) -> Sequence[str]:
        """ONNX's loop; `body(inner, step, carry)` gives whether it continues, carry and rows."""
        kinds: list[Array] = [("int64", ()), ("bool", ()), *map(described, avals)]
        inputs = {self.build.constants.name(): kind for kind in kinds}
        step, _, *within = inputs
        graph = self._within(inputs, lambda inner: body(inner, step, within))
        return self.build.control("Loop", len(equation.outvars), most, goes_on, *carry, body=graph)

    def _scan(self, equation: core.JaxprEqn, *given: str) -> Sequence[str]:
        params = equation.params
        if params["reverse"]:
            raise NotImplementedError("a scan from the end has no ONNX translation")
        inner, before, after = params["jaxpr"], equation.invars, equation.outvars
        # What moves along has one axis more outside; versions of JAX name the numbers otherwise.
        rows = sum(aval(v).ndim > x.ndim for v, x in zip(before, inner.in_avals, strict=True))
        number = sum(aval(v).ndim == x.ndim for v, x in zip(after, inner.out_avals, strict=True))
        last = len(before) - rows
        first = last - number
        consts, carry, moving = given[:first], given[first:last], given[last:]
        true = self.build.constant(np.bool_(True))

        def body(inner: "Translator", step: str, carry: list[str]) -> Sequence[str]:
            of_step = [inner.build.op("Gather", row, step, axis=0) for row in moving]
            return [true, *inner._closed(params["jaxpr"], [*consts, *carry, *of_step])]

        avals = [aval(v) for v in before[first:last]]
        return self._loop(equation, self.size(params["length"]), true, carry, avals, body)

    def _while(self, equation: core.JaxprEqn, *given: str) -> Sequence[str]:
        params = equation.params
        first, last = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        of_cond, of_body, carry = given[:first], given[first:last], given[last:]
        goes_on = self._closed(params["cond_jaxpr"], [*of_cond, *carry])[0]

        def body(inner: "Translator", step: str, carry: list[str]) -> Sequence[str]:
            after = inner._closed(params["body_jaxpr"], [*of_body, *carry])
            return [*inner._closed(params["cond_jaxpr"], [*of_cond, *after]), *after]

        avals = [aval(v) for v in equation.invars[last:]]
        return self._loop(equation, "", goes_on, carry, avals, body)


@dataclasses.dataclass(frozen=True)
class Program:
    """A translated function.

    Attributes:
      graph: its operators; outputs in the order of `outputs`.
      outputs: dtype and shape of each output, by name; an axis with a name has any size.
    """

    graph: Graph
    outputs: dict[str, Array]


def program(
    apply: Callable[..., dict[str, jax.Array]],
    models: PyTree,
    inputs: Mapping[str, Array],
    constants: Constants,
) -> Program:
    """Translates a function.

    Args:
      apply: `(models, *inputs) -> {name: output}`.
      models: a pytree.
      inputs: dtype and shape of each input, by name; an axis with a name has any size, at least 1.
      constants: those of `arrays_of(models)`, which get more.

    Raises:
      NotImplementedError: if a primitive of the function has no translation.
    """
    named = sorted({n for _, shape in inputs.values() for n in shape if isinstance(n, str)})
    axes = export.symbolic_shape(", ".join(named), constraints=[f"{n} >= 1" for n in named])
    of_name: dict[int | str, Size] = dict(zip(named, axes, strict=True))
    given = [
        jax.ShapeDtypeStruct(tuple(of_name.get(n, n) for n in shape), dtype)
        for dtype, shape in inputs.values()
    ]
    models = jax.tree.map(_array, models)
    closed, found = jax.make_jaxpr(apply, return_shape=True)(models, *given)
    build = Builder(constants)
    build.graph.inputs = dict(inputs)
    sizes = {}
    for name, (_, shape) in inputs.items():
        for axis, size in enumerate(shape):
            if isinstance(size, str) and size not in sizes:
                whole, which = build.op("Shape", name), build.constant(np.int64(axis))
                sizes[size] = build.op("Gather", whole, which, axis=0)
    names = [*arrays_of(models), *inputs]
    build.graph.outputs = Translator(build, sizes).run(closed.jaxpr, closed.consts, names)
    outputs = {name: described(x) for name, x in sorted(found.items())}
    return Program(build.graph.pruned(), outputs)


def arrays_of(models: PyTree) -> dict[str, np.ndarray]:
    """All arrays of a pytree, by their place in it, for example `"novelty/strength"`.

    Args:
      models: the pytree.
    """
    leaves = jax.tree_util.tree_leaves_with_path(jax.tree.map(_array, models))
    return {jax.tree_util.keystr(path, simple=True, separator="/"): x for path, x in leaves}


def _array(x: ArrayLike) -> np.ndarray:
    x = np.asarray(x)
    return x.astype(np.float32) if x.dtype == np.float64 else x


def _is_array(variable: Atom) -> bool:
    return not jnp.issubdtype(aval(variable).dtype, jax.dtypes.extended)
