"""Atomic writes of files, and locks of directories."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import filelock

_DIGEST = hashlib.sha256().digest_size
_PARTIAL_NAME = re.compile(r"\.(.+)\.[0-9a-f]{16}\.unfinished")
_WAIT_BEFORE_NOTICE = 1.0  # s


class WriteError(OSError):
    """A file that cannot be written."""


def write(path: Path, content: str | bytes, mode: int = 0o666) -> None:
    """Writes a file atomically: readers never see a part of it, even after a power failure.

    Args:
      path: the file; an existing one is replaced.
      content: of the file; text is encoded as UTF-8.
      mode: permissions of the file, before the umask.

    Raises:
      WriteError: if the file cannot be written; it is then unchanged.
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


def write_digested(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Writes a file as `write` does, with the SHA-256 digest of its content before it."""
    write(path, hashlib.sha256(content).digest() + content, mode)


def is_unfinished(path: Path, name: str | None = None) -> bool:
    """Whether a killed `write` left this partial file.

    Args:
      path: the file.
      name: of the file that was being written; any by default.
    """
    found = _PARTIAL_NAME.fullmatch(path.name)
    is_ours = found is not None and name in (None, found[1])
    return is_ours and path.is_file() and not path.is_symlink()


def remove_unfinished(directory: Path) -> None:
    """Removes the partial files of a killed `write` from a directory."""
    for path in filter(is_unfinished, directory.iterdir()):
        with contextlib.suppress(OSError):
            path.unlink()


@contextlib.contextmanager
def new(path: Path) -> Iterator[IO[bytes]]:
    """Opens a new file, which appears under its name only once it is complete.

    Args:
      path: the file.

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
    """Gives a file its name; raises `FileExistsError` if the name is taken."""
    try:
        os.link(unfinished, path)
    except FileExistsError:
        raise
    except OSError:  # the file system has no links
        path.open("xb").close()
        unfinished.replace(path)


def _unfinished(path: Path) -> Path:
    """A unique name for a partial file, since another process may write the same file."""
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}.unfinished")


def append(path: Path, line: str) -> None:
    """Adds a line to a text file.

    Args:
      path: the file.
      line: without its end.

    Raises:
      WriteError: if the file cannot be written.
    """
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
    except OSError as error:
        raise WriteError(error.errno, error.strerror, str(path)) from error


def _sync(directory: Path) -> None:
    """Makes the names in a directory durable, where the system supports it."""
    with contextlib.suppress(OSError):
        number = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


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
            raise BlockingIOError(f"another process holds {directory}") from None
        on_wait(f"Waiting for another process to finish writing to {directory}.")
        lock.acquire(timeout=-1)
    try:
        yield
    finally:
        lock.release()


def without_digest(whole: bytes) -> bytes:
    """Removes the digest from a file's content.

    Args:
      whole: the bytes that `write_digested` wrote.

    Raises:
      ValueError: if the content is damaged.
    """
    content = whole[_DIGEST:]
    if hashlib.sha256(content).digest() != whole[:_DIGEST]:
        raise ValueError("wrong digest")
    return content
