"""What a Q-network learns in: the map MDP of one agent, or the MDP of a team."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxsense.config import DqnConfig
from jaxsense.dqn import belief_mdp, policies, team_mdp
from jaxsense.dqn.belief_mdp import MapMdp, Outcome
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.types import Index, Key

State = Any
"""A `MapState` or a `TeamState`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Environment:
    """An environment of one learner.

    Attributes:
      num_actions: A; the last action is NOP.
      network: the Q-network, `[S, B] -> [A, B]`.
      exists: `state -> [A] bool`, which actions do.
      observation: `state -> [S]`, what the network reads.
      step: `(key, state, action) -> (state, Outcome)`.
    """

    num_actions: int
    network: nn.Module
    exists: Callable[[State], jax.Array]
    observation: Callable[[State], jax.Array]
    step: Callable[[Key, State, jax.Array], tuple[State, Outcome]]


def environment(mdp: MapMdp | TeamMdp, modality: Index, config: DqnConfig) -> Environment:
    """The environment of an agent.

    Args:
      mdp: the MDP.
      modality: index of the agent's own sensor, see `belief_mdp.step`; a team has all of them.
      config: the settings.
    """
    if isinstance(mdp, TeamMdp):
        return _of_team(mdp, config)
    return Environment(
        num_actions=mdp.num_pois + 1,
        network=policies.q_network(mdp.num_pois, config.hidden),
        exists=lambda state: jnp.ones(mdp.num_pois + 1, bool),
        observation=lambda state: belief_mdp.observation(state.belief),
        step=lambda key, state, action: belief_mdp.step(key, mdp, state, action, modality),
    )


def _of_team(mdp: TeamMdp, config: DqnConfig) -> Environment:
    num_modalities, travel = mdp.map.num_modalities, mdp.config.travel

    def observation(state: team_mdp.TeamState) -> jax.Array:
        known = state.map.belief, state.team, state.agent
        return team_mdp.observation(travel, *known, num_modalities).reshape(-1)

    return Environment(
        num_actions=mdp.map.num_pois + 1,
        network=policies.team_network(mdp.map.unseen.mean.size, num_modalities, config),
        exists=lambda state: jnp.append(state.team.present, True),
        observation=observation,
        step=lambda key, state, action: team_mdp.step(key, mdp, state, action),
    )
