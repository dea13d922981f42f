"""Recorded looks next to the simulated ones that are most similar."""

import dataclasses
import os
from collections.abc import Collection, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from matplotlib.figure import Figure

from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.recorded.reading import RecordedLooks, read
from jaxsense.run import files
from jaxsense.run.rundir import load
from jaxsense.show import drawing
from jaxsense.show.colours import as_srgb, series
from jaxsense.sim import absence, windows
from jaxsense.sim import arena as arenas
from jaxsense.sim import world as worlds
from jaxsense.sim.light import random_light
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene, World

NUM_SIMULATED = 96
"""Simulated windows to find the nearest of."""
_ROOM = 0.5  # m, behind a PoI
_MAX_SIDE = 100.0  # m
_COLUMNS = 6  # looks side by side


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Recorded windows of one sensor, and for each the nearest simulated one.

    Residuals are NaN on rays that hit no PoI.

    Attributes:
      sensor: the sensor.
      recorded: inputs of its detector, of looks whose window was recorded completely.
      simulated: the nearest simulated ones.
      residuals: recorded minus simulated, in the unit of the readings.
      usual: residuals of other simulated windows in place of the recorded ones.
      distances: of the PoIs, in metres.
    """

    sensor: Sensor
    recorded: Float[np.ndarray, "L F"]
    simulated: Float[np.ndarray, "L F"]
    residuals: Float[np.ndarray, "L F"]
    usual: Float[np.ndarray, "L F"]
    distances: Float[np.ndarray, " L"]

    @property
    def apart(self) -> tuple[float, float]:
        """Median root mean square of `residuals`, and of `usual`."""
        recorded, usual = (
            np.median(root_mean_square(x)).item() for x in (self.residuals, self.usual)
        )
        return recorded, usual


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Recorded looks compared with simulated ones.

    Attributes:
      of_sensors: of each recorded sensor; print the comparison to read it.
      picture: file with recorded windows above the nearest simulated ones.
    """

    of_sensors: Mapping[str, Pairs]
    picture: Path

    def __str__(self) -> str:
        """One line for each sensor."""
        return "\n".join(
            f"{name}: {len(pairs.recorded)} recorded windows are {pairs.apart[0]:.4f} from the "
            f"nearest of {NUM_SIMULATED} simulated ones (median residual "
            f"{np.nanmedian(pairs.residuals):+.4f}); simulated ones are {pairs.apart[1]:.4f} away"
            for name, pairs in self.of_sensors.items()
        )


def compare_scans(
    run: Path | str, file: Path | str, picture: Path | str | None = None, trust: bool = False
) -> Comparison:
    """Plots recorded windows next to simulated ones, and reports how far apart they are.

    Every recorded look is compared with simulated ones at the same bearing and distance.

    Args:
      run: directory of a finished run.
      file: a recording, see `recorded.read`.
      picture: SVG or PNG file to write, by its ending; by default an SVG file named after `file`.
      trust: whether the run may import its custom sensors, see `load`.

    Raises:
      FileExistsError: if the picture exists.
      OSError: if a file cannot be read or written.
      ValueError: if the directory is not a finished run, or the recording does not fit its sensors.
    """
    config, _ = load(run, trust)
    looks = read(config, file)
    path = Path(f"{os.fspath(file)}.svg" if picture is None else picture)
    found = {name: _compare(config, config.modalities.index(name), looks) for name in looks.scans}
    with files.new(path) as written:
        written.write(drawing.encoded(_drawn(found.values()), path))
    return Comparison(found, path)


def _compare(config: Config, modality: int, looks: RecordedLooks) -> Pairs:
    name = config.modalities[modality]
    bearings, distances = looks.seen_from(name)
    world = make_world(config, float(np.max(distances, initial=0.0)))
    sensor = world.sensors[modality]
    of_looks = zip(looks.scans[name], bearings, strict=True)
    cut = [windows.as_window(sensor, windows.around(sensor, *look)) for look in of_looks]
    cut = np.array(cut).reshape(len(cut), -1)
    is_in_view = (bearings >= sensor.angles.min()) & (bearings <= sensor.angles.max())
    is_whole = np.isfinite(cut).all(axis=1) & is_in_view
    if not is_whole.any():
        raise ValueError(f"{name}_scans: no window around a PoI was recorded completely")
    cut, bearings, distances = cut[is_whole], bearings[is_whole], distances[is_whole]
    compare = jax.jit(nearest, static_argnums=2)
    keys = jax.random.split(jax.random.key(0), len(cut))
    of_looks = zip(keys, cut, bearings, distances, strict=True)
    found = [compare(key, world, modality, *look) for key, *look in of_looks]
    simulated, residuals, usual = (np.stack(x) for x in zip(*found, strict=True))
    return Pairs(sensor, cut, simulated, residuals, usual, distances)


def _drawn(of_sensors: Collection[Pairs]) -> Figure:
    """Recorded windows above simulated ones, of evenly chosen looks by each sensor."""
    heights = [0.8 if x.sensor.channels == 3 else 2.0 for x in of_sensors for _ in range(2)]
    figure = Figure(figsize=(2.4 * _COLUMNS, sum(heights) + 1.0), layout="constrained")
    axes = figure.subplots(len(heights), _COLUMNS, squeeze=False, height_ratios=heights)
    for ax in axes.flat:
        ax.set_axis_off()
    for i, pairs in enumerate(of_sensors):
        number = min(_COLUMNS, len(pairs.recorded))
        chosen = np.linspace(0, len(pairs.recorded) - 1, number).astype(int)
        for kind, readings in enumerate((pairs.recorded, pairs.simulated)):
            row, shown = axes[2 * i + kind], pairs.sensor.from_left(readings[chosen])
            row[0].set_ylabel(("recorded", "simulated")[kind])
            for ax, values, distance in zip(row, shown, pairs.distances[chosen], strict=False):
                ax.set_axis_on()
                if kind == 0:
                    ax.set_title(f"{pairs.sensor.name} at {distance:.2f} m", fontsize=9)
                if pairs.sensor.channels == 3:  # an image
                    ax.imshow(as_srgb(values)[None], aspect="auto", interpolation="nearest")
                    ax.set(yticks=[], xticks=[])
                else:
                    ax.plot(values, ".", color=series(kind)["color"], markersize=2)
                    ax.set_ylim(0, 1.05 * max(readings.max(), 1e-6))
    return figure


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
      world: the simulation.
      modality: index of the sensor; static.
      poi_class: index of the PoI's class.
      bearing: believed bearing of the PoI, in radians.
      distance: distance of its centre, in metres; less than to the walls.
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
    readings = worlds.scan_around(noise_key, world, scene, data, modality, bearing, modality)
    return windows.as_window(world.sensors[modality], readings)


def nearest(
    key: Key,
    world: World,
    modality: int,
    window: Float[Array, " F"],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> tuple[Float[Array, " F"], Float[Array, " F"], Float[Array, " F"]]:
    """Finds the nearest of many simulated windows of a lone PoI of any class, light and yaw.

    Only rays that hit a PoI of any shape count, so the background does not matter.

    Args:
      key: random key.
      world: from `make_world`.
      modality: index of the sensor; static.
      window: recorded input of the detector.
      bearing: believed bearing of the PoI, in radians.
      distance: distance of its centre, in metres.

    Returns:
      The window and its residuals, and those of another simulated window in place of the recorded
      one, see `Pairs`.
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
