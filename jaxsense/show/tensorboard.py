"""Optional event files for TensorBoard."""

import importlib
from collections.abc import Callable
from pathlib import Path

from jaxsense.config import ConfigError
from jaxsense.core import inside


def require() -> None:
    """Checks that event files can be written.

    Raises:
      ConfigError: if tensorboardX is not installed.
    """
    try:
        importlib.import_module("tensorboardX")
    except ImportError:
        reason = "needs tensorboardX: pip install 'jaxsense[tensorboard]'"
        raise ConfigError("tensorboard", True, reason) from None


def make_writer(path: Path) -> Callable[..., None]:
    """Returns a function that writes reported metrics to event files in a directory of a run."""
    from tensorboardX import SummaryWriter  # noqa: PLC0415 (an optional dependency)

    writer = SummaryWriter(str(inside.place(path, path.parent)))

    def write(*, stage: str, step: int, **metrics: float) -> None:
        for name, value in metrics.items():
            writer.add_scalar(f"{stage}/{name}", value, step)
        writer.flush()

    return write
