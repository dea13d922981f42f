"""Hand-written rules for choosing the next PoI of a team's robot, to compare learned policies with.

All read expected gains of information and times of travel, and return `[N + 1]` values of actions,
of which the highest counts; NOP's, the last, is 0.
"""

import jax
import jax.numpy as jnp

from jaxsense.dqn.team_mdp import Team

_SURE = 1e3  # above the longest way, in seconds
_TAKEN = 1e2  # s, what a robot rather drives than go where another is heading


def nearest(gains: jax.Array, times: jax.Array, team: Team, agent: jax.Array) -> jax.Array:
    """Values PoIs of which the robot expects to learn by its time to look at them.

    Args:
      gains: `[R, N]` expected reward of each robot's look.
      times: `[R, N]` seconds until each robot has looked.
      team: where everybody is; PoIs that other robots head for come last.
      agent: `[]` int32, the robot that chooses.
    """
    cost = times[agent] + _TAKEN * _is_taken(team, agent)
    return _with_nop(_SURE - cost, _is_useful(gains, team)[agent])


def auction(gains: jax.Array, times: jax.Array, team: Team, agent: jax.Array) -> jax.Array:
    """Values most the PoI that the robot wins in an auction, then the others as in `nearest`.

    Each robot at work bids its time for each PoI of which it expects to learn. The lowest bid of
    all wins its PoI, both leave, and so on (Koenig et al. 2006, sequential single-item auctions,
    with one item each). See `nearest` for the arguments.
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
    return nearest(gains, times, team, agent).at[won].add(jnp.where(won < num_pois, _SURE, 0.0))


def rollout(gains: jax.Array, times: jax.Array, team: Team, agent: jax.Array) -> jax.Array:
    """Values PoIs by what one step of the travel model yields: gain for each second.

    See `nearest` for the arguments.
    """
    rate = gains[agent] / times[agent]
    rate /= jnp.where(_is_taken(team, agent), _TAKEN, 1.0)
    return _with_nop(rate, _is_useful(gains, team)[agent])


def _is_useful(gains: jax.Array, team: Team) -> jax.Array:
    return (gains > 0) & team.present[None]


def _is_taken(team: Team, agent: jax.Array) -> jax.Array:
    """`[N]` bool, PoIs that other robots head for."""
    heads = team.target[:, None] == jnp.arange(team.positions.shape[0])[None]
    is_other = team.works & (jnp.arange(len(team.target)) != agent)
    return jnp.any(heads & is_other[:, None], axis=0)


def _with_nop(values: jax.Array, is_useful: jax.Array) -> jax.Array:
    return jnp.append(jnp.where(is_useful, values, -1.0), 0.0)
