"""Hand-written rules by which a team's robot chooses its next PoI, to compare policies with.

They read expected gains of information and travel times, and return `[N + 1]` values of actions,
the highest of which is taken. The last, NOP's, is 0.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.dqn.team_mdp import Team

_TAKEN = 1e2  # s, detour that a robot prefers to a PoI where another is heading

Rule = Callable[[jax.Array, jax.Array, Team, jax.Array], jax.Array]
"""`(gains [R, N], times [R, N], team, agent []) -> [N + 1]` values; see `nearest`."""


def nearest(
    gains: Float[Array, "R N"], times: Float[Array, "R N"], team: Team, agent: Int[Array, ""]
) -> Float[Array, " A"]:
    """Prefers the nearest PoI with a positive expected gain.

    Args:
      gains: `[R, N]` expected reward of each robot's look.
      times: `[R, N]` seconds until each robot has looked.
      team: robots and PoIs at this moment; PoIs that other robots head for come last.
      agent: `[]` int32, the robot that chooses.
    """
    cost = times[agent] + jnp.where(_is_taken(team, agent), _TAKEN, 0.0)
    return _with_nop(1 / (1 + cost), _is_useful(gains, team)[agent])


def auction(
    gains: Float[Array, "R N"], times: Float[Array, "R N"], team: Team, agent: Int[Array, ""]
) -> Float[Array, " A"]:
    """Ranks the PoI won in a sequential auction first, the rest as `nearest` does.

    Each robot at work bids its travel time for each PoI with a positive expected gain. The lowest
    bid wins its PoI, robot and PoI leave, and so on (Koenig et al. 2006, sequential single-item
    auctions, with one item each).

    Args:
      gains: see `nearest`.
      times: see `nearest`.
      team: see `nearest`.
      agent: see `nearest`.
    """
    bids = jnp.where(_is_useful(gains, team) & team.works[:, None], times, jnp.inf)

    def sell(_, carry):
        bids, won = carry
        robot, poi = jnp.unravel_index(jnp.argmin(bids), bids.shape)
        is_sold = jnp.isfinite(bids[robot, poi])
        won = won.at[robot].set(jnp.where(is_sold, poi, won[robot]))
        left = bids.at[robot].set(jnp.inf).at[:, poi].set(jnp.inf)
        return jnp.where(is_sold, left, bids), won

    num_robots, num_pois = bids.shape
    nothing = jnp.full(num_robots, num_pois)
    won = jax.lax.fori_loop(0, num_robots, sell, (bids, nothing))[1][agent]
    # All other values are at most 1.
    return nearest(gains, times, team, agent).at[won].add(jnp.where(won < num_pois, 1.0, 0.0))


def gain_rate(
    gains: Float[Array, "R N"], times: Float[Array, "R N"], team: Team, agent: Int[Array, ""]
) -> Float[Array, " A"]:
    """Prefers the PoI with the highest expected gain for each second.

    Args:
      gains: see `nearest`.
      times: see `nearest`.
      team: see `nearest`.
      agent: see `nearest`.
    """
    rate = gains[agent] / (times[agent] + jnp.where(_is_taken(team, agent), _TAKEN, 0.0))
    return _with_nop(rate, _is_useful(gains, team)[agent])


def _is_useful(gains: jax.Array, team: Team) -> jax.Array:
    return (gains > 0) & team.present[None]


def _is_taken(team: Team, agent: jax.Array) -> jax.Array:
    """`[N]` bool, PoIs that other robots head for."""
    heads = team.target[:, None] == jnp.arange(team.positions.shape[0])[None]
    is_other = team.works & (jnp.arange(team.target.shape[0]) != agent)
    return jnp.any(heads & is_other[:, None], axis=0)


def _with_nop(values: jax.Array, is_useful: jax.Array) -> jax.Array:
    return jnp.append(jnp.where(is_useful, values, -1.0), 0.0)
