"""Types that `sim`, `vae`, `dqn` and the modules above them share."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree, Shaped

T = TypeVar("T")

Key = jax.Array
"""A typed or legacy JAX random key; the function that takes it consumes it exactly once."""

Index = int | jax.Array
"""A Python integer, or a `[]` int32 array."""

Features = tuple[Float[Array, "_"] | None, ...]
"""`[D_m]` features of each modality, or None where it has not looked."""

Scene = PyTree
"""A pytree that describes what looks see; MDPs only carry it."""

product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
"""Matrix product in full float32, so that an accelerator agrees with a CPU."""

Samples = tuple[Float[Array, "C _ _"], ...]
"""`[C, S, D_m]` features of each modality: S looks at every class."""


@dataclass_transform(frozen_default=True, field_specifiers=(struct.field,))
def pytree(cls: type[T]) -> type[T]:
    """Class decorator: makes a frozen dataclass that is a pytree.

    Fields with `flax.struct.field(pytree_node=False)` are static and may hold any hashable value.
    """
    if not isinstance(cls, type):
        raise ValueError(f"cls = {cls!r}: must be a class")
    made: Any = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(made)
    leaves = [field.name for field in fields if field.metadata.get("pytree_node", True)]
    register(made, leaves, [field.name for field in fields if field.name not in leaves])
    made.replace = dataclasses.replace
    return made


def register(cls: type, leaves: Sequence[str], static: Sequence[str]) -> None:
    """Makes a dataclass a pytree with some leaves; other fields are hashable.

    The class is part of the tree definition: two classes of `jax.tree_util.register_dataclass` with
    equal fields have equal ones, and jax 0.10 then runs one's compiled program with the other.
    Nothing is checked when JAX rebuilds a pytree, because its values may be placeholders.
    """
    keys = [jax.tree_util.GetAttrKey(name) for name in leaves]

    def flatten(tree: object) -> tuple[list, tuple]:
        values = tree.__dict__
        return [values[name] for name in leaves], (cls, *[values[name] for name in static])

    def flatten_with_keys(tree: object) -> tuple[list, tuple]:
        children, aux = flatten(tree)
        return list(zip(keys, children, strict=True)), aux

    def unflatten(aux: tuple, children: Iterable) -> object:
        tree = object.__new__(cls)
        tree.__dict__.update(zip(static, aux[1:], strict=True))
        tree.__dict__.update(zip(leaves, children, strict=True))
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def by_place(tree: PyTree) -> dict[str, Any]:
    """The leaves of a tree by their places in it, such as `detectors/0/threshold`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def placed(shapes: PyTree, arrays: Mapping[str, Any]) -> PyTree[np.ndarray]:
    """A tree like `shapes`, from arrays by their places in it.

    Raises:
      ValueError: if one is missing or has another shape or dtype.
    """

    def leaf(place: str, expected: jax.ShapeDtypeStruct) -> np.ndarray:
        if place not in arrays:
            raise ValueError(f"{place} is missing")
        found = np.asarray(arrays[place])
        if (found.shape, found.dtype) != (expected.shape, expected.dtype):
            wanted = f"{expected.dtype}{expected.shape}"
            raise ValueError(f"{place} is {found.dtype}{found.shape} in place of {wanted}")
        return found

    leaves = [leaf(*each) for each in by_place(shapes).items()]
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


@pytree
class Belief:
    """Belief about a point of interest: a diagonal Gaussian in the latent space.

    May have leading axes, for example `[N]` for a map of N points of interest.

    Attributes:
      mean: `[..., D]` float32, in latent units.
      std: `[..., D]` float32 positive standard deviations, in latent units.
    """

    mean: jax.Array
    std: jax.Array


@pytree
class Reliability:
    """Points of a reliability diagram, one for each of B bins of confidence.

    Attributes:
      confidence: `[B]` mean probability of the most likely label; 0 in an empty bin.
      accuracy: `[B]` share of right labels; 0 in an empty bin.
      looks: `[B]` float32 number of looks.
    """

    confidence: jax.Array
    accuracy: jax.Array
    looks: jax.Array


class Fusion(Protocol):
    """Protocol of a fusion, which updates beliefs with looks; a frozen pytree."""

    @property
    def accumulates(self) -> bool:
        """Whether repeated looks by a sensor add up; otherwise, each replaces the one before."""
        ...

    @property
    def classes(self) -> Belief:
        """Mean joint posterior of each class, `[C, D]`."""
        ...

    @property
    def prior(self) -> Belief:
        """Belief before any look, `[D]`."""
        ...

    def update(
        self,
        belief: Belief,
        seen: Bool[Array | np.ndarray, " M"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Belief:
        """Belief `[D]` after one more look by a modality, a static index.

        Args:
          belief: before the look.
          seen: which modalities have looked before.
          features: probabilities of the labels.
          modality: index of the sensor; static.
          weight: share of the look that is new evidence, see `core.novelty`.
        """
        ...

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """Belief after looks by several sensors together, `[D_m]` features by modality."""
        ...

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class according to a belief."""
        ...


@pytree
class Transition:
    """One transition of an MDP, or a batch of them, from which a Q-network learns.

    Attributes:
      s_tm1: `[S, ...]` float32 observation before the action, see `Agent.observe`.
      a_tm1: `[...]` int32 action, `N` being no operation.
      r_t: `[...]` float32 reward.
      discount_t: `[...]` float32 discount factor, 0 where the episode ended.
      s_t: `[S, ...]` float32 observation after the action.
    """

    s_tm1: jax.Array
    a_tm1: jax.Array
    r_t: jax.Array
    discount_t: jax.Array
    s_t: jax.Array


def within_a_turn(angle: jax.Array) -> jax.Array:
    """Angles wrapped to -pi to pi, in radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def is_static(index: Index) -> bool:
    """Whether an index is known while tracing."""
    return isinstance(index, int | np.integer)


def call(function: Callable[[int], T], index: Index, number: int) -> T:
    """Calls a function of a static index with any index below `number`.

    The program switches between all indices if it is an array; all have results of one shape.
    """
    if is_static(index):
        return function(int(index))
    return jax.lax.switch(index, [functools.partial(function, i) for i in range(number)])


def others(rows: Shaped[Array, "R ..."], index: Index) -> Shaped[Array, "R-1 ..."]:
    """All rows except one, starting with the row after it."""
    number = len(rows)
    return rows[(index + 1 + jnp.arange(number - 1)) % number]
