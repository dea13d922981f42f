"""Settings as options of a command line and as plain data, the form of a run's `config.json`.

Options are read from dataclasses, whose docstrings are the help. Command lines and JSON both become
nested dictionaries, from which `made` makes the dataclasses.
"""

import ast
import contextlib
import dataclasses
import difflib
import functools
import inspect
import itertools
import json
import re
import shlex
import shutil
import sys
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from jaxsense.config.section import ConfigError
from jaxsense.config.whole import Config

T = TypeVar("T")
_LONGEST = 80  # characters of a word that an error repeats
_REQUIRED = dataclasses.MISSING


class OptionError(ValueError):
    """A command line that cannot be read; its text is one line."""


class Name(str):
    """Annotates a field that is not the option `--FIELD` on the command line.

    `Name("--config")` is another option, `Name("RUN")` a positional argument, and `Name("--")` a
    section whose options have no prefix.
    """


@dataclasses.dataclass(frozen=True)
class Option:
    """A command-line option or a positional argument.

    Attributes:
      path: fields and keys that lead to its value.
      name: on the command line.
      kind: type of the value.
      default: value if it is missing; `dataclasses.MISSING` if it is required.
      section: dataclass that declares it.
    """

    path: tuple[str, ...]
    name: str
    kind: object
    default: object
    section: type

    @property
    def is_optional(self) -> bool:
        """Whether the value may be None."""
        return types.NoneType in get_args(self.kind)

    @property
    def words(self) -> tuple[object, float | None]:
        """Type of the words of the value and, of a tuple, their number."""
        kind = get_args(self.kind)[0] if self.is_optional else self.kind
        if get_origin(kind) is not tuple:
            return kind, None
        inner = get_args(kind)
        return inner[0], float("inf") if ... in inner else len(inner)

    @property
    def off(self) -> str:
        """The option that sets False, such as `--mission.no-auctions`."""
        return re.sub(r"^(.*\.|--)", r"\1no-", self.name)

    @property
    def help(self) -> str:
        """The field's docstring; of an entry of a dictionary, that of the dictionary."""
        known = docs(self.section)
        text = next((known[field] for field in reversed(self.path) if field in known), "")
        return text.replace("`", "")

    def value(self, words: list[str]) -> object:
        """Reads the value. Words of another type stay text, which the dataclass refuses."""
        kind, number = self.words
        if self.is_optional and [word.lower() for word in words] == ["none"]:
            return None
        values = tuple(_of_type(kind, word) for word in words)
        return values[0] if number is None else values


def options_of(base: object, name: str = "--", path: tuple[str, ...] = ()) -> Iterator[Option]:
    """All options of a dataclass, an instance or else the class, which holds their defaults."""
    section = base if isinstance(base, type) else type(base)
    kinds, marked = get_type_hints(section), get_type_hints(section, include_extras=True)
    prefix = name if name == "--" else f"{name}."
    for field in (each.name for each in dataclasses.fields(cast(Any, section))):
        default = getattr(base, field, _REQUIRED)
        own = next((mark for mark in get_args(marked[field]) if isinstance(mark, Name)), None)
        inside, to = own or prefix + field.replace("_", "-"), (*path, field)
        if dataclasses.is_dataclass(default):
            yield from options_of(default, inside, to)
        elif isinstance(default, Mapping):
            kind = get_args(kinds[field])[1]
            for key, each in default.items():
                entry = f"{inside}.{key.replace('_', '-')}"
                if dataclasses.is_dataclass(each):
                    yield from options_of(each, entry, (*to, key))
                else:
                    yield Option((*to, key), entry, kind, each, section)
        else:
            yield Option(to, inside, kinds[field], default, section)


def read(base: T | type[T], argv: list[str]) -> T:
    """Reads a command line.

    Args:
      base: dataclass of the options; an instance, or else the class, holds their defaults.
      argv: the command line without the program.

    Raises:
      OptionError: if an option is unknown, or an option or a value is missing.
      ConfigError: by the dataclass, for a value that is wrong.
    """
    options = list(options_of(base))
    values, unknown = _split(options, argv)
    if unknown:
        raise OptionError(_unknown(unknown, [option.name for option in options]))
    for option in options:
        if option.default is _REQUIRED and option.path not in values:
            what = option.help[:1].lower() + option.help[1:].rstrip(".")
            raise OptionError(f"missing argument {option.name}: {what}")
    return cast(T, _changed(base, values))


