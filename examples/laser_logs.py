"""Real laser scans with points of interest cast into them, as a recording.

    apt-get install mrpt-common
    python -m jaxsense.train --preset smoke --out runs/smoke
    python examples/laser_logs.py runs/smoke scans.npz
    python examples/recorded_scans.py runs/smoke scans.npz
    python -c "import jaxsense; print(jaxsense.compare_scans('runs/smoke', 'scans.npz'))"

The scans are those of 361 beams over 180 degrees in four logs that Debian installs. Each point of
interest (PoI) is a cylinder or a cube in an open part of one scan. Its beams have the errors of
beams at straight walls in the same logs.
"""

import argparse
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxsense
from jaxsense import sim
from jaxsense.interfaces import rawlog

DIRECTORY = Path("/usr/share/mrpt/datasets")
"""Where Debian's package `mrpt-common` installs logs."""
LOGS = (
    "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog",
    "localization_demo.rawlog",
    "uwb_ro-localization_demo.rawlog",
    "malaga-cs-fac-building.simplemap.gz",
)
"""Those with scans of a real scanner; `graphslam-engine-demos` holds simulated ones."""


def read_logs(directory: Path = DIRECTORY) -> list[rawlog.LaserScans]:
    """Reads the real scans of each log."""
    return [rawlog.read(directory / name) for name in LOGS]


def insert_pois(
    key: jax.Array,
    config: jaxsense.Config,
    scans: rawlog.LaserScans,
    residuals: np.ndarray,
    mixed_pixels: float,
) -> sim.recorded.Inserted:
    """Puts a PoI into each scan; returns those that have room for it."""
    lidar, angles = config.lidar, jnp.asarray(scans.angles)
    # All of the window must have been recorded.
    margin = np.radians(lidar.field_of_view * (lidar.window / 2 + 1) / (lidar.num_beams - 1))

    @jax.jit
    @jax.vmap
    def insert(key: jax.Array, ranges: jax.Array) -> sim.recorded.Inserted:
        return sim.recorded.insert(
            key,
            config.arena,
            config.viewpoint,
            angles,
            ranges,
            jnp.asarray(residuals),
            mixed_pixels=mixed_pixels,
            margin=margin * lidar.stride,
        )

    found = insert(jax.random.split(key, len(scans.ranges)), jnp.asarray(scans.ranges))
    return jax.tree.map(lambda x: np.asarray(x)[np.asarray(found.is_visible)], found)


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="directory of a run, for the sizes of PoIs")
    parser.add_argument("recording", type=Path, help="new file of NumPy's format .npz")
    parser.add_argument("--logs", type=Path, default=DIRECTORY, help="directory of the logs")
    arguments = parser.parse_args(argv)
    try:
        config, _ = jaxsense.load(arguments.run)
        logs = read_logs(arguments.logs)
        angles, ranges = logs[0].angles, np.concatenate([log.ranges for log in logs])
        residuals, distances = sim.recorded.wall_residuals(angles, ranges)
        near = residuals[distances < 2 * config.viewpoint.max_distance]
        mixed_pixels = sim.recorded.fit_noise(config.lidar, angles, ranges).mixed_pixels
        scans = rawlog.LaserScans(angles, ranges)
        found = insert_pois(jax.random.key(0), config, scans, near, mixed_pixels)
        directions = np.stack([np.cos(found.bearing), np.sin(found.bearing)], axis=-1)
        with arguments.recording.open("xb") as file:  # never over another file
            np.savez(
                file,
                places=found.distance[:, None] * directions,
                lidar_poses=np.zeros((len(found.distance), 3)),
                lidar_scans=found.ranges,
                lidar_angles=angles,
            )
    except (OSError, ValueError) as error:
        sys.exit(f"laser_logs: {error}")


if __name__ == "__main__":
    main()
