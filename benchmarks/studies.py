"""What studies of trained models share: how they read models, and what they note of results."""

import dataclasses
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jaxsense
from benchmarks import measure
from jaxsense import Config, Models
from jaxsense.config import ConfigError, parse_json
from jaxsense.run import cli, rundir
from jaxsense.tasks import registry
from jaxsense.tasks.pretrained import PREFIX

_POSITIONAL = ("run", "runs", "commit")  # words without an option
_FILES = ("json", "plot")  # do not change results


def load(program: str, run: Path, trust: bool = False) -> tuple[Config, Models]:
    """Settings and models, or ends the program.

    Args:
      program: module that runs.
      run: directory of a run, `latest`, or `pretrained:PRESET`.
      trust: whether to run the code of custom sensors.
    """
    try:
        return jaxsense.load(run, trust)
    except ConfigError as error:
        cli.fail(program, str(error))


def name_of(run: Path | str) -> str:
    """A run in a table: the preset of pretrained models, or the name of its directory.

    Args:
      run: see `load`.
    """
    return Path(run).name.removeprefix(PREFIX)


def command(program: str, arguments: Any) -> str:
    """The command that measures the same again.

    Args:
      program: module that runs.
      arguments: the dataclass of its options, whose defaults are left out.
    """
    words = ["python", "-m", program]
    for field in dataclasses.fields(arguments):
        value, is_word = getattr(arguments, field.name), field.name in _POSITIONAL
        if field.name in _FILES or (value == field.default and not is_word):
            continue
        words += [] if is_word else [f"--{field.name.replace('_', '-')}"]
        if value is not True:
            words += map(str, value if isinstance(value, tuple) else (value,))
    return shlex.join(words)


def origin(program: str, arguments: Any, packages: tuple[str, ...] = ()) -> dict[str, object]:
    """How, where and when results were measured, with all options and the models' own origin.

    Args:
      program: module that runs.
      arguments: the dataclass of its options.
      packages: distributions that it needs, see `measure.versions`.
    """
    options = dataclasses.asdict(arguments)
    runs = options.get("runs") or (options["run"],)
    return {
        **measure.origin(command(program, arguments), packages),
        "options": {name: x for name, x in options.items() if name not in _FILES},
        "models": {str(run): _made(run) for run in runs},
    }


def _made(run: Path) -> dict[str, object]:
    """What made the models of a run."""
    if (name := str(run)).startswith(PREFIX):
        return dataclasses.asdict(registry.origin(name.removeprefix(PREFIX)))
    found: Any = parse_json((rundir.newest(run) / "config.json").read_bytes())
    return {name: found.get(name) for name in ("preset", "seed", "commit", "versions")}


def write(
    file: Path | None, results: Mapping[str, object] | Sequence[Mapping[str, object]]
) -> None:
    """Writes results to the file that `measure.reserve` has made, if one was asked for.

    Args:
      file: the file.
      results: with the keys of `origin`; perhaps of several calls.
    """
    if file is not None:
        file.write_text(json.dumps(results, indent=1, default=str) + "\n", encoding="utf-8")


def in_words(modality: str) -> str:
    """A modality as pages call it.

    Args:
      modality: its name in the settings.
    """
    return modality.replace("lidar", "LiDAR").replace("_", " ")


def as_table(heads: list[str], rows: list[list[str]]) -> str:
    """A Markdown table.

    Args:
      heads: of the columns.
      rows: cells of each row.
    """
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def with_origin(table: str, results: Mapping[str, Any]) -> str:
    """A table, and below it a sentence that says how it came.

    Args:
      table: in Markdown.
      results: with the keys of `origin`.
    """
    return f"{table}\n\n{measure.describe(results)}"
