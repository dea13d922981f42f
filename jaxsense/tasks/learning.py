"""Policies of our own Q-networks in a frozen task."""

import jax
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int

from jaxsense.core import checks
from jaxsense.core.networks import Params
from jaxsense.core.types import Key
from jaxsense.dqn import policies
from jaxsense.dqn.environments import Agent
from jaxsense.tasks.score import Policy
from jaxsense.tasks.task import Task


@checks.typed
def greedy(task: Task, agent: Agent, params: Params) -> Policy:
    """Makes a policy for `score` that takes the action with the highest Q-value.

    Args:
      task: the task that the network has learned in.
      agent: that was given to `Task.learning`.
      params: of the Q-network, from `dqn.train`.
    """
    return Partial(_act, task, agent, params)


def _act(
    task: Task, agent: Agent, params: Params, key: Key, observation: Float[Array, " S"]
) -> Int[jax.Array, ""]:
    del key
    return policies.best(agent.values(params, task.inputs(observation)))
