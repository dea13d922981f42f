"""The choice of the PoI that a robot looks at next.

With `mission.auctions`, a policy says which looks pay, and an auction over travel times divides
them among the robots. Without, and where values include travel time, the highest value decides.

It reads nothing but what a robot knows, so that `python -m jaxsense.export` takes it along.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.mission import MissionConfig
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import policies
from jaxsense.dqn.policies import Known, Policy
from jaxsense.dqn.team import Team, Travel
from jaxsense.models import Models
from jaxsense.vae.novelty import Novelty

_KEPT, _HEADED_FOR = -1e4, 1e2  # m, larger than any distance


@pytree
class Opinion:
    """What a policy says to a robot that chooses.

    Attributes:
      values: of the A = N + 1 actions, NOP's last.
      gains: of each robot's look at each PoI: above 0 if it pays.
      counts_time: see `Policy`.
      is_unordered: see `Policy`; without it, the gains are 0.
    """

    values: Float[Array, " A"]
    gains: Float[Array, "R N"]
    counts_time: Bool[Array, ""]
    is_unordered: Bool[Array, ""]


@jax.named_scope("mission.ask")
def ask(key: Key, policy: Policy, models: Models, known: Known) -> Opinion:
    """Asks a policy."""
    of_robot = lambda robot: policy.gains(key, models, dataclasses.replace(known, robot=robot))  # noqa: E731
    none, robots = jnp.zeros(known.times.shape), jnp.arange(known.times.shape[0])
    return Opinion(
        values=policy.values(key, models, known),
        gains=jax.vmap(of_robot)(robots) if policy.is_unordered else none,
        counts_time=jnp.bool_(policy.counts_time(models)),
        is_unordered=jnp.bool_(policy.is_unordered),
    )


@jax.named_scope("mission.choose")
def choose(settings: MissionConfig, opinion: Opinion, known: Known) -> Int[Array, ""]:
    """PoI that a robot chooses, N for NOP, or -1 if any value is NaN."""
    values, present = opinion.values, known.team.present
    # Values that include travel time need no order.
    tolerance = jnp.where(opinion.counts_time, 0.0, settings.equal_values)
    of_pois, of_nop = jnp.where(present, values[:-1], -jnp.inf), values[-1]
    is_best = (of_pois >= jnp.max(of_pois) - tolerance) & (of_pois > of_nop)
    by_values = _by_values(known, is_best)
    by_auction = jnp.argmax(policies.auction(opinion.gains, known.times, known.team, known.robot))
    is_auction = settings.auctions & opinion.is_unordered & ~opinion.counts_time
    choice = jnp.where(is_auction, by_auction, by_values)
    is_nan = jnp.any(jnp.isnan(of_pois)) | jnp.isnan(of_nop)
    return jnp.where(is_nan, -1, choice).astype(jnp.int32)


def times_to_new_looks(
    travel: Travel, novelty: Novelty, team: Team, apart: Float[Array, "R N K"]
) -> Float[Array, "R N"]:
    """Seconds until each robot has looked at each PoI from where a look is new.

    Args:
      apart: distances of each robot from earlier looks by its sensor at each PoI, in metres;
        infinite for none.
    """
    metres = jax.vmap(novelty.to_go)(apart, team.modality)
    return travel.times(team) + metres / travel.speed


def _by_values(known: Known, is_best: Bool[Array, " N"]) -> Int[Array, ""]:
    """One of the PoIs with the best values, by the rules; N if there is none."""
    team, robot = known.team, known.robot
    distance = jnp.linalg.norm(team.positions - team.poses[robot, :2][None], axis=-1)
    # Prefer the robot's present target, then PoIs that no other robot heads for, then near ones.
    rank = distance + _KEPT * team.heads[robot] + _HEADED_FOR * team.is_taken(robot)
    poi = jnp.argmin(jnp.where(is_best, rank, jnp.inf))
    return jnp.where(jnp.any(is_best), poi, distance.shape[0])
