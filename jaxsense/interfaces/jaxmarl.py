"""A team as an environment of jaxmarl 0.2: `pip install 'jaxsense[jaxmarl]'`.

`make("team-v0")` makes a task; the names that `jaxmarl.make` knows are fixed.
"""

import functools

import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.interfaces import team
from jaxsense.interfaces.extras import extra, quietly
from jaxsense.tasks.task import TeamTask

with extra("jaxmarl"), quietly():
    from jaxmarl.environments import multi_agent_env, spaces  # pyright: ignore[reportMissingImports]


@pytree  # pyright: ignore[reportGeneralTypeIssues]
class TeamEnvState(multi_agent_env.State):
    """State of `TeamEnv`.

    Attributes:
      done: `[]` bool, the episode has ended.
      step: `[]` int32 choices so far.
      team: the state of the MDP.
    """

    team: TeamState


class TeamEnv(multi_agent_env.MultiAgentEnv):
    """A task of a team, or the team MDP, as a `MultiAgentEnv`: each robot is an agent.

    Robots take turns, see `jaxsense.interfaces.team`. The methods are jaxmarl's.
    """

    def __init__(self, mdp: TeamMdp | TeamTask, config: Config | None = None):
        """Makes the environment.

        Args:
          mdp: a task of a team from `jaxsense.make`, or the MDP of one, see `jaxsense.make_mdp`.
          config: the settings, which name the robots; only with an MDP.

        Raises:
          ValueError: if the MDP has other sensors than the settings.
        """
        self.robots = team.robots_of(mdp, config)
        super().__init__(len(self.robots.names))
        self.agents = list(self.robots.names)
        self.observation_spaces, self.action_spaces = self.robots.spaces(spaces)

    # jaxmarl makes the environment static, here as in its `step`, and with it the MDP.
    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: Key) -> tuple[dict[str, jax.Array], TeamEnvState]:
        """Starts an episode."""
        start = self.robots.start(key)
        state = TeamEnvState(done=jnp.bool_(False), step=start.map.steps, team=start)  # pyright: ignore
        return self.get_obs(state), state

    def step_env(  # pyright: ignore
        self, key: Key, state: TeamEnvState, actions: dict[str, jax.Array]
    ) -> tuple[
        dict[str, jax.Array],
        TeamEnvState,
        dict[str, jax.Array],
        dict[str, jax.Array],
        dict[str, jax.Array],
    ]:
        """Takes one step, without a reset.

        Args:
          key: random key.
          state: the current state.
          actions: of all robots; only that of the robot whose turn it is counts.

        Returns:
          Observations, state, rewards, dones and infos. A robot is done after NOP, and all are at
          the limit; `__all__` is whether the episode is over. `seconds`, `[R]` and the same for
          all, is the duration of the step.

        Raises:
          ValueError: if a robot has no action, or if an action is no integer, or does not exist and
            is not traced.
        """
        checks.require_type("actions", actions, dict, f"with one of each of {self.agents}")
        if not set(self.agents) <= set(actions):
            raise ValueError(
                f"actions of {sorted(actions)}: must have one of each of {self.agents}"
            )
        chosen = jnp.stack([jnp.asarray(actions[agent]) for agent in self.agents])
        after, outcome = team.step(key, self.robots.mdp, state.team, chosen)
        dones = outcome.terminated | outcome.truncated
        ended = jnp.all(dones)
        state = TeamEnvState(done=ended, step=after.map.steps, team=after)  # pyright: ignore
        infos = {"seconds": jnp.full(self.num_agents, outcome.seconds)}
        of_each = {**self.robots.named(dones), "__all__": ended}
        return self.get_obs(state), state, self.robots.named(outcome.rewards), of_each, infos

    def get_obs(self, state: TeamEnvState) -> dict[str, jax.Array]:  # pyright: ignore
        """Observation of each robot, `[S]`, see `team_mdp.observation`."""
        return self.robots.named(self.robots.observations(state.team))

    @functools.partial(jax.jit, static_argnums=0)
    def get_avail_actions(self, state: TeamEnvState) -> dict[str, jax.Array]:
        """Actions that each robot has, `[N + 1]` bool: only NOP if it is not its turn."""
        return self.robots.named(team.available(state.team))

    @property
    def name(self) -> str:
        """Name of the environment."""
        return "jaxsense-Team"

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Robots of each modality."""
        classes: dict[str, list[str]] = {}
        for agent, modality in zip(self.agents, self.robots.modality, strict=True):
            classes.setdefault(modality, []).append(agent)
        return classes


@functools.cache  # jaxmarl makes environments static, see `TeamEnv`
def make(name: str) -> TeamEnv:
    """Makes the environment of a task, see `jaxsense.make`; the same one in every call.

    Args:
      name: of the task.

    Raises:
      ConfigError: if there is no such task, or it is not of a team.
    """
    return TeamEnv(team.team_task(name))
