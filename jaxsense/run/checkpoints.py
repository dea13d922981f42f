"""Checkpoints of a run: finished stages and unfinished trainings.

A checkpoint is one file: a SHA-256 digest, then arrays in the format of `flax.serialization`.
"""

import contextlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from flax import serialization
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.run import files

T = TypeVar("T")

Curves = dict[str, list[float]]
"""Metrics of a training so far, by name."""

_SUFFIX = ".msgpack"
_UNFINISHED = "unfinished"
_RETRAINED = "retraining it"
_LIST = "saved"  # the checkpoint that lists all others, to detect a missing file


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

    def exists(self) -> bool:
        """Whether anything was saved."""
        return self.path is not None and self.path.exists()

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
        with self._lock:
            self._list(self._listed() | {name})
            self._saved(name)

    def load(self, name: str, shapes: PyTree[T]) -> PyTree[np.ndarray] | None:
        """Loads a checkpoint.

        Args:
          name: as in `save`.
          shapes: a tree of the same structure and shapes.

        Returns:
          The tree, with arrays on the host; None if it was not saved.

        Raises:
          ConfigError: if the file is damaged, missing, or holds arrays of other shapes.
        """
        return self._load(name, lambda found: _like(shapes, found))

    def load_or_forget(self, name: str, shapes: PyTree[T]) -> PyTree[np.ndarray] | None:
        """Loads a checkpoint, or warns and sets its file aside if it cannot be used.

        Args:
          name: as in `save`.
          shapes: a tree of the same structure and shapes.

        Returns:
          The tree, as in `load`, or None.
        """
        return self._or_forget(name, lambda found: _like(shapes, found))

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

    def load_unfinished(self, stage: str, state: PyTree) -> Unfinished | None:
        """Loads an unfinished training.

        Args:
          stage: its name.
          state: any state of it, for structure and shapes.

        Returns:
          The training as last saved; None if there is none, or its file is damaged.
        """

        def restore(found: PyTree) -> Unfinished:
            curves = {name: values.tolist() for name, values in found["curves"].items()}
            return Unfinished(int(found["done"]), _like(state, found["state"]), curves)

        return self._or_forget(_unfinished(stage), restore)

    def forget_unfinished(self) -> None:
        """Removes the checkpoints of unfinished trainings, once the run is finished."""
        if self.path is None:
            return
        with self._lock:
            listed = self._listed()
            forgotten = {name for name in listed if name.startswith(_unfinished(""))}
            self._list(listed - forgotten)
        with contextlib.suppress(OSError):
            for name in forgotten:
                self._file(name).unlink(missing_ok=True)
            # Stays if it holds files of others, or is a link.
            (self.path / _UNFINISHED).rmdir()

    def check(self, is_begun: bool = False) -> None:
        """Warns of checkpoints that are damaged or missing, and sets their files aside.

        Args:
          is_begun: whether training has begun, so that the directory should exist.
        """
        if self.path is None:
            return
        if not self.path.exists():
            if is_begun:
                error = ConfigError("checkpoints", str(self.path), "is missing")
                self._warn(f"{error}; retraining everything")
            return
        if self._sound() or self._file(_LIST).exists():
            self._check(_LIST, "resuming from all checkpoints found")
        sound = {name for name in sorted(self._listed()) if self._check(name)}
        self._write(_LIST, sorted(sound))

    def _check(self, name: str, consequence: str = _RETRAINED) -> bool:
        """Whether a checkpoint is intact; if not, warns and sets it aside."""
        try:
            _read(self._file(name))
        except (OSError, ValueError) as error:
            self._forget(name, _reason(error), consequence)
            return False
        return True

    def directories(self) -> list[Path]:
        """The existing directories of checkpoints."""
        if self.path is None:
            return []
        return [p for p in (self.path, self.path / _UNFINISHED) if p.is_dir()]

    def _sound(self) -> set[str]:
        """Names of all intact checkpoints on disk, except the list; other files are the user's."""
        assert self.path is not None
        found = set[str]()
        for place in self.directories():
            for file in place.glob(f"*{_SUFFIX}"):
                with contextlib.suppress(OSError, ValueError):
                    _read(file)
                    found.add(file.relative_to(self.path).as_posix().removesuffix(_SUFFIX))
        return found - {_LIST}

    def _listed(self) -> set[str]:
        """Names of all checkpoints that were saved; of all intact ones if the list is damaged."""
        try:
            return set(_read(self._file(_LIST)))
        except (OSError, ValueError):
            return self._sound()

    def _list(self, names: set[str]) -> None:
        """Writes the list if it has changed."""
        if names != self._listed():
            self._write(_LIST, sorted(names))

    def _write(self, name: str, content: PyTree) -> None:
        files.write_digested(self._file(name), serialization.msgpack_serialize(content))

    def _load(self, name: str, restore: Callable[[PyTree], T]) -> T | None:
        """Applies `restore` to a checkpoint's content; see `load`."""
        if self.path is None:
            return None
        if not self._file(name).exists():
            if name in self._listed():
                raise self._error(name, "is missing")
            return None
        try:
            return restore(_read(self._file(name)))
        except (OSError, ValueError, KeyError) as error:
            raise self._error(name, _reason(error)) from None

    def _or_forget(self, name: str, restore: Callable[[PyTree], T]) -> T | None:
        """Applies `restore` to a checkpoint's content; see `load_or_forget`."""
        try:
            return self._load(name, restore)
        except ConfigError as error:
            self._forget(name, error.expected)
            return None

    def _forget(self, name: str, reason: str, consequence: str = _RETRAINED) -> None:
        """Sets a checkpoint aside, with a warning."""
        file = self._file(name)
        if file.exists():
            file.replace(file.with_name(f"{file.name}.damaged"))
        self._warn(f"{self._error(name, reason)}; {consequence}")

    def _error(self, name: str, reason: str) -> ConfigError:
        return ConfigError("checkpoint", str(self._file(name)), reason)

    def _file(self, name: str) -> Path:
        assert self.path is not None
        return self.path / f"{name}{_SUFFIX}"


def _unfinished(stage: str) -> str:
    """Name of the checkpoint of an unfinished training."""
    return f"{_UNFINISHED}/{stage}"


def _read(file: Path) -> PyTree:
    """A checkpoint's content in nested dictionaries; raises `ValueError` if it is damaged."""
    return serialization.msgpack_restore(files.without_digest(file.read_bytes()))


def _reason(error: Exception) -> str:
    """Why a checkpoint cannot be used."""
    if isinstance(error, FileNotFoundError):
        return "is missing"
    if isinstance(error, OSError):
        return f"cannot be read ({error.strerror})"
    return f"is damaged or of other settings ({str(error).splitlines()[0]})"


def _like(shapes: PyTree[T], found: PyTree) -> PyTree[np.ndarray]:
    """A tree like `shapes` from nested dictionaries; raises `ValueError` if they differ."""

    def check(expected: jax.ShapeDtypeStruct, found: np.ndarray) -> np.ndarray:
        found = np.asarray(found)
        if (found.shape, found.dtype) != (expected.shape, expected.dtype):
            wanted = f"{expected.dtype}{expected.shape}"
            raise ValueError(f"{found.dtype}{found.shape} in place of {wanted}")
        return found

    if jax.tree.structure(serialization.to_state_dict(shapes)) != jax.tree.structure(found):
        raise ValueError("it holds other arrays")
    return jax.tree.map(check, shapes, serialization.from_state_dict(shapes, found))
