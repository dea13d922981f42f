"""Driving among obstacles: the local part of the paper's move_base, as pure functions.

The dynamic window approach (Fox, Burgard and Thrun 1997): of the arcs that its present speed allows
and that keep clear of walls, PoIs and other robots, a robot takes the one that brings it to its
goal soonest. A command is a forward speed [m/s] and a turn rate [rad/s].
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.config.scene import ArenaConfig
from jaxsense.core.types import Index, others, product
from jaxsense.sim import amiro
from jaxsense.sim.arena import Layout, room_beside, to_box

_BACKWARD_SPEED = 0.1  # m/s
_HORIZON = 2.0  # s, length of a trajectory
_INFLATION = 0.1  # m, from obstacles, below which a trajectory costs more
_NUM_SPEEDS = 6  # that the planner tries, one of them backwards
_NUM_TURN_RATES = 21  # that it tries; odd, so that one goes straight
_SAMPLE_TIMES = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0)  # shares of the horizon
# Robots may leave an arc from half the horizon on; earlier, standing still would score as well.
_MAY_LEAVE = _SAMPLE_TIMES.index(0.5)
_GRAZE = 0.005  # m, a trajectory may cut the planning radius: samples are coarse
_SIDESTEP = 0.06  # m, extra distance from another robot when passing it
_INFLATION_COST = 0.1  # s, where an arc just touches the planning radius


def wheel_speeds(command: Float[Array, "*B 2"]) -> Float[Array, "*B 2"]:
    """Left and right wheel speeds of commands, in rad/s."""
    forward, turn = command[..., 0], command[..., 1] * amiro.WHEEL_SEPARATION / 2
    return jnp.stack([forward - turn, forward + turn], axis=-1) / amiro.WHEEL_RADIUS


def ramp(
    command: Float[Array, "*B 2"], wanted: Float[Array, "*B 2"], seconds: float
) -> Float[Array, "*B 2"]:
    """Moves a command towards a wanted one, within the robot's limits.

    Turning takes motor force from forward acceleration.

    Args:
      wanted: clipped to the limits of speed and turn rate.
      seconds: how long the command may change.
    """
    forward = jnp.clip(wanted[..., 0], -amiro.MAX_SPEED, amiro.MAX_SPEED) - command[..., 0]
    turn = jnp.clip(wanted[..., 1], -amiro.MAX_TURN_RATE, amiro.MAX_TURN_RATE) - command[..., 1]
    most = seconds * amiro.MAX_TURN_ACCELERATION
    turn = jnp.clip(turn, -most, most)
    most = seconds * amiro.MAX_ACCELERATION - amiro.FORWARD_PER_TURN * jnp.abs(turn)
    forward = jnp.clip(forward, -most, most)
    return command + jnp.stack([forward, turn], axis=-1)


def face(bearing: Float[Array, ""]) -> Float[Array, "2"]:
    """Command that turns a standing robot towards a bearing in its frame, in radians."""
    return jnp.stack([jnp.zeros_like(bearing), jnp.clip(4.0 * bearing, -1.0, 1.0)])


def clearance(
    arena: ArenaConfig, layout: Layout, poses: Float[Array, "R 3"]
) -> tuple[Float[Array, " R"], Float[Array, " R"]]:
    """Free distance around each robot, exact for the actual shapes of the PoIs.

    Returns:
      Metres from a robot's outline to the nearest wall or PoI, and to the nearest robot; negative
      inside one.
    """
    chex.assert_shape(poses, (None, 3))
    x, y = poses[:, :1], poses[:, 1:2]
    to_wall = arena.side / 2 - jnp.max(jnp.abs(poses[:, :2]), axis=-1)
    if len(layout.walls):
        to_wall = jnp.minimum(to_wall, room_beside(layout.walls, poses[:, 0], poses[:, 1]))

    shapes = arena.shapes.values()
    half_sides = arena.poi_radius * jnp.array([shape.half_sides for shape in shapes])
    is_round = jnp.array([shape.is_round for shape in shapes])[layout.shape]
    half_u, half_v = half_sides[layout.shape].T
    from_x, from_y = x - layout.position[None, :, 0], y - layout.position[None, :, 1]
    from_box = to_box(from_x, from_y, layout.yaw[None], half_u[None], half_v[None])
    from_cylinder = jnp.hypot(from_x, from_y) - half_u[None]
    to_poi = jnp.min(jnp.where(is_round[None], from_cylinder, from_box), axis=-1)

    apart = jnp.hypot(x - x.T, y - y.T) - amiro.BODY_RADIUS
    to_robot = jnp.min(jnp.where(jnp.eye(len(poses), dtype=bool), jnp.inf, apart), axis=-1)
    return jnp.minimum(to_wall, to_poi) - amiro.BODY_RADIUS, to_robot - amiro.BODY_RADIUS


class _Arcs(NamedTuple):
    """Arcs of `[S, 2]` commands of a robot at `[T]` times [s], in its own frame.

    `[S, T]` x [m], y [m], cosine and sine of the heading.
    """

    commands: jax.Array
    times: jax.Array
    x: jax.Array
    y: jax.Array
    cos: jax.Array
    sin: jax.Array


@jax.named_scope("mission.drive_to")
def drive_to(
    arena: ArenaConfig,
    layout: Layout,
    poses: Float[Array, "R 3"],
    commands: Float[Array, "R 2"],
    robot: Index,
    waypoint: Float[Array, "2"],
    seconds: float,
    backs_off: Bool[Array, ""],
) -> Float[Array, "2"]:
    """Command that brings a robot to a waypoint soonest without touching anything.

    Excludes arcs closer to something than the planning radius minus 5 mm, which allows for
    their coarse samples, unless they lead away from what is too close already. PoIs are circles
    that hold every shape. Other robots may stand or go straight on; an arc must be clear of both.
    The cost of an arc is the minimum time to the waypoint over the samples where the robot may
    leave it, from half the horizon on: time so far, turning to the waypoint and driving straight,
    plus a penalty within the inflation around obstacles.

    Args:
      waypoint: in metres.
      seconds: how long the robot keeps the command.
    """
    chex.assert_shape([waypoint, poses, commands], [(2,), (None, 3), (len(poses), 2)])
    pose, present = poses[robot], commands[robot]
    arcs, cos, sin = _arcs(present[1], seconds), jnp.cos(pose[2]), jnp.sin(pose[2])

    def in_frame(positions: Float[Array, "*K 2"]) -> tuple[jax.Array, jax.Array]:
        """Coordinates x and y in the robot's frame, in which arcs are constants."""
        to_x, to_y = positions[..., 0] - pose[0], positions[..., 1] - pose[1]
        return cos * to_x + sin * to_y, cos * to_y - sin * to_x

    # Room to walls and PoIs, from the arcs and from where the robot is.
    x, y = pose[0] + cos * arcs.x - sin * arcs.y, pose[1] + sin * arcs.x + cos * arcs.y
    to_wall = arena.side / 2 - jnp.maximum(jnp.abs(x), jnp.abs(y)) - PLANNING_RADIUS
    to_wall_now = arena.side / 2 - jnp.max(jnp.abs(pose[:2])) - PLANNING_RADIUS
    if len(layout.walls):
        to_wall = jnp.minimum(to_wall, room_beside(layout.walls, x, y) - PLANNING_RADIUS)
        beside_now = room_beside(layout.walls, pose[0], pose[1]) - PLANNING_RADIUS
        to_wall_now = jnp.minimum(to_wall_now, beside_now)
    keep, (poi_x, poi_y) = arena.poi_extent + PLANNING_RADIUS, in_frame(layout.position)
    map_room = jnp.minimum(to_wall, _to_nearest(arcs, poi_x[:, None], poi_y[:, None]) - keep)
    map_room_now = jnp.minimum(to_wall_now, jnp.min(jnp.hypot(poi_x, poi_y)) - keep)
    # To other robots, of which each counts twice: it may go straight on or stand.
    beside, speed = jnp.tile(others(poses, robot), (2, 1)), others(commands, robot)[:, :1]
    driven = arcs.times[None] * jnp.append(speed, jnp.zeros_like(speed), axis=0)
    course, (at_x, at_y) = (beside[:, 2] - pose[2])[:, None], in_frame(beside[:, :2])
    x, y = at_x[:, None] + driven * jnp.cos(course), at_y[:, None] + driven * jnp.sin(course)
    room = jnp.minimum(map_room, _to_nearest(arcs, x, y) - 2 * PLANNING_RADIUS)
    beside_now = jnp.min(jnp.hypot(at_x, at_y), initial=jnp.inf) - 2 * PLANNING_RADIUS
    room_now = jnp.minimum(map_room_now, beside_now)
    is_safe = jax.lax.cummin(room, axis=1) >= jnp.minimum(room_now - 1e-4, -_GRAZE)

    goal = sidestep(arena, layout, pose[:2], waypoint, others(poses[:, :2], robot))
    arrival = _arrival(arcs, *in_frame(goal), map_room)
    value = jnp.min(jnp.where(is_safe, arrival, jnp.inf)[:, _MAY_LEAVE:], axis=1)
    value = jnp.where(backs_off, -room[:, _MAY_LEAVE], value)
    # Within reach of the present command; 0 if no arc may start.
    change = [_change(a, seconds) for a in (amiro.MAX_ACCELERATION, amiro.MAX_TURN_ACCELERATION)]
    in_window = jnp.abs(arcs.commands - present[None]) <= jnp.array(change)[None]
    value = jnp.where(jnp.all(in_window, axis=-1) & is_safe[:, 0], value, jnp.inf)
    best = jnp.argmin(value)
    return jnp.where(jnp.isfinite(value[best]), arcs.commands[best], 0.0)