def read_some(arguments: type, argv: list[str], fields: Sequence[str]) -> dict[str, object]:
    """Reads some options of a dataclass before the defaults of the others are known.

    Returns:
      Values on the command line, by field; text where the type is wrong.

    Raises:
      OptionError: if the value of one of these options is missing.
    """
    options = [option for option in options_of(arguments) if option.path[0] in fields]
    return {field: value for (field,), value in _split(options, argv)[0].items()}


def command(program: str) -> str:
    """The command line that runs a module such as "jaxsense.train" as this process was started."""
    # If the console script is in use, `python` on the path may not find the package.
    if Path(sys.argv[0]).name == "jaxsense":
        return program.replace(".", " ", 1)
    return f"python -m {program}"


def describe(program: str, base: object, common: Sequence[str] = ()) -> str:
    """Returns the help, set for the width of the terminal.

    Args:
      program: module to run, for example "jaxsense.train".
      base: as in `read`.
      common: options to show, in this order; by default all, by section.
    """
    width = max(shutil.get_terminal_size().columns - 2, 20)
    options = {option.name: option for option in options_of(base)}
    positional = [_usage(each) for name, each in options.items() if not name.startswith("-")]
    title = (base.__doc__ or "").replace("`", "")
    parts = [f"usage: {' '.join([f'{command(program)} [OPTIONS]', *positional])}"]
    parts += ["", textwrap.fill(" ".join(title.split()), width)]
    section: object = None
    for option in (options[name] for name in common or options):
        if option.section is not section and not common:
            place = getattr(option.section, "PLACE", "")
            about = " ".join((option.section.__doc__ or "").replace("`", "").split())
            parts += ["", f"{place or 'options'}:"]
            parts += [textwrap.indent(textwrap.fill(about, width - 2), "  "), ""] if place else []
        elif section is None:
            parts += ["", "options:"]
        section = option.section
        parts.append(f"  {option.name} {_metavar(option)}".rstrip())
        lines = textwrap.wrap(_text(option), width - 6, break_on_hyphens=False)
        parts += [f"      {line}" for line in lines]
    if common:
        parts += ["", f"--help-all lists all {len(options)} options."]
    return "\n".join(parts)


@functools.cache
def docs(section: type) -> dict[str, str]:
    """Docstrings of the fields of a dataclass whose source is available, each as one line."""
    found: dict[str, str] = {}
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(section))).body
    for pair in itertools.pairwise(getattr(node, "body", ())):
        match pair:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(text.split())
    return found


def _split(
    options: list[Option], argv: list[str]
) -> tuple[dict[tuple[str, ...], object], list[str]]:
    """The values on a command line, and the words that belong to no option."""
    named = {option.name: option for option in options}
    turned_off = {option.off: option for option in options if option.kind is bool}
    positional = [option for option in options if not option.name.startswith("-")]
    values: dict[tuple[str, ...], object] = {}
    unknown: list[str] = []
    words = list(argv)
    while words:
        name, equals, text = words.pop(0).partition("=")
        # `--num_seeds` is `--num-seeds`.
        name = name.replace("_", "-") if name.startswith("--") else name + equals + text
        option = named.get(name) or turned_off.get(name) if name.startswith("-") else None
        if option is None:
            taken = [name] if _is_option(name) or not positional else [name, *_values(words)]
            if len(taken) == 1 and (_is_option(name) or not positional):
                unknown.append(name)
                continue
            option = positional.pop(0)
            if option.words[1] is None:
                words[:0], taken = taken[1:], taken[:1]
            values[option.path] = option.value(taken)
        elif option.kind is bool:
            if equals:
                raise OptionError(f"argument {name}: ignored explicit argument {_cut(text)!r}")
            values[option.path] = name != option.off
        else:
            number = option.words[1]
            most = 1 if number is None else number
            given = [text] if equals else _values(words, most)
            if most not in (len(given), float("inf")):
                expected = "one argument" if most == 1 else f"{most} arguments"
                raise OptionError(f"argument {name}: expected {expected}")
            values[option.path] = option.value(given)
    return values, unknown


def _values(words: list[str], most: float = float("inf")) -> list[str]:
    """Takes words from the front up to the next option."""
    taken: list[str] = []
    while words and len(taken) < most and not _is_option(words[0]):
        taken.append(words.pop(0))
    return taken


def _is_option(word: str) -> bool:
    """Whether a word begins with a dash and is no negative number."""
    return len(word) > 1 and word[0] == "-" and not re.fullmatch(r"-\d+|-\d*\.\d+", word)


def _of_type(kind: object, word: str) -> object:
    """A word as a number or a path, if it is one."""
    if kind is Path and word and word.isprintable():
        return Path(word)
    with contextlib.suppress(ValueError):
        return int(word) if kind is int else float(word) if kind is float else word
    return word


