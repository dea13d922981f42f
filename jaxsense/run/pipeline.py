"""A whole run: the training, the missions, and the summary of both."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxsense import mission
from jaxsense.config import Config
from jaxsense.core.types import Belief, Key
from jaxsense.dqn import episodes
from jaxsense.models import Models
from jaxsense.run import missions
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.compilation import Compiler, Kept
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.loop import Trained, train
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs, compile_programs
from jaxsense.sim.world import make_world
from jaxsense.training.agents import learner
from jaxsense.training.stages import mission_key, models

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
        yield compile_programs(config, make_world(config).arena, compiler, workers, num_seeds)


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
    player, episodes = programs.player.result(), config.mission.episodes
    cases = mission.cases(config, player.mission.policies)
    played = {name: cases[name] for name in config.mission.policies}
    found = player.play(mission_key(key), networks, played, episodes)
    checkpoints.forget_unfinished()
    posteriors, latent = jax.tree.map(np.asarray, trained.outputs["latent_space"])
    latent = {f.name: getattr(latent, f.name) for f in dataclasses.fields(latent)}
    detections = jax.tree.map(np.asarray, trained.outputs["detections"])
    return RunResult(
        models=networks,
        windows=dict(zip(config.modalities, detections.windows, strict=True)),
        detections=dict(zip(config.modalities, detections.held_out, strict=True)),
        posteriors=posteriors,
        rewards={
            n: {
                name: np.array(trained.curves[learner(config, n)][name])
                for name in ("reward", "greedy")
            }
            for n in config.modalities
        },
        recording=found.recording,
        summary={
            "detectors": jax.tree.map(
                lambda x: np.asarray(x).tolist(), trained.outputs["detector_metrics"]
            ),
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
    seconds = sum(trained.curves[learner(config, modality)]["seconds"])
    others = {
        str(number): returns(np.asarray(total), config)
        for number, (total, _) in zip(
            config.evaluation.num_pois, trained.outputs.get(f"numbers_{modality}", ()), strict=True
        )
    }
    return {
        **policy_metrics(total, first, config),
        **({"other_numbers": others} if others else {}),
        "env_steps": env_steps,
        "env_steps_per_s": env_steps / seconds,
    }


def _as_lists(metrics: dict[str, Any]) -> dict[str, Any]:
    """The summary's block `jmvae` from the arrays of `latent_space`."""
    lists = jax.tree.map(lambda x: x.tolist(), metrics)
    lists["unambiguous"] = {
        name: [share > _UNAMBIGUOUS for share in shares]
        for name, shares in lists["unambiguous"].items()
    }
    return lists


_NAMES = ("return", "optimal", "naive", "random")


def returns(total: np.ndarray, config: Config) -> dict[str, float | None]:
    """Mean return of each of `_NAMES` from random starts, and the share of the optimal one.

    Args:
      total: `[P, S]` from `compare_policies`.
      config: all settings.
    """
    of_starts = total[:, -config.evaluation.num_starts :].mean(axis=1).tolist()
    whole = dict(zip(_NAMES, of_starts, strict=True))
    # Where no look pays, the optimum is 0.
    fraction = whole["return"] / whole["optimal"] if whole["optimal"] else None
    return {**whole, "fraction_of_optimal": fraction}


def policy_metrics(total: np.ndarray, first: np.ndarray, config: Config) -> dict[str, Any]:
    """One modality's block in the summary's `dqn`, without the speed.

    Args:
      total: `[P, S]` from `compare_policies`.
      first: `[P, S]` from `compare_policies`.
      config: all settings.
    """
    num_states = total.shape[1] - config.evaluation.num_starts
    one_step = dict(zip(_NAMES, first[:, num_states:].mean(axis=1).tolist(), strict=True))
    missed = total[_NAMES.index("optimal"), :num_states] - total[0, :num_states]
    is_optimal = missed <= 0.01
    is_permutation = episodes.are_different(
        episodes.every_state(
            config.arena.num_pois,
            len(config.arena.classes),
            len(config.modalities),
            config.evaluation.num_states,
        )[0]
    )
    return {
        **returns(total, config),
        "one_step": {
            "policy": one_step["return"],
            "optimal": one_step["optimal"],
            "random": one_step["random"],
        },
        "optimal_states": int(np.sum(is_optimal)),
        "num_states": num_states,
        "optimal_permutations": int(np.sum(is_optimal & is_permutation)),
        "num_permutations": int(np.sum(is_permutation)),
    }
