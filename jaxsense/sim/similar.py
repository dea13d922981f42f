"""Finds the simulated looks that are most similar to recorded ones, and their residuals."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.config import Config
from jaxsense.core.types import Key, pytree
from jaxsense.sim import absence, windows
from jaxsense.sim import arena as arenas
from jaxsense.sim import world as worlds
from jaxsense.sim.light import random_light
from jaxsense.sim.world import Scene, World

NUM_SIMULATED = 96
"""Simulated windows to find the nearest of."""
_ROOM = 0.5  # m, behind a PoI
_MAX_SIDE = 100.0  # m


@pytree
class Similar:
    """The simulated window nearest to a recorded one, and residuals.

    Residuals are those of the rays at the PoI, NaN elsewhere, in the unit of the readings.

    Attributes:
      window: `[F]` the simulated input of the detector.
      recorded: `[F]` residuals of the recorded window, less the simulated one.
      simulated: `[F]` those of another simulated window in place of the recorded one, less the one
        that is nearest to that.
    """

    window: Float[Array, "*S F"]
    recorded: Float[Array, "*S F"]
    simulated: Float[Array, "*S F"]


def root_mean_square(residuals: Float[Array, "*S F"]) -> Float[Array, "*S"]:
    """Computes the root mean square of the residuals of each window, without NaN.

    Args:
      residuals: `[..., F]` see `Similar`.
    """
    return jnp.sqrt(jnp.nanmean(residuals**2, axis=-1))


def make_world(config: Config, distance: float) -> World:
    """Makes a simulation for `simulate`, with walls beyond a PoI in the middle of the arena.

    Args:
      config: all settings.
      distance: longest distance of a PoI from the sensor, in metres.
    """
    side = min(2 * (distance + config.arena.poi_extent + _ROOM), _MAX_SIDE)
    arena = dataclasses.replace(config.arena, side=max(config.arena.side, side))
    return worlds.make_world(dataclasses.replace(config, arena=arena))


def simulate(
    key: Key,
    world: World,
    modality: int,
    poi_class: Int[Array, ""],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> Float[Array, "window *channels"]:
    """Simulates a look like a recorded one: at a lone PoI in the middle of the arena.

    Args:
      key: random key of light, yaw, error of the bearing and noise.
      world: the simulation.
      modality: index of the sensor; static.
      poi_class: index of the PoI's class.
      bearing: believed bearing of the PoI, in radians.
      distance: distance of its centre, in metres; less than to the walls.

    Returns:
      The readings of the rays that the detector reads.
    """
    layout_key, light_key, error_key, noise_key = jax.random.split(key, 4)
    config, limit = world.arena.config, jnp.radians(world.viewpoint.bearing_error)
    layout = arenas.random_layout(layout_key, config, jnp.full(config.num_pois, poi_class))
    away = jnp.array(absence.outside(config))
    true = bearing - jax.random.uniform(error_key, minval=-limit, maxval=limit)
    centre = distance * jnp.stack([jnp.cos(true), jnp.sin(true)])
    positions = jnp.tile(away, (config.num_pois, 1)).at[0].set(centre)
    poses = jnp.zeros((len(world.sensors), 3)).at[:, :2].set(away).at[modality, :2].set(0.0)
    layout = dataclasses.replace(layout, position=positions)
    scene = Scene(layout, random_light(light_key, world.reads_conditions), poses)
    data = arenas.place(world.arena, layout, poses)
    return worlds.scan_around(noise_key, world, scene, data, modality, bearing, modality)


def nearest(
    key: Key,
    world: World,
    modality: int,
    window: Float[Array, " F"],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> Similar:
    """Finds the nearest of many simulated windows of a lone PoI of any class, light and yaw.

    Only rays that hit a PoI of any shape count, so the background does not matter.

    Args:
      key: random key.
      world: from `make_world`.
      modality: index of the sensor; static.
      window: `[F]` recorded input of the detector.
      bearing: believed bearing of the PoI, in radians.
      distance: distance of its centre, in metres.
    """
    sensor, arena = world.sensors[modality], world.arena.config

    def simulated(key: jax.Array, poi_class: jax.Array) -> jax.Array:
        readings = simulate(key, world, modality, poi_class, bearing, distance)
        return windows.as_window(sensor, readings)

    classes = jnp.arange(NUM_SIMULATED + 1) % len(arena.classes)
    other, *_ = many = jax.vmap(simulated)(jax.random.split(key, NUM_SIMULATED + 1), classes)
    # The rays that hit a PoI of any shape, wherever within the error of its bearing it is.
    half_width = jnp.arcsin(jnp.minimum(arena.poi_half_width / distance, 1.0))
    off = jnp.abs(windows.window_of(sensor, sensor.angles, bearing) - bearing)
    limit = jnp.maximum(half_width - jnp.radians(world.viewpoint.bearing_error), off.min())
    is_at_poi = jnp.repeat(off <= limit, sensor.channels)

    def nearest_to(one: jax.Array) -> tuple[jax.Array, jax.Array]:
        residuals = jnp.where(is_at_poi[None], one[None] - many[1:], jnp.nan)
        chosen = jnp.argmin(root_mean_square(residuals))
        return many[1 + chosen], residuals[chosen]

    (found, recorded), (_, usual) = nearest_to(window), nearest_to(other)
    return Similar(found, recorded, usual)
