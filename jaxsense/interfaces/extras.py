"""Packages that are not installed with jaxsense itself."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """Names the extra of jaxsense that installs a package whose import fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or name).partition(".")[0]
        message = f"{package} is not installed: pip install 'jaxsense[{name}]'"
        raise ModuleNotFoundError(message, name=package) from None
