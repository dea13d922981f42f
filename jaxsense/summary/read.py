"""Reads and checks `summary.json` and the evaluations of the same run."""

import json
import shlex
import types
from pathlib import Path
from typing import Annotated, NotRequired, Union, cast, get_args, get_origin, get_type_hints
from typing import is_typeddict as is_block

from jaxsense.config import ConfigError, parse_json
from jaxsense.config.options import command
from jaxsense.summary.blocks import Evaluation, Made, Results, Summary

ORIGINS = "origins.json"
EVALUATIONS = "evaluations"
"""The directory of evaluations in that of a run."""
RESULTS = tuple(get_type_hints(Results))


def read(run: Path) -> Summary:
    """Reads the summary of a finished run, of one seed or of several.

    Args:
      run: its directory.

    Raises:
      ConfigError: if there is no summary, or a value in it is missing or wrong.
    """
    return cast(Summary, _read(run, run / "summary.json", Summary))


def read_evaluations(run: Path) -> dict[str, Evaluation]:
    """Reads the evaluations of a run.

    Args:
      run: its directory.

    Returns:
      The evaluations, by the names of their files.

    Raises:
      ConfigError: if one cannot be read, or a value in it is missing or wrong.
    """
    files = sorted((run / EVALUATIONS).glob("*.json"))
    return {file.stem: cast(Evaluation, _read(run, file, Evaluation)) for file in files}


def read_made(run: Path) -> list[Made]:
    """Reads what made each stage of a run, which need not be finished.

    Args:
      run: its directory.

    Returns:
      The content of its `origins.json`; of none, nothing.

    Raises:
      ConfigError: if the file cannot be read, or a value in it is missing or wrong.
    """
    file = run / ORIGINS
    return cast(list[Made], _read(run, file, list[Made])) if file.exists() else []


class NotFinishedError(ConfigError):
    """A run that has not finished."""

    def __init__(self, run: Path):
        resume = f"{command('jaxsense.train')} --resume {shlex.quote(str(run))}"
        self.expected = f"is not finished: it has no summary.json; continue it with {resume}"
        ValueError.__init__(self, f"{run} {self.expected}")


def _read(run: Path, file: Path, kind: type) -> object:
    if kind is Summary and not file.exists():
        raise NotFinishedError(run)
    try:
        content = parse_json(file.read_text(encoding="utf-8"))
        json.dumps(content, allow_nan=False)
        # With several seeds, only the summary of each seed has this type.
        values = content
        if isinstance(content, dict) and "seeds" in content:
            values, kind = content["seeds"], dict[str, Results]
        if wrong := _wrong(values, kind, file.stem):
            raise ValueError(wrong)
        return content
    except (OSError, ValueError) as error:
        reason = f"must hold the {file.relative_to(run)} of a finished run ({error})"
        raise ConfigError("run", str(run), reason) from None


def _wrong(value: object, kind: type, key: str) -> str | None:
    """The first JSON value that is missing or not of its type; None if all are."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Annotated, NotRequired):
        return _wrong(value, inner[0], key)
    if origin in (Union, types.UnionType):
        found = [_wrong(value, each, key) for each in inner]
        return None if None in found else found[0]
    if is_block(kind) and isinstance(value, dict):
        hints = get_type_hints(kind, include_extras=True)
        if missing := sorted(kind.__required_keys__ - set(value)):
            return f"{key}.{missing[0]} is missing"
        items = [(name, value[name], hints[name]) for name in hints if name in value]
    elif origin is dict and isinstance(value, dict):
        items = [(name, each, inner[1]) for name, each in value.items()]
    elif origin is list and isinstance(value, list):
        items = [(str(i), each, inner[0]) for i, each in enumerate(value)]
    else:
        kinds = (int, float) if kind is float else kind
        is_right = not (is_block(kind) or origin) and isinstance(value, kinds)
        is_right &= kind is bool or not isinstance(value, bool)
        return None if is_right else f"{key} has the wrong type"
    found = (_wrong(each, hint, f"{key}.{name}") for name, each, hint in items)
    return next((wrong for wrong in found if wrong), None)
