"""Several seeds of a run: their directories, and means and intervals of their metrics."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from jaxsense.config import Config, ConfigError
from jaxsense.mission.compare import described
from jaxsense.run import rundir
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.training.agents import learner

Timing = dict[str, dict[str, float]]
"""Seconds of each stage, `compile_s` and `run_s`."""


def paths(run: RunDirectory) -> dict[int, Path]:
    """The directory of each seed of a run."""
    if run.settings.num_seeds == 1:
        return {run.settings.seed: run.path}
    return {seed: run.path / f"seed-{seed}" for seed in run.settings.seeds}


def check(run: RunDirectory) -> None:
    """Raises `ConfigError` if the directory of one of several seeds holds another run."""
    for seed, path in paths(run).items():
        if path == run.path or not (path / "config.json").exists():
            continue
        # Only compared: no code that they name runs.
        if rundir.read_settings(path / "config.json", trust=True) != _settings_of(run, seed):
            reason = f"must have the settings of {run.path / 'config.json'}, with seed {seed}"
            raise ConfigError("resume", str(path), reason)


def open_run(run: RunDirectory, seed: int, path: Path) -> AbstractContextManager[RunDirectory]:
    """The run directory of one seed, like a run of that seed alone."""
    if path == run.path:
        return contextlib.nullcontext(run)
    if (path / "config.json").exists():
        return RunDirectory.resume(path, trust=True)
    return RunDirectory.create(path, _settings_of(run, seed))


def _settings_of(run: RunDirectory, seed: int) -> Settings:
    return dataclasses.replace(run.settings, seed=seed, num_seeds=1)


def share(total: float, stages: Timing, number: int) -> dict[str, Any]:
    """The block `timing` of each of `number` runs side by side."""
    shared = {
        stage: {kind: value / number for kind, value in seconds.items()}
        for stage, seconds in stages.items()
    }
    return {"total_s": total / number, "stages": shared}


def summarise(runs: Sequence[Path]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The block `timing` of several finished runs together, and all other blocks."""
    found = [rundir.read_summary(path) for path in runs]
    blocks = [{name: one[name] for name in rundir.BLOCKS} for one in found]
    stages: Timing = {}
    for one in found:
        for stage, seconds in one["timing"]["stages"].items():
            entry = stages.setdefault(stage, dict.fromkeys(seconds, 0.0))
            for kind, value in seconds.items():
                entry[kind] += value
    timing = {"total_s": sum(one["timing"]["total_s"] for one in found), "stages": stages}
    of_seeds = {str(one["seed"]): block for one, block in zip(found, blocks, strict=True)}
    return timing, {"seeds": of_seeds, **statistics(blocks)}


def statistics(summaries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and confidence interval of every number in several summaries.

    Args:
      summaries: the blocks of two or more runs, of the same structure.

    Returns:
      The same structure, with `{"mean", "low", "high"}` in place of every number: the mean and its
      95% interval by Student's t, None of a single run. Omits what some run lacks and what is no
      number; in a list, None takes its place.
    """
    return _statistics(list(summaries)) or {}


def rewards(
    runs: Sequence[Path], config: Config, warn: Callable[[str], None]
) -> dict[str, dict[str, np.ndarray]]:
    """`[K, epochs]` total rewards for each modality, from the checkpoints of several runs.

    See `RunResult.rewards`.

    Warns of a run whose checkpoint is damaged or missing, and leaves out its curve.
    """
    shapes = {
        "reward": np.zeros(config.dqn.epochs, np.float32),
        "greedy": np.zeros(config.dqn.epochs, np.float32),
        "epsilon": np.zeros(config.dqn.epochs, np.float32),
        "seconds": np.zeros(config.dqn.epochs // config.dqn.chunk, np.float32),
    }

    def load(run: Path, modality: str) -> list[dict[str, np.ndarray]]:
        directory, name = run / "checkpoints", f"curves_{learner(config, modality)}"
        try:
            found = Checkpoints(directory).load(name, shapes)
        except ConfigError as error:
            warn(f"{error}; left out of reward.png")
            return []
        if found is None:
            warn(f"{directory}: holds no {name}; left out of reward.png")
            return []
        return [found]

    def load_all(modality: str) -> dict[str, np.ndarray]:
        found = [curves for run in runs for curves in load(run, modality)]
        return {
            name: np.array([curves[name] for curves in found]).reshape(-1, config.dqn.epochs)
            for name in ("reward", "greedy")
        }

    return {name: load_all(name) for name in config.modalities}


def _statistics(values: list[Any]) -> Any:
    first = next((value for value in values if value is not None), None)
    if isinstance(first, dict):
        names = [name for name in first if all(isinstance(v, dict) and name in v for v in values)]
        found = {name: _statistics([v[name] for v in values]) for name in names}
        return {name: value for name, value in found.items() if value is not None}
    if isinstance(first, list):
        return [_statistics(list(row)) for row in zip(*values, strict=True)]
    if isinstance(first, bool | int | float):
        return None if None in values else described(np.array(values, float))
    return None
