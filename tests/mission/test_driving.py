import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from navigating import ARENA, PERIOD, layout_of

from jaxsense import sim
from jaxsense.config import Config
from jaxsense.mission import navigation, roadmap

CONFIG = Config()
# A cube of half side 0.1 reaches 0.141421 from its centre, a robot is planned with 0.1.
KEEP = 0.241421  # m


def move(layout, poses, commands, wanted):
    """Poses and commands after one period of driving like a unicycle, and the least clearance."""

    def step(state, _):
        poses, commands = state
        commands = navigation.ramp(commands, wanted, 0.01)
        forward, turn = commands[:, 0], commands[:, 1]
        heading = poses[:, 2] + 0.005 * turn
        velocity = jnp.stack([forward * jnp.cos(heading), forward * jnp.sin(heading), turn], -1)
        poses += 0.01 * velocity
        return (poses, commands), jnp.min(navigation.clearance(ARENA, layout, poses))

    (poses, commands), clearance = jax.lax.scan(step, (poses, commands), length=10)
    return poses, commands, jnp.min(clearance)


@pytest.fixture(scope="module")
def driven():
    """Ways of lone robots from random places to random places: straight on, or by the roadmap."""

    def drive(key, by_map):
        layout_key, class_key, *place_keys, yaw_key, poi_key = jax.random.split(key, 6)
        classes = jax.random.randint(class_key, (3,), 0, 3)
        layout = sim.random_layout(layout_key, ARENA, classes)

        def free_place(key):
            places = jax.random.uniform(key, (64, 2), minval=-1.4, maxval=1.4)
            apart = jnp.linalg.norm(places[:, None] - layout.position[None], axis=-1)
            return places[jnp.argmax(apart.min(axis=-1) >= KEEP)]

        start, goal = (free_place(k) for k in place_keys)
        yaw = jax.random.uniform(yaw_key, (), minval=-np.pi, maxval=np.pi)
        if by_map:
            ways = roadmap.build(CONFIG, layout)
            poi = jax.random.randint(poi_key, (), 0, 3)
            length = roadmap.lengths(CONFIG, layout, ways, start, poi)
            # Of the viewpoints with a way to them, the farthest.
            view = jnp.argmax(jnp.where(jnp.isfinite(length), length, -1.0))
            goal, distance = ways.viewpoints[poi, view], length[view]
        else:
            distance = jnp.linalg.norm(goal - start)

        def step(state, _):
            poses, commands = state
            waypoint = goal
            if by_map:
                far = jnp.full((1, 2), 1e3)
                args = ways.to_viewpoint(poi, view), poses[0, :2], far, poi, view
                _, waypoint = roadmap.next_waypoint(CONFIG, layout, ways, *args)
            args = poses, commands, 0, waypoint, PERIOD, jnp.bool_(False)
            wanted = navigation.drive_to(ARENA, layout, *args)
            poses, commands, clearance = move(layout, poses, commands, wanted[None])
            return (poses, commands), (poses[0, :2], clearance)

        state = jnp.append(start, yaw)[None], jnp.zeros((1, 2))
        _, (path, clearance) = jax.lax.scan(step, state, length=300)
        arrived = jnp.linalg.norm(path - goal[None], axis=-1) < 0.2
        seconds = jnp.where(arrived.any(), PERIOD * (1 + jnp.argmax(arrived)), jnp.inf)
        return layout.position, start, goal, distance, seconds, clearance.min()

    def run(by_map, number):
        keys = jax.random.split(jax.random.key(0), number)
        ways = jax.jit(jax.vmap(functools.partial(drive, by_map=by_map)))(keys)
        return jax.tree.map(np.array, ways)

    return run


