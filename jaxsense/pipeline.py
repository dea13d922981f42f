"""The stages of a run, one after the other: each takes a key, inputs and settings.

Stages run on the host and call compiled programs; between two chunks of work they report to a
`Monitor`, so that nothing calls back from inside a compiled loop.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh

from jaxsense import examine, mission
from jaxsense.checkpoints import Checkpoints, Curves
from jaxsense.chunks import run_chunks
from jaxsense.compilation import Compiler, Kept
from jaxsense.config import Config
from jaxsense.detections import Detections, detect, labels_of_classes
from jaxsense.devices import ALONE, Workers, side_by_side
from jaxsense.models import Models, untrained
from jaxsense.monitor import Monitor, Stopped, is_finite
from jaxsense.networks import Params
from jaxsense.programs import (
    Programs,
    Surveys,
    best_restart,
    chunks_of,
    compile_programs,
    keys_of,
    num_scenes,
    survey_rows,
)
from jaxsense.sim.world import make_world
from jaxsense.types import Belief, Key
from jaxsense.vae.detectors import Detector

T = TypeVar("T")


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


@contextlib.contextmanager
def compiled(
    config: Config,
    monitor: Monitor,
    workers: Workers = ALONE,
    learner_mesh: Mesh | None = None,
    kept: Kept | None = None,
) -> Iterator[Programs]:
    """The programs of runs with the same settings, compiled in the background.

    Args:
      config: all settings.
      monitor: is told how long it takes.
      workers: who shares simulations.
      learner_mesh: devices that the environments of Q-learning are split over; the first one alone
        if not given.
      kept: where compiled programs are kept for later runs, if anywhere.
    """
    with Compiler(monitor, kept) as compiler:
        yield compile_programs(config, make_world(config), compiler, workers, learner_mesh)


def run(
    key: Key,
    config: Config,
    programs: Programs,
    monitor: Monitor,
    checkpoints: Checkpoints | None = None,
) -> RunResult:
    """All stages.

    Args:
      key: the only source of randomness.
      config: all settings.
      programs: from `compiled`, with the same settings and monitor.
      monitor: is told of time and progress.
      checkpoints: where what is trained is saved, if anywhere; what is there already, from the same
        key and settings, is not trained again.

    Returns:
      The trained networks and their figures.

    Raises:
      StageError: if something is not finite; trainings under way have been saved as they were
        before.
      Stopped: if the monitor was told to stop; trainings under way have been saved.
      OSError: if a checkpoint cannot be written.
    """
    checkpoints = checkpoints or Checkpoints()
    with ThreadPoolExecutor(1) as saver:
        stages = Stages(config, programs, monitor, checkpoints, saver)
        try:
            result = stages.run(key)
        except Stopped:
            # Who is told that all is saved must be told if it is not.
            stages.wait_for_saving()
            raise
        stages.wait_for_saving()
    checkpoints.forget_unfinished()
    return result


class Stages:
    """The stages of a run, and what they have in common."""

    def __init__(
        self,
        config: Config,
        programs: Programs,
        monitor: Monitor,
        checkpoints: Checkpoints,
        saver: ThreadPoolExecutor,
    ):
        self._config, self._programs, self._monitor = config, programs, monitor
        self._checkpoints, self._saver = checkpoints, saver
        self._shapes = jax.eval_shape(lambda: untrained(jax.random.key(0), config))
        self._saving: list[Future[None]] = []

    def run(self, key: Key) -> RunResult:
        """All stages."""
        config, programs, names = self._config, self._programs, self._config.modalities
        survey_key, detector_key, jmvae_key, mission_key, *dqn_keys = keys_of(key, 4 + len(names))
        surveys = self.survey(survey_key)
        trained = self._once(
            "detectors",
            self._shapes.detectors,
            lambda: self.train_detectors(detector_key, surveys),
        )
        detections = detect(programs, trained, surveys, config)
        features = detections.train, detections.held_out, detections.starts[2]
        self._monitor.check_finite("detect", "features", features)
        params = self._once(
            "jmvae", self._shapes.jmvae, lambda: self.train_jmvae(jmvae_key, detections.train)
        )
        posteriors, jmvae_figures = programs.examine_jmvae(params, detections.held_out)
        class_beliefs = jax.tree.map(lambda x: np.asarray(x).mean(axis=1), posteriors["joint"])
        self._monitor.check_finite("evaluate_jmvae", "class beliefs", class_beliefs)
        self._monitor.check_finite("evaluate_jmvae", "posteriors", posteriors)
        self._monitor.check_finite("evaluate_jmvae", "figures", jmvae_figures)
        self._save("class_beliefs", class_beliefs)

        def train_and_examine(modality: int):
            train_key, examine_key = keys_of(dqn_keys[modality], 2)
            q_network, curves = self.train_dqn(train_key, modality, trained, params, detections)
            figures = self.examine_dqn(examine_key, modality, q_network, params, detections)
            return q_network, curves, {**figures, **_speed(config, curves)}

        q_networks, curves, dqn_figures = zip(
            *side_by_side(train_and_examine, len(names)), strict=True
        )
        self._monitor.check_stop()
        models = Models(trained, params, class_beliefs, q_networks)
        played = {n: case for n, case in mission.cases(config).items() if n in mission.POLICIES}
        player, episodes = programs.player.result(), config.mission.episodes
        missions = mission.summary(mission_key, player, models, played, episodes)
        assert player.recording is not None
        return RunResult(
            models=models,
            windows=detections.windows,
            posteriors=posteriors,
            rewards={n: np.array(c["reward"]) for n, c in zip(names, curves, strict=True)},
            recording=player.recording,
            summary={
                "detectors": {m: {"accuracy": a} for m, a in detections.accuracy.items()},
                "jmvae": as_lists(jmvae_figures),
                "dqn": dict(zip(names, dqn_figures, strict=True)),
                "mission": missions,
            },
        )

    def wait_for_saving(self) -> None:
        """Waits until all is saved; raises the first error."""
        for each in self._saving:
            each.result()

    def survey(self, key: Key) -> Surveys:
        """Looks at every PoI of all scenes, on the host."""
        simulate, total = self._programs.simulate, sum(num_scenes(self._config))
        found = simulate(key, survey_rows(self._config, simulate.num_workers))
        surveys = jax.tree.map(lambda x: np.asarray(x)[:total], found)
        self._monitor.check_finite("simulate", "scans", surveys.windows)
        self._monitor.check_stop()
        return surveys

    def train_detectors(self, key: Key, surveys: Surveys) -> tuple[Detector, ...]:
        """Trains the detectors on some of the surveys."""
        config, settings = self._config, self._config.detector
        num_train, (number, size) = num_scenes(config)[0], chunks_of(settings.steps)
        keys = keys_of(key, len(config.modalities))

        def train(modality: int) -> Detector:
            stage = f"detector_{config.modalities[modality]}"
            init_key, *chunk_keys = keys_of(keys[modality], 1 + number)
            windows = surveys.windows[modality][:num_train]
            windows = jax.device_put(windows.reshape(-1, windows.shape[-1]))
            labels = labels_of_classes(config, modality)[surveys.classes[:num_train]].reshape(-1)
            detector, state = self._programs.begin_detectors[modality](init_key, windows)
            step = self._programs.train_detectors[modality]

            def train_chunk(i: int, state: Any) -> tuple[Any, Curves]:
                state, losses = step(chunk_keys[i], state, detector, windows, labels)
                done = min((i + 1) * size, settings.steps)
                losses = np.asarray(losses)[: done - i * size]
                self._monitor.report(stage, done, settings.steps, losses, state.params)
                return state, {}

            state, _ = self._in_chunks(stage, state, number, train_chunk)
            return dataclasses.replace(detector, params=state.params)

        return tuple(side_by_side(train, len(config.modalities)))

    def train_jmvae(self, key: Key, bank: tuple[np.ndarray, ...]) -> Params:
        """Trains JMVAEs on a bank of detections and keeps the one with the lowest last losses."""
        settings, step = self._config.jmvae, self._programs.train_jmvae
        number, size = chunks_of(settings.steps)
        keys = [keys_of(of_restart, 1 + number) for of_restart in keys_of(key, settings.restarts)]
        states = [self._programs.begin_jmvae(of_restart[0]) for of_restart in keys]
        failed: set[int] = set()

        def train_chunk(i: int, states: Any) -> tuple[Any, Curves]:
            # On a CPU a batch of small networks takes longer than one after the other.
            states, losses = zip(
                *side_by_side(lambda r: step(keys[r][1 + i], states[r], bank), len(keys)),
                strict=True,
            )
            done = min((i + 1) * size, settings.steps)
            losses = np.stack(losses)[:, : done - i * size]
            sound = [r for r in range(len(keys)) if is_finite((losses[r], states[r].params))]
            for r in set(range(len(keys))) - {*sound, *failed} if sound else ():
                failed.add(r)
                self._monitor.warn(f"jmvae: restart {r} is not finite by step {done}: left out")
            # The worst loss of those that go on; if there is none, this raises.
            chosen = sound or range(len(keys))
            worst = losses[list(chosen)].max(axis=0)
            params = [states[r].params for r in chosen]
            self._monitor.report("jmvae", done, settings.steps, worst, params)
            return list(states), {str(r): x.tolist() for r, x in enumerate(losses)}

        states, losses = self._in_chunks("jmvae", states, number, train_chunk)
        best = best_restart(np.array([losses[str(r)] for r in range(len(keys))]), settings)
        return jax.tree.map(np.asarray, states[int(best)].params)

    def train_dqn(
        self,
        key: Key,
        modality: int,
        trained: tuple[Detector, ...],
        params: Params,
        detections: Detections,
    ) -> tuple[Params, Curves]:
        """Trains the Q-network of one modality.

        Returns:
          Its parameters and two curves: `reward`, for each epoch the mean total reward of the
          episodes that ended, NaN where none did, and `seconds` of each chunk of epochs.
        """
        settings, name = self._config.dqn, self._config.modalities[modality]
        stage, number = f"dqn_{name}", settings.epochs // settings.chunk
        curves_shape = {
            "reward": np.zeros(settings.epochs, np.float32),
            "seconds": np.zeros(number, np.float32),
        }
        q_network = self._checkpoints.load_or_forget(stage, self._shapes.q_networks[modality])
        curves = self._checkpoints.load_or_forget(f"curves_{name}", curves_shape)
        if q_network is not None and curves is not None:
            return q_network, {name: curve.tolist() for name, curve in curves.items()}
        start_key, init_key, *chunk_keys = keys_of(key, 2 + number)
        models = trained, params, detections.train
        prepared = self._programs.start_dqn(start_key, detections.starts, *models)

        # The rate is that of training, without the compilation.
        self._programs.train_dqn.wait()

        def train_chunk(i: int, state: Any) -> tuple[Any, Curves]:
            begin = time.perf_counter()
            inputs = chunk_keys[i], np.int32(modality), state, prepared, *models
            state, info = self._programs.train_dqn(*inputs)
            seconds = time.perf_counter() - begin
            episodes, ended = np.asarray(info.episodes), np.asarray(info.episode_return)
            self._monitor.report(
                stage,
                (i + 1) * settings.chunk,
                settings.epochs,
                np.where(info.is_finite, info.loss, np.nan),
                state.params,
                reward=float(np.average(ended, weights=np.maximum(episodes, 1e-9))),
                epsilon=float(info.epsilon[-1]),
            )
            reward = np.where(episodes > 0, ended, np.nan)
            return state, {"reward": reward.tolist(), "seconds": [seconds]}

        state = self._programs.begin_dqn(init_key, prepared, *models)
        state, curves = self._in_chunks(stage, state, number, train_chunk)
        q_network = jax.tree.map(np.asarray, state.params)
        self._save(stage, q_network)
        self._save(
            f"curves_{name}", {n: np.asarray(curve, np.float32) for n, curve in curves.items()}
        )
        return q_network, curves

    def examine_dqn(
        self,
        key: Key,
        modality: int,
        q_network: Params,
        params: Params,
        detections: Detections,
    ) -> dict[str, Any]:
        """Plays whole episodes with a trained policy and those to compare it with.

        Returns:
          The block of one modality in the summary's `dqn`, without the speed.
        """
        inputs = np.int32(modality), q_network, params, detections.held_out
        total, first = self._programs.examine_dqn(key, *inputs)
        stage = f"evaluate_dqn_{self._config.modalities[modality]}"
        self._monitor.check_finite(stage, "rewards", (total, first))
        num_random = self._config.evaluation.num_starts
        return examine.policy_figures(np.asarray(total), np.asarray(first), num_random)

    def _once(self, name: str, shapes: T, train: Callable[[], T]) -> T:
        """What is saved under a name; trained and saved if it is not."""
        found = self._checkpoints.load_or_forget(name, shapes)
        if found is not None:
            return found
        trained = train()
        self._save(name, trained)
        return trained

    def _save(self, name: str, tree: Any) -> None:
        """Saves something finished, while the run goes on; raises if that failed before."""
        for each in self._saving:
            if each.done():
                each.result()
        if self._checkpoints.path is not None:
            self._saving.append(self._saver.submit(self._checkpoints.save, name, tree))

    def _in_chunks(
        self, stage: str, state: Any, number: int, run: Callable[[int, Any], tuple[Any, Curves]]
    ) -> tuple[Any, Curves]:
        """See `chunks.run_chunks`."""
        return run_chunks(stage, state, number, run, self._monitor, self._checkpoints)


def _speed(config: Config, curves: Curves) -> dict[str, float]:
    """The figures `env_steps` and `env_steps_per_s` of a training."""
    env_steps = config.dqn.epochs * config.dqn.num_envs
    return {"env_steps": env_steps, "env_steps_per_s": env_steps / sum(curves["seconds"])}


def as_lists(figures: dict[str, Any]) -> dict[str, Any]:
    """The summary's block `jmvae` from the arrays of `examine.latent_space`."""
    lists = jax.tree.map(lambda x: x.tolist(), figures)
    lists["unambiguous"] = {
        name: [share > 0.9 for share in shares] for name, shares in lists["unambiguous"].items()
    }
    return lists
