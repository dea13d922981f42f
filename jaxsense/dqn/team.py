"""Robots and points of interest: where they are, and how long it takes to drive and look."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.learning import LOOK_SECONDS, TeamConfig
from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.core.novelty import Novelty
from jaxsense.core.types import Belief, Index, Key, pytree, within_a_turn

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
    def action_mask(self) -> Bool[Array, " A"]:
        """Actions that exist: looks at the PoIs that are present, and NOP."""
        return jnp.append(self.present, True)

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

    def existing(self, action: Int[Array, ""]) -> Int[Array, ""]:
        """The action, or NOP in place of a PoI that is not present.

        Args:
          action: returned as it is if there is no such action.
        """
        nop = self.present.shape[0]
        is_absent = jnp.any(~self.present & (jnp.arange(nop) == action))
        return jnp.where(is_absent, nop, action)


def alone(num_pois: int, modality: Index) -> Team:
    """One robot that is where all PoIs are, as in the paper."""
    return Team(
        positions=jnp.zeros((num_pois, 2)),
        present=jnp.ones(num_pois, bool),
        poses=jnp.zeros((1, 3)),
        modality=jnp.reshape(jnp.asarray(modality, jnp.int32), (1,)),
        works=jnp.ones(1, bool),
        target=jnp.full(1, num_pois, jnp.int32),
    )


@pytree
class Known:
    """Input of a policy: what a robot knows when it chooses.

    Attributes:
      looks: `[N, M]` int32, looks of each modality at each PoI.
      log_posterior: `[N, C]` logarithms of the classes' probabilities by exact Bayes.
      team: robots and PoIs at this moment; PoIs that the robot has given up are not present.
      times: `[R, N]` seconds until each robot has looked at each PoI, see `Travel`.
      exists: `[N]` probability that the PoI exists; below 1 where a robot may find one.
    """

    belief: Belief
    looks: jax.Array
    log_posterior: jax.Array
    team: Team
    times: jax.Array
    robot: jax.Array
    exists: jax.Array | float = 1.0

    @property
    def modality(self) -> jax.Array:
        """`[]` int32 index of the robot's own sensor."""
        return self.team.modality[self.robot]

    @property
    def is_seen(self) -> jax.Array:
        """Mask `[N]` of the PoIs that any robot has looked at."""
        return jnp.any(self.looks > 0, axis=-1)


