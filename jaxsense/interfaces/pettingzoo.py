"""A team as environments of PettingZoo: `pip install 'jaxsense[pettingzoo]'`.

`make("team-v0")` and `make_parallel("team-v0")` make a task.
"""

from collections.abc import Callable
from typing import Any, SupportsInt, TypeVar

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.interfaces import common, team
from jaxsense.interfaces.extras import extra
from jaxsense.interfaces.team import Robots, TeamOutcome
from jaxsense.tasks.task import TeamTask

with extra("pettingzoo"):
    from gymnasium import error, spaces  # pyright: ignore[reportMissingImports]
    from pettingzoo import AECEnv, ParallelEnv  # pyright: ignore[reportMissingImports]

T = TypeVar("T")

Infos = dict[str, dict[str, float | np.ndarray]]


class _Team:
    """An episode of a team, one robot at a time: the base of both environments."""

    def __init__(self, mdp: TeamMdp | TeamTask, config: Config | None = None):
        """Makes the environment; `reset` must be called before the first step.

        Args:
          mdp: a task of a team from `jaxsense.make`, or the MDP of one, see `jaxsense.make_mdp`.
          config: the settings, which name the robots; only with an MDP.

        Raises:
          ValueError: if the MDP has other sensors than the settings.
        """
        self._robots = team.robots_of(mdp, config)
        common.enter_process()
        self.metadata = {"name": "jaxsense_team_v0", "render_modes": []}
        self.render_mode = None
        self.possible_agents = list(self._robots.names)
        self.agents: list[str] = []
        self.observation_spaces, self.action_spaces = self._robots.spaces(spaces)
        self._state: TeamState | None = None
        self._key: Key | None = None

    def observation_space(self, agent: str) -> spaces.Space:
        """Space of a robot's observations, `[S]`."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Space of a robot's actions: each PoI, and NOP."""
        return self.action_spaces[agent]

    def render(self) -> None:
        """Draws nothing: there is no `render_mode`."""

    def close(self) -> None:
        """Closes nothing."""

    def _begin(self, seed: int | None) -> tuple[dict[str, np.ndarray], Infos]:
        """Starts an episode; observations and infos of all robots."""
        common.require_own_process()
        if seed is not None or self._key is None:
            (word,) = np.random.SeedSequence(seed).generate_state(1)
            self._key = jax.random.key(int(word))
        self._key, self._state, observations, available = _start(self._key, self._robots)
        self.agents = list(self.possible_agents)
        return self._named(observations), self._infos(0.0, available)

    def _advance(
        self, action: int
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Takes the action of the robot whose turn it is; results by the names of `agents`."""
        chosen = np.full(len(self.possible_agents), action, np.int32)
        self._key, self._state, observations, outcome, available = _step(
            self._key, self._robots, self._state, chosen
        )
        return (
            self._named(observations),
            self._named(outcome.rewards, float),
            self._named(outcome.terminated, bool),
            self._named(outcome.truncated, bool),
            self._infos(float(outcome.seconds), available),
        )

    def _turn(self) -> str:
        """The robot that chooses; raises `ResetNeeded` if there is none."""
        if self._state is None or not self.agents:
            raise error.ResetNeeded("step before reset, or after the end of an episode")
        return self.possible_agents[int(self._state.agent)]

    def _checked(self, agent: str, name: str, action: SupportsInt) -> int:
        """An integer of any library; raises `ValueError` if it is no action of the robot."""
        if not self.action_space(agent).contains(np.asarray(action)):
            raise ValueError(f"{name} = {action!r}: must be in {self.action_space(agent)}")
        return int(action)

    def _named(
        self, of_robots: jax.Array, kind: Callable[[np.ndarray], T] = np.array
    ) -> dict[str, T]:
        """`[R, ...]` by the names of the robots that work."""
        of_each = self._robots.named(np.asarray(of_robots))
        return {agent: kind(of_each[agent]) for agent in self.agents}

    def _infos(self, seconds: float, available: jax.Array) -> Infos:
        return {
            agent: {"seconds": seconds, "action_mask": mask.astype(np.int8)}
            for agent, mask in self._named(available).items()
        }


class TeamAECEnv(_Team, AECEnv):
    """A task of a team, or the team MDP, as an `AECEnv`: robots are agents that take turns.

    `agent_selection` is the robot that chooses; it earns the reward of its look before its next
    turn. The methods are PettingZoo's. `seconds` in the infos is the duration of the last action,
    and `action_mask`, `[N + 1]` int8, is 1 for the actions that the robot has.
    """

    def reset(self, seed: int | None = None, options: dict[str, object] | None = None) -> None:
        """Starts an episode.

        Args:
          seed: of all random numbers from here on; by default they continue.
          options: ignored.
        """
        del options
        self._observations, self.infos = self._begin(seed)
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self._skip_agent_selection = None
        self.agent_selection = self._turn()

    def observe(self, agent: str) -> np.ndarray:
        """A robot's observation, `[S]` float32; its last one if it has left."""
        return self._observations[agent].copy()

    def step(self, action: Any) -> None:
        """Takes the action of `agent_selection`.

        Args:
          action: an integer; None for a robot that is done, which then leaves `agents`.

        Raises:
          ResetNeeded: before the first reset, or if the episode has ended.
          ValueError: if there is no such action.
        """
        self._turn()
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        result = self._advance(self._checked(agent, "action", action))
        seen, self.rewards, self.terminations, self.truncations, self.infos = result
        self._observations |= seen  # of robots that have left, the last one stays
        self._cumulative_rewards[agent] = 0.0
        self._accumulate_rewards()
        self.agent_selection = self._turn()
        self._deads_step_first()


class TeamParallelEnv(_Team, ParallelEnv):
    """The same as `TeamAECEnv`, as a `ParallelEnv`: libraries step all agents together.

    In each step only the action of the robot whose turn it is counts. The methods are PettingZoo's.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[dict[str, np.ndarray], Infos]:
        """Starts an episode.

        Args:
          seed: of all random numbers from here on; by default they continue.
          options: ignored.

        Returns:
          For each robot `[S]` float32, and infos as in `step`.
        """
        del options
        return self._begin(seed)

    def step(
        self, actions: dict[str, SupportsInt]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Takes one step.

        Args:
          actions: integers of the agents; only the robot whose turn it is must have one.

        Returns:
          Observations, rewards, terminations, truncations and infos of all robots that worked
          before. The infos are those of `TeamAECEnv`, whose masks allow only NOP to a robot that
          does not choose.

        Raises:
          ResetNeeded: before the first reset, or if the episode has ended.
          ValueError: if there is no such action, or that of the robot whose turn it is is missing.
        """
        turn = self._turn()
        checks.require_type("actions", actions, dict, f"with one of {turn!r}")
        if turn not in actions:
            raise ValueError(f"actions of {sorted(actions)}: must have one of {turn!r}")
        chosen = {
            agent: self._checked(agent, f"actions[{agent!r}]", action)
            for agent, action in actions.items()
            if agent in self.agents
        }
        result = self._advance(chosen[turn])
        _, _, terminations, truncations, _ = result
        self.agents = [a for a in self.agents if not (terminations[a] or truncations[a])]
        return result


def make(name: str) -> TeamAECEnv:
    """Makes the `AECEnv` of a task, see `jaxsense.make`.

    Args:
      name: of the task.

    Raises:
      ConfigError: if there is no such task, or it is not of a team.
    """
    return TeamAECEnv(team.team_task(name))


def make_parallel(name: str) -> TeamParallelEnv:
    """Makes the `ParallelEnv` of a task, see `make`.

    Args:
      name: of the task.

    Raises:
      ConfigError: if there is no such task, or it is not of a team.
    """
    return TeamParallelEnv(team.team_task(name))


@jax.jit
def _start(key: Key, robots: Robots) -> tuple[Key, TeamState, jax.Array, jax.Array]:
    """Next key, state, `[R, S]` observations and `[R, N + 1]` actions that robots have."""
    next_key, key = jax.random.split(key)
    state = robots.start(key)
    return next_key, state, robots.observations(state), team.available(state)


@jax.jit
def _step(
    key: Key, robots: Robots, state: TeamState, actions: jax.Array
) -> tuple[Key, TeamState, jax.Array, TeamOutcome, jax.Array]:
    """Next key, state, observations, outcome and actions that robots have."""
    next_key, key = jax.random.split(key)
    after, outcome = team.step(key, robots.mdp, state, actions)
    return next_key, after, robots.observations(after), outcome, team.available(after)
