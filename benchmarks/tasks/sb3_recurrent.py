"""The recurrent PPO of sb3-contrib."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from sb3_contrib import RecurrentPPO  # pyright: ignore[reportMissingImports]

from benchmarks.tasks.learner import Report
from benchmarks.tasks.sb3 import Sb3Ppo, actor
from jaxsense.core.types import Key, pytree
from jaxsense.tasks import Recurrent, Task
from jaxsense.tasks.score import Policy

Memory = tuple[jax.Array, jax.Array]
"""`[H]` hidden state and `[H]` cell state of an LSTM."""


@dataclasses.dataclass(frozen=True)
class RecurrentPpo(Sb3Ppo):
    """`Sb3Ppo` with memory: actor and critic each have an LSTM in front of their dense network.

    Attributes:
      lstm: units of each LSTM.
      share_of_steps: of the environment steps of other learners, since each takes longer.
    """

    name = "SB3 RecurrentPPO"
    packages = (*Sb3Ppo.packages, "sb3-contrib")
    lstm: int = 64
    share_of_steps: float = 0.5

    def make(self, envs: Any, seed: int) -> RecurrentPPO:
        """The algorithm, see `Sb3Ppo.make`."""
        options = self.options(seed, lstm_hidden_size=self.lstm)
        return RecurrentPPO("MlpLstmPolicy", envs, **options)

    def policy(self, model: Any) -> Recurrent:
        """What an algorithm from `make` has learned, see `Sb3Ppo.policy`."""
        return recurrent(model.policy.lstm_actor, actor(model))

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Takes a share of the steps, see `Sb3Ppo.train`."""
        super().train(task, seeds, math.ceil(self.share_of_steps * steps), report)


@pytree
class Lstm:
    """A policy that reads the hidden state of an LSTM, which JAX compiles.

    Attributes:
      input_weights: `[S, 4H]` of input gate, forget gate, candidate and output gate.
      hidden_weights: `[H, 4H]` of the same.
      bias: `[4H]` of the same.
      choose: the policy, whose observation is the hidden state `[H]`.
    """

    input_weights: np.ndarray
    hidden_weights: np.ndarray
    bias: np.ndarray
    choose: Policy

    def __call__(
        self, key: Key, memory: Memory, observation: jax.Array
    ) -> tuple[jax.Array, Memory]:
        """`[]` action, and the memory after it."""
        hidden, cell = memory
        gates = observation @ self.input_weights + hidden @ self.hidden_weights + self.bias
        input_gate, forget_gate, candidate, output_gate = jnp.split(gates, 4)
        kept = jax.nn.sigmoid(forget_gate) * cell
        cell = kept + jax.nn.sigmoid(input_gate) * jnp.tanh(candidate)
        hidden = jax.nn.sigmoid(output_gate) * jnp.tanh(cell)
        return self.choose(key, hidden), (hidden, cell)


def recurrent(lstm: Any, choose: Policy) -> Recurrent:
    """A policy with an LSTM of PyTorch, whose states begin as zeros.

    Args:
      lstm: the LSTM, of one layer.
      choose: see `Lstm`.
    """
    # Copies: training changes them in place.
    arrays = (each.detach().numpy().T.copy() for each in lstm.parameters())
    input_weights, hidden_weights, input_bias, hidden_bias = arrays
    policy = Lstm(input_weights, hidden_weights, input_bias + hidden_bias, choose)
    zeros = np.zeros(lstm.hidden_size, np.float32)
    return Recurrent(policy, (zeros, zeros))


LEARNERS = (RecurrentPpo(),)
