"""Files that are written as a whole or not at all."""

import contextlib
import os
from pathlib import Path


def write(path: Path, content: str | bytes) -> None:
    """Writes a file so that a reader never sees half of it, also if there is no room.

    Args:
      path: the file; what was there before is replaced.
      content: of the file; text as UTF-8.

    Raises:
      OSError: names the file, which is then as it was before.
    """
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
        unfinished.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise OSError(error.errno, reason, str(path)) from error
