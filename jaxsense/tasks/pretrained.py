"""Files that travel with the package: trained models, and the networks and looks of tasks."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxsense import models
from jaxsense.config import Config, ConfigError, from_plain
from jaxsense.config.section import require_32_bits
from jaxsense.models import Models

T = TypeVar("T")
Arrays = dict[str, np.ndarray]

DATA = Path(__file__).parent / "data"
"""Where the files are."""
PRETRAINED = ("default", "noisy", "many", "raw", "team")
"""Presets with trained models, for `load_pretrained`."""
PREFIX = "pretrained:"
"""What stands before a preset's name where the directory of a run may stand, too."""

# The others follow from the settings.
PARTS = "detectors", "jmvae", "fusion", "novelty", "look_values", "q_networks"


@dataclasses.dataclass(frozen=True)
class Origin:
    """Origin of trained models: command, seed, commit and versions.

    Attributes:
      versions: of jaxsense, Python and the packages that results depend on.
    """

    command: str
    preset: str
    seed: int
    commit: str
    versions: dict[str, str]


def load_pretrained(preset: str) -> tuple[Config, Models]:
    """Loads the settings and the trained models of a preset, which ship with the package."""
    require_32_bits()
    if preset not in PRETRAINED:
        raise ConfigError("preset", preset, f"must be one of {', '.join(PRETRAINED)}")
    arrays, config, _ = read(DATA / f"{preset}.npz")
    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    parts = {name: fill(arrays, name, getattr(shapes, name)) for name in PARTS}
    return config, models.make_models(config, **parts)


def read(file: Path) -> tuple[Arrays, Config, Origin]:
    """Arrays by their places in trees, settings and origin, from a file of `benchmarks.ship`."""
    with np.load(file, allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    about = json.loads(str(arrays.pop("about")))
    return arrays, from_plain(about["config"]), Origin(**about["origin"])


def fill(arrays: Arrays, name: str, shapes: T) -> T:
    """The tree of a name, from the arrays that `read` returns."""

    def leaf(place: str, shape: jax.ShapeDtypeStruct) -> jax.Array:
        found = arrays.get(place)
        if found is None or found.shape != shape.shape:
            shown = "is missing" if found is None else f"has shape {found.shape}"
            raise ValueError(f"{place} {shown}: must have shape {shape.shape}")
        return jnp.asarray(found, shape.dtype)

    places = flat({name: shapes})
    leaves = [leaf(place, shape) for place, shape in places.items()]
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


def flat(trees: Mapping[str, PyTree]) -> dict[str, PyTree]:
    """The leaves of trees, by their places in them."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(trees)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
