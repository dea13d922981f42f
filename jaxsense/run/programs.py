"""The compiled programs of a run: of every stage, and of its missions.

A thread traces them one after the other. Each compiles as soon as it is traced, while stages with
compiled programs already run. Shapes come from tracing: a stage's outputs are later stages' inputs.
"""

import dataclasses
import functools
import threading
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor
from contextlib import suppress

import jax
from jaxtyping import PyTree

from jaxsense import mission
from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.dqn.policies import Policy, Values
from jaxsense.run import batches, films, missions
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.training.stage import Output, Stage
from jaxsense.training.stages import stages

OwnPolicies = Mapping[str, Values | Policy]
"""Policies of a user, by name, see `dqn.policies.table`."""
_BEFORE_MISSIONS = 2  # stages that all others wait for
_ROWS_AT_ONCE = 512  # of each thread; their results take up little memory besides those of all


@dataclasses.dataclass(frozen=True)
class Shapes:
    """Shapes and dtypes of the outputs of a stage's programs.

    Attributes:
      output: of the stage.
      metrics: names of the metrics that a chunk reports.
    """

    output: Output
    metrics: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class StagePrograms:
    """The programs of a stage.

    Attributes:
      begin: `(key, config, inputs) -> state`, or the output of a stage without chunks.
      advance: `(key, config, state, inputs) -> (state, Progress)`.
      finish: `(config, state, inputs) -> output`.
      shapes: known once the programs are traced.
    """

    begin: Program
    advance: Program
    finish: Program
    shapes: Future[Shapes]

    def release(self) -> None:
        """Lets go of the compiled programs."""
        for program in (self.begin, self.advance, self.finish):
            program.release()


@dataclasses.dataclass(frozen=True)
class Programs:
    """Compiled programs of runs whose settings differ only in their leaves.

    Attributes:
      config: all settings.
      stages: of the training.
      of_stages: their programs, by name.
      player: of the missions.
      workers: threads or devices that share rows and missions.
      policies: of missions, by name, in addition to `dqn.POLICIES`.
      left: how often each stage's programs are still needed, if it is known.
    """

    config: Config
    stages: list[Stage]
    of_stages: dict[str, StagePrograms]
    player: Future[missions.Player]
    workers: Workers
    policies: OwnPolicies | None = None
    left: Counter[str] = dataclasses.field(default_factory=Counter)
    _lock: threading.Lock = dataclasses.field(default_factory=threading.Lock)

    def of(self, stage: Stage) -> StagePrograms:
        """The programs of a stage."""
        return self.of_stages[stage.program]

    def used(self, stage: Stage) -> None:
        """Notes that a training is done with a stage, and lets go of programs that none needs."""
        with self._lock:
            self.left[stage.program] -= 1
            if self.left[stage.program] == 0:
                self.of(stage).release()

    def fail(self, error: BaseException) -> None:
        """Raises an error wherever a program is awaited, now or later."""
        for each in self.of_stages.values():
            for program in (each.begin, each.advance, each.finish):
                program.fail(error)
        for future in (self.player, *(each.shapes for each in self.of_stages.values())):
            with suppress(InvalidStateError):
                future.set_exception(error)


def compile_programs(
    config: Config,
    compiler: Compiler,
    workers: Workers = ALONE,
    trainings: int = 0,
    policies: OwnPolicies | None = None,
) -> Programs:
    """Starts to trace and compile the programs of a run in the background.

    Args:
      config: all settings.
      compiler: compiles them.
      workers: share rows and missions.
      trainings: number of trainings after whose last call a program is released; 0 for never.
      policies: of missions, by name, in addition to `dqn.POLICIES`.
    """
    found = stages(config)

    programs = Programs(
        config=config,
        stages=found,
        of_stages={
            stage.program: StagePrograms(
                begin=Program(compiler, stage.program, "begin"),
                advance=Program(compiler, stage.program, "advance"),
                finish=Program(compiler, stage.program, "finish"),
                shapes=Future(),
            )
            for stage in found
        },
        player=Future(),
        workers=workers,
        policies=policies,
        left=Counter(stage.program for stage in found for _ in range(trainings)),
    )

    thread = ThreadPoolExecutor(1, "trace")
    thread.submit(_trace, programs, compiler)
    thread.shutdown(wait=False)
    return programs


def _on_cpu() -> bool:
    """Whether the programs run on a CPU; accelerators train faster than they compile."""
    return jax.default_backend() == "cpu"