def _changed(section: Any, values: Mapping[tuple[str, ...], object]) -> object:
    """A section with other values at some paths; of a class, a new instance."""
    if () in values:
        return values[()]
    parts: dict[str, dict[tuple[str, ...], object]] = {path[0]: {} for path in values}
    for path, value in values.items():
        parts[path[0]][path[1:]] = value
    if isinstance(section, Mapping):
        return {**section, **{key: _changed(section[key], part) for key, part in parts.items()}}
    new = {name: _changed(getattr(section, name, None), part) for name, part in parts.items()}
    return section(**new) if isinstance(section, type) else dataclasses.replace(section, **new)


def _usage(option: Option) -> str:
    """A positional argument as a usage line shows it."""
    several = f"{option.name} ..." if option.words[1] else option.name
    return several if option.default is _REQUIRED else f"[{several}]"


def _metavar(option: Option) -> str:
    """Placeholder in the help for the words of a value."""
    kind, number = option.words
    if kind is bool or not option.name.startswith("-"):
        return ""
    names: dict[object, str] = {int: "INT", float: "NUMBER", Path: "PATH"}
    one = names.get(kind, "NAME")
    if get_origin(kind) is Literal:
        one = f"{{{','.join(get_args(kind))}}}"
    return f"[{one} ...]" if number == float("inf") else " ".join([one] * int(number or 1))


def _text(option: Option) -> str:
    """An option's docstring and default value."""
    value = option.default
    if value is True:
        return f"{option.help} (default: on; {option.off} turns it off)"
    if value in (None, (), _REQUIRED) or value is False:
        return option.help
    words = shlex.join(map(str, value)) if isinstance(value, tuple) else value
    return f"{option.help} (default: {words})"


def _cut(word: str) -> str:
    return word if len(word) <= _LONGEST else f"{word[:_LONGEST]}..."


def _unknown(words: list[str], names: list[str]) -> str:
    """The message about words that belong to no option."""
    word = next((word for word in words if word.startswith("-")), words[0])
    if not word.startswith("-"):
        return f"unexpected argument {_cut(word)!r}: options start with --"
    if word[2:].removeprefix("no-").partition("=")[0].replace("-", "_") in _REMOVED:
        return f"{_cut(word)} is no longer an option"
    near = _nearest(word[2:], [name[2:] for name in names if name.startswith("--")])
    hint = f"did you mean --{near[0]}?" if near else "see --help-all"
    return f"unknown option {_cut(word)}; {hint}"


def _nearest(path: str, names: Sequence[str]) -> list[str]:
    """The names nearest to an unknown one, of its section or else of any."""
    section, _, last = path.rpartition(".")
    apart = [name.rpartition(".") for name in names]
    for known in ([name for name in apart if name[0] == section], apart):
        for near in difflib.get_close_matches(last, [name[2] for name in known], 1, 0.7):
            return ["".join(name) for name in known if name[2] == near]
    return []


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
    names = [name for name, _ in fields]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name!r} appears twice")
    return dict(fields)


def require_trust(config: Config) -> None:
    """Raises a `ConfigError` if settings name custom sensors or rewards, whose code would run."""
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
    kinds, given, former = get_type_hints(kind), {}, {}
    for name, value in stored.items():
        path = f"{place}.{name}".lstrip(".")
        if path in _REMOVED and json.loads(json.dumps(value)) in _REMOVED[path]:
            former[name] = value
            continue
        if name in kinds:
            given[name] = _made(kinds[name], value, getattr(base, name, None), path)
        elif path in _REMOVED:
            allowed = " or ".join(map(str, _REMOVED[path]))
            raise ConfigError(path, value, f"is no longer a setting: must be {allowed}")
        else:
            near = _nearest(path, [".".join(option.path) for option in options_of(Config())])
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise ConfigError(path, value, f"unknown setting{hint}")
    if base is not None:
        made = dataclasses.replace(cast(Any, base), **given)
        _check_former(made, former, place)
        return made
    for field in dataclasses.fields(kind):
        if field.name not in given and field.default is dataclasses.MISSING:
            raise ConfigError(place, stored, f"missing setting {field.name}")
    return kind(**given)


def _check_former(made: object, former: Mapping[str, object], place: str) -> None:
    """Compares former settings with what follows from others now, a property of their name."""
    for name, value in former.items():
        follows = isinstance(getattr(type(made), name, None), property)
        if follows and (now := getattr(made, name)) != value:
            raise ConfigError(f"{place}.{name}", value, f"is no longer a setting: must be {now}")


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
