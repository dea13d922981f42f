"""Imports of packages that jaxsense does not require."""

import contextlib
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """Names the extra of jaxsense that installs a package whose import fails.

    Raises:
      ModuleNotFoundError: if a package is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or name).partition(".")[0]
        message = f"{package} is not installed: pip install 'jaxsense[{name}]'"
        raise ModuleNotFoundError(message, name=package) from None


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Sends what an import prints to standard error, and restores the streams that it replaces.

    jaxmarl sets `sys.stdout` to `sys.__stdout__`, which is not where a notebook prints.
    """
    kept = {name: getattr(sys, name) for name in ("stdout", "stderr", "__stdout__")}
    sys.stdout = sys.__stdout__ = sys.stderr  # pyright: ignore
    try:
        yield
    finally:
        for name, stream in kept.items():
            setattr(sys, name, stream)
