"""Versions of jaxsense, and of the packages that results depend on."""

import importlib.metadata

__version__ = "0.2.0"
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")


def versions() -> dict[str, str]:
    """Versions of jaxsense and of the packages that results depend on."""
    others = {package: importlib.metadata.version(package) for package in _PACKAGES}
    return {"jaxsense": __version__, **others}
