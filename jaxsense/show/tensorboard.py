"""Optional event files for TensorBoard."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxsense.config import ConfigError


def make_writer(path: Path) -> Callable[..., None]:
    """Returns a function that writes reported metrics to event files in a directory.

    Raises:
      ConfigError: if tensorboardX is not installed.
    """
    try:
        # An optional dependency.
        from tensorboardX import SummaryWriter  # noqa: PLC0415
    except ImportError:
        reason = "needs tensorboardX: pip install 'jaxsense[tensorboard]'"
        raise ConfigError("tensorboard", True, reason) from None
    writer: Any = SummaryWriter(str(path))

    def write(*, stage: str, step: int, **metrics: float) -> None:
        for name, value in metrics.items():
            writer.add_scalar(f"{stage}/{name}", value, step)
        writer.flush()

    return write
