"""`python -m benchmarks.ship RUN...`: makes the files that travel with the package from runs.

For each run, of a preset in `tasks.PRETRAINED`, it writes the trained models for
`jaxsense.load_pretrained`. If a frozen task has that preset's settings and no file yet, it freezes
it. The file of a task is never written again: another task is another version.
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxsense
from jaxsense import Bank, Config, Models
from jaxsense.config import as_plain
from jaxsense.core.types import Samples, by_place
from jaxsense.models import make_models
from jaxsense.tasks import PRETRAINED, Task, registry
from jaxsense.tasks.registry import Origin
from jaxsense.tasks.task import EPISODES, SEEDS, Scaling

_KEY = 20261126
_LOOKS = 12288  # by each sensor, at all classes together
_STATES, _STEPS = 1024, 12  # from which observations are scaled
_LEAST_SPREAD = 1e-6  # below which a feature is constant


@dataclasses.dataclass(frozen=True)
class Freezing:
    """How a task is made of a preset.

    Attributes:
      name: of the task.
      change: settings of the preset to those of the task.
    """

    name: str
    change: Callable[[Config], Config]


def _map(config: Config) -> Config:
    """One agent, whose looks take no time."""
    return dataclasses.replace(config, dqn=dataclasses.replace(config.dqn, task="map"))


def _team(config: Config) -> Config:
    """A team at the start of its work, which pays about a third of what it earns for its time."""
    team = dataclasses.replace(config.team, second_cost=0.05)
    return dataclasses.replace(config, team=team)


FREEZINGS = {
    "default": Freezing("map-v0", _map),
    "noisy": Freezing("noisy-v0", _map),
    "many": Freezing("many-v0", _map),
    "team": Freezing("team-v0", _team),
}
"""By preset."""


def ship(run: Path) -> list[Path]:
    """Writes the files of a run; returns them.

    Args:
      run: directory of a finished run.
    """
    config, trained = jaxsense.load(run)
    content = json.loads((run / "config.json").read_text())
    preset, seed = content["preset"], content["seed"]
    if preset not in PRETRAINED or config != jaxsense.PRESETS[preset]:
        raise SystemExit(f"{run}: must be of {', '.join(PRETRAINED)}, without other settings")
    if "dirty" in str(content["commit"]) or not content["commit"]:
        raise SystemExit(f"{run}: commit {content['commit']}: must be one without changes")
    command = f"python -m jaxsense.train --preset {preset} --seed {seed}"
    made = Origin(command, preset, seed, content["commit"], content["versions"])
    written = [registry.DATA / f"{preset}.npz"]
    write(written[0], {name: getattr(trained, name) for name in registry.PARTS}, config, made)
    freezing = FREEZINGS.get(preset)
    file = registry.DATA / f"{freezing.name}.npz" if freezing else None
    if freezing is not None and file is not None and not file.exists():
        there = freezing.change(config)
        look_key, scale_key = jax.random.split(jax.random.key(_KEY))
        number = _LOOKS // len(there.arena.classes)
        looks = jaxsense.detections(look_key, there, trained, number)
        freeze(scale_key, file, freezing.name, there, trained, looks, made)
        written.append(file)
    return written


def freeze(
    key: jax.Array,
    file: Path,
    name: str,
    config: Config,
    trained: Models,
    looks: Samples,
    made: Origin,
) -> None:
    """Writes the file of a task, whose name ends in `.npz`."""
    parts = make_models(config, fusion=trained.fusion, look_values=trained.look_values)
    acting = registry.agents_of(config)

    def task(agent: str, scaling: Scaling) -> Task:
        return registry.task_of(name, agent, config, parts, Bank(looks), scaling, jnp.zeros((0, 0)))

    scaling = scaling_of(key, task(acting[0], Scaling(jnp.zeros(1), jnp.ones(1))))

    def returns(agent: str) -> np.ndarray:
        played = registry.reference_returns(task(agent, scaling), SEEDS, EPISODES)
        return np.stack([*played.values()])

    trees = {
        "fusion": trained.fusion,
        "look_values": trained.look_values,
        "looks": looks,
        "scaling": {"offset": scaling.offset, "scale": scaling.scale},
        "returns": {agent: returns(agent) for agent in acting},
    }
    write(file, trees, config, made)


def scaling_of(key: jax.Array, task: Task) -> Scaling:
    """Means and standard deviations of features over states after random looks."""

    def visit(key: jax.Array) -> jax.Array:
        reset_key, walk_key = jax.random.split(key)
        _, state = task.reset(reset_key)

        def look(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            choice_key, step_key = jax.random.split(key)
            chances = task.action_mask(state).at[-1].set(False)
            action = jax.random.choice(choice_key, len(chances), p=chances / chances.sum())
            after, _ = task.step(step_key, state, action)
            return after, task.mdp.features(
                state.belief, state.team, task.mdp.times(state), state.agent
            )

        return jax.lax.scan(look, state, jax.random.split(walk_key, _STEPS))[1]

    found = jax.jit(jax.vmap(visit))(jax.random.split(key, _STATES))
    found = found.reshape(-1, found.shape[-1])
    spread = jnp.std(found, axis=0)
    return Scaling(jnp.mean(found, axis=0), jnp.where(spread > _LEAST_SPREAD, spread, 1.0))


def write(file: Path, trees: Mapping[str, Any], config: Config, made: Origin) -> None:
    """Writes trees of arrays, with the settings and the origin of the models."""
    arrays = {name: np.asarray(leaf) for name, leaf in by_place(trees).items()}
    about = {"config": as_plain(config), "origin": dataclasses.asdict(made)}
    text = np.array(json.dumps(about, allow_nan=False))
    partial = file.with_suffix(".part.npz")  # a task's file is written once
    np.savez_compressed(partial, allow_pickle=False, **{**arrays, "about": text})
    partial.replace(file)


def main(argv: list[str]) -> None:
    """Runs the program."""
    if not argv:
        raise SystemExit(f"{__doc__}")
    for run in argv:
        for file in ship(Path(run)):
            print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
