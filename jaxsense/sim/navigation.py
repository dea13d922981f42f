"""Driving among obstacles: the local part of the paper's move_base, as pure functions.

Trajectory rollout (Fox, Burgard and Thrun 1997, the dynamic window approach): of the arcs that a
robot can take up from its present speed, it takes the one from which it is soonest at its goal,
among those that keep clear of the walls, the PoIs and the other robots. A command is a forward
speed [m/s] and a turn rate [rad/s].
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import ArenaConfig, NavigationConfig
from jaxsense.sim import amiro
from jaxsense.sim.arena import Layout
from jaxsense.types import Index, others

BACKWARD_SPEED = 0.1  # m/s
_SAMPLE_TIMES = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0)  # shares of the horizon
# From half the horizon on an arc may be left; at once would make standing still worth as much.
_MAY_LEAVE = _SAMPLE_TIMES.index(0.5)
_GRAZE = 0.005  # m, by which a trajectory may cut the planning radius: samples are coarse
_SIDESTEP = 0.06  # m, by which a way around another robot is wider than it must be
_INFLATION_COST = 0.1  # s, of a way that just touches the planning radius


def wheel_speeds(command: jax.Array) -> jax.Array:
    """`[..., 2]` left and right wheel speeds [rad/s] of `[..., 2]` commands."""
    forward, turn = command[..., 0], command[..., 1] * amiro.WHEEL_SEPARATION / 2
    return jnp.stack([forward - turn, forward + turn], axis=-1) / amiro.WHEEL_RADIUS


def ramp(command: jax.Array, wanted: jax.Array, seconds: float) -> jax.Array:
    """The command after some time on the way to a wanted one, within the robot's limits.

    What turning takes of the motors' force is not there for going forward.

    Args:
      command: `[..., 2]` the present one.
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
    """`[2]` the command that turns a standing robot towards a bearing [rad] in its frame."""
    return jnp.stack([jnp.zeros_like(bearing), jnp.clip(4.0 * bearing, -1.0, 1.0)])


