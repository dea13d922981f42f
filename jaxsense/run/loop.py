"""Drives a training from the host: stage after stage, chunk after chunk."""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import jax
import numpy as np
from jaxtyping import PyTree

from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.run import devices
from jaxsense.run.checkpoints import Checkpoints, Curves, Unfinished
from jaxsense.run.monitor import Monitor, StageError, Stopped
from jaxsense.run.programs import Programs
from jaxsense.training import stages
from jaxsense.training.stage import Output, Progress, Stage

_SAVE_PERIOD = 60.0  # s
_MAX_THREADS = 64  # stages that run or wait at once
_ONLY_PASSED_ON = ("scenes", "survey", "examples", "views")  # let go of once no stage needs them
_SAVED = ("best_jmvae", "class_beliefs", "fusion", "look_values", "novelty")  # beside trainings


@dataclasses.dataclass(frozen=True)
class Trained:
    """Outputs of stages, and curves: `[steps]` of each metric, and `seconds` of each chunk."""

    outputs: dict[str, Output]
    curves: dict[str, Curves]


def train(
    key: Key,
    config: Config,
    programs: Programs,
    monitor: Monitor,
    checkpoints: Checkpoints | None = None,
) -> Trained:
    """Runs all stages; independent ones run side by side.

    Args:
      key: the only source of randomness.
      config: all settings; its `Traced` fields are inputs of the programs.
      programs: of the stages.
      monitor: receives time and progress.
      checkpoints: where to save, if anywhere. Stages found there, which must come from the same key
        and settings, are not trained again.

    Raises:
      StageError: if a loss, parameter or result is not finite; trainings under way are saved as
        they were before.
      Stopped: if the monitor was asked to stop; trainings under way are saved.
      OSError: if a checkpoint cannot be written.
    """
    with ThreadPoolExecutor(1, "save") as saver:
        loop = _Loop(key, config, programs, monitor, checkpoints or Checkpoints(), saver)
        try:
            return loop.run()
        except Stopped:
            # The user was told that all is saved; raise if it is not.
            loop.wait_for_saving()
            raise


@dataclasses.dataclass
class _Loop:
    """One training."""

    key: Key
    config: Config
    programs: Programs
    monitor: Monitor
    checkpoints: Checkpoints
    saver: ThreadPoolExecutor
    saving: list[Future[None]] = dataclasses.field(default_factory=list)
    curves: dict[str, Curves] = dataclasses.field(default_factory=dict)

    def run(self) -> Trained:
        """Runs all stages."""
        begun: dict[str, Future[Output]] = {}
        with ThreadPoolExecutor(_MAX_THREADS, "stage") as threads:

            def drive(stage: Stage, **inputs: Output) -> Future[Output]:
                begun[stage.name] = threads.submit(self._run_stage, stage, inputs)
                return begun[stage.name]

            stages.train(drive, self.config, self.programs.arena)
            kept = {name: x for name, x in begun.items() if name not in _ONLY_PASSED_ON}
            left = set(begun.values())
            begun.clear()
            while left:
                # A wait without timeout may not notice Ctrl-C.
                done, left = wait(left, timeout=0.2)
                if done:
                    done.clear()  # lets go of outputs
                    devices.give_back_freed()
        self.monitor.check_stop()
        outputs = {name: output.result() for name, output in kept.items()}
        self.wait_for_saving()
        return Trained(outputs, self.curves)

    def wait_for_saving(self) -> None:
        """Raises the first error of saving."""
        for each in self.saving:
            each.result()

    def _run_stage(self, stage: Stage, inputs: dict[str, PyTree[Future[Output]]]) -> Output:
        """The output of a stage, loaded if it was saved."""
        try:
            is_saved = bool(stage.chunks) or stage.name in _SAVED
            found = self._load(stage) if is_saved else None
            if found is not None:
                return found
            given = jax.tree.map(lambda x: x.result() if isinstance(x, Future) else x, inputs)
            self.monitor.check_stop()
            output = (self._train if stage.chunks else self._once)(stage, given)
            if not stage.is_optional:
                self.monitor.check_finite(stage.name, "results", output)
            if is_saved:
                self._save(stage, output)
            return output
        except Stopped:
            raise
        except Exception as error:
            self.monitor.fail(error)
            raise
        finally:
            self.programs.used(stage)

    def _once(self, stage: Stage, inputs: dict[str, Output]) -> Output:
        """The output of a stage without steps."""
        output = stage.finish(self.config, self._begin(stage, inputs), **inputs)
        # Joined rows lie on the host, and every program would transfer them again.
        return jax.device_put(output)

    def _begin(self, stage: Stage, inputs: dict[str, Output]) -> Output:
        """The first state."""
        return self.programs.of(stage).begin(stage.key(self.key), self.config, inputs)

    def _train(self, stage: Stage, inputs: dict[str, Output]) -> Output:
        """The output of a stage with steps."""
        programs, config, failed = self.programs.of(stage), self.config, self._no_curves(stage)
        keys = stage.chunk_keys(self.key)
        # The rate must not include compilation.
        programs.advance.wait()

        def advance(chunk: int, state: Output) -> tuple[Output, Curves]:
            begin = time.perf_counter()
            state, progress = programs.advance(keys[chunk], config, state, inputs)
            seconds = time.perf_counter() - begin
            return state, {**self._report(stage, chunk, progress), "seconds": [seconds]}

        try:
            # Nobody but `run_chunks` holds the first state, so that it can let go of it.
            state, self.curves[stage.name] = run_chunks(
                stage,
                self._begin(stage, inputs),
                advance,
                self.monitor,
                self.checkpoints,
                failed,
            )
        except StageError as error:
            if not stage.is_optional:
                raise
            self.monitor.warn(f"{error}: left out")
            self.curves[stage.name] = failed
            return _failed(programs.shapes.result().output)
        return programs.finish(config, state, inputs)

    def _report(self, stage: Stage, chunk: int, progress: Progress) -> Curves:
        """Reports a chunk, checks its losses, and returns the steps' metrics."""
        size = len(progress.loss)
        done = min((chunk + 1) * size, stage.steps)
        losses, metrics = jax.tree.map(
            lambda x: np.asarray(x)[: done - chunk * size], (progress.loss, progress.metrics)
        )
        means = {
            name: float(np.nanmean(values))
            for name, values in metrics.items()
            if np.isfinite(values).any()
        }
        self.monitor.report(stage.name, done, stage.steps, losses, **means)
        return {name: values.tolist() for name, values in metrics.items()}

    def _load(self, stage: Stage) -> Output:
        """The saved output of a finished stage; None if there is none."""
        if stage.chunks:
            shapes = _as_arrays(self._no_curves(stage))
            curves = self.checkpoints.load_or_forget(f"curves_{stage.name}", shapes)
            if curves is None:
                return None
            self.curves[stage.name] = {name: x.tolist() for name, x in curves.items()}
        output = self.programs.of(stage).shapes.result().output
        return self.checkpoints.load_or_forget(stage.name, output, not stage.is_optional)

    def _no_curves(self, stage: Stage) -> Curves:
        """The curves of a failed training."""
        metrics = self.programs.of(stage).shapes.result().metrics
        return {**dict.fromkeys(metrics, [np.nan] * stage.steps), "seconds": [0.0] * stage.chunks}

    def _save(self, stage: Stage, output: Output) -> None:
        """Saves a finished stage while others run; raises if an earlier save failed."""
        for each in self.saving:
            if each.done():
                each.result()
        if self.checkpoints.path is None:
            return

        def save() -> None:
            if stage.chunks:
                curves = _as_arrays(self.curves[stage.name])
                self.checkpoints.save(f"curves_{stage.name}", curves)
            self.checkpoints.save(stage.name, output)

        self.saving.append(self.saver.submit(save))


