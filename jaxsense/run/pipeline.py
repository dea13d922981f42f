"""A whole run: trains stage after stage, plays the missions, and summarises both."""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed

import jax
import numpy as np
from jaxtyping import PyTree

from jaxsense import mission
from jaxsense.config.learning import LOOK_SECONDS
from jaxsense.core.types import Belief, Key, Reliability
from jaxsense.dqn.episodes import has_optimum
from jaxsense.dqn.optimum import LookValues
from jaxsense.models import Models
from jaxsense.run import devices, missions
from jaxsense.run.files import UNFINISHED, Checkpoints
from jaxsense.run.monitor import StageError, Stopped, is_finite
from jaxsense.run.programs import Programs
from jaxsense.sim import sensors
from jaxsense.summary import blocks, compare, make
from jaxsense.training import stages
from jaxsense.training.agents import learner, learners
from jaxsense.training.stage import Output, Progress, Stage, key_of

Curves = dict[str, np.ndarray]
"""`[steps]` of each metric of a training, and `[chunks]` `seconds`; NaN where it has not been."""

_SAVE_PERIOD = 60.0  # s
_MAX_THREADS = 64  # stages that run or wait at once
_ONLY_PASSED_ON = ("scenes", "survey", "examples", "views")  # let go of once no stage needs them
_SAVED = ("best_jmvae", "class_beliefs", "fusion", "look_values", "novelty")  # beside trainings


@dataclasses.dataclass(frozen=True)
class TrainingResults:
    """The results of a training.

    Attributes:
      models: the trained networks.
      windows: for each modality `[C, window, channels]` one look at each class, from left to right.
      reliability: for each modality the points of its diagram.
      posteriors: `[C, S', D]` beliefs of these, `joint` and for each modality.
      rewards: for each Q-network, named by its modality or `team`, the `[epochs]` mean total reward
        of the episodes that ended, `reward`, and of the learned policy of a robot that is alone on
        the map, `evaluation`; NaN in other epochs.
      results: the blocks of `summary.json` about it.
    """

    models: Models
    windows: dict[str, np.ndarray]
    reliability: dict[str, Reliability]
    posteriors: dict[str, Belief]
    rewards: dict[str, dict[str, np.ndarray]]
    results: blocks.TrainingBlocks


def learn(key: Key, programs: Programs, checkpoints: Checkpoints) -> TrainingResults:
    """Trains everything and summarises it; see `train`."""
    config, (outputs, curves) = programs.config, train(key, programs, checkpoints)
    posteriors, latent = jax.tree.map(np.asarray, outputs["latent_space"])
    measured, reliability = jax.tree.map(np.asarray, outputs["detector_metrics"])
    detections = jax.tree.map(np.asarray, outputs["detections"])
    beliefs: blocks.Beliefs = make.plain(dict(outputs["beliefs"]))
    is_sound = compare.unsound(beliefs) is None

    def agent(modality: str, values: Output) -> blocks.Agent:
        names = f"policies_{modality}", f"numbers_{modality}"
        rewards, others = (jax.tree.map(np.asarray, outputs.get(name, [])) for name in names)
        seconds = curves[learner(config, modality)]["seconds"].tolist()
        is_known = has_optimum(outputs["fusion"], values, is_sound)
        return make.agent(config, rewards, seconds, others, is_known)

    return TrainingResults(
        models=stages.models(outputs, config),
        windows={
            sensor.name: sensor.from_left(windows[:, 0])
            for sensor, windows in zip(sensors.make(config), detections.windows, strict=True)
        },
        reliability=reliability,
        posteriors=posteriors,
        rewards={
            network.removeprefix("dqn_"): {
                name: curves[network][name] for name in ("reward", "evaluation")
            }
            for network in learners(config)
        },
        results={
            "detectors": make.plain(measured),
            "jmvae": make.plain(latent),
            "belief": beliefs,
            "dqn": {
                name: agent(name, values)
                for name, values in zip(config.modalities, outputs["look_values"], strict=True)
            },
        },
    )


