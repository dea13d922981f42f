"""Navigation among more robots and PoIs than two and three."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from navigating import ARENA, PERIOD, layout_of

from jaxsense import sim
from jaxsense.config import ArenaConfig
from jaxsense.mission import navigation

LARGE = ArenaConfig(num_pois=16, side=6.0)
AWAY = [[-1.2, -1.2, 0.0], [-1.2, 1.2, 0.0], [1.2, -1.2, 0.0]]


def random_layout(key, arena):
    return sim.random_layout(key, arena, jnp.arange(arena.num_pois) % len(arena.classes))


def drive(arena, layout, poses):
    rest = jnp.zeros((len(poses), 2)), 0, jnp.array([0.3, 0.2]), PERIOD, jnp.bool_(False)
    return navigation.drive_to(arena, layout, poses, *rest)


def sidestep(arena, layout, poses):
    place, waypoint, blocking = poses[0, :2], jnp.array([0.3, 0.2]), poses[1:, :2]
    return navigation.sidestep(arena, layout, place, waypoint, blocking)


@pytest.mark.parametrize("function", [drive, sidestep, navigation.clearance])
def test_programs_are_of_one_size_for_all_numbers_of_robots_and_pois(function):
    def size(num_robots, arena):
        layout = jax.eval_shape(lambda: random_layout(jax.random.key(0), arena))
        poses = jax.ShapeDtypeStruct((num_robots, 3), jnp.float32)
        return str(jax.make_jaxpr(functools.partial(function, arena))(layout, poses)).count(" = ")

    assert size(2, ARENA) == size(8, ARENA) == size(8, LARGE)


@pytest.fixture(scope="module")
def command_to():
    """The command of robot 0 at the origin, which goes east at full speed."""

    @jax.jit
    def command(layout, others, commands):
        poses = jnp.concatenate([jnp.zeros((1, 3)), others])
        commands = jnp.concatenate([jnp.array([[0.2, 0.0]]), commands])
        args = 0, jnp.array([1.0, 0.0]), PERIOD, jnp.bool_(False)
        return navigation.drive_to(ARENA, layout, poses, commands, *args)

    return command


@pytest.mark.parametrize("slot", range(4))
@pytest.mark.parametrize(
    ("pose", "speed"),
    [
        ((0.5, 0.05, 0.0), 0.0),  # it stands in the way
        ((0.3, -0.3, np.pi / 2), 0.2),  # it drives across
        ((0.42, 0.0, 0.0), 0.2),  # it drives ahead, and may stop
    ],
)
def test_each_of_several_robots_is_kept_clear_of(command_to, slot, pose, speed):
    others = jnp.array([*AWAY[:slot], pose, *AWAY[slot:]])
    commands = jnp.zeros((4, 2)).at[slot, 0].set(speed)
    command = command_to(layout_of(), others, commands)
    alone = command_to(layout_of(), jnp.array([pose]), jnp.array([[speed, 0.0]]))
    np.testing.assert_array_equal(command, alone)
    free = command_to(layout_of(), jnp.array(AWAY), jnp.zeros((3, 2)))
    np.testing.assert_allclose(free, [0.2, 0.0], atol=1e-6)
    assert np.abs(command - free).max() > 0.04


@pytest.mark.parametrize("slot", range(3))
def test_each_of_several_pois_is_kept_clear_of(command_to, slot):
    places = [(-1.0, -1.0), (-1.0, 1.0)]
    nobody = jnp.zeros((0, 3)), jnp.zeros((0, 2))
    command = command_to(layout_of(*places[:slot], (0.3, 0.1), *places[slot:]), *nobody)
    np.testing.assert_array_equal(command, command_to(layout_of((0.3, 0.1)), *nobody))
    assert np.abs(command - jnp.array([0.2, 0.0])).max() > 0.04


def test_of_several_robots_in_the_way_the_last_is_passed():
    step = jax.jit(functools.partial(navigation.sidestep, ARENA, layout_of()))
    place, waypoint = jnp.zeros(2), jnp.array([1.0, 0.0])
    near, far, aside = jnp.array([0.4, 0.05]), jnp.array([0.7, -0.05]), jnp.array([0.5, 0.6])
    alone = {name: step(place, waypoint, other[None]) for name, other in (("n", near), ("f", far))}
    assert np.abs(alone["n"] - alone["f"]).max() > 0.1
    for order, last in (((near, far), "f"), ((far, near), "n"), ((aside, near, aside), "n")):
        np.testing.assert_allclose(step(place, waypoint, jnp.stack(order)), alone[last], atol=1e-6)


def test_clearance_among_many_is_the_least_of_clearances_among_two():
    # Close together, so that robots, PoIs and walls are the nearest of some.
    poses = np.array(jax.random.uniform(jax.random.key(1), (200, 5, 3), minval=-0.5, maxval=0.5))
    poses *= np.array([1.2, 5.9, 1.0], np.float32)
    layout = random_layout(jax.random.key(2), LARGE)
    clearance = jax.jit(jax.vmap(functools.partial(navigation.clearance, LARGE, layout)))
    together = np.array(clearance(poses))
    for robot in range(5):
        pairs = [clearance(poses[:, (robot, other)])[:, 0] for other in range(5) if other != robot]
        np.testing.assert_allclose(together[:, robot], np.min(pairs, axis=0), atol=1e-6)
    alone = np.array(clearance(poses[:, :1]))[:, 0]
    assert 0.1 < np.mean(together[:, 0] < alone) < 0.9


def test_clearance_heeds_every_poi():
    layout = random_layout(jax.random.key(3), LARGE)
    # 0.149 m from their middles: 0.149 - 0.0495 less 0.1, or at most 0.1414 for a cube.
    poses = jnp.pad(layout.position + jnp.array([[0.149, 0.0]]), ((0, 0), (0, 1)))
    clearance = jax.jit(functools.partial(navigation.clearance, LARGE))(layout, poses)
    is_cube = np.arange(16) % 3 == 2
    np.testing.assert_allclose(clearance[~is_cube], -0.0005, atol=1e-5)
    assert np.all((clearance[is_cube] > -0.0495) & (clearance[is_cube] < 0))
