"""Versions of jaxsense, of Python and of the packages that results depend on."""

import hashlib
import importlib.metadata
import platform
import subprocess
from pathlib import Path

__version__ = "0.4.0"
"""Version of jaxsense."""
_ROOT = Path(__file__).parents[2]
_FILES = sorted(
    path
    for path in Path(__file__).parents[1].rglob("*")
    if path.suffix in (".py", ".jinja", ".toml")
)
SOURCE = hashlib.sha256(b"".join(path.read_bytes() for path in _FILES)).hexdigest()[:16]
"""Digest of jaxsense, taken at import so that it matches the code that runs."""
_PLACE = str(Path(__file__).relative_to(_ROOT))
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")


def versions() -> dict[str, str]:
    """Versions of jaxsense, of Python and of the packages that results depend on, by name."""
    others = {package: importlib.metadata.version(package) for package in _PACKAGES}
    return {"jaxsense": __version__, "python": platform.python_version(), **others}


def commit(source: Path = _ROOT) -> str | None:
    """The commit of a source tree, with `-dirty` if files have changed; None outside Git.

    Args:
      source: the root of the tree, by default the one this package was imported from.

    Returns:
      The commit; None also if the package only lies in a repository that does not hold it.
    """
    if not (source / ".git").exists():
        return None
    git = ["git", "-C", str(source)]
    ours = [*git, "ls-files", "--error-unmatch", _PLACE]
    describe = [*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude", "*"]
    try:
        subprocess.run(ours, capture_output=True, timeout=10, check=True)
        found = subprocess.run(describe, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()
