"""The compiled programs of a run: of every stage, and of its missions.

A thread traces them one after the other. Each compiles as soon as it is traced, while stages with
compiled programs already run. Shapes come from tracing: a stage's outputs are later stages' inputs.
"""

import threading
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future
from typing import NamedTuple

import jax

from jaxsense import mission
from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.dqn.policies import Values
from jaxsense.run import missions
from jaxsense.run.compilation import Compiler, Program, RowProgram
from jaxsense.run.devices import ALONE, Workers
from jaxsense.training import stages
from jaxsense.training.stage import Output, Stage

OwnPolicies = Mapping[str, Values]
"""Policies of a user, by name, see `dqn.policies.table`."""

_BEFORE_MISSIONS = 2  # stages that all others wait for
_HAS_ROWS = ("survey",)  # whose inputs and outputs are independent rows, which workers share


class StagePrograms(NamedTuple):
    """The programs of a stage, see `Stage`; without steps, the first alone is compiled.

    Attributes:
      output: shapes and dtypes of the stage's output.
      metrics: names of the metrics of its steps.
    """

    begin: Program | RowProgram
    advance: Program
    finish: Program
    output: Output
    metrics: tuple[str, ...]


class Programs:
    """Compiled programs of the runs of one or several seeds."""

    def __init__(
        self,
        config: Config,
        compiler: Compiler,
        workers: Workers = ALONE,
        trainings: int = 0,
        policies: OwnPolicies | None = None,
    ):
        """Starts to trace and compile in the background.

        Args:
          workers: share rows and missions.
          trainings: number after whose last call a program is released; 0 for never.
          policies: of missions, by name, in addition to `dqn.POLICIES`.
        """
        self.config, self.stages, self.monitor = config, stages.stages(config), compiler.monitor
        self.player: Future[missions.Player] = Future()
        self._compiler, self._workers, self._policies = compiler, workers, policies
        names = [stage.program for stage in self.stages]
        self._of = {name: Future[StagePrograms]() for name in names}
        self._left, self._lock = Counter(trainings * names), threading.Lock()
        threading.Thread(target=self._trace, name="trace").start()

    def of(self, stage: Stage) -> StagePrograms:
        """The programs of a stage, once they are traced."""
        return self.monitor.wait_for(self._of[stage.program])

    def used(self, stage: Stage) -> None:
        """Notes that a training is done with a stage, and lets go of programs that none needs."""
        with self._lock:
            self._left[stage.program] -= 1
            if self._left[stage.program] == 0:
                before, self._of[stage.program] = self._of[stage.program], Future()
                if before.done():
                    for program in before.result()[:3]:
                        program.cancel()

    def _trace(self) -> None:
        """Traces all programs."""
        # Missions come last, but take a CPU longest to compile. With an accelerator, cores are
        # free to compile, and everything waits for tracing.
        left = [stage.name for stage in self.stages[_BEFORE_MISSIONS:]] if _on_cpu() else []

        def drive(stage: Stage, **inputs: Output) -> Output:
            if left[:1] == [stage.name]:
                self._compile_missions()
            return self._compile(stage, inputs)

        try:
            stages.train(drive, self.config)
            if not left:
                self._compile_missions()
        except BaseException as error:
            self.monitor.fail(error)

    def _compile_missions(self) -> None:
        config = self.config
        with self.monitor.measure("compile_s", "mission"):
            scenario = mission.make_mission(config, self._policies)
            scenario = scenario.playing(config.mission.policies)
        number = len(config.mission.policies) * config.mission.episodes
        player = missions.Player(scenario, self._compiler, number, self._workers)
        self.player.set_result(player)

    def _compile(self, stage: Stage, inputs: dict[str, Output]) -> Output:
        """Shapes of a stage's output; compiles its programs unless an earlier stage shares them."""
        name, key, config = stage.program, jax.random.key(0), self.config
        if (before := self._of[name]).done():
            return before.result().output

        def first(key: Key, config: Config, inputs: dict[str, Output]) -> Output:
            return stage.begin(key, config, **inputs)

        def last(config: Config, state: Output, inputs: dict[str, Output]) -> Output:
            return stage.finish(config, state, **inputs)

        begin, advance, finish = (
            Program(self._compiler, name, part) for part in ("begin", "advance", "finish")
        )
        if name in _HAS_ROWS and (_on_cpu() or self._workers.mesh is not None):
            begin = RowProgram(begin, self._workers)
        state = begin.compile(first, key, config, inputs, whole=2)
        if (step := stage.advance) is None:
            output, metrics = jax.eval_shape(lambda *args: last(config, *args), state, inputs), ()
        else:

            def chunk(key: Key, config: Config, state: Output, inputs: dict[str, Output]) -> Output:
                return step(key, config, state, **inputs)

            _, progress = advance.compile(chunk, key, config, state, inputs)
            output = finish.compile(last, config, state, inputs)
            metrics = tuple(progress.metrics)
        self._of[name].set_result(StagePrograms(begin, advance, finish, output, metrics))
        return output


def _on_cpu() -> bool:
    """Whether the programs run on a CPU; accelerators train faster than they compile."""
    return jax.default_backend() == "cpu"