def play(
    key: Key, programs: Programs, learned: TrainingResults, checkpoints: Checkpoints
) -> tuple[missions.Played, blocks.Missions]:
    """Plays the missions of a run, forgets its unfinished trainings, and summarises the missions.

    Raises:
      StageError, Stopped: see `missions.Player.play`.
    """
    player = programs.monitor.wait_for(programs.player)
    settings = programs.config.mission
    cases = mission.cases(programs.config, player.mission.policies)
    of_run = {name: cases[name] for name in settings.policies}
    played = player.play(key_of(key, "mission"), learned.models, of_run, settings.episodes)
    checkpoints.forget_unfinished(stage.name for stage in programs.stages)
    return played, make.missions(programs.config, played.metrics)


def train(
    key: Key, programs: Programs, checkpoints: Checkpoints
) -> tuple[dict[str, Output], dict[str, Curves]]:
    """Runs all stages; independent ones run side by side.

    Args:
      key: the only source of randomness.
      programs: of the stages, with the settings; their monitor receives time and progress.
      checkpoints: where to save. Stages found there, which must come from the same key and
        settings, are not trained again.

    Returns:
      Outputs and curves of the stages.

    Raises:
      StageError: if a loss, parameter or result is not finite; trainings under way are saved as
        they were before.
      Stopped: if the monitor was asked to stop; trainings under way are saved.
      OSError: if a checkpoint cannot be written.
    """
    training = _Training(key, programs, checkpoints)
    outputs = dict[str, Future[Output]]()
    with ThreadPoolExecutor(_MAX_THREADS, "stage") as threads:

        def drive(stage: Stage, **inputs: Output) -> Future[Output]:
            outputs[stage.name] = threads.submit(training.run, stage, inputs)
            return outputs[stage.name]

        stages.train(drive, programs.config)
        done = as_completed([*outputs.values()])
        kept = {name: x for name, x in outputs.items() if name not in _ONLY_PASSED_ON}
        outputs.clear()
        for _ in done:
            devices.give_back_freed()
    programs.monitor.check_stop()
    return {name: output.result() for name, output in kept.items()}, training.curves


