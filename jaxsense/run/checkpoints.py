"""Checkpoints of a run: finished stages and unfinished trainings.

A checkpoint is one file: a SHA-256 digest, then arrays in the format of `flax.serialization`.
"""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np
from flax import serialization
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.core import inside
from jaxsense.run import files
from jaxsense.run.monitor import is_finite

T = TypeVar("T")

_SUFFIX = ".msgpack"
UNFINISHED = "unfinished"
"""The directory of unfinished trainings in that of checkpoints."""
_REST = 2**20  # bytes of a checkpoint that are not numbers


class Checkpoints:
    """Checkpoints of a run in a directory.

    A damaged checkpoint is set aside and its content is trained again, with the same result, since
    seed and settings determine a run.

    Attributes:
      path: the directory.
    """

    def __init__(
        self,
        path: Path,
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
        most = _REST + 8 * sum(x.size for x in jax.tree.leaves(shapes))
        try:
            content = files.without_digest(inside.read(self._file(name), most))
            return _like(shapes, serialization.msgpack_restore(content), finite)
        except FileNotFoundError:
            return None
        except OSError as error:
            reason = f"cannot be read ({error.strerror})"
        except Exception as error:  # the digest may be right and the content of any form
            first, *_ = str(error).splitlines() or [type(error).__name__]
            reason = f"is damaged or of other settings ({first})"
        raise ConfigError("checkpoint", f"{self.path}/{name}{_SUFFIX}", reason)

    def load_or_forget(self, name: str, shapes: PyTree[T], finite: bool = False) -> PyTree | None:
        """As `load`, but warns and sets the file aside if it cannot be used, and returns None."""
        try:
            return self.load(name, shapes, finite)
        except ConfigError as error:
            file = self._file(name)
            file.replace(file.with_name(f"{file.name}.damaged"))
            self._warn(f"{error}; retraining it")
            return None

    def forget_unfinished(self, stages: Iterable[str]) -> None:
        """Removes the checkpoints of unfinished trainings of stages; files of others stay."""
        with contextlib.suppress(OSError):
            for stage in stages:
                self._file(f"{UNFINISHED}/{stage}").unlink(missing_ok=True)
            (self.path / UNFINISHED).rmdir()

    def _file(self, name: str) -> Path:
        """The file of a checkpoint, which may be a link; raises `OSError` if it is elsewhere."""
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
