"""How far exported programs are from ours, and how long they take: `python -m benchmarks.exported`.

Plays missions of runs, and asks the programs of their archives, with onnxruntime on one core, what
ours say in the same states.
"""

import dataclasses
import io
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

from benchmarks import studies
from benchmarks.measure import reserve
from benchmarks.moments import Choice, Inputs, choices
from jaxsense import export
from jaxsense.config import Config
from jaxsense.config.checks import check_fields, limited
from jaxsense.config.options import Name
from jaxsense.interfaces import robot
from jaxsense.interfaces.onboard import Function, functions
from jaxsense.models import Models
from jaxsense.run import cli, devices

PROGRAM = "benchmarks.exported"
PLAYER = "onnxruntime"
SHOWN = ("decide", "detect_camera", "detect_lidar", "write_lidar", "classify")
"""Programs in the tables of the pages."""
_TIMED = 200
_CLOSED = 1e5  # above any value of an action that is open
_TINY = 1e-3  # scale of an output that is about 0

Arrays = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compares what exported runs say with the runs themselves, in states of missions."""

    runs: Annotated[tuple[Path, ...], Name("RUNS")] = limited(
        tuple(Path(f"pretrained:{name}") for name in ("default", "noisy", "many")),
        min_items=1,
    )
    """Directories of finished runs, `latest`, or `pretrained:PRESET`."""
    states: int = limited(1000, at_least=1)
    """How many states of missions of each run."""
    trust: bool = False
    """Run the code of custom sensors that a run's `config.json` names."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Compared:
    """A program and ours.

    Attributes:
      states: how many.
      different: in how many of them a whole number or a bool is another one.
      error: largest difference of real numbers as a share of the scale, see `relative_error`.
      seconds: median duration of a call.
    """

    states: int
    different: int
    error: float
    seconds: float


def compare(
    config: Config, models: Models, archive: bytes, found: list[Choice]
) -> dict[str, Compared]:
    """Compares all programs that a mission plays, by name.

    Args:
      config: settings of the run.
      models: its models.
      archive: from `export.archive`.
      found: moments of missions.

    Raises:
      AssertionError: if the choices of our own function are not those of the missions.
    """
    ours = functions(config)
    given = _given(config, models, ours, found)
    expected = {
        name: [
            jax.tree.map(np.asarray, apply(models, *(x[key] for key in ours[name].inputs)))
            for x in inputs
        ]
        for name, inputs in given.items()
        for apply in [jax.jit(ours[name].apply)]
    }
    actions = [int(each["action"]) for each in expected["decide"]]
    assert actions == [int(choice.action) for choice in found]
    return {
        name: _compared(program, given[name], expected[name])
        for name, program in robot.load(io.BytesIO(archive))[1].items()
        if name in given
    }


def _given(
    config: Config, models: Models, ours: dict[str, Function], found: list[Choice]
) -> dict[str, list[Inputs]]:
    """Inputs of each program in the states."""
    given: dict[str, list[Inputs]] = {"decide": [choice.inputs for choice in found]}
    given["classify"] = [{key: x[key] for key in ("mean", "std")} for x in given["decide"]]
    detect = {name: jax.jit(f.apply) for name, f in ours.items() if name.startswith("detect")}
    weigh = {name: jax.jit(f.apply) for name, f in ours.items() if name.startswith("weigh")}
    for choice in found:
        x = choice.inputs
        robot, poi = int(x["robot"]), int(choice.poi)
        m = int(x["modality"][robot])
        sensor = config.modalities[m]
        look = {key: getattr(choice, key) for key in ("readings", "bearing", "distance")}
        apart = np.linalg.norm(x["poses"][robot, None, :2] - x["looked_from"][poi, m], axis=-1)
        features = detect[f"detect_{sensor}"](models, *look.values())["features"]
        weight = weigh[f"weigh_{sensor}"](models, apart)["weight"]
        new = {"features": np.asarray(features), "weight": np.asarray(weight)}
        of_sensor = {"detect": look, "weigh": {"apart": apart}}
        if choice.sums is None:
            belief = {"mean": x["mean"][poi], "std": x["std"][poi]}
            of_sensor["write"] = {**belief, "seen": choice.seen[poi], **new}
        else:
            of_sensor["tell"] = new
            given.setdefault("merge", []).append({"sums": choice.sums})
        for name, inputs in of_sensor.items():
            given.setdefault(f"{name}_{sensor}", []).append(inputs)
    return given