def _to_nearest(arcs: _Arcs, x: jax.Array, y: jax.Array) -> jax.Array:
    """Metres, `[S, T]`, from the arcs to the nearest of K positions, each `[T]` or `[1]`."""

    def nearer(squared: jax.Array, position: tuple[jax.Array, jax.Array]):
        to_x, to_y = arcs.x - position[0][None], arcs.y - position[1][None]
        return jnp.minimum(squared, to_x**2 + to_y**2), None

    # All positions together exceed the cache, and unrolled they take long to compile.
    far = jnp.full_like(arcs.x, jnp.inf)
    return jnp.sqrt(jax.lax.scan(nearer, far, (x, y), unroll=4)[0])


def _arrival(
    arcs: _Arcs, x: Float[Array, ""], y: Float[Array, ""], room: Float[Array, "S T"]
) -> Float[Array, "S T"]:
    """Seconds to a goal in the robot's frame for a robot that leaves the arc at each sample."""
    to_x, to_y = x - arcs.x, y - arcs.y
    distance = jnp.hypot(to_x, to_y)
    ahead, beside = arcs.cos * to_x + arcs.sin * to_y, arcs.cos * to_y - arcs.sin * to_x
    turn = jnp.arctan2(jnp.abs(beside), ahead)
    # The direction of a near waypoint is meaningless.
    turn *= jnp.clip(distance / 0.08 - 0.25, 0.0, 1.0)
    cost = _INFLATION_COST * jnp.clip(1.0 - jax.lax.cummin(room, axis=1) / _INFLATION, 0.0, 1.0)
    return arcs.times[None] + turn / amiro.MAX_TURN_RATE + distance / amiro.MAX_SPEED + cost


