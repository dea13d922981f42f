"""Settings as plain data, the form of a run's `config.json`."""

import dataclasses
import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast, get_args, get_type_hints

from jaxsense.config.section import ConfigError
from jaxsense.config.whole import Config


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
    return cast(Config, made(Config, stored, base or Config()))


def made(kind: Any, stored: object, base: object = None, place: str = "") -> object:
    """A value of a type, its missing fields from `base`; dataclasses check their fields."""
    if not dataclasses.is_dataclass(kind):
        if isinstance(stored, dict) and len(inner := get_args(kind)) == 2:
            return {n: made(inner[1], each, None, f"{place}.{n}") for n, each in stored.items()}
        return stored
    if not isinstance(stored, dict):
        raise ConfigError(place or "config", stored, "must be an object with names and values")
    kinds, given, former = get_type_hints(kind), {}, {}
    for name, value in stored.items():
        path = f"{place}.{name}".lstrip(".")
        plain = [*value] if isinstance(value, tuple) else value  # as JSON has it
        if plain in FORMER.get(path, ()):
            former[name] = plain
        elif name not in kinds and isinstance(plain, dict):  # a former section
            made(_Nothing, plain, None, path)
        elif name not in kinds:
            raise ConfigError(path, value, _unknown(path))
        else:
            default = getattr(kind if base is None else base, name, None)
            given[name] = made(kinds[name], value, default, path)
    if base is not None:
        found = dataclasses.replace(cast(Any, base), **given)
        _check_former(found, former, place)
        return found
    for field in dataclasses.fields(kind):
        if field.name not in given and field.default is dataclasses.MISSING:
            raise ConfigError(place, stored, f"missing setting {field.name}")
    return kind(**given)  # pyright: ignore[reportCallIssue]


@dataclasses.dataclass
class _Nothing:
    """A section without settings."""


def _unknown(path: str) -> str:
    """What is wrong with the name of a setting."""
    if path in FORMER:
        return f"is no longer a setting: must be {' or '.join(map(str, FORMER[path]))}"
    near = nearest(path, [*_paths(Config())])
    return f"unknown setting; did you mean {' or '.join(near)}?" if near else "unknown setting"


def _paths(section: object, place: str = "") -> Iterator[str]:
    """Names of all settings below a section."""
    for field in dataclasses.fields(cast(Any, section)):
        value, path = getattr(section, field.name), f"{place}.{field.name}".lstrip(".")
        yield from _paths(value, path) if dataclasses.is_dataclass(value) else [path]


def nearest(path: str, names: Sequence[str]) -> list[str]:
    """The names nearest to an unknown one, of its section or else of any."""
    section, _, last = path.rpartition(".")
    apart = [name.rpartition(".") for name in names]
    for known in ([name for name in apart if name[0] == section], apart):
        for near in difflib.get_close_matches(last, [name[2] for name in known], 1, 0.7):
            return ["".join(name) for name in known if name[2] == near]
    return []


def _check_former(section: object, former: Mapping[str, object], place: str) -> None:
    """Compares former settings with what follows from others now, a property of their name."""
    for name, value in former.items():
        follows = isinstance(getattr(type(section), name, None), property)
        if follows and (now := getattr(section, name)) != value:
            raise ConfigError(f"{place}.{name}", value, f"is no longer a setting: must be {now}")


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
    names = [name for name, _ in fields]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name!r} appears twice")
    return dict(fields)


FORMER: Mapping[str, Sequence[object]] = {
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
    "team.tours.states": [65536, 512],
    "team.tours.steps": [3200, 60, 0],
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
    "mission.auctions": [True, False],
    "mission.equal_values": [0.1, 0.05],
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
