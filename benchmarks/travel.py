"""How well the travel model predicts missions in MJX: `python -m benchmarks.travel RUN`.

Plays missions of naive exploration with the models of a run, takes each trip from a decision to its
look, and prints how long it took, how long the model predicts, and the best-fitting parameters.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import rich.console
import rich.table

from jaxsense import Config, Models, mission
from jaxsense.config import TravelConfig
from jaxsense.dqn import team_mdp
from jaxsense.run import rundir

_MISSIONS = 64


def main(argv: list[str]) -> None:
    """Prints the errors of the model."""
    config, models = rundir.load(argv[0], trust=False)
    poses, places, taken = trips(config, models)
    table = rich.table.Table("model", "mean", "median error", "root mean square error")
    for name, travel in {
        "settings": config.team.travel,
        "best fit": fit(poses, places, taken),
    }.items():
        predicted = np.asarray(_predict(travel, poses, places))
        error = predicted - taken
        table.add_row(
            f"{name}: {travel}",
            f"{predicted.mean():.2f} s",
            f"{np.median(np.abs(error)):.2f} s",
            f"{np.sqrt(np.mean(error**2)):.2f} s",
        )
    console = rich.console.Console()
    console.print(table)
    console.print(f"{len(taken)} trips of {taken.mean():.2f} s on average")


def trips(config: Config, models: Models) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Trips from a decision to a look: `[W, 3]` first poses, `[W, 2]` PoIs and `[W]` seconds."""
    scenario = mission.make_mission(config)
    period = config.mission.control_period
    steps = int(config.mission.time_limit / period)
    naive = scenario.policy("naive")

    @jax.jit
    def play(keys: jax.Array):
        states = jax.vmap(lambda key: mission.reset(key, scenario, models, naive))(keys)
        _, records = mission.rollout_batch(keys, scenario, models, states, steps, 1)
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
    return jax.vmap(lambda pose, place: team_mdp.travel_seconds(travel, pose, place[None])[0])(
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
    main(sys.argv[1:])
