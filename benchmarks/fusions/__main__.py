"""`python -m benchmarks.fusions`: compares ways of fusing looks, see `benchmarks.fusions`."""

import dataclasses
import json
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import rich.console

from benchmarks.fusions.study import Each, Study, settings, sizes
from benchmarks.fusions.table import Figures, as_markdown, means, summarise
from benchmarks.measure import origin, reserve
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
    missions: int = limited(128, at_least=0, at_most=1024)
    """Missions of each fusion and seed. Without any, no policies are trained either: only the NLL
    after looks is measured, in minutes."""
    json: Path | None = None
    """JSON file to write; must be new."""

    def __post_init__(self):
        check_fields(self)
        _ = self.range

    @property
    def range(self) -> range:
        """The seeds."""
        found = re.fullmatch(r"(\d+)(?:-(\d+))?", self.seeds, re.ASCII)
        if found is None or not (seeds := range(int(found[1]), int(found[2] or found[1]) + 1)):
            raise ConfigError("seeds", self.seeds, "must be as 100-109, or one seed")
        return seeds


def _command(arguments: Arguments) -> str:
    """The command that measures the same again."""
    return (
        f"python -m {PROGRAM} --preset {arguments.preset} --seeds {arguments.seeds} "
        f"--missions {arguments.missions}"
    )


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    reserve(PROGRAM, "json", arguments.json)
    workers = devices.start(None)
    console = rich.console.Console(stderr=True)
    config = settings(arguments.preset)
    study = Study(config, arguments.missions)
    first, *others = arguments.range

    def measure(seed: int, each: Each = map) -> dict[str, Figures]:
        begin = time.perf_counter()
        found = study.measure(seed, each)
        console.print(f"seed {seed}: {time.perf_counter() - begin:.0f} s")
        return found

    with ThreadPoolExecutor(workers.threads) as executor:
        # The first seed alone, so that each program is compiled once, the fusions side by side.
        found = {first: measure(first, executor.map)}
        found |= zip(others, executor.map(measure, others), strict=True)
    fusions = summarise(found, sizes(config))
    optimal = means(found, "optimal") if arguments.missions else {}
    if arguments.json is not None:
        results = {
            **origin(_command(arguments)),
            "optimal": optimal,
            "fusions": fusions,
            "seeds": found,
        }
        arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    print(as_markdown(fusions))
    print(*(f"optimal {figure}: {x['mean']:.3f}" for figure, x in optimal.items()), sep="\n")


if __name__ == "__main__":
    main()
