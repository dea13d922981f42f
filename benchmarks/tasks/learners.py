"""The rows of the scoreboard that learn. Add your own module here."""

import functools
import importlib
import sys

from benchmarks.tasks.learner import Learner

MODULES = "dqn", "sb3", "sb3_recurrent", "rejax"
"""Modules of this package, each with a tuple `LEARNERS`, in the order of the tables."""


@functools.cache
def load() -> tuple[Learner, ...]:
    """All learners; those whose packages are missing are named on stderr and left out."""
    found: list[Learner] = []
    for name in MODULES:
        try:
            found += importlib.import_module(f"benchmarks.tasks.{name}").LEARNERS
        except ImportError as error:
            reason = f"{error}; pip install -e '.[rejax,sb3]' brings it"
            print(f"benchmarks.tasks: {name} is left out: {reason}", file=sys.stderr)
    return tuple(found)