@jax.named_scope("mission.sidestep")
def sidestep(
    arena: ArenaConfig,
    layout: Layout,
    position: Float[Array, "2"],
    waypoint: Float[Array, "2"],
    blocking: Float[Array, "K 2"],
) -> Float[Array, "2"]:
    """Position to head for on a straight line that another robot may block.

    Args:
      position: of the robot, in metres.
      waypoint: where it is going, in metres.
      blocking: positions of the other robots, in metres.

    Returns:
      The waypoint, or a position next to the blocking robot: on the shorter side with room, on the
      right if both are equal.
    """
    keep = 2 * PLANNING_RADIUS + _SIDESTEP
    reach = arena.side / 2 - PLANNING_RADIUS
    along = waypoint - position
    length = jnp.maximum(jnp.linalg.norm(along), 1e-6)
    along /= length
    right = jnp.stack([along[1], -along[0]])

    def beside(other: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Position next to another robot, and whether to go there."""
        to_other = other - position
        ahead, aside = product(to_other, along), product(to_other, right)
        blocks = (jnp.abs(aside) < keep - _SIDESTEP / 2) & (ahead > 0) & (ahead < length)
        # On the tangents to a circle around the other robot, or outwards from inside the circle.
        apart = jnp.maximum(jnp.linalg.norm(to_other), 1e-6)
        turn = jnp.arcsin(jnp.minimum(keep / apart, 1.0)) + jnp.maximum(1.0 - apart / keep, 0.0)
        step = jnp.sqrt(jnp.maximum(apart**2 - keep**2, 0.15**2)) / apart
        cos, sin = step * jnp.cos(turn), step * jnp.sin(turn)
        across = jnp.stack([to_other[1], -to_other[0]])
        sides = position[None] + jnp.stack(
            [cos * to_other + sin * across, cos * to_other - sin * across]
        )
        to_pois = jnp.linalg.norm(sides[:, None] - layout.position[None], axis=-1)
        has_room = jnp.all(to_pois >= arena.poi_extent + PLANNING_RADIUS, axis=-1)
        has_room &= jnp.max(jnp.abs(sides), axis=-1) <= reach
        if len(layout.walls):
            has_room &= room_beside(layout.walls, *sides.T) >= PLANNING_RADIUS
        detour = jnp.linalg.norm(sides - waypoint[None], axis=-1) + jnp.array([0.0, 0.05])
        best = jnp.argmin(jnp.where(has_room, detour, jnp.inf))
        return sides[best], blocks & jnp.any(has_room)

    # The last of several robots counts.
    steps, applies = jax.vmap(beside)(blocking)
    positions = jnp.concatenate([waypoint[None], steps])
    last = jnp.max(jnp.where(applies, 1 + jnp.arange(len(blocking)), 0), initial=0)
    return positions[last]


def _change(acceleration: float, seconds: float) -> float:
    """How much a command may change within a time, with a margin for rounding."""
    return seconds * acceleration + 1e-6


def _arcs(turn_rate: Float[Array, ""], seconds: float) -> _Arcs:
    """The arcs of the commands that the planner tries, at the turn rates within reach."""
    forward = np.linspace(0.0, amiro.MAX_SPEED, _NUM_SPEEDS - 1)
    speeds = np.concatenate([[-_BACKWARD_SPEED], forward]).astype(np.float32)
    turns = np.linspace(-amiro.MAX_TURN_RATE, amiro.MAX_TURN_RATE, _NUM_TURN_RATES)
    spacing, change = turns[1] - turns[0], _change(amiro.MAX_TURN_ACCELERATION, seconds)
    number = min(_NUM_TURN_RATES, 1 + int(2 * change / spacing))
    first = jnp.ceil((turn_rate - change - turns[0]) / spacing).astype(jnp.int32)
    first = jnp.clip(first, 0, _NUM_TURN_RATES - number)

    times = _HORIZON * jnp.array(_SAMPLE_TIMES, jnp.float32)
    w = jnp.array(turns, jnp.float32)[:, None]
    heading = w * times[None]
    # At a speed of 1 m/s, sin(h) / w and (1 - cos(h)) / w, also where w is 0.
    x = times[None] * jnp.sinc(heading / np.pi)
    y = times[None] * jnp.sin(heading / 2) * jnp.sinc(heading / (2 * np.pi))

    def in_reach(of_turns: jax.Array, factor: np.ndarray) -> jax.Array:
        """Rows of all speeds, times a factor, and the turn rates in reach."""
        rows = jax.lax.dynamic_slice_in_dim(of_turns, first, number)[None]
        return (jnp.asarray(factor)[:, None, None] * rows).reshape(len(speeds) * number, -1)

    once = np.ones_like(speeds)
    commands = jnp.concatenate([in_reach(jnp.ones_like(w), speeds), in_reach(w, once)], axis=1)
    cos, sin = (in_reach(of_turns, once) for of_turns in (jnp.cos(heading), jnp.sin(heading)))
    return _Arcs(commands, times, in_reach(x, speeds), in_reach(y, speeds), cos, sin)
