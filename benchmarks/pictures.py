"""`python -m benchmarks.pictures [NAMES]`: draws the pictures of README and of the pages.

The table of this module names, for every picture in `docs`, what draws it.
"""

import dataclasses
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Protocol

from matplotlib.figure import Figure

from benchmarks import commands, measure, results, same_accuracy
from benchmarks.seeds.plan import GROUPS
from benchmarks.tasks import jobs, plot, record
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.show.drawing import svg

PROGRAM = "benchmarks.pictures"
DOCS = Path(__file__).parents[1] / "docs"
FOLDER = "FOLDER"
"""Stands in a command for the directory that it writes into."""


class Drawing(Protocol):
    """What draws one or more pictures."""

    @property
    def pictures(self) -> Collection[str]:
        """Their paths in `docs`."""
        ...

    @property
    def results(self) -> tuple[str, ...]:
        """The files of `benchmarks/results` that they show, without endings."""
        ...

    @property
    def trains(self) -> bool:
        """Whether drawing them trains something, which takes long."""
        ...

    def draw(self) -> bool:
        """Draws them, and tells whether this succeeded; otherwise they are as they were."""
        ...


@dataclasses.dataclass(frozen=True)
class Written:
    """Pictures that commands write.

    Attributes:
      commands: one after another, with `FOLDER` for a new directory.
      files: names in that directory of the pictures, by their paths in `docs`.
      results: see `Drawing`.
    """

    commands: tuple[str, ...]
    files: Mapping[str, str]
    results: tuple[str, ...] = ()

    @property
    def pictures(self) -> Collection[str]:
        """See `Drawing`."""
        return self.files.keys()

    @property
    def trains(self) -> bool:
        """See `Drawing`."""
        return any("jaxsense.train" in command for command in self.commands)

    def draw(self) -> bool:
        """See `Drawing`."""
        with tempfile.TemporaryDirectory() as folder:
            if not all(commands.run(x.replace(FOLDER, folder)) for x in self.commands):
                return False
            for picture, file in self.files.items():
                shutil.move(Path(folder) / file, DOCS / picture)
        return True


@dataclasses.dataclass(frozen=True)
class Plotted:
    """A picture of stored results, plotted here.

    Attributes:
      picture: its path in `docs`.
      figure: plots it.
      results: see `Drawing`.
    """

    picture: str
    figure: Callable[[], Figure]
    results: tuple[str, ...]
    trains: bool = False

    @property
    def pictures(self) -> Collection[str]:
        """See `Drawing`."""
        return [self.picture]

    def draw(self) -> bool:
        """See `Drawing`."""
        (DOCS / self.picture).write_bytes(svg(self.figure()))
        return True


def _of_results(program: str, options: Mapping[str, str], *names: str) -> Written:
    """Pictures that a program draws of stored results, by the options that write them."""
    files = " ".join(f"benchmarks/results/{name}.json" for name in names)
    written = " ".join(f"{option} {FOLDER}/{picture}" for picture, option in options.items())
    return Written(
        (f"python -m benchmarks.{program} {files} {written}",),
        {f"figures/{picture}": picture for picture in options},
        names,
    )


def _of_run(train: str, **names: str) -> Written:
    """Plots of a training, by the first part of their names in `docs`."""
    files = {f"figures/{name}.svg": f"run/{file}.svg" for name, file in names.items()}
    return Written((f"{train} --out {FOLDER}/run",), files)


def _film(words: str, picture: str) -> Written:
    """A film of a mission with models that ship with the package."""
    return Written(
        (f"python -m benchmarks.film {words} --plot {FOLDER}/film.svg",), {picture: "film.svg"}
    )


_TEAM = " ".join(["--robots", *["camera"] * 3, *["lidar"] * 3])
_IMPERFECT = ("imperfect_default", "imperfect_noisy")
DRAWINGS: tuple[Drawing, ...] = (
    # In whose arena robots skip looks.
    _film("pretrained:default --seed 2", "mission.svg"),
    _film("pretrained:default --seed 2 --policy naive", "mission_naive.svg"),
    _film(
        f"pretrained:team --arena.num-pois 16 --arena.side 6 {_TEAM}", "figures/team_mission.svg"
    ),
    Written((f"python docs/scan.py {FOLDER}/scan.svg",), {"figures/scan.svg": "scan.svg"}),
    Plotted(
        "figures/noisy_curves.svg",
        lambda: same_accuracy.draw(_read("curves")["policies"]),
        ("curves",),
    ),
    Plotted(
        "figures/tasks_curves.svg",
        lambda: plot.draw(record.read(results.RESULTS / jobs.CURVES)),
        ("tasks",),
    ),
    _of_results(
        "imperfect_plot",
        {"imperfect.svg": '--sweeps "position [m]" "heading [deg]" "both [m]" --plot'},
        *_IMPERFECT,
    ),
    _of_results(
        "imperfect_plot",
        {
            "imperfect_drift.svg": '--sweeps "position drift [m]" "heading drift [deg]" '
            '"both drifts [m]" --plot'
        },
        *_IMPERFECT,
    ),
    _of_results(
        "imperfect_plot",
        {"imperfect_messages.svg": "--figures accuracy own nll time --plot"},
        "imperfect_messages",
    ),
    _of_results(
        "raw.report",
        {"raw_ablation.svg": "--plot", "raw_posteriors.svg": "--posteriors"},
        "raw_ablation",
        "raw_ratio",
        "raw_depth",
    ),
    _of_run(GROUPS["paper"].train(100), paper_latent_space="latent_space", paper_reward="reward"),
    _of_run(GROUPS["default"].train(0), default_latent_space="latent_space"),
    _of_run(GROUPS["raw"].train(101), raw_latent_space="latent_space"),
    _of_run(
        GROUPS["noisy"].train(100),
        noisy_latent_space="latent_space",
        noisy_calibration="calibration",
        noisy_policies="policies",
    ),
)
"""What draws the pictures of `docs`."""


def _read(name: str) -> dict:
    return json.loads((results.RESULTS / f"{name}.json").read_text(encoding="utf-8"))


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draws the pictures of the README and the documentation anew."""

    names: Annotated[tuple[str, ...], Name("NAMES")] = ()
    """Pictures, such as `scan.svg`; by default all that need no training."""


def draw(drawings: Iterable[Drawing]) -> list[str]:
    """Draws pictures, and returns those that could not be drawn.

    Args:
      drawings: from `DRAWINGS`.
    """
    return [picture for x in drawings if not x.draw() for picture in x.pictures]


def untrained() -> list[Drawing]:
    """The drawings that need no training; prints a line about each other picture."""
    for drawing in DRAWINGS:
        for picture in drawing.pictures if drawing.trains else ():
            command = f"python -m {PROGRAM} {Path(picture).name}"
            print(f"left out: {picture}: needs a training: run {command}")
    return [drawing for drawing in DRAWINGS if not drawing.trains]


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    of_name = {Path(picture).name: x for x in DRAWINGS for picture in x.pictures}
    measure.require_known(PROGRAM, "names", arguments.names, of_name)
    named = [x for x in DRAWINGS if any(of_name[name] is x for name in arguments.names)]
    if failed := draw(named or untrained()):
        sys.exit(f"not drawn: {', '.join(failed)}; they are as they were")


if __name__ == "__main__":
    main()