def _as_arrays(curves: Curves) -> dict[str, np.ndarray]:
    return {name: np.array(values, np.float32) for name, values in curves.items()}


def _failed(shapes: Output) -> Output:
    """The output of a failed training: every float is NaN, everything else 0."""

    def fail(x: jax.ShapeDtypeStruct) -> np.ndarray:
        return np.full(x.shape, np.nan if np.issubdtype(x.dtype, np.floating) else 0, x.dtype)

    return jax.tree.map(fail, shapes)


def run_chunks(
    stage: Stage,
    state: Output,
    run: Callable[[int, Output], tuple[Output, Curves]],
    monitor: Monitor,
    checkpoints: Checkpoints,
    whole: Curves | None = None,
) -> tuple[Output, Curves]:
    """Runs a training from where it was last saved; saves it once a minute, and when it stops.

    Args:
      stage: with chunks.
      state: first state.
      run: `(chunk, state) -> (state, metrics)`. The state before a `StageError` is saved.
      monitor: asked whether to stop.
      checkpoints: where to save the training.
      whole: see `Checkpoints.load_unfinished`.

    Returns:
      The last state and the metrics of all chunks.
    """
    done, curves = 0, Curves()
    found = checkpoints.load_unfinished(stage.name, state, stage.chunks, whole)
    if found is not None:
        done, state, curves = found
    saved = time.monotonic()
    for chunk in range(done, stage.chunks):
        try:
            after, metrics = run(chunk, state)
        except StageError as error:
            try:
                checkpoints.save_unfinished(stage.name, Unfinished(chunk, state, curves))
            except OSError as lost:
                raise StageError(f"{error}; cannot save the last finite state ({lost})") from error
            raise
        state = after
        for name, values in metrics.items():
            curves.setdefault(name, []).extend(values)
        is_late = time.monotonic() - saved > _SAVE_PERIOD
        if is_late or monitor.is_stopping:
            checkpoints.save_unfinished(stage.name, Unfinished(chunk + 1, state, curves))
            saved = time.monotonic()
        if chunk + 1 < stage.chunks:
            monitor.check_stop()
    return state, curves
