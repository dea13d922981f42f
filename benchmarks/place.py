"""`python -m benchmarks.place RUN`: what a robot gains that chooses from where to look again.

Dynamic programming on one PoI with two equally likely labels. A robot looks from where it stands,
where a look says less with each one before it, drives for some seconds to a place where a look is
new, or stops. It pays a second for each second and a price for a wrong label. The best such robot
is compared, at the same share of errors, with robots that look on from one place while at least
some share of a look is new, and otherwise drive, as in missions.
Weights of looks from one place and the detectors' accuracies are those of the run.

The log-odds of a look of weight w are Gaussian with mean `+-w m` and variance `2 w m`, which makes
them exact evidence; m gives a single look the detector's accuracy.
"""

import dataclasses
import functools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from benchmarks import studies
from benchmarks.measure import reserve
from jaxsense import Config, Models, detections
from jaxsense.config import ConfigError
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.vae.novelty import LEAST_NEW

PROGRAM = "benchmarks.place"
ERRORS = (0.02, 0.01, 0.005)
RULES = {f"share {share:g}": share for share in (LEAST_NEW, 0.25, 0.1)}
"""Shares of a look that must be new where robots look again, by the names of the rules."""
_PRICES = np.geomspace(20.0, 2e4, 60)  # s for an error
_MOST = 8  # looks from one place whose weights differ
_CHANGE = 1e-6  # s, of values between the last two rounds
_SAMPLES = 4000  # looks at each class, for the accuracy of single looks
_SEED = 37
_LOG_ODDS = np.linspace(-15.0, 15.0, 301)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compares the best choice of where to look again with rules."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    drives: tuple[float, ...] = (0.5, 1.0, 2.0, 5.0)
    """Seconds of driving to a place where a look is new."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)
        require(min(self.drives) > 0, self, "drives", "must be above 0")


@dataclasses.dataclass(frozen=True)
class Sensor:
    """One sensor at one PoI.

    Attributes:
      accuracy: share of single looks that show the right one of two labels, above 1/2, below 1.
      strength: how much looks from one place have in common, see `vae.Novelty`.
      look: seconds of a look.
      drive: seconds to another place.
    """

    accuracy: float
    strength: float
    look: float
    drive: float

    def __post_init__(self):
        require(0.5 < self.accuracy < 1, self, "accuracy", "must be above 0.5 and below 1")

    @property
    def weights(self) -> Float[np.ndarray, " K"]:
        """What a look from one place is worth, by earlier looks from there."""
        return (1 + self.strength * np.arange(_MOST)) ** -2.0

    @functools.cached_property
    def after_each(self) -> Float[np.ndarray, "K L L"]:
        """Probabilities of the log-odds after a look, for each before it, and by earlier looks."""
        return np.stack([self._after(weight) for weight in self.weights])

    def _after(self, weight: float) -> np.ndarray:
        gain = weight * 2 * stats.norm.ppf(self.accuracy) ** 2
        edges = np.append((_LOG_ODDS[1:] + _LOG_ODDS[:-1]) / 2, np.inf)
        found = np.zeros((len(_LOG_ODDS), len(_LOG_ODDS)))
        for sign in (1, -1):
            middle = _LOG_ODDS + sign * gain
            up_to = stats.norm.cdf((edges[None] - middle[:, None]) / np.sqrt(2 * gain))
            found += _sigmoid(sign * _LOG_ODDS)[:, None] * np.diff(up_to, prepend=0.0, axis=1)
        return found


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def best(sensor: Sensor, price: float, least_new: float | None = None) -> tuple[float, float]:
    """Expected seconds and share of errors of the robot that decides best when to stop.

    Args:
      sensor: of the robot, which stands where it can look at once.
      price: seconds that an error costs.
      least_new: share of a look that must be new for it to look again from where it stands, and
        while this is so, it does not drive; it chooses freely by default.
    """
    after = sensor.after_each
    later = np.minimum(np.arange(_MOST) + 1, _MOST - 1)
    errors = _sigmoid(-np.abs(_LOG_ODDS))

    def ahead(of_state: np.ndarray) -> np.ndarray:
        """`[2, K, L]` what follows a look from here and from elsewhere."""
        here = np.matmul(after, of_state[later][..., None])[..., 0]
        return np.stack([here, np.broadcast_to(after[0] @ of_state[1], here.shape)])

    seconds = np.array([sensor.look, sensor.look + sensor.drive])[:, None, None]
    forbidden = np.zeros((2, _MOST, 1))
    if least_new is not None:
        stays = sensor.weights[:, None] >= least_new
        forbidden = np.where([~stays, stays], np.inf, 0.0)
    value = np.broadcast_to(price * errors, (_MOST, len(errors)))
    while True:
        looks = ahead(value) + seconds + forbidden
        options = np.stack([np.broadcast_to(price * errors, value.shape), *looks])
        value, old = options.min(axis=0), value
        if np.max(np.abs(value - old)) < _CHANGE:
            break
    choice = options.argmin(axis=0)
    time, wrong = np.zeros_like(value), np.zeros_like(value)
    while True:
        costs = [ahead(time) + seconds, ahead(wrong)]
        stops = [np.zeros_like(value), np.broadcast_to(errors, value.shape)]
        new = [np.choose(choice, [stop, *cost]) for stop, cost in zip(stops, costs, strict=True)]
        change = max(np.max(np.abs(new[0] - time)), np.max(np.abs(new[1] - wrong)))
        time, wrong = new
        if change < _CHANGE:
            middle = len(errors) // 2
            return float(time[0, middle]), float(wrong[0, middle])


def seconds_at(sensor: Sensor, least_new: float | None = None) -> list[float]:
    """Seconds that a robot needs for each share of errors of `ERRORS`.

    Args:
      sensor: see `best`.
      least_new: see `best`.
    """
    found = [best(sensor, price, least_new) for price in _PRICES]
    time, wrong = np.array(found).T
    order = np.argsort(wrong)
    # Between two prices a robot may choose at random which one it pays.
    return [float(np.interp(e, wrong[order], time[order])) for e in ERRORS]


def accuracies(config: Config, models: Models) -> dict[str, float]:
    """Share of simulated looks of which the most likely label is right, by modality.

    Args:
      config: settings of the run.
      models: its trained models.
    """
    found = detections(jax.random.key(_SEED), config, models, _SAMPLES)
    return {
        name: float(np.mean(features.argmax(-1) == np.array(config.label_of_class(name))[:, None]))
        for name, features in zip(config.modalities, found, strict=True)
    }


def compared(
    config: Config, models: Models, accuracy: Mapping[str, float], drives: tuple[float, ...]
) -> Iterator[dict[str, object]]:
    """Seconds by sensor and drive, of the best robot and of each rule, for each of `ERRORS`.

    Args:
      config: settings of the run.
      models: its trained models.
      accuracy: from `accuracies`.
      drives: seconds to where a look is new.
    """
    for m, name in enumerate(config.modalities):
        for drive in drives:
            sensor = Sensor(
                accuracy=accuracy[name],
                strength=float(models.novelty.strength[m]),
                look=float(config.team.travel.look_seconds),
                drive=drive,
            )
            by_rule = {rule: seconds_at(sensor, share) for rule, share in RULES.items()}
            yield {"sensor": name, "drive": drive, "best": seconds_at(sensor), **by_rule}


def table(results: Mapping[str, Any], error: float = 0.01) -> str:
    """What the best choice needs and what the rules need beyond it, in Markdown.

    Args:
      results: the content of the JSON file.
      error: share of errors, one of `ERRORS`.
    """
    i = results["errors"].index(error)

    def cells(row: Mapping[str, Any]) -> list[str]:
        least = row["best"][i]
        rules = [f"{row[rule][i] / least - 1:+.1%}" for rule in RULES]
        return [f"{studies.in_words(row['sensor'])}, {row['drive']:g} s", f"{least:.2f} s", *rules]

    heads = ["sensor, drive", f"best with {error:.1%} wrong", *RULES]
    rows = [cells(row) for row in results["rows"]]
    return studies.with_origin(studies.as_table(heads, rows), results)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    config, models = studies.load(PROGRAM, arguments.run)
    for name in config.modalities:
        if len(config.labels(name)) > 2:
            expected = f"must tell two labels apart by {name}, not more"
            cli.fail(PROGRAM, str(ConfigError("run", arguments.run, expected)))
    reserve(PROGRAM, "json", arguments.json)
    accuracy = accuracies(config, models)
    results = {
        **studies.origin(PROGRAM, arguments),
        "accuracy": accuracy,
        "errors": ERRORS,
        "rows": [*compared(config, models, accuracy, arguments.drives)],
    }
    studies.write(arguments.json, results)
    print(*(table(results, error) for error in ERRORS), sep="\n\n")


if __name__ == "__main__":
    main()