def test_a_robot_drives_to_places_in_sight_and_touches_nothing(driven):
    position, start, goal, distance, seconds, clearance = driven(by_map=False, number=150)
    # With 0.1 m it is planned 0.0505 m larger than it is, of which a trajectory may cut 0.005.
    assert clearance.min() > 0.03
    along = (goal - start) / distance[:, None]
    share = np.sum((position - start[:, None]) * along[:, None], axis=-1)
    nearest = start[:, None] + np.clip(share, 0, distance[:, None])[..., None] * along[:, None]
    in_sight = np.linalg.norm(position - nearest, axis=-1).min(axis=-1) >= KEEP
    assert in_sight.sum() > 100
    # Where it has to turn first it may get behind a PoI, which the roadmap leads it out of.
    assert np.isfinite(seconds[in_sight]).mean() >= 0.93
    # At 0.2 m/s to 0.2 m before the goal, after at most pi s of turning: pi - 1 s longer.
    assert (seconds <= distance / 0.2 + 2.1)[in_sight].mean() > 0.9
    # No faster than its highest speed.
    assert (seconds >= (distance - 0.2) / 0.2 - 0.1).all()


def test_a_robot_that_follows_the_roadmap_always_arrives_and_touches_nothing(driven):
    _, _, _, length, seconds, clearance = driven(by_map=True, number=60)
    assert np.isfinite(length).all()
    assert length.mean() > 1.5
    assert clearance.min() > 0.03
    assert np.isfinite(seconds).all()
    assert np.max(seconds - length / 0.2) < 3


@pytest.fixture(scope="module")
def met():
    """Two robots that drive at each other, or one at another that stands, in B directions.

    How far robot 1 is beside the way of robot 0, paths as seen along it `[B, T, 2, 2]`, distances
    to the goals `[B, T, 2]`, and the least clearance.
    """

    def meet(yaw, beside, stands):
        turn = jnp.array([[jnp.cos(yaw), -jnp.sin(yaw)], [jnp.sin(yaw), jnp.cos(yaw)]])
        starts = jnp.array([[-0.9, 0.0], [0.9, 0.0]]) + beside * jnp.array([[0.0, 0.0], [0.0, 1.0]])
        goals = starts * jnp.array([[-1.0, 1.0]])
        starts = jnp.where(stands, starts * jnp.array([[1.0, 1.0], [0.0, 1.0]]), starts)
        yaws = jnp.stack([yaw, yaw + jnp.pi])
        goals = goals @ turn.T

        def step(state, _):
            poses, commands = state
            wanted = [
                navigation.drive_to(
                    ARENA, layout_of(), poses, commands, r, goal, PERIOD, jnp.bool_(False)
                )
                for r, goal in enumerate(goals)
            ]
            wanted[1] = jnp.where(stands, 0.0, wanted[1])
            poses, commands, clearance = move(layout_of(), poses, commands, jnp.stack(wanted))
            return (poses, commands), (poses, clearance)

        state = jnp.concatenate([starts @ turn.T, yaws[:, None]], axis=-1), jnp.zeros((2, 2))
        _, (path, clearance) = jax.lax.scan(step, state, length=150)
        away = jnp.linalg.norm(path[..., :2] - goals[None], axis=-1)
        return path[..., :2] @ turn, away, clearance.min()

    meet = jax.jit(jax.vmap(meet))

    def run(stands):
        yaw = np.linspace(-3, 3, 25, dtype=np.float32)
        beside = np.tile(np.linspace(-0.2, 0.2, 5, dtype=np.float32), 5)
        return beside, *jax.tree.map(np.array, meet(yaw, beside, np.full(25, stands)))

    return run


def test_two_robots_that_drive_at_each_other_pass_and_do_not_touch(met):
    beside, path, away, clearance = met(stands=False)
    # Planning keeps their middles 2 * 0.1 - 0.005 apart, of which 2 * 0.0495 are the robots.
    assert clearance.min() > 0.09
    # 1.6 m to within 0.2 m at 0.2 m/s take 8 s.
    seconds = PERIOD * (1 + np.argmax(away < 0.2, axis=1))
    assert (away.min(axis=1) < 0.2).all()
    assert np.all((seconds >= 7.9) & (seconds < 11))
    # Head-on, each goes to its right.
    head_on = path[np.abs(beside) < 1e-6]
    assert np.all(head_on[:, :, 0, 1].min(axis=1) < -0.05)
    assert np.all(head_on[:, :, 1, 1].max(axis=1) > 0.05)


