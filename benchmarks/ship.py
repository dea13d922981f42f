"""`python -m benchmarks.ship RUN...`: makes the files that travel with the package from runs.

For each run, of a preset in `tasks.PRETRAINED`, it writes the trained models for
`jaxsense.load_pretrained`. If a frozen task has that preset's settings and no file yet, it freezes
it. The file of a task is never written again: another task is another version.
"""

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

import jax

import jaxsense
from jaxsense import Config
from jaxsense.tasks import PRETRAINED, pretrained, registry
from jaxsense.tasks.pretrained import Origin

_KEY = 20261126
_LOOKS = 12288  # by each sensor, at all classes together


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
    written = [pretrained.DATA / f"{preset}.npz"]
    pretrained.write(written[0], config, trained, made)
    freezing = FREEZINGS.get(preset)
    file = pretrained.DATA / f"{freezing.name}.npz" if freezing else None
    if freezing is not None and file is not None and not file.exists():
        there = freezing.change(config)
        look_key, scale_key = jax.random.split(jax.random.key(_KEY))
        number = _LOOKS // len(there.arena.classes)
        looks = jaxsense.detections(look_key, there, trained, number)
        registry.freeze(scale_key, file, freezing.name, there, trained, looks, made)
        written.append(file)
    return written


def main(argv: list[str]) -> None:
    """Runs the program."""
    if not argv:
        raise SystemExit(f"{__doc__}")
    for run in argv:
        for file in ship(Path(run)):
            print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
