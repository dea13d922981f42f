"""Stable-Baselines3's DQN on the map MDP in NumPy."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, SupportsInt

import gymnasium  # pyright: ignore[reportMissingImports]
import numpy as np
import optax
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import DQN  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import (  # pyright: ignore[reportMissingImports]
    BaseCallback,
)

from benchmarks.maps import MODALITY, Task
from benchmarks.measure import Options, Side
from benchmarks.peers.numpy_mdp import NumpyMdp
from benchmarks.tasks.sb3 import Sb3Dqn, layers


class MapEnv(gymnasium.Env):
    """The NumPy MDP behind gymnasium's interface."""

    def __init__(self, task: Task):
        self._mdp = NumpyMdp(task.config, task.models.jmvae, task.bank, MODALITY)
        self._state: Any = None
        size = (self._mdp.observation_size,)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)
        self.action_space = gymnasium.spaces.Discrete(self._mdp.num_pois + 1)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """A random start."""
        super().reset(seed=seed, options=options)
        self._state = self._mdp.reset(self.np_random)
        return self._mdp.observation(self._state), {}

    def step(self, action: SupportsInt):
        """One action."""
        reward, terminated, truncated = self._mdp.step(self.np_random, self._state, int(action))
        return self._mdp.observation(self._state), reward, terminated, truncated, {}


def make(task: Task, learner: Sb3Dqn, **others: Any) -> DQN:
    """The algorithm with our network, batch, learning rate and discount, on one thread.

    Args:
      task: what to learn.
      learner: all other settings, of which one gradient step at a time is made.
      **others: those that a learner does not have, by the algorithm's names.
    """
    torch.set_num_threads(1)  # faster than two for networks of this size
    dqn = task.config.dqn
    same = dataclasses.replace(
        learner,
        discount=dqn.discount,
        updates=1,
        batch=dqn.batch,
        learning_rate=dqn.learning_rate,
    )
    env, hidden = MapEnv(task), dqn.hidden
    return same.make(env, 0, hidden, exploration_final_eps=dqn.epsilon_min, **others)


def throughputs(task: Task, options: Options) -> list[Side]:
    """Its speed with a gradient step for each environment step, and with one for four of them."""
    steps = 20 if options.quick else 1000

    def side(train_freq: int) -> Side:
        learner = Sb3Dqn(replay=131072, exploration=0.1, target_period=10000)
        model = make(task, learner, train_freq=train_freq, learning_starts=1)

        def run() -> None:
            model.learn(steps, reset_num_timesteps=False)

        return Side(run, steps, 1)

    return [side(1), side(4)]


def as_our_params(model: DQN) -> optax.Params:
    """Its Q-network as one of ours."""
    of_layers = enumerate(layers(model.q_net.q_net))
    return {"params": {f"Dense_{i}": {"kernel": w, "bias": b} for i, (w, b) in of_layers}}


def time_to(task: Task, passes: Callable[[optax.Params], bool], limit: float) -> tuple[float, bool]:
    """Seconds of training until an examination is passed, without the examinations.

    Args:
      task: what to learn.
      passes: the examination; taken every 1,000 steps.
      limit: seconds after which it is stopped.

    Returns:
      The seconds, and whether it was stopped.
    """
    period, most = 1000, 1_000_000
    spent, is_stopped = 0.0, True

    class Examination(BaseCallback):
        def _on_step(self) -> bool:
            nonlocal spent, is_stopped, begin
            if self.num_timesteps % period and time.perf_counter() - begin + spent < limit:
                return True
            spent += time.perf_counter() - begin
            is_stopped = not passes(as_our_params(model))
            begin = time.perf_counter()
            return is_stopped and spent < limit

    begin = time.perf_counter()
    learner = Sb3Dqn(replay=65536, exploration=0.02, target_period=500)
    model = make(task, learner, train_freq=4, learning_starts=500)
    model.learn(most, callback=Examination())
    return spent, is_stopped
