"""Writes files as a whole or not at all, and locks directories."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import filelock

_DIGEST = hashlib.sha256().digest_size
_UNFINISHED_NAME = re.compile(r"\.(.+)\.[0-9a-f]{16}\.unfinished")
"""Names of partial files."""


class WriteError(OSError):
    """A file that cannot be written."""


def write(path: Path, content: str | bytes, mode: int = 0o666) -> None:
    """Writes a file so that a reader never sees a part of it, even after a power failure.

    Args:
      path: the file; an existing one is replaced.
      content: of the file; text as UTF-8.
      mode: of the file, before the umask.

    Raises:
      WriteError: names the file, which is then unchanged.
    """
    unfinished = _unfinished(path)
    try:
        unfinished.touch(mode, exist_ok=False)
        with unfinished.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
        _sync(path.parent)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise WriteError(error.errno, reason, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def is_unfinished(path: Path, name: str | None = None) -> bool:
    """Whether this is a partial file of a killed `write`, of the file `name` if given."""
    found = _UNFINISHED_NAME.fullmatch(path.name)
    is_ours = found is not None and name in (None, found[1])
    return is_ours and path.is_file() and not path.is_symlink()


def remove_unfinished(directory: Path) -> None:
    """Removes partial files of a killed `write` from a directory."""
    for path in filter(is_unfinished, directory.iterdir()):
        with contextlib.suppress(OSError):
            path.unlink()


@contextlib.contextmanager
def new(path: Path) -> Iterator[IO[bytes]]:
    """Opens a new file, which has its name only once it is whole.

    Raises:
      FileExistsError: if the path exists, now or at the end.
      OSError: if it cannot be written.
    """
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    unfinished = _unfinished(path)
    try:
        with unfinished.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _name(unfinished, path)
        _sync(path.parent)
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def _name(unfinished: Path, path: Path) -> None:
    """Names a file; raises `FileExistsError` if another has this name."""
    try:
        os.link(unfinished, path)
    except FileExistsError:
        raise
    except OSError:  # without links
        path.open("xb").close()
        unfinished.replace(path)


def _unfinished(path: Path) -> Path:
    """A name for a partial file, unique as another process may write the same file."""
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}.unfinished")


def append(path: Path, line: str) -> None:
    """Adds a line to a text file; a `WriteError` names a file that cannot be written."""
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
    except OSError as error:
        raise WriteError(error.errno, error.strerror, str(path)) from error


def _sync(directory: Path) -> None:
    """Makes the names in a directory durable, where the system can."""
    with contextlib.suppress(OSError):
        number = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


@contextlib.contextmanager
def locked(directory: Path, *, waits: bool) -> Iterator[None]:
    """Locks a directory for this process, by the file `.lock` in it.

    Args:
      directory: must exist.
      waits: wait until another process releases the directory.

    Raises:
      BlockingIOError: if another process holds the lock, and `waits` is False.
      OSError: if the lock cannot be taken.
    """
    lock = filelock.FileLock(directory / ".lock", timeout=-1 if waits else 0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise BlockingIOError(f"{directory} is kept by another process") from None
    try:
        yield
    finally:
        lock.release()


def with_digest(content: bytes) -> bytes:
    """A file's content after its SHA-256 digest."""
    return hashlib.sha256(content).digest() + content


def without_digest(whole: bytes) -> bytes:
    """The content of a file from `with_digest`; raises `ValueError` if it is damaged."""
    content = whole[_DIGEST:]
    if hashlib.sha256(content).digest() != whole[:_DIGEST]:
        raise ValueError("its content does not have its digest")
    return content
