"""The part that the interfaces for several agents share: a team in which each robot is an agent.

Robots take turns. In a step, the robot whose turn it is chooses; actions of others are ignored.
Action n < N heads for PoI n, and action N is NOP, which ends the robot's part. If nobody else has
to choose, time passes until the next look. The robot that has looked earns the look's reward, and
it is its turn.
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn import team_mdp
from jaxsense.dqn.team_mdp import TeamMdp, TeamState


@struct.dataclass
class TeamOutcome:
    """Outcome of a choice for each robot.

    Attributes:
      rewards: `[R]` float32.
      terminated: `[R]` bool, robots whose part is over because they chose NOP.
      truncated: `[R]` bool, robots that would go on, but the episode has reached its limit.
      seconds: `[]` that passed.
    """

    rewards: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    seconds: jax.Array


def check_team(mdp: TeamMdp, config: Config) -> None:
    """Raises `ValueError` unless it is the MDP of a team with the sensors of the settings."""
    if not isinstance(mdp, TeamMdp):
        raise ValueError(f"mdp = {type(mdp).__name__}: must be a TeamMdp, from interfaces.team_mdp")
    if config.modalities != mdp.modalities:
        raise ValueError(
            f"config.modalities = {config.modalities}: must be {mdp.modalities}, as in mdp"
        )


def observation_size(mdp: TeamMdp) -> int:
    """Numbers in an observation of one robot, `F * N`."""
    features = team_mdp.num_features(mdp.map.fusion.prior.mean.size, mdp.map.num_modalities)
    return features * mdp.map.num_pois


def start(key: Key, mdp: TeamMdp, config: Config) -> TeamState:
    """Starts an episode of the robots of `Config.robots`."""
    return team_mdp.reset(key, mdp, jnp.array(config.modality_of_robot, jnp.int32))


def observations(mdp: TeamMdp, state: TeamState) -> jax.Array:
    """What each robot knows, `[R, F * N]`, see `team_mdp.observation`."""

    def observation(robot: jax.Array) -> jax.Array:
        belief, number = state.map.belief, mdp.map.num_modalities
        travel = mdp.config.travel
        return team_mdp.observation(travel, belief, state.team, robot, number).reshape(-1)

    return jax.vmap(observation)(jnp.arange(len(state.team.works)))


def available(state: TeamState) -> jax.Array:
    """Actions that each robot has, `[R, N + 1]` bool.

    The robot that chooses has the PoIs that are present and NOP; all others have only NOP, which
    means nothing when it is not their turn.
    """
    robots = jnp.arange(len(state.team.works))
    chooses = state.team.works & (robots == state.agent)
    pois = chooses[:, None] & state.team.present[None]
    return jnp.concatenate([pois, jnp.ones((len(robots), 1), bool)], axis=1)


def step(
    key: Key, mdp: TeamMdp, state: TeamState, actions: jax.Array
) -> tuple[TeamState, TeamOutcome]:
    """Lets the robot choose whose turn it is, see `team_mdp.step`.

    Args:
      key: random key.
      mdp: the MDP.
      state: the current state.
      actions: `[R]` int32, of which only that of robot `state.agent` counts. A PoI that is not
        present counts as NOP. Under `jit` nothing can be checked: an action that does not exist
        has a reward of NaN.

    Returns:
      The next state and the outcome. The robot that has looked, which chooses next, earns the
      reward of its look; each robot that works pays for the time that passed.
    """
    num_robots, num_pois = len(state.team.works), mdp.map.num_pois
    chex.assert_shape(actions, (num_robots,), custom_message="actions")
    checks.require_index("actions", actions, num_pois + 1)
    action = actions[state.agent]
    is_absent = jnp.any(~state.team.present & (jnp.arange(num_pois) == action))
    after, outcome = team_mdp.step(key, mdp, state, jnp.where(is_absent, num_pois, action))
    works, seconds = after.team.works, outcome.seconds
    price = mdp.config.second_cost * seconds  # pyright: ignore
    earned = jnp.where(jnp.arange(num_robots) == after.agent, outcome.reward, 0.0)
    return after, TeamOutcome(
        rewards=earned - jnp.where(works, price, 0.0),
        terminated=~works,
        truncated=works & outcome.truncated,
        seconds=seconds,  # pyright: ignore
    )
