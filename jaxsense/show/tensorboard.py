"""Event files for TensorBoard, as an option."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxsense.config import ConfigError


def make_writer(path: Path) -> Callable[..., None]:
    """A function that writes the metrics of a report to event files in a directory.

    Raises:
      ConfigError: if the package that writes them is not installed.
    """
    try:
        # Only who asks for event files needs it.
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
