"""Others who do the same, each behind an adapter; none of them is needed to measure ourselves."""

import importlib
import sys
from typing import Any

from benchmarks.measure import Options


def load(name: str, options: Options) -> Any:
    """The adapter of a peer, or None if peers are not asked for.

    A peer that is missing or broken is named on stderr, and left out.

    Args:
      name: of a module in this package.
      options: whether peers are asked for.

    Returns:
      The module, or None.
    """
    if not options.peers:
        return None
    try:
        return importlib.import_module(f"benchmarks.peers.{name}")
    except (ImportError, RuntimeError) as error:  # the latter where torchvision does not fit torch
        reason = str(error).splitlines()[0]
        if isinstance(error, ImportError):
            reason += " (pip install -e '.[bench]')"
        print(f"benchmarks: peer {name} is left out: {reason}", file=sys.stderr)
        return None
