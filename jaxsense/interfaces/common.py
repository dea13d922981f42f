"""Spaces and the map MDP of one agent, shared by the interfaces."""

from typing import Any

import jax
import numpy as np

from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState


def check_modality(mdp: MapMdp, modality: int) -> None:
    """Checks that the MDP has a sensor.

    Args:
      mdp: the MDP.
      modality: index of the sensor.

    Raises:
      ValueError: if there is no such sensor.
    """
    checks.require_index("modality", modality, mdp.num_modalities)


def spaces_of(spaces: Any, size: int, num_pois: int) -> tuple[Any, Any]:
    """Spaces of observations and of actions.

    Args:
      spaces: another library's module, with `Box` and `Discrete`.
      size: numbers in an observation.
      num_pois: N; there is an action for each PoI, and NOP.
    """
    return spaces.Box(-np.inf, np.inf, (size,), np.float32), spaces.Discrete(num_pois + 1)


def map_spaces(spaces: Any, mdp: MapMdp) -> tuple[Any, Any]:
    """Spaces of the map, `[N * 2D]`, and of the actions, see `spaces_of`.

    Args:
      spaces: another library's module, with `Box` and `Discrete`.
      mdp: the MDP.
    """
    return spaces_of(spaces, 2 * mdp.num_pois * mdp.fusion.prior.mean.size, mdp.num_pois)


def prepared_starts(key: Key, mdp: MapMdp, number: int) -> MapState:
    """Random states, `[number]`, for episodes to start from.

    A start looks at everything it has seen, which costs several steps; a draw from a few thousand
    prepared ones costs nothing.

    Args:
      key: random key.
      mdp: the MDP.
      number: of states.

    Raises:
      ValueError: if `number` is not positive.
    """
    checks.require_number("number", number)
    reset = jax.vmap(map_mdp.reset, (0, None))
    return jax.jit(lambda key, mdp: reset(jax.random.split(key, number), mdp))(key, mdp)


def start(key: Key, mdp: MapMdp, starts: MapState | None) -> MapState:
    """Starts an episode.

    Args:
      key: random key.
      mdp: the MDP.
      starts: `[S]` from `prepared_starts`, to pick a random one; by default the start is new.
    """
    if starts is None:
        return map_mdp.reset(key, mdp)
    row = jax.random.randint(key, (), 0, starts.steps.shape[0])
    return jax.tree.map(lambda x: x[row], starts)
