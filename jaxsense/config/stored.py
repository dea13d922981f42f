"""Settings as plain data, the form of a run's `config.json`."""

import dataclasses
import difflib
import json
from typing import Any

import dacite

from jaxsense.config.checks import ConfigError
from jaxsense.config.whole import Config


def as_plain(config: Config) -> dict[str, Any]:
    """Converts settings to dictionaries, lists, numbers and strings, for JSON."""
    return dataclasses.asdict(config)


def from_plain(stored: Any, base: Config | None = None) -> Config:
    """Makes settings from plain data, the inverse of `as_plain`.

    Args:
      stored: sections and their fields.
      base: source of missing settings; the defaults by default.

    Raises:
      ConfigError: names a field that is unknown, of the wrong type, or invalid.
    """
    if not isinstance(stored, dict):
        raise ConfigError("config", stored, "must be an object with a section for each part")
    for name in ("modalities", "robots"):
        if isinstance(stored.get(name), str | dict):  # which would be taken apart
            raise ConfigError(name, stored[name], "must be a list of names")
    # Each section checks the types of its fields itself.
    rules = dacite.Config(strict=True, check_types=False, type_hooks={float: _number})
    try:
        return dacite.from_dict(Config, _with_tuples(_over(base or Config(), stored)), rules)
    except dacite.UnexpectedDataError as error:
        unknown = sorted(error.keys)[0]
        names = {name.rpartition(".")[2]: name for name in _names(Config)}
        near = difflib.get_close_matches(unknown, names, 1)
        hint = f"; perhaps {names[near[0]]}" if near else ""
        raise ConfigError(unknown, _find(stored, unknown), f"is no setting{hint}") from None
    except dacite.MissingValueError as error:
        raise ConfigError(str(error.field_path), None, "must be given") from None
    except ConfigError:
        raise
    except (dacite.DaciteError, AttributeError, RecursionError, TypeError, ValueError) as error:
        raise ConfigError("config", stored, f"cannot be used ({error})") from None


def parse_json(text: str) -> Any:
    """Parses JSON.

    Raises:
      ValueError: if the text is not JSON, is nested too deeply, or names a field twice.
    """
    try:
        return json.loads(text, object_pairs_hook=_without_twins)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _without_twins(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    """Object of JSON; raises `ValueError` if two of its fields share a name."""
    found = dict(fields)
    if len(found) < len(fields):
        names = [name for name, _ in fields]
        twin = next(name for name in found if names.count(name) > 1)
        raise ValueError(f"{twin!r} is given twice")
    return found


def require_trust(config: Config) -> None:
    """Raises a `ConfigError` if settings name code of custom sensors, which would run."""
    for name, sensor in config.sensors.items():
        reason = "names code that would be run; pass --trust (trust=True) if you trust it"
        raise ConfigError(f"sensors.{name}.make", sensor.make, reason)


def _find(stored: dict[str, Any], name: str) -> Any:
    """Value of the first field of a name, in any section."""
    if name in stored:
        return stored[name]
    sections = (section for section in stored.values() if isinstance(section, dict))
    found = (_find(section, name) for section in sections)
    return next((value for value in found if value is not None), None)


def _over(base: Any, stored: dict[str, Any]) -> dict[str, Any]:
    """Plain settings of `base`, with the stored fields in place of its own, in every section."""
    plain = dataclasses.asdict(base)
    for name, value in stored.items():
        own = getattr(base, name, None)
        merges = dataclasses.is_dataclass(own) and isinstance(value, dict)
        plain[name] = _over(own, value) if merges else value
    return plain


def _with_tuples(value: Any) -> Any:
    """Replaces lists, JSON's form of tuples."""
    if isinstance(value, dict):
        return {name: _with_tuples(each) for name, each in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list | tuple) else value


def _number(value: Any) -> Any:
    """Makes whole numbers real: JSON may write 1 for 1.0."""
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_whole and abs(value) < 2**1000 else value


def _names(section: Any, prefix: str = "") -> list[str]:
    """Names of all settings with their sections."""
    names = []
    for field in dataclasses.fields(section):
        names.append(prefix + field.name)
        if dataclasses.is_dataclass(field.type):
            names += _names(field.type, f"{prefix}{field.name}.")
    return names
