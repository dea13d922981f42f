"""Settings as plain data, the form of a run's `config.json`."""

import dataclasses
import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import cast, get_args, get_type_hints

from jaxsense.config.checks import ConfigError
from jaxsense.config.whole import Config

_REMOVED: Mapping[str, Sequence[object]] = {
    "mission.localisation.search": [{"position": 0.0, "heading": 0.0}],
    "arena.poi_height": [0.2],
    "lidar.stride": [1],
    "camera.light_distance": [0.5],
    "camera.light_time": [60.0],
    "viewpoint.max_bearing": [20.0],
    "viewpoint.clearance": [0.03],
    "jmvae.alpha_start": [0.0, 0.4],
    "jmvae.looks": [4],
    "filter.hidden": [[32]],
    "filter.looks": [6],
    "filter.batch": [256],
    "filter.learning_rate": [5e-3],
    "mdp.unseen_variance": [20.0],
    "team.travel.speed": [0.2],
    "team.travel.turn_rate": [1.2],
    "team.travel.look_seconds": [0.7],
    "team.tours.tries": [4],
    "team.tours.walk": [8],
    "team.tours.batch": [1024, 64],
    "team.tours.learning_rate": [2e-3],
    "team.robots_each": [2],
    "team.alone": [0.25],
    "team.partly_seen": [0.5, 0.0],
    "team.max_steps": [300],
    "dqn.final_learning_rate": [1e-5],
    "dqn.epsilon_start": [1.0],
    "dqn.num_starts": [8192, 64],
    "dqn.chunk": [100, 20],
    "evaluation.value_points": [2048, 8192, 256],
    "navigation.horizon": [2.0],
    "navigation.robot_radius": [0.1],
    "navigation.inflation": [0.1],
    "navigation.view_distances": [[0.5, 0.9]],
    "mission.control_period": [0.1],
    "mission.nearest_first": [True],
    "mission.redecides": [True],
    "mission.avoids_targets": [True],
    "mission.attempts": [3],
    "mission.localisation.position_error": [0.0],
    "mission.localisation.heading_error": [0.0],
    "mission.localisation.position_drift": [0.0],
    "mission.localisation.heading_drift": [0.0],
    "mission.communication.period": [1.0],
}
"""Former settings with their values in all presets, which are constants now."""


def as_plain(config: Config) -> dict[str, object]:
    """Converts settings to dictionaries, lists, numbers and strings, for JSON."""
    return dataclasses.asdict(config)


def from_plain(stored: object, base: Config | None = None) -> Config:
    """Makes settings from plain data, the inverse of `as_plain`.

    Args:
      stored: sections and their fields.
      base: source of missing settings; the defaults by default.

    Raises:
      ConfigError: names a field that is unknown, of the wrong type, or invalid.
    """
    return cast(Config, _made(Config, stored, base or Config(), ""))


def parse_json(content: bytes) -> object:
    """Parses JSON strictly: UTF-8, no deep nesting, no field twice, no half of a character.

    Raises:
      ValueError: if the content is not such JSON.
    """
    try:
        found = json.loads(content.decode(), object_pairs_hook=_without_twins)
        json.dumps(found, ensure_ascii=False).encode()
        return found
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _without_twins(fields: list[tuple[str, object]]) -> dict[str, object]:
    """Object of JSON; raises `ValueError` if two of its fields share a name."""
    found = dict(fields)
    if len(found) < len(fields):
        names = [name for name, _ in fields]
        twin = next(name for name in found if names.count(name) > 1)
        raise ValueError(f"{twin!r} appears twice")
    return found


def require_trust(config: Config) -> None:
    """Raises an error if settings name custom sensors or a custom reward, whose code would run.

    Raises:
      ConfigError: if they do.
    """
    for field, path in config.named_code.items():
        reason = "names code that would be run; pass --trust (trust=True) if you trust it"
        raise ConfigError(field, path, reason)


def _made(kind: object, stored: object, base: object, place: str) -> object:
    """A value of type `kind`, with the missing fields of `base`; dataclasses check their fields."""
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        if isinstance(stored, dict) and len(get_args(kind)) == 2:
            inner = get_args(kind)[1]
            return {n: _made(inner, each, None, f"{place}.{n}") for n, each in stored.items()}
        return stored
    if not isinstance(stored, dict):
        raise ConfigError(place or "config", stored, "must be an object with names and values")
    kinds, given = get_type_hints(kind), {}
    for name, value in stored.items():
        path = f"{place}.{name}".lstrip(".")
        if path in _REMOVED and json.loads(json.dumps(value)) in _REMOVED[path]:
            continue
        if path in _REMOVED and name not in kinds:
            allowed = " or ".join(map(str, _REMOVED[path]))
            raise ConfigError(path, value, f"is no longer a setting: must be {allowed}")
        if name not in kinds:
            raise ConfigError(path, value, f"unknown setting{_suggestion(path)}")
        given[name] = _made(kinds[name], value, getattr(base, name, None), path)
    if dataclasses.is_dataclass(base) and not isinstance(base, type):
        return dataclasses.replace(base, **given)
    for field in dataclasses.fields(kind):
        if field.name not in given and field.default is dataclasses.MISSING:
            raise ConfigError(place, stored, f"missing setting {field.name}")
    return kind(**given)


def _suggestion(path: str) -> str:
    """A question about the known settings whose name is nearest to an unknown one's, if any is."""
    section, _, last = path.rpartition(".")
    names = [name.rpartition(".") for name in _names(Config)]
    inside = [name for name in names if name[0] == section]
    for known in (inside, names):
        for near in difflib.get_close_matches(last, [name[2] for name in known], 1):
            alike = ["".join(name) for name in known if name[2] == near]
            return f"; did you mean {' or '.join(alike)}?"
    return ""


def _names(section: type, prefix: str = "") -> Iterator[str]:
    """Names of all settings with their sections."""
    for field in dataclasses.fields(section):
        yield prefix + field.name
        if isinstance(field.type, type) and dataclasses.is_dataclass(field.type):
            yield from _names(field.type, f"{prefix}{field.name}.")
