"""Files of a run: written whole or not at all, read without trust; locks and checkpoints."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import filelock
import jax
import numpy as np
from flax import serialization
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.core import inside
from jaxsense.core.types import by_place, placed
from jaxsense.run.monitor import is_finite
from jaxsense.run.output import complain

T = TypeVar("T")

_SUFFIX = ".msgpack"
UNFINISHED = "unfinished"
"""The directory of unfinished trainings in that of checkpoints."""
_REST = 2**20  # bytes of a checkpoint that are not numbers
_DIGEST = hashlib.sha256().digest_size
_PARTIAL_NAME = re.compile(r"\..+\.[0-9a-f]{16}\.unfinished")
_WAIT_BEFORE_NOTICE = 1.0  # s


class WriteError(OSError):
    """A file that cannot be written."""


@contextlib.contextmanager
def _naming_errors(path: Path) -> Iterator[None]:
    """Raises errors as `WriteError` with the path."""
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise WriteError(error.errno, reason, str(path)) from error


def write(path: Path, content: str | bytes, mode: int = 0o666, *, is_new: bool = False) -> None:
    """Replaces a file atomically: readers never see a part of it, even after a power failure.

    Args:
      content: of the file; text is encoded as UTF-8.
      mode: permissions of the file, before the umask.
      is_new: whether there must be no such file yet, nor a link.

    Raises:
      WriteError: if the file cannot be written; it is then unchanged.
    """
    # Unique, since another process may write the same file.
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.unfinished")
    with _naming_errors(path):
        try:
            partial.touch(mode, exist_ok=False)
            with partial.open("wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            if is_new:
                path.touch(exist_ok=False)
            partial.replace(path)
            with contextlib.suppress(OSError):  # not all systems let directories be written
                directory = os.open(path.parent, os.O_RDONLY)
                try:
                    os.fsync(directory)
                finally:
                    os.close(directory)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def write_digested(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Writes a file as `write` does, with the SHA-256 digest of its content before it."""
    write(path, hashlib.sha256(content).digest() + content, mode)


def without_digest(whole: bytes) -> bytes:
    """The content that `write_digested` wrote; raises `ValueError` if it is damaged."""
    content = whole[_DIGEST:]
    if hashlib.sha256(content).digest() != whole[:_DIGEST]:
        raise ValueError("wrong digest")
    return content


def append(path: Path, line: str) -> None:
    """Adds a line to a text file; raises `WriteError` if it cannot be written."""
    with _naming_errors(path), path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def remove_unfinished(directory: Path) -> None:
    """Removes the partial files of a killed `write` from a directory."""
    for path in directory.iterdir():
        if _PARTIAL_NAME.fullmatch(path.name) and path.is_file() and not path.is_symlink():
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def locked(directory: Path, on_wait: Callable[[str], None] | None = None) -> Iterator[None]:
    """Locks a directory for this process, with the file `.lock` in it.

    Args:
      directory: must exist.
      on_wait: receives one line if another process still holds the lock after a second. Without
        it, `locked` does not wait.

    Raises:
      BlockingIOError: if another process holds the lock and there is no `on_wait`.
      OSError: if the lock cannot be taken.
    """
    lock = filelock.FileLock(directory / ".lock")
    try:
        lock.acquire(timeout=0 if on_wait is None else _WAIT_BEFORE_NOTICE)
    except filelock.Timeout:
        if on_wait is None:
            reason = "another process is writing to it; wait for it to end"
            raise BlockingIOError(errno.EAGAIN, reason, str(directory)) from None
        on_wait(f"Waiting for another process to finish writing to {directory}.")
        lock.acquire(timeout=-1)
    try:
        yield
    finally:
        lock.release()


class Checkpoints:
    """Checkpoints of a run in a directory.

    A damaged checkpoint is set aside and its content is trained again, with the same result, since
    seed and settings determine a run.

    Attributes:
      path: the directory.
    """

    def __init__(self, path: Path):
        """Opens a directory, which need not exist."""
        self.path = path

    def save(self, name: str, tree: PyTree) -> None:
        """Saves a pytree of arrays; raises `OSError` if the file cannot be written."""
        file, tree = self._file(name), jax.tree.map(np.asarray, tree)
        file.parent.mkdir(parents=True, exist_ok=True)
        content = serialization.msgpack_serialize(by_place(tree))
        write_digested(file, content)

    def load(self, name: str, shapes: PyTree[T], finite: bool = False) -> PyTree:
        """Loads a checkpoint.

        Args:
          name: as in `save`.
          shapes: a tree of the same structure and shapes.
          finite: whether all numbers must be finite.

        Returns:
          The tree, with arrays on the host.

        Raises:
          ConfigError: if the file is missing, damaged or holds arrays of other shapes.
        """
        most = _REST + 8 * sum(x.size for x in jax.tree.leaves(shapes))
        try:
            content = without_digest(inside.read(self._file(name), most))
            found: Any = serialization.msgpack_restore(content)
            if found.keys() != by_place(shapes).keys():
                raise ValueError("it holds other arrays")
            tree = placed(shapes, found)
            if finite and not is_finite(tree):
                raise ValueError("it holds numbers that are not finite")
            return tree
        except FileNotFoundError:
            reason = "is missing; must be that of a finished run"
        except OSError as error:
            reason = f"cannot be read ({error.strerror})"
        except Exception as error:  # the digest may be right and the content of any form
            first, *_ = str(error).splitlines() or [type(error).__name__]
            reason = f"is damaged or of other settings ({first})"
        raise ConfigError("checkpoint", f"{self.path}/{name}{_SUFFIX}", reason)

    def load_or_forget(self, name: str, shapes: PyTree[T], finite: bool = False) -> PyTree | None:
        """As `load`; None if there is no file, or, with a warning, if it must be set aside."""
        if not os.path.lexists(file := self._file(name)):
            return None
        try:
            return self.load(name, shapes, finite)
        except ConfigError as error:
            file.replace(file.with_name(f"{file.name}.damaged"))
            complain(f"{error}; retraining it")
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
