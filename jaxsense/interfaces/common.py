"""The part that all interfaces share: the map MDP of one agent."""

import jax

from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState


def check_modality(mdp: MapMdp, modality: int) -> None:
    """Raises `ValueError` unless the MDP has a sensor of that index."""
    checks.require_index("modality", modality, mdp.num_modalities)


def num_actions(mdp: MapMdp) -> int:
    """Number of actions: a look at each PoI, and NOP."""
    return mdp.num_pois + 1


def observation_size(mdp: MapMdp) -> int:
    """Numbers in an observation, `N * 2D`."""
    return 2 * mdp.num_pois * mdp.fusion.prior.mean.size


def prepared_starts(key: Key, mdp: MapMdp, number: int) -> MapState:
    """Random states, `[number]`, for episodes to start from.

    A start looks at everything it has seen, which costs several steps; a draw from a few thousand
    prepared ones costs nothing.
    """
    checks.require_number("number", number)

    def reset(key: Key) -> MapState:
        return map_mdp.reset(key, mdp)

    return jax.jit(lambda key: jax.vmap(reset)(jax.random.split(key, number)))(key)


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
