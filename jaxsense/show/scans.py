"""Compares recorded looks with simulated ones, see `compare_scans`."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.run import files, recordings
from jaxsense.run.recordings import RecordedLooks
from jaxsense.run.rundir import load
from jaxsense.show.pairs import Pairs
from jaxsense.sim import similar, windows
from jaxsense.sim.similar import Similar


@dataclasses.dataclass(frozen=True)
class Apart:
    """How far recorded windows of one sensor are from simulated ones.

    Attributes:
      recorded: median distance from a recorded window to the nearest simulated one, in the unit of
        the readings, a root mean square over the rays at the PoI.
      simulated: the same from another simulated window in place of the recorded one.
      looks: how many looks these are; others were not recorded as far as their window reaches.
    """

    recorded: float
    simulated: float
    looks: int


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Recorded looks compared with simulated ones.

    Attributes:
      of_sensors: of each recorded sensor; print the comparison to read it.
      picture: file with recorded windows above the nearest simulated ones.
      residuals: file with the distributions of their differences.
    """

    of_sensors: Mapping[str, Apart]
    picture: Path
    residuals: Path

    def __str__(self) -> str:
        """One line for each sensor."""
        return "\n".join(
            f"{name}: {apart.looks} recorded windows are {apart.recorded:.4f} from the nearest of "
            f"{similar.NUM_SIMULATED} simulated ones; simulated ones are {apart.simulated:.4f} away"
            for name, apart in self.of_sensors.items()
        )


def compare_scans(
    run: Path | str, file: Path | str, picture: Path | str | None = None, trust: bool = False
) -> Comparison:
    """Plots recorded windows next to simulated ones, and reports how far apart they are.

    Every recorded look is compared with simulated ones at the same bearing and distance, see
    `sim.similar.nearest`.

    Args:
      run: directory of a finished run.
      file: a recording, see `run.recordings.read`.
      picture: SVG or PNG file to write, by its ending; by default an SVG file named after `file`.
        The residuals are drawn in another one next to it, whose name ends in `.residuals.svg`
        or `.residuals.png`.
      trust: whether the run may import its custom sensors, see `load`.

    Raises:
      FileExistsError: if a picture exists.
      OSError: if a file cannot be read or written.
      ValueError: if the directory is not a finished run, or the recording does not fit its sensors.
    """
    from jaxsense.show import drawing, scan_plots  # noqa: PLC0415 (matplotlib takes long to import)

    config, _ = load(run, trust)
    looks = recordings.read(config, file)
    path = Path(f"{os.fspath(file)}.svg" if picture is None else picture)
    found = {
        name: _compare(config, m, looks)
        for m, name in enumerate(config.modalities)
        if name in looks.scans
    }
    pairs = [each for _, each in found.values()]
    beside = path.with_suffix(f".residuals{path.suffix}")
    with files.new(path) as drawn, files.new(beside) as residuals:
        drawn.write(drawing.encoded(scan_plots.windows(pairs), path))
        residuals.write(drawing.encoded(scan_plots.residuals(pairs), beside))
    return Comparison({name: apart for name, (apart, _) in found.items()}, path, beside)


def _compare(config: Config, modality: int, looks: RecordedLooks) -> tuple[Apart, Pairs]:
    """Compares the looks of one sensor."""
    name = config.modalities[modality]
    bearings, distances = looks.seen_from(name)
    world = similar.make_world(config, float(np.max(distances, initial=0.0)))
    sensor = world.sensors[modality]

    @jax.jit
    def window(scan: jax.Array, bearing: jax.Array) -> jax.Array:
        return windows.as_window(sensor, windows.around(sensor, scan, bearing))

    of_looks = zip(looks.scans[name], bearings, strict=True)
    cut = np.stack([np.asarray(window(scan, bearing)) for scan, bearing in of_looks])
    is_in_view = (bearings >= sensor.angles.min()) & (bearings <= sensor.angles.max())
    is_whole = np.isfinite(cut).all(axis=1) & is_in_view
    if not is_whole.any():
        raise ValueError(f"{name}_scans: no window around a PoI was recorded completely")
    cut, bearings, distances = cut[is_whole], bearings[is_whole], distances[is_whole]

    @jax.jit
    def nearest(key: jax.Array, *look: jax.Array) -> Similar:
        return similar.nearest(key, world, modality, *look)

    keys = jax.random.split(jax.random.key(0), len(cut))
    each = [nearest(*look) for look in zip(keys, cut, bearings, distances, strict=True)]
    found = jax.tree.map(lambda *x: np.stack(x), *each)
    recorded, simulated = (
        float(np.median(similar.root_mean_square(x))) for x in (found.recorded, found.simulated)
    )
    pairs = Pairs(
        sensor=sensor,
        recorded=cut,
        simulated=np.asarray(found.window),
        residuals=np.asarray(found.recorded),
        usual=np.asarray(found.simulated),
        distances=distances,
    )
    return Apart(recorded, simulated, len(cut)), pairs
