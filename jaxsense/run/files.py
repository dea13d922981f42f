"""Files that are written whole or not at all, and locks of directories."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path

import filelock

_DIGEST = hashlib.sha256().digest_size
_PARTIAL_NAME = re.compile(r"\.(.+)\.[0-9a-f]{16}\.unfinished")
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


def write(path: Path, content: str | bytes, mode: int = 0o666) -> None:
    """Replaces a file atomically: readers never see a part of it, even after a power failure.

    Args:
      path: the file.
      content: of the file; text is encoded as UTF-8.
      mode: permissions of the file, before the umask.

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


def is_unfinished(path: Path, name: str | None = None) -> bool:
    """Whether a killed `write` of the file `name`, or of any, left this partial file."""
    found = _PARTIAL_NAME.fullmatch(path.name)
    is_ours = found is not None and name in (None, found[1])
    return is_ours and path.is_file() and not path.is_symlink()


def remove_unfinished(directory: Path) -> None:
    """Removes the partial files of a killed `write` from a directory."""
    for path in filter(is_unfinished, directory.iterdir()):
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
