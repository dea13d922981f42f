"""A stage of a training: a name and pure functions, which `learn` and a run both call."""

import dataclasses
import zlib
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxsense.config import Config
from jaxsense.core.types import Key, pytree

_MAX_CHUNKS = 20

Output = PyTree
"""A pytree of arrays."""

Outputs = dict[str, Output]
"""The outputs of stages, by name."""


@pytree
class Progress:
    """Loss and metrics of some steps of a training.

    Attributes:
      loss: `[steps]`; NaN where an input or a parameter of the step is not finite.
      metrics: `[steps]` each; NaN where a step has none.
    """

    loss: Float[Array, "..."]
    metrics: dict[str, Float[Array, "..."]]


def _no_progress(*_: Output, **__: Output) -> tuple[Output, Progress]:
    """`advance` of a stage without steps."""
    raise TypeError("a stage without steps does not advance")


def _whole(config: Config, output: Output) -> Output:
    """`divide` of a stage whose output stays as it is."""
    del config
    return output


def _state(config: Config, state: Output, **_: Output) -> Output:
    """`finish` of a stage whose output is its state."""
    del config
    return state


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """One stage of a training.

    Attributes:
      name: determines the random keys of the stage.
      begin: `(key, config, **inputs) -> state`, the output of a stage without chunks.
      inputs: for each argument the name of the earlier stage that outputs it, the names of several,
        or a number, which is passed as `[]` int32.
      advance: `(key, config, state, **inputs) -> (state, Progress)`, one chunk of steps.
      finish: `(config, state, **inputs) -> output`.
      steps: number of steps.
      chunks: number of calls of `advance`; the last one may have fewer steps.
      is_optional: whether the stage may diverge, because a later one picks a finite one of several.
      is_passing: whether only other stages need the output, so that a run holds it no longer than
        they do.
      is_kept: whether a run saves the output although the stage has no chunks.
      has_rows: whether inputs and output have independent rows, which devices can share.
      runs_long: whether a run compiles the chunks as programs that run much longer than they
        compile.
      shares: the name under which stages with the same functions share their programs; by default
        the stage has its own.
      divide: `(config, output of begin) -> output`, for stages without chunks. It only slices rows,
        and a run calls it on the host, where slices are no copies.
    """

    name: str
    begin: Callable[..., Output]
    inputs: Mapping[str, str | tuple[str, ...] | int] = dataclasses.field(default_factory=dict)
    advance: Callable[..., tuple[Output, Progress]] = _no_progress
    finish: Callable[..., Output] = _state
    steps: int = 0
    chunks: int = 0
    is_optional: bool = False
    is_passing: bool = False
    is_kept: bool = False
    has_rows: bool = False
    runs_long: bool = False
    shares: str = ""
    divide: Callable[[Config, Output], Output] = _whole

    @property
    def program(self) -> str:
        """Name of the stage's programs."""
        return self.shares or self.name

    @property
    def is_saved(self) -> bool:
        """Whether a run saves the output, and does not repeat the stage when it resumes."""
        return self.chunks > 0 or self.is_kept

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the stages whose outputs are inputs."""
        named = [x for x in self.inputs.values() if not isinstance(x, int)]
        return tuple(n for x in named for n in ((x,) if isinstance(x, str) else x))

    def key(self, key: Key) -> Key:
        """Key of `begin`, from the key of a training."""
        return jax.random.fold_in(key_of(key, self.name), 0)

    def chunk_keys(self, key: Key) -> Key:
        """Keys of `advance`, `[chunks]`, from the key of a training."""
        own = key_of(key, self.name)
        return jax.vmap(lambda i: jax.random.fold_in(own, i))(1 + jnp.arange(self.chunks))

    def select(self, outputs: Mapping[str, Output]) -> dict[str, Output]:
        """Inputs by argument, from the outputs of earlier stages by name."""
        return {argument: _input(source, outputs) for argument, source in self.inputs.items()}


def _input(source: str | tuple[str, ...] | int, outputs: Mapping[str, Output]) -> Output:
    # Not a function inside `select`: it would hold the outputs, and refer to itself.
    if isinstance(source, int):
        return jnp.int32(source)
    if isinstance(source, str):
        return outputs[source]
    return tuple(_input(each, outputs) for each in source)


@pytree
class Learned:
    """Result of `learn`: the outputs of all stages, and their losses.

    Attributes:
      outputs: of every stage, by its name.
      progress: `[steps]` of every stage that has steps, by its name.
      is_finite: `[]` bool, whether all losses and outputs are finite; optional stages are ignored.
    """

    outputs: Outputs
    progress: dict[str, Progress]
    is_finite: Bool[Array, ""]


def compose(key: Key, config: Config, stages: Sequence[Stage]) -> Learned:
    """Composes stages into one training, with a `scan` over the chunks of each.

    Args:
      key: of the training.
      config: all settings.
      stages: each after the stages whose outputs it takes.
    """
    outputs, progress = Outputs(), dict[str, Progress]()
    finite = [jnp.bool_(True)]
    for stage in stages:
        inputs = stage.select(outputs)
        state = stage.divide(config, stage.begin(stage.key(key), config, **inputs))
        if stage.chunks:

            def advance(state: Output, key: Key) -> tuple[Output, Progress]:
                return stage.advance(key, config, state, **inputs)  # noqa: B023

            state, chunks = jax.lax.scan(advance, state, stage.chunk_keys(key))
            whole = jax.tree.map(lambda x: x.reshape(-1)[: stage.steps], chunks)  # noqa: B023
            progress[stage.name] = whole
        outputs[stage.name] = stage.finish(config, state, **inputs)
        if not stage.is_optional:
            losses = progress[stage.name].loss if stage.chunks else ()
            finite.append(is_finite((outputs[stage.name], losses)))
    return Learned(outputs, progress, jnp.stack(finite).all())


def key_of(key: Key, name: str) -> Key:
    """Random key that depends on a name.

    Args:
      key: of a training.
      name: for example of a stage.
    """
    return jax.random.fold_in(key, zlib.crc32(name.encode()))


def chunk_size(steps: int) -> int:
    """Number of steps in a chunk, for at most 20 chunks."""
    return -(-steps // _MAX_CHUNKS)


def num_chunks(steps: int) -> int:
    """Number of chunks of `chunk_size` steps."""
    return -(-steps // chunk_size(steps))


def is_finite(values: Output) -> Bool[Array, ""]:
    """Whether all floating-point numbers in a pytree are finite."""
    leaves = [x for x in jax.tree.leaves(values) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    return jnp.stack([jnp.isfinite(x).all() for x in leaves] or [jnp.bool_(True)]).all()
