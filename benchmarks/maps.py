"""What the rows about Q-learning have in common: a task, and a short way to say it."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.observe import Bank

from benchmarks.jmvae import random_bank
from jaxsense import models, observe
from jaxsense.config import PRESETS, Config, DqnConfig
from jaxsense.core.networks import Params
from jaxsense.dqn import belief_mdp, episodes, policies
from jaxsense.models import Models

MODALITY = 0
"""The agent looks with the camera."""
SHARE = 0.99
"""Of the optimal return, which counts as optimal."""
_EXPECTATION_DRAWS = 1024


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """Q-learning on the map MDP with stored detections.

    Attributes:
      config: all settings, those of our own DQN among them.
      params: of the JMVAE.
      bank: detections, see `observe.bank_mdp`.
    """

    config: Config
    params: Params
    bank: Bank

    @property
    def mdp(self) -> MapMdp:
        """The MDP."""
        return self.mdp_of(self.params, self.bank)

    @property
    def mdp_of(self) -> Callable[[Params, Bank], MapMdp]:
        """The MDP from parameters and bank, for where they are arguments of a jitted function."""
        shape = models.make_jmvae(self.config)
        return lambda params, bank: observe.bank_mdp(self.config, bank, params, shape)


def untrained_task(dqn: DqnConfig, samples: int = 10000) -> tuple[Task, Models]:
    """A task of the real sizes with random networks and detections: as fast as a trained one."""
    config = dataclasses.replace(PRESETS["default"], dqn=dqn)
    networks = models.init(jax.random.key(0), config)
    sizes = models.make_jmvae(config).feature_sizes
    bank = random_bank(jax.random.key(1), sizes, len(config.arena.classes), samples)
    return Task(config, networks.jmvae, bank), networks


@dataclasses.dataclass(frozen=True)
class Learner:
    """One that trains, a chunk at a time, and compiles what it needs when first called.

    Attributes:
      start: `() -> state`.
      go_on: `(state) -> state` after a chunk.
      as_params: `(state) -> params` of a Q-network of ours.
    """

    start: Callable[[], Any]
    go_on: Callable[[Any], Any]
    as_params: Callable[[Any], Params]


class Examiner:
    """Tells whether a Q-network is near the optimum, from whole episodes from fixed starts.

    Attributes:
      target: mean return to reach, `SHARE` of that of the optimal policy.
    """

    def __init__(self, task: Task, num_starts: int):
        """Compiles everything, and plays the optimal policy, on the task's bank."""
        config, mdp = task.config, task.mdp
        reset_key, play_key, table_key = jax.random.split(jax.random.key(5), 3)
        reset = jax.jit(jax.vmap(lambda key: belief_mdp.reset(key, mdp)))
        starts = reset(jax.random.split(reset_key, num_starts))
        play_keys = jax.random.split(play_key, num_starts)

        def mean_return(policy: policies.Policy, starts: belief_mdp.MapState) -> jax.Array:
            def play(key: jax.Array, start: belief_mdp.MapState) -> jax.Array:
                return episodes.run_episode(key, mdp, policy, start, MODALITY)[0]

            return jnp.mean(jax.vmap(play)(play_keys, starts))

        def optimal_return(key: jax.Array, starts: belief_mdp.MapState) -> jax.Array:
            labels = [config.label_of_class(m) for m in config.modalities]
            table = policies.expected_rewards(key, mdp, MODALITY, _EXPECTATION_DRAWS)
            return mean_return(policies.optimal(mdp, table, jnp.array(labels)), starts)

        def greedy_return(params: Params, starts: belief_mdp.MapState) -> jax.Array:
            return mean_return(policies.greedy(mdp, params, config.dqn.hidden), starts)

        self.target = SHARE * float(jax.jit(optimal_return)(table_key, starts))
        self._starts = starts
        map_size = 2 * config.jmvae.latent_size * config.arena.num_pois
        network = policies.q_network(mdp.num_pois, config.dqn.hidden)
        example = network.init(table_key, jnp.zeros(map_size))
        self._greedy_return = jax.jit(greedy_return).lower(example, starts).compile()

    def passes(self, params: Params) -> bool:
        """Whether the greedy policy of a Q-network reaches the target."""
        return float(self._greedy_return(params, self._starts)) >= self.target
