"""The stages of a run, one after the other: each takes a key, inputs and settings.

Stages run on the host and call compiled programs; between two chunks of work they report to a
`Monitor`, so that nothing calls back from inside a compiled loop.
"""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np
from flax import struct
from jax.sharding import Mesh

from jaxsense import examine, mission
from jaxsense.compilation import Compiler, Kept
from jaxsense.config import MODALITIES, Config
from jaxsense.models import Models
from jaxsense.monitor import Monitor
from jaxsense.networks import Params
from jaxsense.programs import (
    Programs,
    Surveys,
    compile_programs,
    num_chunks,
    num_held_out_per_class,
    num_scene_starts,
    num_scenes,
)
from jaxsense.sim.world import Scene, make_world
from jaxsense.types import Belief, Key
from jaxsense.vae.detectors import Detector

T = TypeVar("T")


@struct.dataclass
class Detections:
    """What the detectors make of surveys that they were not trained on.

    Attributes:
      train: for each modality a `[C, S, D_m]` bank for training.
      held_out: the same from other scenes, for measuring.
      starts: classes, scenes and `[S, N, D_m]` features for each modality, in which episodes start.
      accuracy: for each modality, on held-out looks.
      windows: for each modality `[C, 1, F]` one look at each class.
    """

    train: tuple[np.ndarray, ...]
    held_out: tuple[np.ndarray, ...]
    starts: tuple[np.ndarray, Scene, tuple[np.ndarray, ...]]
    accuracy: dict[str, float]
    windows: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run leaves.

    Attributes:
      models: the trained networks.
      windows: for each modality `[C, 1, F]` one look at each class.
      posteriors: for each set of modalities, `[C, S', D]` beliefs of held-out detections.
      rewards: for each modality `[epochs]` mean total reward of the episodes that ended; NaN where
        none did.
      recording: the first mission of the latent policy.
      summary: the blocks `detectors`, `jmvae`, `dqn` and `mission` of `summary.json`.
    """

    models: Models
    windows: dict[str, np.ndarray]
    posteriors: dict[str, Belief]
    rewards: dict[str, np.ndarray]
    recording: mission.Recording
    summary: dict[str, Any]


def run(
    key: Key,
    config: Config,
    monitor: Monitor,
    keep: Callable[[str, Any], None] = lambda name, tree: None,
    mesh: Mesh | None = None,
    learner_mesh: Mesh | None = None,
    kept: Kept | None = None,
) -> RunResult:
    """All stages.

    Args:
      key: the only source of randomness.
      config: all settings.
      monitor: is told of time and progress.
      keep: `(stage, parameters)`, called as soon as a stage has been trained.
      mesh: devices that simulations are split over; the first one alone if not given.
      learner_mesh: devices that the environments of Q-learning are split over, likewise.
      kept: where compiled programs are kept for later runs, if anywhere.

    Returns:
      The trained networks and their figures.

    Raises:
      StageError: if a loss is not finite.
    """
    with Compiler(monitor, kept) as compiler:
        programs = compile_programs(config, make_world(config), compiler, mesh, learner_mesh)
        return _run(key, config, programs, monitor, keep)


def _run(
    key: Key,
    config: Config,
    programs: Programs,
    monitor: Monitor,
    keep: Callable[[str, Any], None],
) -> RunResult:
    """The stages, with their programs."""
    saver = ThreadPoolExecutor(1)
    saved: list[Future] = []

    def keep_soon(name: str, tree: Any) -> None:
        saved.append(saver.submit(keep, name, tree))

    names = config.modalities
    survey_key, detector_key, jmvae_key, mission_key, *dqn_keys = _keys(key, 4 + len(names))
    surveys = jax.tree.map(np.asarray, programs.simulate(survey_key))
    trained, detections = train_detectors(detector_key, surveys, config, programs, monitor)
    keep_soon("detectors", trained)

    params = train_jmvae(jmvae_key, detections.train, config, programs, monitor)
    keep_soon("jmvae", params)
    posteriors, jmvae_figures = programs.examine_jmvae(params, detections.held_out)
    class_beliefs = jax.tree.map(lambda x: np.asarray(x).mean(axis=1), posteriors["joint"])
    keep_soon("class_beliefs", class_beliefs)

    def train_and_examine(modality: int):
        name = names[modality]
        train_key, examine_key = _keys(dqn_keys[modality], 2)
        q_network, rewards, speed = train_dqn(
            train_key, modality, trained, params, detections, config, programs, monitor
        )
        keep_soon(f"dqn_{name}", q_network)
        inputs = modality, q_network, params, detections, config, programs
        return q_network, rewards, {**examine_dqn(examine_key, *inputs), **speed}

    q_networks, rewards, dqn_figures = zip(
        *_side_by_side(train_and_examine, len(names)), strict=True
    )
    models = Models(trained, params, class_beliefs, q_networks)
    played = {n: case for n, case in mission.cases(config).items() if n in mission.POLICIES}
    player, episodes = programs.player.result(), config.mission.episodes
    missions = mission.summary(mission_key, player, models, played, episodes)
    assert player.recording is not None
    for each in saved:
        each.result()
    return RunResult(
        models=models,
        windows=detections.windows,
        posteriors=posteriors,
        rewards=dict(zip(names, rewards, strict=True)),
        recording=player.recording,
        summary={
            "detectors": {m: {"accuracy": a} for m, a in detections.accuracy.items()},
            "jmvae": _as_lists(jmvae_figures),
            "dqn": dict(zip(names, dqn_figures, strict=True)),
            "mission": missions,
        },
    )


def _keys(key: Key, number: int) -> list[Key]:
    """Different keys, as from `jax.random.split`, which would compile anew for each number."""
    return [jax.random.fold_in(key, i) for i in range(number)]


def _side_by_side(function: Callable[[int], T], number: int) -> list[T]:
    """`function(0)`, `function(1)` and so on, each in a thread: one alone leaves cores idle."""
    with ThreadPoolExecutor(number) as executor:
        return list(executor.map(function, range(number)))


def train_detectors(
    key: Key, surveys: Surveys, config: Config, programs: Programs, monitor: Monitor
) -> tuple[tuple[Detector, ...], Detections]:
    """Trains the detectors on some of the surveys and applies them to the others."""
    num_train, num_bank, _ = num_scenes(config)
    keys = _keys(key, len(config.modalities))

    def train(modality: int) -> Detector:
        stage = f"detector_{config.modalities[modality]}"
        steps = config.detector.steps
        init_key, *chunk_keys = _keys(keys[modality], 1 + num_chunks(steps))
        windows = surveys.windows[modality][:num_train]
        windows = jax.device_put(windows.reshape(-1, windows.shape[-1]))
        labels = _labels(config, modality)[surveys.classes[:num_train]].reshape(-1)
        detector, state = programs.begin_detectors[modality](init_key, windows)
        for i, chunk_key in enumerate(chunk_keys):
            inputs = chunk_key, state, detector, windows, labels
            state, losses = programs.train_detectors[modality](*inputs)
            done = (i + 1) * steps // len(chunk_keys)
            monitor.report(stage, done, steps, np.asarray(losses))
        monitor.check_finite(stage, state.params)
        return dataclasses.replace(detector, params=state.params)

    trained = tuple(_side_by_side(train, len(config.modalities)))
    others = jax.tree.map(lambda x: x[num_train:], surveys)
    features = jax.tree.map(np.asarray, programs.detect(trained, others.windows))
    is_bank = np.arange(len(others.classes)) < num_bank

    def by_class(values: np.ndarray, chosen: np.ndarray, number: int) -> np.ndarray:
        classes = others.classes[chosen]
        return np.stack(
            [values[chosen][classes == c][:number] for c in range(len(config.arena.classes))]
        )

    held_out = tuple(by_class(f, ~is_bank, num_held_out_per_class(config)) for f in features)
    accuracy = {
        name: float(np.mean(looks.argmax(axis=-1) == _labels(config, m)[:, None]))
        for m, (name, looks) in enumerate(zip(config.modalities, held_out, strict=True))
    }
    number = num_scene_starts(config)
    detections = Detections(
        train=tuple(by_class(f, is_bank, config.jmvae.samples_per_class) for f in features),
        held_out=held_out,
        starts=jax.tree.map(lambda x: x[:number], (others.classes, others.scenes, features)),
        accuracy=accuracy,
        windows={
            name: by_class(windows, ~is_bank, 1)
            for name, windows in zip(config.modalities, others.windows, strict=True)
        },
    )
    return trained, detections


def _labels(config: Config, modality: int) -> np.ndarray:
    """`[C]` int32 what a modality detects of each class."""
    name = config.modalities[modality]
    return np.array(config.arena.label_of_class(MODALITIES[name]), np.int32)


def train_jmvae(
    key: Key, bank: tuple[np.ndarray, ...], config: Config, programs: Programs, monitor: Monitor
) -> Params:
    """Trains JMVAEs on a bank of detections and keeps the one with the lowest loss at the end."""
    settings = config.jmvae
    num_keys = 1 + num_chunks(settings.steps)
    keys = [_keys(of_restart, num_keys) for of_restart in _keys(key, settings.restarts)]
    states = [programs.begin_jmvae(of_restart[0]) for of_restart in keys]
    losses = np.zeros((settings.restarts, 1))
    for i in range(1, num_keys):

        def train(restart: int):
            return programs.train_jmvae(keys[restart][i], states[restart], bank)  # noqa: B023

        # On a CPU a batch of small networks takes longer than one after the other.
        states, losses = zip(*_side_by_side(train, settings.restarts), strict=True)
        losses = np.stack(losses)
        done = i * settings.steps // (num_keys - 1)
        # The worst loss, so that a restart that fails does not go unnoticed.
        monitor.report("jmvae", done, settings.steps, losses.max(axis=0))
    best = int(losses.mean(axis=1).argmin())
    params = jax.tree.map(np.asarray, states[best].params)
    monitor.check_finite("jmvae", params)
    return params


def train_dqn(
    key: Key,
    modality: int,
    trained: tuple[Detector, ...],
    params: Params,
    detections: Detections,
    config: Config,
    programs: Programs,
    monitor: Monitor,
) -> tuple[Params, np.ndarray, dict[str, float]]:
    """Trains the Q-network of one modality.

    Returns:
      Its parameters, the `[epochs]` mean total reward of the episodes that ended, NaN where none
      did, and the figures `env_steps` and `env_steps_per_s`.
    """
    settings, stage = config.dqn, f"dqn_{config.modalities[modality]}"
    num_chunks = settings.epochs // settings.chunk
    start_key, init_key, *chunk_keys = _keys(key, 2 + num_chunks)
    models = trained, params, detections.train
    prepared = programs.start_dqn(start_key, detections.starts, *models)
    state = programs.begin_dqn(init_key, prepared, *models)
    rewards, seconds = [], 0.0
    for i, chunk_key in enumerate(chunk_keys):
        inputs = chunk_key, np.int32(modality), state, prepared, *models
        begin = time.perf_counter()
        state, info = programs.train_dqn(*inputs)
        seconds += time.perf_counter() - begin
        episodes, ended = np.asarray(info.episodes), np.asarray(info.episode_return)
        rewards.append(np.where(episodes > 0, ended, np.nan))
        monitor.report(
            stage,
            (i + 1) * settings.chunk,
            settings.epochs,
            np.asarray(info.loss),
            reward=float(np.average(ended, weights=np.maximum(episodes, 1e-9))),
            epsilon=float(info.epsilon[-1]),
        )
    monitor.check_finite(stage, state.params)
    env_steps = settings.epochs * settings.num_envs
    speed = {"env_steps": env_steps, "env_steps_per_s": env_steps / seconds}
    return jax.tree.map(np.asarray, state.params), np.concatenate(rewards), speed


def examine_dqn(
    key: Key,
    modality: int,
    q_network: Params,
    params: Params,
    detections: Detections,
    config: Config,
    programs: Programs,
) -> dict[str, Any]:
    """Plays whole episodes with a trained policy and those to compare it with.

    Returns:
      The block of one modality in the summary's `dqn`, without the speed.
    """
    inputs = np.int32(modality), q_network, params, detections.held_out
    total, first = programs.examine_dqn(key, *inputs)
    num_random = config.evaluation.num_starts
    return examine.policy_figures(np.asarray(total), np.asarray(first), num_random)


def _as_lists(figures: dict[str, Any]) -> dict[str, Any]:
    """The summary's block `jmvae` from the arrays of `examine.latent_space`."""
    lists = jax.tree.map(lambda x: x.tolist(), figures)
    lists["unambiguous"] = {
        name: [share > 0.9 for share in shares] for name, shares in lists["unambiguous"].items()
    }
    return lists
