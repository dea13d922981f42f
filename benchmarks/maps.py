"""What the rows about Q-learning share: a task, a learner and an examination."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from benchmarks.jmvae import random_bank
from jaxsense import PRESETS, Bank, Config, Models, init, make_jmvae, make_mdp
from jaxsense.config import DqnConfig
from jaxsense.dqn import episodes, policies
from jaxsense.dqn.episodes import Start
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.policies import Known
from jaxsense.dqn.reference import reference

MODALITY = 0
"""The agent looks with the camera."""
SHARE = 0.99
"""Of the optimal return, which counts as optimal."""


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """Q-learning on the map MDP with stored detections.

    Attributes:
      config: all settings, including our own DQN's.
      models: the networks.
      bank: for each modality `[C, S, D_m]` detections.
    """

    config: Config
    models: Models
    bank: tuple[jax.Array, ...]

    @property
    def mdp(self) -> MapMdp:
        """The MDP."""
        return make_mdp(self.config, self.models, Bank(self.bank)).map


def untrained_task(dqn: DqnConfig, samples: int = 10000) -> Task:
    """A task of the real sizes with random networks and detections: as fast as a trained one.

    Args:
      dqn: settings of our own DQN.
      samples: detections of each class by each sensor.
    """
    config = dataclasses.replace(PRESETS["default"], dqn=dqn)
    networks = init(jax.random.key(0), config)
    sizes = make_jmvae(config).feature_sizes
    bank = random_bank(jax.random.key(1), sizes, len(config.arena.classes), samples)
    return Task(config, networks, bank)


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
    as_params: Callable[[Any], optax.Params]


class Examiner:
    """Tells whether a Q-network is near the optimum, from whole episodes from fixed starts.

    Attributes:
      target: mean return to reach, `SHARE` of that of the optimal policy.
    """

    def __init__(self, task: Task, num_starts: int):
        """Compiles everything, and plays the optimal policy, on the task's bank."""
        mdp, exact, agent = task.mdp, task.models.bayes, task.models.agent
        reset_key, play_key = jax.random.split(jax.random.key(5))
        reset = jax.jit(jax.vmap(lambda key: episodes.reset(key, mdp, exact)))
        starts = reset(jax.random.split(reset_key, num_starts))
        play_keys = jax.random.split(play_key, num_starts)
        optimal = reference(jax.random.key(0), mdp, MODALITY, task.models, exact.labels)

        def mean_return(
            values: Callable[[Known, jax.Array], jax.Array], starts: Start
        ) -> jax.Array:
            def play(key: jax.Array, start: Start) -> jax.Array:
                def act(key: jax.Array, known: Known) -> jax.Array:
                    del key
                    return policies.best(values(known, start.state.classes))

                return episodes.run_episode(key, mdp, exact, act, start, MODALITY)[0]

            return jnp.mean(jax.vmap(play)(play_keys, starts))

        def learned_return(params: optax.Params, starts: Start) -> jax.Array:
            def values(known: Known, classes: jax.Array) -> jax.Array:
                del classes
                observed = agent.observe(known.belief, known.team, known.robot)
                return agent.values(params, observed)

            return mean_return(values, starts)

        def optimal_return(starts: Start) -> jax.Array:
            return mean_return(optimal, starts)

        self.target = SHARE * float(jax.jit(optimal_return)(starts))
        self._starts = starts
        example = agent.init(jax.random.key(0))
        self._learned_return = jax.jit(learned_return).lower(example, starts).compile()

    def passes(self, params: optax.Params) -> bool:
        """Whether the policy of a Q-network reaches the target."""
        return float(self._learned_return(params, self._starts)) >= self.target