def _compared(
    program: Callable[..., Arrays], given: list[Inputs], expected: list[Arrays]
) -> Compared:
    theirs = [program(**inputs) for inputs in given]
    is_other, error = np.zeros(len(given), bool), 0.0
    for key, first in expected[0].items():
        ours, found = (np.stack([each[key] for each in both]) for both in (expected, theirs))
        if first.dtype == np.float32:
            error = max(error, relative_error(found, ours))
        else:
            is_other |= (found != ours).reshape(len(given), -1).any(axis=1)
    seconds = []
    for inputs in given[:_TIMED]:
        start = time.perf_counter()
        program(**inputs)
        seconds.append(time.perf_counter() - start)
    return Compared(len(given), int(is_other.sum()), error, float(np.median(seconds)))


def relative_error(theirs: np.ndarray, ours: np.ndarray) -> float:
    """Largest difference as a share of the scale of an output, its maximum magnitude.

    Numbers of 1e5 and more, or infinite, say that an action is not open: they are not compared, but
    must be the same ones.

    Args:
      theirs: of all states.
      ours: of the same shape.

    Returns:
      The share; infinite if other actions are open.
    """
    is_value = np.abs(ours) < _CLOSED
    if not np.array_equal(is_value, np.abs(theirs) < _CLOSED):
        return np.inf
    scale = np.abs(ours[is_value]).max(initial=_TINY)
    return float(np.abs(theirs[is_value] - ours[is_value]).max(initial=0.0) / scale)


def measure(arguments: Arguments) -> dict[str, object]:
    """The content of the JSON file.

    Args:
      arguments: of the program.
    """
    results = studies.origin(PROGRAM, arguments, ("onnx", PLAYER))
    results["programs"] = {}
    for run in arguments.runs:
        config, models = studies.load(PROGRAM, run, arguments.trust)
        found = choices(config, models, arguments.states)
        compared = compare(config, models, export.archive(config, models), found)
        results["programs"][str(run)] = {
            PLAYER: {name: dataclasses.asdict(each) for name, each in compared.items()}
        }
    return results


def table(results: Mapping[str, Any], programs: Collection[str] | None = None) -> str:
    """Answers, errors and latencies of all runs, in Markdown.

    Args:
      results: the content of the JSON file.
      programs: names of the programs to show; all by default.
    """
    rows = [
        [
            f"`{studies.name_of(run)}`",
            f"`{name}`",
            f"{each['different']} of {each['states']:,}",
            f"{each['error']:.1e}",
            _microseconds(each),
        ]
        for run, found in results["programs"].items()
        for name, each in found[PLAYER].items()
        if programs is None or name in programs
    ]
    heads = ["run", "program", "different answers", "error", "latency"]
    return studies.with_origin(studies.as_table(heads, rows), results)


def latencies(results: Mapping[str, Any], runs: Sequence[str], programs: Sequence[str]) -> str:
    """Latencies, in Markdown.

    Args:
      results: the content of the JSON file.
      runs: columns.
      programs: rows.
    """
    rows = [
        [
            f"`{name}`",
            *(_microseconds(results["programs"][run][PLAYER][name]) for run in runs),
        ]
        for name in programs
    ]
    heads = ["program", *(f"`{studies.name_of(run)}`" for run in runs)]
    return studies.with_origin(studies.as_table(heads, rows), results)


def _microseconds(compared: Mapping[str, Any]) -> str:
    """A latency with two digits."""
    rounded = float(f"{1e6 * compared['seconds']:.2g}")
    return f"{rounded:,.0f} µs"


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    devices.start(None)
    reserve(PROGRAM, "json", arguments.json)
    results = measure(arguments)
    studies.write(arguments.json, results)
    print(table(results))


if __name__ == "__main__":
    main()
