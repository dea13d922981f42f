"""Checkpoints of a run: finished stages and unfinished trainings.

A checkpoint is one file: a SHA-256 digest, then arrays in the format of `flax.serialization`.
"""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from flax import serialization
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.core import inside
from jaxsense.run import files
from jaxsense.run.monitor import is_finite

T = TypeVar("T")

Curves = dict[str, list[float]]
"""Metrics of a training so far, by name."""

_SUFFIX = ".msgpack"
_UNFINISHED = "unfinished"
_REST = 2**20  # bytes of a checkpoint that are not numbers


class Unfinished(NamedTuple):
    """An unfinished training.

    Attributes:
      done: number of chunks so far.
      state: input of the next chunk.
      curves: metrics of the chunks so far.
    """

    done: int
    state: PyTree
    curves: Curves


class Checkpoints:
    """Checkpoints of a run in a directory; without one, saves and finds none.

    A damaged checkpoint is set aside and its content is trained again, with the same result, since
    seed and settings determine a run.

    Attributes:
      path: the directory.
    """

    def __init__(
        self,
        path: Path | None = None,
        warn: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
        saved: Callable[[str], object] = lambda name: None,
    ):
        """Opens a directory, which need not exist.

        Args:
          path: the directory.
          warn: receives a line about each damaged checkpoint.
          saved: receives the name of each checkpoint once it is saved.
        """
        self.path, self._warn, self._saved = path, warn, saved
        self._lock = threading.Lock()

    def save(self, name: str, tree: PyTree) -> None:
        """Saves a pytree of arrays; raises `OSError` if the file cannot be written."""
        if self.path is None:
            return
        file, tree = self._file(name), jax.tree.map(np.asarray, tree)
        file.parent.mkdir(parents=True, exist_ok=True)
        content = serialization.msgpack_serialize(serialization.to_state_dict(tree))
        files.write_digested(file, content)
        with self._lock:
            self._saved(name)

    def load(self, name: str, shapes: PyTree[T], finite: bool = False) -> PyTree | None:
        """Loads a checkpoint.

        Args:
          name: as in `save`.
          shapes: a tree of the same structure and shapes.
          finite: whether all numbers must be finite.

        Returns:
          The tree, with arrays on the host; None if it was not saved.

        Raises:
          ConfigError: if the file is damaged or holds arrays of other shapes.
        """
        return self._load(name, shapes, lambda found: _like(shapes, found, finite))

    def load_or_forget(self, name: str, shapes: PyTree[T], finite: bool = False) -> PyTree | None:
        """As `load`, but warns and sets the file aside if it cannot be used, and returns None."""
        return self._or_forget(name, lambda: self.load(name, shapes, finite))

    def save_unfinished(self, stage: str, unfinished: Unfinished) -> None:
        """Saves an unfinished training over its previous checkpoint; raises as `save` does."""
        curves = {name: np.array(values, np.float64) for name, values in unfinished.curves.items()}
        saved = {"done": np.int64(unfinished.done), "state": unfinished.state, "curves": curves}
        self.save(f"{_UNFINISHED}/{stage}", saved)

    def load_unfinished(
        self, stage: str, state: PyTree, chunks: int, whole: Curves | None = None
    ) -> Unfinished | None:
        """Loads an unfinished training.

        Args:
          stage: its name.
          state: any state of it, for structure and shapes.
          chunks: number of chunks of the whole training.
          whole: any curves of the whole training, for names and lengths; not checked without.

        Returns:
          The training as last saved; None if there is none, or its file is damaged.
        """

        def restore(found: PyTree) -> Unfinished:
            curves = {name: values.tolist() for name, values in found["curves"].items()}
            done, sizes = int(found["done"]), {name: len(x) for name, x in curves.items()}
            if not 0 <= done <= chunks:
                raise ValueError(f"done = {done}: must be from 0 to {chunks}")
            # Only the last of all chunks may be smaller.
            due = {n: min(done * -(-len(x) // chunks), len(x)) for n, x in (whole or {}).items()}
            if whole is not None and sizes != due:
                raise ValueError("its curves have other names or lengths")
            return Unfinished(done, _like(state, found["state"]), curves)

        name = f"{_UNFINISHED}/{stage}"
        return self._or_forget(name, lambda: self._load(name, (state, whole), restore))

    def forget_unfinished(self, stages: Iterable[str]) -> None:
        """Removes the checkpoints of unfinished trainings of stages; files of others stay."""
        if self.path is None:
            return
        with contextlib.suppress(OSError):
            for stage in stages:
                self._file(f"{_UNFINISHED}/{stage}").unlink(missing_ok=True)
            (self.path / _UNFINISHED).rmdir()

    def _load(self, name: str, shapes: PyTree, restore: Callable[[PyTree], T]) -> T | None:
        """Applies `restore` to the content of a checkpoint of such arrays; see `load`."""
        if self.path is None:
            return None
        most = _REST + 8 * sum(getattr(x, "size", 1) for x in jax.tree.leaves(shapes))
        try:
            content = files.without_digest(inside.read(self._file(name), most))
            return restore(serialization.msgpack_restore(content))
        except FileNotFoundError:
            return None
        except OSError as error:
            reason = f"cannot be read ({error.strerror})"
        except Exception as error:  # the digest may be right and the content of any form
            first, *_ = str(error).splitlines() or [type(error).__name__]
            reason = f"is damaged or of other settings ({first})"
        raise ConfigError("checkpoint", f"{self.path}/{name}{_SUFFIX}", reason)

    def _or_forget(self, name: str, load: Callable[[], T | None]) -> T | None:
        """What `load` returns; see `load_or_forget`."""
        try:
            return load()
        except ConfigError as error:
            file = self._file(name)
            file.replace(file.with_name(f"{file.name}.damaged"))
            self._warn(f"{error}; retraining it")
            return None

    def _file(self, name: str) -> Path:
        """The file of a checkpoint, which may be a link; raises `OSError` if it is elsewhere."""
        assert self.path is not None
        file = self.path / f"{name}{_SUFFIX}"
        return inside.place(file.parent, self.path.parent) / file.name


def _like(shapes: PyTree[T], found: PyTree, finite: bool = False) -> PyTree[np.ndarray]:
    """A tree like `shapes` from nested dictionaries; raises `ValueError` if they differ."""

    def check(expected: jax.ShapeDtypeStruct, found: np.ndarray) -> np.ndarray:
        found = np.asarray(found)
        if (found.shape, found.dtype) != (expected.shape, expected.dtype):
            wanted = f"{expected.dtype}{expected.shape}"
            raise ValueError(f"{found.dtype}{found.shape} in place of {wanted}")
        return found

    if jax.tree.structure(serialization.to_state_dict(shapes)) != jax.tree.structure(found):
        raise ValueError("it holds other arrays")
    if finite and not is_finite(found):
        raise ValueError("it holds numbers that are not finite")
    return jax.tree.map(check, shapes, serialization.from_state_dict(shapes, found))
