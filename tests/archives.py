"""Imports from exported archives, which Python would remember by their path."""

import contextlib
import importlib
import sys
import zipimport
from pathlib import Path

from jaxsense import export


@contextlib.contextmanager
def imports_from_archives():
    """Imports within it may be from archives, and are forgotten after it."""
    path = [*sys.path]
    try:
        yield
    finally:
        sys.path[:] = path
        for file in export.FILES:
            sys.modules.pop(Path(file).stem, None)
        zipimport._zip_directory_cache.clear()
        importlib.invalidate_caches()
