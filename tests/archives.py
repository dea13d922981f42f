"""Imports from exported archives, which Python would remember by their path."""

import contextlib
import sys
import zipimport
from pathlib import Path

from jaxsense import export


@contextlib.contextmanager
def imports_from_archives():
    """Imports within it may be from archives, and are forgotten before and after it.

    An archive `robot.zip` of another directory has its parts elsewhere: what Python remembers of it
    ends in an `EOFError`.
    """
    path = [*sys.path]
    _forget()
    try:
        yield
    finally:
        sys.path[:] = path
        _forget()


def _forget():
    for file in export.FILES:
        sys.modules.pop(Path(file).stem, None)
    zipimport._zip_directory_cache.clear()
    for name, finder in [*sys.path_importer_cache.items()]:
        # None: there was no archive of that name yet.
        if finder is None or isinstance(finder, zipimport.zipimporter):
            del sys.path_importer_cache[name]
