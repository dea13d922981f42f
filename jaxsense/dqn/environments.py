"""What a Q-network learns in: the map MDP of one agent, or the MDP of a team."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxsense.config import DqnConfig
from jaxsense.core import networks
from jaxsense.core.networks import Params
from jaxsense.core.types import Index, Key, Transition, pytree
from jaxsense.dqn import belief_mdp, policies, team_mdp
from jaxsense.dqn.belief_mdp import MapMdp, Outcome
from jaxsense.dqn.team_mdp import TeamMdp, TeamState

State = Any
"""A `MapState`, or a `Remembered` state of a team."""


@dataclasses.dataclass(frozen=True, eq=False)
class Environment:
    """An environment of one learner.

    Attributes:
      num_actions: A; the last action is NOP.
      init: `key -> parameters` of the Q-network.
      reset: `key -> state`.
      exists: `state -> [A] bool`, which actions do.
      observation: `state -> [S]`, what the network reads.
      step: `(key, state, observation [S], action) -> (state, Transition, Outcome)`.
      values: `(parameters, [S, B]) -> [A, B]` values of actions, the highest of which is best.
      learned: `(parameters, [S, B]) -> [A, B]` what learning predicts of each action: its reward
        and the discounted best value after it.
    """

    num_actions: int
    init: Callable[[Key], Params]
    reset: Callable[[Key], State]
    exists: Callable[[State], jax.Array]
    observation: Callable[[State], jax.Array]
    step: Callable[[Key, State, jax.Array, jax.Array], tuple[State, Transition, Outcome]]
    values: Callable[[Params, jax.Array], jax.Array]
    learned: Callable[[Params, jax.Array], jax.Array]


@pytree
class Remembered:
    """A team, and what each robot saw and chose when it last set out.

    Attributes:
      now: the state.
      observation: `[R, S]`.
      action: `[R]` int32.
    """

    now: TeamState
    observation: jax.Array
    action: jax.Array


def environment(mdp: MapMdp | TeamMdp, modality: Index, config: DqnConfig) -> Environment:
    """The environment of an agent.

    Args:
      mdp: the MDP.
      modality: index of the agent's own sensor, see `belief_mdp.step`; a team has all of them.
      config: the settings.
    """
    return _of_team(mdp, config) if isinstance(mdp, TeamMdp) else _of_agent(mdp, modality, config)


def _of_agent(mdp: MapMdp, modality: Index, config: DqnConfig) -> Environment:
    network = policies.q_network(mdp.num_pois, config.hidden)

    def observation(state: belief_mdp.MapState) -> jax.Array:
        return belief_mdp.observation(state.belief)

    def step(key: Key, state: belief_mdp.MapState, s_tm1: jax.Array, action: jax.Array):
        after, outcome = belief_mdp.step(key, mdp, state, action, modality)
        discount = jnp.where(outcome.terminated, 0.0, config.discount)
        return (
            after,
            Transition(s_tm1, action, outcome.reward, discount, observation(after)),
            outcome,
        )

    def values(params: Params, x: jax.Array) -> jax.Array:
        return networks.apply(network, params, x)

    return Environment(
        num_actions=mdp.num_pois + 1,
        init=lambda key: networks.init(key, network, 2 * mdp.num_pois * mdp.unseen.mean.size),
        reset=lambda key: belief_mdp.reset(key, mdp),
        exists=lambda state: jnp.ones(mdp.num_pois + 1, bool),
        observation=observation,
        step=step,
        values=values,
        learned=values,
    )


def _of_team(mdp: TeamMdp, config: DqnConfig) -> Environment:
    num_modalities, latent_size = mdp.map.num_modalities, mdp.map.unseen.mean.size
    network = policies.team_network(latent_size, num_modalities, config)
    size = network.features * mdp.map.num_pois

    def observation(state: Remembered) -> jax.Array:
        known = state.now.map.belief, state.now.team, state.now.agent
        return team_mdp.observation(mdp.config.travel, *known, num_modalities).reshape(-1)

    def reset(key: Key) -> Remembered:
        now = team_mdp.reset(key, mdp)
        num_robots = len(now.team.works)
        nothing = jnp.full(num_robots, mdp.map.num_pois)
        return Remembered(now, jnp.zeros((num_robots, size)), nothing)

    def step(key: Key, state: Remembered, s_tm1: jax.Array, action: jax.Array):
        seen = state.observation.at[state.now.agent].set(s_tm1)
        chosen = state.action.at[state.now.agent].set(action)
        now, outcome = team_mdp.step(key, mdp, state.now, action)
        after = Remembered(now, seen, chosen)
        # The way of the robot that has just looked is over. Without a look, the robot that chooses
        # next has not chosen yet or has ended, and nothing is to be learned: an action that does
        # not exist has value and target 0.
        looked = chosen[now.agent] < mdp.map.num_pois
        transition = Transition(
            s_tm1=seen[now.agent],
            a_tm1=jnp.where(looked, chosen[now.agent], -1),
            r_t=outcome.reward,
            discount_t=jnp.where(looked, 1.0, 0.0),
            s_t=observation(after),
        )
        return after, transition, outcome

    def learned(params: Params, x: jax.Array) -> jax.Array:
        return networks.apply(network, params, x)

    def values(params: Params, x: jax.Array) -> jax.Array:
        return policies.of_ways(learned(params, x), x, latent_size, mdp.config, config)

    return Environment(
        num_actions=mdp.map.num_pois + 1,
        init=lambda key: networks.init(key, network, size),
        reset=reset,
        exists=lambda state: jnp.append(state.now.team.present, True),
        observation=observation,
        step=step,
        values=values,
        learned=learned,
    )