def test_a_robot_drives_around_one_that_stands_in_its_way(met):
    _, path, away, clearance = met(stands=True)
    assert clearance.min() > 0.09
    assert np.ptp(path[:, :, 1], axis=1).max() < 1e-6
    assert (away[:, :, 0].min(axis=1) < 0.2).all()
    assert np.argmax(away[:, :, 0] < 0.2, axis=1).max() * PERIOD < 11


@pytest.fixture(scope="module")
def sidestep():
    step = jax.jit(functools.partial(navigation.sidestep, ARENA))

    def from_origin(others, layout=None, place=(0.0, 0.0)):
        """The next place on the way to 1 m further east, seen from where the robot is."""
        place, others = jnp.array(place), jnp.array(others).reshape(-1, 2) + jnp.array([place])
        layout = layout_of() if layout is None else layout
        return np.array(step(layout, place, place + jnp.array([1.0, 0.0]), others) - place)

    return from_origin


@pytest.mark.parametrize(
    "others",
    [
        [],
        [(0.5, 0.235)],  # 0.2 + 0.03 beside the way are enough
        [(0.5, -0.235)],
        [(-0.1, 0.0)],  # behind
        [(1.05, 0.0)],  # beyond the waypoint
        [(1e3, 1e3)],
    ],
)
def test_with_nobody_in_the_way_the_waypoint_stays(sidestep, others):
    np.testing.assert_array_equal(sidestep(others), [1.0, 0.0])


# From 0.52 m away, tangents to a circle of 2 * 0.1 + 0.06 = 0.26 m leave at 30 degrees to either
# side and touch it after sqrt(0.52^2 - 0.26^2) = 0.450333 m, at (0.39, +-0.225167).
RIGHT, LEFT = (0.39, -0.225167), (0.39, 0.225167)


def at(distance, degrees):
    return distance * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((0.52, 0.0), RIGHT),
        (at(0.52, 10), at(0.450333, -20)),  # to the left of the way: the right side is shorter
        (at(0.52, 1), at(0.450333, -29)),
        (at(0.52, -1), at(0.450333, -31)),  # left is shorter, but by less than 0.05 m
        (at(0.52, -10), at(0.450333, 20)),
        # Closer than 0.26, outwards: 0.15 m at 90 degrees + 1 - 0.2 / 0.26 = 0.230769 rad.
        ((0.2, 0.0), (-0.034309, -0.146024)),
        (at(0.52, 25), at(0.450333, -5)),  # 0.22 beside the way: just in it
    ],
)
def test_a_robot_in_the_way_is_passed_on_the_shorter_side(sidestep, other, expected):
    np.testing.assert_allclose(sidestep([other]), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "in_the_way", "expected"),
    [
        ((0.0, 0.0), [(0.39, -0.46)], LEFT),  # 0.2348 from the place on the right, less than 0.2414
        ((0.0, 0.0), [(0.39, -0.47)], RIGHT),  # 0.2448
        ((0.0, 0.0), [(0.39, 0.46)], RIGHT),
        ((0.0, 0.0), [(0.39, -0.46), (0.39, 0.46)], (1.0, 0.0)),
        ((0.0, -1.18), [], LEFT),  # on the right, 1.5 - 1.18 - 0.2252 = 0.0948 to the wall
        ((0.0, -1.17), [], RIGHT),  # 0.1048
        ((0.0, 1.3), [], RIGHT),
    ],
)
def test_a_robot_in_the_way_is_passed_where_there_is_room(sidestep, place, in_the_way, expected):
    step = sidestep([(0.52, 0.0)], layout_of(*in_the_way), place)
    np.testing.assert_allclose(step, expected, atol=1e-5)
