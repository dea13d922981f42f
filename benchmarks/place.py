"""`python -m benchmarks.place RUN`: what a robot gains that may look on from where it stands.

Dynamic programming on one PoI with two equally likely labels. A robot looks from where it stands,
where a look says less with each one before it, drives for some seconds to a place where a look is
new, or stops. It pays a second for each second and a price for a wrong label. The time is compared,
at the same share of errors, with that of a robot that always drives before it looks again, as in
missions. Weights of looks from one place and the detectors' accuracies are those of the run.

The log-odds of a look of weight w are Gaussian with mean `+-w m` and variance `2 w m`, which makes
them exact evidence; m gives a single look the detector's accuracy.
"""

import dataclasses
import functools
import json
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from scipy import stats

from jaxsense.config import ConfigError
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.run import cli, rundir
from jaxsense.run.version import commit, versions
from jaxsense.summary import read
from jaxsense.summary.metrics import mean

PROGRAM = "benchmarks.place"
ERRORS = (0.02, 0.01, 0.005)
_PRICES = np.geomspace(20.0, 2e4, 60)  # s for an error
_MOST = 8  # looks from one place whose weights differ
_CHANGE = 1e-6  # s, of values between the last two rounds
_LOG_ODDS = np.linspace(-15.0, 15.0, 301)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compare robots that may look on from one place with robots that must drive."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, or `latest`."""
    drives: tuple[float, ...] = (0.5, 2.0, 5.0)
    """Seconds of driving to a place where a look is new."""
    json: Path | None = None
    """File to write the figures to."""

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

    @functools.cached_property
    def after_each(self) -> Float[np.ndarray, "K L L"]:
        """Probabilities of the log-odds after a look, for each before it, and by earlier looks."""
        return np.stack([self._after(number) for number in range(_MOST)])

    def _after(self, number: int) -> np.ndarray:
        gain = (1 + self.strength * number) ** -2 * 2 * stats.norm.ppf(self.accuracy) ** 2
        edges = np.append((_LOG_ODDS[1:] + _LOG_ODDS[:-1]) / 2, np.inf)
        found = np.zeros((len(_LOG_ODDS), len(_LOG_ODDS)))
        for sign in (1, -1):
            middle = _LOG_ODDS + sign * gain
            up_to = stats.norm.cdf((edges[None] - middle[:, None]) / np.sqrt(2 * gain))
            found += _sigmoid(sign * _LOG_ODDS)[:, None] * np.diff(up_to, prepend=0.0, axis=1)
        return found


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def best(sensor: Sensor, price: float, *, stays: bool) -> tuple[float, float]:
    """Expected seconds and share of errors of the best robot.

    Args:
      sensor: of the robot, which stands where it can look at once.
      price: seconds that an error costs.
      stays: whether the robot may look twice from one place.
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
    if not stays:
        forbidden[0, 1:] = np.inf
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


def seconds_at(sensor: Sensor, *, stays: bool) -> list[float]:
    """Seconds of the best robot at each share of errors of `ERRORS`.

    Args:
      sensor: see `best`.
      stays: see `best`.
    """
    found = [best(sensor, price, stays=stays) for price in _PRICES]
    time, wrong = np.array(found).T
    order = np.argsort(wrong)
    # Between two prices a robot may choose at random which one it pays.
    return [float(np.interp(e, wrong[order], time[order])) for e in ERRORS]


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    directory = cli.find_run(arguments.run)
    config, models = rundir.load(directory)
    detectors = read(directory)["detectors"]
    rows = []
    print(f"| sensor, drive | {' | '.join(f'{e:.1%} wrong' for e in ERRORS)} |")
    print("| --- |" + " --- |" * len(ERRORS))
    for m, name in enumerate(config.modalities):
        if len(config.labels(name)) > 2:
            raise ConfigError(
                "run", arguments.run, f"must tell two labels apart by {name}, not more"
            )
        for drive in arguments.drives:
            sensor = Sensor(
                accuracy=mean(detectors[name]["accuracy"]),
                strength=float(models.novelty.strength[m]),
                look=float(config.team.travel.look_seconds),
                drive=drive,
            )
            may, must = (seconds_at(sensor, stays=stays) for stays in (True, False))
            rows.append({"sensor": name, "drive": drive, "stays": may, "drives": must})
            cells = [f"{a:.2f} s, {a / b - 1:+.1%}" for a, b in zip(may, must, strict=True)]
            print(f"| {name}, {drive:g} s | {' | '.join(cells)} |", flush=True)
    if arguments.json is not None:
        whole = {"commit": commit(), "versions": versions(), "rows": rows}
        arguments.json.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
