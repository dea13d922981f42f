"""`python -m jaxsense.train`: the whole pipeline, from scanlines to policies, in one command."""

import dataclasses
import importlib.metadata
import re
import sys
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import jax
import rich.console
import rich.table
import tyro
from jax.sharding import Mesh

from jaxsense import __version__, animation, cli, devices, page, pipeline, report
from jaxsense.config import PRESETS, Config, ConfigError
from jaxsense.display import Display
from jaxsense.monitor import Monitor, StageError
from jaxsense.rundir import RunDirectory

PROGRAM = "jaxsense.train"
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train detectors, the JMVAE and one Q-network per modality, and write a run directory."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["default", "paper", "smoke"] = "default"
    """Settings to start from; every option below changes one of them."""
    seed: int = 0
    """Seed of all randomness, from 0 to 2^32 - 1."""
    out: Path | None = None
    """Directory to write; must be new. By default `runs/DATE-TIME-PRESET`."""
    devices: int | None = None
    """Devices that environments are split over: accelerators, or threads of the CPU. By default all
    accelerators there are; on a CPU as many threads as cores, at most 8, for simulations, and one
    for Q-learning."""
    cache: Path | None = Path("~/.cache/jaxsense")
    """Directory in which compiled programs are kept for later runs; `None` to keep none."""


def main(argv: list[str] | None = None) -> None:
    """The program."""
    begin = time.perf_counter()
    arguments = parse(sys.argv[1:] if argv is None else argv)
    console = rich.console.Console()
    meshes = _start(arguments)
    name = f"{datetime.now():%Y%m%d-%H%M%S}-{arguments.preset}"
    try:
        run = RunDirectory(
            arguments.out or Path("runs") / name,
            arguments.config,
            arguments.preset,
            arguments.seed,
        )
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    kept = cli.keep_programs(PROGRAM, arguments.cache, arguments.config, meshes)
    with Display(console, run.append_metrics) as display:
        monitor = Monitor(display.show)
        try:
            result = pipeline.run(
                jax.random.key(arguments.seed), arguments.config, monitor, run.save, *meshes, kept
            )
        except StageError as error:
            cli.fail(PROGRAM, f"{error}; must be finite. What was written before is in {run.path}")
    report.write_plots(run.path, arguments.config, result)
    film, beliefs = run.path / "mission.svg", result.models.class_beliefs
    animation.write(film, arguments.config, result.recording, beliefs, "latent policy")
    summary = {
        "preset": arguments.preset,
        "seed": arguments.seed,
        "versions": {
            "jaxsense": __version__,
            **{package: importlib.metadata.version(package) for package in _PACKAGES},
        },
        "devices": [device.device_kind for device in jax.devices()],
        "timing": {"total_s": time.perf_counter() - begin, "stages": monitor.seconds},
        **result.summary,
    }
    run.write_json("summary.json", summary)
    page.write(run.path)
    _print_summary(console, summary)
    console.print(f"Everything is in {run.path}; look at {run.path / 'report.html'} first.")


def parse(argv: list[str]) -> Arguments:
    """Reads the command line; ends the program with status 2 and one line if it is wrong."""
    preset = _preset_of(argv)
    default = Arguments(PRESETS[preset], preset)  # pyright: ignore[reportArgumentType]
    arguments = cli.parse(PROGRAM, Arguments, argv, default)
    if not 0 <= arguments.seed < 2**32:
        cli.fail(PROGRAM, f"seed = {arguments.seed}: must be within 0 and 2^32 - 1")
    return arguments


def _start(arguments: Arguments) -> tuple[Mesh | None, Mesh | None]:
    """The devices, see `devices.start`."""
    try:
        return devices.start(arguments.devices, arguments.config.dqn)
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))


def _preset_of(argv: list[str]) -> str:
    """The preset that the other options change, which must be known before they are read."""
    text = " ".join(argv)
    found = re.findall(r"(?:^|\s)--preset(?:=|\s+)(\S+)", text)
    preset = found[-1] if found else "default"
    if preset not in PRESETS:
        cli.fail(PROGRAM, f"preset = {preset!r}: must be one of {', '.join(PRESETS)}")
    return preset


def _print_summary(console: rich.console.Console, summary: dict) -> None:
    """A table of the figures that matter most."""
    table = rich.table.Table("figure", *summary["dqn"], title=f"{summary['preset']} preset")
    rows = {
        "detector accuracy": lambda m: f"{summary['detectors'][m]['accuracy']:.4f}",
        "episode reward, DQN": lambda m: f"{summary['dqn'][m]['return']:.3f}",
        "episode reward, optimal": lambda m: f"{summary['dqn'][m]['optimal']:.3f}",
        "episode reward, naive": lambda m: f"{summary['dqn'][m]['naive']:.3f}",
        "episode reward, random": lambda m: f"{summary['dqn'][m]['random']:.3f}",
        "fraction of optimal": lambda m: str(summary["dqn"][m]["fraction_of_optimal"])[:6],
        "optimal in states": lambda m: (
            f"{summary['dqn'][m]['optimal_states']} of {summary['dqn'][m]['num_states']}"
        ),
    }
    for name, cell in rows.items():
        table.add_row(name, *(cell(m) for m in summary["dqn"]))
    console.print(table)
    console.print(
        f"latent units in use: {summary['jmvae']['active_units']}, "
        f"total time: {summary['timing']['total_s']:.0f} s"
    )


if __name__ == "__main__":
    main()
