"""The table of policies, for the map MDP and for missions.

A policy maps trained models and what a robot knows to `[N + 1]` values of actions, the highest of
which is taken; the last is NOP's. A custom policy is one more entry of a table.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import ConfigError
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Fusion, Key, pytree
from jaxsense.dqn import rules
from jaxsense.dqn.environments import Agent
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.team_mdp import Team


@pytree
class Known:
    """Input of a policy: what a robot knows when it chooses.

    Attributes:
      belief: `[N, D]` the map.
      looks: `[N, M]` int32, looks of each modality at each PoI.
      log_posterior: `[N, C]` logarithms of the classes' probabilities by exact Bayes.
      team: robots and PoIs at this moment; PoIs that the robot has given up are not present.
      times: `[R, N]` seconds until each robot has looked at each PoI, by the travel model.
      robot: `[]` int32, the robot that chooses.
    """

    belief: Belief
    looks: jax.Array
    log_posterior: jax.Array
    team: Team
    times: jax.Array
    robot: jax.Array

    @property
    def modality(self) -> jax.Array:
        """`[]` int32 index of the robot's own sensor."""
        return self.team.modality[self.robot]

    @property
    def is_seen(self) -> jax.Array:
        """Mask `[N]` of the PoIs that any robot has looked at."""
        return jnp.any(self.looks > 0, axis=-1)


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
      values: see `Values`.
      counts_time: `agent -> bool`, whether the values include travel time, so that no other rule
        needs to order looks.
      is_unordered: whether looks that pay may be taken in any order, so that missions choose one,
        see `mission.auctions` in the settings.
      worth: `(key, models, known) -> [N]`, which looks pay: those above 0. By default, values
        minus NOP's.
    """

    values: Values
    counts_time: Callable[[Agent], bool] = lambda agent: False
    is_unordered: bool = False
    worth: Values | None = None

    def gains(self, key: Key, models: "Trained", known: Known) -> Float[Array, " N"]:
        """Numbers above 0 for the looks that pay, see `worth`.

        Args:
          key: random key.
          models: trained models.
          known: what the robot knows.
        """
        if self.worth is not None:
            return self.worth(key, models, known)
        values = self.values(key, models, known)
        return values[:-1] - values[-1]


def as_policy(policy: Values | Policy) -> Policy:
    """A custom policy, of which a function alone has only values."""
    return policy if isinstance(policy, Policy) else Policy(policy)


def table(own: Mapping[str, Values | Policy] | None = None) -> dict[str, Policy]:
    """All policies by name: `POLICIES`, then your own.

    Raises:
      ConfigError: if a custom policy has the name of one of `POLICIES`.
    """
    wrapped = {name: as_policy(each) for name, each in (own or {}).items()}
    for name, each in wrapped.items():
        if POLICIES.get(name, each) is not each:
            raise ConfigError("policies", name, f"must not be {', '.join(POLICIES)}")
    return {**POLICIES, **wrapped}


def best(values: Float[Array, " A"]) -> Int[Array, ""]:
    """Action of the highest value, `[]` int32, or -1 if any value is NaN."""
    return jnp.where(jnp.any(jnp.isnan(values)), -1, jnp.argmax(values)).astype(jnp.int32)


def expected_gains(
    fusion: Fusion,
    look_values: tuple[LookValues, ...],
    belief: Belief,
    is_seen: Bool[Array, " N"],
) -> Float[Array, "M N"]:
    """Expected reward of each modality's next look at each PoI, given the map.

    Args:
      fusion: reads the map.
      look_values: of each modality.
      belief: `[N, D]` the map.
      is_seen: `[N]` bool.

    Returns:
      `[M, N]`.
    """
    of_poi = jax.vmap(functools.partial(expected_gain, fusion, look_values), out_axes=1)
    return of_poi(belief, is_seen)


def expected_gain(
    fusion: Fusion,
    look_values: tuple[LookValues, ...],
    belief: Belief,
    is_seen: Bool[Array, ""],
) -> Float[Array, " M"]:
    """Expected reward of each modality's next look at one PoI, given the map.

    Args:
      fusion: reads the map.
      look_values: of each modality.
      belief: `[D]` of the PoI.
      is_seen: `[]` bool.

    Returns:
      `[M]`.
    """
    on_map = fusion.class_probabilities(belief)
    return jnp.stack([values.of_next(on_map, is_seen) for values in look_values])


def latent(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Asks the trained Q-network.

    Args:
      key: not used.
      models: trained models.
      known: what the robot knows.
    """
    del key
    return models.agent.decide(
        _own_network(models, known),
        models.tours,
        models.fusion.classes,
        known.belief,
        known.team,
        known.robot,
    )


