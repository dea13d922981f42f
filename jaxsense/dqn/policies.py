"""The table of policies, for the MDP and for missions.

A policy maps trained models and what a robot knows to `[N + 1]` values of actions, the highest of
which is taken; the last is NOP's. A custom policy is one more entry of a table.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.config import ConfigError
from jaxsense.core.networks import Params
from jaxsense.core.types import Fusion, Key
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.team import Known

_TAKEN = 1e2  # s, detour that a robot prefers to a PoI where another is heading


class Trained(Protocol):
    """What policies read of trained models; see `jaxsense.Models`."""

    @property
    def fusion(self) -> Fusion:
        """How looks update the map."""
        ...

    @property
    def look_values(self) -> tuple[LookValues, ...]:
        """Values of looks, for each modality."""
        ...

    @property
    def agent(self) -> Agent:
        """How the Q-networks are used."""
        ...

    @property
    def q_networks(self) -> tuple[Params, ...]:
        """Parameters for each modality, or of one for all."""
        ...


Values = Callable[[Key, Trained, Known], jax.Array]
"""`(key, models, known) -> [N + 1]` values of actions, NOP's last."""

Gains = Callable[[Trained, Known], jax.Array]
"""`(models, known) -> [R, N]` gains of each robot's next look at each PoI; above 0 if it pays."""

Probabilities = Callable[[Trained, Known], jax.Array]
"""`(models, known) -> [N, C]` probabilities of the classes of each PoI."""

Rule = Callable[[jax.Array, Known], jax.Array]
"""`(gains [R, N], known) -> [N + 1]` values, see `nearest`."""


def table(own: Mapping[str, Values] | None = None) -> dict[str, Values]:
    """All policies by name: `POLICIES`, then your own."""
    for name, each in (own or {}).items():
        if POLICIES.get(name, each) is not each:
            raise ConfigError("policies", name, f"must not be {', '.join(POLICIES)}")
    return {**POLICIES, **(own or {})}


def best(values: Float[Array, " A"]) -> Int[Array, ""]:
    """Action of the highest value, or -1 if any value is NaN."""
    return jnp.where(jnp.any(jnp.isnan(values)), -1, jnp.argmax(values)).astype(jnp.int32)


