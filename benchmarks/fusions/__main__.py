"""`python -m benchmarks.fusions`: compares ways of fusing looks, see `benchmarks.fusions`."""

import dataclasses
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import rich.console

from benchmarks.fusions.study import Study, settings, sizes
from benchmarks.fusions.table import Figures, as_markdown, means, summarise
from benchmarks.measure import versions
from jaxsense.config import ConfigError, PresetName
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli, devices

PROGRAM = "benchmarks.fusions"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compares ways of fusing looks on the same detections, and prints one table."""

    preset: PresetName = "noisy"
    """Settings of sensors, detectors and the JMVAE."""
    seeds: str = "100-109"
    """The first and the last seed, or one seed. Differences over one seed have no intervals."""
    missions: int = limited(128, at_least=1, at_most=1024)
    """Missions of each fusion and seed."""
    out: Path | None = None
    """JSON file to write; must be new."""

    def __post_init__(self):
        check_fields(self)
        _ = self.range

    @property
    def range(self) -> range:
        """The seeds."""
        first, _, last = self.seeds.partition("-")
        if first.isdecimal() and (last or first).isdecimal() and int(first) <= int(last or first):
            return range(int(first), int(last or first) + 1)
        raise ConfigError("seeds", self.seeds, "must be as 100-109, or one seed")


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    if arguments.out is not None and arguments.out.exists():
        cli.fail(PROGRAM, f"out = {str(arguments.out)!r}: exists already; must be new")
    workers = devices.start(None)
    console = rich.console.Console(stderr=True)
    config = settings(arguments.preset)
    study = Study(config, arguments.missions)
    first, *others = arguments.range

    def measure(seed: int) -> dict[str, Figures]:
        begin = time.perf_counter()
        found = study.measure(seed)
        console.print(f"seed {seed}: {time.perf_counter() - begin:.0f} s")
        return found

    # Alone, so that each program is compiled once.
    found = {first: measure(first)}
    with ThreadPoolExecutor(workers.threads) as executor:
        found |= zip(others, executor.map(measure, others), strict=True)
    fusions, optimal = summarise(found, sizes(config)), means(found, "optimal")
    if arguments.out is not None:
        results = {
            "preset": arguments.preset,
            "missions": arguments.missions,
            "versions": versions(),
            "optimal": optimal,
            "fusions": fusions,
            "seeds": found,
        }
        arguments.out.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    print(as_markdown(fusions))
    print(*(f"optimal {figure}: {x['mean']:.3f}" for figure, x in optimal.items()), sep="\n")


if __name__ == "__main__":
    main()
