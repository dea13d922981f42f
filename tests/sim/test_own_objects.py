"""Colours, shapes and attributes that a user has declared, in arena and sensors."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config import Attribute, Shape
from jaxsense.config.scene import ArenaConfig
from jaxsense.sim import sensors, windows
from jaxsense.sim.arena import build
from jaxsense.sim.light import Light

LIGHT = Light(jnp.array([0.8, 0.0, 0.6]), diffuse=jnp.float32(0.5), ambient=jnp.float32(0.25))
CONFIG = ArenaConfig(
    colours={"orange": (0.9, 0.4, 0.05), "black": (0.0, 0.0, 0.0)},
    shapes={"slab": Shape("box", (1.0, 0.6)), "post": Shape("cylinder", (0.5, 0.5))},
    attributes={"temperature": Attribute({"cold": 5.0, "hot": 60.0}, elsewhere=20.0)},
    classes=("orange slab hot", "black post cold", "orange post hot"),
)
POSITION = jnp.array([[0.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
LAYOUT = sim.make_layout(CONFIG, POSITION, jnp.zeros(3), jnp.array([0, 1, 0]))

cast = jax.jit(sim.cast)
cross_section = jax.jit(sim.cross_section, static_argnames=("arena", "robot"))


@pytest.fixture(scope="module")
def view():
    """An arena of them, and its state with a robot before the slab and one in a corner."""
    arena = build(CONFIG, (False, True), contacts=True)
    poses = jnp.array([[-0.5, 0.0, 0.0], [-1.3, -1.3, 0.0]])
    return arena, jax.jit(sim.place, static_argnums=0)(arena, LAYOUT, poses)


def test_rays_meet_shapes_where_their_sides_are(view):
    arena, data = view
    section = cross_section(arena, data, 0.152, robot=-1)
    # The slab at the origin is 0.2 m by 0.12 m, the post at (0, 1) 0.1 m across.
    for start, angle, distance in (
        ((0.5, 0.0), np.pi, 0.4),
        ((0.0, -0.5), np.pi / 2, 0.44),
        ((0.0, 0.5), np.pi / 2, 0.45),
        ((0.5, 1.0), np.pi, 0.45),
    ):
        hit = cast(section, jnp.array(start), jnp.float32(angle))
        assert hit.distance == pytest.approx(distance, abs=1e-5)


def test_surfaces_show_the_attributes_of_pois_and_of_everything_else(view):
    arena, _ = view
    shown = sensors.surfaces(arena, LAYOUT)
    of_geom = {arena.mj_model.geom(g).name: g for g in range(arena.mj_model.ngeom)}
    for name, temperature in (("poi0_slab", 60), ("poi1_post", 5), ("wall0", 20)):
        assert shown["temperature"][of_geom[name]] == temperature
    np.testing.assert_allclose(shown["colour"][of_geom["poi2_slab"]], [0.9, 0.4, 0.05])


@dataclasses.dataclass(frozen=True)
class ThreeRays:
    """Ahead and 0.5 rad to either side, from left to right."""

    angles = np.float32([0.5, 0.0, -0.5])

    def centre(self, bearing):
        return 1.0 - 2.0 * bearing


class Sonar(sim.Sensor):
    """One range for all rays, in a unit of its own."""

    scale: float

    def read(self, key, hits, surfaces, light):
        nearest = jnp.min(hits.distance)
        return self.scale * jnp.full(hits.distance.shape, nearest)


def test_a_sensor_of_ones_own_is_a_subclass_whose_fields_are_inputs_of_a_program(view):
    arena, data = view

    @jax.jit
    @chex.assert_max_traces(n=1)
    def scan(sonar):
        light, key = LIGHT, jax.random.key(0)
        return sim.scan(key, sonar, arena, data, LAYOUT, light, 0, jnp.array(sonar.directions))

    for scale in (1.0, 100.0):
        sonar = Sonar(scale, height=0.1, rays=ThreeRays(), window=3)
        # The slab is 0.5 m ahead of robot 0, less half of its 0.2 m.
        np.testing.assert_allclose(scan(sonar), 3 * [0.4 * scale], rtol=1e-5)
    assert windows.cut_out(sonar, np.ones(3, np.float32), 0.0).tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(TypeError, match="abstract"):
        sim.Sensor(height=0.1, rays=ThreeRays(), window=3)
