"""A stage of a training, and the stages that fit a network."""

import dataclasses
import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxsense.config import Config
from jaxsense.core import supervised
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState, Problem
from jaxsense.core.types import Key, pytree

_MAX_CHUNKS = 20

Output = PyTree
"""A pytree of arrays."""

Drive = Callable[..., Output]
"""`(stage, **inputs) -> output` executes a stage; its inputs are outputs of earlier ones."""


@pytree
class Progress:
    """Loss and metrics of some steps of a training.

    Attributes:
      loss: `[steps]`; NaN where an input or a parameter of the step is not finite.
      metrics: `[steps]` each; NaN where a step has none.
    """

    loss: Float[Array, "..."]
    metrics: dict[str, Float[Array, "..."]]


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """One stage of a training.

    Attributes:
      name: determines the random keys of the stage.
      begin: `(key, config, **inputs) -> state`.
      advance: `(key, config, state, **inputs) -> (state, Progress)`, one chunk of steps.
      finish: `(config, state, **inputs) -> output`. Without steps it only slices rows: a run calls
        it on the host, where slices are no copies.
      steps: number of steps.
      chunks: number of calls of `advance`; the last one may have fewer steps.
      is_optional: whether the stage may diverge, because a later one picks a finite one of several.
      shares: the name of the programs of several stages with the same functions; by default the
        stage has its own.
    """

    name: str
    begin: Callable[..., Output]
    advance: Callable[..., tuple[Output, Progress]] | None = None
    finish: Callable[..., Output] = lambda config, state, **inputs: state
    steps: int = 0
    chunks: int = 0
    is_optional: bool = False
    shares: str = ""

    @property
    def program(self) -> str:
        """Name of the stage's programs."""
        return self.shares or self.name

    def key(self, key: Key) -> Key:
        """Key of `begin`, from the key of a training."""
        return jax.random.fold_in(key_of(key, self.name), 0)

    def chunk_keys(self, key: Key) -> Key:
        """Keys of `advance`, `[chunks]`, from the key of a training."""
        own = key_of(key, self.name)
        return jax.vmap(lambda i: jax.random.fold_in(own, i))(1 + jnp.arange(self.chunks))


def scan(
    key: Key, config: Config, stage: Stage, inputs: dict[str, Output]
) -> tuple[Output, Progress | None]:
    """Executes a stage as a pure function, with a `scan` over its chunks."""
    state, progress = stage.begin(stage.key(key), config, **inputs), None
    if (step := stage.advance) is not None:

        def advance(state: Output, key: Key) -> tuple[Output, Progress]:
            return step(key, config, state, **inputs)

        state, chunks = jax.lax.scan(advance, state, stage.chunk_keys(key))
        progress = jax.tree.map(lambda x: x.reshape(-1)[: stage.steps], chunks)
    return stage.finish(config, state, **inputs), progress


@dataclasses.dataclass(frozen=True)
class Fit:
    """How a network is fitted.

    Attributes:
      untrained: `key -> (model, parameters to fit)`.
      problem: `model -> Problem`.
      trained: `(model, FitState) -> output`.
    """

    untrained: Callable[[Key], tuple[Output, Params]]
    problem: Callable[[Any], Problem[Any]]
    trained: Callable[[Any, FitState], Output]

    @classmethod
    def of_params(cls, init: Callable[[Key], Params], problem: Problem[Any]) -> "Fit":
        """Of parameters alone; the output is these and the loss of the last chunk."""
        return cls(
            lambda key: ((), init(key)), lambda _: problem, lambda _, fit: (fit.params, fit.loss)
        )


def fit_stage(name: str, steps: int, fit: Callable[..., Fit]) -> Stage:
    """Makes a stage that fits a network.

    Args:
      fit: `(config, **inputs) -> Fit`, whose problem has these `steps`.
    """
    size = -(-steps // _MAX_CHUNKS)

    def begin(key: Key, config: Config, **inputs: Output) -> tuple[Output, FitState]:
        given = fit(config, **inputs)
        model, params = given.untrained(key)
        return model, supervised.start(params, given.problem(model))

    def advance(
        key: Key, config: Config, state: tuple[Output, FitState], **inputs: Output
    ) -> tuple[tuple[Output, FitState], Progress]:
        model, before = state
        problem = fit(config, **inputs).problem(model)
        after, losses = supervised.fit(key, before, problem, size)
        return (model, after), Progress(losses, {})

    def finish(config: Config, state: tuple[Output, FitState], **inputs: Output) -> Output:
        return fit(config, **inputs).trained(*state)

    return Stage(name, begin, advance, finish, steps, chunks=-(-steps // size))


def restarts(config: Config, fit: Callable[..., Fit]) -> list[Stage]:
    """Makes stages that each train a JMVAE, see `fit_stage`."""
    number = config.jmvae.restarts
    stage = fit_stage("", config.jmvae.steps, fit)
    stage = dataclasses.replace(stage, shares="jmvae", is_optional=number > 1)
    return [dataclasses.replace(stage, name=f"jmvae_{i + 1}") for i in range(number)]


def key_of(key: Key, name: str) -> Key:
    """Random key that depends on a name, for example of a stage."""
    return jax.random.fold_in(key, zlib.crc32(name.encode()))


def is_finite(values: Output) -> Bool[Array, ""]:
    """Whether all floating-point numbers in a pytree are finite."""
    leaves = [x for x in jax.tree.leaves(values) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    return jnp.stack([jnp.isfinite(x).all() for x in leaves] or [jnp.bool_(True)]).all()
