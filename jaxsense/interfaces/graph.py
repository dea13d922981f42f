"""Graphs of ONNX operators, and how they are written as ONNX files."""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsense.interfaces.extras import extra

OPSET, IR_VERSION = 18, 9
"""The version of the operators, and of the file: of December 2022, so that old runtimes read it."""

Array = tuple[str, tuple[int | str, ...]]
"""Dtype and shape of an array; an axis with a name has any size."""

Attribute = int | str | list[int]
"""Of an operator: a number, a name, or axes."""


@dataclasses.dataclass(frozen=True)
class Node:
    """An operator with names of its inputs and outputs; an input that is left out is "".

    A loop or a branch also has graphs.
    """

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Attribute]
    graphs: Mapping[str, "Graph"]

    def read(self) -> set[str]:
        """All names that the operator and those in its graphs read."""
        return set(self.inputs).union(*(graph.read() for graph in self.graphs.values()))

    def pruned(self) -> "Node":
        """The operator with pruned graphs."""
        graphs = {name: graph.pruned() for name, graph in self.graphs.items()}
        return dataclasses.replace(self, graphs=graphs)


@dataclasses.dataclass
class Graph:
    """Operators in their order.

    Attributes:
      inputs: dtype and shape of each, by name.
      outputs: names.
      nodes: operators; those of a loop also read names of the graph around it.
    """

    inputs: dict[str, Array] = dataclasses.field(default_factory=dict)
    outputs: list[str] = dataclasses.field(default_factory=list)
    nodes: list[Node] = dataclasses.field(default_factory=list)

    def read(self) -> set[str]:
        """All names that operators of the graph, and of those within it, read."""
        return set(self.outputs).union(*(node.read() for node in self.nodes))

    def pruned(self) -> "Graph":
        """The graph without operators whose outputs nobody reads."""
        wanted, kept = set(self.outputs), []
        for node in reversed(self.nodes):
            if not wanted.isdisjoint(node.outputs):
                kept.append(node.pruned())
                wanted |= kept[-1].read()
        return dataclasses.replace(self, nodes=kept[::-1])


class Constants:
    """Arrays by name, each kept once, and new names."""

    def __init__(self, named: Mapping[str, np.ndarray]):
        self.arrays = dict(named)
        self._numbers = itertools.count()
        self._known: dict[object, str] = {}

    def name(self) -> str:
        """A name that nothing else has."""
        return f"x{next(self._numbers)}"

    def constant(self, value: np.ndarray) -> str:
        """The name of an array."""
        key = value.dtype.name, value.shape, value.tobytes()
        if key not in self._known:
            self._known[key] = self.name()
            self.arrays[self._known[key]] = value
        return self._known[key]


class Builder:
    """Builds a graph, or one within it; an operator on the same inputs is taken once.

    Attributes:
      constants: of all graphs.
      graph: the graph so far.
    """

    def __init__(self, constants: Constants, around: "Builder | None" = None):
        self.constants = constants
        self.graph = Graph()
        self._around = around
        self._known: dict[object, str] = {}

    def constant(self, value: np.ndarray | np.generic) -> str:
        """The name of an array."""
        return self.constants.constant(np.asarray(value))

    def integers(self, *values: int) -> str:
        """The name of a list of int64, as operators take axes and shapes."""
        return self.constant(np.array(values, np.int64))

    def op(self, operator: str, *inputs: str, **attributes: Attribute) -> str:
        """Applies an operator with one output, and returns its name."""
        key = operator, inputs, repr(sorted(attributes.items()))
        scope: Builder | None = self
        while scope is not None:
            if key in scope._known:
                return scope._known[key]
            scope = scope._around
        (self._known[key],) = self.ops(operator, 1, *inputs, **attributes)
        return self._known[key]

    def ops(
        self, operator: str, number: int, *inputs: str, **attributes: Attribute
    ) -> tuple[str, ...]:
        """Applies an operator with some number of outputs, and returns their names."""
        return self._add(operator, number, inputs, attributes, {})

    def control(self, operator: str, number: int, *inputs: str, **graphs: Graph) -> tuple[str, ...]:
        """Applies a loop or a branch, and returns the names of its outputs."""
        return self._add(operator, number, inputs, {}, graphs)

    def _add(
        self,
        operator: str,
        number: int,
        inputs: tuple[str, ...],
        attributes: dict[str, Attribute],
        graphs: dict[str, Graph],
    ) -> tuple[str, ...]:
        outputs = tuple(self.constants.name() for _ in range(number))
        self.graph.nodes.append(Node(operator, inputs, outputs, attributes, graphs))
        return outputs


def as_onnx(
    name: str,
    about: str,
    graph: Graph,
    constants: Mapping[str, np.ndarray],
    of_outputs: Mapping[str, Array],
) -> bytes:
    """A graph as an ONNX file, checked.

    Args:
      name: of the graph.
      about: what it does.
      graph: the graph.
      constants: all arrays that it reads.
      of_outputs: each output by its name in the file, in the order of `graph.outputs`.

    Raises:
      ModuleNotFoundError: if `onnx` is not installed.
    """
    with extra("export"):
        import onnx  # noqa: PLC0415
        from onnx import checker, helper, numpy_helper  # noqa: PLC0415

    def described(name: str, dtype: str, shape: tuple[int | str, ...]) -> onnx.ValueInfoProto:
        kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        return helper.make_tensor_value_info(name, kind, shape)

    def node(each: Node) -> onnx.NodeProto:
        graphs = {
            key: helper.make_graph(
                [node(x) for x in within.nodes],
                key,
                [described(x, *each) for x, each in within.inputs.items()],
                [helper.make_empty_tensor_value_info(x) for x in within.outputs],
            )
            for key, within in each.graphs.items()
        }
        attributes: dict[str, Any] = {**each.attributes, **graphs}
        if each.operator == "Cast":
            attributes["to"] = helper.np_dtype_to_tensor_dtype(np.dtype(attributes["to"]))
        return helper.make_node(each.operator, each.inputs, each.outputs, **attributes)

    renamed = [
        helper.make_node("Identity", [internal], [external])
        for internal, external in zip(graph.outputs, of_outputs, strict=True)
    ]
    read = graph.read()
    whole = helper.make_graph(
        [*map(node, graph.nodes), *renamed],
        name.replace("+", "_"),
        [described(key, *each) for key, each in graph.inputs.items()],
        [described(key, *each) for key, each in of_outputs.items()],
        [numpy_helper.from_array(x, key) for key, x in constants.items() if key in read],
        doc_string=about,
    )
    model = helper.make_model(
        whole,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="jaxsense",
    )
    checker.check_model(model)
    return model.SerializeToString()
