"""Recorded looks next to the simulated ones that are most similar."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.recorded.reading import RecordedLooks
from jaxsense.sim import arena as arenas
from jaxsense.sim import viewpoints, windows
from jaxsense.sim import world as worlds
from jaxsense.sim.light import random_light
from jaxsense.sim.world import Scene, World

NUM_SIMULATED = 96
"""Simulated windows to find the nearest of."""
_ROOM = 0.5  # m, behind a PoI
_MAX_SIDE = 100.0  # m


@dataclasses.dataclass(frozen=True)
class Compared:
    """Recorded windows of one sensor, and for each the nearest simulated one.

    Residuals are in the unit of the readings, NaN on rays that hit no PoI.

    Attributes:
      recorded: inputs of the detector, of looks whose window was recorded completely.
      simulated: the nearest simulated ones.
      residuals: recorded minus simulated.
      usual: residuals of other simulated windows in place of the recorded ones.
    """

    recorded: Float[np.ndarray, "L F"]
    simulated: Float[np.ndarray, "L F"]
    residuals: Float[np.ndarray, "L F"]
    usual: Float[np.ndarray, "L F"]

    def __str__(self) -> str:
        """How far apart they are: medians of root mean squares over the rays at the PoI."""
        recorded, usual = (np.median(root_mean_square(x)) for x in (self.residuals, self.usual))
        return (
            f"{len(self.recorded)} recorded windows are {recorded:.4f} from the nearest of "
            f"{NUM_SIMULATED} simulated ones, with a median residual of "
            f"{np.nanmedian(self.residuals):+.4f}; simulated ones are {usual:.4f} away"
        )


@checks.typed
def compare(config: Config, looks: RecordedLooks) -> dict[str, Compared]:
    """Compares recorded looks with simulated ones at the same bearing and distance.

    Returns:
      What was found of each recorded sensor; print it.

    Raises:
      ValueError: if no window of a sensor was recorded completely.
    """
    return {name: _compared(config, config.modalities.index(name), looks) for name in looks.scans}


def _compared(config: Config, modality: int, looks: RecordedLooks) -> Compared:
    name = config.modalities[modality]
    bearings, distances = looks.seen_from(name)
    world = make_world(config, float(np.max(distances, initial=0.0)))
    sensor = world.sensors[modality]
    of_looks = zip(looks.scans[name], bearings, strict=True)
    cut = [windows.as_window(sensor, windows.around(sensor, *look)) for look in of_looks]
    cut = np.array(cut).reshape(len(cut), -1)
    is_whole = (bearings >= sensor.angles.min()) & (bearings <= sensor.angles.max())
    is_whole &= np.isfinite(cut).all(axis=1)
    if not is_whole.any():
        raise ValueError(f"{name}_scans: no window around a PoI was recorded completely")
    compare = jax.jit(nearest, static_argnums=2)
    cut, bearings, distances = cut[is_whole], bearings[is_whole], distances[is_whole]
    keys = jax.random.split(jax.random.key(0), len(cut))
    of_looks = zip(keys, cut, bearings, distances, strict=True)
    found = [compare(key, world, modality, *look) for key, *look in of_looks]
    return Compared(cut, *map(np.stack, zip(*found, strict=True)))


def root_mean_square(residuals: Float[Array | np.ndarray, "*S F"]) -> Float[Array, "*S"]:
    """Root mean square of the residuals of each window, without NaN."""
    return jnp.sqrt(jnp.nanmean(residuals**2, axis=-1))


def make_world(config: Config, distance: float) -> World:
    """Makes a simulation whose walls lie beyond a PoI at `distance`, in metres, from the middle."""
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
) -> Float[Array, "F"]:
    """Simulates a window like a recorded one: of a lone PoI, seen from the middle of the arena.

    Args:
      key: random key of light, yaw, error of the bearing and noise.
      bearing: believed bearing of the PoI, in radians.
      distance: distance of its centre, in metres; less than to the walls.
    """
    layout_key, light_key, error_key, noise_key = jax.random.split(key, 4)
    config, limit = world.arena.config, jnp.radians(world.viewpoint.bearing_error)
    layout = arenas.random_layout(layout_key, config, jnp.full(config.num_pois, poi_class))
    away = jnp.array(viewpoints.outside(config))
    true = bearing - jax.random.uniform(error_key, minval=-limit, maxval=limit)
    centre = distance * jnp.stack([jnp.cos(true), jnp.sin(true)])
    positions = jnp.tile(away, (config.num_pois, 1)).at[0].set(centre)
    poses = jnp.zeros((len(world.sensors), 3)).at[:, :2].set(away).at[modality, :2].set(0.0)
    layout = dataclasses.replace(layout, position=positions)
    scene = Scene(layout, random_light(light_key, world.reads_conditions), poses)
    data = arenas.place(world.arena, layout, poses)
    return worlds.window_around(noise_key, world, scene, data, modality, bearing)


def nearest(
    key: Key,
    world: World,
    modality: int,
    window: Float[Array, " F"],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> tuple[Float[Array, " F"], Float[Array, " F"], Float[Array, " F"]]:
    """Finds the nearest of many simulated windows of a lone PoI of any class, light and yaw.

    Only rays that hit a PoI of any shape count, so the background does not matter. The other
    arguments are those of `simulate`.

    Returns:
      The window and its residuals, and the usual ones, see `Compared`.
    """
    sensor, arena = world.sensors[modality], world.arena.config
    classes = jnp.arange(NUM_SIMULATED + 1) % len(arena.classes)
    simulated = jax.vmap(lambda *x: simulate(x[0], world, modality, x[1], bearing, distance))
    other, *_ = many = simulated(jax.random.split(key, NUM_SIMULATED + 1), classes)
    # The rays that hit a PoI of any shape, wherever within the error of its bearing it is.
    half_width = jnp.arcsin(jnp.minimum(arena.poi_half_width / distance, 1.0))
    off = jnp.abs(windows.around(sensor, sensor.angles, bearing) - bearing)
    limit = jnp.maximum(half_width - jnp.radians(world.viewpoint.bearing_error), off.min())
    is_at_poi = jnp.repeat(off <= limit, sensor.channels)

    def nearest_to(one: jax.Array) -> tuple[jax.Array, jax.Array]:
        residuals = jnp.where(is_at_poi[None], one[None] - many[1:], jnp.nan)
        chosen = jnp.argmin(root_mean_square(residuals))
        return many[1 + chosen], residuals[chosen]

    (found, residuals), (_, usual) = nearest_to(window), nearest_to(other)
    return found, residuals, usual
