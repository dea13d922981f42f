"""Reads and checks `summary.json` and the evaluations of the same run."""

import json
import os
import shlex
import types
from pathlib import Path
from typing import Annotated, NotRequired, Union, cast, get_args, get_origin, get_type_hints
from typing import is_typeddict as is_block

from jaxsense.config import ConfigError
from jaxsense.config.options import command, parse
from jaxsense.core import inside
from jaxsense.summary.blocks import Evaluation, Interval, Missions, Origin, Results, Summary, Timed

ORIGINS = "origins.json"
EVALUATIONS = "evaluations"
"""The directory of evaluations in that of a run."""
_MOST_CASES, _LARGEST = 1000, 1e30


def read_summary(run: Path) -> Summary:
    """The summary of a finished run, of one seed or of several.

    Raises:
      ConfigError: if there is no summary, or a value in it is missing or wrong.
    """
    if not os.path.lexists(run / "summary.json"):
        resume = f"{command('jaxsense.train')} --resume {shlex.quote(str(run))}"
        reason = f"is not finished: it has no summary.json; continue it with {resume}"
        raise ConfigError("run", str(run), reason)
    return cast(Summary, _read(run, run / "summary.json", Summary))


def read_evaluations(run: Path) -> dict[str, Evaluation]:
    """The evaluations of a run, by the names of their files.

    Raises:
      ConfigError: if one cannot be read, or a value in it is missing or wrong.
      OSError: see `inside.matching`.
    """
    files = inside.matching(run, f"{EVALUATIONS}/*.json")
    return {file.stem: cast(Evaluation, _read(run, file, Evaluation)) for file in files}


def read_origins(run: Path) -> list[Origin]:
    """The processes that have worked on a run, in order; none without `origins.json`.

    Raises:
      ConfigError: if the file cannot be read, or a value in it is missing or wrong.
    """
    file = run / ORIGINS
    return cast(list[Origin], _read(run, file, list[Origin])) if file.exists() else []


def _read(run: Path, file: Path, kind: type) -> object:
    try:
        content = parse(inside.read(file))
        json.dumps(content, allow_nan=False)
        wrong = _wrong(content, kind, file.stem)
        # With several seeds, only the results of each seed have this type.
        if kind is Summary and isinstance(content, dict) and content.get("seeds"):
            wrong = _wrong(content, Timed, "summary") or _wrong(content, Results, "summary", True)
        if wrong:
            raise ValueError(wrong)
        return content
    except (OSError, ValueError) as error:
        reason = f"must hold the {file.relative_to(run)} of a finished run ({error})"
        raise ConfigError("run", str(run), reason) from None


def _wrong(value: object, kind: type, key: str, is_mean: bool = False) -> str | None:
    """The first JSON value that is missing or not of its type; None if all are.

    Means of several seeds have an `Interval` in place of each number.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Annotated, NotRequired):
        return _wrong(value, inner[0], key, is_mean)
    if origin in (Union, types.UnionType):
        found = [_wrong(value, each, key, is_mean) for each in inner]
        return None if None in found else found[0]
    if is_mean and kind in (int, float, bool):
        kind, is_mean = Interval, False
    if is_block(kind) and isinstance(value, dict):
        hints = get_type_hints(kind, include_extras=True)
        if missing := sorted(kind.__required_keys__ - set(value)):
            return f"{key}.{missing[0]} is missing"
        items = [(name, value[name], hints[name]) for name in hints if name in value]
    elif kind == Missions and not (isinstance(value, dict) and 0 < len(value) <= _MOST_CASES):
        return f"{key} must hold 1 to {_MOST_CASES:,} cases"
    elif origin is dict and isinstance(value, dict):
        items = [(name, each, inner[1]) for name, each in value.items()]
    elif origin is list and isinstance(value, list):
        items = [(str(i), each, inner[0]) for i, each in enumerate(value)]
    else:
        kinds = (int, float) if kind is float else kind
        is_right = not (is_block(kind) or origin) and isinstance(value, kinds)
        is_right &= kind is bool or not isinstance(value, bool)
        is_right &= not isinstance(value, int | float) or abs(value) <= _LARGEST
        return None if is_right else f"{key} has the wrong type"
    found = (_wrong(each, hint, f"{key}.{name}", is_mean) for name, each, hint in items)
    return next((wrong for wrong in found if wrong), None)
