"""The DQN and the PPO of Stable-Baselines3."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from flax import struct
from stable_baselines3 import DQN, PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import (  # pyright: ignore[reportMissingImports]
    BaseCallback,
)

from benchmarks.tasks.learner import NUM_STARTS, POINTS, Report
from jaxsense.core.types import pytree
from jaxsense.interfaces import prepared_starts
from jaxsense.interfaces.gymnasium import MapVectorEnv
from jaxsense.interfaces.stable_baselines3 import MapVecEnv
from jaxsense.tasks import Recurrent, Task
from jaxsense.tasks.score import Policy

_STARTS = jax.random.key(2**30)
_HIDDEN = (64, 64)


@dataclasses.dataclass(frozen=True)
class Sb3Dqn:
    """Stable-Baselines3's DQN.

    Attributes:
      discount: of a step.
      num_envs: environments side by side.
      updates: gradient steps for each step of all environments.
      batch: transitions of one of them.
      replay: transitions that are kept.
      learning_rate: of Adam.
      exploration: share of the training after which exploration has fallen to its floor.
      target_period: environment steps between two copies to the target network.
    """

    name = "SB3 DQN"
    packages = ("stable-baselines3", "torch")
    discount: float = 0.5
    num_envs: int = 128
    updates: int = 8
    batch: int = 256
    replay: int = 65536
    learning_rate: float = 1e-3
    exploration: float = 0.5
    target_period: int = 2560

    def make(self, envs: Any, seed: int, hidden: Sequence[int] = _HIDDEN, **others: Any) -> DQN:
        """The algorithm.

        Args:
          envs: where it learns, one environment or several.
          seed: of the training.
          hidden: sizes of the hidden layers.
          **others: other settings, by its own names.
        """
        return DQN(
            "MlpPolicy",
            envs,
            gradient_steps=self.updates,
            batch_size=self.batch,
            buffer_size=self.replay,
            learning_rate=self.learning_rate,
            gamma=self.discount,
            exploration_fraction=self.exploration,
            target_update_interval=self.target_period,
            policy_kwargs={"net_arch": list(hidden), "activation_fn": torch.nn.ReLU},
            device="cpu",
            seed=seed,
            **{"learning_starts": 1024, "train_freq": 1, **others},
        )

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Trains one seed after another, see `Learner.train`."""

        def policy(model: Any) -> "Dense":
            return Dense(layers(model.q_net.q_net), jax.nn.relu, best)

        _train(task, self.num_envs, self.make, policy, seeds, steps, report)


@dataclasses.dataclass(frozen=True)
class Sb3Ppo:
    """Stable-Baselines3's PPO, which draws its actions.

    Attributes:
      discount: of a step.
      num_envs: environments side by side.
      num_steps: steps of each between two rounds of learning.
      epochs: times that a round learns from each step.
      batch: steps of one gradient step.
      learning_rate: of Adam.
      entropy: weight of the policy's entropy.
    """

    name = "SB3 PPO"
    packages = ("stable-baselines3", "torch")
    discount: float = 0.5
    num_envs: int = 64
    num_steps: int = 16
    epochs: int = 10
    batch: int = 256
    learning_rate: float = 1e-3
    entropy: float = 0.01

    def make(self, envs: Any, seed: int) -> Any:
        """The algorithm.

        Args:
          envs: where it learns.
          seed: of the training.
        """
        return PPO("MlpPolicy", envs, **self.options(seed))

    def options(self, seed: int, **network: Any) -> dict[str, Any]:
        """Settings by PPO's names.

        Args:
          seed: of the training.
          **network: arguments of its policy besides the hidden layers.
        """
        return {
            "n_steps": self.num_steps,
            "n_epochs": self.epochs,
            "batch_size": self.batch,
            "learning_rate": self.learning_rate,
            "gamma": self.discount,
            "ent_coef": self.entropy,
            "policy_kwargs": {"net_arch": list(_HIDDEN), **network},
            "device": "cpu",
            "seed": seed,
        }

    def policy(self, model: Any) -> Policy | Recurrent:
        """What an algorithm from `make` has learned.

        Args:
          model: the algorithm.
        """
        return actor(model)

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Trains one seed after another, see `Learner.train`."""
        _train(task, self.num_envs, self.make, self.policy, seeds, steps, report)


def best(key: jax.Array, values: jax.Array) -> jax.Array:
    """`[]` action of the highest value, with any key."""
    del key
    return jnp.argmax(values)


def actor(model: Any) -> "Dense":
    """The dense network from whose outputs PPO draws its actions.

    Args:
      model: the algorithm.
    """
    last = model.policy.mlp_extractor.policy_net, model.policy.action_net
    return Dense(layers(*last), jnp.tanh, jax.random.categorical)


@pytree
class Dense:
    """A policy by the outputs of a dense network, which JAX compiles.

    Attributes:
      layers: weights `[in, out]` and biases `[out]`.
      activation: between them.
      choose: `(key, outputs) -> action`.
    """

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    activation: Callable[[jax.Array], jax.Array] = struct.field(pytree_node=False)
    choose: Callable[[jax.Array, jax.Array], jax.Array] = struct.field(pytree_node=False)

    def __call__(self, key: jax.Array, observation: jax.Array) -> jax.Array:
        """`[]` action."""
        *hidden, last = self.layers
        for weight, bias in hidden:
            observation = self.activation(observation @ weight + bias)
        return self.choose(key, observation @ last[0] + last[1])


class _Points(BaseCallback):
    """Reports the policy before the first step, and then as often as a curve has points."""

    def __init__(self, tell: Callable[[int], None], steps: int):
        super().__init__()
        self._tell, self._steps, self._told = tell, steps, 0

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._told * self._steps / POINTS:
            self._tell(self.num_timesteps)
            self._told += 1

    def _on_training_end(self) -> None:
        self._tell(self.num_timesteps)

    def _on_step(self) -> bool:
        return True


def layers(*modules: Any) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Weights `[in, out]` and biases `[out]` of the dense layers in networks of PyTorch."""
    of_all = [layer for module in modules for layer in module.modules()]
    dense = [layer for layer in of_all if isinstance(layer, torch.nn.Linear)]
    # Copies: training changes them in place.
    return tuple(
        (each.weight.detach().numpy().T.copy(), each.bias.detach().numpy().copy()) for each in dense
    )


def _train(
    task: Task,
    num_envs: int,
    make: Callable[[Any, int], Any],
    policy: Callable[[Any], Policy | Recurrent],
    seeds: Sequence[int],
    steps: int,
    report: Report,
) -> None:
    """Trains `make(environments, seed)` with each seed."""
    torch.set_num_threads(1)  # faster than two for networks of this size
    starts = prepared_starts(_STARTS, task, NUM_STARTS)
    envs = MapVecEnv(MapVectorEnv(task, None, num_envs, starts, "SameStep"))
    # Compiles all: steps, ends of episodes and new starts.
    envs.reset()
    envs.step(np.full(num_envs, task.num_actions - 1))
    for seed in seeds:
        model = make(envs, seed)
        tell = lambda steps: report(steps, {seed: policy(model)})  # noqa: B023, E731
        model.learn(steps, callback=_Points(tell, steps))


LEARNERS = Sb3Dqn(), Sb3Ppo()
