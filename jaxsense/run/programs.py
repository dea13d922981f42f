"""The compiled programs of a run: of every stage, and of its missions.

A thread traces them one after the other. Each compiles as soon as it is traced, while stages with
compiled programs already run. Shapes come from tracing: a stage's outputs are later stages' inputs.
"""

import dataclasses
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import jax

from jaxsense import mission
from jaxsense.config import Config
from jaxsense.run import missions
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.together import SharedProgram, Trainings
from jaxsense.sim.world import World
from jaxsense.stages import Stage, Steps, stages


@dataclasses.dataclass(frozen=True)
class Shapes:
    """Shapes and dtypes of what a stage's programs return.

    Attributes:
      output: of the stage.
      progress: of one chunk; None for a stage without steps.
    """

    output: Any
    progress: Any = None


@dataclasses.dataclass(frozen=True)
class StagePrograms:
    """The programs of a stage.

    Attributes:
      begin: `(key, config, *inputs) -> state`, or the output of a stage without steps.
      advance: `(key, config, state, *inputs) -> (state, Progress)`.
      finish: `(config, state, *inputs) -> output`.
      shapes: known once the programs are traced.
    """

    begin: Program | SharedProgram
    advance: Program | SharedProgram
    finish: Program | SharedProgram
    shapes: Future[Shapes]


@dataclasses.dataclass(frozen=True)
class Programs:
    """The programs of runs whose settings differ in their leaves at most.

    Attributes:
      config: all settings.
      stages: of the training.
      of_stages: their programs, by `Stage.program`.
      player: of the missions.
      workers: what shares rows and missions.
      trainings: those side by side.
    """

    config: Config
    stages: list[Stage]
    of_stages: dict[str, StagePrograms]
    player: Future[missions.Player]
    workers: Workers
    trainings: Trainings

    def of(self, stage: Stage) -> StagePrograms:
        """The programs of a stage."""
        return self.of_stages[_name(stage)]

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
    world: World,
    compiler: Compiler,
    workers: Workers = ALONE,
    num_seeds: int = 1,
) -> Programs:
    """Starts to trace and compile the programs of a run in the background.

    Args:
      config: all settings.
      world: the simulation, without contacts.
      compiler: compiles them.
      workers: what shares rows, missions and seeds.
      num_seeds: trainings side by side; each calls the programs from its own threads.
    """
    found, trainings = stages(config, world), Trainings(num_seeds)

    def program(stage: Stage, part: str) -> Program | SharedProgram:
        alone = Program(compiler, _name(stage), part)
        is_shared = num_seeds > 1 and not stage.has_rows
        return SharedProgram(alone, trainings, workers) if is_shared else alone

    programs = Programs(
        config=config,
        stages=found,
        of_stages={
            _name(stage): StagePrograms(
                begin=program(stage, "begin"),
                advance=program(stage, "advance"),
                finish=program(stage, "finish"),
                shapes=Future(),
            )
            for stage in found
        },
        player=Future(),
        workers=workers,
        trainings=trainings,
    )

    thread = ThreadPoolExecutor(1)
    thread.submit(_trace, programs, compiler)
    thread.shutdown(wait=False)
    return programs


_BEFORE_MISSIONS = 2  # stages that all others wait for


def _name(stage: Stage) -> str:
    return stage.program or stage.name


def _on_cpu() -> bool:
    """Whether the programs run on a CPU; accelerators train faster than they compile."""
    return jax.default_backend() == "cpu"


def _trace(programs: Programs, compiler: Compiler) -> None:
    """Traces all programs; an error reaches whoever waits for one."""
    try:
        for stage in programs.stages[:_BEFORE_MISSIONS]:
            _trace_stage(programs, stage)
        # Missions come last, but take a CPU longest to compile. With an accelerator, cores are
        # free to compile, and everything waits for tracing.
        if _on_cpu():
            _trace_missions(programs, compiler)
        for stage in programs.stages[_BEFORE_MISSIONS:]:
            _trace_stage(programs, stage)
        if not _on_cpu():
            _trace_missions(programs, compiler)
    except BaseException as error:
        programs.fail(error)


def _trace_missions(programs: Programs, compiler: Compiler) -> None:
    config = programs.config
    batch = missions.batch_of(len(config.mission.policies) * config.mission.episodes)
    team = mission.make_mission(config)
    programs.player.set_result(missions.Player(team, compiler, batch, programs.workers))


def _trace_stage(programs: Programs, stage: Stage) -> None:
    """Traces the programs of a stage, unless an earlier stage shares them."""
    compiled, key, config = programs.of(stage), jax.random.key(0), programs.config
    if compiled.shapes.done():
        return
    outputs = {
        before.name: programs.of(before).shapes.result().output
        for before in programs.stages
        if before.name in stage.inputs
    }
    inputs = stage.select(outputs)
    if isinstance(compiled.begin, Program) and stage.has_rows:
        inputs = padded(inputs, programs.workers.number)
        whole = {"workers": programs.workers, "whole": (0, 1)}
        output = compiled.begin.compile(stage.begin, key, config, *inputs, **whole)
        number = len(jax.tree.leaves(outputs)[0])
        output = jax.tree.map(lambda x: x.update(shape=(number, *x.shape[1:])), output)
        compiled.shapes.set_result(Shapes(output))
        return
    state = compiled.begin.compile(stage.begin, key, config, *inputs, whole=(1,))
    if not isinstance(stage, Steps):
        compiled.shapes.set_result(Shapes(state))
        return
    runs_long = stage.is_dense and _on_cpu()
    _, progress = compiled.advance.compile(
        stage.advance, key, config, state, *inputs, runs_long=runs_long, whole=(1,)
    )
    output = compiled.finish.compile(stage.finish, config, state, *inputs, whole=(0,))
    compiled.shapes.set_result(Shapes(output, progress))


def padded(inputs: Any, number: int) -> Any:
    """Repeats the first rows of inputs until `number` divides their count."""

    def pad(x: Any) -> Any:
        rows = -(-x.shape[0] // number) * number
        if isinstance(x, jax.ShapeDtypeStruct):
            return x.update(shape=(rows, *x.shape[1:]))
        return x if rows == len(x) else x[jax.numpy.arange(rows) % len(x)]

    return jax.tree.map(pad, inputs)
