"""Several seeds of a run: their directories, and means and intervals of their metrics."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from jaxsense.config import Config, ConfigError
from jaxsense.core import inside
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings, read_settings
from jaxsense.training.agents import learner

_MOST = 10_000


def check_range(seed: int, number: int) -> None:
    """Checks the first seed and the number of seeds.

    Args:
      seed: the first seed.
      number: of seeds.

    Raises:
      ConfigError: if one is outside its range.
    """
    if not 0 <= seed < 2**32:
        raise ConfigError("seed", seed, "must be from 0 to 2^32 - 1")
    if seed + number > 2**32:
        raise ConfigError("num_seeds", number, "leads beyond seed 2^32 - 1")
    if not 1 <= number <= _MOST:
        raise ConfigError("num_seeds", number, f"must be from 1 to {_MOST:,}")


def paths(run: RunDirectory) -> dict[int, Path]:
    """The directory of each seed of a run; raises `OSError` if one leads out of it."""
    if run.settings.num_seeds == 1:
        return {run.settings.seed: run.path}
    return {n: inside.place(run.path / f"seed-{n}", run.path) for n in run.settings.seeds}


def check(run: RunDirectory) -> None:
    """Checks that the directories of several seeds belong to this run.

    Raises:
      ConfigError: if one holds another run.
    """
    for seed, path in paths(run).items():
        if path == run.path or not (path / "config.json").exists():
            continue
        # The settings are only compared: no custom sensor is made.
        if read_settings(path / "config.json", trust=True) != _settings_of(run, seed):
            reason = f"must have the settings of {run.path / 'config.json'}, with seed {seed}"
            raise ConfigError("resume", str(path), reason)


def open_run(run: RunDirectory, seed: int, path: Path) -> AbstractContextManager[RunDirectory]:
    """Opens the run directory of one seed, the same as if that seed were trained alone.

    Args:
      run: the run of all seeds.
      seed: the seed.
      path: its directory, from `paths`.
    """
    if path == run.path:
        return contextlib.nullcontext(run)
    if (path / "config.json").exists():
        return RunDirectory.resume(path, trust=True)
    return RunDirectory.create(path, _settings_of(run, seed))


def _settings_of(run: RunDirectory, seed: int) -> Settings:
    return dataclasses.replace(run.settings, seed=seed, num_seeds=1)


def rewards(
    runs: Sequence[Path], config: Config, warn: Callable[[str], None]
) -> dict[str, dict[str, np.ndarray]]:
    """Reads the curves of `reward.svg` from the checkpoints of several runs.

    Args:
      runs: their directories.
      config: their settings.
      warn: called with a line about each checkpoint that is damaged or missing.

    Returns:
      `[K, epochs]` rewards as in `pipeline.Learned.rewards`, without those of such checkpoints.
    """
    of_epochs, epochs = ("reward", "evaluation", "epsilon"), config.dqn.epochs
    shapes = dict.fromkeys(of_epochs, np.zeros(epochs, np.float32))
    shapes["seconds"] = np.zeros(epochs // config.dqn.chunk, np.float32)

    def load(run: Path, network: str) -> list[dict[str, np.ndarray]]:
        directory, name = run / "checkpoints", f"curves_{network}"
        found, reason = None, f"{directory}: holds no {name}"
        try:
            found = Checkpoints(directory).load(name, shapes)
        except ConfigError as error:
            reason = str(error)
        if found is None:
            warn(f"{reason}; left out of reward.svg")
        return [] if found is None else [found]

    def load_all(network: str) -> dict[str, np.ndarray]:
        found = [curves for run in runs for curves in load(run, network)]
        return {
            name: np.array([curves[name] for curves in found]).reshape(-1, config.dqn.epochs)
            for name in ("reward", "evaluation")
        }

    networks = dict.fromkeys(learner(config, name) for name in config.modalities)
    return {network.removeprefix("dqn_"): load_all(network) for network in networks}