def latent(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Values of the trained Q-network."""
    del key
    agent, belief, team = models.agent, known.belief, known.team
    if agent.travel is None:
        # A dense network has no input for what is not there: nothing is left to learn about it.
        classes = models.fusion.classes
        apart = jnp.sum((belief.mean[:, None] - classes.mean[None]) ** 2, axis=-1)
        nearest = jax.tree.map(lambda x: jnp.asarray(x)[jnp.argmin(apart, axis=-1)], classes)
        there = team.present[:, None]
        belief = jax.tree.map(lambda own, x: jnp.where(there, own, x), belief, nearest)
    observed = agent.observe(belief, team, known.times, known.robot)
    # Picked parameters would be one network for each row of a batch.
    values = [agent.values(params, observed, known.exists) for params in models.q_networks]
    return values[0] if len(values) == 1 else jnp.stack(values)[known.modality]


def _by_values(read: Callable[..., jax.Array], probabilities: Probabilities) -> Gains:
    """Reads the values of looks at probabilities of the classes."""

    def gains(models: Trained, known: Known) -> jax.Array:
        of_pois, is_seen = probabilities(models, known), known.is_seen
        found = [jax.vmap(read, (None, 0, 0))(x, of_pois, is_seen) for x in models.look_values]
        return jnp.stack(found)[known.team.modality] * jnp.reshape(known.exists, (1, -1))

    return gains


def _exact_posterior(models: Trained, known: Known) -> jax.Array:
    del models
    return jnp.exp(known.log_posterior)


def _on_map(models: Trained, known: Known) -> jax.Array:
    return jax.vmap(models.fusion.class_probabilities)(known.belief)


def _unexplored(number: int) -> Gains:
    """Naive exploration: every PoI gets `number` looks with each sensor, by any of its robots."""

    def gains(models: Trained, known: Known) -> jax.Array:
        del models
        return jnp.where(known.looks.T[known.team.modality] < number, 1.0, -1.0)

    return gains


def random(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes every action with equal chance; one that does not exist is no operation in missions."""
    del models
    number = known.looks.shape[0] + 1
    return jax.nn.one_hot(jax.random.randint(key, (), 0, number), number)


def highest(gains: Float[Array, "R N"], known: Known) -> Float[Array, " A"]:
    """Rule that prefers the PoI with the highest expected gain."""
    return jnp.append(gains[known.robot], 0.0)


def nearest(gains: Float[Array, "R N"], known: Known) -> Float[Array, " A"]:
    """Rule that prefers the nearest PoI with a positive expected gain.

    PoIs that other robots head for come last.

    Args:
      gains: expected reward of each robot's look.
    """
    return _with_nop(1 / (1 + _cost(known)), _is_useful(gains, known)[known.robot])


def auction(gains: Float[Array, "R N"], known: Known) -> Float[Array, " A"]:
    """Rule that ranks the PoI won in a sequential auction first, the rest as `nearest` does.

    Each robot at work bids its travel time for each PoI with a positive expected gain. The lowest
    bid wins its PoI, robot and PoI leave, and so on (Koenig et al. 2006, sequential single-item
    auctions, with one item each).
    """
    bids = jnp.where(_is_useful(gains, known) & known.team.works[:, None], known.times, jnp.inf)

    def sell(_, carry):
        bids, won = carry
        robot, poi = jnp.unravel_index(jnp.argmin(bids), bids.shape)
        is_sold = jnp.isfinite(bids[robot, poi])
        won = won.at[robot].set(jnp.where(is_sold, poi, won[robot]))
        left = bids.at[robot].set(jnp.inf).at[:, poi].set(jnp.inf)
        return jnp.where(is_sold, left, bids), won

    num_robots, num_pois = bids.shape
    nothing = jnp.full(num_robots, num_pois)
    won = jax.lax.fori_loop(0, num_robots, sell, (bids, nothing))[1][known.robot]
    # All other values are at most 1.
    return nearest(gains, known).at[won].add(jnp.where(won < num_pois, 1.0, 0.0))


def gain_rate(gains: Float[Array, "R N"], known: Known) -> Float[Array, " A"]:
    """Rule that prefers the PoI with the highest expected gain for each second."""
    return _with_nop(gains[known.robot] / _cost(known), _is_useful(gains, known)[known.robot])


def _is_useful(gains: jax.Array, known: Known) -> jax.Array:
    return (gains > 0) & known.team.present[None]


def _cost(known: Known) -> jax.Array:
    return known.times[known.robot] + jnp.where(known.team.is_taken(known.robot), _TAKEN, 0.0)


def _with_nop(values: jax.Array, is_useful: jax.Array) -> jax.Array:
    return jnp.append(jnp.where(is_useful, values, -1.0), 0.0)


def _by_rule(rule: Rule, gains: Gains) -> Values:
    """A hand-written rule on expected gains and travel times."""
    return lambda key, models, known: rule(gains(models, known), known)


_GAINS_ON_MAP = _by_values(LookValues.of_next, _on_map)

POLICIES: dict[str, Values] = {
    "latent": latent,
    "greedy": _by_rule(highest, _GAINS_ON_MAP),
    "bayes": _by_rule(auction, _by_values(LookValues.of_next, _exact_posterior)),
    "optimal": _by_rule(auction, _by_values(LookValues.of_all, _exact_posterior)),
    "naive": _by_rule(auction, _unexplored(1)),
    "naive_2": _by_rule(auction, _unexplored(2)),
    "naive_3": _by_rule(auction, _unexplored(3)),
    "random": random,
    "nearest": _by_rule(nearest, _GAINS_ON_MAP),
    "auction": _by_rule(auction, _GAINS_ON_MAP),
    "rollout": _by_rule(gain_rate, _GAINS_ON_MAP),
}
"""Built-in policies, by name.

`latent` is the trained Q-network. `bayes` and `optimal` take looks that pay by the next gain and by
all gains on the exact posterior; `naive_2` looks twice with each sensor. These and `auction` divide
the looks among the robots by an auction.
"""

UNORDERED: dict[str, Values] = {
    "optimal": _by_rule(highest, _by_values(LookValues.of_all, _exact_posterior)),
    "naive": _by_rule(highest, _unexplored(1)),
}
"""The same without travel times, for MDPs in which the order of looks does not matter."""
