"""What all interfaces have in common: the map MDP as one agent meets it."""

import jax

from jaxsense.dqn import belief_mdp
from jaxsense.dqn.belief_mdp import MapMdp, MapState
from jaxsense.types import Key


def check_modality(mdp: MapMdp, modality: int) -> None:
    """Raises `ValueError` unless the MDP has a sensor of that index."""
    if not 0 <= modality < mdp.num_modalities:
        raise ValueError(f"modality = {modality}: must be below {mdp.num_modalities}, not negative")


def num_actions(mdp: MapMdp) -> int:
    """A look at each PoI, and NOP."""
    return mdp.num_pois + 1


def observation_size(mdp: MapMdp) -> int:
    """Numbers in an observation, `N * 2D`."""
    return 2 * mdp.num_pois * mdp.unseen.mean.size


def start(key: Key, mdp: MapMdp, starts: MapState | None) -> MapState:
    """The start of an episode.

    Args:
      key: random key.
      mdp: the MDP.
      starts: `[S]` states from `dqn.starts`, of which a random one is taken. Without, the start is
        made anew: it then takes a look at everything that has been seen in it, which costs several
        steps.
    """
    if starts is None:
        return belief_mdp.reset(key, mdp)
    row = jax.random.randint(key, (), 0, starts.steps.shape[0])
    return jax.tree.map(lambda x: x[row], starts)
