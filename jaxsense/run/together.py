"""Runs several trainings side by side on an accelerator, with one call for all of them.

Each training has its own threads, and saves, stops and fails independently. They share programs:
their calls of the same program are stacked, along an axis that `vmap` adds.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxsense.run.compilation import Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.kept import shapes_of

_PATIENCE = 0.5  # s; then a call goes ahead without the trainings that have not made it yet

_Call: TypeAlias = tuple[tuple[PyTree, ...], Future[PyTree]]


class Trainings:
    """Trainings side by side.

    Attributes:
      number: maximum number of trainings at a time.
      total: number of trainings in all, if it is known.
      active: number of trainings that are running.
    """

    def __init__(self, number: int = 1, total: int | None = None):
        self.number = self.active = number
        self.total = total
        self._lock = threading.Lock()

    def begin(self, number: int) -> None:
        """Begins `number` trainings, at most `self.number`."""
        self.active = number

    def leave(self) -> None:
        """Ends one training, for which the others no longer wait."""
        with self._lock:
            self.active -= 1


class SharedProgram:
    """A `Program` that every training calls with its own arguments."""

    def __init__(self, program: Program, trainings: Trainings, workers: Workers = ALONE):
        """Shares a program among trainings.

        Args:
          program: compiles and runs the stacked calls.
          trainings: that call it.
          workers: accelerators that share the trainings, if they divide evenly among them.
        """
        self._program, self._trainings = program, trainings
        self._workers = workers if trainings.number % workers.number == 0 else ALONE
        self._whole: tuple[int, ...] = ()
        self._lock = threading.Lock()
        self._waiting: list[_Call] = []
        self._last = 0.0

    def compile(
        self,
        function: Callable[..., PyTree],
        *args: PyTree,
        runs_long: bool = False,
        whole: tuple[int, ...] = (),
    ) -> PyTree[jax.ShapeDtypeStruct]:
        """Starts to compile the stacked function; see `Program.compile`.

        Args:
          function: of one training.
          *args: arguments of one training, or their shapes.
          runs_long: see `devices.compiler_options`.
          whole: positions of arguments that all trainings share.

        Returns:
          Shapes and dtypes of one training's results.
        """
        self._whole, number = whole, self._trainings.number
        axes = tuple(None if i in whole else 0 for i in range(len(args)))
        shapes = shapes_of(args)
        stacked = [
            arg if i in whole else jax.tree.map(lambda x: _with_rows(x, number), shapes[i])
            for i, arg in enumerate(args)
        ]
        results = self._program.compile(
            jax.vmap(function, axes),
            *stacked,
            runs_long=runs_long,
            workers=self._workers,
            whole=whole,
        )
        return jax.tree.map(lambda x: x.update(shape=x.shape[1:]), results)

    def fail(self, error: BaseException) -> None:
        """See `Program.fail`."""
        self._program.fail(error)

    def release(self) -> None:
        """See `Program.release`."""
        self._program.release()

    def wait(self) -> Callable[..., PyTree]:
        """See `Program.wait`."""
        return self._program.wait()

    def __call__(self, *args: PyTree) -> PyTree:
        """Runs the program for all trainings that call it now; returns this training's results."""
        mine: Future[PyTree] = Future()
        with self._lock:
            self._waiting.append((args, mine))
            self._last = time.monotonic()
        while not mine.done():
            calls = self._take()
            if calls:
                self._run(calls)
            else:
                wait((mine,), timeout=_PATIENCE / 10)
        return mine.result()

    def _take(self) -> list[_Call]:
        """The calls to make now: one of each training, or all that have waited too long."""
        with self._lock:
            is_late = time.monotonic() - self._last > _PATIENCE
            if not (len(self._waiting) >= self._trainings.active or is_late):
                return []
            number = self._trainings.number
            calls, self._waiting = self._waiting[:number], self._waiting[number:]
            return calls

    def _run(self, calls: list[_Call]) -> None:
        """Makes several calls as one; all of them get its error, if it has one."""
        try:
            results = self._program(*self._stacked([args for args, _ in calls]))
            of_each = [jax.tree.map(lambda x: x[i], results) for i in range(len(calls))]  # noqa: B023
        except BaseException as error:
            for _, future in calls:
                future.set_exception(error)
            return
        for (_, future), result in zip(calls, of_each, strict=True):
            future.set_result(result)

    def _stacked(self, rows: list[tuple[PyTree, ...]]) -> list[PyTree]:
        """Arguments of several calls as those of one, padded with copies of the first."""
        rows += rows[:1] * (self._trainings.number - len(rows))
        return [
            column[0] if i in self._whole else jax.tree.map(lambda *x: jnp.stack(x), *column)
            for i, column in enumerate(zip(*rows, strict=True))
        ]


def _with_rows(x: jax.ShapeDtypeStruct, number: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((number, *x.shape), x.dtype)