def _trace(programs: Programs, compiler: Compiler) -> None:
    """Traces all programs; an error reaches whoever waits for one."""
    try:
        # Missions come last, but take a CPU longest to compile. With an accelerator, cores are
        # free to compile, and everything waits for tracing.
        before = _BEFORE_MISSIONS if _on_cpu() else len(programs.stages)
        for stage in programs.stages[:before]:
            _trace_stage(programs, stage)
        _trace_missions(programs, compiler)
        for stage in programs.stages[before:]:
            _trace_stage(programs, stage)
    except BaseException as error:
        programs.fail(error)


def _trace_missions(programs: Programs, compiler: Compiler) -> None:
    with compiler.monitor.stopwatch.measure("compile_s", "mission"):
        scenario = mission.make_mission(programs.config, programs.policies)
    batch, workers = _batch(programs), programs.workers
    runs_long = batches.runs_long(programs.config, _num_missions(programs.config))
    programs.player.set_result(missions.Player(scenario, compiler, batch, workers, runs_long))


def _num_missions(config: Config) -> int:
    """How many missions a run plays."""
    return len(config.mission.policies) * config.mission.episodes


def _batch(programs: Programs) -> int:
    """How many missions play side by side, with room for those to record."""
    number, workers = _num_missions(programs.config), programs.workers
    batch = batches.batch_of(programs.config, number, workers)
    return max(batch, min(number, films.AT_A_TIME * workers.number))


def _trace_stage(programs: Programs, stage: Stage) -> None:
    """Traces the programs of a stage, unless an earlier stage shares them."""
    compiled, key, config = programs.of(stage), jax.random.key(0), programs.config
    if compiled.shapes.done():
        return
    outputs = {
        before.name: programs.of(before).shapes.result().output
        for before in programs.stages
        if before.name in stage.sources
    }
    inputs = stage.select(outputs)

    def begin(key: Key, config: Config, inputs: dict[str, Output]) -> Output:
        return stage.begin(key, config, **inputs)

    def advance(key: Key, config: Config, state: Output, inputs: dict[str, Output]) -> Output:
        return stage.advance(key, config, state, **inputs)

    def finish(config: Config, state: Output, inputs: dict[str, Output]) -> Output:
        return stage.finish(config, state, **inputs)

    divided = functools.partial(jax.eval_shape, functools.partial(stage.divide, config))
    if stage.has_rows:
        number = len(jax.tree.leaves(inputs)[0])
        workers = workers_for(number, programs.workers)
        split = padded(inputs, workers)
        output = compiled.begin.compile(begin, key, config, split, workers=workers, whole=(0, 1))
        output = jax.tree.map(lambda x: x.update(shape=(number, *x.shape[1:])), output)
        compiled.shapes.set_result(Shapes(divided(output)))
        return
    state = compiled.begin.compile(begin, key, config, inputs, whole=(1,))
    if not stage.chunks:
        compiled.shapes.set_result(Shapes(divided(state)))
        return
    runs_long = _on_cpu() and stage.runs_long
    _, progress = compiled.advance.compile(
        advance, key, config, state, inputs, runs_long=runs_long, whole=(1,)
    )
    output = compiled.finish.compile(finish, config, state, inputs, whole=(0,))
    compiled.shapes.set_result(Shapes(output, tuple(progress.metrics)))


def workers_for(rows: int, workers: Workers) -> Workers:
    """Workers for the rows of a stage: threads take a few rows at a time, devices all at once.

    Args:
      rows: their number.
      workers: share the rows.
    """
    if not _on_cpu() or workers.mesh is not None:
        return workers
    return dataclasses.replace(workers, calls=-(-rows // (workers.threads * _ROWS_AT_ONCE)))


def padded(inputs: PyTree, workers: Workers) -> PyTree:
    """Repeats the first rows of inputs until every call of the workers has equally many.

    Args:
      inputs: arrays or their shapes.
      workers: share the rows.
    """
    number = workers.shares

    def pad(x: jax.Array | jax.ShapeDtypeStruct) -> jax.Array | jax.ShapeDtypeStruct:
        rows = -(-x.shape[0] // number) * number
        if isinstance(x, jax.ShapeDtypeStruct):
            return x.update(shape=(rows, *x.shape[1:]))
        return x if rows == len(x) else x[jax.numpy.arange(rows) % len(x)]

    return jax.tree.map(pad, inputs)
