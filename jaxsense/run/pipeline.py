"""A whole run: the training, the missions, and the summary of both."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxsense import examine, mission
from jaxsense.config import Config
from jaxsense.core.types import Belief, Key
from jaxsense.models import Models
from jaxsense.run import missions
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.compilation import Compiler, Kept
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.loop import Trained, train
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs, compile_programs
from jaxsense.sim.world import make_world
from jaxsense.stages import agent, mission_key, models

_UNAMBIGUOUS = 0.9  # share of looks in a single class, above which the class counts as one


@dataclasses.dataclass(frozen=True)
class RunResult:
    """The results of a run.

    Attributes:
      models: the trained networks.
      windows: for each modality `[C, 1, F]` one look at each class.
      detections: for each modality `[C, S', D_m]` held-out detections.
      posteriors: `[C, S', D]` beliefs of these, `joint` and for each modality.
      rewards: for each modality the `[epochs]` mean total reward of the episodes that ended, as
        `reward`, and of the greedy policy, as `greedy`; NaN in other epochs.
      recording: the first mission of the first of `config.mission.policies`.
      summary: the blocks `detectors`, `jmvae`, `dqn` and `mission` of `summary.json`.
    """

    models: Models
    windows: dict[str, np.ndarray]
    detections: dict[str, np.ndarray]
    posteriors: dict[str, Belief]
    rewards: dict[str, dict[str, np.ndarray]]
    recording: missions.Recording
    summary: dict[str, Any]


@contextlib.contextmanager
def compiled(
    config: Config,
    monitor: Monitor,
    workers: Workers = ALONE,
    kept: Kept | None = None,
    num_seeds: int = 1,
) -> Iterator[Programs]:
    """The programs of runs with the same settings, compiled in the background.

    Args:
      config: all settings.
      monitor: receives the time that it takes.
      workers: what shares scenes, missions and seeds.
      kept: where to keep compiled programs for later runs, if anywhere.
      num_seeds: runs side by side, see `compile_programs`.
    """
    with Compiler(monitor, kept) as compiler:
        yield compile_programs(config, make_world(config), compiler, workers, num_seeds)


def run(
    key: Key,
    config: Config,
    programs: Programs,
    monitor: Monitor,
    checkpoints: Checkpoints | None = None,
) -> RunResult:
    """Trains everything, plays the missions and summarises.

    Args:
      key: the only source of randomness.
      config: all settings.
      programs: from `compiled`, with the same monitor.
      monitor: receives time and progress.
      checkpoints: see `loop.train`.

    Raises:
      StageError, Stopped, OSError: see `loop.train`.
    """
    checkpoints = checkpoints or Checkpoints()
    trained = train(key, config, programs, monitor, checkpoints)
    networks = models(trained.outputs, config)
    cases = mission.cases(config)
    played = {name: cases[name] for name in config.mission.policies}
    player, episodes = programs.player.result(), config.mission.episodes
    found = player.play(mission_key(key), networks, played, episodes)
    checkpoints.forget_unfinished()
    posteriors, latent = jax.tree.map(np.asarray, trained.outputs["latent_space"])
    detections = jax.tree.map(np.asarray, trained.outputs["detections"])
    return RunResult(
        models=networks,
        windows=dict(zip(config.modalities, detections.windows, strict=True)),
        detections=dict(zip(config.modalities, detections.held_out, strict=True)),
        posteriors=posteriors,
        rewards={
            n: {
                name: np.array(trained.curves[agent(config, n)][name])
                for name in ("reward", "greedy")
            }
            for n in config.modalities
        },
        recording=found.recording,
        summary={
            "detectors": jax.tree.map(lambda x: x.tolist(), detections.metrics),
            "jmvae": _as_lists(latent),
            "belief": jax.tree.map(lambda x: np.asarray(x).tolist(), trained.outputs["beliefs"]),
            "dqn": {name: _of_agent(config, name, trained) for name in config.modalities},
            "mission": missions.summary(player.mission, found),
        },
    )


def _of_agent(config: Config, modality: str, trained: Trained) -> dict[str, Any]:
    """One modality's block in the summary's `dqn`."""
    total, first = map(np.asarray, trained.outputs[f"policies_{modality}"])
    env_steps = config.dqn.epochs * config.dqn.num_envs
    seconds = sum(trained.curves[agent(config, modality)]["seconds"])
    others = {
        str(number): examine.returns(np.asarray(total), config)
        for number, (total, _) in zip(
            config.evaluation.num_pois, trained.outputs.get(f"numbers_{modality}", ()), strict=True
        )
    }
    return {
        **examine.policy_metrics(total, first, config),
        **({"other_numbers": others} if others else {}),
        "env_steps": env_steps,
        "env_steps_per_s": env_steps / seconds,
    }


def _as_lists(metrics: dict[str, Any]) -> dict[str, Any]:
    """The summary's block `jmvae` from the arrays of `examine.latent_space`."""
    lists = jax.tree.map(lambda x: x.tolist(), metrics)
    lists["unambiguous"] = {
        name: [share > _UNAMBIGUOUS for share in shares]
        for name, shares in lists["unambiguous"].items()
    }
    return lists