def clearance(arena: ArenaConfig, layout: Layout, poses: jax.Array) -> jax.Array:
    """Free distance around each robot, exact for the shapes that the PoIs really have.

    Args:
      arena: its sizes.
      layout: the PoIs.
      poses: `[R, 3]` of the robots.

    Returns:
      `[R]` metres from a robot's outline to the nearest wall, PoI or robot; negative if it is in
      one.
    """
    chex.assert_shape(poses, (None, 3), custom_message="poses")
    x, y = poses[:, 0], poses[:, 1]
    nearest = arena.side / 2 - jnp.maximum(jnp.abs(x), jnp.abs(y))
    for n in range(arena.num_pois):
        from_x, from_y = x - layout.position[n, 0], y - layout.position[n, 1]
        cos, sin = jnp.cos(layout.yaw[n]), jnp.sin(layout.yaw[n])
        for i, shape in enumerate(arena.shapes.values()):
            half_u, half_v = (share * arena.poi_radius for share in shape.half_sides)
            along = jnp.abs(cos * from_x + sin * from_y) - half_u
            across = jnp.abs(cos * from_y - sin * from_x) - half_v
            outside = jnp.hypot(jnp.maximum(along, 0.0), jnp.maximum(across, 0.0))
            to_box = outside + jnp.minimum(jnp.maximum(along, across), 0.0)
            to_cylinder = jnp.hypot(from_x, from_y) - half_u
            distance = to_box if shape.primitive == "box" else to_cylinder
            nearest = jnp.where(layout.shape[n] == i, jnp.minimum(nearest, distance), nearest)
    for r in range(len(poses)):
        apart = jnp.hypot(x - x[r], y - y[r]) - amiro.BODY_RADIUS
        nearest = jnp.where(jnp.arange(len(poses)) == r, nearest, jnp.minimum(nearest, apart))
    return nearest - amiro.BODY_RADIUS


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
    """The command that brings a robot to a waypoint soonest without touching anything.

    Arcs that come closer to something than `robot_radius` (less 5 mm, for their coarse samples) are
    out, but for those that lead away from what is too close already. PoIs are the circles that hold
    both shapes. Other robots are held to stay and, just as well, to go straight on as they do now.
    The value of an arc is the least time to the waypoint over the points where the robot may leave
    it, from half the horizon on: the time so far, that of turning to the waypoint, and that of a
    straight drive; ways through the inflation around obstacles cost extra time.

    Args:
      settings: of the planner.
      arena: its sizes.
      layout: the PoIs' places; their shapes are not used.
      poses: `[R, 3]` of all robots.
      commands: `[R, 2]` of all robots.
      robot: which one is asking.
      waypoint: `[2]` in metres.
      seconds: for which the command will be held.
      backs_off: `[]` bool: instead, have as much room as possible in half the horizon from now.

    Returns:
      `[2]` the wanted command.
    """
    chex.assert_shape(waypoint, (2,), custom_message="waypoint")
    chex.assert_equal_shape_prefix([poses, commands], 1, custom_message="commands")
    samples, times, x, y, heading = _arcs(settings)
    pose, present = poses[robot], commands[robot]
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])

    # All in the robot's frame, where the arcs are constants.
    def in_frame(place: jax.Array) -> tuple[jax.Array, jax.Array]:
        to_x, to_y = place[0] - pose[0], place[1] - pose[1]
        return cos * to_x + sin * to_y, cos * to_y - sin * to_x

    reach = settings.robot_radius
    world_x, world_y = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
    room = arena.side / 2 - jnp.maximum(jnp.abs(world_x), jnp.abs(world_y)) - reach
    room_now = arena.side / 2 - jnp.max(jnp.abs(pose[:2])) - reach
    for n in range(arena.num_pois):
        at_x, at_y = in_frame(layout.position[n])
        keep = arena.poi_extent + reach
        room = jnp.minimum(room, jnp.hypot(x - at_x, y - at_y) - keep)
        room_now = jnp.minimum(room_now, jnp.hypot(at_x, at_y) - keep)
    room_of_map = jax.lax.cummin(room, axis=1)
    for other, command in zip(others(poses, robot), others(commands, robot), strict=True):
        at_x, at_y = in_frame(other)
        course, speed = other[2] - pose[2], command[0]
        then_x, then_y = (
            at_x + times * speed * jnp.cos(course),
            at_y + times * speed * jnp.sin(course),
        )
        keep = 2 * reach
        to_other = jnp.minimum(
            jnp.hypot(x - then_x[None], y - then_y[None]), jnp.hypot(x - at_x, y - at_y)
        )
        room = jnp.minimum(room, to_other - keep)
        room_now = jnp.minimum(room_now, jnp.hypot(at_x, at_y) - keep)
    least = jax.lax.cummin(room, axis=1)

    beside = sidestep(settings, arena, layout, pose[:2], waypoint, others(poses[:, :2], robot))
    goal_x, goal_y = in_frame(beside)
    distance = jnp.hypot(goal_x - x, goal_y - y)
    turn = jnp.arctan2(goal_y - y, goal_x - x) - heading
    turn = jnp.abs((turn + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    # Near the waypoint its direction means nothing.
    turn *= jnp.clip(distance / 0.08 - 0.25, 0.0, 1.0)
    inflation = jnp.maximum(settings.inflation, 1e-6)
    cost = _INFLATION_COST * jnp.clip(1.0 - room_of_map / inflation, 0.0, 1.0)
    arrival = times[None] + turn / amiro.MAX_TURN_RATE + distance / amiro.MAX_SPEED + cost
    is_safe = least >= jnp.minimum(room_now - 1e-4, -_GRAZE)
    value = jnp.min(jnp.where(is_safe, arrival, jnp.inf)[:, _MAY_LEAVE:], axis=1)
    value = jnp.where(backs_off, -room[:, _MAY_LEAVE], value)
    change = seconds * jnp.array([amiro.MAX_ACCELERATION, amiro.MAX_TURN_ACCELERATION]) + 1e-6
    in_window = jnp.all(jnp.abs(samples - present[None]) <= change[None], axis=-1)
    # The first part of the arc must be safe in any case: it will be driven.
    value = jnp.where(in_window & is_safe[:, 0], value, jnp.inf)
    best = jnp.argmin(value)
    return jnp.where(jnp.isfinite(value[best]), jnp.array(samples)[best], 0.0)


def sidestep(
    settings: NavigationConfig,
    arena: ArenaConfig,
    layout: Layout,
    place: jax.Array,
    waypoint: jax.Array,
    blocking: jax.Array,
) -> jax.Array:
    """The next place to go to on a straight way that another robot may stand in.

    Args:
      settings: of the planner.
      arena: its sizes.
      layout: the PoIs' places.
      place: `[2]` where the robot is, in metres.
      waypoint: `[2]` where it is going.
      blocking: `[K, 2]` where the other robots are.

    Returns:
      `[2]` the waypoint, or a place beside the robot that is in the way: on the side of the shorter
      way on which there is room, the right one if both are equal.
    """
    keep = 2 * settings.robot_radius + _SIDESTEP
    reach = arena.side / 2 - settings.robot_radius
    result = waypoint
    for other in blocking:
        along = waypoint - place
        length = jnp.maximum(jnp.linalg.norm(along), 1e-6)
        along /= length
        right = jnp.stack([along[1], -along[0]])
        ahead, beside = jnp.dot(other - place, along), jnp.dot(other - place, right)
        blocks = (jnp.abs(beside) < keep - _SIDESTEP / 2) & (ahead > 0) & (ahead < length)
        # On the tangents to a circle around the other robot; closer than that, outwards.
        to_other = other - place
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
        result = jnp.where(blocks & jnp.any(has_room), sides[best], result)
    return result


def _arcs(settings: NavigationConfig):
    """Commands `[S, 2]`, times `[T]`, and places and headings `[S, T]` on their arcs from 0."""
    forward = np.linspace(0.0, amiro.MAX_SPEED, settings.speed_samples - 1)
    turns = np.linspace(-amiro.MAX_TURN_RATE, amiro.MAX_TURN_RATE, settings.turn_samples)
    speeds = np.concatenate([[-BACKWARD_SPEED], forward])
    samples = np.stack(np.meshgrid(speeds, turns, indexing="ij"), axis=-1).reshape(-1, 2)
    samples = samples.astype(np.float32)
    times = settings.horizon * jnp.array(_SAMPLE_TIMES, jnp.float32)
    v, w = samples[:, :1], samples[:, 1:]
    heading = w * times[None]
    # sin(h) / w and (1 - cos(h)) / w, also where w is 0.
    x = v * times[None] * jnp.sinc(heading / np.pi)
    y = v * times[None] * jnp.sin(heading / 2) * jnp.sinc(heading / (2 * np.pi))
    return samples, times, x, y, heading
