"""Trained models that travel with the package."""

import dataclasses
from pathlib import Path

import jax

from jaxsense import models
from jaxsense.config import Config, ConfigError, as_plain, from_plain, require_32_bits
from jaxsense.models import Models
from jaxsense.tasks import archive

DATA = Path(__file__).parent / "data"
"""Where the files are."""
PRETRAINED = ("default", "noisy", "many", "raw", "team")
"""Presets with trained models, for `load_pretrained`."""
PREFIX = "pretrained:"
"""What stands before a preset's name where the directory of a run may stand, too."""

# The others follow from the settings.
_PARTS = "detectors", "jmvae", "fusion", "novelty", "look_values", "q_networks", "tours"


@dataclasses.dataclass(frozen=True)
class Origin:
    """Origin of trained models: command, seed, commit and versions.

    Attributes:
      command: that trained them.
      preset: whose settings they have.
      seed: of the training.
      commit: of jaxsense.
      versions: of jaxsense, Python and the packages that results depend on.
    """

    command: str
    preset: str
    seed: int
    commit: str
    versions: dict[str, str]


def load_pretrained(preset: str) -> tuple[Config, Models]:
    """Loads the settings and the trained models of a preset, which ship with the package.

    Args:
      preset: one of `PRETRAINED`.

    Returns:
      The settings and the models, on the default device.

    Raises:
      ConfigError: if there are no such models, or if JAX computes in 64 bits.
    """
    require_32_bits()
    arrays, about = archive.read(_file(preset))
    config = from_plain(about["config"])
    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    parts = {name: archive.fill(arrays, name, getattr(shapes, name)) for name in _PARTS}
    return config, models.make_models(config, **parts)


def write(file: Path, config: Config, trained: Models, made: Origin) -> None:
    """Writes what `load_pretrained` reads.

    Args:
      file: a new file; its name ends in `.npz`.
      config: settings of the training.
      trained: the models.
      made: what made them.
    """
    trees = {name: getattr(trained, name) for name in _PARTS}
    archive.write(file, trees, {"config": as_plain(config), "origin": dataclasses.asdict(made)})


def _file(preset: str) -> Path:
    """The file of a preset's models."""
    if preset not in PRETRAINED:
        raise ConfigError("preset", preset, f"must be one of {', '.join(PRETRAINED)}")
    return DATA / f"{preset}.npz"
