"""`python -m benchmarks.lost_beams RUNS`: what looks say if beams of the scanner return nothing."""

import dataclasses
import functools
import itertools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

import jaxsense
from benchmarks import gate, studies
from benchmarks.measure import reserve
from jaxsense.config.checks import check_fields, limited
from jaxsense.config.options import Name
from jaxsense.run import cli, devices
from jaxsense.sim import resampling
from jaxsense.sim import world as worlds

PROGRAM = "benchmarks.lost_beams"
SHARES = (0.0, 0.01, 0.03, 0.1, 0.3)
_AT_ONCE = 500
_SEED = 31


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Counts right and wrong answers of looks that lose some of their beams."""

    runs: Annotated[tuple[Path, ...], Name("RUNS")] = limited(
        (Path("pretrained:default"), Path("pretrained:noisy")), min_items=1
    )
    """Directories of finished runs, `latest`, or `pretrained:PRESET`."""
    looks: int = limited(10_000, at_least=1)
    """At PoIs of random classes."""
    trust: bool = False
    """Run the code of custom sensors that a run's `config.json` names."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)


def scattered(
    random: np.random.Generator, shape: tuple[int, int], share: float
) -> Bool[np.ndarray, "looks W"]:
    """Beams that are lost independently of each other.

    Args:
      random: source of random numbers.
      shape: number of looks, and of beams in each.
      share: of the beams that are lost.
    """
    return random.random(shape) < share


def together(
    random: np.random.Generator, shape: tuple[int, int], share: float
) -> Bool[np.ndarray, "looks W"]:
    """Neighbouring beams that are lost together, as on a black surface; see `scattered`."""
    number, beams = shape
    length = round(share * beams)
    first = random.integers(beams - length + 1, size=number)[:, None]
    beam = np.arange(beams)
    return (beam >= first) & (beam < first + length)


def as_read(readings: np.ndarray) -> np.ndarray:
    """Readings as they are."""
    return readings


def closed(readings: np.ndarray) -> np.ndarray:
    """Readings with short gaps closed, see `resampling.close_gaps`."""
    angles = np.radians(np.arange(readings.shape[1]))  # of a window, less than a circle
    return np.stack([resampling.close_gaps(angles, each) for each in readings])


WAYS = {"scattered": scattered, "together": together}
"""Ways of losing beams."""
READ = {"no": as_read, "yes": closed}
"""Whether gaps are closed."""


def answers(
    config: jaxsense.Config, models: jaxsense.Models, modality: str, number: int
) -> Iterator[dict[str, object]]:
    """Share of looks that are answered, and of answers that are right, for each of `SHARES`.

    Args:
      config: settings of the run.
      models: its trained models.
      modality: name of a sensor that measures distances.
      number: of looks.
    """
    world, robot = worlds.make_world(config), config.modalities.index(modality)
    sensor, is_poi = world.sensors[robot], jnp.int32([*gate.SITUATIONS].index("PoI"))
    options = devices.compiler_options()

    @functools.partial(jax.jit, compiler_options=options)
    def look(keys: jax.Array) -> tuple[jax.Array, ...]:
        return jax.lax.map(
            lambda key: gate.simulate(key, world, robot, is_poi), keys, batch_size=_AT_ONCE
        )

    @functools.partial(jax.jit, compiler_options=options)
    def detect(
        models: jaxsense.Models, readings: jax.Array, bearing: jax.Array, distance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        def one(look: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            found = models.detect_in_window(robot, sensor, look[0], look[1], look[2])
            is_clear = jnp.max(found.features) >= config.mission.least_confidence
            return found.is_there & is_clear, jnp.argmax(found.features)

        return jax.lax.map(one, (readings, bearing, distance), batch_size=_AT_ONCE)

    readings, bearing, distance, shown = look(jax.random.split(jax.random.key(_SEED), number))
    label = np.array(config.label_of_class(modality))[np.asarray(shown)]
    for (way, lose), (is_closed, read) in itertools.product(WAYS.items(), READ.items()):
        answered, right = [], []
        for share in SHARES:
            lost = lose(np.random.default_rng(_SEED), readings.shape, share)
            seen = read(np.where(lost, np.inf, readings))
            is_answered, found = map(
                np.asarray, detect(models, jnp.asarray(seen), bearing, distance)
            )
            answered.append(float(is_answered.mean()))
            right.append(float((found == label)[is_answered].mean()))
        yield {
            "sensor": modality,
            "lost": way,
            "closed": is_closed,
            "answered": answered,
            "right": right,
        }


def measure_all(arguments: Arguments) -> dict[str, object]:
    """The content of the JSON file: shares by run, sensor and way of losing beams.

    Args:
      arguments: of the program.
    """
    rows: list[dict[str, object]] = []
    for run in arguments.runs:
        config, models = studies.load(PROGRAM, run, arguments.trust)
        sensors = worlds.make_world(config).sensors
        for name, sensor in zip(config.modalities, sensors, strict=True):
            if sensor.measures_distance:
                found = answers(config, models, name, arguments.looks)
                rows += [{"run": studies.name_of(run), **row} for row in found]
    return {**studies.origin(PROGRAM, arguments), "shares": SHARES, "rows": rows}


def table(results: Mapping[str, Any]) -> str:
    """The shares, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    heads = ["run", "lost beams", "gaps closed"]
    heads += [f"{100 * share:g} % lost" for share in results["shares"]]
    rows = [
        [f"`{row['run']}`", row["lost"], row["closed"], *map(_cell, row["answered"], row["right"])]
        for row in results["rows"]
    ]
    return studies.with_origin(studies.as_table(heads, rows), results)


def _cell(answered: float, right: float) -> str:
    return f"{answered:.3f}, {right:.3f}"


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    reserve(PROGRAM, "json", arguments.json)
    results = measure_all(arguments)
    studies.write(arguments.json, results)
    print(table(results))


if __name__ == "__main__":
    main()
