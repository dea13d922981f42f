"""A team as an environment of jaxmarl 0.2: `pip install 'jaxsense[jaxmarl]'`.

`make("team-v0")` makes a task; the names that `jaxmarl.make` knows are fixed.
"""

import functools
import sys
from unittest import mock

import jax
import jax.numpy as jnp

from jaxsense import tasks
from jaxsense.config import Config
from jaxsense.core.types import Key, pytree
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.interfaces import common
from jaxsense.tasks.task import Task

# Its import prints, and sets `sys.stdout` to `sys.__stdout__`, which is not where notebooks print.
with (
    common.extra("jaxmarl"),
    mock.patch.multiple(sys, stdout=sys.stderr, __stdout__=sys.stderr, stderr=sys.stderr),
):
    from jaxmarl.environments import multi_agent_env, spaces  # pyright: ignore[reportMissingImports]

OfRobots = dict[str, jax.Array]


@pytree  # pyright: ignore[reportGeneralTypeIssues]
class TeamEnvState(multi_agent_env.State):
    """State of `TeamEnv`.

    Attributes:
      done: `[]` bool, the episode has ended.
      step: `[]` int32 choices so far.
      team: the state of the MDP.
    """

    team: State


class TeamEnv(multi_agent_env.MultiAgentEnv):
    """A task of a team, or the team MDP, as a `MultiAgentEnv`: each robot is an agent.

    Robots take turns, see `jaxsense.interfaces.common.Robots`. A robot is done after NOP, and all
    are at the limit; `__all__` is whether the episode is over. `seconds` in the infos, `[R]` and
    the same for all, is the duration of the step. The methods are jaxmarl's.
    """

    def __init__(self, mdp: Mdp | Task, config: Config | None = None):
        """Makes the environment.

        Args:
          mdp: a task of a team from `jaxsense.make`; or the MDP of a team, see
            `jaxsense.make_mdp`.
          config: the settings, which name the robots; only with an MDP.
        """
        self.robots = common.robots_of(mdp, config)
        super().__init__(len(self.robots.names))
        self.agents = list(self.robots.names)
        of_each = (
            dict.fromkeys(self.agents, x) for x in common.spaces_of(spaces, self.robots.played)
        )
        self.observation_spaces, self.action_spaces = of_each

    # jaxmarl makes the environment static, here as in its `step`, and with it the MDP.
    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: Key) -> tuple[OfRobots, TeamEnvState]:
        """Starts an episode."""
        _, start = self.robots.played.reset(key)
        state = TeamEnvState(done=jnp.bool_(False), step=start.steps, team=start)  # pyright: ignore
        return self.get_obs(state), state

    def step_env(  # pyright: ignore
        self, key: Key, state: TeamEnvState, actions: OfRobots
    ) -> tuple[OfRobots, TeamEnvState, OfRobots, OfRobots, OfRobots]:
        """Takes one step, without a reset; only the action of the robot whose turn it is counts."""
        if not set(self.agents) <= set(actions):
            raise ValueError(f"actions = {actions}: must have one of each of {self.agents}")
        chosen = jnp.stack([jnp.asarray(actions[agent]) for agent in self.agents])
        after, found, seconds = self.robots.step(key, state.team, chosen)
        dones = found.terminated | found.truncated
        ended = jnp.all(dones)
        state = TeamEnvState(done=ended, step=after.steps, team=after)  # pyright: ignore
        infos = {"seconds": jnp.full(self.num_agents, seconds)}
        named = self.robots.named
        of_each = {**named(dones), "__all__": ended}
        return named(found.observation), state, named(found.reward), of_each, infos

    def get_obs(self, state: TeamEnvState) -> OfRobots:  # pyright: ignore
        """Observation of each robot, `[S]`, see `dqn.team.surroundings`."""
        return self.robots.named(self.robots.observe(state.team))

    @functools.partial(jax.jit, static_argnums=0)
    def get_avail_actions(self, state: TeamEnvState) -> OfRobots:
        """Actions that each robot has, `[N + 1]` bool: only NOP if it is not its turn."""
        return self.robots.named(self.robots.action_mask(state.team))


@functools.cache  # jaxmarl makes environments static, see `TeamEnv`
def make(name: str) -> TeamEnv:
    """The environment of a task of a team, see `jaxsense.make`; the same one in every call."""
    return TeamEnv(tasks.make(name))
