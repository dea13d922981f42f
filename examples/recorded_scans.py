"""Recorded scans through a trained run: detect, fuse, and read the map.

    python -m jaxsense.train --preset smoke --out runs/smoke
    python examples/recorded_scans.py runs/smoke recorded.npz --simulate
    python examples/recorded_scans.py runs/smoke recorded.npz

The second line writes a recording of simulated looks at a PoI of each class, the third reads it.
Your own recording can come from anywhere. It must hold, for C PoIs:

    places      [C, 2]       their positions, in metres
    NAME_poses  [C, 3]       from where the sensor NAME looked: x, y in metres and yaw in radians
    NAME_scans  [C, B, ...]  what all its B rays read: metres, or linear RGB from 0 to 1
    NAME_angles [B]          their directions in radians, if they are not those of the run

A sensor may be missing. Scans along other rays are resampled. A run with custom sensors needs
`--trust`, because their functions are imported.
"""

import argparse
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxsense
from jaxsense import recorded, sim
from jaxsense.config.mission import Search
from jaxsense.recorded import RecordedLooks


def read(config: jaxsense.Config, models: jaxsense.Models, looks: RecordedLooks) -> None:
    """Prints what the map makes of recorded looks."""
    fusion, sensors = models.fusion, sim.make_world(config).sensors
    views = {name: looks.seen_from(name) for name in looks.scans}
    for n in range(len(looks.positions)):
        print(f"PoI {n + 1}")
        belief, seen = fusion.prior, np.zeros(len(sensors), bool)
        for m, sensor in enumerate(sensors):
            if sensor.name not in views:
                continue
            # What the look says of the PoI, which may be that there is nothing.
            bearing, distance = (jnp.float32(values[n]) for values in views[sensor.name])
            scan = looks.scans[sensor.name][n]
            search = Search(*config.mission.localisation.search)
            detection = models.detect(m, sensor, scan, bearing, distance, search)
            if not detection.is_known:
                where = f"{distance:.2f} m away at {np.degrees(bearing):.0f} degrees"
                print(f"  {sensor.name}: outside of what was recorded or learned, {where}")
                continue
            if not detection.is_there:
                print(f"  {sensor.name}: nothing there")
                continue
            features = detection.features
            # Missions keep such a look off the map.
            if features.max() < config.mission.least_confidence:
                print(f"  {sensor.name}: uncertain, {features.max():.2f} at most")
                continue

            # What it says alone, and with the looks of other sensors before it.
            alone = fusion.together({m: features})
            belief = fusion.update(belief, seen, features, m)
            seen[m] = True

            told = zip(config.labels(sensor.name), features, strict=True)
            print(f"  {sensor.name}:", ", ".join(f"{label} {share:.2f}" for label, share in told))
            print(f"    alone:   mean {np.asarray(alone.mean)}, sigma {np.asarray(alone.std)}")
            print(f"    in map:  mean {np.asarray(belief.mean)}, sigma {np.asarray(belief.std)}")
        classes = zip(config.arena.classes, fusion.class_probabilities(belief), strict=True)
        told = ", ".join(f"{name} {share:.2f}" for name, share in classes if share > 0.01)
        print(f"  The map says: {told if seen.any() else 'unseen'}")


def simulate(config: jaxsense.Config) -> dict[str, np.ndarray]:
    """Simulates a recording of one PoI of each class."""
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
            found[f"{sensor.name}_scans"] = sim.scan(
                noise_key,
                sensor,
                world.arena,
                data,
                scene.layout,
                scene.light,
                robot,
                directions=jnp.array(sensor.directions),
            )
            found[f"{sensor.name}_poses"] = scene.poses[robot]
        return found

    number = len(config.arena.classes)
    found = record(jax.random.split(jax.random.key(0), number), jnp.arange(number))
    return {name: np.asarray(values) for name, values in found.items()}


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="directory of a run, `latest`, or pretrained:PRESET")
    parser.add_argument("recording", type=Path, help="file of NumPy's format .npz")
    parser.add_argument("--simulate", action="store_true", help="write a new recording, and stop")
    parser.add_argument("--trust", action="store_true", help="import the run's own sensors")
    arguments = parser.parse_args(argv)
    np.set_printoptions(precision=2, suppress=True)
    try:
        config, models = jaxsense.load(arguments.run, arguments.trust)
        if arguments.simulate:
            found = simulate(config)
            # Opened here, so that NumPy appends no ending; "x": never over another file.
            with arguments.recording.open("xb") as file:
                np.savez(file, **found)
            return
        read(config, models, recorded.read(config, arguments.recording))
    except (OSError, ValueError) as error:
        sys.exit(f"recorded_scans: {error}")


if __name__ == "__main__":
    main()
