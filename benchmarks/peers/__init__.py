"""Other libraries that do the same, a module for each; we are measured without them too."""

import importlib
import sys
from typing import Any


def load(name: str, is_wanted: bool = True) -> Any:
    """The module of a peer, or None if it is not wanted, or is missing or broken.

    A missing or broken one is named on stderr.

    Args:
      name: of a module in this package.
      is_wanted: whether to load it.
    """
    if not is_wanted:
        return None
    try:
        return importlib.import_module(f"benchmarks.peers.{name}")
    except (ImportError, RuntimeError) as error:  # the latter where torchvision does not fit torch
        reason = str(error).splitlines()[0]
        if isinstance(error, ImportError):
            reason += " (pip install -e '.[bench]')"
        print(f"benchmarks: peer {name} is left out: {reason}", file=sys.stderr)
        return None
