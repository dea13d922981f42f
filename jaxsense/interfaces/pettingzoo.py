"""A team as environments of PettingZoo: `pip install 'jaxsense[pettingzoo]'`.

`make("team-v0")` makes a task. PettingZoo's `turn_based_aec_to_parallel` makes it a `ParallelEnv`,
whose masks allow robots that must wait NOP alone; `active_agent` in the infos names the other.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import tasks
from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.interfaces import common
from jaxsense.interfaces.common import Robots
from jaxsense.tasks import Task, TimeStep

with common.extra("pettingzoo"):
    from gymnasium import error, spaces  # pyright: ignore[reportMissingImports]
    from pettingzoo import AECEnv  # pyright: ignore[reportMissingImports]

T = TypeVar("T")


class TeamAECEnv(AECEnv):
    """A task of a team, or the team MDP, as an `AECEnv`: robots are agents that take turns.

    `agent_selection` is the robot that chooses; it earns the reward of its look before its next
    turn, see `jaxsense.interfaces.common.Robots`. The methods are PettingZoo's. `seconds` in the
    infos is the duration of the last action, and `action_mask`, `[N + 1]` int8, is 1 for the
    actions that the robot has.
    """

    def __init__(self, mdp: Mdp | Task, config: Config | None = None):
        """Makes the environment; `reset` must be called before the first step.

        Args:
          mdp: a task of a team from `jaxsense.make`; or the MDP of a team, see
            `jaxsense.make_mdp`.
          config: the settings, which name the robots; only with an MDP.
        """
        self._robots = common.robots_of(mdp, config)
        self.metadata = {"name": "jaxsense_team_v0", "render_modes": []}
        self.render_mode = None
        self.possible_agents = list(self._robots.names)
        self.agents = []
        of_each = common.spaces_of(spaces, self._robots.played)
        self._spaces = dict.fromkeys(self.possible_agents, of_each)
        self._key: Key | None = None

    def observation_space(self, agent: str) -> spaces.Space:
        """Space of a robot's observations, `[S]`."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.Space:
        """Space of a robot's actions: each PoI, and NOP."""
        return self._spaces[agent][1]

    def reset(self, seed: int | None = None, options: dict[str, object] | None = None) -> None:
        """Starts an episode; no options are read."""
        del options
        if seed is not None or self._key is None:
            (word,) = np.random.SeedSequence(seed).generate_state(1)
            self._key = jax.random.key(int(word))
        self._key, self._state, *told = _start(self._key, self._robots)
        self.agents, self._observations = list(self.possible_agents), {}
        self._tell(*told)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self._skip_agent_selection = None

    def observe(self, agent: str) -> np.ndarray:
        """A robot's observation, `[S]` float32; its last one if it has left."""
        return self._observations[agent].copy()

    def step(self, action: Any) -> None:
        """Takes the action of `agent_selection`; None if it is done, after which it leaves.

        Raises:
          ResetNeeded: before the first reset, or if the episode has ended.
          ValueError: if there is no such action.
        """
        if not self.agents:
            raise error.ResetNeeded("step before reset, or after the end of an episode")
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        if not self.action_space(agent).contains(np.asarray(action)):
            raise ValueError(f"action = {action!r}: must be in {self.action_space(agent)}")
        chosen = np.full(len(self.possible_agents), int(action), np.int32)
        self._key, self._state, *told = _step(self._key, self._robots, self._state, chosen)
        self._tell(*told)
        self._cumulative_rewards[agent] = 0.0
        self._accumulate_rewards()
        self._deads_step_first()

    def render(self) -> None:
        """Draws nothing: there is no `render_mode`."""

    def close(self) -> None:
        """Closes nothing, as PettingZoo's own test asks of what has `render`."""

    def _tell(self, found: TimeStep, seconds: jax.Array, mask: jax.Array) -> None:
        """Sets what each robot is told, and whose turn it is."""
        self._observations |= self._named(found.observation)  # of robots that left, the last stays
        self.rewards = self._named(found.reward, float)
        self.terminations = self._named(found.terminated, bool)
        self.truncations = self._named(found.truncated, bool)
        self.infos = {
            agent: {"seconds": float(seconds), "action_mask": of_robot}
            for agent, of_robot in self._named(mask, np.int8).items()
        }
        self.agent_selection = self.possible_agents[int(self._state.agent)]

    def _named(
        self, of_robots: jax.Array, kind: Callable[[np.ndarray], T] = np.array
    ) -> dict[str, T]:
        """`[R, ...]` by the names of the robots that work."""
        of_each = self._robots.named(np.asarray(of_robots))
        return {agent: kind(of_each[agent]) for agent in self.agents}


def make(name: str) -> TeamAECEnv:
    """The `AECEnv` of a task of a team, see `jaxsense.make`."""
    return TeamAECEnv(tasks.make(name))


Told = tuple[Key, State, TimeStep, jax.Array, jax.Array]
"""Next key, state, time steps of the robots, seconds, and `[R, N + 1]` actions that robots have."""


@jax.jit
def _start(key: Key, robots: Robots) -> Told:
    next_key, key = jax.random.split(key)
    _, state = robots.played.reset(key)
    nothing, nobody = jnp.zeros(len(robots.names)), jnp.zeros(len(robots.names), bool)
    found = TimeStep(robots.observe(state), nothing, nobody, nobody)
    return next_key, state, found, jnp.float32(0), robots.action_mask(state)


@jax.jit
def _step(key: Key, robots: Robots, state: State, actions: jax.Array) -> Told:
    next_key, key = jax.random.split(key)
    after, found, seconds = robots.step(key, state, actions)
    return next_key, after, found, seconds, robots.action_mask(after)
