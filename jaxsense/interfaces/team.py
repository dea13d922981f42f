"""The team MDP with each robot as an agent, shared by the interfaces for several agents.

Robots take turns. In each step one robot chooses, and the actions of the others are ignored. Action
n < N heads for PoI n, and action N is NOP, after which the robot is done. If nobody else has to
choose, time passes until the next look. The robot that has looked earns the reward of its look and
chooses next.
"""

from collections.abc import Iterable
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config, ConfigError, names_of_robots
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import team_mdp
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.interfaces import common
from jaxsense.interfaces.common import Spaces
from jaxsense.tasks import make
from jaxsense.tasks.environment import Scaling
from jaxsense.tasks.task import TeamTask

B = TypeVar("B")
D = TypeVar("D")
T = TypeVar("T")


@pytree
class TeamOutcome:
    """Outcome of a choice for each robot.

    Attributes:
      rewards: `[R]` float32.
      terminated: `[R]` bool, robots that are done because they chose NOP.
      truncated: `[R]` bool, robots that would go on, but the episode has reached its limit.
      seconds: `[]` that passed.
    """

    rewards: Float[Array, " R"]
    terminated: Bool[Array, " R"]
    truncated: Bool[Array, " R"]
    seconds: Float[Array, ""]


@pytree
class Unscaled:
    """Leaves the numbers of an observation as `team_mdp.observation` has them, row by row."""

    @property
    def bound(self) -> float:
        """None: infinity."""
        return float("inf")

    def __call__(self, features: Float[Array, "N F"]) -> Float[Array, " S"]:
        """`[F * N]` from `[N, F]`."""
        return features.T.reshape(-1)


@pytree
class Robots:
    """A team, each robot of which is an agent.

    Attributes:
      mdp: the MDP.
      sensors: `[R]` int32 index of each robot's sensor.
      scaling: of observations.
      names: of the robots.
      modality: names of their sensors.
    """

    mdp: TeamMdp
    sensors: jax.Array
    scaling: Scaling | Unscaled
    names: tuple[str, ...] = struct.field(pytree_node=False)
    modality: tuple[str, ...] = struct.field(pytree_node=False)

    def spaces(self, spaces: Spaces[B, D]) -> tuple[dict[str, B], dict[str, D]]:
        """Spaces of what each robot knows, `[S]`, and of its actions, see `common.spaces_of`.

        Args:
          spaces: another library's module.

        Returns:
          Both by the names of the robots.
        """
        num_pois = self.mdp.map.num_pois
        size, bound = self.mdp.num_features * num_pois, self.scaling.bound
        observation, action = common.spaces_of(spaces, size, num_pois + 1, bound)
        return dict.fromkeys(self.names, observation), dict.fromkeys(self.names, action)

    def named(self, of_robots: Iterable[T]) -> dict[str, T]:
        """What each robot has, by its name.

        Args:
          of_robots: `[R, ...]`.
        """
        return dict(zip(self.names, of_robots, strict=True))

    def start(self, key: Key) -> TeamState:
        """Starts an episode of all robots.

        Args:
          key: random key.
        """
        return team_mdp.reset(key, self.mdp, self.sensors)

    def observations(self, state: TeamState) -> Float[Array, "R S"]:
        """What each robot knows, see `team_mdp.observation`.

        Args:
          state: the current state.

        Returns:
          `[R, S]`.
        """

        def observation(robot: jax.Array) -> jax.Array:
            return self.scaling(self.mdp.observe(state, robot).T)

        return jax.vmap(observation)(jnp.arange(len(self.names)))


def robots_of(mdp: TeamMdp | TeamTask, config: Config | None) -> Robots:
    """What an interface for several agents plays.

    Args:
      mdp: a task of a team, see `jaxsense.make`, or the MDP of a team, see `jaxsense.make_mdp`.
      config: the settings, which name the robots; only with an MDP.

    Raises:
      ValueError: if the MDP is not that of a team with the sensors of the settings, or a task has
        its own.
    """
    if isinstance(mdp, TeamTask):
        if config is not None:
            raise ValueError("config: must be None with a task, which has its robots")
        modality = tuple(mdp.mdp.modalities[m] for m in mdp.robots.tolist())
        return Robots(mdp.mdp, mdp.robots, mdp.scaling, names_of_robots(modality), modality)
    if config is None or mdp.modalities != config.modalities:
        sensors = None if config is None else config.modalities
        reason = f"must be a TeamMdp with {sensors}, as config.modalities are"
        made = "from jaxsense.make_mdp with dqn.task = 'team'"
        found = f"{type(mdp).__name__} with modalities {mdp.modalities}"
        raise ValueError(f"mdp = {found}: {reason}, {made}")
    indices = jnp.array(config.modality_of_robot, jnp.int32)
    return Robots(mdp, indices, Unscaled(), config.robot_names, config.carried)


def team_task(name: str) -> TeamTask:
    """A task of a team, see `jaxsense.make`.

    Args:
      name: of the task.

    Raises:
      ConfigError: if there is no such task, or it is not of a team.
    """
    task = make(name)
    if not isinstance(task, TeamTask):
        raise ConfigError("name", name, "must be a task of a team, such as team-v0")
    return task


def available(state: TeamState) -> Bool[Array, "R A"]:
    """Actions that each robot has, `[R, N + 1]`.

    The robot that chooses has the PoIs that are present and NOP; all others have only NOP, which
    does nothing when it is not their turn.
    """
    robots = jnp.arange(len(state.team.works))
    chooses = state.team.works & (robots == state.agent)
    return (chooses[:, None] & team_mdp.action_mask(state)[None]).at[:, -1].set(True)


def step(
    key: Key, mdp: TeamMdp, state: TeamState, actions: Int[Array, " R"]
) -> tuple[TeamState, TeamOutcome]:
    """Lets the robot choose whose turn it is, see `team_mdp.step`.

    Args:
      key: random key.
      mdp: the MDP.
      state: the current state.
      actions: `[R]` int32, of which only that of robot `state.agent` counts. A PoI that is not
        present counts as NOP. Traced actions are not checked: one that does not exist has a reward
        of NaN, in the step in which the robot would look.

    Returns:
      The next state and the outcome. The robot that has looked, which chooses next, earns the
      reward of its look; each robot that works pays for the time that passed.

    Raises:
      ValueError: if an action does not exist.
    """
    num_robots, num_pois = len(state.team.works), mdp.map.num_pois
    checks.require_shape("actions", actions, (num_robots,))
    checks.require_index("actions", actions, num_pois + 1)
    action = team_mdp.existing(state, actions[state.agent])
    after, outcome = team_mdp.step(key, mdp, state, action)
    works, seconds = after.team.works, jnp.asarray(outcome.seconds)
    price = mdp.config.second_cost * seconds
    earned = jnp.where(jnp.arange(num_robots) == after.agent, outcome.reward, 0.0)
    return after, TeamOutcome(
        rewards=earned - jnp.where(works, price, 0.0),
        terminated=~works,
        truncated=works & outcome.truncated,
        seconds=seconds,
    )
