"""Files of a directory that somebody else may have filled: none of them is believed."""

import errno
import os
import stat
from pathlib import Path

LARGEST = 2**24
"""Largest file of text, in bytes: as Python objects, JSON takes up to 30 times as much memory."""


def place(path: Path, directory: Path) -> Path:
    """Returns a path; raises `OSError` if it, or a link on its way, leads out of a directory."""
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(directory)):
        raise OSError(errno.ELOOP, "Leads out of its directory", str(path))
    return path


def read(path: Path, most: int = LARGEST) -> bytes:
    """Reads a file of at most so many bytes.

    Raises:
      OSError: if there is none, if it is larger, not regular, or a link out of its directory.
    """
    found = place(path, path.parent).stat()
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))  # a pipe might never end
    if found.st_size > most:
        raise OSError(errno.EFBIG, f"Larger than {most:,} bytes", str(path))
    return path.read_bytes()


def matching(directory: Path, pattern: str) -> list[Path]:
    """Files of a directory that match a pattern and can be printed, in the order of their names.

    Raises:
      OSError: if they lie elsewhere, or are together larger than `LARGEST`.
    """
    place((directory / pattern).parent, directory)
    paths = [path for path in sorted(directory.glob(pattern)) if path.name.isprintable()]
    if sum(path.lstat().st_size for path in paths) > LARGEST:
        raise OSError(errno.EFBIG, f"Larger than {LARGEST:,} bytes", str(directory / pattern))
    return paths
