"""`python -m benchmarks.recorded RUN`: looks through the real laser scans of mrpt-common."""

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxsense
from benchmarks import studies
from benchmarks.measure import reserve
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.interfaces import rawlog
from jaxsense.run import cli
from jaxsense.sim import recorded, sensors, windows
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Classifier, Detector

PROGRAM = "benchmarks.recorded"
NOISE = ("range_noise", "range_noise_growth", "mixed_pixels", "dropout")
"""Settings of the LiDAR that are fitted to the scans."""
_VIEWS = 10  # of each scan
_LABELLED = 200  # windows to retrain with
_RETRAINED = 5  # times, each with other windows
_SEED = 31


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Counts looks through real laser scans that the gate accepts, and that are right."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    logs: Path = rawlog.DIRECTORY
    """Directory of the logs."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Shown:
    """Looks at PoIs in real scans.

    Attributes:
      scans: `[L, B]` readings of the run's beams, in metres.
      bearings: `[L]` in radians.
      distances: `[L]` in metres.
      labels: `[L]` true shapes.
      rows: `[L]` indices of the recorded scans.
    """

    scans: np.ndarray
    bearings: np.ndarray
    distances: np.ndarray
    labels: np.ndarray
    rows: np.ndarray


class Recorded:
    """The LiDAR of a run, and real scans along its beams.

    Attributes:
      config: settings of the run.
      models: its trained models.
      scans: the recorded scans.
      every: step between the recorded beams that are used.
      offset: error of all distances, in metres, as of a scanner that is mounted or calibrated
        differently.
    """

    def __init__(
        self,
        config: jaxsense.Config,
        models: jaxsense.Models,
        scans: rawlog.LaserScans,
        every: int = 1,
        offset: float = 0.0,
    ):
        self.config, self.models, self.scans = config, models, scans
        self.every, self.offset = every, offset
        self.modality = config.modalities.index("lidar")
        self.sensor = sensors.make(config)[self.modality]

        def detect(scan: jax.Array, bearing: jax.Array, distance: jax.Array) -> tuple:
            found = models.detect(self.modality, self.sensor, scan, bearing, distance)
            return found.is_there, jnp.argmax(found.features)

        self.detect = jax.jit(jax.vmap(detect))

    def resampled(self, ranges: np.ndarray) -> np.ndarray:
        """`[S, A]` recorded ranges along the run's beams, `[S, B]`."""
        angles = self.scans.angles[:: self.every]
        return recorded.resample(self.sensor, angles, ranges[:, :: self.every] + self.offset)

    def empty(self, key: jax.Array) -> dict[str, float]:
        """Shares of looks at nothing that pass the gate, by the expected distance."""
        keys = jax.random.split(key, (len(self.scans.ranges), _VIEWS))
        draw = jax.vmap(jax.vmap(lambda k: recorded.random_view(k, self.config, self.scans.angles)))
        bearings, distances = (np.asarray(x) for x in draw(keys))
        scans = np.repeat(self.resampled(self.scans.ranges), _VIEWS, axis=0)
        bearings = bearings.reshape(-1)
        # What is measured there, if a PoI may be there: its centre is behind its surface.
        ray = np.abs(self.sensor.angles[None] - bearings[:, None]).argmin(axis=1)
        there = scans[np.arange(len(scans)), ray] + self.config.arena.poi_half_width
        limits = self.config.viewpoint
        is_near = (there >= limits.min_distance) & (there <= limits.max_distance)
        of_random, _ = self.detect(scans, bearings, distances.reshape(-1))
        of_measured, _ = self.detect(scans[is_near], bearings[is_near], there[is_near])
        return {
            f"random distance, {len(scans):,} looks": float(np.mean(of_random)),
            f"at the measured distance, {int(is_near.sum()):,} looks": float(np.mean(of_measured)),
        }

    def shown(self, key: jax.Array, errors: recorded.Errors, rows: np.ndarray) -> Shown:
        """Looks at PoIs that are cast into some scans, `_VIEWS` times into each."""
        rows = np.repeat(rows, _VIEWS)

        def insert(key: jax.Array, ranges: jax.Array) -> recorded.Inserted:
            return recorded.insert(key, self.config, self.scans.angles, ranges, errors)

        keys = jax.random.split(key, len(rows))
        found = jax.jit(jax.vmap(insert))(keys, self.scans.ranges[rows])
        kept = np.asarray(found.is_visible)
        found = jax.tree.map(lambda x: np.asarray(x)[kept], found)
        scans = self.resampled(found.ranges)
        return Shown(scans, found.bearing, found.distance, found.label, rows[kept])

    def windows(self, looks: Shown) -> jax.Array:
        """Inputs of the detector, `[L, F]`."""

        def cut(scan: jax.Array, bearing: jax.Array) -> jax.Array:
            return windows.as_window(self.sensor, windows.around(self.sensor, scan, bearing))

        return jax.jit(jax.vmap(cut))(looks.scans, looks.bearings)

    def right(self, detector: Detector, looks: Shown) -> float:
        """Share of looks whose shape a detector finds, without the gate."""
        of_window = jax.vmap(detector.features)
        found = np.argmax(of_window(self.windows(looks)), axis=1)
        return float(np.mean(found == looks.labels))

    def retrained(self, key: jax.Array, errors: recorded.Errors) -> dict[str, float]:
        """Shares of right shapes as trained and after retraining, means of several.

        Half of the scans give the windows to train with, the other half those to measure with. An
        encoder that has learned without labels is not retrained with labels.
        """
        before, after = [], []
        detector, number = self.models.detectors[self.modality], len(self.scans.ranges)
        for each in jax.random.split(key, _RETRAINED):
            order_key, train_key, test_key, choice_key, fit_key = jax.random.split(each, 5)
            order = np.asarray(jax.random.permutation(order_key, number))
            train = self.shown(train_key, errors, order[: number // 2])
            test = self.shown(test_key, errors, order[number // 2 :])
            before.append(self.right(detector, test))
            if isinstance(detector, Classifier):
                chosen = jax.random.permutation(choice_key, len(train.labels))[:_LABELLED]
                given = self.windows(train)[chosen], jnp.asarray(train.labels)[chosen]
                other = jax.jit(detectors.retrain)(fit_key, detector, *given)
                after.append(self.right(other, test))
        found = {"shape right": before, "after retraining": after}
        return {name: float(np.mean(shares)) for name, shares in found.items() if shares}


def figures(
    config: jaxsense.Config, models: jaxsense.Models, scans: rawlog.LaserScans
) -> Mapping[str, float]:
    """The figures of `docs/recorded.md`.

    Args:
      config: settings of the run.
      models: its trained models.
      scans: the recorded scans.
    """
    found: dict[str, float] = {}
    empty_key, shown_key, *keys = jax.random.split(jax.random.key(_SEED), 5)
    real = Recorded(config, models, scans)
    of_empty = real.empty(empty_key)
    found |= {f"nothing there, {name}: passes": share for name, share in of_empty.items()}
    errors = recorded.errors(config, scans.angles, scans.ranges)
    looks = real.shown(shown_key, errors, np.arange(len(scans.ranges)))
    is_there, label = real.detect(looks.scans, looks.bearings, looks.distances)
    is_there, is_right = np.asarray(is_there), np.asarray(label == looks.labels)
    found[f"PoI, {len(looks.labels):,} looks: passes"] = float(np.mean(is_there))
    found["PoI: shape right, of those that pass"] = float(np.mean(is_right[is_there]))
    others = {
        "half of the scans": real,
        "a beam each degree": Recorded(config, models, scans, every=2),
        "5 cm too far": Recorded(config, models, scans, offset=0.05),
    }
    for (name, other), key in zip(others.items(), keys, strict=True):
        shares = other.retrained(key, errors)
        found |= {f"PoI, {name}: {figure}": share for figure, share in shares.items()}
    return found


def table(results: Mapping[str, Any]) -> str:
    """The shares, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    rows = [[name, f"{share:.4f}"] for name, share in results["shares"].items()]
    return studies.with_origin(studies.as_table(["looks", "share"], rows), results)


def of_noise(results: Mapping[str, Any]) -> str:
    """The fitted noise of the scanner, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    rows = [[f"`lidar.{name}`", f"{value:.2g}"] for name, value in results["noise"].items()]
    return studies.with_origin(studies.as_table(["setting", "fitted"], rows), results)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    config, models = studies.load(PROGRAM, arguments.run)
    scans = rawlog.read_logs(arguments.logs)
    reserve(PROGRAM, "json", arguments.json)
    fitted = recorded.fit_noise(config.lidar, scans.angles, scans.ranges)
    results = {
        **studies.origin(PROGRAM, arguments),
        "scans": len(scans.ranges),
        "shares": figures(config, models, scans),
        "noise": {name: getattr(fitted, name) for name in NOISE},
    }
    studies.write(arguments.json, results)
    print(table(results), of_noise(results), sep="\n\n")


if __name__ == "__main__":
    main()
