"""The team MDP: robots choose, drive and look, and time counts.

In each step one robot chooses the PoI that it will look at, or NOP, after which it is done. If all
have chosen, time passes until a robot arrives and looks; the look updates the map, and that robot
chooses next. For each robot this is a semi-Markov decision process (Sutton, Precup and Singh 1999,
Artificial Intelligence 112, Sec. 3): an action takes the time until its look. The robot earns the
rewards of its own looks in the map MDP minus a price of each second, discounted by time.

Travel times follow a model, see `Travel`.
"""

import dataclasses

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.learning import TeamConfig
from jaxsense.core import checks
from jaxsense.core.types import Belief, Index, Key, pytree
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState, Outcome

TIME_SCALE = 10.0
"""Unit of travel times in observations, in seconds."""


@pytree
class Team:
    """Robots and PoIs at one moment.

    Attributes:
      positions: `[N, 2]` of the PoIs, in metres.
      present: `[N]` bool, PoIs that exist and that the robot that chooses has not given up.
      poses: `[R, 3]` x [m], y [m] and yaw [rad] of the robots.
      modality: `[R]` int32 index of each robot's sensor.
      works: `[R]` bool, robots that are neither done nor failed.
      target: `[R]` int32 PoI that each robot heads for, or N.
    """

    positions: jax.Array
    present: jax.Array
    poses: jax.Array
    modality: jax.Array
    works: jax.Array
    target: jax.Array

    @property
    def heads(self) -> Bool[Array, "R N"]:
        """Which robot heads for which PoI."""
        return self.target[:, None] == jnp.arange(self.positions.shape[0])[None]

    def others(self, robot: Int[Array, ""]) -> Bool[Array, " R"]:
        """Other robots that work."""
        return self.works & (jnp.arange(self.poses.shape[0]) != robot)

    def is_taken(self, robot: Int[Array, ""]) -> Bool[Array, " N"]:
        """PoIs that other robots head for."""
        return jnp.any(self.heads & self.others(robot)[:, None], axis=0)


@pytree
class Travel:
    """A robot that turns to a PoI, drives straight until it is near enough, and looks.

    Attributes:
      view_distance: from which it looks, in metres.
      speed: in metres per second.
      turn_rate: in radians per second.
      look_seconds: duration of a look.
    """

    view_distance: jax.Array | float
    speed: jax.Array | float = 0.2
    turn_rate: jax.Array | float = 1.2
    look_seconds: jax.Array | float = 0.7


