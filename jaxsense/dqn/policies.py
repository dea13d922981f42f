"""The table of policies, for the MDP and for missions.

A policy maps trained models and what a robot knows to `[N + 1]` values of actions, the highest of
which is taken; the last is NOP's. A custom policy is one more entry of a table.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import ConfigError
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Fusion, Key
from jaxsense.dqn import hybrid
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.team import Known, Team

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
        """Parameters for each modality."""
        ...

    @property
    def tours(self) -> tuple[Params, ...]:
        """Parameters of each network that orders looks."""
        ...


Values = Callable[[Key, Trained, Known], jax.Array]
"""`(key, models, known) -> [N + 1]` values of actions, NOP's last."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """A policy: a function that values looks, and how missions use the values.

    Attributes:
      counts_time: `models -> bool`, whether the values include travel time, so that no other rule
        needs to order looks.
      is_unordered: whether looks that pay may be taken in any order, so that missions choose one,
        see `mission.auctions` in the settings.
      worth: `(key, models, known) -> [N]`, which looks pay: those above 0. By default, values
        minus NOP's.
    """

    values: Values
    counts_time: Callable[["Trained"], bool] = lambda models: False
    is_unordered: bool = False
    worth: Values | None = None


def as_policy(policy: Values | Policy) -> Policy:
    """A custom policy, of which a function alone has only values."""
    return policy if isinstance(policy, Policy) else Policy(policy)


def table(own: Mapping[str, Values | Policy] | None = None) -> dict[str, Policy]:
    """All policies by name: `POLICIES`, then your own."""
    wrapped = {name: as_policy(each) for name, each in (own or {}).items()}
    for name, each in wrapped.items():
        if POLICIES.get(name, each) is not each:
            raise ConfigError("policies", name, f"must not be {', '.join(POLICIES)}")
    return {**POLICIES, **wrapped}


def best(values: Float[Array, " A"]) -> Int[Array, ""]:
    """Action of the highest value, `[]` int32, or -1 if any value is NaN."""
    return jnp.where(jnp.any(jnp.isnan(values)), -1, jnp.argmax(values)).astype(jnp.int32)


def expected_gain(
    fusion: Fusion,
    look_values: tuple[LookValues, ...],
    belief: Belief,
    is_seen: Bool[Array, ""],
) -> Float[Array, " M"]:
    """Expected reward of each modality's next look at one PoI, given the map.

    Args:
      is_seen: whether anybody has looked at the PoI.
    """
    on_map = fusion.class_probabilities(belief)
    return jnp.stack([values.of_next(on_map, is_seen) for values in look_values])


def latent(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Asks the trained Q-network."""
    del key
    own, classes = _own_network(models, known), models.fusion.classes
    return hybrid.decide(models.agent, own, models.tours, classes, known)


def latent_worth(key: Key, models: Trained, known: Known) -> Float[Array, " N"]:
    """Asks the trained Q-network which looks pay."""
    del key
    own, classes = _own_network(models, known), models.fusion.classes
    return hybrid.worth(models.agent, own, classes, known)


def greedy(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes the look with the highest expected gain on the map."""
    del key
    return jnp.append(_gains(models, known)[known.robot], 0.0)


def _by_exact_bayes(read: Callable[..., jax.Array]) -> Values:
    """Reads the values of looks at the exact posterior over the classes."""

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        del key
        exact = jnp.exp(known.log_posterior)
        found = [jax.vmap(read, (None, 0, 0))(x, exact, known.is_seen) for x in models.look_values]
        return jnp.append(jnp.stack(found)[known.modality], 0.0)

    return values


bayes = _by_exact_bayes(LookValues.of_next)
"""Takes the look with the highest expected gain on the exact posterior over the classes."""

optimal = _by_exact_bayes(LookValues.of_all)
"""Takes the look with the highest total gain by dynamic programming on the exact posterior."""


def naive(number: int) -> Values:
    """Explores naively: every PoI gets `number` looks with each sensor, by any of its robots."""

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        del key, models
        times = known.looks[:, known.modality]
        return jnp.append(jnp.where(times < number, 1.0, -1.0), 0.0)

    return values


def random(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes every action with equal chance; one that does not exist is no operation in missions."""
    del models
    number = known.looks.shape[0] + 1
    return jax.nn.one_hot(jax.random.randint(key, (), 0, number), number)


def nearest(
    gains: Float[Array, "R N"], times: Float[Array, "R N"], team: Team, agent: Int[Array, ""]
) -> Float[Array, " A"]:
    """Rule that prefers the nearest PoI with a positive expected gain.

    Args:
      gains: expected reward of each robot's look.
      times: seconds until each robot has looked.
      team: robots and PoIs at this moment; PoIs that other robots head for come last.
      agent: the robot that chooses.
    """
    return _with_nop(1 / (1 + _cost(times, team, agent)), _is_useful(gains, team)[agent])


def auction(
    gains: Float[Array, "R N"], times: Float[Array, "R N"], team: Team, agent: Int[Array, ""]
) -> Float[Array, " A"]:
    """Rule that ranks the PoI won in a sequential auction first, the rest as `nearest` does.

    Each robot at work bids its travel time for each PoI with a positive expected gain. The lowest
    bid wins its PoI, robot and PoI leave, and so on (Koenig et al. 2006, sequential single-item
    auctions, with one item each).
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
    """Rule that prefers the PoI with the highest expected gain for each second."""
    return _with_nop(gains[agent] / _cost(times, team, agent), _is_useful(gains, team)[agent])


def _is_useful(gains: jax.Array, team: Team) -> jax.Array:
    return (gains > 0) & team.present[None]


def _cost(times: jax.Array, team: Team, agent: jax.Array) -> jax.Array:
    return times[agent] + jnp.where(team.is_taken(agent), _TAKEN, 0.0)


def _with_nop(values: jax.Array, is_useful: jax.Array) -> jax.Array:
    return jnp.append(jnp.where(is_useful, values, -1.0), 0.0)


def _by_rule(rule: Callable[[jax.Array, jax.Array, Team, jax.Array], jax.Array]) -> Policy:
    """A hand-written rule on expected gains and the team's travel times, see `nearest`."""

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        del key
        return rule(_gains(models, known), known.times, known.team, known.robot)

    return Policy(values, lambda models: True)


def _gains(models: Trained, known: Known) -> jax.Array:
    """`[R, N]` expected gains of each robot's next look at each PoI, on the map."""
    gain = lambda belief, seen: expected_gain(models.fusion, models.look_values, belief, seen)  # noqa: E731
    of_modality = jax.vmap(gain, out_axes=1)(known.belief, known.is_seen)
    return of_modality[known.team.modality]


def _own_network(models: Trained, known: Known) -> Params:
    """Parameters of the Q-network of the robot's own sensor."""
    return jax.tree.map(lambda *x: jnp.stack(x)[known.modality], *models.q_networks)


POLICIES: dict[str, Policy] = {
    "latent": Policy(latent, lambda models: bool(models.tours), True, latent_worth),
    "network": Policy(latent, lambda models: True),
    "greedy": Policy(greedy, is_unordered=True),
    "bayes": Policy(bayes, is_unordered=True),
    "optimal": Policy(optimal, is_unordered=True),
    "naive": Policy(naive(1), is_unordered=True),
    "naive_2": Policy(naive(2), is_unordered=True),
    "naive_3": Policy(naive(3), is_unordered=True),
    "random": Policy(random),
    "nearest": _by_rule(nearest),
    "auction": _by_rule(auction),
    "rollout": _by_rule(gain_rate),
}
"""Built-in policies, by name."""
