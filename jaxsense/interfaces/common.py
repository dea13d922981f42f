"""Spaces and starts, shared by the interfaces."""

import enum
import os
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.tasks.environment import Environment, OneAgent

E = TypeVar("E", bound=enum.Enum)
B_co = TypeVar("B_co", covariant=True)
D_co = TypeVar("D_co", covariant=True)


class Spaces(Protocol[B_co, D_co]):
    """Another library's module of spaces."""

    @property
    def Box(self) -> Callable[..., B_co]:  # noqa: N802
        """Of an array of numbers within bounds."""
        ...

    @property
    def Discrete(self) -> Callable[..., D_co]:  # noqa: N802
        """Of a number of actions."""
        ...


_processes: set[int] = set()  # in which environments were made: this one and those it forked from


def enter_process() -> None:
    """Notes that an environment was made in this process."""
    _processes.add(os.getpid())


def require_own_process() -> None:
    """Raises `RuntimeError` if this process was forked from one that has made an environment.

    Programs of JAX hang there.
    """
    if _processes - {os.getpid()}:
        advice = "start processes with spawn, as vector_kwargs={'context': 'spawn'} does"
        raise RuntimeError(f"this process was forked from one that uses JAX: {advice}")


def environment(mdp: MapMdp | Environment, modality: int | None) -> Environment:
    """What an interface of one agent plays.

    Args:
      mdp: a task, see `jaxsense.make`, or the map MDP of one agent, see `jaxsense.make_mdp`.
      modality: index of the agent's own sensor; only with an MDP.

    Raises:
      ValueError: if there is no such sensor, or a task has one already.
    """
    if isinstance(mdp, MapMdp):
        checks.require_index("modality", modality, mdp.num_modalities)
        return OneAgent(mdp, modality)  # pyright: ignore[reportArgumentType]
    if modality is not None:
        raise ValueError(f"modality = {modality}: must be None with a task, which has its agent")
    return mdp


def spaces_of(
    spaces: Spaces[B_co, D_co], size: int, num_actions: int, bound: float
) -> tuple[B_co, D_co]:
    """Spaces of observations and of actions.

    Args:
      spaces: another library's module.
      size: numbers in an observation.
      num_actions: a look at each PoI, and NOP.
      bound: observations are within plus and minus this.
    """
    return spaces.Box(-bound, bound, (size,), np.float32), spaces.Discrete(num_actions)


def environment_spaces(spaces: Spaces[B_co, D_co], played: Environment) -> tuple[B_co, D_co]:
    """Spaces of an environment of one policy, see `spaces_of`.

    Args:
      spaces: another library's module.
      played: the environment.
    """
    return spaces_of(spaces, played.observation_size, played.num_actions, played.bound)


def prepared_starts(key: Key, mdp: MapMdp | Environment, number: int) -> PyTree:
    """Draws random states, `[number]`, for episodes to start from.

    A start looks at everything it has seen, which costs several steps; a draw from a few thousand
    prepared ones costs nothing.

    Args:
      key: random key.
      mdp: a task or a map MDP.
      number: of states.

    Raises:
      ValueError: if `number` is not positive.
    """
    checks.require_number("number of starts", number)
    # A start is the same for all sensors.
    played = OneAgent(mdp, 0) if isinstance(mdp, MapMdp) else mdp
    reset = jax.vmap(lambda key, played: played.reset(key)[1], (0, None))
    return jax.jit(lambda key, played: reset(jax.random.split(key, number), played))(key, played)


def start(key: Key, played: Environment, starts: PyTree) -> tuple[Float[Array, " S"], PyTree]:
    """Starts an episode.

    Args:
      key: random key.
      played: the environment.
      starts: `[S]` from `prepared_starts`, to pick a random one; None for a new start.

    Returns:
      `[S]` observation, and the state.
    """
    if starts is None:
        return played.reset(key)
    rows = len(jax.tree.leaves(starts)[0])
    row = jax.random.randint(key, (), 0, rows)
    state = jax.tree.map(lambda x: x[row], starts)
    return played.observe(state), state


def member(name: str, kind: type[E], value: object) -> E:
    """A member of an enumeration, by its value or as it is; raises `ValueError` if it is none."""
    known = {each.value: each for each in kind}
    if value not in (*known, *kind):
        raise ValueError(f"{name} = {value!r}: must be one of {', '.join(map(str, known))}")
    return value if isinstance(value, kind) else known[value]


def checked_mode(mode: str | None, modes: Sequence[str]) -> str | None:
    """A mode to render in, one of some; raises `ValueError` if it is another."""
    if mode not in (None, *modes):
        raise ValueError(f"render_mode = {mode!r}: must be {' or '.join([*modes, 'None'])}")
    return mode
