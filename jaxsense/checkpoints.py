"""What a run saves while it trains, by Orbax: what is finished, and trainings under way."""

import contextlib
import os
import re
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxsense.config import ConfigError

_MOST_TOLD = 200
_MARGIN = 100_000  # bytes that a checkpoint takes beside its arrays

Curves = dict[str, list[float]]
"""Figures of a training so far, by their names."""


class Unfinished(NamedTuple):
    """A training under way.

    Attributes:
      done: chunks so far.
      state: what the next chunk starts from.
      curves: figures of the chunks so far.
    """

    done: int
    state: Any
    curves: Curves


class Checkpoints:
    """The checkpoints of a run, in a directory; without one nothing is saved and nothing is there.

    Attributes:
      path: the directory.
    """

    def __init__(self, path: Path | None = None):
        self.path = None if path is None else path.absolute()
        # After a failure Orbax closes what another save of the process still needs.
        self._lock = threading.Lock()

    def exists(self) -> bool:
        """Whether anything was saved."""
        return self.path is not None and self.path.exists()

    def save(self, name: str, tree: Any) -> None:
        """Saves something finished; an `OSError` says that it cannot be written."""
        if self.path is None:
            return
        tree = _on_host(tree)
        with (
            self._lock,
            _writing(self.path / name, tree),
            ocp.StandardCheckpointer() as checkpointer,
        ):
            checkpointer.save(self.path / name, tree, force=True)

    def load(self, name: str, shapes: Any) -> Any:
        """Loads what was saved.

        Args:
          name: as it was saved.
          shapes: a tree like it.

        Returns:
          The tree, of arrays on the host; None if there is none.

        Raises:
          ConfigError: if it cannot be read or is of other shapes.
        """
        if self.path is None or not (self.path / name).exists():
            return None
        try:
            with ocp.StandardCheckpointer() as checkpointer:
                return jax.tree.map(np.asarray, checkpointer.restore(self.path / name, shapes))
        except Exception as error:  # Orbax hands on whatever its storage raises
            raise _damaged(self.path / name, error) from error

    def save_unfinished(self, stage: str, unfinished: Unfinished) -> None:
        """Saves a training under way, in place of what was saved of it before; see `save`."""
        if self.path is None:
            return
        path, state = self._unfinished(stage), _on_host(unfinished.state)
        with self._lock, _writing(path, state), self._manager(stage) as manager:
            manager.save(
                unfinished.done,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(state),
                    curves=ocp.args.JsonSave(unfinished.curves),
                ),
            )

    def load_unfinished(self, stage: str, state: Any) -> Unfinished | None:
        """Loads a training under way.

        Args:
          stage: its name.
          state: any state of it, for structure and shapes.

        Returns:
          The training as it was saved last; None if it was not.

        Raises:
          ConfigError: if it cannot be read or is of other shapes.
        """
        if self.path is None or not self._unfinished(stage).exists():
            return None
        try:
            with self._manager(stage) as manager:
                done = manager.latest_step()
                if done is None:
                    return None
                shapes = jax.tree.map(ocp.utils.to_shape_dtype_struct, state)
                restored = manager.restore(
                    done,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardRestore(shapes), curves=ocp.args.JsonRestore()
                    ),
                )
                # On the host, so that any program may take it, on whatever devices.
                state = jax.tree.map(np.asarray, restored.state)
                return Unfinished(done, state, restored.curves)
        except Exception as error:
            raise _damaged(self._unfinished(stage), error) from error

    def forget(self) -> None:
        """Removes all."""
        if self.path is not None:
            shutil.rmtree(self.path, ignore_errors=True)

    def forget_unfinished(self) -> None:
        """Removes all trainings under way: the run is finished."""
        if self.path is not None:
            shutil.rmtree(self.path / "unfinished", ignore_errors=True)

    def _unfinished(self, stage: str) -> Path:
        assert self.path is not None
        return self.path / "unfinished" / stage

    def _manager(self, stage: str) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(max_to_keep=1, enable_async_checkpointing=False)
        return ocp.CheckpointManager(self._unfinished(stage), options=options)


@contextlib.contextmanager
def _writing(path: Path, tree: Any) -> Iterator[None]:
    """Whatever goes wrong when a tree of arrays is written, as an `OSError`."""
    # Without room Orbax fails in many threads, and each prints what it has to say.
    trial = path.parent / f".{path.name}.trial"
    try:
        trial.parent.mkdir(parents=True, exist_ok=True)
        trial.write_bytes(bytes(sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) + _MARGIN))
    except OSError as error:
        raise OSError(f"{path} ({error.strerror})") from error
    finally:
        with contextlib.suppress(OSError):
            trial.unlink(missing_ok=True)
    try:
        yield
    except Exception as error:
        code = re.search(r"os_error_code='(\d+)'", str(error))
        reason = os.strerror(int(code[1])) if code else _first_line(error)
        raise OSError(f"{path} ({reason})") from error


def _damaged(path: Path, error: Exception) -> ConfigError:
    """The error of a checkpoint that is there and cannot be read."""
    reason = f"is damaged or of other settings ({_first_line(error)})"
    return ConfigError("checkpoint", str(path), reason)


def _first_line(error: Exception) -> str:
    """What an error says, in brief."""
    lines = str(error).strip().splitlines()
    return lines[0][:_MOST_TOLD] if lines else type(error).__name__


def _on_host(tree: Any) -> Any:
    """A copy, which nobody gives away to a program while it is written."""
    return jax.tree.map(np.array, tree)
