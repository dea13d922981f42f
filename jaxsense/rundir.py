"""The directory that a run leaves behind: writing it, and reading the trained models back."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from jaxsense import models
from jaxsense.config import Config, ConfigError, from_plain
from jaxsense.models import Models


class RunDirectory:
    """Writes the files of one run; never over those of another.

    Attributes:
      path: the directory.
    """

    def __init__(self, path: Path, config: Config, preset: str, seed: int):
        """Makes the directory and writes `config.json`.

        Raises:
          ConfigError: if the directory holds something already or cannot be written.
        """
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()):
                raise ConfigError("out", str(path), "is not empty; must be a new directory")
            settings = {"preset": preset, "seed": seed, "config": dataclasses.asdict(config)}
            self.write_json("config.json", settings)
        except OSError as error:
            reason = f"cannot be written ({error.strerror}); must be a new directory"
            raise ConfigError("out", str(path), reason) from None

    def write_json(self, name: str, content: Any) -> None:
        """Writes a file of the run, see the function of the same name."""
        write_json(self.path / name, content)

    def append_metrics(self, **figures: Any) -> None:
        """Adds a line to `metrics.jsonl`."""
        with (self.path / "metrics.jsonl").open("a") as lines:
            lines.write(json.dumps(figures) + "\n")

    def save(self, name: str, tree: Any) -> None:
        """Saves parameters as `checkpoints/NAME`."""
        with ocp.StandardCheckpointer() as checkpointer:
            checkpointer.save(self.path.absolute() / "checkpoints" / name, jax.device_get(tree))


def write_json(path: Path, content: Any) -> None:
    """Writes a file as a whole, so that a reader never sees half of it."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    unfinished.rename(path)


def read_summary(path: Path) -> dict[str, Any]:
    """The `summary.json` of a finished run; a `ConfigError` if there is none."""
    try:
        summary = json.loads((path / "summary.json").read_text())
        if not isinstance(summary, dict):
            raise ValueError("not an object")
        return summary
    except (OSError, ValueError) as error:
        reason = f"must hold the summary.json of a finished run ({error})"
        raise ConfigError("run", str(path), reason) from None


def load(path: Path | str) -> tuple[Config, Models]:
    """Reads the settings and the trained models of a finished run.

    Args:
      path: the run's directory.

    Returns:
      The settings and the models, on the default device.

    Raises:
      ConfigError: if the directory holds no finished run.
    """
    path = Path(path)
    try:
        settings = json.loads((path / "config.json").read_text())["config"]
        config = from_plain(Config, settings)
        shapes = jax.eval_shape(lambda: models.untrained(jax.random.key(0), config))
        with ocp.StandardCheckpointer() as checkpointer:

            def restore(name: str, shape: Any) -> Any:
                return checkpointer.restore(path.absolute() / "checkpoints" / name, shape)

            q_networks = tuple(
                restore(f"dqn_{name}", shape)
                for name, shape in zip(config.modalities, shapes.q_networks, strict=True)
            )
            return config, Models(
                detectors=restore("detectors", shapes.detectors),
                jmvae=restore("jmvae", shapes.jmvae),
                class_beliefs=restore("class_beliefs", shapes.class_beliefs),
                q_networks=q_networks,
            )
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError("run", str(path), f"must be a finished run ({reason})") from error
