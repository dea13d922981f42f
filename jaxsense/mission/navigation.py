"""Driving among obstacles: the local part of the paper's move_base, as pure functions.

Trajectory rollout (Fox, Burgard and Thrun 1997, the dynamic window approach): of the arcs within
reach of its present speed that keep clear of walls, PoIs and other robots, a robot takes the one
that brings it to its goal soonest. A command is a forward speed [m/s] and a turn rate [rad/s].
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import ArenaConfig, NavigationConfig
from jaxsense.core.types import Index, others
from jaxsense.sim import amiro
from jaxsense.sim.arena import Layout

BACKWARD_SPEED = 0.1  # m/s
_NUM_SPEEDS = 6  # that the planner tries, one of them backwards
_NUM_TURN_RATES = 21  # that it tries; odd, so that one goes straight
_SAMPLE_TIMES = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0)  # shares of the horizon
# Robots may leave an arc from half the horizon on; earlier, standing still would score as well.
_MAY_LEAVE = _SAMPLE_TIMES.index(0.5)
_GRAZE = 0.005  # m, a trajectory may cut the planning radius: samples are coarse
_SIDESTEP = 0.06  # m, extra width of a way around another robot
_INFLATION_COST = 0.1  # s, where a way just touches the planning radius


def wheel_speeds(command: jax.Array) -> jax.Array:
    """`[..., 2]` left and right wheel speeds [rad/s] of `[..., 2]` commands."""
    forward, turn = command[..., 0], command[..., 1] * amiro.WHEEL_SEPARATION / 2
    return jnp.stack([forward - turn, forward + turn], axis=-1) / amiro.WHEEL_RADIUS


def ramp(command: jax.Array, wanted: jax.Array, seconds: float) -> jax.Array:
    """Moves a command towards a wanted one, within the robot's limits.

    Turning uses up motor force that forward acceleration then lacks.

    Args:
      command: `[..., 2]` the current one.
      wanted: `[..., 2]`, cut to the limits of speed and turn rate.
      seconds: how long the command may change.

    Returns:
      `[..., 2]` the next command.
    """
    forward = jnp.clip(wanted[..., 0], -amiro.MAX_SPEED, amiro.MAX_SPEED) - command[..., 0]
    turn = jnp.clip(wanted[..., 1], -amiro.MAX_TURN_RATE, amiro.MAX_TURN_RATE) - command[..., 1]
    most = seconds * amiro.MAX_TURN_ACCELERATION
    turn = jnp.clip(turn, -most, most)
    most = seconds * amiro.MAX_ACCELERATION - amiro.FORWARD_PER_TURN * jnp.abs(turn)
    forward = jnp.clip(forward, -most, most)
    return command + jnp.stack([forward, turn], axis=-1)


def face(bearing: jax.Array) -> jax.Array:
    """Command, `[2]`, that turns a standing robot towards a bearing [rad] in its frame."""
    return jnp.stack([jnp.zeros_like(bearing), jnp.clip(4.0 * bearing, -1.0, 1.0)])


def clearance(arena: ArenaConfig, layout: Layout, poses: jax.Array) -> jax.Array:
    """Free distance around each robot, exact for the actual shapes of the PoIs.

    Args:
      arena: its sizes.
      layout: the PoIs.
      poses: `[R, 3]` of the robots.

    Returns:
      `[R]` metres from a robot's outline to the nearest wall, PoI or robot; negative inside one.
    """
    chex.assert_shape(poses, (None, 3), custom_message="poses")
    x, y = poses[:, :1], poses[:, 1:2]
    to_wall = arena.side / 2 - jnp.max(jnp.abs(poses[:, :2]), axis=-1)

    shapes = arena.shapes.values()
    half_sides = arena.poi_radius * jnp.array([shape.half_sides for shape in shapes])
    is_box = jnp.array([shape.primitive == "box" for shape in shapes])[layout.shape]
    half_u, half_v = half_sides[layout.shape].T
    from_x, from_y = x - layout.position[None, :, 0], y - layout.position[None, :, 1]
    cos, sin = jnp.cos(layout.yaw)[None], jnp.sin(layout.yaw)[None]
    along = jnp.abs(cos * from_x + sin * from_y) - half_u[None]
    across = jnp.abs(cos * from_y - sin * from_x) - half_v[None]
    outside = jnp.hypot(jnp.maximum(along, 0.0), jnp.maximum(across, 0.0))
    to_box = outside + jnp.minimum(jnp.maximum(along, across), 0.0)
    to_cylinder = jnp.hypot(from_x, from_y) - half_u[None]
    to_poi = jnp.min(jnp.where(is_box[None], to_box, to_cylinder), axis=-1)

    apart = jnp.hypot(x - x.T, y - y.T) - amiro.BODY_RADIUS
    to_robot = jnp.min(jnp.where(jnp.eye(len(poses), dtype=bool), jnp.inf, apart), axis=-1)
    return jnp.minimum(jnp.minimum(to_wall, to_poi), to_robot) - amiro.BODY_RADIUS


class _Arcs(NamedTuple):
    """Arcs of `[S, 2]` commands at `[T]` times [s]: `[S, T]` x [m], y [m] and heading [rad]."""

    commands: np.ndarray
    times: jax.Array
    x: jax.Array
    y: jax.Array
    heading: jax.Array


class _Frame(NamedTuple):
    """A robot's frame, in which its arcs are constants: its `[3]` pose, and cosine and sine."""

    pose: jax.Array
    cos: jax.Array
    sin: jax.Array

    def of(self, places: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Coordinates of places, from `[..., 2]` in the world."""
        to_x, to_y = places[..., 0] - self.pose[0], places[..., 1] - self.pose[1]
        return self.cos * to_x + self.sin * to_y, self.cos * to_y - self.sin * to_x

    def in_world(self, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Coordinates in the world of places in the frame."""
        pose, cos, sin = self
        return pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y


def drive_to(
    settings: NavigationConfig,
    arena: ArenaConfig,
    layout: Layout,
    poses: jax.Array,
    commands: jax.Array,
    robot: Index,
    waypoint: jax.Array,
    seconds: float,
    backs_off: jax.Array,
) -> jax.Array:
    """Command that brings a robot to a waypoint soonest without touching anything.

    Arcs closer to something than `robot_radius` (less 5 mm, for their coarse samples) are out,
    unless they lead away from what is too close already. PoIs are circles that hold every shape.
    Other robots may stand or go straight on; an arc must be clear of both. The cost of an arc is
    the least time to the waypoint over the points where the robot may leave it, from half the
    horizon on: time so far, turning to the waypoint and driving straight; ways through the
    inflation around obstacles cost extra time.

    Args:
      settings: of the planner.
      arena: its sizes.
      layout: the PoIs' places; their shapes are not used.
      poses: `[R, 3]` of all robots.
      commands: `[R, 2]` of all robots.
      robot: index of the one to drive.
      waypoint: `[2]` in metres.
      seconds: how long the robot keeps the command.
      backs_off: `[]` bool: seek as much room as possible in half the horizon instead.

    Returns:
      `[2]` the wanted command.
    """
    chex.assert_shape(waypoint, (2,), custom_message="waypoint")
    chex.assert_equal_shape_prefix([poses, commands], 1, custom_message="commands")
    arcs = _arcs(settings)
    pose, present = poses[robot], commands[robot]
    frame = _Frame(pose, jnp.cos(pose[2]), jnp.sin(pose[2]))
    room_of_map = _room_of_map(settings, arena, layout, frame, arcs)
    moving = others(poses, robot), others(commands, robot)
    room, room_now = _room_beside(settings, frame, arcs, *moving, *room_of_map)
    least = jax.lax.cummin(room, axis=1)
    beside = sidestep(settings, arena, layout, pose[:2], waypoint, others(poses[:, :2], robot))
    arrival = _arrival(settings, arcs, *frame.of(beside), room_of_map[0])
    is_safe = least >= jnp.minimum(room_now - 1e-4, -_GRAZE)
    value = jnp.min(jnp.where(is_safe, arrival, jnp.inf)[:, _MAY_LEAVE:], axis=1)
    value = jnp.where(backs_off, -room[:, _MAY_LEAVE], value)
    return _best(arcs, present, seconds, value, may_start=is_safe[:, 0])


def _room_of_map(
    settings: NavigationConfig, arena: ArenaConfig, layout: Layout, frame: _Frame, arcs: _Arcs
) -> tuple[jax.Array, jax.Array]:
    """Metres to walls and PoIs, `[S, T]` from the arcs and `[]` from the robot's current place."""
    x, y, reach = arcs.x, arcs.y, settings.robot_radius
    world_x, world_y = frame.in_world(x, y)
    room = arena.side / 2 - jnp.maximum(jnp.abs(world_x), jnp.abs(world_y)) - reach
    room_now = arena.side / 2 - jnp.max(jnp.abs(frame.pose[:2])) - reach
    at_x, at_y = frame.of(layout.position)
    keep = arena.poi_extent + reach
    room = jnp.minimum(room, _to_nearest(arcs, at_x[:, None], at_y[:, None]) - keep)
    return room, jnp.minimum(room_now, jnp.min(jnp.hypot(at_x, at_y)) - keep)


def _room_beside(
    settings: NavigationConfig,
    frame: _Frame,
    arcs: _Arcs,
    poses: jax.Array,
    commands: jax.Array,
    room: jax.Array,
    room_now: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Reduces both results of `_room_of_map` by robots of `[K, 3]` poses and `[K, 2]` commands."""
    # Each counts twice: it may go straight on or stand.
    speed = jnp.append(commands[:, 0], jnp.zeros(len(commands)))
    poses = jnp.tile(poses, (2, 1))
    at_x, at_y = frame.of(poses[:, :2])
    course, way = poses[:, 2] - frame.pose[2], arcs.times[None] * speed[:, None]
    x = at_x[:, None] + way * jnp.cos(course)[:, None]
    y = at_y[:, None] + way * jnp.sin(course)[:, None]
    keep = 2 * settings.robot_radius
    room_now = jnp.minimum(room_now, jnp.min(jnp.hypot(at_x, at_y), initial=jnp.inf) - keep)
    return jnp.minimum(room, _to_nearest(arcs, x, y) - keep), room_now


def _to_nearest(arcs: _Arcs, x: jax.Array, y: jax.Array) -> jax.Array:
    """Metres, `[S, T]`, from the arcs to the nearest of K places, each `[T]` or `[1]`."""

    def nearer(squared: jax.Array, place: tuple[jax.Array, jax.Array]):
        to_x, to_y = arcs.x - place[0][None], arcs.y - place[1][None]
        return jnp.minimum(squared, to_x**2 + to_y**2), None

    # All places at once would not fit the cache, and to compile them one by one takes long.
    far = jnp.full_like(arcs.x, jnp.inf)
    return jnp.sqrt(jax.lax.scan(nearer, far, (x, y))[0])


def _arrival(
    settings: NavigationConfig, arcs: _Arcs, goal_x: jax.Array, goal_y: jax.Array, room: jax.Array
) -> jax.Array:
    """Seconds to a goal, `[S, T]`, for a robot that leaves the arc at each of its points."""
    distance = jnp.hypot(goal_x - arcs.x, goal_y - arcs.y)
    turn = jnp.arctan2(goal_y - arcs.y, goal_x - arcs.x) - arcs.heading
    turn = jnp.abs((turn + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    # Near the waypoint its direction means nothing.
    turn *= jnp.clip(distance / 0.08 - 0.25, 0.0, 1.0)
    inflation = jnp.maximum(settings.inflation, 1e-6)
    narrowest = jax.lax.cummin(room, axis=1)
    cost = _INFLATION_COST * jnp.clip(1.0 - narrowest / inflation, 0.0, 1.0)
    return arcs.times[None] + turn / amiro.MAX_TURN_RATE + distance / amiro.MAX_SPEED + cost


def _best(
    arcs: _Arcs, present: jax.Array, seconds: float, value: jax.Array, may_start: jax.Array
) -> jax.Array:
    """Command of least `[S]` value in reach of the present one where `[S]` `may_start`, or 0."""
    change = seconds * jnp.array([amiro.MAX_ACCELERATION, amiro.MAX_TURN_ACCELERATION]) + 1e-6
    in_window = jnp.all(jnp.abs(arcs.commands - present[None]) <= change[None], axis=-1)
    value = jnp.where(in_window & may_start, value, jnp.inf)
    best = jnp.argmin(value)
    return jnp.where(jnp.isfinite(value[best]), jnp.array(arcs.commands)[best], 0.0)


def sidestep(
    settings: NavigationConfig,
    arena: ArenaConfig,
    layout: Layout,
    place: jax.Array,
    waypoint: jax.Array,
    blocking: jax.Array,
) -> jax.Array:
    """Next place on a straight way that another robot may block.

    Args:
      settings: of the planner.
      arena: its sizes.
      layout: the PoIs' places.
      place: `[2]` where the robot is, in metres.
      waypoint: `[2]` where it is going.
      blocking: `[K, 2]` where the other robots are.

    Returns:
      `[2]` the waypoint, or a place beside the robot in the way: on the shorter side with room, the
      right one if both are equal.
    """
    keep = 2 * settings.robot_radius + _SIDESTEP
    reach = arena.side / 2 - settings.robot_radius
    along = waypoint - place
    length = jnp.maximum(jnp.linalg.norm(along), 1e-6)
    along /= length
    right = jnp.stack([along[1], -along[0]])

    def beside(other: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Place beside another robot, and whether to go there."""
        to_other = other - place
        ahead, aside = jnp.dot(to_other, along), jnp.dot(to_other, right)
        blocks = (jnp.abs(aside) < keep - _SIDESTEP / 2) & (ahead > 0) & (ahead < length)
        # On the tangents to a circle around the other robot; inside it, outwards.
        apart = jnp.maximum(jnp.linalg.norm(to_other), 1e-6)
        turn = jnp.arcsin(jnp.minimum(keep / apart, 1.0)) + jnp.maximum(1.0 - apart / keep, 0.0)
        step = jnp.sqrt(jnp.maximum(apart**2 - keep**2, 0.15**2)) / apart
        cos, sin = step * jnp.cos(turn), step * jnp.sin(turn)
        across = jnp.stack([to_other[1], -to_other[0]])
        sides = place[None] + jnp.stack(
            [cos * to_other + sin * across, cos * to_other - sin * across]
        )
        to_pois = jnp.linalg.norm(sides[:, None] - layout.position[None], axis=-1)
        has_room = jnp.all(to_pois >= arena.poi_extent + settings.robot_radius, axis=-1)
        has_room &= jnp.max(jnp.abs(sides), axis=-1) <= reach
        detour = jnp.linalg.norm(sides - waypoint[None], axis=-1) + jnp.array([0.0, 0.05])
        best = jnp.argmin(jnp.where(has_room, detour, jnp.inf))
        return sides[best], blocks & jnp.any(has_room)

    # The last of several robots counts.
    steps, applies = jax.vmap(beside)(blocking)
    places = jnp.concatenate([waypoint[None], steps])
    last = jnp.max(jnp.where(applies, 1 + jnp.arange(len(blocking)), 0), initial=0)
    return places[last]


def _arcs(settings: NavigationConfig) -> _Arcs:
    """Arcs of all commands that the planner tries."""
    forward = np.linspace(0.0, amiro.MAX_SPEED, _NUM_SPEEDS - 1)
    turns = np.linspace(-amiro.MAX_TURN_RATE, amiro.MAX_TURN_RATE, _NUM_TURN_RATES)
    speeds = np.concatenate([[-BACKWARD_SPEED], forward])
    samples = np.stack(np.meshgrid(speeds, turns, indexing="ij"), axis=-1).reshape(-1, 2)
    samples = samples.astype(np.float32)
    times = settings.horizon * jnp.array(_SAMPLE_TIMES, jnp.float32)
    v, w = jnp.array(samples[:, :1]), jnp.array(samples[:, 1:])
    heading = w * times[None]
    # sin(h) / w and (1 - cos(h)) / w, also where w is 0.
    x = v * times[None] * jnp.sinc(heading / np.pi)
    y = v * times[None] * jnp.sin(heading / 2) * jnp.sinc(heading / (2 * np.pi))
    return _Arcs(samples, times, x, y, heading)
