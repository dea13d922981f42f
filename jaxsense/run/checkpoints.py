"""Checkpoints of a run: finished stages, and trainings under way.

A checkpoint is one file: a SHA-256 digest, then arrays in the format of `flax.serialization`.
"""

import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from flax import serialization

from jaxsense.config import ConfigError
from jaxsense.run import files

T = TypeVar("T")

_SUFFIX = ".msgpack"
_AGAIN = "its content is trained again"
_LIST = "saved"
"""The checkpoint that lists all others, to detect a missing file."""

Curves = dict[str, list[float]]
"""Metrics of a training so far, by name."""


class Unfinished(NamedTuple):
    """A training under way.

    Attributes:
      done: chunks so far.
      state: input of the next chunk.
      curves: metrics of the chunks so far.
    """

    done: int
    state: Any
    curves: Curves


class Checkpoints:
    """The checkpoints of a run in a directory; without one, nothing is saved or found.

    A damaged checkpoint is put aside and trained again, with the same result: a run follows from
    its seed and settings.

    Attributes:
      path: the directory.
    """

    def __init__(
        self,
        path: Path | None = None,
        warn: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
    ):
        """Takes the directory, and a function that receives warnings of damaged checkpoints."""
        self.path, self._warn = path, warn
        self._lock = threading.Lock()

    def exists(self) -> bool:
        """Whether anything was saved."""
        return self.path is not None and self.path.exists()

    def save(self, name: str, tree: Any) -> None:
        """Saves something finished; an `OSError` names a file that cannot be written."""
        if self.path is None:
            return
        self._file(name).parent.mkdir(parents=True, exist_ok=True)
        with self._lock:
            if not self._file(_LIST).exists():
                self._write(_LIST, [])
        self._write(name, serialization.to_state_dict(jax.tree.map(np.asarray, tree)))
        with self._lock:
            self._list(self._listed() | {name})

    def load(self, name: str, shapes: Any) -> Any:
        """Loads what `save` saved.

        Args:
          name: as in `save`.
          shapes: a tree of the same structure and shapes.

        Returns:
          The tree, with arrays on the host; None if nothing was saved.

        Raises:
          ConfigError: names a file that is damaged, missing, or of other shapes.
        """
        return self._load(name, lambda found: _like(shapes, found))

    def load_or_forget(self, name: str, shapes: Any) -> Any:
        """`load`, but warns of a file that cannot be used, puts it aside and returns None."""
        return self._or_forget(name, lambda found: _like(shapes, found))

    def save_unfinished(self, stage: str, unfinished: Unfinished) -> None:
        """Saves a training under way over its last checkpoint; see `save`."""
        curves = {name: np.array(values, np.float64) for name, values in unfinished.curves.items()}
        saved = {"done": np.int64(unfinished.done), "state": unfinished.state, "curves": curves}
        self.save(_unfinished(stage), saved)

    def load_unfinished(self, stage: str, state: Any) -> Unfinished | None:
        """Loads a training under way.

        Args:
          stage: its name.
          state: any state of it, for structure and shapes.

        Returns:
          The training as last saved; None if it was not, or if the file is damaged.
        """

        def restore(found: Any) -> Unfinished:
            curves = {name: values.tolist() for name, values in found["curves"].items()}
            return Unfinished(int(found["done"]), _like(state, found["state"]), curves)

        return self._or_forget(_unfinished(stage), restore)

    def forget_unfinished(self) -> None:
        """Removes all trainings under way, once the run is finished."""
        if self.path is not None:
            shutil.rmtree(self.path / _unfinished(""), ignore_errors=True)
            with self._lock:
                self._list(
                    {name for name in self._listed() if not name.startswith(_unfinished(""))}
                )

    def check(self, is_begun: bool = False) -> None:
        """Warns of checkpoints that are damaged or missing, and puts them aside.

        Args:
          is_begun: whether training has begun, so that an absent directory is missing.
        """
        if self.path is None:
            return
        if not self.path.exists():
            if is_begun:
                error = ConfigError("checkpoints", str(self.path), "is missing")
                self._warn(f"{error}; everything is trained again")
            return
        there = self._there()
        if there or self._file(_LIST).exists():
            self._check(_LIST, "the run resumes from all checkpoints found")
        expected = sorted(self._listed() | there)
        sound = {name for name in expected if self._check(name)}
        self._write(_LIST, sorted(sound))

    def _check(self, name: str, consequence: str = _AGAIN) -> bool:
        """Whether a checkpoint is as it was saved; if not, warns and puts it aside."""
        try:
            _read(self._file(name))
        except (OSError, ValueError) as error:
            self._forget(name, _what_is_wrong(error), consequence)
            return False
        return True

    def directories(self) -> list[Path]:
        """The existing directories of checkpoints."""
        if self.path is None:
            return []
        return [p for p in (self.path, self.path / _unfinished("")) if p.is_dir()]

    def _there(self) -> set[str]:
        """Names of all checkpoints on disk, except the list."""
        assert self.path is not None
        found = (file.relative_to(self.path).as_posix() for file in self.path.rglob(f"*{_SUFFIX}"))
        return {name.removesuffix(_SUFFIX) for name in found} - {_LIST}

    def _listed(self) -> set[str]:
        """Names of all checkpoints that were saved; those on disk if the list is damaged."""
        try:
            return set(_read(self._file(_LIST)))
        except (OSError, ValueError):
            return self._there()

    def _list(self, names: set[str]) -> None:
        if names != self._listed():
            self._write(_LIST, sorted(names))

    def _write(self, name: str, content: Any) -> None:
        packed = serialization.msgpack_serialize(content)
        files.write(self._file(name), files.with_digest(packed))

    def _load(self, name: str, restore: Callable[[Any], T]) -> T | None:
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
            raise self._error(name, _what_is_wrong(error)) from None

    def _or_forget(self, name: str, restore: Callable[[Any], T]) -> T | None:
        try:
            return self._load(name, restore)
        except ConfigError as error:
            self._forget(name, error.expected)
            return None

    def _forget(self, name: str, reason: str, consequence: str = _AGAIN) -> None:
        """Puts a checkpoint aside, with a warning."""
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
    """The checkpoint's name of a training under way."""
    return f"unfinished/{stage}"


def _read(file: Path) -> Any:
    """A checkpoint's content as nested dictionaries; raises `ValueError` if it is damaged."""
    return serialization.msgpack_restore(files.without_digest(file.read_bytes()))


def _what_is_wrong(error: Exception) -> str:
    """Why a checkpoint cannot be used."""
    if isinstance(error, FileNotFoundError):
        return "is missing"
    if isinstance(error, OSError):
        return f"cannot be read ({error.strerror})"
    return f"is damaged or of other settings ({str(error).splitlines()[0]})"


def _like(shapes: Any, found: Any) -> Any:
    """A tree like `shapes` from nested dictionaries; raises `ValueError` if they differ."""

    def check(expected: Any, found: Any) -> np.ndarray:
        found = np.asarray(found)
        if (found.shape, found.dtype) != (expected.shape, expected.dtype):
            raise ValueError(
                f"{found.dtype}{found.shape} in place of {expected.dtype}{expected.shape}"
            )
        return found

    if jax.tree.structure(serialization.to_state_dict(shapes)) != jax.tree.structure(found):
        raise ValueError("it holds other arrays")
    return jax.tree.map(check, shapes, serialization.from_state_dict(shapes, found))
