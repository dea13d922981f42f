"""What missions read from a Q-network where hand-written rules choose among the looks that pay.

The rules are those of `mission.decide`; here is which looks pay, and in which order.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.core.networks import Params
from jaxsense.core.types import Belief
from jaxsense.dqn import tours
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.team import Known, Team, alone

_NOT_WORTH_IT = -1e6  # s, below minus any tour


def decide(
    agent: Agent, params: Params, tour_params: tuple[Params, ...], classes: Belief, known: Known
) -> Float[Array, " A"]:
    """Values of a robot's actions in a mission.

    Without travel, a PoI that is not present is shown to the network as one of a known class, about
    which nothing is left to learn. As its class is unknown, the values are means over all classes.

    With travel, the values rank PoIs by predicted completion time. A look is worthwhile if its
    Q-value, were it the only one left, exceeds the price of the travel time. If no look is, judge
    as if the robot were alone, see `worth`: a robot that leaves a PoI to one that is nearer stays
    until that look was enough. The value of a worthwhile look is minus the predicted seconds of
    `tours`; that of NOP is lower, and those of other looks are lowest. Without `tour_params`, the
    values are those of the agent, and lowest for looks that are worth nothing.
    """
    belief, team, robot = known.belief, known.team, known.robot
    if agent.travel is None:

        def values_if(of_class: Belief) -> jax.Array:
            there = team.present[:, None]
            seen = jax.tree.map(lambda own, x: jnp.where(there, own, x[None]), belief, of_class)
            return agent.values(params, agent.observe(seen, team, robot))

        values = jnp.mean(jax.vmap(values_if)(classes), axis=0)
        return jnp.where(team.action_mask, values, -jnp.inf)

    seen = agent.observe(belief, team, robot)
    is_useless = worth(agent, params, classes, known) <= 0
    if not tour_params:
        values = agent.values(params, seen)
        return jnp.append(jnp.where(is_useless, _NOT_WORTH_IT, values[:-1]), values[-1])
    after = _q_alone(agent, params, classes, belief, team, robot)
    is_own = (agent.less_way(after, seen) > 0) & team.present
    is_worth_it = jnp.where(jnp.any(is_own), is_own, ~is_useless)
    seconds = tours.seconds(agent, tour_params[0], seen)
    of_pois = jnp.where(is_worth_it, -seconds, 2 * _NOT_WORTH_IT)
    # Comparisons with NaN are false; propagate it instead.
    return jnp.append(jnp.where(jnp.isnan(after), after, of_pois), _NOT_WORTH_IT)


def worth(agent: Agent, params: Params, classes: Belief, known: Known) -> Float[Array, " N"]:
    """Value of a look at each PoI less NOP's, were no other PoI left, nor other robot at work.

    In a map with other open PoIs, a look that gains nothing is still worth what can be done after
    it. Who looks is for others to say: the network would leave a PoI to a robot that is nearer.
    """
    belief, team, robot = known.belief, known.team, known.robot
    num_pois = team.present.shape[0]  # not `len`: exported programs have any number
    if agent.travel is None:

        def of_poi(poi: Int[Array, ""]) -> jax.Array:
            only = dataclasses.replace(team, present=team.present & (jnp.arange(num_pois) == poi))
            values = decide(agent, params, (), classes, dataclasses.replace(known, team=only))
            return values[poi] - values[-1]

        return jax.vmap(of_poi)(jnp.arange(num_pois))
    single = dataclasses.replace(alone(num_pois, team.modality[robot]), present=team.present)
    after = _q_alone(agent, params, classes, belief, single, jnp.int32(0))
    return agent.less_way(after, agent.observe(belief, team, robot))


def _q_alone(
    agent: Agent, params: Params, classes: Belief, belief: Belief, team: Team, robot: Int[Array, ""]
) -> Float[Array, " N"]:
    """Q-value of a look at each PoI if nothing were left to learn about the others.

    The Q-value of a useless look holds what the robot can still learn elsewhere. So all other PoIs
    are shown to the network as known: as of the class that is nearest to their beliefs. What it
    then still finds in a look at a known PoI is an error, and taken off.
    """
    apart = jnp.sum((belief.mean[:, None] - classes.mean[None]) ** 2, axis=-1)
    nearest = jnp.argmin(apart, axis=-1)
    known = Belief(jnp.asarray(classes.mean)[nearest], jnp.asarray(classes.std)[nearest])
    seen, seen_known = (agent.observe(x, team, robot) for x in (belief, known))
    of_look = agent.q(params, seen, seen_known)[:-1]
    of_known = agent.q(params, seen_known)[:-1]
    # Where there is no PoI both are far below any reward.
    return jnp.where(team.present, of_look - of_known + agent.useless, of_look)
