"""Checkpoints of a run: finished stages and unfinished trainings.

A checkpoint is one file: a SHA-256 digest, then arrays in the format of `flax.serialization`.
"""

import contextlib
import os
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
_RETRAINED = "retraining it"
_LIST = "saved"  # the checkpoint that lists all others, only to detect a missing file
_MOST_NAMES = 1000
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
        """Saves a pytree.

        Args:
          name: of the checkpoint.
          tree: of arrays.

        Raises:
          OSError: if the file cannot be written.
        """
        if self.path is None:
            return
        self._file(name).parent.mkdir(parents=True, exist_ok=True)
        with self._lock:
            if not self._file(_LIST).exists():
                self._write(_LIST, [])
        self._write(name, serialization.to_state_dict(jax.tree.map(np.asarray, tree)))
        self._relist(lambda listed: listed | {name})
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
          ConfigError: if the file is damaged, missing, or holds arrays of other shapes.
        """
        return self._load(name, shapes, lambda found: _like(shapes, found, finite))

    def load_or_forget(self, name: str, shapes: PyTree[T], finite: bool = False) -> PyTree | None:
        """Loads a checkpoint, or warns and sets its file aside if it cannot be used.

        Args:
          name: as in `save`.
          shapes: a tree of the same structure and shapes.
          finite: see `load`.

        Returns:
          The tree, as in `load`, or None.
        """
        return self._or_forget(name, lambda: self.load(name, shapes, finite))

    def save_unfinished(self, stage: str, unfinished: Unfinished) -> None:
        """Saves an unfinished training over its previous checkpoint.

        Args:
          stage: its name.
          unfinished: the training so far.

        Raises:
          OSError: if the file cannot be written.
        """
        curves = {name: np.array(values, np.float64) for name, values in unfinished.curves.items()}
        saved = {"done": np.int64(unfinished.done), "state": unfinished.state, "curves": curves}
        self.save(_unfinished(stage), saved)

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

        name = _unfinished(stage)
        return self._or_forget(name, lambda: self._load(name, (state, whole), restore))

    def forget_unfinished(self, stages: Iterable[str]) -> None:
        """Removes the checkpoints of unfinished trainings, once the run is finished.

        Args:
          stages: names of all stages; other files stay.
        """
        if self.path is None:
            return
        names = {_unfinished(stage) for stage in stages}
        self._relist(lambda listed: listed - names)
        with contextlib.suppress(OSError):
            for name in names:
                self._file(name).unlink(missing_ok=True)
            # Stays if it holds files of others.
            (self.path / _UNFINISHED).rmdir()

    def check(self, is_begun: bool = False) -> None:
        """Warns of checkpoints that are missing, and makes the list of all anew if it is damaged.

        Args:
          is_begun: whether training has begun, so that the directory should exist.

        Raises:
          OSError: if the directory leads out of the run, or cannot be written.
        """
        assert self.path is not None
        if not self._file(_LIST).parent.exists():
            if is_begun:
                self._warn(f"checkpoints = '{self.path}': is missing; retraining everything")
            return
        try:
            names = self._names()
        except (OSError, ValueError) as error:
            self._forget(_LIST, _reason(error), "resuming from all checkpoints found")
            names = set[str]()
        # They are only looked for: they might be paths.
        missing = {name for name in names if not os.path.lexists(self.path / f"{name}{_SUFFIX}")}
        for name in sorted(missing):
            self._warn(f"{self._error(name, 'is missing')}; {_RETRAINED}")
        self._write(_LIST, sorted(names - missing))

    def _names(self) -> set[str]:
        """Names in the list; raises `OSError` or `ValueError` if it cannot be used."""
        names = self._read(_LIST, (), set)
        if len(names) > _MOST_NAMES or not all(isinstance(name, str) for name in names):
            raise ValueError("it holds other than names")
        return names

    def _listed(self) -> set[str]:
        """Names of all checkpoints that were saved, none if the list is damaged."""
        try:
            return self._names()
        except (OSError, ValueError):
            return set()

    def _relist(self, change: Callable[[set[str]], set[str]]) -> None:
        """Writes the list if it has changed."""
        with self._lock:
            if (names := change(listed := self._listed())) != listed:
                self._write(_LIST, sorted(names))

    def _write(self, name: str, content: PyTree) -> None:
        files.write_digested(self._file(name), serialization.msgpack_serialize(content))

    def _load(self, name: str, shapes: PyTree, restore: Callable[[PyTree], T]) -> T | None:
        """Applies `restore` to the content of a checkpoint of such arrays; see `load`."""
        if self.path is None:
            return None
        try:
            return self._read(name, shapes, restore)
        except FileNotFoundError:
            if name in self._listed():
                raise self._error(name, "is missing") from None
            return None
        except (OSError, ValueError) as error:
            raise self._error(name, _reason(error)) from None

    def _or_forget(self, name: str, load: Callable[[], T | None]) -> T | None:
        """What `load` returns; see `load_or_forget`."""
        try:
            return load()
        except ConfigError as error:
            self._forget(name, error.expected)
            return None

    def _forget(self, name: str, reason: str, consequence: str = _RETRAINED) -> None:
        """Sets a checkpoint aside, with a warning."""
        file = self._file(name)
        if os.path.lexists(file):
            file.replace(file.with_name(f"{file.name}.damaged"))
        self._relist(lambda listed: listed - {name})
        self._warn(f"{self._error(name, reason)}; {consequence}")

    def _error(self, name: str, reason: str) -> ConfigError:
        return ConfigError("checkpoint", f"{self.path}/{name}{_SUFFIX}", reason)

    def _file(self, name: str) -> Path:
        """The file of a checkpoint, which may be a link; raises `OSError` if it is elsewhere."""
        assert self.path is not None
        file = self.path / f"{name}{_SUFFIX}"
        return inside.place(file.parent, self.path.parent) / file.name

    def _read(self, name: str, shapes: PyTree, restore: Callable[[PyTree], T]) -> T:
        """Applies `restore` to a checkpoint's content, in nested dictionaries.

        Raises `OSError` if the file cannot be read or is larger than `shapes`, and `ValueError` if
        it is damaged.
        """
        most = _REST + 8 * sum(getattr(x, "size", 1) for x in jax.tree.leaves(shapes))
        content = inside.read(self._file(name), most)
        try:
            return restore(serialization.msgpack_restore(files.without_digest(content)))
        except Exception as error:  # the digest may be right and the content of any form
            raise ValueError(str(error) or type(error).__name__) from None


def _unfinished(stage: str) -> str:
    """Name of the checkpoint of an unfinished training."""
    return f"{_UNFINISHED}/{stage}"


def _reason(error: Exception) -> str:
    """Why a checkpoint cannot be used."""
    if isinstance(error, FileNotFoundError):
        return "is missing"
    if isinstance(error, OSError):
        return f"cannot be read ({error.strerror})"
    return f"is damaged or of other settings ({str(error).splitlines()[0]})"


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
