import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import sim
from jaxsense.config.scene import ArenaConfig
from jaxsense.mission import navigation
from jaxsense.sim import arena as arenas

ARENA, PERIOD = ArenaConfig(num_pois=1, inner_walls=2), 0.1  # s
# One wall from (0.5, -0.6) to (0.5, 0.6), 0.05 m thick; the other is absent.
WALLS = jnp.array(arenas.absent_walls(2)).at[0].set(jnp.array([0.5, 0.0, jnp.pi / 2, 0.6]))
POI = jnp.array([[-1.2, -1.2]])
LAYOUT = sim.make_layout(ARENA, POI, jnp.zeros(1), jnp.zeros(1, jnp.int32), WALLS)


def test_clearance_from_an_inner_wall_is_that_worked_by_hand():
    places = [[0.2, 0.1], [0.6, 0.1], [0.565, 0.63], [0.51, 0.1], [1.4, 0.1]]
    clearance, _ = navigation.clearance(ARENA, LAYOUT, jnp.pad(jnp.array(places), [(0, 0), (0, 1)]))
    # 0.3 and 0.1 from its middle, minus 0.025 and 0.0495; hypot(0.065 - 0.025, 0.03) - 0.0495 from
    # its end; in it: 0.01 - 0.025 - 0.0495; nearer to the outer wall.
    np.testing.assert_allclose(clearance, [0.2255, 0.0255, 0.0005, -0.0645, 0.0505], atol=1e-5)


@jax.jit
def drive(layout, waypoint):
    """Positions of a robot that drives from the origin for 10 s."""

    def step(state, _):
        pose, command = state
        given = pose[None], command[None], 0, waypoint, PERIOD, jnp.bool_(False)
        wanted = navigation.drive_to(ARENA, layout, *given)
        forward, turn = command = navigation.ramp(command, wanted, PERIOD)
        pose += PERIOD * jnp.stack([forward * jnp.cos(pose[2]), forward * jnp.sin(pose[2]), turn])
        return (pose, command), pose[:2]

    return jax.lax.scan(step, (jnp.zeros(3), jnp.zeros(2)), length=100)[1]


def test_a_robot_stops_before_a_wall():
    ahead = jnp.array([1.2, 0.0])
    path = np.array(drive(LAYOUT, ahead))
    # It keeps 0.1 m from the near side at 0.475, or 5 mm less.
    assert 0.3 < path[:, 0].max() <= 0.475 - 0.095 + 1e-4
    # Without the wall, it arrives.
    free = drive(dataclasses.replace(LAYOUT, walls=jnp.array(arenas.absent_walls(2))), ahead)
    assert np.abs(free[-1] - ahead).max() < 0.1
