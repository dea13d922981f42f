"""Recorded scans through a trained run: detect, encode, fuse, and read the map.

    python -m jaxsense.train --preset smoke --out runs/smoke
    python examples/recorded_scans.py runs/smoke recorded.npz

A run with sensors of your own needs `--trust` at the end, for their functions are imported.

Where there is no such file yet, looks at a PoI of each class are simulated and written to it. Yours
can come from anywhere. It holds for C PoIs

    places      [C, 2]       where they stand, in metres
    NAME_poses  [C, 3]       from where the sensor NAME looked: x, y in metres and yaw in radians
    NAME_scans  [C, B, ...]  what all its B rays read
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxsense
from jaxsense import sim, vae


def main(run: Path, recording: Path, trust: bool = False) -> None:
    """Reads the run and the recording, and tells what the map makes of it."""
    config, models = jaxsense.load(run, trust)
    if not recording.exists():
        np.savez(recording, **simulate(config))
    recorded = np.load(recording)

    sensors, model = sim.sensors.make(config), jaxsense.make_jmvae(config)
    for n, place in enumerate(recorded["places"]):
        print(f"PoI {n + 1}")
        entry = vae.unseen(model, config.mdp.unseen_variance)
        seen = np.zeros(len(sensors), bool)
        for m, sensor in enumerate(sensors):
            # The part of the scan around the PoI, and what the detector makes of it.
            bearing = sim.bearing(recorded[f"{sensor.name}_poses"][n], place)
            window = sim.cut_out(sensor, recorded[f"{sensor.name}_scans"][n], bearing)
            features = vae.detect(models.detectors[m], window)

            # What it tells alone, and together with what the others have written before.
            look = tuple(features if i == m else None for i in range(len(sensors)))
            mean, log_var = vae.encode(models.jmvae, model, look)
            std = jnp.exp(0.5 * log_var)
            entry = vae.fuse(models.jmvae, model, entry, seen, look)
            seen[m] = True

            told = zip(config.labels(sensor.name), features, strict=True)
            print(f"  {sensor.name}:", ", ".join(f"{label} {share:.2f}" for label, share in told))
            print(f"    alone:   mean {np.asarray(mean)}, sigma {np.asarray(std)}")
            print(f"    in map:  mean {np.asarray(entry.mean)}, sigma {np.asarray(entry.std)}")
        nearest = vae.nearest_class(entry, models.class_beliefs.mean)
        print(f"  The map says: {config.arena.classes[nearest]}")


def simulate(config: jaxsense.Config) -> dict[str, np.ndarray]:
    """What a recording of one PoI of each class would hold."""
    world = sim.make_world(config)

    @jax.jit
    @jax.vmap
    def record(key: jax.Array, poi_class: jax.Array) -> dict[str, jax.Array]:
        scene_key, *keys = jax.random.split(key, 1 + len(world.sensors))
        classes = jnp.full(config.arena.num_pois, poi_class)
        scene = sim.random_scene(scene_key, world, classes)
        found = {"places": scene.layout.position[0]}
        for robot, sensor in enumerate(world.sensors):
            look_key, noise_key = jax.random.split(keys[robot])
            _, scene = sim.look(look_key, world, scene, robot, jnp.int32(0))  # goes there
            data = sim.place(world.arena, scene.layout, scene.poses)
            at = world.arena, data, scene.layout, scene.light, robot
            rays = jnp.array(sensor.directions)
            found[f"{sensor.name}_scans"] = sim.scan(noise_key, sensor, *at, rays)
            found[f"{sensor.name}_poses"] = scene.poses[robot]
        return found

    number = len(config.arena.classes)
    found = record(jax.random.split(jax.random.key(0), number), jnp.arange(number))
    return {name: np.asarray(values) for name, values in found.items()}


if __name__ == "__main__":
    np.set_printoptions(precision=2, suppress=True)
    main(Path(sys.argv[1]), Path(sys.argv[2]), trust="--trust" in sys.argv[3:])