@dataclasses.dataclass(frozen=True)
class _Training:
    """What the stages of a training share."""

    key: Key
    programs: Programs
    checkpoints: Checkpoints
    curves: dict[str, Curves] = dataclasses.field(default_factory=dict)

    def run(self, stage: Stage, inputs: dict[str, PyTree[Future[Output]]]) -> Output:
        """The output of a stage, loaded if it was saved."""
        is_saved = bool(stage.chunks) or stage.name in _SAVED
        try:
            if is_saved and (found := self._load(stage)) is not None:
                return found
            output = self._execute(stage, inputs)
            if stage.chunks:
                self.checkpoints.save(f"curves_{stage.name}", self.curves[stage.name])
            if is_saved:
                self.checkpoints.save(stage.name, output)
            if stage.name == "look_values":
                self._check_prices(output)
            return output
        except BaseException as error:
            if not isinstance(error, Stopped):
                self.programs.monitor.fail(error)
            raise
        finally:
            self.programs.used(stage)

    def _execute(self, stage: Stage, inputs: dict[str, PyTree[Future[Output]]]) -> Output:
        """The output of a stage that was not saved."""
        given = jax.tree.map(lambda x: x.result() if isinstance(x, Future) else x, inputs)
        self.programs.monitor.check_stop()
        if stage.chunks:
            output = self._train(stage, given)
        else:
            output = stage.finish(self.programs.config, self._begin(stage, given), **given)
            # Joined rows lie on the host, and every program would transfer them again.
            output = jax.device_put(output)
        if not is_finite(output):
            told = f"{stage.name}: results are not finite"
            if not stage.is_optional:
                raise StageError(told)
            self.programs.monitor.warn(f"{told}: left out")
        return output

    def _check_prices(self, values: tuple[LookValues, ...]) -> None:
        """Tells if no look is worth what it costs."""
        config = self.programs.config
        cost = config.team.second_cost * LOOK_SECONDS if config.dqn.task == "team" else 0.0
        if max(np.max(np.append(each.q, each.q_unseen)) for each in values) <= cost:
            self.programs.monitor.warn("no look pays: lower what it costs, or mdp.min_increase")

    def _begin(self, stage: Stage, inputs: dict[str, Output]) -> Output:
        """The first state."""
        return self.programs.of(stage).begin(stage.key(self.key), self.programs.config, inputs)

    def _train(self, stage: Stage, inputs: dict[str, Output]) -> Output:
        """The output of a stage with steps."""
        programs, config = self.programs.of(stage), self.programs.config
        keys = stage.chunk_keys(self.key)
        # The rate must not include compilation.
        programs.advance.wait()

        def advance(chunk: int, state: Output) -> tuple[Output, Curves]:
            begin = time.perf_counter()
            state, progress = programs.advance(keys[chunk], config, state, inputs)
            seconds = np.array([time.perf_counter() - begin])
            return state, {**self._report(stage, chunk, progress), "seconds": seconds}

        # Nobody but `_run_chunks` holds the first state, so that it can let go of it.
        state = self._run_chunks(stage, self._begin(stage, inputs), advance)
        return programs.finish(config, state, inputs)

    def _run_chunks(
        self, stage: Stage, state: Output, run: Callable[[int, Output], tuple[Output, Curves]]
    ) -> Output:
        """Runs a training from where it was last saved; saves it once a minute, and when it stops.

        Args:
          stage: with chunks.
          state: first state.
          run: `(chunk, state) -> (state, metrics)`. The state before a `StageError` is saved.

        Returns:
          The last state.
        """
        name, curves = f"{UNFINISHED}/{stage.name}", self._no_curves(stage)

        def save(state: Output) -> None:
            self.checkpoints.save(name, {"state": state, "curves": curves})

        if found := self.checkpoints.load_or_forget(name, {"state": state, "curves": curves}):
            state, curves = found["state"], jax.tree.map(np.array, found["curves"])
        saved = time.monotonic()
        for chunk in range(np.count_nonzero(np.isfinite(curves["seconds"])), stage.chunks):
            try:
                after, metrics = run(chunk, state)
            except StageError as error:
                try:
                    save(state)
                except OSError as lost:
                    reason = f"{error}; cannot save the last finite state ({lost})"
                    raise StageError(reason) from error
                raise
            state = after
            for metric, values in metrics.items():
                first = chunk * -(-len(curves[metric]) // stage.chunks)
                curves[metric][first : first + len(values)] = values
            if time.monotonic() - saved > _SAVE_PERIOD or self.programs.monitor.is_stopping:
                save(state)
                saved = time.monotonic()
            if chunk + 1 < stage.chunks:
                self.programs.monitor.check_stop()
        self.curves[stage.name] = curves
        return state

    def _report(self, stage: Stage, chunk: int, progress: Progress) -> Curves:
        """Reports a chunk and returns the steps' metrics.

        Raises:
          StageError: if a loss is not finite, or the parameters after the last step, whose loss is
            not finite then, see `supervised.fit` and `dqn.train_chunk`.
        """
        size = len(progress.loss)
        done = min((chunk + 1) * size, stage.steps)
        losses, metrics = jax.tree.map(
            lambda x: np.asarray(x)[: done - chunk * size], (progress.loss, progress.metrics)
        )
        bad = np.flatnonzero(~np.isfinite(losses))
        if len(bad) and not stage.is_optional:
            where = f"at step {chunk * size + bad[0] + 1} of {stage.steps}"
            raise StageError(f"{stage.name}: loss = {losses[bad[0]]} {where}")
        means = {
            name: float(np.mean(values[np.isfinite(values)]))
            for name, values in {"loss": losses, **metrics}.items()
            if np.isfinite(values).any()
        }
        self.programs.monitor.progress(stage.name, done, stage.steps, **means)
        return metrics

    def _load(self, stage: Stage) -> Output:
        """The saved output of a finished stage; None if there is none."""
        if stage.chunks:
            curves = self.checkpoints.load_or_forget(f"curves_{stage.name}", self._no_curves(stage))
            if curves is None:
                return None
            self.curves[stage.name] = curves
        output = self.programs.of(stage).output
        return self.checkpoints.load_or_forget(stage.name, output, not stage.is_optional)

    def _no_curves(self, stage: Stage) -> Curves:
        """The curves of a training that has not begun."""
        lengths = dict.fromkeys(self.programs.of(stage).metrics, stage.steps)
        lengths["seconds"] = stage.chunks
        return {name: np.full(length, np.nan, np.float32) for name, length in lengths.items()}
