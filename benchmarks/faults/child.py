"""`python -m benchmarks.faults.child FAULT STAGE ARGUMENTS...`: a training that meets a fault.

The fault strikes in this process, at the first program of a stage that has run; in the stage
`write` when the plots are about to be drawn. `gradient` makes one array of a training's
gradients NaN, within its compiled program, in step `NAN_STEP`.

`clock` lets all runs begin in the same second. `evaluate` and `export` as STAGE begin that program
in place of a training, with a disk that is full.
"""

import dataclasses
import datetime
import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxsense import evaluate, export, train
from jaxsense.config import DetectorConfig, DqnConfig, JmvaeConfig
from jaxsense.core import supervised
from jaxsense.core.supervised import FitState
from jaxsense.dqn import training as dqn_training
from jaxsense.dqn.training import DqnState
from jaxsense.run import output, rundir
from jaxsense.run.compilation import Program
from jaxsense.show import plots
from jaxsense.training.stage import Progress
from jaxsense.training.surveys import Survey

NAN_STEP = 17
TRAININGS: dict[str, tuple[Any, str, type]] = {
    "detector_camera": (supervised, "_adam", DetectorConfig),
    "jmvae": (supervised, "_adam", JmvaeConfig),
    "dqn": (dqn_training, "_optimiser", DqnConfig),
}
"""Where the optimiser of a training is made, and from which settings."""
OTHERS = {"evaluate": evaluate, "export": export}

SIGNALS = {
    "ctrl-c": [signal.SIGINT],
    "ctrl-c-twice": [signal.SIGINT] * 2,
    "sigterm": [signal.SIGTERM],
}


def press(numbers: list[signal.Signals]) -> None:
    """Sends signals to this process, each after the one before was heard by the main thread."""
    for number in numbers:
        waiting = signal.getsignal(number)
        os.kill(os.getpid(), number)
        while signal.getsignal(number) is waiting:
            time.sleep(0.01)


def fill_disk() -> None:
    """From now on no file can grow, as if there were no room."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))


def poisoned(tree: Any, number: int) -> Any:
    """NaN in place of the first number of one array of floats, for any `number` one of them.

    Last rows may only fill up the calls of several threads, and are dropped.
    """
    leaves, structure = jax.tree.flatten(tree)
    floats = [i for i, x in enumerate(leaves) if jnp.issubdtype(x.dtype, np.floating)]
    chosen = floats[number % len(floats)]
    leaves[chosen] = np.array(leaves[chosen])
    leaves[chosen].reshape(-1)[0] = np.nan
    return jax.tree.unflatten(structure, leaves)


def with_nan(output: Any, number: int) -> Any:
    """A program's results with NaN in what was simulated, detected or learnt."""
    if isinstance(output, tuple) and isinstance(output[-1], Progress):
        state, progress = output
        return with_bad_params(state, number), progress
    if isinstance(output, Survey):
        return dataclasses.replace(output, windows=poisoned(output.windows, number))
    return poisoned(output, number)


def with_bad_params(state: Any, number: int) -> Any:
    """A state of a training with NaN in the parameters that are trained."""
    if isinstance(state, FitState | DqnState):
        return dataclasses.replace(state, params=poisoned(state.params, number))
    if isinstance(state, tuple):
        return tuple(with_bad_params(part, number) for part in state)
    return state


def poison_gradients(stage: str, number: int) -> None:
    """Lets one array of the gradients of a training be NaN in step `NAN_STEP`."""
    module, name, settings = TRAININGS[stage]
    make = getattr(module, name)

    def make_poisoned(config: Any) -> optax.GradientTransformation:
        optimiser = make(config)
        if not isinstance(config, settings):
            return optimiser

        def update(updates: Any, state: Any, params: Any = None) -> Any:
            # Adam and its schedule count alike, from zero.
            count = jax.tree.leaves(optax.tree_utils.tree_get_all_with_path(state, "count"))[-1]
            leaves, structure = jax.tree.flatten(updates)
            chosen = number % len(leaves)
            factor = jnp.where(count == NAN_STEP - 1, jnp.nan, 1.0)
            leaves[chosen] = leaves[chosen] * factor
            return optimiser.update(jax.tree.unflatten(structure, leaves), state, params)

        return optax.GradientTransformation(optimiser.init, update)

    setattr(module, name, make_poisoned)


class StoppedClock(datetime.datetime):
    """It is always the same second."""

    @classmethod
    def now(cls, tz: Any = None) -> "StoppedClock":
        """That second."""
        return cls(2025, 1, 1, tzinfo=tz)


def strike_at(stage: str, fault: str) -> None:
    """Lets a fault happen once."""
    draw_plots, struck = plots.of_run, []

    def strike() -> None:
        if not struck:
            struck.append(fault)
            fill_disk() if fault == "disk" else press(SIGNALS[fault])

    def striking(run: Callable[..., Any]) -> Callable[..., Any]:
        def call(self: Program, *args: Any) -> Any:
            output = run(self, *args)
            if not f"{self._stage}-{self._name}".startswith(stage) or struck:
                return output
            if fault.startswith("nan"):
                struck.append(fault)
                return with_nan(output, int(fault.removeprefix("nan")))
            strike()
            return output

        return call

    def draw(*args: Any) -> dict[str, bytes]:
        strike()
        return draw_plots(*args)

    if stage == "write":
        plots.of_run = draw
    else:
        # Missions leave their results on the devices.
        for name in ("__call__", "run"):
            setattr(Program, name, striking(getattr(Program, name)))


if __name__ == "__main__":
    fault, stage, *argv = sys.argv[1:]
    # A script may have started this in the background, where Ctrl-C is not for it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if stage in OTHERS:
        fill_disk()
        output.run(lambda: OTHERS[stage].main(argv))
    elif fault.startswith("gradient"):
        poison_gradients(stage, int(fault.removeprefix("gradient")))
        output.run(lambda: train.main(argv))
    elif fault == "clock":
        rundir.datetime = StoppedClock
        output.run(lambda: train.main(argv))
    else:
        strike_at(stage, fault)
        output.run(lambda: train.main(argv))
