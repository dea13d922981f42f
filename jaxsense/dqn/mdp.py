"""The shared map as a Markov decision process.

Korthals et al. 2018, Sec. III and IV. The map holds a Gaussian belief for each of N points of
interest. Action n < N looks at PoI n with the robot's own sensor and updates its belief; action N
is no operation (NOP), after which the robot is done. The episode ends with the last robot.

Without `teams`, one robot looks in every step: the paper's MDP. With them, robots take turns. In
each step one robot chooses; if all have chosen, time passes until a robot arrives and looks, which
chooses next; then, as in missions, those that are on their way choose anew. For each robot this is
a semi-Markov decision process (Sutton, Precup and Singh 1999, Artificial Intelligence 112, Sec. 3):
an action takes the time until its look.
"""

import dataclasses
import functools
from typing import Protocol

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from jaxsense.config import MdpConfig
from jaxsense.core import checks
from jaxsense.core.novelty import Novelty
from jaxsense.core.types import Belief, Fusion, Index, Key, Scene, call, pytree
from jaxsense.dqn.rewards import Reward
from jaxsense.dqn.team import (
    NO_TRAVEL,
    Team,
    Teams,
    Travel,
    num_features,
    surroundings,
    to_go,
)

RECENT = 4
"""Looks by a sensor at a PoI whose places are remembered."""
NEVER = 1e6
"""Coordinate of a place far from everything, where no look has been, in metres."""


class LookSource(Protocol):
    """Protocol of the source of an MDP's looks, for example `Bank` or `Live`; a frozen pytree."""

    @property
    def num_modalities(self) -> int:
        """M."""
        ...

    def scene(self, key: Key, classes: Int[Array, " N"]) -> Scene:
        """A random scene with PoIs of the given classes."""
        ...

    def observe(
        self,
        key: Key,
        scene: Scene,
        poi: Int[Array, ""],
        modality: int,
        distance: Float[Array, ""] | float,
    ) -> tuple[Float[Array, " L"], Scene]:
        """Looks at a PoI.

        Args:
          distance: from the PoI, in metres; 0 without travel, for a look from anywhere.

        Returns:
          Features, one for each label, and the scene after the look.
        """
        ...


@pytree
class Mdp:
    """The MDP of robots that share one map.

    Attributes:
      config: length and starts of episodes.
      num_pois: number of PoIs; of teams, the largest.
      robots: index of each robot's sensor.
      teams: how robots travel; None for one robot that looks once in each step.
    """

    looks: LookSource
    fusion: Fusion
    reward: Reward
    config: MdpConfig
    num_pois: int = struct.field(pytree_node=False)
    robots: Int[Array, " R"] | tuple[Index, ...]
    teams: Teams | None = None

    @property
    def num_modalities(self) -> int:
        """M, the number of sensors."""
        return self.looks.num_modalities

    @property
    def num_actions(self) -> int:
        """A: a look at each PoI, and NOP."""
        return self.num_pois + 1

    @property
    def num_classes(self) -> int:
        """C, the number of classes that a PoI can have."""
        return len(self.fusion.classes.mean)

    @property
    def num_features(self) -> int:
        """F, numbers that a robot knows of each PoI, see `features`."""
        size = self.fusion.prior.mean.size
        return 2 * size if self.teams is None else num_features(size, self.num_modalities)

    @property
    def travel(self) -> Travel:
        """How long a look takes."""
        return NO_TRAVEL if self.teams is None else self.teams.travel

    @property
    def is_single(self) -> bool:
        """Whether there is one robot, whose sensor is then the same in all episodes."""
        return len(self.robots) == 1

    def sensor(self, team: Team, robot: Int[Array, ""]) -> Index:
        """Index of a robot's sensor."""
        return self.robots[0] if self.is_single else team.modality[robot]

    def of(self, modality: Index) -> "Mdp":
        """The MDP in which the only robot has another sensor."""
        checks.require_index("modality", modality, self.num_modalities)
        teams = self.teams and dataclasses.replace(self.teams, is_random=False)
        return dataclasses.replace(self, robots=(modality,), teams=teams)

    def information(self, belief: Belief) -> Float[Array, ""]:
        """Information of a belief, in units of the reward."""
        return self.reward.information(belief, self.fusion.class_probabilities(belief))

    def features(
        self, belief: Belief, team: Team, times: Float[Array, "R N"], robot: Int[Array, ""]
    ) -> Float[Array, "N F"]:
        """What a robot knows of each PoI: its belief; of a team see `surroundings`."""
        if self.teams is None:
            return jnp.concatenate([belief.mean, belief.std], axis=-1)
        return surroundings(belief, team, times, robot, self.num_modalities).T

    def times(self, state: "State") -> Float[Array, "R N"]:
        """Seconds until each robot has looked at each PoI from where a look is new."""
        return self.travel.times(state.team, self.to_go(state))

    def to_go(self, state: "State") -> Float[Array, "R N"]:
        """Metres that each robot goes round each PoI until its look is new."""
        if self.novelty is None or (places := state.looked_from) is None:
            return jnp.zeros(state.team.heads.shape)
        apart = lambda place, poi, modality: _apart(place, places[poi, modality])  # noqa: E731
        return to_go(self.novelty, self.travel, state.team, apart)

    @property
    def novelty(self) -> Novelty | None:
        """How new looks are; None where all are."""
        return None if self.teams is None else self.teams.novelty

    def earned(self, outcome: "Outcome", team: Team) -> Float[Array, ""]:
        """The reward, less the price of time of all robots that then work."""
        number = jnp.sum(team.works, dtype=outcome.seconds.dtype)
        return outcome.reward - self.second_cost * outcome.seconds * number

    @property
    def second_cost(self) -> jax.Array | float:
        """Price of a second of each robot that works."""
        return 0.0 if self.teams is None else self.teams.config.second_cost


