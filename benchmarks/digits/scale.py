"""`python -m benchmarks.digits.scale`: compares scales of initial weights, see `vae.init`.

Trains with each scale on three quarters of the digits to train with, and prints the log-likelihood
of the rest. The digits that the comparison measures with take no part.
"""

import dataclasses
import functools
import sys

import numpy as np

from benchmarks.digits import data, measures
from benchmarks.digits.data import Digits
from benchmarks.digits.models import Budget, Ours
from jaxsense import vae
from jaxsense.run import cli

PROGRAM = "benchmarks.digits.scale"
SCALES = 1.0, 0.8, 0.6, 0.4, 0.2
_SEEDS = range(3)
_SAMPLES = 50  # of z for the likelihood of each digit


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compares scales of initial weights, on three quarters of the digits to train with."""


def main(argv: list[str] | None = None) -> None:
    """The program."""
    cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    digits = data.load()
    inner = data.split(digits.names, digits.train, digits.train_labels)
    print(
        "| scale | log-likelihood, mean over seeds | lowest | highest |\n| --- | --- | --- | --- |"
    )
    for scale in SCALES:
        found = likelihoods(inner, scale, Budget())
        print(f"| {scale} | {np.mean(found):.1f} | {min(found):.1f} | {max(found):.1f} |")


def likelihoods(digits: Digits, scale: float, budget: Budget) -> list[float]:
    """Mean log-likelihood of the digits to measure with, in nats, for each seed.

    Args:
      digits: to train on, and others to measure with.
      scale: of initial weights.
      budget: settings.
    """
    found, kind = [], Ours(1, functools.partial(vae.init, scale=scale))
    for seed, run in zip(_SEEDS, kind.runs(digits, budget, _SEEDS), strict=True):
        rng = np.random.default_rng(seed)
        each = measures.log_likelihood(rng, run.trained, digits.test, budget.variance, _SAMPLES)
        found.append(float(each.mean()))
    return found


if __name__ == "__main__":
    main()
