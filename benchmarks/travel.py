"""`python -m benchmarks.travel RUN`: how well the travel model predicts missions in MJX.

Plays missions of naive exploration, takes each trip from a decision to its look, and compares how
long it took with what the model predicts, with its settings and with the parameters that fit best.
"""

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import measure, studies
from jaxsense import Config, Models, mission
from jaxsense.config import TravelConfig
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.dqn.travel import travel_seconds
from jaxsense.run import cli

PROGRAM = "benchmarks.travel"
_MISSIONS = 64


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compares the travel model with missions."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    config, models = studies.load(PROGRAM, arguments.run)
    measure.reserve(PROGRAM, "json", arguments.json)
    poses, places, taken = trips(config, models)
    results = {
        **studies.origin(PROGRAM, arguments),
        "trips": len(taken),
        "mean_s": float(taken.mean()),
        "models": {
            "settings": _errors(config.team.travel, poses, places, taken),
            "best fit": _errors(fit(poses, places, taken), poses, places, taken),
        },
    }
    studies.write(arguments.json, results)
    print(table(results))


def _errors(
    travel: TravelConfig, poses: np.ndarray, places: np.ndarray, taken: np.ndarray
) -> dict[str, Any]:
    """Parameters of a model, the mean trip that it predicts, and its errors."""
    predicted = np.asarray(_predict(travel, poses, places))
    error = predicted - taken
    return {
        "parameters": dataclasses.asdict(travel),
        "mean_s": float(predicted.mean()),
        "median_error_s": float(np.median(np.abs(error))),
        "root_mean_square_error_s": float(np.sqrt(np.mean(error**2))),
    }


def table(results: Mapping[str, Any]) -> str:
    """Parameters and errors of the models, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    units = {"speed": "m/s", "turn_rate": "rad/s", "view_distance": "m", "look_seconds": "s"}
    parameters = [f"`{name}` [{unit}]" for name, unit in units.items()]
    heads = ["model", *parameters, "mean trip", "median error", "root mean square error"]
    rows = [["missions", *[""] * len(units), f"{results['mean_s']:.2f} s", "", ""]]
    for name, model in results["models"].items():
        values = [f"{model['parameters'][parameter]:.2f}" for parameter in units]
        keys = "mean_s", "median_error_s", "root_mean_square_error_s"
        rows.append([name, *values, *(f"{model[key]:.2f} s" for key in keys)])
    return studies.with_origin(studies.as_table(heads, rows), results)


def trips(config: Config, models: Models) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trips from a decision to a look: `[W, 3]` first poses, `[W, 2]` PoIs and `[W]` seconds."""
    scenario = mission.make_mission(config)
    period = config.mission.control_period
    steps = int(config.mission.time_limit / period)
    naive = scenario.policy("naive")

    @jax.jit
    def play(keys: jax.Array):
        states = jax.vmap(lambda key: mission.reset(key, scenario, models, naive))(keys)
        _, records = mission.rollout_batch(keys, scenario, models, states, steps)
        return states.scene.poses, states.scene.layout.position, records

    first, positions, record = jax.tree.map(
        np.asarray, play(jax.random.split(jax.random.key(0), _MISSIONS))
    )
    found = []
    num_pois = config.arena.num_pois
    for b in range(_MISSIONS):
        before = np.concatenate([first[b][None], record.poses[b][:-1]])
        for r in range(first.shape[1]):
            begin = 0
            target = record.target[b, :, r]
            for i in np.flatnonzero(record.scanned[b, :, r]):
                # After a look there is no target; a robot that changed its mind drove farther.
                aims = target[begin:i]
                if (
                    record.detected[b, i, r]
                    and i > begin
                    and np.all(aims == aims[0])
                    and aims[0] < num_pois
                ):
                    found.append(
                        (before[begin, r], positions[b, aims[0]], (i + 1 - begin) * period)
                    )
                begin = i + 1
    poses, places, taken = zip(*found, strict=True)
    return np.array(poses), np.array(places), np.array(taken)


def _predict(travel: TravelConfig, poses: np.ndarray, places: np.ndarray) -> jax.Array:
    return jax.vmap(lambda pose, place: travel_seconds(travel, pose, place[None])[0])(
        jnp.asarray(poses), jnp.asarray(places)
    )


def fit(poses: np.ndarray, places: np.ndarray, taken: np.ndarray) -> TravelConfig:
    """The model of least squares, over viewing distances of .3 to 1.2 m."""
    to_place = places - poses[:, :2]
    distance = np.linalg.norm(to_place, axis=1)
    turn = np.arctan2(to_place[:, 1], to_place[:, 0]) - poses[:, 2]
    turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    best = None
    for view in np.arange(0.3, 1.21, 0.02):
        columns = np.stack([np.ones_like(turn), turn, np.maximum(distance - view, 0.0)], axis=1)
        weights, *_ = np.linalg.lstsq(columns, taken, rcond=None)
        error = float(np.mean((columns @ weights - taken) ** 2))
        if best is None or error < best[0]:
            best = error, view, weights
    assert best is not None
    _, view, (look, by_turn, by_way) = best
    return dataclasses.replace(
        TravelConfig(),
        look_seconds=float(look),
        turn_rate=float(1 / by_turn),
        speed=float(1 / by_way),
        view_distance=float(view),
    )


if __name__ == "__main__":
    main()
