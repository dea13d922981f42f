"""A whole run: the training, the missions, and the summary of both."""

import contextlib
import dataclasses
from collections.abc import Iterator

import jax
import numpy as np

from jaxsense import mission, summary
from jaxsense.config import Config
from jaxsense.core.types import Belief, Key, Reliability
from jaxsense.dqn.episodes import has_optimum
from jaxsense.mission.outcome import require_playable
from jaxsense.models import Models
from jaxsense.run import missions
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.compilation import Compiler, Kept
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.loop import Trained, train
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import OwnPolicies, Programs
from jaxsense.summary import compare
from jaxsense.training.agents import learner
from jaxsense.training.comparison import permutations
from jaxsense.training.measures import reliability
from jaxsense.training.stages import mission_key, models


@dataclasses.dataclass(frozen=True)
class Learned:
    """The results of a training.

    Attributes:
      models: the trained networks.
      windows: for each modality `[C, window, channels]` one look at each class, from left to right.
      reliability: for each modality, see `training.measures.reliability`.
      fields_of_view: of each sensor, by modality, in degrees.
      posteriors: `[C, S', D]` beliefs of these, `joint` and for each modality.
      rewards: for each Q-network, named by its modality or `team`, the `[epochs]` mean total reward
        of the episodes that ended, `reward`, and of the learned policy of a robot that is alone on
        the map, `evaluation`; NaN in other epochs.
      results: the blocks of `summary.json` about it.
    """

    models: Models
    windows: dict[str, np.ndarray]
    fields_of_view: dict[str, float]
    reliability: dict[str, Reliability]
    posteriors: dict[str, Belief]
    rewards: dict[str, dict[str, np.ndarray]]
    results: summary.Learned


@dataclasses.dataclass(frozen=True)
class Played:
    """The results of the missions that follow a training.

    Attributes:
      recording: the first mission of the first of `config.mission.policies`.
      naive: the same mission under naive exploration, see `missions.Played`.
      missions: the block `mission` of `summary.json`.
    """

    recording: missions.Recording
    naive: missions.Recording | None
    missions: summary.Missions


@contextlib.contextmanager
def compiled(
    config: Config,
    monitor: Monitor,
    workers: Workers = ALONE,
    kept: Kept | None = None,
    trainings: int = 0,
    policies: OwnPolicies | None = None,
) -> Iterator[Programs]:
    """The programs of runs with the same settings, compiled in the background; see `Programs`.

    Keep no programs with custom policies, whose code may change.

    Raises:
      ConfigError: see `require_playable`.
    """
    require_playable(config, policies)
    with Compiler(monitor, kept) as compiler:
        yield Programs(config, compiler, workers, trainings, policies)


def learn(
    key: Key,
    config: Config,
    programs: Programs,
    monitor: Monitor,
    checkpoints: Checkpoints | None = None,
) -> Learned:
    """Trains everything and summarises it; see `loop.train`."""
    trained = train(key, config, programs, monitor, checkpoints)
    scenario = monitor.wait_for(programs.player).mission
    posteriors, latent = jax.tree.map(np.asarray, trained.outputs["latent_space"])
    detections = jax.tree.map(np.asarray, trained.outputs["detections"])
    beliefs = summary.beliefs(trained.outputs["beliefs"])
    is_sound = compare.unsound(beliefs) is None
    # Measured of a JMVAE that learns from scans, and of no other.
    grouped = {name: x for name, x in trained.outputs.items() if name == "grouped"}
    return Learned(
        models=models(trained.outputs, config),
        windows={
            sensor.name: sensor.from_left(windows[:, 0])
            for sensor, windows in zip(scenario.world.sensors, detections.windows, strict=True)
        },
        fields_of_view=scenario.fields_of_view,
        reliability=reliability(config, detections.held_out),
        posteriors=posteriors,
        rewards={
            network.removeprefix("dqn_"): {
                name: np.array(trained.curves[network][name]) for name in ("reward", "evaluation")
            }
            for network in (learner(config, n) for n in config.modalities)
        },
        results={
            "detectors": jax.tree.map(
                lambda x: np.asarray(x).tolist(), trained.outputs["detector_metrics"]
            ),
            "jmvae": summary.jmvae(vars(latent) | grouped),
            "belief": beliefs,
            "dqn": {name: _agent(config, name, trained, is_sound) for name in config.modalities},
        },
    )


def play(
    key: Key,
    config: Config,
    programs: Programs,
    learned: Learned,
    checkpoints: Checkpoints | None = None,
) -> Played:
    """Plays the missions of a run, forgets its unfinished trainings, and summarises the missions.

    Raises:
      StageError, Stopped: see `missions.Player.play`.
    """
    player, episodes = programs.player.result(), config.mission.episodes
    cases = mission.cases(config, player.mission.policies)
    played = {name: cases[name] for name in config.mission.policies}
    found = player.play(mission_key(key), learned.models, played, episodes)
    (checkpoints or Checkpoints()).forget_unfinished(stage.name for stage in programs.stages)
    block = summary.missions(player.mission, found.metrics)
    return Played(found.recording, found.naive, block)


def _agent(config: Config, modality: str, trained: Trained, is_sound: bool) -> summary.Agent:
    """One modality's block of `dqn`."""
    rewards = jax.tree.map(np.asarray, trained.outputs[f"policies_{modality}"])
    others = jax.tree.map(np.asarray, trained.outputs.get(f"numbers_{modality}", []))
    fusion, values = trained.outputs["fusion"], trained.outputs["look_values"]
    return summary.agent(
        config,
        rewards,
        permutations(config),
        trained.curves[learner(config, modality)]["seconds"],
        dict(zip(config.evaluation.num_pois, others, strict=True)),
        has_optimum(fusion, values[config.modalities.index(modality)], is_sound),
    )