@pytree
class State:
    """The map, the scene that it describes, and the robots before one of them chooses.

    Attributes:
      seen: `[N, M]` bool, which modalities have looked at which PoI; hidden from the policies.
      classes: `[N]` int32 true classes; hidden from the policies.
      scene: what the looks see; hidden from the policies.
      steps: `[]` int32 choices so far.
      asks: `[R]` bool, robots that have yet to choose at this moment; at first all that work.
      agent: `[]` int32 the robot that chooses.
      looked: `[R]` seconds that each robot has been looking.
      looked_from: `[N, M, K, 2]` places of each modality's last looks at each PoI, in metres;
        far away for none; None where all looks are new.
      seconds: `[]` since the start; without travel, looks.
    """

    belief: Belief
    seen: jax.Array
    classes: jax.Array
    scene: Scene
    steps: jax.Array
    team: Team
    asks: jax.Array
    agent: jax.Array
    looked: jax.Array
    looked_from: jax.Array | None
    seconds: jax.Array


@pytree
class Outcome:
    """Outcome of a choice.

    Attributes:
      reward: `[]` of the look, if there was one, by the robot that chooses next.
      terminated: `[]` bool, all robots are done.
      truncated: `[]` bool, the episode has reached its limit of steps.
      seconds: `[]` that passed; without travel, 1 for a look.
      poi: `[]` int32 that was looked at; N for none.
      distance: `[]` from which, in metres; see `LookSource.observe`.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    seconds: jax.Array
    poi: jax.Array
    distance: jax.Array


@checks.typed
def step(key: Key, mdp: Mdp, state: State, action: Int[Array, ""]) -> tuple[State, Outcome]:
    """Lets one robot choose; if all have chosen, time passes until the next look.

    Returns:
      The next state and the outcome. The reward is that of the look, see `Reward`; 0 if there was
      none; NaN if the gain is NaN or a traced action does not exist.

    Raises:
      ValueError: if there is no such action, or if the reward is not one number.
    """
    checks.require_key(key)
    checks.require_shape("state.seen", state.seen, (mdp.num_pois, mdp.num_modalities))
    chex.assert_rank(action, 0)
    checks.require_index("action", action, mdp.num_actions)
    team, nop = state.team, mdp.num_pois
    robots = jnp.arange(len(team.works))
    is_agent = robots == state.agent
    target = jnp.where(is_agent, action, team.target)
    works = team.works & ~(is_agent & (action == nop))
    asks = state.asks & ~is_agent
    terminated = ~jnp.any(works)
    passes = ~jnp.any(asks) & ~terminated

    goals = team.positions.at[target].get(mode="clip")
    to_go = _to_go(mdp, state, target, goals)
    times = jax.vmap(mdp.travel.seconds)(team.poses, goals, to_go)
    left = times - state.looked
    looker = jnp.argmin(jnp.where(works, left, jnp.inf)).astype(jnp.int32)
    is_looker = robots == looker
    seconds = jnp.where(passes, left[looker], 0.0)
    # A look under way continues while another robot looks.
    looked = jnp.maximum(state.looked + seconds - (times - mdp.travel.look_seconds), 0.0)
    looked = jnp.where(is_looker, 0.0, jnp.minimum(looked, mdp.travel.look_seconds))
    moved = team.poses
    if mdp.teams is not None:
        moved = jax.vmap(mdp.travel.move, (0, 0, None, 0))(moved, goals, seconds, to_go)
    poi = jnp.where(passes, target[looker], nop)
    place = moved[looker, :2]
    distance = jnp.linalg.norm(place - team.positions[jnp.minimum(poi, nop - 1)])
    changed, reward = _look(key, mdp, state, poi, looker, place, distance)

    is_on_way = works & (looked <= 0) & (mdp.teams is not None and mdp.teams.chooses_anew)
    asks = jnp.where(passes, is_looker | is_on_way, asks)
    before = jnp.where(passes, looker - 1, state.agent)
    following = jnp.argmin(jnp.where(asks, (robots - before - 1) % len(robots), len(robots)))
    after = dataclasses.replace(
        state,
        **changed,
        steps=state.steps + 1,
        team=dataclasses.replace(
            team,
            poses=jnp.where(works[:, None], moved, team.poses),
            works=works,
            target=jnp.where(passes & is_looker, nop, target),
        ),
        asks=asks,
        agent=following.astype(jnp.int32),
        looked=jnp.where(passes, looked, state.looked),
        seconds=state.seconds + seconds,
    )
    truncated = ~terminated & (after.steps >= mdp.config.max_steps)
    return after, Outcome(reward, terminated, truncated, seconds, poi, distance)


def _look(
    key: Key,
    mdp: Mdp,
    state: State,
    poi: Int[Array, ""],
    looker: Int[Array, ""],
    stands: Float[Array, "2"],
    distance: Float[Array, ""],
) -> tuple[dict[str, PyTree], Float[Array, ""]]:
    """What a robot's look changes, or NOP, and the reward."""
    is_nop, place = poi == mdp.num_pois, jnp.minimum(poi, mdp.num_pois - 1)
    old = jax.tree.map(lambda x: x[place], state.belief)
    modality, weight, looked_from = mdp.sensor(state.team, looker), 1.0, state.looked_from
    if mdp.novelty is not None and looked_from is not None:
        earlier = looked_from[place, modality]
        weight = mdp.novelty.weight(_apart(stands, earlier), modality)
        here = jnp.where(distance > 0, stands, NEVER)
        latest = jnp.concatenate([here[None], earlier[:-1]])
        looked_from = looked_from.at[place, modality].set(latest)

    def look(modality: int) -> tuple[Belief, Scene]:
        features, scene = mdp.looks.observe(key, state.scene, place, modality, distance)
        return mdp.fusion.update(old, state.seen[place], features, modality, weight), scene

    if mdp.is_single:
        new, scene = call(look, modality, mdp.num_modalities)
    else:
        # Every sensor looks and one look is kept: under `vmap` a switch takes many times as long.
        new, scene = look(0)
        for m in range(1, mdp.num_modalities):
            kept = functools.partial(jnp.where, modality == m)
            new, scene = jax.tree.map(kept, look(m), (new, scene))
    of_look = mdp.reward.of_gain(mdp.information(new) - mdp.information(old))
    checks.require_shape("reward of a look", of_look, ())
    exists = (poi >= 0) & (poi <= mdp.num_pois)
    looked = {
        "belief": jax.tree.map(lambda x, y: x.at[place].set(y), state.belief, new),
        "seen": state.seen.at[place, modality].set(True),
        "scene": scene,
        "looked_from": looked_from,
    }
    before = {name: getattr(state, name) for name in looked}
    changed = jax.tree.map(functools.partial(jnp.where, is_nop), before, looked)
    return changed, jnp.where(exists, jnp.where(is_nop, 0.0, of_look), jnp.nan)


def _to_go(
    mdp: Mdp, state: State, target: Int[Array, " R"], goals: Float[Array, "R 2"]
) -> Float[Array, " R"]:
    """Metres that each robot goes round its target, away from the nearest earlier look."""
    novelty, team, places = mdp.novelty, state.team, state.looked_from
    if novelty is None or places is None:
        return jnp.zeros(len(target))

    def of_robot(pose: jax.Array, modality: jax.Array, poi: jax.Array, goal: jax.Array):
        earlier = places.at[poi, modality].get(mode="clip")
        arrival = mdp.travel.arrival(pose, goal)
        apart = _apart(arrival, earlier)
        (x, y), (other_x, other_y) = arrival - goal, earlier[jnp.argmin(apart)] - goal
        is_left = x * other_y - y * other_x > 0
        return jnp.where(is_left, -1.0, 1.0) * novelty.to_go(apart, modality)

    return jax.vmap(of_robot)(team.poses, team.modality, target, goals)


def _apart(place: Float[Array, "2"], places: Float[Array, "K 2"]) -> Float[Array, " K"]:
    """Distances from earlier looks, in metres."""
    return jnp.linalg.norm(places - place[None], axis=-1)
