"""Stable-Baselines3: its DQN on the map MDP in NumPy, and DQN and PPO as learners in tasks."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, SupportsInt

import gymnasium  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numpy as np
import optax
import sb3_contrib  # pyright: ignore[reportMissingImports]
import stable_baselines3  # pyright: ignore[reportMissingImports]
import torch  # pyright: ignore[reportMissingImports]
from jax.tree_util import Partial
from stable_baselines3.common.callbacks import (  # pyright: ignore[reportMissingImports]
    BaseCallback,
)

from benchmarks.dqn import MODALITY, NUM_STARTS, Task
from benchmarks.measure import Options, Side
from benchmarks.peers.numpy_mdp import NumpyMdp
from jaxsense import tasks
from jaxsense.core.types import Key
from jaxsense.interfaces import prepared_starts
from jaxsense.interfaces.gymnasium import MapVectorEnv
from jaxsense.interfaces.stable_baselines3 import MapVecEnv
from jaxsense.tasks import Recurrent
from jaxsense.tasks.score import Policy

_HIDDEN = (64, 64)
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]
"""Weights `[in, out]` and bias `[out]` of each dense layer."""
Memory = tuple[jax.Array, jax.Array]
"""`[H]` hidden state and `[H]` cell state of an LSTM."""


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


@dataclasses.dataclass(frozen=True)
class Dqn:
    """Stable-Baselines3's DQN as a learner, see `scoreboard.Learner`.

    Attributes:
      updates: gradient steps for each step of all environments.
      replay: transitions.
      exploration: share of the training until exploration is at its floor.
      target_period: environment steps.
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

    def make(self, envs: Any, seed: int, hidden: Sequence[int] = _HIDDEN, **others: Any) -> Any:
        """The algorithm; `others` are settings by its own names."""
        return stable_baselines3.DQN(
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

    def policy(self, model: Any) -> Policy:
        """The action of the highest value."""
        return Partial(_best, layers(model.q_net.q_net))

    def train(
        self, task: tasks.Task, seeds: Sequence[int], steps: int
    ) -> dict[int, Policy | Recurrent]:
        """Trains one seed after another."""
        return _train(self, task, seeds, steps)


@dataclasses.dataclass(frozen=True)
class Ppo:
    """Stable-Baselines3's PPO, which draws its actions.

    Attributes:
      num_steps: steps of each environment between two rounds of learning.
      epochs: times that a round learns from each step.
      batch: steps of one gradient step.
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
        """The algorithm."""
        return stable_baselines3.PPO("MlpPolicy", envs, **self._options(seed))

    def policy(self, model: Any) -> Policy | Recurrent:
        """Draws from the outputs of the actor."""
        return Partial(_drawn, _actor(model))

    def train(
        self, task: tasks.Task, seeds: Sequence[int], steps: int
    ) -> dict[int, Policy | Recurrent]:
        """Trains one seed after another."""
        return _train(self, task, seeds, steps)

    def _options(self, seed: int, **network: Any) -> dict[str, Any]:
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


@dataclasses.dataclass(frozen=True)
class RecurrentPpo(Ppo):
    """The PPO of sb3-contrib: actor and critic each have an LSTM before their dense network.

    Attributes:
      lstm: units of each LSTM.
    """

    name = "SB3 RecurrentPPO"
    packages = (*Ppo.packages, "sb3-contrib")
    lstm: int = 64

    def make(self, envs: Any, seed: int) -> Any:
        """The algorithm."""
        options = self._options(seed, lstm_hidden_size=self.lstm)
        return sb3_contrib.RecurrentPPO("MlpLstmPolicy", envs, **options)

    def policy(self, model: Any) -> Recurrent:
        """Draws from the outputs of the actor, which remembers."""
        lstm = model.policy.lstm_actor
        # Copies: training changes them in place.
        arrays = (each.detach().numpy().T.copy() for each in lstm.parameters())
        of_input, of_hidden, input_bias, hidden_bias = arrays
        weights, zeros = (of_input, of_hidden, input_bias + hidden_bias), np.zeros(self.lstm)
        memory = zeros.astype(np.float32), zeros.astype(np.float32)
        return Recurrent(Partial(_remembering, weights, _actor(model)), memory)


LEARNERS = Dqn(), Ppo(), RecurrentPpo()


def layers(*modules: Any) -> Layers:
    """The dense layers in networks of PyTorch."""
    of_all = [layer for module in modules for layer in module.modules()]
    dense = [layer for layer in of_all if isinstance(layer, torch.nn.Linear)]
    # Copies: training changes them in place.
    return tuple(
        (each.weight.detach().numpy().T.copy(), each.bias.detach().numpy().copy()) for each in dense
    )


def throughputs(task: Task, options: Options) -> list[Side]:
    """Its speed with a gradient step for each environment step, and with one for four of them."""
    steps = 20 if options.quick else 1000

    def side(train_freq: int) -> Side:
        learner = Dqn(replay=131072, exploration=0.1, target_period=10000)
        model = _of_row(task, learner, train_freq=train_freq, learning_starts=1)

        def run() -> None:
            model.learn(steps, reset_num_timesteps=False)

        return Side(run, steps, 1)

    return [side(1), side(4)]


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
            # As our own parameters.
            found = enumerate(layers(model.q_net.q_net))
            named = {f"Dense_{i}": {"kernel": kernel, "bias": bias} for i, (kernel, bias) in found}
            is_stopped = not passes({"params": named})
            begin = time.perf_counter()
            return is_stopped and spent < limit

    begin = time.perf_counter()
    learner = Dqn(replay=65536, exploration=0.02, target_period=500)
    model = _of_row(task, learner, train_freq=4, learning_starts=500)
    model.learn(most, callback=Examination())
    return spent, is_stopped


def _of_row(task: Task, learner: Dqn, **others: Any) -> Any:
    """The algorithm with our network, batch, learning rate and discount, on one thread."""
    torch.set_num_threads(1)  # faster than two for networks of this size
    dqn = task.config.dqn
    rate, discount = dqn.learning_rate, dqn.discount
    same = dataclasses.replace(learner, discount=discount, batch=dqn.batch, learning_rate=rate)
    same = dataclasses.replace(same, updates=1)
    return same.make(MapEnv(task), 0, dqn.hidden, exploration_final_eps=dqn.epsilon_min, **others)


def _train(
    learner: Dqn | Ppo, task: tasks.Task, seeds: Sequence[int], steps: int
) -> dict[int, Policy | Recurrent]:
    torch.set_num_threads(1)  # faster than two for networks of this size
    starts = prepared_starts(jax.random.key(2**30), task, NUM_STARTS)
    envs = MapVecEnv(
        MapVectorEnv(task, num_envs=learner.num_envs, starts=starts, autoreset_mode="SameStep")
    )
    found: dict[int, Policy | Recurrent] = {}
    for seed in seeds:
        model = learner.make(envs, seed)
        found[seed] = learner.policy(model.learn(steps))
    return found


def _actor(model: Any) -> Layers:
    return layers(model.policy.mlp_extractor.policy_net, model.policy.action_net)


def _outputs(
    layers: Layers, activation: Callable[[jax.Array], jax.Array], x: jax.Array
) -> jax.Array:
    *hidden, (kernel, bias) = layers
    for weights, offsets in hidden:
        x = activation(x @ weights + offsets)
    return x @ kernel + bias


def _best(layers: Layers, key: Key, observation: jax.Array) -> jax.Array:
    del key
    return jnp.argmax(_outputs(layers, jax.nn.relu, observation))


def _drawn(layers: Layers, key: Key, observation: jax.Array) -> jax.Array:
    return jax.random.categorical(key, _outputs(layers, jnp.tanh, observation))


def _remembering(
    weights: tuple[np.ndarray, np.ndarray, np.ndarray],
    layers: Layers,
    key: Key,
    memory: Memory,
    observation: jax.Array,
) -> tuple[jax.Array, Memory]:
    """PyTorch's LSTM before a dense network; gates: input, forget, candidate, output."""
    hidden, cell = memory
    of_input, of_hidden, bias = weights
    gates = jnp.split(observation @ of_input + hidden @ of_hidden + bias, 4)
    entering, keeping, leaving = (jax.nn.sigmoid(gates[i]) for i in (0, 1, 3))
    cell = keeping * cell + entering * jnp.tanh(gates[2])
    hidden = leaving * jnp.tanh(cell)
    return _drawn(layers, key, hidden), (hidden, cell)