@pytree
class Travel:
    """A robot that turns to a PoI, drives straight until it sees it, and looks.

    Where such a look would not be new, it goes on, round the PoI.

    Attributes:
      view_distance: from which it sees a PoI, in metres.
      speed: in metres per second.
      turn_rate: in radians per second.
      look_seconds: duration of a look.
    """

    view_distance: jax.Array | float
    speed: jax.Array | float = 0.2
    turn_rate: jax.Array | float = 1.0
    look_seconds: jax.Array | float = LOOK_SECONDS

    def arrival(self, pose: Float[Array, "3"], place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Where a robot that drives to a PoI first sees it, in metres."""
        _, straight, along = self._way(pose, place)
        return pose[:2] + straight * along

    def seconds(
        self,
        pose: Float[Array, "3"],
        place: Float[Array, "2"],
        to_go: Float[Array, ""] | float = 0.0,
    ) -> Float[Array, ""]:
        """Time until a robot has looked at a PoI.

        Args:
          pose: x [m], y [m] and yaw [rad] of the robot as it sets out.
          place: position of the PoI, in metres.
          to_go: from the `arrival` to where a look is new, in metres; to the robot's right if
            positive.
        """
        turn, straight, _ = self._way(pose, place)
        return self.duration(turn, straight + jnp.abs(to_go))

    def duration(self, turn: Float[Array, "*B"], path: Float[Array, "*B"]) -> Float[Array, "*B"]:
        """Seconds of a turn, in radians, a path, in metres, and a look."""
        return self.look_seconds + jnp.abs(turn) / self.turn_rate + path / self.speed

    def times(self, team: Team, to_go: Float[Array, "R N"]) -> Float[Array, "R N"]:
        """Time until each robot has looked at each PoI, see `seconds`."""
        of_pois = jax.vmap(self.seconds, (None, 0, 0))
        return jax.vmap(of_pois, (0, None, 0))(team.poses, team.positions, to_go)

    def move(
        self,
        pose: Float[Array, "3"],
        place: Float[Array, "2"],
        seconds: Float[Array, ""],
        to_go: Float[Array, ""] | float = 0.0,
    ) -> Float[Array, "3"]:
        """Pose of a robot some time after it set out for a PoI, see `seconds`."""
        turn, straight, along = self._way(pose, place)
        beyond = jnp.abs(to_go)
        turning = jnp.minimum(jnp.abs(turn) / self.turn_rate, seconds)
        driven = jnp.minimum((seconds - turning) * self.speed, straight + beyond)
        arrival = pose[:2] + jnp.minimum(driven, straight) * along
        # A chord of the circle from which the robot sees the PoI; then it faces the PoI again.
        away = arrival - place
        radius = jnp.maximum(jnp.linalg.norm(away), 1e-6)
        angle = 2 * jnp.arcsin(jnp.clip(to_go / (2 * radius), -1.0, 1.0))
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        end = place + jnp.stack([cos * away[0] - sin * away[1], sin * away[0] + cos * away[1]])
        share = jnp.maximum(driven - straight, 0.0) / jnp.maximum(beyond, 1e-6)
        yaw = pose[2] + jnp.sign(turn) * turning * self.turn_rate + share * angle
        return jnp.append(arrival + share * (end - arrival), yaw)

    def _way(self, pose: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """`[]` radians to turn, `[]` metres straight on until it sees, and `[2]` which way."""
        to_place = place - pose[:2]
        turn = within_a_turn(jnp.arctan2(to_place[1], to_place[0]) - pose[2])
        # At zero distance the bearing is undefined: do not turn.
        distance = jnp.linalg.norm(to_place)
        turn = jnp.where(distance > 0, turn, 0.0)
        straight = jnp.maximum(distance - self.view_distance, 0.0)
        return turn, straight, to_place / jnp.maximum(distance, 1e-6)


NO_TRAVEL = Travel(view_distance=jnp.inf, speed=1e30, turn_rate=1e30, look_seconds=1.0)
"""Of a robot that does not travel: a look takes one second, from anywhere."""


def to_go(
    novelty: Novelty,
    travel: Travel,
    team: Team,
    apart: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
) -> Float[Array, "R N"]:
    """Metres from where each robot first sees each PoI to where its look is new.

    Args:
      apart: `(place [2], poi, modality) -> [K]` distances of a place from earlier looks.
    """
    pois = jnp.arange(team.positions.shape[0])

    def of_robot(pose: jax.Array, modality: jax.Array) -> jax.Array:
        def of_poi(position: jax.Array, poi: jax.Array) -> jax.Array:
            return novelty.to_go(apart(travel.arrival(pose, position), poi, modality), modality)

        return jax.vmap(of_poi)(team.positions, pois)

    return jax.vmap(of_robot)(team.poses, team.modality)


@pytree
class Places:
    """Random positions: each PoI in a cell of its own, robots anywhere.

    Attributes:
      config: numbers of PoIs and sides of arenas.
      poi_pitch: smallest distance of two PoIs' centres, in metres.
    """

    config: TeamConfig
    poi_pitch: float = struct.field(pytree_node=False)

    def draw(self, key: Key, num_robots: int) -> tuple[Float[Array, "N 2"], Float[Array, "R 3"]]:
        """Draws an arena.

        Returns:
          Positions of the PoIs, in metres, and poses of the robots.
        """
        num_pois, per_side = self.config.num_pois[1], self.config.cells_per_side
        shortest, longest = self.config.sides
        draws = jax.random.uniform(key, (1 + per_side**2 + 2 * num_pois + 3 * num_robots,))
        side = shortest + (longest - shortest) * draws[0]
        order, draws = draws[1 : 1 + per_side**2], draws[1 + per_side**2 :]
        cell = jnp.argsort(order)[:num_pois]
        corner = jnp.stack([cell // per_side, cell % per_side], axis=-1).astype(side.dtype)
        play = jnp.maximum(side / per_side - self.poi_pitch, 0.0)
        jitter = play * (draws[: 2 * num_pois].reshape(num_pois, 2) - 0.5)
        positions = (corner + 0.5) * side / per_side - side / 2 + jitter
        places = 2 * draws[2 * num_pois :].reshape(num_robots, 3) - 1
        reach = side / 2 - PLANNING_RADIUS
        poses = jnp.concatenate([reach * places[:, :2], jnp.pi * places[:, 2:]], axis=-1)
        return positions, poses


@pytree
class Teams:
    """Teams that drive, and how their episodes start.

    Attributes:
      config: numbers of PoIs and the price of time.
      modalities: names of the sensors, in the order of their indices.
      alone: share of random teams that are one robot without travel, as in the paper.
      partly_seen: share of the other episodes that start with some looks already taken.
      novelty: how new looks are after others from nearby; all are by default.
      is_random: whether in each episode only some of the robots work, at least one of each
        modality; then as many of each stand side by side.
      chooses_anew: whether robots on their way choose anew after a look by another.
    """

    config: TeamConfig
    travel: Travel
    places: Places
    modalities: tuple[str, ...] = struct.field(pytree_node=False)
    alone: jax.Array | float = 0.25
    partly_seen: jax.Array | float = 0.5
    novelty: Novelty | None = None
    is_random: bool = struct.field(pytree_node=False, default=True)
    chooses_anew: bool = struct.field(pytree_node=False, default=True)

    def draw(
        self, keys: Sequence[Key], num_pois: int, robots: Int[Array, " R"]
    ) -> tuple[Team, Bool[Array, "N M"]]:
        """A team with a random number of PoIs, and earlier looks.

        Args:
          keys: five.
          num_pois: the largest number.
          robots: sensors of the robots. In a share `alone` of the episodes of random teams, one
            robot is alone and shares its position with all PoIs.
        """
        place_key, number_key, team_key, alone_key, seen_key = keys
        least, most = self.config.num_pois
        number = jax.random.randint(number_key, (), least, most + 1)
        is_alone, works = jnp.bool_(False), jnp.ones(len(robots), bool)
        if self.is_random:
            is_alone = jax.random.bernoulli(alone_key, self.alone)
            works = self._some(team_key, robots, is_alone)
        positions, poses = self.places.draw(place_key, len(robots))
        some_key, share_key, looks_key = jax.random.split(seen_key, 3)
        starts_late = is_alone | jax.random.bernoulli(some_key, self.partly_seen)
        # Uniform share, so that late states are as frequent as early ones.
        share = jnp.where(starts_late, jax.random.uniform(share_key), 0.0)
        team = Team(
            positions=jnp.where(is_alone, 0.0, positions),
            present=jnp.arange(num_pois) < number,
            poses=jnp.where(is_alone, 0.0, poses),
            modality=robots,
            works=works,
            target=jnp.full(len(robots), num_pois, jnp.int32),
        )
        return team, jax.random.bernoulli(looks_key, share, (num_pois, len(self.modalities)))

    def _some(self, key: Key, robots: jax.Array, is_alone: jax.Array) -> jax.Array:
        """Which robots work: one or more of each modality, or one alone."""
        num_modalities = len(self.modalities)
        most, places = len(robots) // num_modalities, jnp.arange(len(robots))
        count_key, single_key = jax.random.split(key)
        counts = jax.random.randint(count_key, (num_modalities,), 1, most + 1)
        single = jax.random.randint(single_key, (), 0, num_modalities) * most
        return jnp.where(is_alone, places == single, places % most < counts[robots])


def num_features(latent_size: int, num_modalities: int) -> int:
    """Numbers that a robot knows of each PoI, F, see `surroundings`."""
    return 2 * latent_size + 3 * num_modalities + 4


def surroundings(
    belief: Belief,
    team: Team,
    times: Float[Array, "R N"],
    agent: Int[Array, ""],
    num_modalities: int,
) -> Float[Array, "F N"]:
    """What a robot of a team knows when it chooses.

    Args:
      times: seconds until each robot has looked at each PoI.

    Returns:
      For each PoI: mean and standard deviation of its belief; the robot's own time to look at it;
      for each modality, how soon another robot that heads for it arrives, and how soon the nearest
      other robot could, as `exp(-time / 10 s)`, 0 for none; the robot's own modality, one number
      for each; whether the PoI is present; and its position relative to the robot.
    """
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