@pytree
class Places:
    """Random positions: each PoI in a cell of its own, robots anywhere.

    Attributes:
      sides: `[2]` shortest and longest side of an arena, in metres.
      robot_radius: `[]` smallest distance of a robot from a wall, in metres.
      poi_pitch: smallest distance of two PoIs' centres, in metres.
      cells_per_side: cells along a side of an arena.
    """

    sides: tuple[jax.Array | float, jax.Array | float]
    robot_radius: jax.Array | float
    poi_pitch: float = struct.field(pytree_node=False)
    num_pois: int = struct.field(pytree_node=False)
    cells_per_side: int = struct.field(pytree_node=False)

    def draw(self, key: Key, num_robots: int) -> tuple[Float[Array, "N 2"], Float[Array, "R 3"]]:
        """Draws an arena.

        Returns:
          `[N, 2]` positions of the PoIs, in metres, and `[R, 3]` poses of the robots.
        """
        num_pois, per_side = self.num_pois, self.cells_per_side
        draws = jax.random.uniform(key, (1 + per_side**2 + 2 * num_pois + 3 * num_robots,))
        side = self.sides[0] + (self.sides[1] - self.sides[0]) * draws[0]
        order, draws = draws[1 : 1 + per_side**2], draws[1 + per_side**2 :]
        cell = jnp.argsort(order)[:num_pois]
        corner = jnp.stack([cell // per_side, cell % per_side], axis=-1).astype(side.dtype)
        play = jnp.maximum(side / per_side - self.poi_pitch, 0.0)
        jitter = play * (draws[: 2 * num_pois].reshape(num_pois, 2) - 0.5)
        positions = (corner + 0.5) * side / per_side - side / 2 + jitter
        places = 2 * draws[2 * num_pois :].reshape(num_robots, 3) - 1
        reach = side / 2 - self.robot_radius
        poses = jnp.concatenate([reach * places[:, :2], jnp.pi * places[:, 2:]], axis=-1)
        return positions, poses


@pytree
class TeamState:
    """State of the team MDP before a robot's choice.

    Attributes:
      asks: `[R]` bool, robots that have yet to choose at this moment; at first all that work.
      looked: `[R]` seconds that each robot has been looking.
    """

    map: MapState
    team: Team
    asks: jax.Array
    agent: jax.Array
    looked: jax.Array
    seconds: jax.Array

    @property
    def teams(self) -> "tuple[TeamState]":
        """States of teams in it: itself; a `MapState` has none."""
        return (self,)


@pytree
class TeamMdp:
    """The MDP of a team that shares one map.

    Attributes:
      config: numbers of PoIs and the price of time.
      map: the map MDP, with the maximum number of PoIs.
      modalities: names of the sensors, in the order of their indices.
      alone: share of episodes with one robot and no travel, as in the paper.
      partly_seen: share of the other episodes that start with some looks already taken.
      max_steps: maximum length of an episode, in choices.
      robots_each: maximum number of robots per modality in an episode; the minimum is one.
    """

    config: TeamConfig
    map: MapMdp
    places: Places
    modalities: tuple[str, ...] = struct.field(pytree_node=False)
    travel: Travel
    alone: jax.Array | float = 0.25
    partly_seen: jax.Array | float = 0.5
    max_steps: jax.Array | int = 300
    robots_each: int = struct.field(pytree_node=False, default=2)

    @property
    def num_features(self) -> int:
        """Numbers that a robot knows of each PoI, F, see `observation`."""
        return num_features(self.map.fusion.prior.mean.size, self.map.num_modalities)

    def observe(self, state: TeamState, robot: Int[Array, ""]) -> Float[Array, "F N"]:
        """What a robot knows, see `observation`."""
        belief, travel, number = state.map.belief, self.travel, self.map.num_modalities
        return observation(travel, belief, state.team, robot, number)

    def time_price(self, team: Team, seconds: Float[Array, ""]) -> Float[Array, ""]:
        """What all robots that work pay together for some time."""
        return self.config.second_cost * seconds * jnp.sum(team.works, dtype=seconds.dtype)


def travel_seconds(
    travel: Travel, pose: Float[Array, "3"], places: Float[Array, "N 2"]
) -> Float[Array, " N"]:
    """Time until a robot has looked at PoIs, by the travel model.

    Args:
      pose: `[3]` x [m], y [m] and yaw [rad] of the robot.
      places: `[N, 2]` positions of the PoIs, in metres.
    """
    turn, path = jax.vmap(lambda place: _path(travel, pose, place))(places)
    return travel.look_seconds + jnp.abs(turn) / travel.turn_rate + path / travel.speed


def move(
    travel: Travel,
    pose: Float[Array, "3"],
    place: Float[Array, "2"],
    seconds: Float[Array, ""],
) -> Float[Array, "3"]:
    """Pose of a robot some time after it set out for a PoI, by the travel model.

    Args:
      pose: `[3]` x [m], y [m] and yaw [rad] of the robot as it set out.
      place: `[2]` position of the PoI, in metres.
    """
    turn, path = _path(travel, pose, place)
    turning = jnp.minimum(jnp.abs(turn) / travel.turn_rate, seconds)
    yaw = pose[2] + jnp.sign(turn) * turning * travel.turn_rate
    driven = jnp.minimum((seconds - turning) * travel.speed, path)
    to_place = place - pose[:2]
    along = to_place / jnp.maximum(jnp.linalg.norm(to_place), 1e-6)
    return jnp.append(pose[:2] + driven * along, yaw)


def _path(travel: Travel, pose: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`[]` radians to turn and `[]` metres to drive until a robot is near enough to look."""
    to_place = place - pose[:2]
    turn = jnp.arctan2(to_place[1], to_place[0]) - pose[2]
    turn = (turn + jnp.pi) % (2 * jnp.pi) - jnp.pi
    # At zero distance the bearing is undefined: do not turn.
    distance = jnp.linalg.norm(to_place)
    turn = jnp.where(distance > 0, turn, 0.0)
    return turn, jnp.maximum(distance - travel.view_distance, 0.0)


def travel_times(travel: Travel, team: Team) -> Float[Array, "R N"]:
    """Time until each robot has looked at each PoI, see `travel_seconds`."""
    return jax.vmap(lambda pose: travel_seconds(travel, pose, team.positions))(team.poses)


def own_seconds(observed: Float[Array, "F N ..."], latent_size: int) -> Float[Array, "N ..."]:
    """The robot's own time to look at each PoI, in seconds."""
    return TIME_SCALE * observed[2 * latent_size]


def num_features(latent_size: int, num_modalities: int) -> int:
    """Numbers that a robot knows of each PoI, F, see `observation`."""
    return 2 * latent_size + 3 * num_modalities + 4


def observation(
    travel: Travel, belief: Belief, team: Team, agent: Int[Array, ""], num_modalities: int
) -> Float[Array, "F N"]:
    """What a robot knows when it chooses.

    Returns:
      `[F, N]`, for each PoI: mean and standard deviation of its belief; the robot's own time to
      look at it; for each modality, how soon another robot that heads for it arrives, and how soon
      the nearest other robot could, as `exp(-time / 10 s)`, 0 for none; the robot's own modality,
      one number for each; whether the PoI is present; and its position relative to the robot.
    """
    times = travel_times(travel, team)
    soon = jnp.exp(-times / TIME_SCALE)
    carries = team.modality[None] == jnp.arange(num_modalities)[:, None]
    counts = (carries & team.others(agent)[None])[:, :, None]
    nearest = jnp.max(jnp.where(counts, soon[None], 0.0), axis=1)
    heading = jnp.max(jnp.where(counts & team.heads[None], soon[None], 0.0), axis=1)
    own = jnp.broadcast_to(carries[:, agent][:, None], heading.shape)
    relative = team.positions - team.poses[agent, :2][None]
    rows = [
        belief.mean.T,
        belief.std.T,
        (times[agent] / TIME_SCALE)[None],
        heading,
        nearest,
        own.astype(times.dtype),
        team.present[None].astype(times.dtype),
        relative.T,
    ]
    return jnp.where(team.present[None], jnp.concatenate(rows, axis=0), 0.0)


def action_mask(state: TeamState) -> Bool[Array, " A"]:
    """Mask `[N + 1]` of the PoIs that are present, and NOP."""
    return jnp.append(state.team.present, True)


def existing(state: TeamState, action: Int[Array, ""]) -> Int[Array, ""]:
    """The action, or NOP in place of a PoI that is not present.

    Args:
      action: `[]` int32; returned as it is if there is no such action.
    """
    nop = len(state.team.present)
    is_absent = jnp.any(~state.team.present & (jnp.arange(nop) == action))
    return jnp.where(is_absent, nop, action)


def alone(num_pois: int, modality: Index) -> Team:
    """The team of the paper's MDP: one robot, and all PoIs share its position."""
    return Team(
        positions=jnp.zeros((num_pois, 2)),
        present=jnp.ones(num_pois, bool),
        poses=jnp.zeros((1, 3)),
        modality=jnp.reshape(jnp.asarray(modality, jnp.int32), (1,)),
        works=jnp.ones(1, bool),
        target=jnp.full(1, num_pois, jnp.int32),
    )


def reset(key: Key, mdp: TeamMdp, modality: Int[Array, " R"] | None = None) -> TeamState:
    """Starts an episode with a random number of PoIs and earlier looks.

    Args:
      modality: `[R]` int32 sensors of the robots, which all work; by default the team is random. In
        a share `mdp.alone` of these episodes, one robot is alone and shares its position
        with all PoIs: the map MDP of the paper, where only looks take time.
    """
    checks.require_key(key)
    map_key, place_key, number_key, team_key, alone_key, seen_key = jax.random.split(key, 6)
    config, num_pois = mdp.config, mdp.map.num_pois
    number = jax.random.randint(number_key, (), config.num_pois[0], config.num_pois[1] + 1)
    if modality is None:
        alone = jax.random.bernoulli(alone_key, mdp.alone)
        modality, works = _random_team(team_key, mdp, alone)
    else:
        checks.require_index("modality", modality, mdp.map.num_modalities)
        alone, works = jnp.bool_(False), jnp.ones(modality.shape, bool)
    num_robots = len(modality)
    positions, poses = mdp.places.draw(place_key, num_robots)
    some_key, share_key, looks_key = jax.random.split(seen_key, 3)
    starts_late = alone | jax.random.bernoulli(some_key, mdp.partly_seen)
    # Uniform share, so that late states are as frequent as early ones.
    share = jnp.where(starts_late, jax.random.uniform(share_key), 0.0)
    seen = jax.random.bernoulli(looks_key, share, (num_pois, mdp.map.num_modalities))
    state = map_mdp.reset(map_key, mdp.map, seen=seen)
    team = Team(
        positions=jnp.where(alone, 0.0, positions),
        present=jnp.arange(num_pois) < number,
        poses=jnp.where(alone, 0.0, poses),
        modality=modality,
        works=works,
        target=jnp.full(num_robots, num_pois, jnp.int32),
    )
    first = jnp.argmax(works).astype(jnp.int32)
    return TeamState(state, team, works, first, jnp.zeros(num_robots), jnp.float32(0.0))


def _look(
    key: Key, mdp: MapMdp, state: MapState, action: jax.Array, modality: jax.Array
) -> tuple[MapState, jax.Array]:
    """The map after a look or NOP, and the `[]` reward."""

    def look(m: int) -> tuple[MapState, jax.Array]:
        after, outcome = map_mdp.step(key, mdp, state, action, m)
        return after, outcome.reward

    # Every sensor looks and one look is kept: under `vmap` a switch takes many times as long.
    found = look(0)
    for m in range(1, mdp.num_modalities):
        found = jax.tree.map(lambda x, y: jnp.where(modality == m, x, y), look(m), found)  # noqa: B023
    return found


def _random_team(key: Key, mdp: TeamMdp, alone: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`[R]` int32 modalities and `[R]` bool `works`: one or more of each modality, or one alone."""
    num_modalities, most = mdp.map.num_modalities, mdp.robots_each
    count_key, single_key = jax.random.split(key)
    counts = jax.random.randint(count_key, (num_modalities,), 1, most + 1)
    # Robots of one modality side by side.
    modality = jnp.repeat(jnp.arange(num_modalities), most)
    robots = jnp.arange(len(modality))
    single = jax.random.randint(single_key, (), 0, num_modalities) * most
    works = jnp.where(alone, robots == single, robots % most < counts[modality])
    return modality, works


def step(
    key: Key, mdp: TeamMdp, state: TeamState, action: Int[Array, ""]
) -> tuple[TeamState, Outcome]:
    """Lets one robot choose; if all have chosen, time passes until the next look.

    Returns:
      The next state and the outcome: the reward of the look, if there was one, by the robot that
      chooses next, and the seconds that passed.
    """
    checks.require_key(key)
    chex.assert_rank(action, 0)
    checks.require_index("action", action, mdp.map.num_pois + 1)
    num_pois, team, travel = mdp.map.num_pois, state.team, mdp.travel
    robots = jnp.arange(team.poses.shape[0])
    is_agent = robots == state.agent
    target = jnp.where(is_agent, action, team.target)
    works = team.works & ~(is_agent & (action == num_pois))
    asks = state.asks & ~is_agent
    terminated = ~jnp.any(works)
    passes = ~jnp.any(asks) & ~terminated

    goals = team.positions.at[target].get(mode="clip")
    time_to = lambda pose, goal: travel_seconds(travel, pose, goal[None])[0]  # noqa: E731
    times = jax.vmap(time_to)(team.poses, goals)
    left = times - state.looked
    looker = jnp.argmin(jnp.where(works, left, jnp.inf)).astype(jnp.int32)
    seconds = jnp.where(passes, left[looker], 0.0)
    # A look under way continues while another robot looks.
    looked = jnp.maximum(state.looked + seconds - (times - travel.look_seconds), 0.0)
    looked = jnp.minimum(looked, travel.look_seconds)
    moved = jax.vmap(lambda pose, goal: move(travel, pose, goal, seconds))(team.poses, goals)
    look = jnp.where(passes, target[looker], num_pois)
    after, reward = _look(key, mdp.map, state.map, look, team.modality[looker])

    following = jnp.argmin(jnp.where(asks, (robots - state.agent - 1) % len(robots), len(robots)))
    team = dataclasses.replace(
        team,
        poses=jnp.where(works[:, None], moved, team.poses),
        works=works,
        target=jnp.where(passes & (robots == looker), num_pois, target),
    )
    state = TeamState(
        map=after,
        team=team,
        asks=jnp.where(passes, robots == looker, asks),
        agent=jnp.where(passes, looker, following.astype(jnp.int32)),
        looked=jnp.where(passes, jnp.where(robots == looker, 0.0, looked), state.looked),
        seconds=state.seconds + seconds,
    )
    return state, Outcome(
        reward=reward,
        terminated=terminated,
        truncated=~terminated & (after.steps >= mdp.max_steps),
        seconds=seconds,
    )