def latent_worth(key: Key, models: Trained, known: Known) -> Float[Array, " N"]:
    """Asks the trained Q-network which looks pay.

    Args:
      key: not used.
      models: trained models.
      known: what the robot knows.
    """
    del key
    q_network, classes = _own_network(models, known), models.fusion.classes
    return models.agent.worth(q_network, classes, known.belief, known.team, known.robot)


def greedy(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes the look with the highest expected gain on the map.

    Args:
      key: not used.
      models: trained models.
      known: what the robot knows.
    """
    del key
    return jnp.append(_gains(models, known)[known.robot], 0.0)


def bayes(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes the look with the highest expected gain on the exact posterior over the classes.

    Args:
      key: not used.
      models: trained models.
      known: what the robot knows.
    """
    del key
    exact = jnp.exp(known.log_posterior)
    gains = [jax.vmap(x.of_next)(exact, known.is_seen) for x in models.look_values]
    return jnp.append(jnp.stack(gains)[known.modality], 0.0)


def optimal(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes the look with the highest total gain by dynamic programming on the exact posterior.

    Args:
      key: not used.
      models: trained models.
      known: what the robot knows.
    """
    del key
    exact = jnp.exp(known.log_posterior)
    values = [jax.vmap(x.of_all)(exact, known.is_seen) for x in models.look_values]
    return jnp.append(jnp.stack(values)[known.modality], 0.0)


def naive(number: int) -> Values:
    """Explores naively: every PoI gets `number` looks with each sensor, by any of its robots."""

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        del key, models
        times = known.looks[:, known.modality]
        return jnp.append(jnp.where(times < number, 1.0, -1.0), 0.0)

    return values


def random(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes every action with equal chance; one that does not exist is no operation in missions.

    Args:
      key: random key.
      models: not used.
      known: what the robot knows.
    """
    del models
    number = len(known.looks) + 1
    return jax.nn.one_hot(jax.random.randint(key, (), 0, number), number)


def _by_rule(rule: rules.Rule) -> Values:
    """A hand-written rule on expected gains and the team's travel times."""

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        del key
        gains = _gains(models, known)
        return rule(gains, known.times, known.team, known.robot)

    return values


def _gains(models: Trained, known: Known) -> jax.Array:
    """`[R, N]` expected gains of each robot's next look at each PoI, on the map."""
    of_modality = expected_gains(models.fusion, models.look_values, known.belief, known.is_seen)
    return of_modality[known.team.modality]


def _own_network(models: Trained, known: Known) -> Params:
    """Parameters of the Q-network of the robot's own sensor."""
    return jax.tree.map(lambda *x: jnp.stack(x)[known.modality], *models.q_networks)


def _always(agent: Agent) -> bool:
    """Says that a policy's highest value is its choice, which no rule of missions changes."""
    del agent
    return True


POLICIES: dict[str, Policy] = {
    "latent": Policy(latent, lambda agent: agent.counts_time, True, latent_worth),
    "network": Policy(latent, _always),
    "greedy": Policy(greedy, is_unordered=True),
    "bayes": Policy(bayes, is_unordered=True),
    "optimal": Policy(optimal, is_unordered=True),
    "naive": Policy(naive(1), is_unordered=True),
    "naive_2": Policy(naive(2), is_unordered=True),
    "naive_3": Policy(naive(3), is_unordered=True),
    "random": Policy(random),
    "nearest": Policy(_by_rule(rules.nearest), _always),
    "auction": Policy(_by_rule(rules.auction), _always),
    "rollout": Policy(_by_rule(rules.gain_rate), _always),
}
"""Built-in policies, by name."""
