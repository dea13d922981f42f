"""The MDP of a team as a `ParallelEnv` of PettingZoo: `pip install 'jaxsense[pettingzoo]'`."""

import functools
from typing import Any

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.interfaces import team
from jaxsense.interfaces.extras import extra
from jaxsense.interfaces.team import TeamOutcome

with extra("pettingzoo"):
    from gymnasium import error, spaces  # pyright: ignore[reportMissingImports]
    from pettingzoo import ParallelEnv  # pyright: ignore[reportMissingImports]


class TeamParallelEnv(ParallelEnv):
    """The MDP of a team: each robot of `Config.robots` is an agent of its name.

    Robots take turns, see `jaxsense.interfaces.team`. All methods are those of PettingZoo.
    """

    def __init__(self, mdp: TeamMdp, config: Config):
        """Makes the environment; call `reset` before the first step.

        Args:
          mdp: the MDP, see `interfaces.team_mdp`.
          config: the settings, which name the robots.

        Raises:
          ValueError: if the MDP has other sensors than the settings.
        """
        team.check_team(mdp, config)
        self.metadata = {"name": "jaxsense_team_v0", "render_modes": []}
        self.render_mode = None
        self.possible_agents = list(config.robot_names)
        self.agents: list[str] = []
        size = (team.observation_size(mdp),)
        self.observation_spaces = {
            agent: spaces.Box(-np.inf, np.inf, size, np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: spaces.Discrete(mdp.map.num_pois + 1) for agent in self.possible_agents
        }
        self._nop = mdp.map.num_pois
        self._state: TeamState | None = None
        self._key: Key | None = None
        self._start = jax.jit(functools.partial(_start, mdp, config))
        self._step = jax.jit(functools.partial(_step, mdp))

    def observation_space(self, agent: str) -> spaces.Box:
        """Space of what a robot knows, `[F * N]`."""
        return self.observation_spaces[agent]  # pyright: ignore

    def action_space(self, agent: str) -> spaces.Discrete:
        """Space of a robot's actions: each PoI, and NOP."""
        return self.action_spaces[agent]  # pyright: ignore

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Starts an episode.

        Args:
          seed: of all random numbers from here on; by default they continue.
          options: ignored.

        Returns:
          For each robot `[F * N]` float32, and infos as in `step`.
        """
        del options
        if seed is not None or self._key is None:
            (word,) = np.random.SeedSequence(seed).generate_state(1)
            self._key = jax.random.key(int(word))
        self._key, self._state, observations, available = self._start(self._key)
        self.agents = list(self.possible_agents)
        return self._named(observations), self._infos(0.0, available)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, np.ndarray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Takes one step.

        Args:
          actions: integers of the agents; only the robot whose turn it is must have one.

        Returns:
          Observations, rewards, terminations, truncations and infos of all robots that worked
          before. `seconds` in the infos are those that passed, and `action_mask`, `[N + 1]` int8,
          is 1 for the actions that the robot has: only NOP if it is not its turn.

        Raises:
          ResetNeeded: before the first reset, or if the episode has ended.
          ValueError: if there is no such action, or that of the robot whose turn it is is missing.
        """
        if self._state is None or not self.agents:
            raise error.ResetNeeded("step before reset, or after the end of an episode")
        self._key, self._state, observations, outcome, available = self._step(
            self._key, self._state, self._chosen(actions)
        )
        terminations = self._named(outcome.terminated, bool)
        truncations = self._named(outcome.truncated, bool)
        result = (
            self._named(observations),
            self._named(outcome.rewards, float),
            terminations,
            truncations,
            self._infos(float(outcome.seconds), available),
        )
        self.agents = [a for a in self.agents if not (terminations[a] or truncations[a])]
        return result

    def _chosen(self, actions: dict[str, Any]) -> np.ndarray:
        """`[R]` int32 actions; raises what `step` raises about them."""
        turn = self.possible_agents[int(self._state.agent)]  # pyright: ignore
        if turn not in actions:
            raise ValueError(f"actions of {sorted(actions)}: must have one of {turn!r}")
        chosen = np.full(len(self.possible_agents), self._nop, np.int32)
        for i, agent in enumerate(self.possible_agents):
            if agent in actions and agent in self.agents:
                space = self.action_space(agent)
                if not space.contains(actions[agent]):
                    raise ValueError(f"actions[{agent!r}] = {actions[agent]!r}: must be in {space}")
                chosen[i] = actions[agent]
        return chosen

    def _named(self, of_robots: jax.Array, kind: Any = np.array) -> dict[str, Any]:
        """`[R, ...]` by the names of the robots that work."""
        of_each = dict(zip(self.possible_agents, np.asarray(of_robots), strict=True))
        return {agent: kind(of_each[agent]) for agent in self.agents}

    def _infos(self, seconds: float, available: jax.Array) -> dict[str, dict[str, Any]]:
        masks = self._named(available)
        return {
            agent: {"seconds": seconds, "action_mask": mask.astype(np.int8)}
            for agent, mask in masks.items()
        }


def _start(mdp: TeamMdp, config: Config, key: Key) -> tuple[Key, TeamState, jax.Array, jax.Array]:
    """Next key, state, `[R, F * N]` observations and `[R, N + 1]` actions that robots have."""
    next_key, key = jax.random.split(key)
    state = team.start(key, mdp, config)
    return next_key, state, team.observations(mdp, state), team.available(state)


def _step(
    mdp: TeamMdp, key: Key, state: TeamState, actions: jax.Array
) -> tuple[Key, TeamState, jax.Array, TeamOutcome, jax.Array]:
    """Next key, state, observations, outcome and actions that robots have."""
    next_key, key = jax.random.split(key)
    after, outcome = team.step(key, mdp, state, actions)
    return next_key, after, team.observations(mdp, after), outcome, team.available(after)
