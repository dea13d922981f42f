"""`python -m tests.faults.child FAULT STAGE ARGUMENTS...`: a training that meets a fault.

The fault strikes in this process, at the first program of a stage that has run; in the stage
`write` when the first plot is about to be written.
"""

import dataclasses
import os
import resource
import signal
import sys
import time
from typing import Any

import jax
import numpy as np

from jaxsense import cli, report, train
from jaxsense.compilation import Program

SIGNALS = {
    "ctrl-c": [signal.SIGINT],
    "ctrl-c-twice": [signal.SIGINT] * 2,
    "sigterm": [signal.SIGTERM],
}


def press(numbers: list[int]) -> None:
    """Sends signals to this process, each after the one before was heard by the main thread."""
    for number in numbers:
        waiting = signal.getsignal(number)
        os.kill(os.getpid(), number)
        while signal.getsignal(number) is waiting:
            time.sleep(0.01)


def fill_disk() -> None:
    """From now on no file can grow, as if there were no room."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))


def poisoned(tree: Any) -> Any:
    """NaN in place of the first number of every array of floats."""

    def poison(x: Any) -> Any:
        if not jax.numpy.issubdtype(x.dtype, np.floating):
            return x
        values = np.array(x)
        values.reshape(-1)[:1] = np.nan
        return values

    return jax.tree.map(poison, tree)


def with_nan(output: Any) -> Any:
    """A program's results with NaN in what was simulated, detected or learnt."""
    if isinstance(output, tuple) and hasattr(output[0], "params"):
        return dataclasses.replace(output[0], params=poisoned(output[0].params)), *output[1:]
    return poisoned(output)


def strike_at(stage: str, fault: str) -> None:
    """Lets a fault happen once."""
    run, write_plots, struck = Program.__call__, report.write_plots, []

    def strike() -> None:
        if not struck:
            struck.append(fault)
            fill_disk() if fault == "disk" else press(SIGNALS[fault])

    def call(self: Program, *args: Any) -> Any:
        output = run(self, *args)
        if not f"{self._stage}-{self._name}".startswith(stage) or struck:
            return output
        if fault == "nan":
            struck.append(fault)
            return with_nan(output)
        strike()
        return output

    def write(*args: Any) -> None:
        strike()
        write_plots(*args)

    if stage == "write":
        report.write_plots = write
    else:
        Program.__call__ = call


if __name__ == "__main__":
    fault, stage, *argv = sys.argv[1:]
    strike_at(stage, fault)
    cli.run(lambda: train.main(argv))
