"""Arrays and a few words about them in one `.npz` file, which travels with the package."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

T = TypeVar("T")
Arrays = dict[str, np.ndarray]
_ABOUT = "about"


def write(file: Path, trees: Mapping[str, PyTree], about: Mapping[str, object]) -> None:
    """Writes trees of arrays.

    Args:
      file: a new file; its name ends in `.npz`.
      trees: by name.
      about: what JSON can hold.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _flat(dict(trees)).items()}
    text = json.dumps(about, allow_nan=False)
    part = file.with_suffix(".part.npz")
    np.savez_compressed(part, allow_pickle=False, **{**arrays, _ABOUT: np.array(text)})
    os.replace(part, file)


def read(file: Path) -> tuple[Arrays, dict[str, object]]:
    """Reads what `write` wrote: arrays by their places, and the words about them.

    Args:
      file: the file.
    """
    with np.load(file, allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    return arrays, json.loads(str(arrays.pop(_ABOUT)))


def fill(arrays: Arrays, name: str, shapes: T) -> T:
    """A tree that `write` was given.

    Args:
      arrays: from `read`.
      name: of the tree.
      shapes: the same structure of anything with a shape and a dtype.

    Raises:
      ValueError: if an array is missing or has another shape.
    """

    def leaf(place: str, shape: jax.ShapeDtypeStruct) -> jax.Array:
        found = arrays.get(place)
        if found is None or found.shape != shape.shape:
            shown = "is missing" if found is None else f"has shape {found.shape}"
            raise ValueError(f"{place} {shown}: must have shape {shape.shape}")
        return jnp.asarray(found, shape.dtype)

    places = _flat({name: shapes})
    leaves = [leaf(place, shape) for place, shape in places.items()]
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


def _flat(trees: Mapping[str, PyTree]) -> dict[str, PyTree]:
    """The leaves of trees, by their places in them."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(trees)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
