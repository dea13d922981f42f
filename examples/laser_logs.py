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
import numpy as np

import jaxsense
from jaxsense import sim
from jaxsense.interfaces import rawlog


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="directory of a run, for the sizes of PoIs")
    parser.add_argument("recording", type=Path, help="new file of NumPy's format .npz")
    parser.add_argument("--logs", type=Path, default=rawlog.DIRECTORY, help="directory of the logs")
    parser.add_argument("--trust", action="store_true", help="import the run's own sensors")
    arguments = parser.parse_args(argv)
    try:
        config, _ = jaxsense.load(arguments.run, arguments.trust)
        scans = rawlog.read_logs(arguments.logs)
        errors = sim.recorded.errors(config, scans.angles, scans.ranges)

        @jax.jit
        @jax.vmap
        def insert(key: jax.Array, ranges: jax.Array) -> sim.recorded.Inserted:
            return sim.recorded.insert(key, config, scans.angles, ranges, errors)

        found = insert(jax.random.split(jax.random.key(0), len(scans.ranges)), scans.ranges)
        found = jax.tree.map(lambda x: np.asarray(x)[found.is_visible], found)
        directions = np.stack([np.cos(found.bearing), np.sin(found.bearing)], axis=-1)
        with arguments.recording.open("xb") as file:  # never over another file
            np.savez(
                file,
                places=found.distance[:, None] * directions,
                lidar_poses=np.zeros((len(found.distance), 3)),
                lidar_scans=found.ranges,
                lidar_angles=scans.angles,
            )
    except (OSError, ValueError) as error:
        sys.exit(f"laser_logs: {error}")


if __name__ == "__main__":
    main()
