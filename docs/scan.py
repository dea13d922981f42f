"""Draws `figures/scan.svg`, a whole scan by each sensor and its window.

python docs/scan.py [FILE]
"""

import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxsense
from jaxsense.show import drawing
from jaxsense.show.colours import SOFT, as_srgb, modality_colour
from jaxsense.sim import arena, sensors, windows, world

PICTURE = Path(__file__).parent / "figures" / "scan.svg"
SEED, POI = 11, 0
CLASSES = np.array([2, 0, 1])  # the PoI in the window is a red cube


def draw() -> Figure:
    """The scans, from left to right over the bearing, with the window around one PoI marked."""
    simulated = world.make_world(jaxsense.PRESETS["default"])
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.subplots(len(simulated.sensors), 1, height_ratios=(1, 3))
    for modality, (sensor, ax) in enumerate(zip(simulated.sensors, axes, strict=True)):
        readings, bearing = _scan(simulated, modality)
        angles = np.degrees(sensor.angles)
        if sensor.channels == 3:
            edges = angles[0], angles[-1], 0, 1
            ax.imshow(as_srgb(readings)[None], aspect="auto", extent=edges)
            ax.set_yticks([])
        else:
            ax.plot(angles, readings, ".", markersize=2, color=SOFT)
            ax.set(ylabel="distance [m]", ylim=(0, 1.05 * readings.max()))
        seen = np.degrees(windows.around(sensor, sensor.angles, bearing))
        colour = modality_colour(modality)
        ax.axvspan(seen.min(), seen.max(), facecolor="none", edgecolor=colour, linewidth=2)
        ax.axvline(np.degrees(bearing), color=colour, linestyle="--")
        ax.set_xlim(angles.max(), angles.min())
        ax.set_title(f"{sensor.name}: {len(angles)} rays, of which the detector reads {len(seen)}")
    axes[-1].set_xlabel("bearing in the robot's frame [degrees], positive to the left")
    return figure


def _scan(simulated: world.World, modality: int) -> tuple[np.ndarray, jax.Array]:
    """All readings of a robot that stands at a viewpoint of the PoI, and the PoI's bearing."""
    sensor = simulated.sensors[modality]

    @functools.partial(jax.jit, static_argnums=1)
    def scan(key: jax.Array, robot: int) -> tuple[jax.Array, jax.Array]:
        scene_key, look_key, noise_key = jax.random.split(key, 3)
        scene = world.random_scene(scene_key, simulated, CLASSES)
        _, scene = world.look(look_key, simulated, scene, robot, POI)
        data = arena.place(simulated.arena, scene.layout, scene.poses)
        readings = sensors.scan(
            noise_key,
            sensor,
            simulated.arena,
            data,
            scene.layout,
            scene.light,
            robot,
            sensor.directions,
        )
        x, y = scene.layout.position[POI] - scene.poses[robot, :2]
        ahead = jnp.arctan2(y, x) - scene.poses[robot, 2]
        return readings, (ahead + jnp.pi) % (2 * jnp.pi) - jnp.pi

    readings, bearing = scan(jax.random.key(SEED), modality)
    return np.asarray(readings), bearing


if __name__ == "__main__":
    (Path(sys.argv[1]) if sys.argv[1:] else PICTURE).write_bytes(drawing.svg(draw()))
