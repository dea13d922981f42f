"""The team MDP with each robot as an agent, shared by the interfaces for several agents.

Robots take turns. In each step one robot chooses, and the actions of the others are ignored. Action
n < N heads for PoI n, and action N is NOP, after which the robot is done. If nobody else has to
choose, time passes until the next look. The robot that has looked earns the reward of its look and
chooses next.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn import team_mdp
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.interfaces import common


@struct.dataclass
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


def check_team(mdp: MapMdp | TeamMdp, config: Config) -> None:
    """Checks that an MDP is that of a team with the sensors of the settings.

    Args:
      mdp: the MDP.
      config: the settings.

    Raises:
      ValueError: if it is not.
    """
    if mdp.modalities != config.modalities:
        reason = f"must be a TeamMdp with {config.modalities}, as config.modalities are"
        made = "from jaxsense.make_mdp with dqn.task = 'team'"
        found = f"{type(mdp).__name__} with modalities {mdp.modalities}"
        raise ValueError(f"mdp = {found}: {reason}, {made}")


def team_spaces(spaces: Any, mdp: TeamMdp) -> tuple[Any, Any]:
    """Spaces of what a robot knows, `[F * N]`, and of its actions, see `common.spaces_of`.

    Args:
      spaces: another library's module, with `Box` and `Discrete`.
      mdp: the MDP.
    """
    features = team_mdp.num_features(mdp.map.fusion.prior.mean.size, mdp.map.num_modalities)
    number = mdp.map.num_pois
    return common.spaces_of(spaces, features * number, number + 1, np.inf)


def start(key: Key, mdp: TeamMdp, config: Config) -> TeamState:
    """Starts an episode of the robots of `Config.robots`.

    Args:
      key: random key.
      mdp: the MDP.
      config: the settings, which name the robots.
    """
    return team_mdp.reset(key, mdp, jnp.array(config.modality_of_robot, jnp.int32))


def observations(mdp: TeamMdp, state: TeamState) -> Float[Array, "R S"]:
    """What each robot knows, see `team_mdp.observation`.

    Args:
      mdp: the MDP.
      state: the current state.

    Returns:
      `[R, F * N]`.
    """

    def observation(robot: jax.Array) -> jax.Array:
        belief, number = state.map.belief, mdp.map.num_modalities
        travel = mdp.config.travel
        return team_mdp.observation(travel, belief, state.team, robot, number).reshape(-1)

    return jax.vmap(observation)(jnp.arange(len(state.team.works)))


def available(state: TeamState) -> Bool[Array, "R A"]:
    """Actions that each robot has, `[R, N + 1]`.

    The robot that chooses has the PoIs that are present and NOP; all others have only NOP, which
    does nothing when it is not their turn.
    """
    robots = jnp.arange(len(state.team.works))
    chooses = state.team.works & (robots == state.agent)
    pois = chooses[:, None] & state.team.present[None]
    return jnp.concatenate([pois, jnp.ones((len(robots), 1), bool)], axis=1)


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
        of NaN.

    Returns:
      The next state and the outcome. The robot that has looked, which chooses next, earns the
      reward of its look; each robot that works pays for the time that passed.

    Raises:
      ValueError: if an action does not exist.
    """
    num_robots, num_pois = len(state.team.works), mdp.map.num_pois
    chex.assert_shape(actions, (num_robots,), custom_message="actions")
    checks.require_index("actions", actions, num_pois + 1)
    action = actions[state.agent]
    is_absent = jnp.any(~state.team.present & (jnp.arange(num_pois) == action))
    after, outcome = team_mdp.step(key, mdp, state, jnp.where(is_absent, num_pois, action))
    works, seconds = after.team.works, jnp.asarray(outcome.seconds)
    price = mdp.config.second_cost * seconds
    earned = jnp.where(jnp.arange(num_robots) == after.agent, outcome.reward, 0.0)
    return after, TeamOutcome(
        rewards=earned - jnp.where(works, price, 0.0),
        terminated=~works,
        truncated=works & outcome.truncated,
        seconds=seconds,
    )
